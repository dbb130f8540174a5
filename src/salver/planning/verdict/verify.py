"""The verdict on which all safety rests: every motion must pass it before it is committed, stored as a stop or sent.

`verify` evaluates the motion at instants `VerdictOptions.step` apart, independent of the planner's nodes, from the
state in which it begins. It runs `CHECKS`, cheapest first, up to the first that fails. A check returns rows g <= 0, as
constraints do (`salver.planning.trajopt.constraints.constraints`).
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
from salver.planning.verdict.judged import STANDARD, Judged, VerdictOptions, no_gradient
from salver.planning.verdict.margins import ConstraintMargins
from salver.trajectory import JointMotion, ways

State = tuple[Array, Array, Array]  # q, dq, ddq (n,): rad, rad/s, rad/s^2


@dataclass(frozen=True, eq=False)
class Verdict:
    """Whether a motion passes.

    Attributes:
        sentence: why not; "" if it passes.
        excess: value of the worst row that was checked; infinite without rows.
        what: name of the violated row.
        slower: relative increase of the duration with which it would pass; infinite if that does not help.
        judged, margins: the evaluated motion, and its largest row at each instant; None for an invalid motion or one
            that does not begin in the arm's state.
    """

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
    """|ddq| <= limit, of the reference, as in manufacturers' limits."""
    return judged.joints(2)


def jerk(judged: Judged) -> Iterable[Block]:
    """|dddq| <= limit, of the reference; on both sides of a knot, where it jumps."""
    return judged.joints(3)


def tilt(judged: Judged) -> Iterator[Block]:
    """Tray level, or tilted by at most motion.max_tilt_deg: e_z . R_SE e_z >= cos(tilt), of the reference."""
    for constraint in judged.of_kind(LevelConstraint, TiltConstraint):
        yield from judged.rows(constraint)


def torque_rate(judged: Judged) -> Iterator[Block]:
    """|tau(t + p) - tau(t)| / p <= limit over every control period p, of the reference. dtau/dt = dtau/dq dq +
    dtau/ddq ddq + M dddq is computed on both sides of each instant, because the jerk jumps, and is linear between: its
    mean over a period is largest where that begins or ends at an instant, or has one in its middle."""
    z, slope, n = judged.along.at_nodes, judged.along.terms.torque_z, judged.problem.n
    after = slope @ z[1:].swapaxes(0, 1).reshape(len(slope), 3 * n, 1)
    before = after - slope[:, :, 2 * n :] @ (z[3] - judged.along.jerk_before)[:, :, None]
    shares = np.outer([1.0, 0.5], judged.options.period / np.diff(judged.t))  # of a step, in a whole and half a period
    half, quarter = np.minimum(shares, 1.0)[:, :, None] / 2  # where the mean over these is, from either end of a step
    for constraint in judged.of_kind(TorqueRateLimit):
        limit = constraint.limits.torque_rate
        some = np.flatnonzero(np.isfinite(limit))
        if len(some):
            first, last = after[:-1, some, 0] / limit[some], before[1:, some, 0] / limit[some]
            begins, ends, middle = first + half * (last - first), last + half * (first - last), 0.0 * first
            middle[1:] = 0.5 * (last + quarter * (first - last))[:-1] + 0.5 * (first + quarter * (last - first))[1:]
            values = np.max([both_sides(x) for x in (begins, ends, middle)], axis=0)
            points = judged.along.nodes[:-1]
            row = Block("torque rate", values, no_gradient, points, slows=0.5, inherits=False)
            yield from judged.rows(constraint, [row])


def torque(judged: Judged) -> Iterator[Block]:
    """|tau| + its radius under the uncertain set <= limit."""
    for constraint in judged.of_kind(TorqueLimit):
        yield from judged.rows(constraint)


def position(judged: Judged) -> Iterable[Block]:
    """q_min <= q - radius, q + radius <= q_max; radius: largest deviation of the arm under the uncertain set."""
    return judged.joints(0)


def velocity(judged: Judged) -> Iterable[Block]:
    """|dq| + its radius under the uncertain set <= limit."""
    return judged.joints(1)


def contact(judged: Judged) -> Iterator[Block]:
    """C(p) w <= 0 at full speed for every p in the uncertain set: C has the facets of the contact wrench cone, and w is
    the tray's motion regressor with the deviation caused by p, plus the contribution of load dynamics."""
    for constraint in judged.of_kind(ContactConstraint):
        if constraint.speed.factor:
            yield from map(judged.at_peaks, judged.rows(replace(constraint, coarsely=True)))


def contact_standing(judged: Judged) -> Iterator[Block]:
    """C(p) w_0 <= 0 for every p, where w_0 is weight alone in each posture, with the arm's static deviation under p.
    Together with full speed this covers every lower speed: w is linear in the speed squared and the cone is convex."""
    for constraint in judged.of_kind(ContactConstraint):
        if not constraint.speed.factor:
            yield from judged.rows(replace(constraint, coarsely=True))


def load_limits(judged: Judged) -> Iterator[Block]:
    """Limits of load dynamics (a liquid below its brim) in every case of the verdict, during the motion, and of the
    residual swing after it."""
    for constraint in judged.of_kind(LoadConstraint):
        yield from judged.rows(constraint)


def at_rest(judged: Judged) -> Iterator[Block]:
    """`contact` and `load_limits` for a period of the slowest load after the end, while the arm settles: on a tilted
    tray a load that has swung back pushes more than when the tray stopped."""
    for constraint in judged.of_kind(AtRest):
        yield from judged.rows(constraint.of, constraint.blocks(judged.along))


def clearance(judged: Judged) -> Iterator[Block]:
    """distance(pair) - deviation >= required, of arm, tray, load and obstacles; of pairs that come near only. At the
    end, with the largest deviation while the arm settles there."""
    out = judged.problem.keep_out
    if out is not None:
        for block in judged.rows(Clearance(out.near(judged.along.at_nodes[0]))):
            block.values[judged.last] += PER_METRE * judged.settling
            yield block


def others(judged: Judged) -> Iterator[Block]:
    """All other constraints of the problem: predicted obstacles and user-defined ones."""
    limits = JointLimit, LevelConstraint, TiltConstraint, TorqueRateLimit, TorqueLimit
    known = *limits, ContactConstraint, LoadConstraint, AtRest
    for constraint in judged.problem.constraints:
        own = type(constraint) is Clearance and constraint.keep_out is judged.problem.keep_out
        if type(constraint) not in known and not own:
            yield from judged.rows(constraint)


# Cheapest first: those of the reference alone, its dynamics, the deviation, everything.
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
    """The verdict on a motion that ends at rest.

    Args:
        problem: with the arm's deviation and the modal states at the beginning of the motion.
        motion: of the joints.
        begins: the arm's state then; None: at rest.
        options: of the verdict.
        thoroughly: after a failure run the remaining checks too, to name the largest violation of all.
    """
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
    """Why a motion is invalid: it does not begin in the arm's state q, dq, ddq, or not end with dq = ddq = 0; "" if it
    is valid."""
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
    """The parts that collide between two instants, in words; "" for none.

    Pairs that are closer, at both instants together, than they can move relative to each other (sum of |dq| times lever
    arm) are checked in between.
    """
    states = judged.along.at_nodes[:3]
    for block in blocks:
        if type(block.of) is not Clearance:  # rows of a subclass may be anything
            continue
        out = block.of.keep_out
        low = out.least - (block.values - judged.options.margin(block, block.of)) / PER_METRE
        moved = ways(judged.t, states) @ out.parts.levers(states[0]).T
        if np.any(low[:-1] + low[1:] - moved <= 2 * TOUCHING) and (touch := sweep(out.parts, judged.motion).touch):
            return f"{touch.first} and {touch.second} would touch"
    return ""


def _refused(blocks: Sequence[Block], judged: Judged) -> Verdict:
    """The verdict on a motion with violated rows."""
    margins = ConstraintMargins.of(blocks, judged.t, judged.problem)
    worst = int(np.argmax(margins.row))
    excess, name = float(margins.row[worst]), margins.names[int(margins.what[worst])]
    amount = max(blocks, key=lambda block: float(block.values.max())).in_words(excess)
    beyond = f"{amount} too small" if name.startswith("clearance of ") else f"exceeded by {amount}"
    sentence = f"{name} would be {beyond} {judged.t[worst]:.2f} s after it begins"
    by_time = all(block.by_time and np.isfinite(block.values.max()) for block in blocks)
    slower = max(block.slows * float(block.values.max()) for block in blocks) if by_time else np.inf
    return Verdict(sentence, excess, name, slower, judged, margins)
