"""Tuning of a robot that does not follow its command: correction of the command, then more margin, or refusal.

1. The tracking error is added to the command (iterative learning control; Arimoto, Kawamura and Miyazaki 1984, with a
   zero-phase low-pass filter, as Bristow, Tharayil and Alleyne 2006 advise), repeatedly as long as it helps.
2. For the remaining error `contact.margin` is raised by 1.1 times the excess with its uncertainty, and the motion is
   planned again.
3. If that needs too much margin, the robot is refused, with the joint and the reason.
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
        gain: share of the tracking error that is added to the command; at twice the default corrections overshoot.
        fastest: Hz, up to which errors are corrected; doubled, random errors are amplified.
        tail: s over which a correction ends after the motion.
        corrections: largest number for one plan; doubled, twice the runs.
        helps: ratio of excess after and before a correction below which another correction follows.
        replans: largest number of plans with another margin.
        dearest: largest margin, as a share of the weight; it costs a fifth of the speed.
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
    """One run of tuning.

    tracking: result of the run. next: "done", "command" (the command is corrected), "margin" (planned again with more
    margin) or "refused". sentence: next in words. then: the next plan; None if the robot is refused.
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
    """Log of the scenario's simulated robot ([physics]) with the nominal load fixed to its tray."""
    t, q = Experiment(plan).joint_log(seed=seed)
    assert plan.scenario.arm is not None
    names = tuple(load_arm(plan.scenario.arm, plan.scenario.tray).joint_names)
    return joint_samples(t, names, q, None, None, "the robot in the engine")


def tune(plan: Plan, carry: Carry, options: TuningOptions | None = None) -> Iterator[TuningRun]:
    """Tune, run by run, until the executed motion keeps every load in the ranges, or the robot is refused.

    carry: runs the command of a plan with the load fixed to the tray, and returns the log of the joints. Raises
    ScenarioError for a plan without a joint motion or with a loop on the object's pose, FileFormatError for a log that
    is not of the plan.
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
    """One run of tuning, from a log of a plan; a plan with a corrected command that still has an excess is planned with
    more margin."""
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
        raise ScenarioError(f"{scenario.name}: this plan has no motion of an arm; tuning corrects joint commands.")
    if plan.stops is not None:
        raise ScenarioError(
            f"{scenario.name}: this plan has stops, which do not support a corrected command; plan without --stops."
        )
    if plan.space != "joint" and scenario.physics.robot.control == "torque":
        raise ScenarioError(
            f"{scenario.name}: salver's own controller follows the object with this plan ({plan.method}), not the "
            "joints, so no command of joints can be corrected; plan with --fastest, or give physics.robot.control = "
            '"position".'
        )


def with_margin(plan: Plan, margin: float) -> Plan | None:
    """The plan made again with `contact.margin`, as a share of the weight; None for methods without that margin."""
    scenario = plan.scenario
    if plan.method != "fastest" and (plan.method != "robust" or scenario.contact.condition != "exact"):
        return None
    return make_plan(scenario.with_changes(contact__margin=margin), plan.method)


def _refusal(seen: Tracking, margin: float, again: Plan | None, replans: int, options: TuningOptions) -> str:
    """The reason of a refusal, in a sentence."""
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
    """The plan with the next command: the last command plus the tracking error.

    The command begins `COMMAND_LEAD` s before the plan, so that corrections can begin earlier, and continues until the
    arm has reached its goal.
    """
    options, plan, done = options or TuningOptions(), seen.plan, seen.done
    joint, before, tail = plan.joint, plan.command, options.tail
    assert joint is not None
    t = np.linspace(-COMMAND_LEAD, joint.duration + tail, 1 + round((COMMAND_LEAD + joint.duration + tail) / 0.004))
    slow = low_passed(done.off, done.step, options.fastest)[0]
    missed = make_interp_spline(done.t, slow, k=3)(np.clip(t, done.t[0], done.t[-1]))
    # At rest before the motion the arm is not moved, so that its static deflection is corrected during the motion; at
    # rest after the motion it stays.
    rest = done.off[done.t <= 0.0].mean(axis=0), done.off[done.t > done.t[-1] - 0.04].mean(axis=0)
    begun, over = smooth_step(1 + t / COMMAND_LEAD)[:, None], smooth_step((t[-1] - t) / tail)[:, None]
    missed = begun * (missed - rest[0]) + smooth_step(t / joint.duration)[:, None] * rest[0]
    missed = over * missed + (1 - over) * rest[1]
    change = make_interp_spline(t, -options.gain * missed, k=5)
    q, dq, ddq = joint.sample(t) if before is None else before.sample(t + COMMAND_LEAD)
    q, dq, ddq = q + change(t), dq + change(t, 1), ddq + change(t, 2)
    dq[[0, -1]], ddq[[0, -1]] = 0.0, 0.0  # it begins and ends at rest, to the splines' accuracy
    return replace(plan, command=JointMotion(t + COMMAND_LEAD, q, dq, ddq))
