"""The verdict on which all safety rests: no motion is committed, stored as a stop or sent that did not pass it.

`verify` evaluates the motion at instants `VerdictOptions.step` apart, from the state in which it begins, and goes
through `CHECKS` in the order of their price; it ends at the first that fails. A check gives rows g <= 0, as constraints
do (`salver.planning.trajopt.constraints.constraints`). Whatever the planner's nodes were, these instants are the
verdict's own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from salver.geometry import Array
from salver.planning.follow.clearance import EXACT as TOUCHING
from salver.planning.follow.clearance import sweep
from salver.planning.trajopt.constraints.constraints import (
    PER_METRE,
    Block,
    Clearance,
    ContactConstraint,
    JointLimit,
    LevelConstraint,
    TiltConstraint,
    TorqueLimit,
    TorqueRateLimit,
    both_sides,
)
from salver.planning.trajopt.constraints.load_limits import AtRest, LoadConstraint
from salver.planning.trajopt.problem import TransportProblem
from salver.planning.verdict.judged import STANDARD, Judged, VerdictOptions, no_gradient, subsample
from salver.planning.verdict.margins import ConstraintMargins
from salver.trajectory import JointMotion, ways

State = tuple[Array, Array, Array]  # q, dq, ddq (n,): rad, rad/s, rad/s^2


@dataclass(frozen=True, eq=False)
class Verdict:
    """Whether a motion passes. sentence: why not; empty where it does. excess: of the worst row that was looked at,
    infinite where no row is; what: which row it is, of a motion that does not pass. slower: by how much longer,
    relatively, it would pass; infinite when time does not help. judged: the motion as it was looked at; margins: the
    largest row at each of its instants. Both are None where it is no motion or does not begin in its state."""

    sentence: str
    excess: float = np.inf
    what: str = ""
    slower: float = np.inf
    judged: Judged | None = None
    margins: ConstraintMargins | None = None

    @property
    def ok(self) -> bool:
        return not self.sentence


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
            row = Block("torque rate", np.maximum(*either), no_gradient, points, slows=0.5, inherits=False)
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
    and w is what the tray feels, with the deviation that p itself makes and with what moves inside loads."""
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


def load_limits(judged: Judged) -> Iterator[Block]:
    """What moves inside loads within its limits (a liquid below its brim), in every case that a verdict
    looks at, during the motion, and of what is left after it."""
    for constraint in judged.of_kind(LoadConstraint):
        yield from judged.rows(constraint)


def at_rest(judged: Judged) -> Iterator[Block]:
    """`contact` and `load_limits` for a period of the slowest load after the end, in which the arm settles: it leans,
    and what swings back there pushes more than when the tray stopped."""
    for constraint in judged.of_kind(AtRest):
        assert isinstance(constraint, AtRest)
        yield from judged.rows(constraint.of, constraint.blocks(judged.along))


def clearance(judged: Judged) -> Iterator[Block]:
    """distance(pair) - deviation >= required, of arm, tray, load and obstacles; of pairs that come near only. At the
    end, with the largest deviation while the arm settles there."""
    out = judged.problem.keep_out
    if out is not None:
        for block in judged.rows(Clearance(out.near(subsample(out.parts, judged.along.at_nodes[0])))):
            block.values[judged.last] += PER_METRE * judged.settling
            yield block


def others(judged: Judged) -> Iterator[Block]:
    """Whatever else the problem asks for: what is predicted to pass, and constraints of one's own."""
    limits = JointLimit, LevelConstraint, TiltConstraint, TorqueRateLimit, TorqueLimit
    known = *limits, ContactConstraint, LoadConstraint, AtRest
    for constraint in judged.problem.constraints:
        own = type(constraint) is Clearance and constraint.keep_out is judged.problem.keep_out
        if type(constraint) not in known and not own:
            yield from judged.rows(constraint)


# In the order of their price: the reference alone, its dynamics, the deviation, everything.
CHECKS: tuple[Check, ...] = (
    *(acceleration, jerk, tilt, torque_rate, torque, position, velocity),
    *(contact_standing, contact, load_limits, at_rest, clearance, others),
)


def verify(
    problem: TransportProblem,
    motion: JointMotion,
    begins: State | None = None,
    options: VerdictOptions = STANDARD,
    *,
    thoroughly: bool = False,
) -> Verdict:
    """The verdict on a motion to rest under a problem.

    problem: with the deviation of the arm, and the modal states, that there are when the motion begins. begins: the
    arm's state then; None: at rest. thoroughly: when a check fails, go through the others too, to say what of all is
    violated most."""
    if jolt := joins(motion, begins, options):
        return Verdict(jolt)
    judged = Judged.of(problem, motion, options)
    blocks: list[Block] = []
    for check in CHECKS:
        blocks += check(judged)
        broken = [block for block in blocks if block.values.max(initial=-np.inf) > 0.0]
        if broken and (not thoroughly or check is CHECKS[-1]):
            return _refused(broken, judged)
    margins = ConstraintMargins.of(blocks, judged.t, problem)
    if touch := touches(judged, blocks):
        return Verdict(touch, judged=judged, margins=margins)
    return Verdict("", float(margins.row.max()), judged=judged, margins=margins)


def joins(motion: JointMotion, begins: State | None, options: VerdictOptions) -> str:
    """q, dq, ddq at its beginning are those of the arm then, and dq, ddq = 0 at its end; why not, or nothing."""
    states = motion.q, motion.dq, motion.ddq
    if not all(np.all(np.isfinite(x)) for x in (motion.t, *states)) or not np.all(np.diff(motion.t) > 0):
        return "it is no motion: its knots are not numbers in order"
    if max(np.abs(motion.dq[-1]).max(), np.abs(motion.ddq[-1]).max()) > options.at_rest:
        return "it does not end at rest"
    now = (motion.q[0], 0.0, 0.0) if begins is None else begins
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
        low = out.least - (block.values - judged.options.margin(block, block.of)) / PER_METRE
        moved = ways(judged.t, states) @ out.parts.levers(states[0]).T
        if np.any(low[:-1] + low[1:] - moved <= 2 * TOUCHING) and (touch := sweep(out.parts, judged.motion).touch):
            return f"{touch.first} and {touch.second} would touch"
    return ""


def _refused(blocks: Sequence[Block], judged: Judged) -> Verdict:
    """The verdict on a motion of which some rows are violated."""
    margins = ConstraintMargins.of(blocks, judged.t, judged.problem)
    worst = int(np.argmax(margins.row))
    excess, name = float(margins.row[worst]), margins.names[int(margins.what[worst])]
    far = name.startswith("clearance of ")  # in metres, not as a share of anything
    beyond = f"{1e3 * excess / PER_METRE:.2g} mm too small" if far else f"exceeded by {100 * excess:.2g} %"
    sentence = f"{name} would be {beyond} {judged.t[worst]:.2f} s after it begins"
    by_time = all(block.by_time and np.isfinite(block.values.max()) for block in blocks)
    slower = max(block.slows * float(block.values.max()) for block in blocks) if by_time else np.inf
    return Verdict(sentence, excess, name, slower, judged, margins)
