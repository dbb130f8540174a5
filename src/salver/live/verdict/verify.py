"""The verdict on which all safety rests: no motion is committed that did not pass it, whoever proposed it.

`verified` evaluates the motion at instants `VerdictOptions.step` apart, from the state in which the committed motion is
left, and goes through `CHECKS` in the order of their price; it ends at the first that fails. A check gives rows g <= 0,
as constraints do (`salver.planning.trajopt.constraints.constraints`). Whatever the planner's nodes were, these
instants are the verdict's own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from salver.geometry import Array, Indices
from salver.live.verdict.margins import ConstraintMargins
from salver.live.verdict.motion import Committed
from salver.live.verdict.profile import SpeedProfile
from salver.live.verdict.seal import seal_of
from salver.models.arm.arm_geometry import ArmGeometry
from salver.models.arm.arm_limits import LIMITS
from salver.planning.fastest import Block, Constraint, MotionEvaluation, TransportProblem
from salver.planning.fastest.after import stays
from salver.planning.follow.clearance import EXACT as TOUCHING
from salver.planning.follow.clearance import sweep
from salver.planning.trajopt.constraints.brim import Brim
from salver.planning.trajopt.constraints.constraints import (
    FINEST,
    PER_METRE,
    Clearance,
    ContactConstraint,
    JointLimit,
    LevelConstraint,
    TiltConstraint,
    TorqueLimit,
    TorqueRateLimit,
    both_sides,
    strayed,
)
from salver.planning.trajopt.constraints.obstacles import NEAR
from salver.sensitivity.arm.terms import MotionTerms
from salver.sensitivity.arm.tracking import Deviation
from salver.trajectory import JointMotion, extremes, hulls, ways


@dataclass(frozen=True)
class VerdictOptions:
    """What a verdict looks at, and what it keeps for what may happen between the instants that it looks at.

    Attributes:
        step: s between instants; every knot of the motion is one. Doubled, a verdict takes 0.7 of the time and contact
            rows rise by more than `contact` between the instants.
        instants: of a motion without liquids at least, no closer than `period`: stops of 0.2 s change within less
            time, and were up to 1.8 % beyond a limit of torque rate, 0.2 % of contact, between instants `step` apart.
        step_with_liquids: s, as `step`, with open liquids, whose cases cost most.
        deriving: instants from one at which derivatives of the dynamics are worked out to the next (knots are such);
            between them they are linear. They are factors of the deviation, which is small: contact rows change by less
            than 2e-4 (tests/test_live_verdict.py). At 1, a verdict takes 1.04 to 1.1 times as long.
        contact: share of the normal force at rest that every contact row keeps. Measured: between the instants rows
            rise by up to 5e-4 (tests/test_live_verdict.py). Doubled, friction is used to 0.1 % less.
        torque_rate: share of its limit that the rate of torque keeps. Measured: over a period it is up to 1.3e-3 more
            than is found along a fastest motion (tests/test_live_verdict.py), and was up to 8e-3 more in wild streams.
        period: s, the shortest of a loop that is told torques.
        brim: share of a liquid's room that is kept: waves are known from one motion to the next to a thousandth.
        at_rest_instants: of the rest after the end, until the deviation has settled; closer together where it begins.
        forgiven: share of a row's margin, never of the row itself, that may be lacking at first (`beginning`, s), where
            the jerk has just changed. At 0, bends are refused for a margin that the arm inherits.
        at_rest: rad/s and rad/s^2 that may be left at the end of a motion: rounding.
        continuous: rad, rad/s, rad/s^2 by which a motion may begin elsewhere than where the arm is: rounding.
    """

    step: float = 2.5e-3
    instants: int = 160
    step_with_liquids: float = 4e-3
    at_rest_instants: int = 16
    deriving: int = 4
    contact: float = 1e-3
    torque_rate: float = 1e-2
    period: float = 1e-3
    brim: float = 3e-3
    forgiven: float = 0.2
    beginning: float = 0.02
    at_rest: float = 1e-7
    continuous: tuple[float, float, float] = (1e-8, 1e-7, 1e-5)

    def margin(self, block: Block, constraint: Constraint | None) -> float:
        """What a motion keeps from the boundary of a constraint, in the unit of its rows."""
        least = {ContactConstraint: self.contact, TorqueRateLimit: self.torque_rate, Brim: self.brim}
        return max(block.margins[1], *(x for kind, x in least.items() if isinstance(constraint, kind)), 0.0)


STANDARD = VerdictOptions()


@dataclass(frozen=True)
class Finding:
    """What became of a motion that was looked at: committed, or why not. excess: of the worst row of the checks that
    failed; what: which row it is. slower: by how much longer, relatively, they would be passed; infinite when time does
    not help."""

    committed: Committed | None
    excess: float
    sentence: str
    what: str = ""
    slower: float = np.inf


@dataclass(frozen=True, eq=False)
class LiveEvaluation(MotionEvaluation):
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
    settled (with open liquids: to its end, see `settles`). t: (N,) s, instants of its own time."""

    problem: TransportProblem
    motion: JointMotion
    t: Array
    along: LiveEvaluation
    options: VerdictOptions

    @classmethod
    def of(cls, problem: TransportProblem, motion: JointMotion, options: VerdictOptions = STANDARD) -> Judged:
        """Every knot is an instant, and between two of them they are evenly spaced."""
        closer = max(motion.duration / options.instants, options.period)
        step = options.step_with_liquids if problem.liquids else min(options.step, closer)
        counts = np.maximum(1, np.ceil(np.diff(motion.t) / step - 1e-9)).astype(int)
        counts[0] += max(0, 4 - int(counts.sum()))  # a filter of cubics needs five
        t, z = motion.evenly(counts)
        before, knots = z[3].copy(), np.append(0, np.cumsum(counts))
        before[knots] = motion.jerk_before
        if problem.tracking is not None and not problem.liquids:
            seconds = problem.tracking.settling
            rest = np.zeros((4, options.at_rest_instants, problem.n))
            rest[0], z[3, -1] = motion.q[-1], 0.0
            t = np.append(t, t[-1] + seconds * np.linspace(0.0, 1.0, rest.shape[1] + 1)[1:] ** 2)
            z, before = np.concatenate([z, rest], axis=1), np.concatenate([before, rest[3]])
        whole = replace(problem, liquids=problem.every_case).at(t / t[-1], z, float(t[-1]), imposed=False)
        derived = np.union1d(np.append(knots, len(t) - 1), np.arange(0, len(t), options.deriving))
        more = {"jerk_before": before, "derived": derived, "moving": False, "coarsely": bool(problem.liquids)}
        return cls(problem, motion, t, LiveEvaluation(**(vars(whole) | more)), options)

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
        there; of acceleration, for which that bound is wide, the extremes. To position and velocity the deviation of
        the arm is added, the larger of that at either instant."""
        kind = LIMITS[order]
        for constraint in self.of_kind(JointLimit):
            assert isinstance(constraint, JointLimit)
            middle, half = constraint.limits.range(kind)
            finite = np.flatnonzero(np.isfinite(half))
            if not len(finite) or order not in constraint.orders:
                continue
            hull, middle, half = self._hulls[order], middle[finite], half[finite]
            low, high = extremes(hull) if order == 2 else (hull.min(axis=0), hull.max(axis=0))
            beyond = np.concatenate([high[:, finite] - middle, middle - low[:, finite]], axis=1) / np.tile(half, 2) - 1
            if order < 2 and self.along.response is not None:
                radius = self.along.joint_radius(order)[:, finite] / half
                beyond += np.tile(np.maximum(radius[:-1], radius[1:]), 2)
            slows = 1.5 if order == 0 else 1.0 / order + 0.02
            row = Block(kind.name, beyond, _no_gradient, self.along.nodes[:-1], (0.0, FINEST), order > 0, slows=slows)
            yield from self.rows(constraint, [row.having(inherits=order < 3)])


def _no_gradient(node: Indices, row: Indices) -> Array:
    raise NotImplementedError("a verdict needs no derivatives")


Check = Callable[[Judged], Iterable[Block]]


def acceleration(judged: Judged) -> Iterable[Block]:
    """|ddq| <= limit, of the reference, as makers state their limits."""
    return judged.joints(2)


def jerk(judged: Judged) -> Iterable[Block]:
    """|dddq| <= limit, of the reference; on either side of a knot, where it jumps."""
    return judged.joints(3)


def tilt(judged: Judged) -> Iterator[Block]:
    """Tray level, or leaning by no more than motion.max_tilt_deg: e_z . R_SE e_z >= cos(tilt), of the reference."""
    for constraint in judged.of_kind(LevelConstraint, TiltConstraint):
        yield from judged.rows(constraint)


def torque_rate(judged: Judged) -> Iterator[Block]:
    """|tau(t + p) - tau(t)| / p <= limit over every period p of the loop, of the reference: with dtau/dt = dtau/dq dq +
    dtau/ddq ddq + M dddq on either side of each instant, where the jerk jumps at knots, and linear between two."""
    z, slope, n = judged.along.at_nodes, judged.along.terms.torque_z, judged.problem.n
    after = slope @ z[1:].swapaxes(0, 1).reshape(len(slope), 3 * n, 1)
    before = after - slope[:, :, 2 * n :] @ (z[3] - judged.along.jerk_before)[:, :, None]
    half = np.minimum(judged.options.period / np.diff(judged.t), 1.0)[:, None] / 2  # of a step, from either end
    for constraint in judged.of_kind(TorqueRateLimit):
        assert isinstance(constraint, TorqueRateLimit)
        limit = constraint.limits.torque_rate
        some = np.flatnonzero(np.isfinite(limit))
        if len(some):
            first, last = after[:-1, some, 0] / limit[some], before[1:, some, 0] / limit[some]
            either = [both_sides(first + half * (last - first)), both_sides(last + half * (first - last))]
            points = judged.along.nodes[:-1]
            row = Block("torque rate", np.maximum(*either), _no_gradient, points, slows=0.5, inherits=False)
            yield from judged.rows(constraint, [row])


def torque(judged: Judged) -> Iterator[Block]:
    """|tau| + its radius under the uncertain set <= limit."""
    for constraint in judged.of_kind(TorqueLimit):
        yield from judged.rows(constraint)


def position(judged: Judged) -> Iterable[Block]:
    """q_min <= q - radius, q + radius <= q_max; radius: the most that the arm is off under the uncertain set."""
    return judged.joints(0)


def velocity(judged: Judged) -> Iterable[Block]:
    """|dq| + its radius under the uncertain set <= limit."""
    return judged.joints(1)


def contact(judged: Judged) -> Iterator[Block]:
    """C(p) w <= 0 at full speed for every parameter p of the uncertain set: C are the facets of the contact wrench cone
    and w is what the tray feels, with the deviation that p itself makes and with what liquids push."""
    for constraint in judged.of_kind(ContactConstraint):
        assert isinstance(constraint, ContactConstraint)
        if constraint.speed.factor:
            yield from judged.rows(replace(constraint, coarsely=True))


def contact_standing(judged: Judged) -> Iterator[Block]:
    """C(p) w_0 <= 0 for every p, w_0 the weight alone in each posture of the arm that sags under p: so contact holds at
    every lower speed, for w is linear in the speed squared and the cone is convex."""
    for constraint in judged.of_kind(ContactConstraint):
        assert isinstance(constraint, ContactConstraint)
        if not constraint.speed.factor:
            yield from judged.rows(replace(constraint, coarsely=True))


def liquids(judged: Judged) -> Iterator[Block]:
    """Crest below the brim, waves no steeper than linear theory holds for, at every fill and damping that a verdict
    looks at, during the motion and after it."""
    for constraint in judged.of_kind(Brim):
        yield from judged.rows(constraint)


def clearance(judged: Judged) -> Iterator[Block]:
    """distance(pair) - deviation >= required, of arm, tray, load and obstacles; of pairs that come near only."""
    out = judged.problem.keep_out
    if out is not None:
        yield from judged.rows(Clearance(out.near(subsample(out.parts, judged.along.at_nodes[0]))))


def others(judged: Judged) -> Iterator[Block]:
    """Whatever else the problem asks for: what is predicted to pass, and constraints of one's own."""
    known = JointLimit, LevelConstraint, TiltConstraint, TorqueRateLimit, TorqueLimit, ContactConstraint, Brim
    for constraint in judged.problem.constraints:
        own = type(constraint) is Clearance and constraint.keep_out is judged.problem.keep_out
        if type(constraint) not in known and not own:
            yield from judged.rows(constraint)


# In the order of their price: the reference alone, its dynamics, the deviation, everything.
CHECKS: tuple[Check, ...] = (
    *(acceleration, jerk, tilt, torque_rate, torque, position, velocity),
    *(contact_standing, contact, liquids, clearance, others),
)


def verified(
    problem: TransportProblem,
    motion: JointMotion,
    begins: float,
    before: Committed | None,
    options: VerdictOptions = STANDARD,
    *,
    thoroughly: bool = False,
    profile: SpeedProfile | None = None,
) -> Finding:
    """The verdict on a motion from live time `begins`, s, on that goes on from the one before (None: a long rest).
    thoroughly: when a check fails, go through the others too, to say what of all is violated most. profile: the path
    that it is, at which speed, for whoever changes the speed later; nothing here depends on it."""
    if jolt := joins(motion, begins, before, options):
        return Finding(None, np.inf, jolt)
    judged = Judged.of(problem if before is None else before.left(begins, problem), motion, options)
    blocks: list[Block] = []
    for check in CHECKS:
        blocks += check(judged)
        broken = [block for block in blocks if block.values.max(initial=-np.inf) > 0.0]
        if broken and (not thoroughly or check is CHECKS[-1]):
            return _refused(broken, judged, begins)
    if touch := touches(judged, blocks):
        return Finding(None, np.inf, touch)
    committed = replace(_committed(judged, blocks, begins), profile=profile)
    excess, what = settles(judged, blocks, committed)
    if excess > 0.0:
        sentence = f"{what} would be exceeded by {100 * excess:.2g} % while the arm settles at its end"
        return Finding(None, excess, sentence, what)
    if not rests(judged, committed):
        return Finding(None, np.inf, "what is carried would not stay in the wave after it")
    return Finding(replace(committed, seal=seal_of(committed, before)), -committed.margins.from_(begins)[0], "")


def joins(motion: JointMotion, begins: float, before: Committed | None, options: VerdictOptions) -> str:
    """q, dq, ddq at its beginning are those of the committed motion then, and dq, ddq = 0 at its end; why not, or
    nothing."""
    states = motion.q, motion.dq, motion.ddq
    if not all(np.all(np.isfinite(x)) for x in (motion.t, *states)) or not np.all(np.diff(motion.t) > 0):
        return "it is no motion: its knots are not numbers in order"
    if max(np.abs(motion.dq[-1]).max(), np.abs(motion.ddq[-1]).max()) > options.at_rest:
        return "it does not end at rest"
    now = (motion.q[0], 0.0, 0.0) if before is None else before.state(begins)
    for mine, other, close in zip((x[0] for x in states), now, options.continuous, strict=True):
        if np.abs(mine - other).max() > close:
            return "it does not begin where the arm is then"
    return ""


def touches(judged: Judged, blocks: Sequence[Block]) -> str:
    """Which parts may touch between two instants: those nearer to each other, at both together, than they may move
    against one another in between (sum of |dq| times lever). These are swept; what touches, in words, or nothing."""
    states = judged.along.at_nodes[:3]
    for block in blocks:
        if type(block.of) is not Clearance:  # of a subclass nobody knows what its rows are
            continue
        out = block.of.keep_out
        low = out.least - block.values / PER_METRE
        moved = ways(judged.t, states) @ out.parts.levers(states[0]).T
        if np.any(low[:-1] + low[1:] - moved <= 2 * TOUCHING) and (touch := sweep(out.parts, judged.motion).touch):
            return f"{touch.first} and {touch.second} would touch"
    return ""


def settles(judged: Judged, blocks: Sequence[Block], committed: Committed) -> tuple[float, str]:
    """The clearance at the end of a motion with open liquids, less what the tray strays further than there while it
    settles. The excess, and its name. Without liquids that rest is judged with the motion."""
    if judged.problem.tracking is None or not judged.problem.liquids:
        return -np.inf, ""
    rest = committed.settling(judged.problem).response
    assert rest is not None
    further = strayed(*rest.tray_radius())
    more = PER_METRE * (further.max() - further[0])
    clearances = (block for block in blocks if isinstance(block.of, Clearance) and block.values.size)
    return max(((block.values[-1].max() + more, block.name) for block in clearances), default=(-np.inf, ""))


def rests(judged: Judged, committed: Committed) -> bool:
    """Whether what is carried stays while waves die away after the end."""
    problem, end = judged.problem, np.pad(judged.motion.q[-1:], ((0, 3), (0, 0)))[:, None]
    return not problem.liquids or stays(committed.left(committed.ends, problem), np.zeros(1), end)


def _refused(blocks: Sequence[Block], judged: Judged, begins: float) -> Finding:
    """The verdict on a motion of which some rows are violated."""
    margins = ConstraintMargins.of(blocks, begins + judged.t, judged.problem)
    worst = int(np.argmax(margins.row))
    excess, name = float(margins.row[worst]), margins.names[int(margins.what[worst])]
    far = name.startswith("clearance of ")  # in metres, not as a share of anything
    beyond = f"{1e3 * excess / PER_METRE:.2g} mm too small" if far else f"exceeded by {100 * excess:.2g} %"
    sentence = f"{name} would be {beyond} {judged.t[worst]:.2f} s after it begins"
    by_time = all(block.by_time and np.isfinite(block.values.max()) for block in blocks)
    slower = max(block.slows * float(block.values.max()) for block in blocks) if by_time else np.inf
    return Finding(None, excess, sentence, name, slower)


def _committed(judged: Judged, blocks: Sequence[Block], begins: float) -> Committed:
    """The motion with what goes on from it: until its end, the deviation e, e' of each term, and the waves. At its end
    the tray strays by as much as it will at rest."""
    along, t = judged.along, judged.t
    margins = ConstraintMargins.of(blocks, begins + t, judged.problem)
    last = int(np.searchsorted(t, judged.motion.duration - 1e-9))
    deviation, off = None, np.zeros(last + 1)
    if along.response is not None:
        joints, held = along.response.joints, along.response.held
        both = [[joints.q, joints.dq], [held.q[:, :, None], held.dq[:, :, None]]]
        deviation = -np.concatenate([np.stack(each, axis=1)[: last + 1] for each in both], axis=3)
        stray = strayed(*along.tray_radius())
        off = np.append(stray[:last], stray[last:].max())
    waves = along.left if judged.problem.liquids else None
    return Committed(begins, judged.motion, begins + t[: last + 1], deviation, margins, waves, off)


def subsample(parts: ArmGeometry, q: Array) -> Array:
    """Of postures (N, n) along a motion so many that no pair is near (`NEAR`) at another one only: between two of them
    none comes nearer by more than half of that."""
    for every in (8, 4, 2):
        some = q[np.unique(np.append(np.arange(0, len(q), every), len(q) - 1))]
        if (np.abs(np.diff(some, axis=0)) @ parts.levers(q).T).max(initial=0.0) < NEAR:
            return some
    return q
