"""A nonlinear programme over the coefficients of a motion and the scalar of its objective, its iterates, and their
quadratic subproblems.

Rows near their limit are linearised in the coefficients and in the scalar. The duration enters as sigma = T^2:
multiplied by sigma, contact, torque and acceleration rows are exactly linear in it. A quadratic programme with one
shared slack (an exact penalty on the largest violation) and a proximal term gives the step. Its metric measures the
change in posture and acceleration, so large smooth changes cost little and ripples cost much.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from salver.dynamics.motion_gradients import Unknowns
from salver.geometry import Array, Indices, Mask
from salver.planning import qp
from salver.planning.trajopt.constraints.constraints import Block, Constraint, evaluate, worst_of
from salver.planning.trajopt.curves import Curve
from salver.planning.trajopt.evaluation import MotionEvaluation
from salver.planning.trajopt.objectives import Objective, Point, Scalar
from salver.planning.trajopt.trust import Trust


@dataclass(frozen=True)
class Iterate:
    """An iterate of the programme: the motion at a point, and its constraint rows with their margins."""

    point: Point
    curve: Curve
    motion: MotionEvaluation
    blocks: tuple[Block, ...]
    cost: float
    _unknowns: dict[float, Unknowns] = field(default_factory=dict, repr=False)

    @property
    def coefficients(self) -> Array:
        return self.point.coefficients

    @property
    def duration(self) -> float:
        return self.point.duration

    def unknowns(self, factor: float = 1.0) -> Unknowns:
        """Derivatives of the tray's motion regressor at the nodes, at a speed factor, by the coefficients and
        log T / 2."""
        if factor not in self._unknowns:
            motion, point = self.motion, self.point
            slope = motion.terms.w_z if factor == 1.0 else motion.terms.w_z_at(factor**2, 0.0)
            parts = np.zeros((slope.shape[0] * slope.shape[1], 4, motion.n))
            parts[:, :3] = slope.reshape(len(parts), 3, motion.n)
            at = np.repeat(motion.nodes, slope.shape[1])
            columns = self.curve.columns(point.coefficients, point.duration, parts, at)
            felt = np.column_stack([columns, 0.5 * np.einsum("rkn,krn->r", parts, self.slower[:, at])])
            stretch = np.append(np.zeros(columns.shape[1]), 0.5)
            self._unknowns[factor] = Unknowns(felt.reshape(*slope.shape[:2], -1), stretch)
        return self._unknowns[factor]

    @cached_property
    def slower(self) -> Array:
        """Derivative (4, P, n) of the motion by log T with fixed coefficients."""
        return self.curve.by_duration(self.point.coefficients, self.point.duration, self.motion.z)

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
    """Rows A x <= b in x = (coefficients, scalar), and their origin: (block, nodes, columns)."""

    matrix: Array
    bound: Array
    where: tuple[tuple[int, Indices, Indices], ...] = ()

    def and_also(self, other: Linearised) -> Linearised:
        matrix, bound = np.vstack([self.matrix, other.matrix]), np.concatenate([self.bound, other.bound])
        return Linearised(matrix, bound, self.where + other.where)


@dataclass(frozen=True, eq=False)
class Programme:
    """A nonlinear programme: an objective over the motions of a curve, under constraints at the nodes of its grid.

    given: whether the arm's response to load dynamics is frozen at that of the first iterate. The derivatives neglect
    its change, so predictions of steps are then accurate; the final motion needs a check with the true response.
    accuracy: with which steps meet rows; a fiftieth of what counts as converged.
    """

    curve: Curve
    constraints: Sequence[Constraint]
    objective: Objective
    given: bool = field(default=False, kw_only=True)
    accuracy: float = field(default=1e-5, kw_only=True)

    def at(self, point: Point, like: MotionEvaluation | None = None) -> Iterate:
        """The iterate at a point, with all rows. like: a motion whose arm response is used."""
        motion = self.curve.evaluated(point.coefficients, point.duration)
        if like is not None:
            motion = motion.giving_way_as(like)
        blocks = self.blocks(motion, point)
        return Iterate(point, self.curve, motion, blocks, self.objective.value(self.curve, point))

    def blocks(self, motion: MotionEvaluation, point: Point) -> tuple[Block, ...]:
        """All rows along the motion at a point."""
        return self.objective.demanded(evaluate(self.constraints, motion), point.margin)

    def begin(self, coefficients: Array, duration: float) -> Iterate:
        """The iterate at coefficients (size, m) and a duration, s; a margin that is maximised starts at its value
        there."""
        first = self.at(Point(coefficients, duration))
        if self.objective.scalar is not Scalar.MARGIN:
            return first
        counted = [float(block.values.max()) for block in first.blocks if self.objective.counts(block)]
        return self.at(Point(coefficients, duration, -max(counted)))

    def moved(self, path: Iterate, step: Array) -> Iterate | None:
        """The iterate after a step (coefficients, scalar), corrected to satisfy the equalities exactly; None if that
        failed."""
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
        return self.at(Point(coefficients, duration, margin), path.motion if self.given else None)

    def derivatives(self, path: Iterate, block: Block, node: Indices, column: Indices) -> Array:
        """Derivatives (r, size m + 1) of a block's rows by the coefficients and the scalar. With free duration, rows
        that scale with time are those multiplied by sigma / sigma_0."""
        matrix = self._chained(path, block.gradient(node, column), block.points[node])
        if block.following is not None:
            matrix += self._chained(path, block.following(node, column), block.points[node + 1])
        if block.whole is not None:
            matrix[:, :-1] += block.whole(node, column)
        if block.history is not None:
            near = np.flatnonzero(block.values[node, column] > -block.remembers)
            if len(near):
                matrix[near] += block.history(node[near], column[near], path.unknowns(block.factor))
        if self.objective.scalar is Scalar.DURATION:
            if block.by_duration is not None:
                matrix[:, -1] += 0.5 * block.by_duration[node, column]
            if block.scales:
                matrix[:, -1] += block.values[node, column]
        else:
            matrix[:, -1] = float(self.objective.counts(block))
        return matrix

    def _chained(self, path: Iterate, rows: Array, point: Indices) -> Array:
        """Chain rule from derivatives by z at points of the grid to those by the coefficients and sigma / sigma_0."""
        parts = rows.reshape(len(point), 4, -1)
        out = np.empty((len(point), path.coefficients.size + 1))
        out[:, :-1] = self.curve.columns(path.coefficients, path.duration, parts, point)
        out[:, -1] = 0.5 * np.einsum("rkn,krn->r", parts, path.slower[:, point])
        return out

    def linearised(self, path: Iterate, masks: Sequence[Mask]) -> Linearised:
        """The rows selected by masks (N, m), one per block, linearised."""
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
        """The rows with bounds that make the linear model exact at the trial point after a step; without rows that are
        far from their limit there, as a correction is small."""
        values, scales = [np.zeros(0)], [np.zeros(0)]
        free = self.objective.scalar is Scalar.DURATION
        for k, node, column in rows.where:
            block = trial.blocks[k]
            values.append(block.values[node, column])
            scales.append(np.full(len(node), 1 + step[-1] * (free and block.scales)))
        value = np.concatenate(scales) * np.concatenate(values)
        near = value > -max(0.02, 3.0 * trial.violation)  # rows that the correction of such a violation may reach
        matrix = rows.matrix[near]
        return Linearised(matrix, matrix @ step - value[near])

    def beyond_kinks(self, path: Iterate, trial: Iterate) -> Linearised:
        """Violated rows of a trial that have kinks, linearised at the trial: derivatives before a kink are useless."""
        kinked = [(block.values > 0) & block.kinked for block in trial.blocks]
        found = self.linearised(trial, kinked)
        matrix, scalar = found.matrix.copy(), trial.point.margin - path.point.margin
        if self.objective.scalar is Scalar.DURATION:  # sigma is relative to that of each iterate
            ratio = (trial.duration / path.duration) ** 2
            scalar = ratio - 1
            matrix[:, -1] /= ratio
        moved = np.append((trial.coefficients - path.coefficients).ravel(), scalar)
        return Linearised(matrix, found.bound + matrix @ moved)

    def subproblem(self, path: Iterate, trust: Trust) -> Subproblem:
        """The quadratic programme of an iteration, without rows."""
        m, count = self.curve.width, path.coefficients.size
        model = self.objective.model(self.curve, path.point)
        hessian, metric = np.zeros((count + 2, count + 2)), self.curve.metric(path.duration, trust.damping)
        for curve in range(m):  # curves are independent in the metric
            hessian[curve:count:m, curve:count:m] = metric
        if model.curvature is not None:
            hessian[:count, :count] += model.curvature
        ridge = hessian.ravel()[:: count + 3]
        ridge[:count] += 1e-9  # regularisation where the metric is singular
        ridge[count:] += 1e-6  # the metric does not contain scalar and slack
        cost = np.concatenate([model.slope, [model.by_scalar, trust.penalty]])
        low, high = -np.ones(count + 2), np.ones(count + 2)  # rad: no coefficient moves further in one iteration
        low[-2:], high[-2:] = (-trust.largest_shrink, 0.0), (0.5, np.inf)  # T grows by 22 % at most
        first, last = self.curve.fixed()
        scalar = [] if self.objective.scalar is Scalar.NONE else [count]
        free = np.array([*range(first, count - last), *scalar, count + 1])
        equal, target = self.curve.equalities(path.coefficients)
        extra, extra_bound = self.curve.inequalities(path.coefficients)
        return Subproblem(hessian, cost, low, high, free, equal, target, extra, extra_bound, self.accuracy)


@dataclass(frozen=True, eq=False)
class Subproblem:
    """A quadratic programme over x = (coefficients, scalar, slack), of which only the entries `free` are variable.

    equal, target: A x = b for the coefficients. extra, extra_bound: A x <= b for them, without slack. accuracy: with
    which rows are met.
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
    accuracy: float

    def solve(self, rows: Linearised) -> tuple[Array, float, Array] | None:
        """The step (coefficients, scalar), the remaining slack, and the rows' multipliers. None when the solver
        fails."""
        free, count = self.free, len(rows.bound)
        some = slice(free[0], free[-1] + 1) if free[-1] - free[0] < len(free) else free
        known = free[free < self.extra.shape[1]]  # coefficients, which come first and are contiguous
        inner = slice(known[0], known[-1] + 1) if len(known) else slice(0)
        columns = np.empty((len(free), count + len(self.extra)))  # column-major, as sparse solvers need them
        columns[: len(known), :count] = rows.matrix[:, inner].T
        columns[len(known) : -1, :count] = rows.matrix[:, free[len(known) : -1]].T
        columns[-1, :count] = -1.0
        columns[: len(known), count:] = self.extra[:, inner].T
        columns[len(known) :, count:] = 0.0
        equal = np.zeros((len(self.target), len(free)))
        equal[:, : len(known)] = self.equal[:, inner]
        programme = qp.Quadratic(
            self.hessian[some][:, some],
            self.cost[some],
            columns.T,
            np.concatenate([rows.bound, self.extra_bound]),
            equal,
            self.target,
            self.low[some],
            self.high[some],
        )
        found = qp.solve(programme, self.accuracy)
        if found is None:
            return None
        step = np.zeros(len(self.cost))
        step[free] = found.x
        return step[:-1], float(step[-1]), found.rows[: len(rows.bound)]
