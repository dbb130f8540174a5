"""A motion at the instants at which a verdict looks at it, with what the arm, its load and what moves inside do
there."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from salver.geometry import Array, Indices
from salver.models.arm.arm_geometry import ArmGeometry
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
from salver.planning.trajopt.constraints.obstacles import CLEARANCE
from salver.planning.trajopt.evaluation import MotionEvaluation
from salver.planning.trajopt.problem import TransportProblem
from salver.sensitivity.arm.terms import MotionTerms
from salver.sensitivity.arm.tracking import Deviation
from salver.trajectory import JointMotion, extremes, hulls


@dataclass(frozen=True)
class VerdictOptions:
    """What a verdict looks at, and what it keeps for what may happen between the instants that it looks at.

    Attributes:
        step: s between instants; every knot of the motion is one. Doubled, a verdict takes 0.7 of the time and contact
            rows rise by more than `contact` between the instants.
        instants: of a motion without load dynamics at least, no closer than `period`: stops of 0.2 s change within less
            time, and were up to 1.8 % beyond a limit of torque rate, 0.2 % of contact, between instants `step` apart.
        step_with_dynamics: s, as `step`, where something moves inside a load, whose cases cost most.
        deriving: instants from one at which derivatives of the dynamics are worked out to the next (knots are such);
            between them they are linear. They are factors of the deviation, which is small: contact rows change by less
            than 2e-4 (tests/test_live_verdict.py). At 1, a verdict takes 1.04 to 1.1 times as long.
        contact: share of the normal force at rest that every contact row keeps. Measured: between the instants rows
            rise by up to 5e-4 (tests/test_live_verdict.py). Doubled, friction is used to 0.1 % less.
        torque_rate: share of its limit that the rate of torque keeps. Measured: over a period it is up to 1.3e-3 more
            than is found along a fastest motion (tests/test_live_verdict.py), and was up to 8e-3 more in wild streams.
        period: s, the shortest of a loop that is told torques.
        inside: share of its room that what moves inside keeps: its state is known from one motion to the next to a
            thousandth.
        at_rest_instants: of the rest after the end, until the deviation has settled; closer together where it begins.
        spent: of what a planner keeps between its instants (`FINEST`), what a verdict does not ask for once more; of a
            distance, which it keeps at its instants only, as much may be lacking: 0.01 mm. Live motions, which others
            go on from, have to keep all of it.
        forgiven: share of a row's margin, never of the row itself, that may be lacking at first (`beginning`, s), where
            the jerk has just changed. At 0, bends are refused for a margin that the arm inherits.
        at_rest: rad/s and rad/s^2 that may be left at the end of a motion: rounding.
        continuous: rad, rad/s, rad/s^2 by which a motion may begin elsewhere than where the arm is: rounding.
    """

    step: float = 2.5e-3
    instants: int = 160
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
        """What a motion keeps from the boundary of a constraint, in the unit of its rows."""
        margins = {ContactConstraint: self.contact, TorqueRateLimit: self.torque_rate, LoadConstraint: self.inside}
        kept = (x for kind, x in margins.items() if isinstance(constraint, kind))
        least = -self.spent if isinstance(constraint, Clearance) else 0.0
        return max(block.margins[1] - self.spent, *kept, least)


STANDARD = VerdictOptions()
# A plan and its stops keep what their scenario asks for: nothing goes on from them that would need more.
PLANNED = VerdictOptions(contact=0.0, torque_rate=0.0, inside=0.0, spent=FINEST)


@dataclass(frozen=True, eq=False)
class VerdictEvaluation(MotionEvaluation):
    """A motion whose jerk jumps at its knots: jerk_before (N, n) is that just before each node, `z` has that after.
    derived: nodes at which derivatives of the dynamics are worked out; between them they are linear."""

    jerk_before: Array = field(default_factory=lambda: np.zeros(0))
    derived: Indices = field(default_factory=lambda: np.zeros(0, dtype=np.intp))

    @cached_property
    def terms(self) -> MotionTerms:
        t = self.shares * self.duration
        return MotionTerms.deriving(self.model, self.frame_id, self.at_nodes[:3], t, self.derived)

    @cached_property
    def response(self) -> Deviation | None:
        """e'' + kd e' + kp e = M^-1 J^T dF and what late commands are short of, which jumps where the jerk does."""
        if self.tracking is None:
            return None
        rates, before = self.at_nodes[1:], self.jerk_before
        return self.tracking.along(self.shares * self.duration, self.terms, rates, before=before)


@dataclass(frozen=True, eq=False)
class Judged:
    """A motion under a problem that begins where the arm is then, and the rest after it until the deviation has
    settled (with load dynamics: to its end, see `MotionEvaluation.rest`). t: (N,) s, instants of its own time."""

    problem: TransportProblem
    motion: JointMotion
    t: Array
    along: VerdictEvaluation
    options: VerdictOptions

    @classmethod
    def of(cls, problem: TransportProblem, motion: JointMotion, options: VerdictOptions = STANDARD) -> Judged:
        """Every knot is an instant, and between two of them they are evenly spaced."""
        closer = max(motion.duration / options.instants, options.period)
        step = options.step_with_dynamics if problem.cases else min(options.step, closer)
        counts = np.maximum(1, np.ceil(np.diff(motion.t) / step - 1e-9)).astype(int)
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
        more = {"jerk_before": before, "derived": derived, "moving": False, "coarsely": bool(problem.cases)}
        return cls(problem, motion, t, VerdictEvaluation(**(vars(whole) | more)), options)

    def of_kind(self, *kinds: type[Constraint]) -> list[Constraint]:
        """The problem's constraints of exactly these kinds; the rest is left to `others`."""
        return [constraint for constraint in self.problem.constraints if type(constraint) in kinds]

    def rows(self, constraint: Constraint, blocks: Iterable[Block] | None = None) -> Iterator[Block]:
        """A constraint's rows along the motion, or those given in their place, with their margins. A row that is no
        number is violated; a margin that is lacking where the motion begins is forgiven in part."""
        for block in constraint.blocks(self.along) if blocks is None else blocks:
            margin = self.options.margin(block, constraint)
            values = block.values + margin
            values[np.isnan(values)] = np.inf
            if block.inherits:
                first = values[: np.searchsorted(self.t[block.points], self.options.beginning)]
                first[:] = np.where(first < self.options.forgiven * margin, np.minimum(first, 0.0), first)
            yield block.having(values=values, of=constraint)

    @cached_property
    def _hulls(self) -> list[Array]:
        return hulls(self.t, self.along.z[:3])

    def joints(self, order: int) -> Iterator[Block]:
        """|d^k q / dt^k| at most its limit, at every time: the Bernstein coefficients between two instants bound it
        there; of acceleration and jerk, for which that bound is wide, the extremes. To position and velocity the
        deviation of the arm is added, the larger of that at either instant."""
        kind = LIMITS[order]
        for constraint in self.of_kind(JointLimit):
            assert isinstance(constraint, JointLimit)
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
        """(N - 1, 2 n) dq + its radius <= v(q + its radius) towards either end: v is concave, so v of a motion between
        two instants is at least what the Bernstein coefficients of v at those of q make."""
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
        """The instant at which the motion ends; those after it are of the rest."""
        return int(np.searchsorted(self.t, self.motion.duration - 1e-9))

    @cached_property
    def deviation(self) -> Array | None:
        """(N, 2, n, k) e and e' of each term until the end of the motion, see `JointLoop.start`; None where nothing is
        uncertain."""
        if self.along.response is None:
            return None
        joints, held = self.along.response.joints, self.along.response.held
        both = [[joints.q, joints.dq], [held.q[:, :, None], held.dq[:, :, None]]]
        return -np.concatenate([np.stack(each, axis=1)[: self.last + 1] for each in both], axis=3)

    @property
    def stray(self) -> Array:
        """(n,) rad, the most by which each joint may be off the motion under the uncertain set."""
        if self.along.response is None:
            return np.zeros(self.problem.n)
        return np.asarray(self.along.joint_radius(0)[: self.last + 1].max(axis=0))

    @cached_property
    def off(self) -> Array:
        """(N,) m by which what stands on the tray may be elsewhere until the end of the motion; at its end, by as much
        as it will be at rest."""
        if self.along.response is None:
            return np.zeros(self.last + 1)
        stray = strayed(*self.along.tray_radius())
        return np.append(stray[: self.last], stray[self.last :].max() + self.settling)

    @cached_property
    def settling(self) -> float:
        """m by which what stands on the tray may be further away in the rest after the motion than at its end; 0 where
        that rest is judged with the motion."""
        if self.along.response is None or not self.problem.cases:
            return 0.0
        stray = strayed(*self.along.rest.tray_radius())
        return float(stray.max() - stray[0])


def no_gradient(node: Indices, row: Indices) -> Array:
    raise NotImplementedError("a verdict needs no derivatives")


def subsample(parts: ArmGeometry, q: Array) -> Array:
    """Of postures (N, n) along a motion so many that no pair is near (`ClearanceOptions.near`) at another one only:
    between two of them none comes nearer by more than half of that."""
    for every in (8, 4, 2):
        some = q[np.unique(np.append(np.arange(0, len(q), every), len(q) - 1))]
        if (np.abs(np.diff(some, axis=0)) @ parts.levers(q).T).max(initial=0.0) < CLEARANCE.near:
            return some
    return q
