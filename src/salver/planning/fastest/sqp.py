"""Sequential quadratic programming on the coefficients of a motion and the scalar of its objective.

Each iteration linearises the rows near their edge, in the coefficients and in the scalar. The duration goes in as
sigma = T^2: multiplied by sigma, contact, torque and acceleration rows are exactly linear in it. A quadratic programme
with one shared slack (an exact penalty on the largest violation) and a proximal term gives the step; its metric is the
size of the change in posture and in acceleration, so smooth large changes are cheap and ripples are not. A second-order
correction (the same rows with their true values at the trial point; Fletcher 1982) keeps steps long: rows that were
left out as too far away, and the far side of kinks, come in with it.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from salver.errors import Status
from salver.geometry import Array
from salver.planning import qp
from salver.planning.fastest.constraints import Block, Constraint, evaluate, worst_of
from salver.planning.fastest.curves import Curve
from salver.planning.fastest.evaluation import Evaluation, Indices
from salver.planning.fastest.objectives import Objective, Point, Scalar
from salver.planning.fastest.trust import SHALLOWEST, Trust
from salver.planning.fastest.watch import Watch
from salver.sensitivity.wave_gradients import Unknowns

Mask = npt.NDArray[np.bool_]

# The metric of a step: a change of acceleration by 1 rad/s^2 counts like 0.055 rad of posture, of jerk by 1000
# rad/s^3 like 0.03 rad.
ACCELERATION_WEIGHT, JERK_WEIGHT = 3e-3, 1e-9
RIDGE = 1e-9  # of the coefficients, where the metric has none
SCALAR_RIDGE = 1e-6  # of scalar and slack, which have no metric
PROGRAMME_TOLERANCE = 1e-5  # of rows: a fiftieth of the violation at which an iterate counts as converged
LONGEST_STRETCH = 0.5  # of sigma, or of the margin, in one iteration: 22 % of T
LARGEST_MOVE = 1.0  # rad of a coefficient in one iteration
KEPT = -0.3  # a row that has joined stays in until it is further away than this
BENT = 2e-4  # violation of a trial, beyond the programme's own, that is worth a correction
STILL_NEAR = 3.0  # times the violation of a trial: rows that are further from their edge are not for its correction
POOR, GOOD = 0.8, 0.3  # shares of what was hoped for: below, a correction is tried; above, a step is taken as it is
LEAST_RATIO = 0.01  # of what was hoped for that a step must bring
FUTILE = 6  # iterations in turn of which none promises or reaches less violation, by ...
LESS = 0.05  # ... this share, than one before did: another start is better


@dataclass(frozen=True)
class Options:
    """iterations: when to stop; watch: may stop sooner. gain: relative improvement that counts as none.
    violation: largest violation of a margin-tightened row that counts as converged. penalty: first price of a unit of
    violation, in the unit of the objective. least_damping: of the proximal term. mending: to end with the first step
    that keeps all rows.
    """

    iterations: int = 60
    watch: Watch = field(default_factory=Watch)
    gain: float = 1e-4
    violation: float = 5e-4
    penalty: float = 20.0
    least_damping: float = 1e-5
    mending: bool = False


@dataclass(frozen=True)
class Iterate:
    """Where the programme stands, the motion there and its rows, margins included."""

    point: Point
    curve: Curve
    motion: Evaluation
    blocks: tuple[Block, ...]
    cost: float

    @property
    def coefficients(self) -> Array:
        return self.point.coefficients

    @property
    def duration(self) -> float:
        return self.point.duration

    @cached_property
    def unknowns(self) -> Unknowns:
        """What the coefficients and log T / 2 make of what the tray feels at the nodes."""
        motion, point = self.motion, self.point
        slope = motion.terms.w_z
        parts = np.zeros((slope.shape[0] * slope.shape[1], 4, motion.n))
        parts[:, :3] = slope.reshape(len(parts), 3, motion.n)
        at = np.repeat(motion.nodes, slope.shape[1])
        columns = self.curve.columns(point.coefficients, point.duration, parts, at)
        slower = self.curve.by_duration(point.coefficients, point.duration, motion.z)
        felt = np.column_stack([columns, 0.5 * np.einsum("rkn,krn->r", parts, slower[:, at])])
        return Unknowns(felt.reshape(*slope.shape[:2], -1), np.append(np.zeros(columns.shape[1]), 0.5))

    @cached_property
    def worst(self) -> tuple[float, str]:
        """Largest row, and the name of the block it belongs to."""
        return worst_of(self.blocks)

    @property
    def violation(self) -> float:
        return max(0.0, self.worst[0])

    def merit(self, penalty: float) -> float:
        return self.cost + penalty * self.violation


@dataclass(frozen=True)
class Linearised:
    """Rows A x <= b of x = (coefficients, scalar), and where they came from: (block, node, column)."""

    matrix: Array
    bound: Array
    where: tuple[tuple[int, Indices, Indices], ...] = ()

    def and_also(self, other: Linearised) -> Linearised:
        matrix, bound = np.vstack([self.matrix, other.matrix]), np.concatenate([self.bound, other.bound])
        return Linearised(matrix, bound, self.where + other.where)


@dataclass(frozen=True)
class Solution:
    """Last accepted iterate, how it ended, iterations and quadratic programmes used, wall time in s."""

    iterate: Iterate
    status: Status
    iterations: int
    programmes: int
    wall_time: float


@dataclass(frozen=True, eq=False)
class Programme:
    """A nonlinear programme: an objective over the motions of a curve, under constraints at the nodes of its grid."""

    curve: Curve
    constraints: Sequence[Constraint]
    objective: Objective

    def at(self, point: Point) -> Iterate:
        """All rows at a point."""
        grid = self.curve.grid
        z = self.curve.motion(point.coefficients, point.duration)
        motion = self.curve.problem.at(grid.s, z, point.duration, grid.nodes)
        blocks = self.objective.demanded(evaluate(self.constraints, motion), point.margin)
        return Iterate(point, self.curve, motion, blocks, self.objective.value(self.curve, point))

    def begin(self, coefficients: Array, duration: float) -> Iterate:
        """The iterate at coefficients (size, m) and a duration; the margin, if it is sought, is what there is."""
        first = self.at(Point(coefficients, duration))
        if self.objective.scalar is not Scalar.MARGIN:
            return first
        counted = [float(block.values.max()) for block in first.blocks if self.objective.counts(block)]
        return self.at(Point(coefficients, duration, -max(counted)))

    def moved(self, path: Iterate, step: Array) -> Iterate | None:
        """The iterate after a step (coefficients, scalar), put back on what it must satisfy exactly; None if that is
        impossible."""
        coefficients = self.curve.repaired(path.coefficients + step[:-1].reshape(path.coefficients.shape))
        if coefficients is None:
            return None
        duration, margin = path.duration, path.point.margin
        if self.objective.scalar is Scalar.DURATION:
            if step[-1] <= -1.0:
                return None
            duration *= float(np.sqrt(1 + step[-1]))
        elif self.objective.scalar is Scalar.MARGIN:
            margin += float(step[-1])
        return self.at(Point(coefficients, duration, margin))

    def derivatives(self, path: Iterate, block: Block, node: Indices, column: Indices) -> Array:
        """Rows (r, size m + 1) of a block by the coefficients and the scalar; with the duration free, of the rows that
        scale multiplied by sigma / sigma_0."""
        matrix = self._chained(path, block.gradient(node, column), block.points[node])
        if block.following is not None:
            matrix += self._chained(path, block.following(node, column), block.points[node + 1])
        if block.history is not None:
            near = np.flatnonzero(block.values[node, column] > -block.remembers)
            if len(near):
                matrix[near] += block.history(node[near], column[near], path.unknowns)
        if self.objective.scalar is Scalar.DURATION:
            if block.by_duration is not None:
                matrix[:, -1] += 0.5 * block.by_duration[node, column]
            if block.scales:
                matrix[:, -1] += block.values[node, column]
        else:
            matrix[:, -1] = float(self.objective.counts(block))
        return matrix

    def _chained(self, path: Iterate, rows: Array, point: Indices) -> Array:
        """Chain rule from z at points of the grid to the coefficients and, by log T, to sigma / sigma_0."""
        parts = rows.reshape(len(point), 4, -1)
        out = np.empty((len(point), path.coefficients.size + 1))
        out[:, :-1] = self.curve.columns(path.coefficients, path.duration, parts, point)
        slower = self.curve.by_duration(path.coefficients, path.duration, path.motion.z)
        out[:, -1] = 0.5 * np.einsum("rkn,krn->r", parts, slower[:, point])
        return out

    def linearised(self, path: Iterate, masks: Sequence[Mask]) -> Linearised:
        """The rows that the masks (N, m) of the blocks name."""
        size = path.coefficients.size + 1
        matrices, bounds, where = [np.zeros((0, size))], [np.zeros(0)], []
        for k, (block, mask) in enumerate(zip(path.blocks, masks, strict=True)):
            node, column = np.nonzero(mask)
            if len(node):
                matrices.append(self.derivatives(path, block, node, column))
                bounds.append(-block.values[node, column])
                where.append((k, node, column))
        return Linearised(np.vstack(matrices), np.concatenate(bounds), tuple(where))

    def corrected(self, rows: Linearised, trial: Iterate, step: Array) -> Linearised:
        """The rows with bounds that make the linear model exact at the trial point, which a step led to; without those
        that are far from their edge there, as a correction is small."""
        values, scales = [np.zeros(0)], [np.zeros(0)]
        free = self.objective.scalar is Scalar.DURATION
        for k, node, column in rows.where:
            block = trial.blocks[k]
            values.append(block.values[node, column])
            scales.append(np.full(len(node), 1 + step[-1] * (free and block.scales)))
        value = np.concatenate(scales) * np.concatenate(values)
        near = value > -max(SHALLOWEST, STILL_NEAR * trial.violation)
        return Linearised(rows.matrix[near], rows.matrix[near] @ step - value[near])

    def beyond_kinks(self, path: Iterate, trial: Iterate) -> Linearised:
        """Violated rows of a trial that have kinks, linearised there: beyond one the path's derivative is no help."""
        kinked = [(block.values > 0) & block.kinked for block in trial.blocks]
        found = self.linearised(trial, kinked)
        matrix, scalar = found.matrix.copy(), trial.point.margin - path.point.margin
        if self.objective.scalar is Scalar.DURATION:  # sigma is relative to each one's own
            ratio = (trial.duration / path.duration) ** 2
            scalar = ratio - 1
            matrix[:, -1] /= ratio
        moved = np.append((trial.coefficients - path.coefficients).ravel(), scalar)
        return Linearised(matrix, found.bound + matrix @ moved)

    @cached_property
    def metric(self) -> Array:
        """(3, size, size): squares of the change in posture, and for T = 1 in acceleration and jerk, of each curve."""
        basis = self.curve.grid.basis[[0, 2, 3]]
        return np.asarray(np.swapaxes(basis, 1, 2) @ basis / basis.shape[1])

    def subproblem(self, path: Iterate, trust: Trust) -> Subproblem:
        """The quadratic programme of an iteration, without its rows."""
        (size, m), count = path.coefficients.shape, path.coefficients.size
        model = self.objective.model(self.curve, path.point)
        weights = trust.damping * np.array([1.0, ACCELERATION_WEIGHT, JERK_WEIGHT])
        weights /= path.duration ** np.array([0.0, 4.0, 6.0])
        hessian = np.zeros((count + 2, count + 2))
        of_all = hessian[:count, :count].reshape(size, m, size, m)  # a view; the curves do not mix
        of_all[:, range(m), :, range(m)] = np.tensordot(weights, self.metric, axes=1)
        if model.curvature is not None:
            hessian[:count, :count] += model.curvature
        hessian[range(count + 2), range(count + 2)] += np.r_[np.full(count, RIDGE), SCALAR_RIDGE, SCALAR_RIDGE]
        cost = np.concatenate([model.slope, [model.by_scalar, trust.penalty]])
        low, high = np.full(count + 2, -LARGEST_MOVE), np.full(count + 2, LARGEST_MOVE)
        low[-2:], high[-2:] = (-trust.largest_shrink, 0.0), (LONGEST_STRETCH, np.inf)
        first, last = self.curve.fixed()
        scalar = [] if self.objective.scalar is Scalar.NONE else [count]
        free = np.r_[first : count - last, scalar, count + 1].astype(int)
        equal, target = self.curve.equalities(path.coefficients)
        extra, extra_bound = self.curve.inequalities(path.coefficients)
        return Subproblem(hessian, cost, low, high, free, equal, target, extra, extra_bound)


@dataclass(frozen=True, eq=False)
class Subproblem:
    """A quadratic programme over x = (coefficients, scalar, slack), of which only `free` are unknown.

    equal, target: A x = b for the coefficients. extra, extra_bound: A x <= b for them, without slack.
    """

    hessian: Array
    cost: Array
    low: Array
    high: Array
    free: Indices
    equal: Array
    target: Array
    extra: Array
    extra_bound: Array

    def solve(self, rows: Linearised) -> tuple[Array, float, float] | None:
        """The step (coefficients, scalar), the slack that is left, and the sum of the rows' multipliers: what a unit
        of violation is worth. None when the solver gives up."""
        free, count = self.free, len(rows.bound)
        known = free[free < self.extra.shape[1]]  # of the coefficients, which come first, and without a gap
        inner = slice(known[0], known[-1] + 1)
        matrix = np.zeros((count + len(self.extra), len(free)))
        matrix[:count, : len(known)] = rows.matrix[:, inner]
        matrix[:count, len(known) : -1] = rows.matrix[:, free[len(known) : -1]]
        matrix[:count, -1] = -1.0
        matrix[count:, : len(known)] = self.extra[:, inner]
        equal = np.zeros((len(self.target), len(free)))
        equal[:, : len(known)] = self.equal[:, inner]
        programme = qp.Quadratic(
            self.hessian[np.ix_(free, free)],
            self.cost[free],
            matrix,
            np.concatenate([rows.bound, self.extra_bound]),
            equal,
            self.target,
            self.low[free],
            self.high[free],
        )
        found = qp.solve(programme, PROGRAMME_TOLERANCE)
        if found is None:
            return None
        step = np.zeros(len(self.cost))
        step[free] = found.x
        return step[:-1], float(step[-1]), float(found.rows[: len(rows.bound)].sum())


@dataclass(frozen=True)
class Attempt:
    """What an iteration came to. trial: where it leads, None if nowhere. predicted: improvement of the merit that was
    hoped for, gained: that it brought, hoped: of the objective alone. slack: violation that was to be left. share: of
    the step that was taken. unseen: rows that were left out and came near. programmes: that were solved."""

    trial: Iterate | None
    predicted: float
    gained: float
    hoped: float
    slack: float
    share: float
    unseen: tuple[Mask, ...]
    programmes: int

    @property
    def ratio(self) -> float:
        return self.gained / max(self.predicted, 1e-12)


def minimise(programme: Programme, start: Iterate, options: Options, trust: Trust | None = None) -> Solution:
    """Local optimum from a start, which may violate conditions. trust: how far the first steps may go."""
    begun = time.perf_counter()
    trust = replace(trust or Trust(), penalty=options.penalty, least_damping=options.least_damping)
    path, forced = start, tuple(np.zeros(block.values.shape, dtype=bool) for block in start.blocks)
    idle = programmes = done = futile = 0
    least = lowest = np.inf
    code = "iteration_limit"
    while done < options.iterations:
        done += 1
        depth = np.broadcast_to(trust.depth, len(path.blocks))
        masks = [block.near(d) | more for block, d, more in zip(path.blocks, depth, forced, strict=True)]
        attempt = _attempt(programme, path, masks, trust)
        if attempt is None:
            programmes += 1
            trust.failed()
            if trust.hopeless:
                code = "stalled"
                break
            continue
        programmes += attempt.programmes
        # Far from every edge a programme promises too much: that what was reached gets less is progress as well.
        nearer = path.violation < (1 - LESS) * lowest
        futile = futile + 1 if attempt.slack > max(options.violation, (1 - LESS) * least) and not nearer else 0
        least, lowest = min(least, attempt.slack), min(lowest, path.violation)
        enough = options.gain * programme.objective.scale(path.point, path.cost)
        forced = tuple(mask | more for mask, more in zip(forced, attempt.unseen, strict=True))
        if attempt.trial is not None and attempt.ratio > LEAST_RATIO:
            before, path = path, attempt.trial
            forced = tuple(mask & (b.values > KEPT) for mask, b in zip(forced, path.blocks, strict=True))
            trust.accepted(attempt.ratio, attempt.share, _change(before, path))
            idle = idle + 1 if attempt.gained < enough else 0
            mended = options.mending
        else:
            trust.rejected()
            idle += attempt.predicted < enough
            mended = False
        if path.violation <= options.violation and (mended or attempt.hoped < 3 * enough):
            idle = 2
        if futile >= FUTILE:
            code = "stalled"
            break
        if idle >= 2 or trust.hopeless:
            if path.violation > options.violation and trust.dearer():
                idle = 0
                continue
            code = "optimal" if idle >= 2 else "stalled"
            break
        if options.watch.over():
            code = options.watch.ended
            break
    sought = programme.objective.sought
    return Solution(path, _status(code, path, options, sought), done, programmes, time.perf_counter() - begun)


def _attempt(programme: Programme, path: Iterate, masks: Sequence[Mask], trust: Trust) -> Attempt | None:
    """One iteration: the step of the quadratic programme, corrected where the rows bend; None without a step."""
    rows = programme.linearised(path, masks)
    subproblem = programme.subproblem(path, trust)
    solved = subproblem.solve(rows)
    if solved is None:
        return None
    step, slack, worth = solved
    trust.priced(slack, worth)
    hoped = path.cost - programme.objective.expected(programme.curve, path.point, path.cost, step)
    predicted = hoped + trust.penalty * (path.violation - slack)
    merit = path.merit(trust.penalty)
    unseen = tuple(np.zeros(block.values.shape, dtype=bool) for block in path.blocks)
    trial, share, programmes = programme.moved(path, step), 1.0, 1
    if (
        trial is not None
        and merit - trial.merit(trust.penalty) < POOR * predicted
        and trial.violation > max(BENT, 2 * slack)
    ):
        # Rows that were thought to be far away join, linearised where the others were.
        unseen = tuple(b.joining(m) for b, m in zip(trial.blocks, masks, strict=True))
        rows = rows.and_also(programme.linearised(path, unseen))
        bent = programme.corrected(rows, trial, step).and_also(programme.beyond_kinks(path, trial))
        second = subproblem.solve(bent)
        programmes = 2
        trial, share = _along_arc(programme, path, trial, step, second, slack, predicted, trust.penalty)
    gained = -np.inf if trial is None else merit - trial.merit(trust.penalty)
    return Attempt(trial, predicted, gained, hoped, slack, share, unseen, programmes)


def _along_arc(
    programme: Programme,
    path: Iterate,
    trial: Iterate,
    step: Array,
    second: tuple[Array, float, float] | None,
    slack: float,
    predicted: float,
    penalty: float,
) -> tuple[Iterate, float]:
    """The best of a step, of the corrected one, and of a point on the way x + a d + a^2 (d_c - d); and its share a.

    Along that arc the violation left at its end shrinks like a^3, along a straight line like a^2.
    """
    bend, power = np.zeros_like(step), 2
    corrected = None if second is None else programme.moved(path, second[0])
    if second is not None and corrected is not None and corrected.merit(penalty) < trial.merit(penalty):
        trial, bend, power = corrected, second[0] - step, 3
    if path.merit(penalty) - trial.merit(penalty) >= GOOD * predicted:
        return trial, 1.0
    left = max(trial.violation - max(path.violation, slack), 1e-12)
    best = (max(predicted, 0.0) / (power * penalty * left)) ** (1 / (power - 1))
    share = float(np.clip(best, 0.1, 0.8))
    third = programme.moved(path, share * step + share**2 * bend)
    if third is not None and third.merit(penalty) < trial.merit(penalty):
        return third, share
    return trial, 1.0


def _change(before: Iterate, after: Iterate) -> Array:
    """(B,) largest change of a row of each block that was not far from its edge."""
    pairs = zip(before.blocks, after.blocks, strict=True)
    return np.array([np.abs(b.values - a.values)[a.values > -min(1.0, a.reach)].max(initial=0.0) for a, b in pairs])


def _status(code: str, path: Iterate, options: Options, sought: str) -> Status:
    value, name = path.worst
    if value <= options.violation:
        return Status(code, f"At the nodes the {sought} motion takes {path.duration:.4f} s.", True)
    return Status(
        "infeasible",
        f"No motion was found that keeps all conditions: {name} is exceeded by {100 * value:.2g} % of its scale.",
        False,
        {"worst": name, "violation": value},
    )
