"""Solvers of the planning problem: the convex programme to global optimality, the rest by a sequence of such."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from salver.errors import Status
from salver.geometry import GRAVITY_S, Array, exp, log
from salver.planning.object.conditions import apart, unit_of
from salver.planning.object.problem import MISSED, Linearisation, Problem
from salver.planning.object.subproblem import TOLERANCE, Step, solve_model

_PROGRESS = 1e-6  # the sequential method ends when a step promises less, relative to the cost
_SMALLEST_RADIUS = 1e-8  # of its trust region
_HIGHEST_PENALTY = 1e7  # price at which a violation that no step lowers is taken for infeasible
_LINEAR = 1e-8  # of z, m and rad/s: after a step this small a linear model is right to rounding
_PENALTY = 10.0  # first price of a unit of violation in the sequential method, in units of the starting cost


@dataclass(frozen=True)
class Solution:
    """A point z with its cost and how it was found.

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


def solve(problem: Problem, start: Array | None = None) -> Solution:
    """Solve a planning problem: as a convex programme if it is one, else by a sequence of convex programmes.

    An infeasible problem is a status, not an exception.
    """
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
    step = solve_model(model, margin, 0.0, np.inf)
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
    relaxed = solve_model(model, margin, 0.0, np.inf, elastic=True)
    if relaxed is None:  # numbers too far apart for the programme: the motion that z = 0 stands for, without a proof
        z = np.zeros(problem.size)
        violation = _violation(model, margin)
        return Solution(z, _cost(model), None, violation, 0, method, infeasible(problem, model, None, False))
    z, rounds = relaxed.d, relaxed.rounds
    if relaxed.violation <= TOLERANCE:  # only the programme of least cost was too hard
        status = Status("iteration_limit", "The plan is safe; whether it is optimal could not be shown.", True)
        return Solution(z, _cost(model, z), None, relaxed.violation, rounds, method, status)
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
        step = solve_model(model, margin, 1e-9 * scale, radius)
        if step is None:
            step = solve_model(model, margin, 1e-9 * scale, radius, elastic=True, penalty=10 * penalty)
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
            if _violation(model, margin) > MISSED and penalty < _HIGHEST_PENALTY * scale:
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
    z, model, d = _meet_goal(problem, z, model)
    violation = _violation(model, margin, d)
    if violation > MISSED:
        status = infeasible(problem, model, d, False)
    else:
        words = {
            "optimal": "Locally optimal: a small change of the reference would save less than a millionth of the cost.",
            "iteration_limit": f"Stopped after {iteration_limit} iterations; the plan is safe but not quite optimal.",
        }
        status = Status(reason, words[reason], True)
    bound = _convex_bound(problem)
    method = "sequential convex programming, PIQP"
    return Solution(z + d, _cost(model, d), bound, violation, programmes, method, status)


def infeasible(problem: Problem, model: Linearisation, d: Array | None, proven: bool) -> Status:
    """The constraint that is violated most after the step d of least violation, with instant and amount."""
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


# Pieces of the sequential method ---------------------------------------------------------------------------


def _cost(model: Linearisation, d: Array | None = None) -> float:
    residual = model.residual if d is None else model.residual + model.residual_jacobian @ d
    return float(residual @ residual)


def _violation(model: Linearisation, margin: float, d: Array | None = None) -> float:
    return max(0.0, *(margin - float(rows.slack(d).min()) for rows in model.rows))


def _merit(model: Linearisation, margin: float, penalty: float) -> float:
    return _cost(model) + penalty * (_violation(model, margin) + float(np.abs(model.goal).sum()))


def _model_merit(model: Linearisation, step: Step, margin: float, penalty: float) -> float:
    return _cost(model, step.d) + penalty * _violation(model, margin, step.d)


def _correction(trial: Linearisation, margin: float, radius: float) -> Array | None:
    """Shortest step, in the metric of the cost, from a trial point back to what its own constraints allow."""
    level = replace(trial, residual=np.zeros_like(trial.residual))
    metric = float(np.mean(np.sum(trial.residual_jacobian**2, axis=0)))
    step = solve_model(level, margin, 1e-3 * metric, radius)
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


def _meet_goal(problem: Problem, z: Array, model: Linearisation) -> tuple[Array, Linearisation, Array]:
    """Newton steps of least norm until the goal orientation is met to rounding: z, the model there, and a step from
    there too small for another model."""
    goal, d = model.goal, np.zeros(len(z))
    for _ in range(5):
        if np.abs(goal).max(initial=0.0) < 1e-13:
            break
        d = d - np.linalg.pinv(model.goal_jacobian) @ goal
        if np.abs(d).max() < _LINEAR:
            goal = problem.goal_missed(z + d)
        else:
            z, d = z + d, np.zeros(len(z))
            model = problem.linearise(z)
            goal = model.goal
    return z, model, d


def _relative(cost: float, bound: float) -> float:
    return abs(cost - bound) / max(cost, 1e-300)
