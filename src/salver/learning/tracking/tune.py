"""A robot that does not do what it is told: its command corrected, then a margin bought for the rest, or a refusal.

1. What the joints missed is added to what they are told (iterative learning; Arimoto, Kawamura and Miyazaki 1984, with
   a low pass that does not shift, as Bristow, Tharayil and Alleyne 2006 advise), again and again while it helps.
2. What repeats itself but cannot be commanded away is paid for: `contact.margin` is raised by 1.1 times the excess and
   its uncertainty, and the motion planned again.
3. Where that asks too much, the robot is refused, with the joint and the reason.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.interpolate import make_interp_spline

from salver.errors import ScenarioError
from salver.learning.tracking.executed import low_passed
from salver.learning.tracking.track import Judge, Tracking, track
from salver.models.arm.arm import load_arm
from salver.motion_files import JointSamples
from salver.motion_files.samples import joint_samples
from salver.planning.make import make_plan
from salver.planning.plan import COMMAND_LEAD, Plan
from salver.simulation.physics import Experiment
from salver.trajectory import JointMotion, smooth_step


@dataclass(frozen=True)
class TuningOptions:
    """Options of tuning a robot, and limits at which it is refused.

    Attributes:
        gain: share of what was missed that is added to the command; at twice the default corrections overshoot.
        fastest: Hz up to which is corrected; doubled, what differs from run to run is amplified.
        tail: s over which a correction ends after the motion.
        corrections: of one plan at most; doubled, twice the runs.
        helps: share of the excess that a correction leaves, at most, to be followed by another.
        replans: plans with another margin, at most.
        dearest: of the weight, the largest margin: it costs a fifth of the speed.
    """

    gain: float = 0.9
    fastest: float = 12.0
    tail: float = 0.2
    corrections: int = 6
    helps: float = 0.8
    replans: int = 4
    dearest: float = 0.12


Carry = Callable[[Plan], JointSamples]
Next = Literal["done", "command", "margin", "refused"]


@dataclass(frozen=True, eq=False)
class TuningRun:
    """One run. tracking: of what, and what came of it. next: what is done about it: nothing ("done"), another command,
    another plan with a margin, or the robot is refused; sentence: in words. then: the plan to go on with; None when
    refused.
    """

    number: int
    tracking: Tracking
    next: Next
    sentence: str
    then: Plan | None

    @property
    def plan(self) -> Plan:
        """The commanded plan."""
        return self.tracking.plan


def engine_robot(plan: Plan, seed: int = 0) -> JointSamples:
    """The robot of the scenario's [physics], in the engine, with the nominal load strapped to its tray: its log."""
    t, q = Experiment(plan).joint_log(seed=seed)
    assert plan.scenario.arm is not None
    names = tuple(load_arm(plan.scenario.arm, plan.scenario.tray).joint_names)
    return joint_samples(t, names, q, None, None, "the robot in the engine")


def tune(plan: Plan, carry: Carry, options: TuningOptions | None = None) -> Iterator[TuningRun]:
    """Runs until what is executed keeps the load at every parameter of the set, or the robot is refused.

    carry: does a plan (`Plan.told`) with the load strapped to the tray, and gives the log of the joints. Raises
    ScenarioError for a plan that has no arm's motion or whose loop is not closed on the joints, FileFormatError for a
    log that is not of the plan.
    """
    _tunable(plan)
    options = options or TuningOptions()
    judge, replans, number = Judge.of(plan.scenario), 0, 0
    while True:
        best: Tracking | None = None
        for _ in range(options.corrections + 1):
            number += 1
            seen = track(plan, carry(plan), judge)
            if seen.ok:
                yield _done(number, seen)
                return
            helped = best is None or seen.excess + seen.uncertainty < options.helps * (best.excess + best.uncertainty)
            best = seen if best is None or seen.row < best.row else best
            if not helped:
                break
            made = _commanded(number, seen, options)
            yield made
            assert made.then is not None
            plan = made.then
        assert best is not None
        made = _bought(number, seen, best, replans, options)
        yield made
        if made.then is None:
            return
        plan, judge, replans = made.then, Judge.of(made.then.scenario), replans + 1


def step(plan: Plan, log: JointSamples) -> TuningRun:
    """One run, from a log of a plan with its command. A plan that has been commanded and still misses what it may
    not is given a margin."""
    _tunable(plan)
    seen = track(plan, log)
    if seen.ok:
        return _done(1, seen)
    options = TuningOptions()
    return _commanded(1, seen, options) if plan.command is None else _bought(1, seen, seen, 0, options)


def _done(number: int, seen: Tracking) -> TuningRun:
    told = f"What was executed keeps the load for every load of the ranges. {beyond_limits(seen.plan)}".rstrip()
    return TuningRun(number, seen, "done", told, seen.plan)


def beyond_limits(plan: Plan) -> str:
    """The maker's limits that a plan's command exceeds, in words; empty if none, or without a command."""
    if plan.command is None or plan.scenario.arm is None:
        return ""
    limits, told = load_arm(plan.scenario.arm, plan.scenario.tray).limits, plan.command
    t = np.arange(0.0, told.duration, 1e-3)
    q, dq, ddq = told.sample(t)
    shares = limits.shares({"position": q, "velocity": dq, "acceleration": ddq, "jerk": told.jerk(t)})
    over = [f"{100 * float(np.abs(x).max()):.0f} % of {key}" for key, x in shares.items() if np.abs(x).max() > 1]
    return f"The command asks for {', '.join(over)} that the maker allows: the robot may not take it." if over else ""


def _commanded(number: int, seen: Tracking, options: TuningOptions) -> TuningRun:
    return TuningRun(number, seen, "command", f"The command is corrected: {seen.cause}.", corrected(seen, options))


def _bought(number: int, seen: Tracking, best: Tracking, replans: int, options: TuningOptions) -> TuningRun:
    margin = best.margin
    again = None if replans >= options.replans or margin > options.dearest else with_margin(best.plan, margin)
    if again is None or not again.ok:
        return TuningRun(number, seen, "refused", _refusal(best, margin, again, replans, options), None)
    told = f"Corrections leave {100 * best.excess:.1f} % of the weight: a margin of {100 * margin:.1f} % is bought."
    return TuningRun(number, seen, "margin", told, again)


def _tunable(plan: Plan) -> None:
    scenario = plan.scenario
    if plan.joint is None:
        raise ScenarioError(
            f"{scenario.name}: this plan has no arm that moves; a robot is tuned by the joints it moves."
        )
    if plan.stops is not None:
        raise ScenarioError(
            f"{scenario.name}: this plan has stops, which know nothing of a corrected command; plan without --stops."
        )
    if plan.space != "joint" and scenario.physics.robot.control == "torque":
        raise ScenarioError(
            f"{scenario.name}: salver's own controller follows the object with this plan ({plan.method}), not the "
            "joints, so no command of joints can be corrected; plan with --fastest, or give physics.robot.control = "
            '"position".'
        )


def with_margin(plan: Plan, margin: float) -> Plan | None:
    """Planned again with `contact.margin`, of the weight; None for plans that know no such margin."""
    scenario = plan.scenario
    if plan.method != "fastest" and (plan.method != "robust" or scenario.contact.condition != "exact"):
        return None
    return make_plan(scenario.with_changes(contact__margin=margin), plan.method)


def _refusal(seen: Tracking, margin: float, again: Plan | None, replans: int, options: TuningOptions) -> str:
    """Why this robot cannot carry this plan."""
    why = f"this robot is refused: what it does exceeds the plan by {100 * seen.excess:.1f} % of the weight"
    if again is not None:
        why += f", and with a margin of {100 * margin:.1f} % no safe motion was found ({again.status.sentence})"
    elif margin > options.dearest:
        why += f"; a margin of {100 * margin:.2f} % is more than the {100 * options.dearest:.0f} % that are bought"
    elif replans >= options.replans:
        why += f" after {replans} margins bought"
    else:
        why += f"; a plan by this method ({seen.plan.method}) knows no such margin"
    return f"{why[0].upper()}{why[1:]}. The cause: {seen.cause}."


def corrected(seen: Tracking, options: TuningOptions | None = None) -> Plan:
    """The plan with the next command: what was missed is added to what was commanded.

    The command begins `COMMAND_LEAD` s before the plan does, so that a correction may begin before it is needed, and
    goes on until the arm is where it should be.
    """
    options, plan, done = options or TuningOptions(), seen.plan, seen.done
    joint, before, tail = plan.joint, plan.command, options.tail
    assert joint is not None
    t = np.linspace(-COMMAND_LEAD, joint.duration + tail, 1 + round((COMMAND_LEAD + joint.duration + tail) / 0.004))
    slow = low_passed(done.off, done.step, options.fastest)[0]
    missed = make_interp_spline(done.t, slow, k=3)(np.clip(t, done.t[0], done.t[-1]))
    # Where the arm rests before, it is not moved: what it misses there, as it sags, is put right on the way. Where it
    # rests after, it stays.
    rest = done.off[done.t <= 0.0].mean(axis=0), done.off[done.t > done.t[-1] - 0.04].mean(axis=0)
    begun, over = smooth_step(1 + t / COMMAND_LEAD)[:, None], smooth_step((t[-1] - t) / tail)[:, None]
    missed = begun * (missed - rest[0]) + smooth_step(t / joint.duration)[:, None] * rest[0]
    missed = over * missed + (1 - over) * rest[1]
    change = make_interp_spline(t, -options.gain * missed, k=5)
    q, dq, ddq = joint.sample(t) if before is None else before.sample(t + COMMAND_LEAD)
    q, dq, ddq = q + change(t), dq + change(t, 1), ddq + change(t, 2)
    dq[[0, -1]], ddq[[0, -1]] = 0.0, 0.0  # it begins and ends at rest, to the splines' accuracy
    return replace(plan, command=JointMotion(t + COMMAND_LEAD, q, dq, ddq))
