"""Solvers of the planning problem, eqs (13) to (17): convex problems to global optimality, others by a sequence of
convex programmes.

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
from salver.planning.qp import Optimum, Quadratic

TOLERANCE = 1e-9  # N (or the row's own unit): violation of a convex programme's constraint that is allowed


@dataclass(frozen=True)
class SequentialOptions:
    """Options of the sequential solver.

    iterations: at most. progress: relative improvement of the cost below which the search ends. radius: initial size of
    the trust region, in units of z. least_radius: size of the trust region at which the search ends. penalty: initial
    penalty on the violation, in units of the initial cost. highest_penalty: at which a violation that no step lowers
    means an infeasible problem.
    """

    iterations: int = 60
    progress: float = 1e-6
    radius: float = 1.0
    least_radius: float = 1e-8
    penalty: float = 10.0
    highest_penalty: float = 1e7


@dataclass(frozen=True)
class Solution:
    """A solution z with its cost and how it was found.

    cost: integral (13). lower_bound: a proven bound on it, or None without a proof. violation: of the worst constraint
    on the grid. iterations: number of convex programmes solved.
    """

    z: Array
    cost: float
    lower_bound: float | None
    violation: float
    iterations: int
    method: str
    status: Status

    @property
    def gap(self) -> float | None:
        """Relative duality gap: |cost - lower bound| / cost. The bound itself has an error of about 1e-10."""
        return None if self.lower_bound is None else _relative(self.cost, self.lower_bound)


def solve(problem: Problem, start: Array | None = None) -> Solution:
    """Solve a planning problem: as one convex programme if it is convex, else by a sequence of them.

    An infeasible problem is reported in the status, not by an exception.
    """
    return solve_convex(problem) if problem.is_affine else solve_sequential(problem, start)


def solve_convex(problem: Problem) -> Solution:
    """Global optimum of a convex problem, with the duality gap; or the solution with the least possible violation."""
    model, margin = problem.linearise(np.zeros(problem.size)), problem.margin
    method = "convex quadratic programme with tangent cuts"
    step = solve_model(model, margin)
    if step is not None and step.violation <= TOLERANCE:
        cost = _cost(model, step.d)
        gap = _relative(cost, step.lower_bound)
        sentence = f"Optimal: no reference of this degree costs less (duality gap {gap:.1e})."
        status = Status("optimal", sentence, True, {"gap": gap})
        return Solution(step.d, cost, step.lower_bound, step.violation, step.rounds, method, status)
    relaxed = solve_model(model, margin, penalty=np.inf)
    if relaxed is None:  # too badly scaled for the solver: the motion of z = 0, without a proof
        zero = np.zeros(problem.size)
        step = Step(zero, -np.inf, _violation(model, margin, zero), 0, 0.0)
    else:
        step = relaxed
    if step.violation <= TOLERANCE:  # only the programme of least cost failed
        status = Status("iteration_limit", "The plan is safe; whether it is optimal could not be shown.", True)
    else:
        status = infeasible(problem, model, step.d, relaxed is not None)
    return Solution(step.d, _cost(model, step.d), None, step.violation, step.rounds, method, status)


def solve_sequential(
    problem: Problem, start: Array | None = None, options: SequentialOptions = SequentialOptions()
) -> Solution:
    """Local optimum by Gauss-Newton steps inside a trust region, each a convex programme.

    The trust region makes up for the curvature that Gauss-Newton neglects. A step along which constraints are curved
    gets a second-order correction with their true values (Fletcher 1982).

    problem: what to solve. start: (n_z,) initial z; 0 unless given. options: of the search.
    """
    z, margin = np.zeros(problem.size) if start is None else start, problem.margin
    model = problem.linearise(z)
    scale = max(_cost(model), 1e-12)
    radius, penalty, programmes, ended = options.radius, options.penalty * scale, 0, "iteration_limit"
    for _ in range(options.iterations):
        step = solve_model(model, margin, 1e-9 * scale, radius)
        if step is None:
            step = solve_model(model, margin, 1e-9 * scale, radius, penalty=10 * penalty)
        if step is None:
            radius *= 0.35
            if radius < options.least_radius:
                break
            continue
        programmes += step.rounds
        penalty = max(penalty, 2 * step.price)
        merit = _merit(model, margin, penalty)
        predicted = merit - _merit(model, margin, penalty, step.d)
        if predicted <= options.progress * _cost(model):
            if _violation(model, margin) > MISSED and penalty < options.highest_penalty * scale:
                penalty *= 10
                continue
            ended = "optimal"
            break
        d, trial = step.d, problem.linearise(z + step.d)
        ratio = (merit - _merit(trial, margin, penalty)) / predicted
        if ratio < 0.5:
            correction = _correction(trial, margin, radius)
            if correction is not None:
                programmes += 1
                again = problem.linearise(z + d + correction)
                better = (merit - _merit(again, margin, penalty)) / predicted
                if better > ratio:
                    d, trial, ratio = d + correction, again, better
        if ratio > 1e-3:
            z, model = z + d, trial
        radius *= 2.5 if ratio > 0.7 else 0.35 if ratio < 0.2 else 1.0
        if radius < options.least_radius:
            ended = "optimal"
            break
    z, model = _met_goal(problem, z, model)
    violation = _violation(model, margin)
    if violation > MISSED:
        status = infeasible(problem, model, np.zeros(len(z)), False)
    else:
        sentence = "Locally optimal: a small change of the reference would save less than a millionth of the cost."
        if ended != "optimal":
            sentence = f"Stopped after {options.iterations} iterations; the plan is safe but not quite optimal."
        status = Status(ended, sentence, True)
    method = "sequential convex programming"
    return Solution(z, _cost(model), _convex_bound(problem), violation, programmes, method, status)


def infeasible(problem: Problem, model: Linearisation, d: Array, proven: bool) -> Status:
    """Status that names the most violated constraint after the step d of least violation, its instant and amount."""
    contact = problem.scenario.contact
    worst = min(model.rows, key=lambda rows: float(rows.slack(d).min()))
    slack = worst.slack(d)
    k, i = np.unravel_index(int(np.argmin(slack)), slack.shape)
    short, t, owner = problem.margin - float(slack[k, i]), float(problem.t[k]), worst.owner[i]
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


# Pieces of the sequential method ---------------------------------------------------------------------------


def _cost(model: Linearisation, d: Array | None = None) -> float:
    residual = model.residual if d is None else model.residual + model.residual_jacobian @ d
    return float(residual @ residual)


def _violation(model: Linearisation, margin: float, d: Array | None = None) -> float:
    return max(0.0, *(margin - float(rows.slack(d).min()) for rows in model.rows))


def _merit(model: Linearisation, margin: float, penalty: float, d: Array | None = None) -> float:
    """Merit function after a step of the model: cost with exact penalties on the largest violation and the goal."""
    goal = model.goal if d is None else model.goal + model.goal_jacobian @ d
    return _cost(model, d) + penalty * (_violation(model, margin, d) + float(np.abs(goal).sum()))


def _correction(trial: Linearisation, margin: float, radius: float) -> Array | None:
    """Shortest step, in the metric of the cost, from a trial point to one that satisfies its linearised constraints."""
    level = replace(trial, residual=np.zeros_like(trial.residual))
    metric = float(np.mean(np.sum(trial.residual_jacobian**2, axis=0)))
    step = solve_model(level, margin, 1e-3 * metric, radius)
    return None if step is None else step.d


def _met_goal(problem: Problem, z: Array, model: Linearisation) -> tuple[Array, Linearisation]:
    """z after least-norm Newton steps until the goal orientation is met to rounding, and the linearisation there."""
    for _ in range(5):
        if np.abs(model.goal).max(initial=0.0) < 1e-13:
            break
        z = z - np.linalg.pinv(model.goal_jacobian) @ model.goal
        model = problem.linearise(z)
    return z, model


def _convex_bound(problem: Problem) -> float | None:
    """A proven lower bound: the least cost without any constraints, if the cost is convex; else None."""
    if problem.rotates:
        return None
    model = problem.linearise(np.zeros(problem.size))
    d: Array = np.linalg.lstsq(model.residual_jacobian, -model.residual, rcond=None)[0].astype(float)
    return _cost(model, d)


def _relative(cost: float, bound: float) -> float:
    return abs(cost - bound) / max(cost, 1e-300)


# The convex programme ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Step:
    """Solution of one convex programme.

    d: the step. lower_bound, violation: of the model. rounds: quadratic programmes solved. price: sum of the
    multipliers, the change of the cost per unit of violation.
    """

    d: Array
    lower_bound: float
    violation: float
    rounds: int
    price: float


def solve_model(
    model: Linearisation,
    margin: float,
    damping: float = 0.0,
    radius: float = np.inf,
    penalty: float | None = None,
    most_rounds: int = 60,
) -> Step | None:
    """Minimise |r + J d|^2 + damping |d|^2 over |d_i| <= radius, goal met, all rows above the margin.

    penalty: on one common violation s >= 0 of all rows; None: the rows are hard constraints; infinite: only s is
    minimised (a tiny weight of the cost decides between equal solutions). most_rounds: of adding tangents. Returns None
    when the rows contradict each other.
    """
    n, elastic = model.residual_jacobian.shape[1], penalty is not None
    if n == 0:  # the boundary conditions leave nothing free
        none = Step(np.zeros(0), _cost(model), _violation(model, margin), 1, 0.0)
        return none if elastic or none.violation <= TOLERANCE else None
    jacobian, residual = model.residual_jacobian, model.residual
    hessian, gradient, constant = 2 * (jacobian.T @ jacobian), 2 * (jacobian.T @ residual), float(residual @ residual)
    hessian = hessian + (2 * damping + 1e-14 * np.trace(hessian) / n) * np.eye(n)
    if penalty == np.inf:
        unit = max(constant, 1e-12)
        hessian, gradient, penalty = 1e-6 * hessian / unit, 1e-6 * gradient / unit, 1.0
    programme, step = _Programme(hessian, gradient, model, radius, penalty), None
    for rounds in range(1, most_rounds + 1):
        answer = programme.solve()
        if answer is None:  # with a penalty: the latest tangents differ by rounding only, the last step is as good
            return step if elastic else None
        d, s, dual_value, price = answer
        offset, slope, violation = _violated(model.rows, d, margin, s)
        step = Step(d, constant + dual_value, violation, rounds, price)
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

    Cost and rows are scaled to order one, whatever their units. With a penalty the common violation s is one more
    unknown.
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
        """Add rows offset (m,) + slope (m, n) d >= 0."""
        # A row that d cannot change has a slope of rounding errors: with s it is scaled to order one all the same.
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
        """(d, s, dual value, sum of multipliers), or None when infeasible. The dual value is computed from the
        multipliers, so it is a bound even if the solver stopped early."""
        found = qp.solve(self.quadratic, 1e-12)  # of scaled rows: it limits the accuracy of the lower bound
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
