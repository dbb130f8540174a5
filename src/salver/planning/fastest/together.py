"""All legs of a task at once: the postures at the stops between them, and what share of the time each leg takes, are
unknowns of one programme.

A stop's posture is where one leg ends and the next begins; with a redundant arm it is not given by the pose. One leg
after the other, each would be chosen for the leg that ends there alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from salver.geometry import Array, Indices
from salver.planning.trajopt.constraints.constraints import Block, Constraint, evaluate
from salver.planning.trajopt.curves import ORDERS, Grid, end_equalities, with_ends
from salver.planning.trajopt.ends import End
from salver.planning.trajopt.evaluation import MotionEvaluation
from salver.planning.trajopt.exchange import SHORTEST
from salver.planning.trajopt.objectives import Point
from salver.planning.trajopt.problem import TransportProblem
from salver.planning.trajopt.programme import Iterate, Programme
from salver.planning.trajopt.spline import DERIVATIVES, RestSpline, SplineMotion
from salver.planning.trajopt.sqp import SqpOptions, minimise
from salver.planning.trajopt.trust import Trust
from salver.planning.trajopt.watch import Watch


@dataclass(frozen=True, eq=False)
class LegsCurve:
    """Joint splines from rest to rest, one after the other.

    Coefficients: control postures (K (size - 1) + 1, n) of K legs, the last of a leg being the first of the next, and
    below them, in rows of n, the log of each leg's share of the duration relative to `shares` (K,), then zeros.
    s: (P,) points of each leg in [0, 1] of it, of which `nodes` are nodes.
    """

    problems: tuple[TransportProblem, ...]
    spline: RestSpline
    s: Array
    nodes: Indices
    shares: Array

    @property
    def problem(self) -> TransportProblem:
        return self.problems[0]

    @property
    def width(self) -> int:
        return self.problem.n

    @property
    def count(self) -> int:
        """K."""
        return len(self.problems)

    @property
    def postures(self) -> int:
        """Number of rows of postures."""
        return self.count * (self.spline.size - 1) + 1

    def rows(self, k: int) -> slice:
        """Those of a leg, its ends included."""
        return slice(k * (self.spline.size - 1), (k + 1) * (self.spline.size - 1) + 1)

    @cached_property
    def grid(self) -> Grid:
        """The grid of all legs, at their initial shares of the time."""
        each, points = self.spline.matrices(self.s), len(self.s)
        size = self.postures + -(-self.count // self.width)
        basis = np.zeros((DERIVATIVES, self.count * points, size))
        begins = np.append(0.0, np.cumsum(self.shares))[:-1]
        for k, share in enumerate(self.shares):
            basis[:, k * points : (k + 1) * points, self.rows(k)] = each / share**ORDERS
        s = (begins[:, None] + self.shares[:, None] * self.s).ravel()
        return Grid(s, basis, (np.arange(self.count)[:, None] * points + self.nodes).ravel())

    def logs(self, coefficients: Array) -> Array:
        """(K,) logs of the shares, relative to those from which this began."""
        return np.asarray(coefficients[self.postures :].ravel()[: self.count])

    def durations(self, coefficients: Array, duration: float) -> Array:
        """(K,) of the legs, s."""
        return np.asarray(duration * self.shares * np.exp(self.logs(coefficients)))

    def _slower(self, coefficients: Array) -> Array:
        """(4, K P, 1) what the shares make of z."""
        return np.asarray(np.exp(-ORDERS * np.repeat(self.logs(coefficients), len(self.s))[None, :, None]))

    def motion(self, coefficients: Array, duration: float) -> Array:
        return np.asarray(self.grid.motion(coefficients, duration) * self._slower(coefficients))

    def by_duration(self, coefficients: Array, duration: float, z: Array) -> Array:
        return np.asarray(-ORDERS * z)

    def columns(self, coefficients: Array, duration: float, parts: Array, point: Indices) -> Array:
        """By the control postures; `LegsProgramme` adds what the shares do."""
        slower = self._slower(coefficients)[:, point, 0].T
        return self.grid.chained(parts * slower[:, :, None], point, duration)

    def fixed(self) -> tuple[int, int]:
        unused = self.grid.basis.shape[2] - self.postures
        return self.width * self.problem.start.given, unused * self.width - self.count

    def equalities(self, coefficients: Array) -> tuple[Array, Array]:
        rows, targets = end_equalities(self.problem.arm, self.ends, coefficients)
        whole = np.zeros((1, coefficients.size))  # the shares make one
        whole[0, self.columns_of_shares] = self.shares * np.exp(self.logs(coefficients))
        return np.vstack([rows, whole]), np.append(targets, 0.0)

    @property
    def ends(self) -> list[tuple[End, int]]:
        """The start and the end of each leg, with the row of coefficients that is the posture there."""
        return [(self.problem.start, 0), *((p.goal, self.rows(k).stop - 1) for k, p in enumerate(self.problems))]

    @property
    def columns_of_shares(self) -> Indices:
        return self.postures * self.width + np.arange(self.count)

    def inequalities(self, coefficients: Array) -> tuple[Array, Array]:
        rows = np.zeros((self.count, coefficients.size))
        rows[np.arange(self.count), self.columns_of_shares] = 1.0
        return np.vstack([rows, -rows]), np.full(2 * self.count, 0.2)  # a fifth of a leg's time in one iteration

    def repaired(self, coefficients: Array) -> Array | None:
        arm, limits = self.problem.arm, self.problem.limits
        out = coefficients.copy()
        for end, row in self.ends:
            found = end.nearest(arm, limits, coefficients[row], 20)
            if found is None:
                return None
            out[row] = found
        for rows in map(self.rows, range(self.count)):
            out[rows] = with_ends(coefficients[rows], out[rows.start], out[rows.stop - 1])
        logs = self.logs(out)
        out[self.postures :].ravel()[: self.count] = logs - np.log(self.shares @ np.exp(logs))
        return out


@dataclass(frozen=True, eq=False)
class LegsProgramme(Programme):
    """A programme over a `LegsCurve`. each: the constraints of each leg."""

    each: tuple[tuple[Constraint, ...], ...]

    def at(self, point: Point, like: MotionEvaluation | None = None) -> Iterate:
        curve = self.curve
        assert isinstance(curve, LegsCurve)
        z, points = curve.motion(point.coefficients, point.duration), len(curve.s)
        durations = curve.durations(point.coefficients, point.duration)
        blocks: list[Block] = []
        for k, (problem, constraints) in enumerate(zip(curve.problems, self.each, strict=True)):
            part = z[:, k * points : (k + 1) * points]
            motion = problem.at(curve.s, part, float(durations[k]), curve.nodes)
            blocks += [replace(b, points=b.points + k * points) for b in evaluate(constraints, motion)]
        # Of the whole only z is asked for: what depends on the load is in the blocks of the legs.
        whole = curve.problem.at(curve.grid.s, z, point.duration, curve.grid.nodes)
        demanded = self.objective.demanded(blocks, point.margin)
        return Iterate(point, curve, whole, demanded, self.objective.value(curve, point))

    def derivatives(self, path: Iterate, block: Block, node: Indices, column: Indices) -> Array:
        curve = self.curve
        assert isinstance(curve, LegsCurve)
        matrix = super().derivatives(path, block, node, column)
        leg = block.points[node] // len(curve.s)
        # A leg's rows know its own duration: by the log of its share as by that of T, which is half the log of T^2.
        matrix[np.arange(len(node)), curve.columns_of_shares[leg]] = 2 * matrix[:, -1]
        return matrix


def together(
    problems: Sequence[TransportProblem],
    begin: Sequence[SplineMotion],
    nodes_per_span: int,
    watch: Watch,
    gain: float,
    iterations: int = 25,
) -> tuple[list[SplineMotion], float]:
    """A first optimum of all legs, unchecked between nodes and without inner dynamics, and its largest violation.

    begin: a motion of each leg, of one spline, each from where the one before it ends. gain: as of `optimise`.
    """
    rough, spline = tuple(problem.roughly for problem in problems), begin[0].spline
    times = np.array([motion.duration for motion in begin])
    grid = Grid.of(spline, spline.nodes(nodes_per_span))
    curve = LegsCurve(rough, spline, grid.s, grid.nodes, times / times.sum())
    coefficients = np.zeros((curve.grid.basis.shape[2], curve.width))
    for k, motion in enumerate(begin):
        coefficients[curve.rows(k)] = motion.coefficients
    each = [
        tuple(c.near(spline.matrices(grid.s)[0] @ motion.coefficients) for c in problem.constraints)
        for problem, motion in zip(rough, begin, strict=True)
    ]
    programme = LegsProgramme(curve, (), SHORTEST, tuple(each))
    start = programme.begin(coefficients, float(times.sum()))
    found = minimise(programme, start, SqpOptions(iterations, watch, gain=gain), Trust()).iterate
    durations = curve.durations(found.coefficients, found.duration)
    motions = [SplineMotion(spline, found.coefficients[curve.rows(k)], float(t)) for k, t in enumerate(durations)]
    return motions, found.violation
