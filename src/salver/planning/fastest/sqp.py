"""Shortest duration by sequential quadratic programming on spline coefficients and T^2.

Each iteration linearises the rows near their edge, in the coefficients and in sigma = T^2: multiplied by sigma,
contact, torque and acceleration rows are exactly linear in sigma. A quadratic programme with one shared slack
(an exact penalty on the largest violation) and a proximal term gives the step; its metric is the size of the
change in posture and in acceleration, so smooth large changes are cheap and ripples are not. A second-order
correction (the same rows with their true values at the trial point; Fletcher 1982) keeps steps long: rows that were
left out as too far away, and the far side of kinks, come in with it.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import piqp
from scipy.sparse import csc_matrix

from salver.errors import Status
from salver.geometry import Array
from salver.planning.fastest.curves import Curve
from salver.planning.fastest.rows import Evaluated, Family, Indices, Margins, evaluate

Mask = npt.NDArray[np.bool_]

# The metric of a step: a change of acceleration by 1 rad/s^2 counts like 0.055 rad of posture, of jerk by 1000
# rad/s^3 like 0.2 rad.
ACCELERATION_WEIGHT, JERK_WEIGHT = 3e-3, 1e-9
LEAST_PENALTY = 1.0  # s per unit of violation
DEEPEST = 0.2  # rows further than this from their edge are left out of a programme
UNSEEN = -0.02  # a row left out of a programme is put in when its step brings it nearer than this to its edge
MOST_ROWS = 4  # facets of one contact wrench cone at one node: a fine cone has hundreds, nearly parallel
LONGEST_SHRINK, LONGEST_STRETCH = -0.36, 0.5  # of sigma in one iteration: 20 % and 22 % of T


@dataclass(frozen=True)
class Options:
    """iterations, time_limit (s): when to stop. gain: relative shortening below which an iteration counts as idle.
    violation: largest violation of a margin-tightened row that counts as converged. penalty: s per unit of violation.
    least_damping: of the proximal term.
    """

    iterations: int = 60
    time_limit: float = 20.0
    gain: float = 1e-4
    violation: float = 5e-4
    penalty: float = 20.0
    least_damping: float = 1e-5


@dataclass(frozen=True)
class Iterate:
    """Coefficients (size, m) and the rows of the motion they make."""

    coefficients: Array
    at: Evaluated

    @property
    def duration(self) -> float:
        return self.at.duration

    def merit(self, penalty: float) -> float:
        return self.duration + penalty * self.at.violation


@dataclass(frozen=True)
class Solution:
    """Last accepted iterate, how it ended, iterations and quadratic programmes used, wall time in s."""

    iterate: Iterate
    status: Status
    iterations: int
    programmes: int
    wall_time: float
    damping: float


@dataclass(frozen=True)
class Linearised:
    """Rows A x <= b of x = (coefficients, sigma / sigma_0 - 1), and where they came from: (family, node, column)."""

    matrix: Array
    bound: Array
    where: list[tuple[int, Indices, Indices]]

    def with_more(self, other: Linearised) -> Linearised:
        matrix, bound = np.vstack([self.matrix, other.matrix]), np.concatenate([self.bound, other.bound])
        return Linearised(matrix, bound, self.where + other.where)


def minimise_duration(
    curve: Curve,
    coefficients: Array,
    duration: float,
    margins: Margins,
    options: Options,
    damping: float = 1.0,
    depth: float = DEEPEST,
) -> Solution:
    """Local optimum from a start, which may violate conditions. Coefficients (size, m), duration in s.

    damping: weight of the proximal term in the first iteration; small for a start near the optimum.
    depth: rows further than this from their edge are left out of the first programme.
    """
    begun = time.perf_counter()
    path = _iterate(curve, coefficients, duration, margins)
    grams = [basis.T @ basis / len(curve.grid.s) for basis in curve.grid.basis]
    penalty, shrink = options.penalty, LONGEST_SHRINK
    forced: list[Mask] = [np.zeros(f.values.shape, dtype=bool) for f in path.at.families]
    idle = programmes = done = 0
    code = "iteration_limit"
    while done < options.iterations:
        done += 1
        masks = [near | more for near, more in zip(_near(path.at, depth), forced, strict=True)]
        rows = _linearise(curve, path, masks)
        metric = (
            grams[0] + ACCELERATION_WEIGHT * grams[2] / path.duration**4 + JERK_WEIGHT * grams[3] / path.duration**6
        )
        programme = _Programme(curve, path, rows.matrix, metric, damping, penalty, shrink)
        step = programme.solve(rows.bound)
        programmes += 1
        if step is None:
            damping, shrink = damping * 10, shrink * 0.5
            if damping > 1e6:
                code = "stalled"
                break
            continue
        # Just above what the violation is worth (the sum of multipliers), so that steps are not judged by it alone.
        if step[-1] > 1e-6:
            penalty *= 3
        elif penalty > 3 * programme.worth:
            penalty = max(2 * programme.worth, 0.3 * penalty, LEAST_PENALTY)
        hoped = path.duration * (1 - float(np.sqrt(1 + step[-2])))
        predicted = hoped + penalty * (path.at.violation - step[-1])
        trial, share = _move(curve, path, step, margins), 1.0
        poor = trial is None or path.merit(penalty) - trial.merit(penalty) < 0.8 * predicted
        if trial is not None and poor and trial.at.violation > max(2e-4, 2 * step[-1]):
            # Rows that were thought to be far away join, linearised where the others were.
            unseen = [(f.values > UNSEEN) & ~mask for f, mask in zip(trial.at.families, masks, strict=True)]
            forced = [mask | more for mask, more in zip(forced, unseen, strict=True)]
            rows = rows.with_more(_linearise(curve, path, unseen))
            kinked = _beyond_kinks(curve, path, trial)
            if len(kinked.bound) or any(mask.any() for mask in unseen):
                matrix = np.vstack([rows.matrix, kinked.matrix])
                programme = _Programme(curve, path, matrix, metric, damping, penalty, shrink)
            corrected = programme.solve(np.concatenate([_corrected(rows, trial, step), kinked.bound]))
            programmes += 1
            trial, share = _along_arc(curve, path, trial, step, corrected, margins, penalty, predicted)
        gained = -np.inf if trial is None else path.merit(penalty) - trial.merit(penalty)
        ratio = gained / max(predicted, 1e-12)
        if trial is not None and ratio > 0.01:
            change = max(
                float(np.abs(new.values - old.values)[old.values > -1].max(initial=0.0))
                for new, old in zip(trial.at.families, path.at.families, strict=True)
            )
            depth = float(np.clip(2 * change, 0.02, DEEPEST))
            forced = [(mask & (f.values > -0.3)) for mask, f in zip(forced, trial.at.families, strict=True)]
            idle = idle + 1 if gained < options.gain * path.duration else 0
            path = trial
            if hoped < 3 * options.gain * path.duration and path.at.violation <= options.violation:
                idle = 2
            if share < 1.0:
                damping *= min(1 / share, 4.0)
            else:
                damping *= 0.33 if ratio > 0.9 else 0.5 if ratio > 0.6 else 2.0 if ratio < 0.3 else 1.0
            damping = max(damping, options.least_damping)
            shrink = max(1.5 * shrink, LONGEST_SHRINK) if ratio > 0.3 else shrink
        else:
            damping, shrink = damping * 4, 0.5 * max(shrink, -0.5)
            if predicted < options.gain * path.duration:
                idle += 1
        if idle >= 2 or damping > 1e7:
            if path.at.violation > options.violation and penalty < 1e4 and damping <= 1e7:
                penalty, idle, damping = 10 * penalty, 0, 1.0
                continue
            code = "optimal" if idle >= 2 else "stalled"
            break
        if time.perf_counter() - begun > options.time_limit:
            code = "time_limit"
            break
    return Solution(path, _status(code, path, options), done, programmes, time.perf_counter() - begun, damping)


def _along_arc(
    curve: Curve,
    path: Iterate,
    trial: Iterate,
    step: Array,
    corrected: Array | None,
    margins: Margins,
    penalty: float,
    predicted: float,
) -> tuple[Iterate, float]:
    """The best of a step, of the corrected one, and of a point on the way x + a d + a^2 (d_c - d); and its share a.

    Along that arc the violation left at its end shrinks like a^3, along a straight line like a^2.
    """
    bend, power = np.zeros_like(step), 2
    second = None if corrected is None else _move(curve, path, corrected, margins)
    if corrected is not None and second is not None and second.merit(penalty) < trial.merit(penalty):
        trial, bend, power = second, corrected - step, 3
    if path.merit(penalty) - trial.merit(penalty) >= 0.3 * predicted:
        return trial, 1.0
    left = max(trial.at.violation - max(path.at.violation, step[-1]), 1e-12)
    best = (max(predicted, 0.0) / (power * penalty * left)) ** (1 / (power - 1))
    share = float(np.clip(best, 0.1, 0.8))
    third = _move(curve, path, share * step + share**2 * bend, margins)
    if third is not None and third.merit(penalty) < trial.merit(penalty):
        return third, share
    return trial, 1.0


def _status(code: str, path: Iterate, options: Options) -> Status:
    value, name = path.at.worst
    if value <= options.violation:
        return Status(code, f"The shortest duration at the nodes is {path.duration:.4f} s.", True)
    return Status(
        "infeasible",
        f"No motion was found that keeps all conditions: {name} is exceeded by {100 * value:.2g} % of its scale.",
        False,
        {"worst": name, "violation": value},
    )


def _near(at: Evaluated, depth: float) -> list[Mask]:
    """Rows no further from their edge than `depth`, for each family."""
    masks = []
    for family in at.families:
        floor = -np.inf if family.name == "tilt" and family.values.shape[1] == 4 else -depth
        near = family.values > max(floor, -family.reach)
        if family.values.shape[1] > MOST_ROWS and family.name.startswith("contact"):
            near &= family.values >= -np.partition(-family.values, MOST_ROWS, axis=1)[:, MOST_ROWS - 1 : MOST_ROWS]
        masks.append(near)
    return masks


def _linearise(curve: Curve, path: Iterate, masks: list[Mask]) -> Linearised:
    matrices, bounds, where = [], [], []
    for k, family in enumerate(path.at.families):
        node, column = np.nonzero(masks[k])
        if len(node):
            matrices.append(_derivatives(curve, path, family, node, column))
            bounds.append(-family.values[node, column])
            where.append((k, node, column))
    size = path.coefficients.size + 1
    if not matrices:
        return Linearised(np.zeros((0, size)), np.zeros(0), [])
    return Linearised(np.vstack(matrices), np.concatenate(bounds), where)


def _derivatives(curve: Curve, path: Iterate, family: Family, node: Indices, column: Indices) -> Array:
    """Rows (r, size m + 1) of a family, with respect to the coefficients and sigma / sigma_0."""
    matrix = _at_point(curve, path, family.gradient(node, column), family.points[node])
    if family.following is not None:
        matrix += _at_point(curve, path, family.following(node, column), family.points[node + 1])
        # The time step between the nodes shrinks too.
        matrix[:, -1] -= 0.5 * (family.values[node, column] + family.edge)
    if family.scales:
        matrix[:, -1] += family.values[node, column]
    return matrix


def _at_point(curve: Curve, path: Iterate, rows: Array, point: Indices) -> Array:
    """Chain rule from z at a point of the grid to the coefficients and sigma / sigma_0."""
    z = path.at.z
    parts = rows.reshape(len(point), 4, z.shape[2])
    out = np.empty((len(point), path.coefficients.size + 1))
    out[:, :-1] = curve.columns(path.coefficients, path.duration, parts, point)
    moved = np.einsum("rkn,krn->rk", parts[:, 1:], z[1:, point])
    out[:, -1] = -moved @ np.array([0.5, 1.0, 1.5])
    return out


def _corrected(rows: Linearised, trial: Iterate, step: Array) -> Array:
    """Bounds that make the linear model exact at the trial point."""
    values = np.concatenate([trial.at.families[k].values[i, f] for k, i, f in rows.where])
    scales = np.concatenate([np.full(len(i), 1 + step[-2] * trial.at.families[k].scales) for k, i, _ in rows.where])
    return rows.matrix @ step[:-1] - scales * values


def _beyond_kinks(curve: Curve, path: Iterate, trial: Iterate) -> Linearised:
    """Violated rows of a trial that have kinks, linearised there: beyond a kink the path's derivative is no help."""
    size = path.coefficients.size
    matrices, bounds = [np.zeros((0, size + 1))], [np.zeros(0)]
    moved = (trial.coefficients - path.coefficients).ravel()
    for family in trial.at.families:
        if family.kinked:
            node, column = np.nonzero(family.values > 0)
            if not len(node):
                continue
            matrices.append(_derivatives(curve, trial, family, node, column))
            bounds.append(matrices[-1][:, :-1] @ moved - family.values[node, column])
    return Linearised(np.vstack(matrices), np.concatenate(bounds), [])


def _iterate(curve: Curve, coefficients: Array, duration: float, margins: Margins) -> Iterate:
    z = curve.motion(coefficients, duration)
    return Iterate(coefficients, evaluate(curve.problem, curve.grid.s, z, duration, margins, curve.grid.nodes))


def _move(curve: Curve, path: Iterate, step: Array, margins: Margins) -> Iterate | None:
    """The iterate after a step, put back on what it must satisfy exactly; None if that is impossible."""
    coefficients = curve.repaired(path.coefficients + step[:-2].reshape(path.coefficients.shape))
    if coefficients is None:
        return None
    return _iterate(curve, coefficients, path.duration * float(np.sqrt(1 + step[-2])), margins)


class _Programme:
    """The quadratic programme of one iteration, solved for several right-hand sides.

    x = (coefficients, sigma / sigma_0 - 1, slack); what is given of the coefficients is left out.
    """

    def __init__(
        self,
        curve: Curve,
        path: Iterate,
        rows: Array,
        metric: Array,
        damping: float,
        penalty: float,
        shrink: float,
    ) -> None:
        size, m = path.coefficients.shape
        count = size * m + 2
        hessian = np.zeros((count, count))
        hessian[:-2, :-2] = damping * np.kron(metric, np.eye(m))
        hessian[range(count - 2), range(count - 2)] += 1e-9
        hessian[-2:, -2:] = 1e-6 * np.eye(2)
        cost = np.zeros(count)
        cost[-2:] = 0.5 * path.duration, penalty
        equal, target = curve.equalities(path.coefficients)
        extra, self.extra_bound = curve.inequalities(path.coefficients)
        low, high = np.full(count, -1.0), np.full(count, 1.0)
        low[-2:], high[-2:] = (shrink, 0.0), (LONGEST_STRETCH, 1e3)
        first, last = curve.fixed()
        self.free = np.r_[first : size * m - last, count - 2, count - 1]
        self.count = count
        matrix = np.vstack(
            [
                np.hstack([rows, -np.ones((len(rows), 1))]),
                np.hstack([extra, np.zeros((len(extra), 2))]),
            ]
        )
        self.data = (
            csc_matrix(hessian[np.ix_(self.free, self.free)]),
            cost[self.free],
            csc_matrix(np.hstack([equal, np.zeros((len(equal), 2))])[:, self.free]),
            target,
            csc_matrix(matrix[:, self.free]),
        )
        self.box = low[self.free], high[self.free]
        self.worth = 0.0

    def solve(self, bound: Array) -> Array | None:
        """Minimiser (size m + 2,), or None when the solver gives up."""
        solver = piqp.SparseSolver()
        settings = solver.settings
        settings.eps_abs = settings.eps_rel = 1e-5
        settings.eps_duality_gap_abs = settings.eps_duality_gap_rel = 1e-5
        settings.max_iter = 80
        settings.kkt_solver = piqp.sparse_multistage
        # The rows are scaled already; equilibration and the default step length cost iterations here.
        settings.preconditioner_iter = 0
        settings.tau = 0.95
        hessian, cost, equal, target, matrix = self.data
        every = np.concatenate([bound, self.extra_bound])
        conditions = (matrix, np.full(len(every), -1e30), every) if len(every) else (None, None, None)
        ends = (equal, target) if len(target) else (None, None)
        solver.setup(hessian, cost, *ends, *conditions, *self.box)
        status = solver.solve()
        if status != piqp.PIQP_SOLVED and not (
            status == piqp.PIQP_MAX_ITER_REACHED and solver.result.info.primal_res < 1e-4
        ):
            return None
        self.worth = float(solver.result.z_u[: len(bound)].sum())
        step = np.zeros(self.count)
        step[self.free] = solver.result.x
        return step
