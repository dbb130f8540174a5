"""Solver of the planning problem, eqs (13) to (17): a convex programme, with a proof; or a sequence of them.

A convex programme has a quadratic cost and thousands of concave constraints, few of which are active. Tangents of the
violated ones are added to a quadratic programme until none is violated. Each of these programmes has fewer constraints
and so bounds the optimum from below, which gives the duality gap that is reported.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from salver.errors import Status
from salver.geometry import Array
from salver.planning import qp
from salver.planning.object.conditions import Rows, apart, unit_of
from salver.planning.object.problem import MISSED, Linearisation, Problem
from salver.planning.qp import Quadratic

TOLERANCE = 1e-9  # N (or the row's own unit): violation of a convex programme's constraint that is allowed
PROGRAMME_TOLERANCE = 1e-12  # of the scaled rows: limits the accuracy of the lower bound
MOST_ROUNDS = 60  # of adding tangents
MOST_PROGRAMMES = 20  # of a problem that is not convex; after three or four of them z hardly changes
SAME = 1e-6  # relative change of z below which these have converged


@dataclass(frozen=True)
class Solution:
    """A solution z with its cost and how it was found.

    cost: integral (13). lower_bound: a proven bound on it, or None without a proof. violation: of the worst constraint
    on the grid. programmes: number of quadratic programmes solved.
    """

    z: Array
    cost: float
    lower_bound: float | None
    violation: float
    programmes: int
    method: str
    status: Status

    @property
    def gap(self) -> float | None:
        """Relative duality gap: |cost - lower bound| / cost. The bound itself has an error of about 1e-10."""
        return None if self.lower_bound is None else abs(self.cost - self.lower_bound) / max(self.cost, 1e-300)


def solve(problem: Problem) -> Solution:
    """Solve a planning problem: as one convex programme if it is convex, else by a sequence of them.

    An infeasible problem is reported in the status, not by an exception.
    """
    return _solve_convex(problem) if problem.is_affine else _solve_sequence(problem)


def _solve_convex(problem: Problem) -> Solution:
    """Global optimum of a convex problem, with the duality gap; or the solution with the least possible violation."""
    model, method = problem.linearise(np.zeros(problem.size)), "convex quadratic programme with tangent cuts"
    step = solve_model(model, problem.margin)
    if step is not None and step.violation <= TOLERANCE:
        cost, bound = _cost(model, step.d), step.lower_bound
        found = Solution(step.d, cost, bound, step.violation, step.rounds, method, Status("optimal", "", True))
        sentence = f"Optimal: no reference of this degree costs less (duality gap {found.gap:.1e})."
        return replace(found, status=Status("optimal", sentence, True, {"gap": found.gap}))
    relaxed = solve_model(model, problem.margin, relaxed=True)
    # Without an answer the programme is too badly scaled for the solver: the motion of z = 0, without a proof.
    d, rounds = (np.zeros(problem.size), 0) if relaxed is None else (relaxed.d, relaxed.rounds)
    violation = _violation(model, problem.margin, d)
    if violation <= TOLERANCE:  # only the programme of least cost failed
        status = Status("iteration_limit", "The plan is safe; whether it is optimal could not be shown.", True)
    else:
        status = infeasible(problem, model, relaxed is not None, d)
    return Solution(d, _cost(model, d), None, violation, rounds, method, status)


def _solve_sequence(problem: Problem) -> Solution:
    """Solution of a problem that is nearly convex: it is linearised again at the solution of each convex programme."""
    z, rounds, done = np.zeros(problem.size), 0, False
    model = problem.linearise(z)
    for _ in range(MOST_PROGRAMMES):
        step = solve_model(model, problem.margin) or solve_model(model, problem.margin, relaxed=True)
        if step is None:
            break
        z, rounds = z + step.d, rounds + step.rounds
        model = problem.linearise(z)
        if done := bool(np.abs(step.d).max(initial=0.0) <= SAME * np.abs(z).max(initial=1.0)):
            break
    violation = _violation(model, problem.margin)
    if violation > MISSED:
        status = infeasible(problem, model, False)
    elif done:
        status = Status("optimal", "Locally optimal: a further convex programme does not change the reference.", True)
    else:
        sentence = f"Stopped after {MOST_PROGRAMMES} convex programmes; the plan is safe but not quite optimal."
        status = Status("iteration_limit", sentence, True)
    return Solution(z, _cost(model), None, violation, rounds, "sequential convex programming", status)


def infeasible(problem: Problem, model: Linearisation, proven: bool, d: Array | None = None) -> Status:
    """Status that names the most violated constraint after a step d, its instant and amount."""
    contact = problem.scenario.contact
    worst = min(model.rows, key=lambda rows: float(rows.slack(d).min()))
    slack = worst.slack(d)
    k, i = np.unravel_index(int(np.argmin(slack)), slack.shape)
    short, t, owner = problem.margin - float(slack[k, i]), float(problem.grid.t[k]), worst.owner[i]
    what = "cone coefficient" if contact.condition == "paper" else "facet of the contact wrench cone"
    where = owner if apart(owner) else f"{owner} ({what} {i})"
    shown = "No reference of this degree and duration is safe" if proven else "No safe reference was found"
    unit = unit_of(problem.scenario, owner)
    if short <= problem.margin:
        kept = f"{problem.margin - short:.4g} of the {problem.margin:.4g} {unit} of contact.margin over its tube"
        sentence = (
            f"{shown}: the best one keeps only {kept}, on {where} at t = {t:.3f} s; "
            "a smaller contact.margin would help."
        )
    else:
        sentence = (
            f"{shown}: the best one still misses the condition on {where} at t = {t:.3f} s by {short:.4g} {unit}; "
            "a longer duration, more friction, a wider base or less uncertainty would help."
        )
    details = {"object": owner, "constraint": int(i), "time": t, "violation": short, "proven": proven}
    return Status("infeasible", sentence, False, details)


def _cost(model: Linearisation, d: Array | None = None) -> float:
    residual = model.residual if d is None else model.residual + model.residual_jacobian @ d
    return float(residual @ residual)


def _violation(model: Linearisation, margin: float, d: Array | None = None) -> float:
    return max(0.0, *(margin - float(rows.slack(d).min()) for rows in model.rows))


# The convex programme ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Step:
    """Solution of one convex programme.

    d: the step. lower_bound, violation: of the model. rounds: quadratic programmes solved.
    """

    d: Array
    lower_bound: float
    violation: float
    rounds: int


def solve_model(model: Linearisation, margin: float, relaxed: bool = False) -> Step | None:
    """Minimise |r + J d|^2 with all rows above the margin.

    relaxed: the largest violation s >= 0 of all rows is minimised instead (a tiny weight of the cost decides between
    equal solutions). Returns None when the rows contradict each other.
    """
    n = model.residual_jacobian.shape[1]
    if n == 0:  # the boundary conditions leave nothing free
        none = Step(np.zeros(0), _cost(model), _violation(model, margin), 1)
        return none if relaxed or none.violation <= TOLERANCE else None
    jacobian, residual = model.residual_jacobian, model.residual
    hessian, gradient, constant = 2 * (jacobian.T @ jacobian), 2 * (jacobian.T @ residual), float(residual @ residual)
    hessian = hessian + 1e-14 * np.trace(hessian) / n * np.eye(n)
    if relaxed:
        weight = 1e-6 / max(constant, 1e-12)
        hessian, gradient = weight * hessian, weight * gradient
    programme, step = _Programme(hessian, gradient, relaxed), None
    for rounds in range(1, MOST_ROUNDS + 1):
        answer = programme.solve()
        if answer is None:  # relaxed, the latest tangents differ by rounding only: the last step is as good
            return step if relaxed else None
        d, s, dual_value = answer
        offset, slope, violation = _violated(model.rows, d, margin, s)
        step = Step(d, constant + dual_value, violation, rounds)
        if len(offset) == 0:
            break
        programme.add(offset, slope)
    return step


def _violated(rows: tuple[Rows, ...], d: Array, margin: float, s: float) -> tuple[Array, Array, float]:
    """Tangents at d of the violated slacks: of each row at its local minima over time."""
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
    """The dense quadratic programme of a subproblem, to which each round adds rows.

    Cost and rows are scaled to order one, whatever their units. Relaxed, the common violation s is one more unknown.
    """

    def __init__(self, hessian: Array, gradient: Array, relaxed: bool) -> None:
        self.n, self.relaxed = len(gradient), relaxed
        n, size = self.n, self.n + relaxed
        self.unit = max(float(np.abs(gradient).max(initial=0.0)), float(np.abs(hessian).max(initial=0.0)), 1e-300)
        h, g = np.zeros((size, size)), np.zeros(size)
        h[:n, :n], g[:n] = hessian / self.unit, gradient / self.unit
        low, high, none = np.full(size, -np.inf), np.full(size, np.inf), np.zeros((0, size))
        if relaxed:
            g[n], h[n, n], low[n] = 1.0 / self.unit, 1e-9 / self.unit, 0.0
        self.quadratic = Quadratic(h, g, none, np.zeros(0), none, np.zeros(0), low, high)

    def add(self, offset: Array, slope: Array) -> None:
        """Add rows offset (m,) + slope (m, n) d >= 0."""
        # A row that d cannot change has a slope of rounding errors: with s it is scaled to order one all the same.
        norm = np.maximum(np.linalg.norm(slope, axis=1), 1.0 if self.relaxed else 1e-12)
        rows, before = np.full((len(slope), self.n + self.relaxed), -1.0), self.quadratic
        rows[:, : self.n] = -slope
        rows, bound = np.concatenate([before.rows, rows / norm[:, None]]), np.append(before.bound, offset / norm)
        self.quadratic = replace(before, rows=rows, bound=bound)

    def solve(self) -> tuple[Array, float, float] | None:
        """(d, s, dual value), or None when infeasible. The dual value is computed from the multipliers, so it is a
        bound even if the solver stopped early."""
        programme = self.quadratic
        found = qp.solve(programme, PROGRAMME_TOLERANCE)
        if found is None:
            return None
        s = float(found.x[self.n]) if self.relaxed else 0.0
        linear = programme.cost + programme.rows.T @ found.rows
        least = -0.5 * linear @ np.linalg.solve(programme.hessian, linear)
        return found.x[: self.n], s, self.unit * float(least - found.rows @ programme.bound)
