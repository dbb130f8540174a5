"""The convex programme inside every solver: a quadratic cost, thousands of concave constraints, few of which bind.

They are not handed to the quadratic solver: it gets the tangents that the current point violates, until none is.
Every relaxed programme bounds the optimum from below, which gives the duality gap that is reported.
"""

from __future__ import annotations

from dataclasses import dataclass

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
    hessian, gradient, constant = 2 * jacobian.T @ jacobian, 2 * jacobian.T @ residual, float(residual @ residual)
    ridge = 2 * damping + 1e-14 * np.trace(hessian) / max(n, 1)
    hessian = hessian + ridge * np.eye(n)
    if elastic and penalty is None:
        unit = max(constant, 1e-12)
        hessian, gradient, penalty = 1e-6 * hessian / unit, 1e-6 * gradient / unit, 1.0
    offset, slope = np.zeros(0), np.zeros((0, n))
    d = _least(hessian, gradient, model.goal, model.goal_jacobian, radius)
    bound, violation, s, price = -np.inf, np.inf, 0.0, 0.0
    solved = False
    if d is not None:
        bound = constant + float(gradient @ d + 0.5 * d @ hessian @ d)
    for rounds in range(1, _CUT_LIMIT + 1):
        if d is not None:
            new_offset, new_slope, violation = _violated(model.rows, d, margin, s)
            if len(new_offset) == 0:
                return Step(d, bound, violation, rounds, price)
            if n == 0:  # the boundary conditions leave nothing free
                return Step(d, bound, violation, rounds) if elastic else None
            offset, slope = np.concatenate([offset, new_offset]), np.concatenate([slope, new_slope])
        answer = _quadratic(hessian, gradient, model, offset, slope, radius, penalty if elastic else None)
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
        slack, sides = item.slack(d)
        slack = slack - margin
        violation = max(violation, -float(slack.min()))
        before = np.vstack([np.full((1, slack.shape[1]), np.inf), slack[:-1]])
        after = np.vstack([slack[1:], np.full((1, slack.shape[1]), np.inf)])
        instant, row = np.nonzero((slack + s < -TOLERANCE) & (slack <= before) & (slack <= after))
        if len(instant):
            offset, slope = item.cuts(instant, row, sides[instant, row])
            offsets.append(offset - margin)
            slopes.append(slope)
    return np.concatenate(offsets), np.concatenate(slopes), violation


def _quadratic(
    hessian: Array,
    gradient: Array,
    model: Linearisation,
    offset: Array,
    slope: Array,
    radius: float,
    penalty: float | None,
) -> tuple[Array, float, float, float] | None:
    """One dense quadratic programme: (d, s, value of its dual, sum of multipliers), or None when it is infeasible.

    Scaled so that cost and rows are of order one, whatever their units. The dual value is computed from the
    multipliers themselves, so it is a bound even where the solver stopped early.
    """
    n, elastic = len(gradient), penalty is not None
    size = n + elastic
    unit = max(float(np.abs(gradient).max()), float(np.abs(hessian).max()), 1e-300)
    h, g = np.zeros((size, size)), np.zeros(size)
    h[:n, :n], g[:n] = hessian / unit, gradient / unit
    rows = np.zeros((len(offset), size))
    # What d cannot change keeps a row of order one when s can: its slope is rounding.
    norm = np.maximum(np.linalg.norm(slope, axis=1), 1.0 if elastic else 1e-12)
    rows[:, :n] = slope / norm[:, None]
    low, high = np.full(size, -radius), np.full(size, radius)
    if elastic:
        assert penalty is not None
        rows[:, n] = 1 / norm
        g[n], h[n, n] = penalty / unit, 1e-9 * penalty / unit
        low[n], high[n] = 0.0, np.inf
    goal_jacobian = np.hstack([model.goal_jacobian, np.zeros((len(model.goal), int(elastic)))])
    programme = Quadratic(h, g, -rows, offset / norm, goal_jacobian, -model.goal, low, high)
    found = qp.solve(programme, PROGRAMME_TOLERANCE)
    if found is None:
        return None
    price = unit * float(np.sum(found.rows / norm) + np.abs(found.equal).max(initial=0.0))
    return found.x[:n], float(found.x[n]) if elastic else 0.0, unit * _dual_value(programme, found), price


def _dual_value(p: Quadratic, found: Optimum) -> float:
    """Value of the dual at the solver's multipliers."""
    low, high = np.isfinite(p.low), np.isfinite(p.high)
    linear = p.cost + p.equal.T @ found.equal + p.rows.T @ found.rows + found.high * high - found.low * low
    value = (
        -found.equal @ p.target - found.rows @ p.bound + found.low[low] @ p.low[low] - found.high[high] @ p.high[high]
    )
    x = np.linalg.solve(p.hessian, -linear)
    return float(value + 0.5 * linear @ x)
