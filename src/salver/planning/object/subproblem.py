"""The convex programme inside every solver: a quadratic cost, thousands of concave constraints, few of which bind.

They are not handed to the quadratic solver: it gets the tangents that the current point violates, until none is.
Every relaxed programme bounds the optimum from below, which gives the duality gap that is reported.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from salver.geometry import Array
from salver.planning import qp
from salver.planning.object.conditions import Rows
from salver.planning.object.problem import Linearisation
from salver.planning.qp import Optimum, Quadratic

TOLERANCE = 1e-9  # N (or the row's own unit): a constraint counts as kept within this
PROGRAMME_TOLERANCE = 1e-12  # of the scaled rows: the bound that a programme proves is only as good
_CUT_LIMIT = 60  # rounds of tangents


@dataclass(frozen=True)
class Step:
    """Answer of one convex subproblem.

    d: the step. lower_bound, violation: of the model. rounds: programmes solved. price: sum of the multipliers, what
    one unit of violation is worth.
    """

    d: Array
    lower_bound: float
    violation: float
    rounds: int
    price: float = 0.0


def solve_model(
    model: Linearisation,
    margin: float,
    damping: float,
    radius: float,
    elastic: bool = False,
    penalty: float | None = None,
) -> Step | None:
    """Minimise |r + J d|^2 + damping |d|^2 over |d_i| <= radius, goal met, all rows above the margin.

    elastic: allow one common violation s >= 0 at a price; without a `penalty` only s counts (and the cost
    decides among equals by a hair). Returns None when the rows contradict each other.
    """
    n = model.residual_jacobian.shape[1]
    jacobian, residual = model.residual_jacobian, model.residual
    hessian, gradient, constant = 2 * (jacobian.T @ jacobian), 2 * (jacobian.T @ residual), float(residual @ residual)
    ridge = 2 * damping + 1e-14 * np.trace(hessian) / max(n, 1)
    hessian = hessian + ridge * np.eye(n)
    if elastic and penalty is None:
        unit = max(constant, 1e-12)
        hessian, gradient, penalty = 1e-6 * hessian / unit, 1e-6 * gradient / unit, 1.0
    programme = _Programme(hessian, gradient, model, radius, penalty if elastic else None)
    d = _least(hessian, gradient, model.goal, model.goal_jacobian, radius)
    bound, violation, s, price = -np.inf, np.inf, 0.0, 0.0
    solved = False
    if d is not None:
        bound = constant + float(gradient @ d + 0.5 * d @ hessian @ d)
    for rounds in range(1, _CUT_LIMIT + 1):
        if d is not None:
            offset, slope, violation = _violated(model.rows, d, margin, s)
            if len(offset) == 0:
                return Step(d, bound, violation, rounds, price)
            if n == 0:  # the boundary conditions leave nothing free
                return Step(d, bound, violation, rounds) if elastic else None
            programme.add(offset, slope)
        answer = programme.solve()
        if answer is None:
            if elastic and solved and d is not None:  # the latest cuts differ by rounding: the step before is as good
                return Step(d, bound, violation, rounds, price)
            return None
        d, s, dual_value, price = answer
        solved = True
        bound = constant + dual_value
    assert d is not None
    return Step(d, bound, violation, _CUT_LIMIT, price)


def _least(hessian: Array, gradient: Array, goal: Array, goal_jacobian: Array, radius: float) -> Array | None:
    """Minimiser without contact constraints, or None when it leaves the trust region."""
    m, n = len(goal), len(gradient)
    if m == 0:
        d = np.linalg.solve(hessian, -gradient)
    else:
        kkt = np.block([[hessian, goal_jacobian.T], [goal_jacobian, np.zeros((m, m))]])
        d = np.linalg.solve(kkt, np.concatenate([-gradient, -goal]))[:n]
    return d.astype(float) if np.abs(d).max(initial=0.0) <= radius else None


def _violated(rows: tuple[Rows, ...], d: Array, margin: float, s: float) -> tuple[Array, Array, float]:
    """Tangents at d of what is violated there: for each row, at its local minima over time."""
    offsets, slopes, violation = [np.zeros(0)], [np.zeros((0, len(d)))], 0.0
    for item in rows:
        slack = item.slack(d) - margin
        least = float(slack.min())
        violation = max(violation, -least)
        if least + s < -TOLERANCE:
            around = np.full((len(slack) + 2, slack.shape[1]), np.inf)
            around[1:-1] = slack
            lowest = (slack <= around[:-2]) & (slack <= around[2:])
            instant, row = np.nonzero((slack + s < -TOLERANCE) & lowest)
            offset, slope = item.tangents(d, instant, row)
            offsets.append(offset - margin)
            slopes.append(slope)
    return np.concatenate(offsets), np.concatenate(slopes), violation


class _Programme:
    """The dense quadratic programme of a subproblem, which gets more rows from round to round.

    Scaled so that cost and rows are of order one, whatever their units. With a penalty, one unknown more: the common
    violation s.
    """

    def __init__(
        self, hessian: Array, gradient: Array, model: Linearisation, radius: float, penalty: float | None
    ) -> None:
        self.n, self.elastic = len(gradient), penalty is not None
        n, size = self.n, self.n + self.elastic
        self.unit = max(float(np.abs(gradient).max(initial=0.0)), float(np.abs(hessian).max(initial=0.0)), 1e-300)
        h, g = np.zeros((size, size)), np.zeros(size)
        h[:n, :n], g[:n] = hessian / self.unit, gradient / self.unit
        low, high = np.full(size, -radius), np.full(size, radius)
        if penalty is not None:
            g[n], h[n, n] = penalty / self.unit, 1e-9 * penalty / self.unit
            low[n], high[n] = 0.0, np.inf
        equal = np.hstack([model.goal_jacobian, np.zeros((len(model.goal), int(self.elastic)))])
        self.norm = np.zeros(0)
        self.quadratic = Quadratic(h, g, np.zeros((0, size)), np.zeros(0), equal, -model.goal, low, high)

    def add(self, offset: Array, slope: Array) -> None:
        """Rows offset (m,) + slope (m, n) d >= 0."""
        # What d cannot change keeps a row of order one when s can: its slope is rounding.
        norm = np.maximum(np.linalg.norm(slope, axis=1), 1.0 if self.elastic else 1e-12)
        rows = np.empty((len(slope), self.n + self.elastic))
        rows[:, : self.n] = slope / -norm[:, None]
        rows[:, self.n :] = -1 / norm[:, None]
        self.norm, before = np.concatenate([self.norm, norm]), self.quadratic
        self.quadratic = replace(
            before,
            rows=np.concatenate([before.rows, rows]),
            bound=np.concatenate([before.bound, offset / norm]),
        )

    def solve(self) -> tuple[Array, float, float, float] | None:
        """(d, s, value of the dual, sum of multipliers), or None when it is infeasible. The dual value is computed from
        the multipliers themselves, so it is a bound even where the solver stopped early."""
        found = qp.solve(self.quadratic, PROGRAMME_TOLERANCE)
        if found is None:
            return None
        price = self.unit * float(np.sum(found.rows / self.norm) + np.abs(found.equal).max(initial=0.0))
        s = float(found.x[self.n]) if self.elastic else 0.0
        return found.x[: self.n], s, self.unit * _dual_value(self.quadratic, found), price


def _dual_value(p: Quadratic, found: Optimum) -> float:
    """Value of the dual at the solver's multipliers."""
    low, high = np.isfinite(p.low), np.isfinite(p.high)
    linear = p.cost + p.equal.T @ found.equal + p.rows.T @ found.rows + found.high * high - found.low * low
    value = (
        -found.equal @ p.target - found.rows @ p.bound + found.low[low] @ p.low[low] - found.high[high] @ p.high[high]
    )
    x = np.linalg.solve(p.hessian, -linear)
    return float(value + 0.5 * linear @ x)
