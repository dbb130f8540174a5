"""Solvers of the planning problem: the convex programme to global optimality, the rest by a sequence of such.

Only few of the thousands of contact constraints ever bind, and each is concave (a tube radius is a norm), so
they are not handed to the solver: it gets the tangents that the current point violates, until none is. Every
relaxed programme bounds the optimum from below, which gives the duality gap that is reported.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import piqp

from salver.errors import Status
from salver.geometry import GRAVITY_S, Array, exp, log
from salver.planning.conditions import TILT, Rows, unit_of
from salver.planning.problem import Linearisation, Problem

TOLERANCE = 1e-9  # N (or the row's own unit): a constraint counts as kept within this
_CUT_LIMIT = 60  # rounds of tangents
_PROGRESS = 1e-6  # the sequential method ends when a step promises less, relative to the cost
_SMALLEST_RADIUS = 1e-8  # of its trust region
_HIGHEST_PENALTY = 1e7  # price at which a violation that no step lowers is taken for infeasible
_PENALTY = 10.0  # first price of a unit of violation in the sequential method, in units of the starting cost


@dataclass(frozen=True)
class Solution:
    """A point z, what it costs, and how that was established.

    cost: integral (13). lower_bound: a proven bound on it, or None where nothing is proven.
    iterations: convex programmes solved. violation: how far the worst constraint on the grid is from kept.
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
        """Relative duality gap: |cost - lower bound| / cost. The bound has an error of some 1e-10 of its own."""
        if self.lower_bound is None:
            return None
        return _relative(self.cost, self.lower_bound)


@dataclass(frozen=True)
class _Step:
    """Answer of one convex subproblem.

    d: the step. lower_bound, violation: of the model. rounds: programmes solved. price: sum of the multipliers, what
    one unit of violation is worth.
    """

    d: Array
    lower_bound: float
    violation: float
    rounds: int
    price: float = 0.0


def solve(problem: Problem, start: Array | None = None) -> Solution:
    """Solve a planning problem by the method that its structure allows. Never raises for an infeasible one."""
    if problem.is_affine:
        return solve_convex(problem)
    solution = solve_sequential(problem, start)
    if solution.status.ok or not problem.rotates or start is not None:
        return solution
    tilting = solve_sequential(problem, _waiter(problem))
    return tilting if tilting.violation < solution.violation else solution


def solve_convex(problem: Problem) -> Solution:
    """Global optimum of the fixed-orientation problem, with the duality gap; or the least violation possible."""
    model = problem.linearise(np.zeros(problem.size))
    margin = problem.margin
    step = _solve_model(model, margin, 0.0, np.inf)
    method = "convex quadratic programme, PIQP with tangent cuts"
    if step is not None and step.violation <= TOLERANCE:
        cost = _cost(model, step.d)
        gap = _relative(cost, step.lower_bound)
        status = Status(
            "optimal",
            f"Optimal: no reference of this degree costs less (duality gap {gap:.1e}).",
            True,
            {"gap": gap},
        )
        return Solution(step.d, cost, step.lower_bound, step.violation, step.rounds, method, status)
    relaxed = _solve_model(model, margin, 0.0, np.inf, elastic=True)
    assert relaxed is not None
    z, rounds = relaxed.d, relaxed.rounds
    return Solution(z, _cost(model, z), None, relaxed.violation, rounds, method, infeasible(problem, model, z, True))


def solve_sequential(problem: Problem, start: Array | None = None, iteration_limit: int = 60) -> Solution:
    """Local optimum by Gauss-Newton steps inside a trust region, each a convex programme with the cuts above.

    Starts from the solution with fixed orientation when start and goal agree in it, else from z = 0, which turns
    about one axis. The cost's curvature beyond Gauss-Newton's is left to the trust region.
    """
    z = _initial(problem) if start is None else start
    margin = problem.margin
    model = problem.linearise(z)
    scale = max(_cost(model), 1e-12)
    radius, programmes, penalty, reason = 1.0, 0, _PENALTY * scale, "iteration_limit"
    for _ in range(iteration_limit):
        step = _solve_model(model, margin, 1e-9 * scale, radius)
        if step is None:
            step = _solve_model(model, margin, 1e-9 * scale, radius, elastic=True, penalty=10 * penalty)
        if step is None:
            radius *= 0.35
            if radius < _SMALLEST_RADIUS:
                break
            continue
        programmes += step.rounds
        penalty = max(penalty, 2 * step.price)
        merit = _merit(model, margin, penalty)
        predicted = merit - _model_merit(model, step, margin, penalty)
        if predicted <= _PROGRESS * _cost(model):
            if _violation(model, margin) > 1e-7 and penalty < _HIGHEST_PENALTY * scale:
                penalty *= 10
                continue
            reason = "optimal"
            break
        d, trial = step.d, problem.linearise(z + step.d)
        ratio = (merit - _merit(trial, margin, penalty)) / predicted
        if ratio < 0.5:  # the constraints bend: try again with what they turned out to be
            corrected = _correction(trial, margin, radius)
            if corrected is not None:
                programmes += 1
                again = problem.linearise(z + d + corrected)
                better = (merit - _merit(again, margin, penalty)) / predicted
                if better > ratio:
                    d, trial, ratio = d + corrected, again, better
        if ratio > 1e-3:
            z, model = z + d, trial
        radius = radius * 2.5 if ratio > 0.7 else radius * 0.35 if ratio < 0.2 else radius
        if radius < _SMALLEST_RADIUS:
            reason = "optimal"
            break
    z, model = _meet_goal(problem, z, model)
    violation = _violation(model, margin)
    if violation > 1e-7:
        status = infeasible(problem, model, None, False)
    else:
        words = {
            "optimal": "Locally optimal: a small change of the reference would save less than a millionth of the cost.",
            "iteration_limit": f"Stopped after {iteration_limit} iterations; the plan is safe but not quite optimal.",
        }
        status = Status(reason, words[reason], True)
    bound = _convex_bound(problem)
    return Solution(z, _cost(model), bound, violation, programmes, "sequential convex programming, PIQP", status)


def infeasible(problem: Problem, model: Linearisation, d: Array | None, proven: bool) -> Status:
    """Which constraint fails worst, when, and by how much: after the step d of the model, of least violation."""
    contact = problem.scenario.contact
    worst = min(model.rows, key=lambda rows: float(rows.slack(d)[0].min()))
    slack = worst.slack(d)[0]
    k, i = np.unravel_index(int(np.argmin(slack)), slack.shape)
    short, t, owner = problem.margin - float(slack[k, i]), float(problem.grid.t[k * problem.every]), worst.owner[i]
    what = "cone coefficient" if contact.condition == "paper" else "facet of the contact wrench cone"
    where = owner if owner == TILT else f"{owner} ({what} {i})"
    shown = "No reference of this degree and duration is safe" if proven else "No safe reference was found"
    missed = f"{short:.4g} {unit_of(problem.scenario, owner)}"
    sentence = (
        f"{shown}: the best one still misses the condition on {where} at t = {t:.3f} s by {missed}; "
        "a longer duration, more friction, a wider base or less uncertainty would help."
    )
    details = {"object": owner, "constraint": int(i), "time": t, "violation": short, "proven": proven}
    return Status("infeasible", sentence, False, details)


# The convex subproblem -----------------------------------------------------------------------------------


def _solve_model(
    model: Linearisation,
    margin: float,
    damping: float,
    radius: float,
    elastic: bool = False,
    penalty: float | None = None,
) -> _Step | None:
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
    if d is not None:
        bound = constant + float(gradient @ d + 0.5 * d @ hessian @ d)
    for rounds in range(1, _CUT_LIMIT + 1):
        if d is not None:
            new_offset, new_slope, violation = _violated(model.rows, d, margin, s)
            if len(new_offset) == 0:
                return _Step(d, bound, violation, rounds, price)
            if n == 0:  # the boundary conditions leave nothing free
                return _Step(d, bound, violation, rounds) if elastic else None
            offset, slope = np.concatenate([offset, new_offset]), np.concatenate([slope, new_slope])
        answer = _quadratic(hessian, gradient, model, offset, slope, radius, penalty if elastic else None)
        if answer is None:
            return None
        d, s, dual_value, price = answer
        bound = constant + dual_value
    assert d is not None
    return _Step(d, bound, violation, _CUT_LIMIT, price)


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
    norm = np.maximum(np.linalg.norm(slope, axis=1), 1e-12)
    rows[:, :n] = slope / norm[:, None]
    low, high = np.full(size, -radius), np.full(size, radius)
    if elastic:
        assert penalty is not None
        rows[:, n] = 1 / norm
        g[n], h[n, n] = penalty / unit, 1e-9 * penalty / unit
        low[n], high[n] = 0.0, np.inf
    goal_jacobian = np.hstack([model.goal_jacobian, np.zeros((len(model.goal), int(elastic)))])
    solver = piqp.DenseSolver()
    solver.settings.eps_abs = solver.settings.eps_rel = 1e-12
    solver.settings.eps_duality_gap_abs = solver.settings.eps_duality_gap_rel = 1e-12
    solver.settings.max_iter = 100
    solver.setup(
        np.asfortranarray(h),
        g,
        np.asfortranarray(goal_jacobian),
        -model.goal,
        np.asfortranarray(rows),
        -offset / norm,
        None,
        low if np.isfinite(radius) or elastic else None,
        high if np.isfinite(radius) or elastic else None,
    )
    status = solver.solve()
    result = solver.result
    if status in (piqp.PIQP_PRIMAL_INFEASIBLE, piqp.PIQP_NUMERICS) or not np.all(np.isfinite(result.x)):
        return None
    if status == piqp.PIQP_MAX_ITER_REACHED and result.info.primal_res > 1e-7:
        return None
    x = np.asarray(result.x)
    value = unit * _dual_value(h, g, goal_jacobian, -model.goal, rows, -offset / norm, low, high, result)
    price = unit * float(np.sum(np.maximum(result.z_l, 0.0) / norm) + np.abs(result.y).max(initial=0.0))
    return x[:n], float(x[n]) if elastic else 0.0, value, price


def _dual_value(
    h: Array, g: Array, a: Array, b: Array, rows: Array, low_rows: Array, low: Array, high: Array, result: object
) -> float:
    """Dual of min 1/2 x'Hx + g'x, Ax = b, rows x >= low_rows, low <= x <= high at the solver's multipliers."""
    z_l = np.maximum(np.asarray(result.z_l), 0.0)  # type: ignore[attr-defined]
    y = np.asarray(result.y)  # type: ignore[attr-defined]
    linear = g + a.T @ y - rows.T @ z_l
    value = float(z_l @ low_rows - y @ b)
    if np.all(np.isfinite(high[:-1])) and len(high) > 1:
        z_bl = np.maximum(np.asarray(result.z_bl), 0.0)  # type: ignore[attr-defined]
        z_bu = np.maximum(np.asarray(result.z_bu), 0.0)  # type: ignore[attr-defined]
        finite = np.isfinite(high)
        linear = linear - z_bl + np.where(finite, z_bu, 0.0)
        value += float(z_bl @ np.where(np.isfinite(low), low, 0.0) - z_bu[finite] @ high[finite])
    x = np.linalg.solve(h, -linear)
    return value + 0.5 * float(linear @ x)


# Pieces of the sequential method ---------------------------------------------------------------------------


def _cost(model: Linearisation, d: Array | None = None) -> float:
    residual = model.residual if d is None else model.residual + model.residual_jacobian @ d
    return float(residual @ residual)


def _violation(model: Linearisation, margin: float, d: Array | None = None) -> float:
    return max(0.0, *(margin - float(rows.slack(d)[0].min()) for rows in model.rows))


def _merit(model: Linearisation, margin: float, penalty: float) -> float:
    return _cost(model) + penalty * (_violation(model, margin) + float(np.abs(model.goal).sum()))


def _model_merit(model: Linearisation, step: _Step, margin: float, penalty: float) -> float:
    return _cost(model, step.d) + penalty * _violation(model, margin, step.d)


def _correction(trial: Linearisation, margin: float, radius: float) -> Array | None:
    """Shortest step, in the metric of the cost, from a trial point back to what its own constraints allow."""
    level = replace(trial, residual=np.zeros_like(trial.residual))
    metric = float(np.mean(np.sum(trial.residual_jacobian**2, axis=0)))
    step = _solve_model(level, margin, 1e-3 * metric, radius)
    return None if step is None else step.d


def _initial(problem: Problem) -> Array:
    """z of the fixed-orientation solution; z = 0 when the orientation has to change."""
    z = np.zeros(problem.size)
    fixed = replace(problem, scenario=problem.scenario.with_changes(motion__orientation="fixed"))
    if problem.rotates and fixed.is_affine:
        found = solve_convex(fixed).z
        z[: len(found)] = found
    return z


def _waiter(problem: Problem) -> Array:
    """z of the min-jerk line with the tray tilted as a waiter does: its normal along a - g, as far as z allows."""
    z = np.zeros(problem.size)
    # The straight line is a minimum-jerk problem: least squares on the jerk that z leaves free.
    residual, jacobian = problem.smoothness
    n_position = problem.n_position
    z[:n_position] = np.linalg.lstsq(jacobian[:, :n_position], -residual, rcond=None)[0]
    t = problem.grid.t
    line = problem.reference(z).sample(t)
    normal = line.a_S - GRAVITY_S
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    axis = np.cross([0.0, 0.0, 1.0], normal)
    sine = np.linalg.norm(axis, axis=1, keepdims=True)
    tilt = exp(np.arctan2(sine, normal[:, 2:]) * axis / np.maximum(sine, 1e-12))
    wanted = tilt @ line.R_SB
    steps = log(np.swapaxes(wanted[:-1], 1, 2) @ wanted[1:]) / (t[1] - t[0])
    omega = 0.5 * (np.vstack([steps[:1], steps]) + np.vstack([steps, steps[-1:]]))
    basis = problem.spin_basis
    z[n_position:] = np.linalg.lstsq(
        basis[:, :, n_position:].reshape(-1, problem.size - n_position), (omega - line.omega_B).ravel(), rcond=None
    )[0]
    return z


def _convex_bound(problem: Problem) -> float | None:
    """A proven lower bound: of the cost alone when that is convex, with all constraints dropped."""
    if problem.rotates:
        return None
    model = problem.linearise(np.zeros(problem.size))
    jacobian, residual = model.residual_jacobian, model.residual
    d: Array = np.linalg.lstsq(jacobian, -residual, rcond=None)[0].astype(float)
    return _cost(model, d)


def _meet_goal(problem: Problem, z: Array, model: Linearisation) -> tuple[Array, Linearisation]:
    """Newton steps of least norm until the goal orientation is met to rounding."""
    for _ in range(5):
        if np.abs(model.goal).max(initial=0.0) < 1e-13:
            break
        z = z - np.linalg.pinv(model.goal_jacobian) @ model.goal
        model = problem.linearise(z)
    return z, model


def _relative(cost: float, bound: float) -> float:
    return abs(cost - bound) / max(cost, 1e-300)
