"""The verdict on which all rests: no motion is committed that did not pass it, whoever proposed it.

All rows of the problem are looked at, as the check of a fastest motion does, but at every millisecond for the joints
and every two for dynamics and contact, whatever the planner's nodes were; from the state that a wrong load has brought
the arm into. No row may be broken because the state that is inherited breaks it. What comes near to something is looked
at between the instants too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from salver.geometry import Array, Indices, Mask
from salver.live.known import Known
from salver.live.motion import Committed, ConstraintMargins
from salver.live.seal import seal_of
from salver.models.arm_geometry import ArmGeometry
from salver.models.arm_limits import LIMITS
from salver.planning.fastest import Block, Constraint, MotionEvaluation, TransportProblem, evaluate
from salver.planning.fastest.after import stays
from salver.planning.fastest.brim import Brim
from salver.planning.fastest.constraints import (
    PER_METRE,
    Clearance,
    ContactConstraint,
    JointLimit,
    LevelConstraint,
    TiltConstraint,
    TorqueLimit,
    TorqueRateLimit,
    strayed,
)
from salver.planning.fastest.obstacles import NEAR, KeepOut
from salver.planning.follow.clearance import EXACT as TOUCHING
from salver.planning.follow.clearance import sweep
from salver.sensitivity.arm.finer import Finer, Smooth
from salver.sensitivity.arm.liquids import Sloshing
from salver.sensitivity.arm.terms import MotionTerms
from salver.trajectory import JointMotion, ways

STEP = 2e-3  # s between instants at which dynamics, contact and distances are looked at
# s between those at which they are worked out, and what a wrong load does to the arm: from knot to knot they are smooth
COARSE = 5e-3
SLOW = 1e-2  # s between those at which their derivatives are: of the deviation, which is small, these are factors
LEAST_NODES = 4  # what a filter needs
FINER = 2  # times as many at which the joints' own motion is
# Of the normal force at rest, that contact keeps at least: between the instants rows rise by up to 3e-4, and what a
# wrong load does to the arm is known to 2e-4 (tests/test_live_verdict.py measures both); twice that.
STEADY = 1e-3
# Of its limit, that the rate of torque keeps at least: from one period to the next, wherever the periods fall, it is up
# to 7.6e-3 more than is found (in a wild hand's session; of 72 live goals 3.1e-3: tests/test_live_verdict.py).
UNHURRIED = 1e-2
# Of the room of a liquid: waves are known every 5 ms, and from one motion to the next to a thousandth.
UNSPILT = 3e-3
KEPT: dict[type[Constraint], float] = {ContactConstraint: STEADY, TorqueRateLimit: UNHURRIED, Brim: UNSPILT}
BESIDE = -0.05  # of their limit: rates of joints that are nearer than this are looked at between their instants
PERIOD = 1e-3  # s: the shortest, of a loop that is told torques
SETTLING = 2e-2  # of the normal force at rest, by which contact comes nearer to its edge after a motion's end at most
OVERSHOOT = 5e-3  # m, than which the arm strays less further after its end: as much as is kept free
FORGIVEN = 0.2  # of a row's margin, never of the row, that the beginning may lack: there the jerk has just changed
BEGINNING = 0.02  # s
AT_REST = 1e-7  # rad/s, rad/s^2: what is left of a motion's end
CONTINUOUS = (1e-8, 1e-7, 1e-5)  # rad, rad/s, rad/s^2: by which a motion may begin elsewhere than where the arm is


@dataclass(frozen=True)
class Finding:
    """What became of a motion that was looked at: committed, or why not. excess: of the worst row, beyond its edge;
    what: which one it is. slower: by how much longer, relatively, it would be put right; infinite when that would not
    do. known: what was worked out for it."""

    committed: Committed | None
    excess: float
    sentence: str
    what: str = ""
    slower: float = np.inf
    known: Known | None = None


def verified(
    problem: TransportProblem, motion: JointMotion, begins: float, before: Committed | None, hastily: bool = False
) -> Finding:
    """The verdict on a motion from live time `begins` on that goes on from the one before (None: from a long rest).
    hastily: of a motion whose reference breaks a row already, whatever the arm strays from it, the worst of these."""
    broken = _jolt(motion, begins, before)
    if broken:
        return Finding(None, np.inf, broken)
    begun = problem if before is None else before.left(begins, problem)
    evaluation, straying, knots = seen(begun, motion)
    nodes, t = evaluation.nodes, evaluation.s * motion.duration
    keep_out, (of_reference, constraints) = problem.keep_out, _apart_by_reference(problem.constraints)
    blocks = [_begun(told(block, t[nodes], knots), t) for block in evaluate(of_reference, evaluation)]
    planned, count = None, len(blocks)
    if hastily and _kept(blocks) and problem.liquids:
        planned, swinging = _as_planned(begun, evaluation, t[nodes], knots)
        blocks += [_begun(block, t) for block in swinging]
    if hastily and not _kept(blocks):
        return _refused(blocks, _margins(blocks, begins + t, problem), t)
    blocks = blocks[:count]
    known = straying(planned)
    response = known.response
    if keep_out is not None:
        keep_out = keep_out.near(few(keep_out.parts, evaluation.at_nodes[0]))
    for k, constraint in enumerate(constraints):
        if keep_out is not None and watches(constraint, problem.keep_out):
            constraints[k] = Clearance(keep_out)
        else:
            constraints[k] = coarse(constraint)
    blocks += [_begun(told(block, t[nodes], knots), t) for block in evaluate(constraints, evaluation)]
    if response is not None:
        blocks = [_at_rest(block, response) for block in blocks]
    margins = _margins(blocks, begins + t, problem)
    excess = float(margins.row.max())
    if excess > 0.0:
        return _refused(blocks, margins, t)
    if keep_out is not None and not _apart(keep_out, blocks, t[nodes], evaluation.at_nodes[:3]):
        met = sweep(keep_out.parts, motion).touch
        if met is not None:
            return Finding(None, np.inf, f"{met.first} and {met.second} would touch")
    deviation = None
    instants, off = t[nodes], np.zeros(len(nodes))
    if response is not None:
        joints, held = response.known.joints, response.known.held
        moved, late = joints.state[:, : 2 * problem.n], np.concatenate([held.q, held.dq], axis=1)
        deviation = -np.concatenate([moved, late[:, :, None]], axis=2).reshape(len(moved), 2, problem.n, -1)
        instants = known.t
        off = np.interp(instants, t[nodes], strayed(*evaluation.tray_radius()))
    waves = None if known.sloshing is None else known.sloshing.past(known.t)
    committed = Committed(begins, motion, begins + instants, deviation, margins, waves, off)
    if response is not None and not problem.liquids and _at_the_edge(blocks):
        contacts = [
            coarse(constraint) for constraint in problem.constraints if isinstance(constraint, ContactConstraint)
        ]
        settling = evaluate(contacts, committed.settling(problem), margins=False)
        worst = max(settling, key=lambda block: float(block.values.max()))
        excess = float(worst.values.max()) + STEADY
        if excess > 0.0:
            sentence = f"{worst.name} would be exceeded by {100 * excess:.2g} % while the arm settles at its end"
            return Finding(None, excess, sentence, worst.name)
    resting = np.pad(motion.q[-1:], ((0, 3), (0, 0)))[:, None]
    if problem.liquids and not stays(committed.left(committed.ends, problem), np.zeros(1), resting):
        return Finding(None, np.inf, "what is carried would not stay in the wave after it")
    committed = replace(committed, seal=seal_of(committed, before))
    return Finding(committed, excess, "", known=replace(known, keep_out=keep_out))


def _at_rest(block: Block, response: Finer) -> Block:
    """The block; if of distances, at the end those at rest too: the arm strays on until it has settled."""
    if isinstance(block.of, Clearance) and block.values[-1].max() > -PER_METRE * OVERSHOOT:
        more = strayed(*response.resting) - strayed(*response.tray_radius())[-1]
        block.values[-1] += PER_METRE * max(0.0, float(more))
    return block


def _at_the_edge(blocks: Sequence[Block]) -> bool:
    """Whether contact comes so near to its edge at the end that it might break while the arm settles."""
    return any(isinstance(b.of, ContactConstraint) and b.values[-1].max() > -SETTLING for b in blocks)


def _kept(blocks: Sequence[Block]) -> bool:
    """Whether no row is beyond its edge."""
    return max((float(block.values.max()) for block in blocks), default=0.0) <= 0.0


def _as_planned(
    problem: TransportProblem, evaluation: MotionEvaluation, t: Array, knots: Mask
) -> tuple[Sloshing, tuple[Block, ...]]:
    """Liquids on a tray that follows a motion exactly, at some of its nodes t (N,), and what becomes of their surfaces;
    what an arm makes of them that gives way comes beside it."""
    some = Smooth.of(t, knots, COARSE).some
    planned = Sloshing.of(problem.every_case, t[some], evaluation.terms.w[some], None, problem.past)
    at = replace(evaluation, nodes=evaluation.nodes[some]).sloshing_as(planned.each)
    return planned, evaluate([brim for brim in problem.constraints if isinstance(brim, Brim)], at)


def _refused(blocks: Sequence[Block], margins: ConstraintMargins, t: Array) -> Finding:
    """The verdict on a motion of which some rows are beyond their edge; t: (P,) of the margins, from its beginning."""
    worst = int(np.argmax(margins.row))
    excess, name = float(margins.row[worst]), margins.names[int(margins.what[worst])]
    far = name.startswith("clearance of ")  # in metres, not as a share of anything
    beyond = f"{1e3 * excess / PER_METRE:.2g} mm too small" if far else f"exceeded by {100 * excess:.2g} %"
    sentence = f"{name} would be {beyond} {t[worst]:.2f} s after it begins"
    return Finding(None, excess if np.isfinite(excess) else np.inf, sentence, name, _slower(blocks))


def _apart_by_reference(constraints: Sequence[Constraint]) -> tuple[list[Constraint], list[Constraint]]:
    """Constraints on the reference alone, and those on which it bears what the arm strays from it."""
    alone: list[Constraint] = []
    strayed: list[Constraint] = []
    for constraint in constraints:
        if isinstance(constraint, JointLimit):
            first, second = constraint.by_reference
            alone.append(first)
            strayed.append(second)
        else:
            (alone if isinstance(constraint, TorqueRateLimit | LevelConstraint | TiltConstraint) else strayed).append(
                constraint
            )
    return alone, strayed


def seen(problem: TransportProblem, motion: JointMotion) -> tuple[MotionEvaluation, Callable[..., Known], Mask]:
    """A motion at the instants at which it is looked at; (N,) which nodes are knots. What it returns second works out
    what a wrong load does to the arm, and is what is known at some of the instants, from where dynamics and this are
    continued to all nodes; it takes liquids as planned, if they are known there."""
    counts = _counts(motion)
    t, z = motion.evenly(FINER * counts)
    nodes = np.arange(0, len(t), FINER)
    knots = np.zeros(len(nodes), dtype=bool)
    knots[np.append(0, np.cumsum(counts))] = True
    smooth = Smooth.of(t[nodes], knots, COARSE)
    some = nodes[smooth.some]
    evaluation = replace(problem.at(t / motion.duration, z, motion.duration, nodes, imposed=False), moving=False)
    evaluation = replace(evaluation, coarsely=bool(problem.liquids))
    slow = Smooth.of(t[some], knots[smooth.some], SLOW, fewest=2)
    terms = MotionTerms.deriving(problem.model, problem.arm.tray_id, z[:3, some], slow.some, slow.each)
    evaluation.feeling(terms.continued(z[:3, nodes], smooth.each))

    def straying(planned: Sloshing | None = None) -> Known:
        response, sloshing = None, None
        if problem.tracking is not None:
            jerk = z[3, some]
            jerk[knots[smooth.some]] = motion.jerk_before
            response = Finer.of(problem.tracking, t[nodes], evaluation.terms, terms, z[1:, some], jerk, smooth)
            evaluation.straying(response)
            sag = problem.tracking.sag(terms)
            evaluation.sagging(replace(sag, dw=smooth.each([sag.dw])[0]))
        if problem.liquids:
            midway = None if response is None else response.midway
            sloshing = Sloshing.of(problem.every_case, t[some], terms.w, midway, problem.past, planned=planned)
            each = sloshing.each.items()
            evaluation.sloshing_as({name: tuple(x.continued(smooth.each) for x in parts) for name, parts in each})
        return Known(t[some], knots[smooth.some], terms, response, sloshing=sloshing)

    return evaluation, straying, knots


def instants(motion: JointMotion) -> tuple[Array, Indices]:
    """Points s (P,) of a motion's duration at which it is looked at, and indices of the nodes among them; its knots are
    nodes."""
    t = motion.evenly(FINER * _counts(motion))[0]
    return t / motion.duration, np.arange(0, len(t), FINER)


def _counts(motion: JointMotion) -> Indices:
    """How many steps from node to node each piece of a motion has."""
    counts = np.maximum(1, np.ceil(np.diff(motion.t) / STEP - 1e-9)).astype(int)
    counts[0] += max(0, LEAST_NODES - int(counts.sum()))
    return counts


def coarse(constraint: Constraint) -> Constraint:
    """The same, with bounds on rows that are far from their edge."""
    return replace(constraint, coarsely=True) if isinstance(constraint, ContactConstraint) else constraint


def watches(constraint: Constraint, keep_out: KeepOut | None) -> bool:
    """Whether a constraint is that of these distances, and not of others of one's own."""
    return isinstance(constraint, Clearance) and constraint.keep_out is keep_out


def few(parts: ArmGeometry, q: Array) -> Array:
    """Of postures (N, n) along a motion so many that no pair is near (`NEAR`) at another one only: between two of them
    none comes nearer by more than half of that."""
    for every in (8, 4, 2):
        some = q[np.unique(np.append(np.arange(0, len(q), every), len(q) - 1))]
        if (np.abs(np.diff(some, axis=0)) @ parts.levers(q).T).max(initial=0.0) < NEAR:
            return some
    return q


def _apart(keep_out: KeepOut, blocks: Sequence[Block], t: Array, states: Array) -> bool:
    """Whether nothing can touch between nodes t (N,) with states (3, N, n) either, by how far apart things are at these
    and how far they go; otherwise it has to be looked."""
    parts = keep_out.parts
    for block in blocks:
        if isinstance(block.of, Clearance) and block.of.keep_out is keep_out:
            low = keep_out.least - block.values / PER_METRE
            return bool(np.all(low[:-1] + low[1:] - ways(t, states) @ parts.levers(states[0]).T > 2 * TOUCHING))
    return not parts.pairs


def kept(block: Block, constraint: Constraint | None) -> float:
    """The margin that a motion keeps from the edge of a constraint's rows."""
    return max(block.margins[1], next((least for kind, least in KEPT.items() if isinstance(constraint, kind)), 0.0))


def told(block: Block, t: Array, knots: Mask) -> Block:
    """The block; if of torque's rate, not over the steps between the instants t (N,) but over any period within them.

    It is nearly a parabola through three steps between two knots: its peak is put where it is, and beside a knot, where
    it has a kink, it is carried on to that. The joints' own rates are so between their instants: from rest an
    acceleration may rise and fall within 3 ms.
    knots: (N,) which instants are.
    """
    if not isinstance(block.of, JointLimit | TorqueRateLimit):
        return block
    most = block.values.max(axis=0)
    if isinstance(block.of, TorqueRateLimit):  # by less than this is added to any of them
        most += 2.5 * np.abs(np.diff(block.values, axis=0)).max(axis=0)
    near = np.flatnonzero(most > BESIDE)
    if not len(near):
        return block
    values = block.values[:, near]
    before, at, after = values[:-2], values[1:-1], values[2:]
    if isinstance(block.of, JointLimit):
        kink = np.zeros(len(values), dtype=bool)
        kink[::FINER] = knots
        bend, tilt = 2 * at - before - after, after - before
        # Beside a knot, where there is a kink, a peak may be nearer to that than to the instant after it. Jerk jumps
        # there: what it is beyond says nothing.
        within = 2.0 if block.inherits else 1.0
        peak = (np.maximum(np.maximum(before, after), at) > BESIDE) & (np.abs(tilt) <= within * bend) & (bend > 0.0)
        i, j = np.nonzero(peak & ~kink[1:-1, None])
        block.values[i + 1, near[j]] += tilt[i, j] ** 2 / (8 * bend[i, j])
        return block
    step, kink = np.diff(t), knots[1:-1]
    # Of three steps in one piece, which are equal: how the parabola through them bends.
    bend = np.where((kink[:-1] | kink[1:])[:, None], 0.0, before - 2 * at + after)
    peak = (at >= before) & (at >= after) & (bend < 0)
    flat = (1.0 - (PERIOD / np.maximum(step[1:-1], PERIOD)) ** 2)[:, None] / 24
    higher = np.where(peak, (after - before) ** 2 / (8 * np.maximum(-bend, 1e-12)) - flat * bend, 0.0)
    short = np.minimum(PERIOD / step, 1.0)[:, None]
    none = np.zeros_like(at[:1])
    first = _edge(values[:-1], values[1:], np.vstack([bend, none]), short[:-1])
    last = _edge(values[1:], values[:-1], np.vstack([none, bend]), short[1:])
    first[~knots[:-2] | kink], last[~knots[2:] | kink] = 0.0, 0.0
    values[1:-1] += higher
    values[:-1] += first
    values[1:] += last
    block.values[:, near] = values
    return block


def _edge(at: Array, beside: Array, bend: Array, short: Array) -> Array:
    """By how much a parabola is higher over a share `short` at an end of a step than over the step; at least 0."""
    return np.maximum((1.0 - short) * (0.5 * (at - beside + bend) - bend * (1.0 + short) / 6), 0.0)


def _begun(block: Block, t: Array) -> Block:
    """The block with its margin, of which what the state that is inherited lacks is forgiven."""
    margin = kept(block, block.of)
    if margin != block.margins[1]:
        block.values[:] += margin - block.margins[1]
    if block.inherits:
        first = block.values[: np.searchsorted(t[block.points], BEGINNING)]
        first[:] = np.where(first < FORGIVEN * margin, np.minimum(first, 0.0), first)
    return block


def _slower(blocks: Sequence[Block]) -> float:
    """By how much longer, relatively, all rows would be kept; infinite when time is not what they lack."""
    excess = [(block, float(block.values.max(initial=0.0))) for block in blocks]
    if not all(np.isfinite(most) and (block.by_time or most <= 0.0) for block, most in excess):
        return np.inf
    return max(block.slows * most for block, most in excess)


def _jolt(motion: JointMotion, begins: float, before: Committed | None) -> str:
    """Why a motion cannot follow what is committed, or does not end at rest; nothing when it can."""
    states = motion.q, motion.dq, motion.ddq
    if not all(np.all(np.isfinite(x)) for x in (motion.t, *states)) or not np.all(np.diff(motion.t) > 0):
        return "it is no motion: its knots are not numbers in order"
    if max(np.abs(motion.dq[-1]).max(), np.abs(motion.ddq[-1]).max()) > AT_REST:
        return "it does not end at rest"
    now = (motion.q[0], 0.0, 0.0) if before is None else before.state(begins)
    for mine, other, close in zip((x[0] for x in states), now, CONTINUOUS, strict=True):
        if np.abs(mine - other).max() > close:
            return "it does not begin where the arm is then"
    return ""


def _margins(blocks: Sequence[Block], t: Array, problem: TransportProblem) -> ConstraintMargins:
    """The largest row at each of the points t, and its name."""
    names: list[str] = []
    largest, what = np.full(len(t), -np.inf), np.zeros(len(t), dtype=np.intp)
    for block in blocks:
        if not block.values.size:
            continue
        value = block.values.max(axis=1)
        value[np.isnan(value)] = np.inf
        if isinstance(block.of, LevelConstraint) and np.all(value <= 0.0):
            continue  # a tray that has to stay level is always as near to that as this, and nothing is limited by it
        at = block.points[: len(value)]
        above = np.flatnonzero(value > largest[at])
        if len(above):
            label = _labels(block, problem)
            row = np.argmax(block.values[above], axis=1) if len(label) > 1 else 0  # the first that is no number, if any
            largest[at[above]], what[at[above]] = value[above], len(names) + row
            names += label
    if not np.isfinite(largest).any():
        return ConstraintMargins(t, np.full(len(t), -1.0), what, ("nothing",))
    return ConstraintMargins(t, largest, what, tuple(names))


def _labels(block: Block, problem: TransportProblem) -> Sequence[str]:
    """What rows of a block are called: by joint, where there is one for each, or by what has to keep apart."""
    if isinstance(block.of, Clearance):
        parts = block.of.keep_out.parts
        return [f"{block.name} of {parts.names[i]} from {parts.names[j]}" for i, j in parts.pairs]
    if isinstance(block.of, JointLimit | TorqueLimit | TorqueRateLimit):
        return _by_joint(block.of, block.name, problem.arm.joint_names)
    return [block.name]


@lru_cache(maxsize=64)
def _by_joint(constraint: JointLimit | TorqueLimit | TorqueRateLimit, name: str, joints: tuple[str, ...]) -> list[str]:
    """Names of rows either side of a limit."""
    kind = next(kind for kind in LIMITS if kind.name == name)
    finite = np.flatnonzero(np.isfinite(constraint.limits.range(kind)[1]))
    return [f"{name} of {joints[j]}" for j in (*finite, *finite)]
