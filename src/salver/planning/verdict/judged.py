"""Evaluation of a motion at the instants of a verdict: arm, load and load dynamics."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Self, TypeVar

import numpy as np

from salver.geometry import Array, Indices
from salver.models.arm.arm_limits import LIMITS, JointLimits
from salver.planning.trajopt.constraints.constraints import (
    FINEST,
    Block,
    Clearance,
    Constraint,
    ContactConstraint,
    JointLimit,
    TorqueRateLimit,
    strayed,
)
from salver.planning.trajopt.constraints.load_limits import LoadConstraint
from salver.planning.trajopt.evaluation import MotionEvaluation
from salver.planning.trajopt.problem import TransportProblem
from salver.sensitivity.arm.terms import MotionTerms
from salver.sensitivity.arm.tracking import Deviation
from salver.trajectory import JointMotion, Quintics, extremes


@dataclass(frozen=True)
class VerdictOptions:
    """The instants at which a verdict evaluates constraints, and the margins that it requires for peaks between them.

    Attributes:
        step: time between instants, s; every knot of the motion is an instant. With twice the step a verdict takes 0.7
            of the time, and contact rows rise by more than `contact` between instants.
        instants: least number of instants of a motion without load dynamics, if they are then at least `period` apart.
            Stops of 0.2 s change
            fast: between instants `step` apart they exceeded torque rate limits by up to 1.8 %, contact by 0.2 %.
        each: least number of instants between two knots, if they are then at least `period` apart: the jerk is a
            parabola there. With 1, a live motion with knots 3.6 ms apart exceeded a torque rate limit by 3 % between
            two instants.
        step_with_dynamics: s, instead of `step` with load dynamics, whose cases are expensive.
        deriving: derivatives of the dynamics are computed at every such instant and at knots, and are linear between.
            They multiply the small deviation: contact rows change by less than 2e-4 (test_live_verdict.py). With
            1 a verdict takes 1.04 to 1.1 times as long.
        contact: margin of every contact row, as a share of the normal force at rest, beside the peaks
            between instants (`peaks`), which are not looked for with 0. A drive that is linear between instants makes
            up to 2e-4 of it, and the peaks of rows that are no parabolas 1e-4 (test_live_verdict.py).
        torque_rate: margin of the torque rate, as a share of its limit. Measured: up to 1.3e-3 more over a period than
            is found along a fastest motion (test_live_verdict.py), up to 8e-3 more in rapidly changing streams.
        period: s, shortest control period of a torque interface.
        inside: margin of load dynamics, as a share of their room: their state is known to a thousandth from one motion
            to the next.
        at_rest_instants: of the rest after the end, until the deviation has settled; denser at its beginning.
        spent: part of the planner's margin between instants (`FINEST`) that the verdict does not require; distances,
            which the planner keeps at its instants only, may be smaller by as much: 0.01 mm. Live motions, from which
            others go on, must keep the whole margin.
        forgiven: share of a row's margin (never of the row itself) that may be missing during the first `beginning`
            seconds, where the jerk has just changed. With 0, changes of motion are refused because of margins that the
            motion before had already used.
        at_rest: largest velocity and acceleration at the end of a motion, rad/s and rad/s^2, due to rounding.
        continuous: largest difference of a motion's start from the arm's state, rad, rad/s, rad/s^2, due to rounding.
    """

    step: float = 2.5e-3
    instants: int = 160
    each: int = 4
    step_with_dynamics: float = 4e-3
    at_rest_instants: int = 16
    deriving: int = 3
    contact: float = 1e-3
    torque_rate: float = 1e-2
    period: float = 1e-3
    inside: float = 3e-3
    spent: float = 0.0
    forgiven: float = 0.2
    beginning: float = 0.02
    at_rest: float = 1e-7
    continuous: tuple[float, float, float] = (1e-8, 1e-7, 1e-5)

    def margin(self, block: Block, constraint: Constraint | None) -> float:
        """The margin that a constraint's rows must keep, in their unit."""
        margins = {ContactConstraint: self.contact, TorqueRateLimit: self.torque_rate, LoadConstraint: self.inside}
        kept = (x for kind, x in margins.items() if isinstance(constraint, kind))
        least = -self.spent if isinstance(constraint, Clearance) else 0.0
        return max(block.margins[1] - self.spent, *kept, least)


Kind = TypeVar("Kind", bound=Constraint)
STANDARD = VerdictOptions()
# Plans and stops need no more margin than their scenario's: no other motion goes on from them. Their knots are at most
# 3 ms apart, and between two of these a torque rate was exceeded by 0.02 %, as `each` = 4 shows.
PLANNED = VerdictOptions(each=1, contact=0.0, torque_rate=0.0, inside=0.0, spent=FINEST)


@dataclass(frozen=True, eq=False)
class VerdictEvaluation(MotionEvaluation):
    """Evaluation of a motion whose jerk jumps at its knots: jerk_before (N, n) is the value just before each node, `z`
    has the one after. derived: nodes with derivatives of the dynamics, which are linear between."""

    jerk_before: Array = field(default_factory=lambda: np.zeros(0))
    derived: Indices = field(default_factory=lambda: np.zeros(0, dtype=np.intp))

    def _slowed(self, factor: float) -> Self:
        return replace(super()._slowed(factor), jerk_before=factor**3 * self.jerk_before)

    @cached_property
    def terms(self) -> MotionTerms:
        t = self.shares * self.duration
        return MotionTerms.deriving(self.model, self.frame_id, self.at_nodes[:3], t, self.derived)

    @cached_property
    def response(self) -> Deviation | None:
        """Response e of e'' + kd e' + kp e = M^-1 J^T dF, with the error of held commands, which jumps with the
        jerk."""
        if self.tracking is None:
            return None
        rates, before = self.at_nodes[1:], self.jerk_before
        return self.tracking.along(self.shares * self.duration, self.terms, rates, before=before)


@dataclass(frozen=True, eq=False)
class Judged:
    """A motion, and the rest after it until the arm's deviation has settled, under a problem that begins with the arm's
    state (with load dynamics: to its end, see `MotionEvaluation.rest`). t: (N,) s, instants of its own time."""

    problem: TransportProblem
    motion: JointMotion
    t: Array
    along: VerdictEvaluation
    options: VerdictOptions

    @classmethod
    def of(cls, problem: TransportProblem, motion: JointMotion, options: VerdictOptions = STANDARD) -> Judged:
        """The motion with instants at all knots and evenly spaced ones between."""
        closer = max(motion.duration / options.instants, options.period)
        step = options.step_with_dynamics if problem.cases else min(options.step, closer)
        apart = np.diff(motion.t)
        each = np.minimum(options.each, np.ceil(apart / options.period))
        counts = np.maximum(each, np.ceil(apart / step - 1e-9)).astype(int)
        counts[0] += max(0, 4 - int(counts.sum()))  # a filter of cubics needs five
        t, z = motion.evenly(counts)
        before, knots = z[3].copy(), np.append(0, np.cumsum(counts))
        before[knots] = motion.jerk_before
        if problem.tracking is not None and not problem.cases:
            seconds = problem.tracking.settling
            rest = np.zeros((4, options.at_rest_instants, problem.n))
            rest[0], z[3, -1] = motion.q[-1], 0.0
            t = np.append(t, t[-1] + seconds * np.linspace(0.0, 1.0, rest.shape[1] + 1)[1:] ** 2)
            z, before = np.concatenate([z, rest], axis=1), np.concatenate([before, rest[3]])
        whole = replace(problem, cases=problem.every_case).at(t / t[-1], z, float(t[-1]), imposed=False)
        derived = np.union1d(np.append(knots, len(t) - 1), np.arange(0, len(t), options.deriving))
        more = {"jerk_before": before, "derived": derived, "moving": False}
        return cls(problem, motion, t, VerdictEvaluation(**(vars(whole) | more)), options)

    def of_kind(self, *kinds: type[Kind]) -> list[Kind]:
        """The problem's constraints of exactly these classes; `others` treats the rest."""
        return [constraint for constraint in self.problem.constraints if type(constraint) in kinds]  # type: ignore[misc]

    def rows(self, constraint: Constraint, blocks: Iterable[Block] | None = None) -> Iterator[Block]:
        """A constraint's rows along the motion, or the given ones, with their margins. NaN counts as a violation; a
        part of the margin may be missing at the beginning (`VerdictOptions.forgiven`)."""
        for block in constraint.blocks(self.along) if blocks is None else blocks:
            margin = self.options.margin(block, constraint)
            values = block.values + margin
            values[np.isnan(values)] = np.inf
            if block.inherits:
                first = values[: np.searchsorted(self.t[block.points], self.options.beginning)]
                first[:] = np.where(first < self.options.forgiven * margin, np.minimum(first, 0.0), first)
            yield block.having(values=values, of=constraint)

    def at_peaks(self, block: Block) -> Block:
        """Rows at all instants, each with the largest value until the next one; see `VerdictOptions.contact`."""
        if not self.options.contact or not np.all(np.isfinite(block.values)):
            return block
        return block.having(values=np.append(peaks(self.t, block.values), block.values[-1:], axis=0))

    @cached_property
    def _hulls(self) -> list[Array]:
        return Quintics.through(self.t, self.along.z[:3]).hulls

    def joints(self, order: int) -> Iterator[Block]:
        """Rows |d^k q / dt^k| <= limit at all times: Bernstein coefficients bound it between two instants; for
        acceleration and jerk, where that bound is loose, the extremes are used. Position and velocity include the arm's
        deviation, the larger of both instants."""
        kind = LIMITS[order]
        for constraint in self.of_kind(JointLimit):
            middle, half = constraint.limits.range(kind)
            finite = np.flatnonzero(np.isfinite(half))
            if not len(finite) or order not in constraint.orders:
                continue
            hull, middle, half = self._hulls[order], middle[finite], half[finite]
            low, high = extremes(hull) if order >= 2 else (hull.min(axis=0), hull.max(axis=0))
            beyond = np.concatenate([high[:, finite] - middle, middle - low[:, finite]], axis=1) / np.tile(half, 2) - 1
            if order < 2 and self.along.response is not None:
                radius = self.along.joint_radius(order)[:, finite] / half
                beyond += np.tile(np.maximum(radius[:-1], radius[1:]), 2)
            slows = 1.5 if order == 0 else 1.0 / order + 0.02
            row = Block(kind.name, beyond, no_gradient, self.along.nodes[:-1], (0.0, FINEST), order > 0, slows=slows)
            rows = [row.having(inherits=order < 3)]
            if order == 1 and constraint.limits.velocity_by_position is not None:
                rows.append(row.having(values=self._velocity_by_position(constraint.limits)))
            yield from self.rows(constraint, rows)

    def _velocity_by_position(self, limits: JointLimits) -> Array:
        """Rows (N - 1, 2 n) dq + radius <= v(q + radius) towards either end. v is concave, so between two instants v(q)
        is at least the polynomial whose Bernstein coefficients are v at those of q."""
        by_position, n = limits.velocity_by_position, self.problem.n
        assert by_position is not None
        stray = extra = np.zeros((len(self.t) - 1, n))
        if self.along.response is not None:
            radii = (self.along.joint_radius(order) for order in (0, 1))
            stray, extra = (np.maximum(radius[:-1], radius[1:]) for radius in radii)
        allowed = by_position.towards_ends(self._hulls[0], stray)[0]
        share = np.arange(6)[:, None, None] / 5
        quartic = np.pad(self._hulls[1], ((1, 1), (0, 0), (0, 0)))
        dq = share * quartic[:-1] + (1 - share) * quartic[1:]  # as coefficients of a quintic
        beyond = np.concatenate([dq + extra, extra - dq], axis=2) - allowed
        return np.asarray(beyond.max(axis=0) / np.tile(limits.finite_velocity, 2))

    @property
    def last(self) -> int:
        """Index of the instant at which the motion ends; later ones are at rest."""
        return int(np.searchsorted(self.t, self.motion.duration - 1e-9))

    @cached_property
    def deviation(self) -> Array | None:
        """Deviations e and e' of each term until the end of the motion, (N, 2, n, k), see `JointLoop.start`; None if
        nothing is uncertain."""
        if self.along.response is None:
            return None
        joints, held = self.along.response.joints, self.along.response.held
        both = [[joints.q, joints.dq], [held.q[:, :, None], held.dq[:, :, None]]]
        return -np.concatenate([np.stack(each, axis=1)[: self.last + 1] for each in both], axis=3)

    @property
    def stray(self) -> Array:
        """Largest deviation (n,) of each joint from the motion under the uncertain set, rad."""
        if self.along.response is None:
            return np.zeros(self.problem.n)
        return np.asarray(self.along.joint_radius(0)[: self.last + 1].max(axis=0))

    @cached_property
    def off(self) -> Array:
        """Largest displacement (N,) of an object on the tray from the plan until the end of the motion, m; at its end
        that of the rest after it."""
        if self.along.response is None:
            return np.zeros(self.last + 1)
        stray = strayed(*self.along.tray_radius())
        return np.append(stray[: self.last], stray[self.last :].max() + self.settling)

    @cached_property
    def settling(self) -> float:
        """Additional displacement of the objects on the tray in the rest after the motion, beyond that at its end, m; 0
        where that rest is judged with the motion."""
        if self.along.response is None or not self.problem.cases:
            return 0.0
        stray = strayed(*self.along.rest.tray_radius())
        return float(stray.max() - stray[0])


def peaks(t: Array, values: Array) -> Array:
    """Largest values (N - 1, m) between instants t (N,) of rows (N, m): of parabolas through both ends, with the larger
    downward curvature that differences show there."""
    h = np.diff(t)[:, None]
    slope = np.diff(values, axis=0) / h
    bend = np.maximum(1e-12, -2.0 * np.diff(slope, axis=0) / (h[1:] + h[:-1]))
    bend = np.concatenate([bend[:1], np.maximum(bend[1:], bend[:-1]), bend[-1:]])
    top = 0.125 * bend * (h + 2.0 * np.abs(slope) / bend) ** 2
    lower, higher = np.minimum(values[1:], values[:-1]), np.maximum(values[1:], values[:-1])
    return np.where(np.abs(slope) < 0.5 * bend * h, lower + top, higher)


def no_gradient(node: Indices, row: Indices) -> Array:
    raise NotImplementedError("a verdict needs no derivatives")
