"""Checks before an arm moves; each is a sentence, whether it passes or not.

They judge the joint motion that will be sent, also between its samples, and not the verdict in its files. NaN never
passes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from salver.contact_margins import margins
from salver.errors import SalverError
from salver.geometry import log
from salver.models.arm.arm_geometry import arm_geometry
from salver.models.described import Wall
from salver.models.tray_motion import FULL_SPEED
from salver.motion_files.verdict import UNSAFE
from salver.planning.follow.clearance import sweep
from salver.planning.follow.forward import tray_motion
from salver.planning.follow.limits import BETWEEN, verdict
from salver.planning.stops import stop_problem, verdicts
from salver.planning.verdict.judged import PLANNED
from salver.planning.verdict.verify import verify
from salver.trajectory import JointMotion, MotionSamples

if TYPE_CHECKING:
    from collections.abc import Sequence

    from salver.control.arm import ArmState
    from salver.models.arm.arm import ArmModel
    from salver.models.bodies import Body
    from salver.planning.plan import Plan


@dataclass(frozen=True)
class PreflightOptions:
    """Tolerances of the checks, and the instants at which a motion is judged.

    posture, posture_rate: largest difference of each joint from the start of the motion, rad, and largest velocity,
    rad/s. still: largest velocity and acceleration at the ends of the motion, rad/s and rad/s^2: rounding. reference:
    largest difference between the object's reference and its motion by the joints: m and rad, m/s and rad/s, m/s^2 and
    rad/s^2; plans keep 1e-3 of it. step: largest time between instants, s; pieces: least number of pieces between two
    samples. longest: largest duration, s; samples are limited to that duration over `step`.
    """

    posture: float = 0.01
    posture_rate: float = 0.01
    still: float = 1e-6
    reference: tuple[float, float, float] = (1e-5, 1e-4, 1e-2)
    step: float = 1e-3
    pieces: int = 4
    longest: float = 600.0


STANDARD = PreflightOptions()


@dataclass(frozen=True)
class Check:
    """A check. required: whether its failure prevents the run."""

    name: str
    ok: bool
    sentence: str
    required: bool = True


def check_plan(
    plan: Plan,
    arm: ArmModel,
    bodies: Sequence[Body],
    full_speed_only: bool = False,
    options: PreflightOptions = STANDARD,
) -> list[Check]:
    """Checks that need no robot. The plan must have a joint motion.

    full_speed_only: whether to accept a plan that does not keep its load at every speed.
    """
    assert plan.joint is not None
    numbers = _numbers(plan, arm, options)
    if not numbers.ok:  # NaN: nothing can be computed
        return [numbers]
    motion, failed = looked_at(plan.joint, options), plan.verdict.removeprefix(f"{UNSAFE}: ")
    given = tray_motion(arm, motion).of_frame(bodies[0].p_EB, bodies[0].R_EB)
    return [
        numbers,
        Check("plan", plan.ok, plan.verification.sentence if plan.ok else f"The plan is not safe: {failed}"),
        *_arm(plan.joint, arm, bodies, plan, options),
        _reference(plan, given, options.reference),
        _verdict(plan, given),
        _speeds(plan, full_speed_only),
        _rest(plan.joint, options.still),
        Check(
            "feedback",
            plan.scenario.physics.feedback == "joints",
            f'physics.feedback is "{plan.scenario.physics.feedback}"; without a live measurement of the object it must '
            'be "joints".',
        ),
        _stops(plan, arm),
    ]


def looked_at(joint: JointMotion, options: PreflightOptions = STANDARD) -> JointMotion:
    """The motion resampled at the instants at which it is judged."""
    pieces = np.maximum(options.pieces, np.ceil(np.diff(joint.t) / options.step)).astype(int)
    t, z = joint.evenly(pieces)
    return JointMotion(t, *z[:3])


def _numbers(plan: Plan, arm: ArmModel, options: PreflightOptions) -> Check:
    """Samples are finite, with one value per joint, at times that increase from 0."""
    joint = plan.joint
    assert joint is not None

    def check(wrong: str) -> Check:
        good = f"{len(joint.t)} samples of {arm.n} joints, all of them numbers, at times that increase."
        return Check("numbers", not wrong, f"The joint motion is not usable: {wrong}." if wrong else good)

    arrays = {"joint_t": joint.t, "joint_q": joint.q, "joint_dq": joint.dq, "joint_ddq": joint.ddq}
    for name, array in arrays.items():
        wanted = (len(joint.t),) if name == "joint_t" else (len(joint.t), arm.n)
        if array.dtype.kind != "f" or array.shape != wanted or len(joint.t) < 2:
            return check(f"{name} is an array of {array.dtype.name} of shape {array.shape}")
        if not np.all(np.isfinite(array)):
            return check(f"{name} holds {array[~np.isfinite(array)][0]} where a number must be")
    if joint.t[0] != 0 or not np.all(np.diff(joint.t) > 0):
        return check("joint_t does not increase from 0")
    if not joint.duration + len(joint.t) * options.step < options.longest:
        return check(f"{len(joint.t)} samples over {joint.duration:.6g} s are more than can be judged")
    if not abs(plan.duration - joint.duration) < 1e-9:
        return check(f"it lasts {joint.duration:.6g} s and the object's motion {plan.duration:.6g} s")
    samples = plan.reference.sample(looked_at(joint, options).t)
    for name, array in vars(samples).items():
        if not np.all(np.isfinite(array)):
            return check(f"{name} of the object's motion holds what is no number")
    return check("")


def _arm(
    joint: JointMotion, arm: ArmModel, bodies: Sequence[Body], plan: Plan, options: PreflightOptions = STANDARD
) -> list[Check]:
    """Limits, and the arm against itself, its tray, its load and the scenario's obstacles."""
    parts, motion = arm_geometry(arm, bodies, plan.scenario.around), looked_at(joint, options)
    status, swept = verdict(arm, joint, bodies, parts, BETWEEN, motion.t), sweep(parts, motion)
    near, touch = swept.nearest, swept.touch
    walls = dict.fromkeys(f", the {one.name}" for one in plan.scenario.around if isinstance(one, Wall))
    around = f"{''.join(walls)} and {len(plan.scenario.obstacles) or 'no'} obstacles"
    if near is None:
        sentence = "Nothing is known of the arm's shape, so collisions cannot be excluded."
    elif touch is not None:
        sentence = f"{touch.first} and {touch.second} touch at t = {touch.time:.2f} s."
    else:
        blind = f"Not looked at: {'; '.join(parts.unchecked)}. " if parts.unchecked else ""
        sentence = (
            f"{blind}Arm, tray, load{around} keep apart all along; nearest are {near.first} and {near.second}, "
            f"{1e3 * near.distance:.1f} mm at t = {near.time:.2f} s."
        )
    return [
        Check("limits", status.ok, status.sentence),
        Check("clearance", near is not None and touch is None, sentence),
    ]


def _reference(plan: Plan, given: MotionSamples, allowed: tuple[float, float, float]) -> Check:
    """The object's reference agrees with the joint motion."""
    wanted = plan.reference.sample(given.t)
    turn = log(np.swapaxes(given.R_SB, 1, 2) @ wanted.R_SB)
    differences = {
        "m, rad": (given.p_SB - wanted.p_SB, turn),
        "m/s, rad/s": (given.v_S - wanted.v_S, given.omega_B - wanted.omega_B),
        "m/s^2, rad/s^2": (given.a_S - wanted.a_S, given.alpha_B - wanted.alpha_B),
    }
    off = [max(float(np.abs(x).max()) for x in pair) for pair in differences.values()]
    worst = int(np.argmax(np.divide(off, allowed)))
    return Check(
        "reference",
        bool(np.all(np.less_equal(off, allowed))),
        f"The object's motion in the plan and where its joints take it differ by {off[worst]:.2g} "
        f"{list(differences)[worst]}; {allowed[worst]:g} are allowed.",
    )


def _verdict(plan: Plan, given: MotionSamples) -> Check:
    """Every constraint of the task at full speed, in the worst case of the uncertain set. An arm whose controller
    closes its loop on the object's pose is taken to follow exactly: the verdict does not know how it strays then. With
    load dynamics contacts and loads are judged along the joints' motion, as the plan's own check does."""
    assert plan.joint is not None
    if plan.scenario.payload.dynamic:
        status = margins(plan.scenario, given).verdict(worst=True)
        return Check("verdict", status.ok, status.sentence)
    problem = replace(stop_problem(plan), speeds=(FULL_SPEED,))
    if plan.space == "object":
        problem = replace(problem, tracking=None)
    found = verify(problem, plan.joint, None, PLANNED)
    good = "Load and arm keep every constraint of the task, in the worst case of the uncertain set."
    return Check("verdict", found.ok, good if found.ok else f"The motion is not safe: {found.sentence}.")


def _speeds(plan: Plan, full_speed_only: bool) -> Check:
    """Whether the load stays in place when the robot's own controller scales the speed."""
    speeds = plan.speeds
    sentence = speeds.sentence
    if not speeds.every:
        sentence += (
            " It is sent as it is, at full speed."
            if full_speed_only
            else " Where nothing on the way to the motors scales its speed, --full-speed-only sends it."
        )
    return Check("speeds", speeds.every or full_speed_only, sentence)


def _stops(plan: Plan, arm: ArmModel) -> Check:
    """Whether the plan can be stopped with the load in its place, and whether the stored stops fit the plan."""
    stops, joint = plan.stops, plan.joint
    if stops is None or joint is None:
        return Check(
            "stops",
            False,
            "The plan has no load-safe stops: when it is stopped the arm brakes without regard to the load, which may "
            "fall; plan with --stops.",
            required=False,
        )
    count, n = len(stops.t), arm.n
    shapes = {"q": (count, len(stops.s), n), "stray": (count + 1, n), "duration": (count,), "s": stops.s.shape}
    shapes |= {"dq": shapes["q"], "ddq": shapes["q"], "t": (count,)}
    for name, shape in shapes.items():
        array = getattr(stops, name)
        if array.dtype.kind != "f" or array.shape != shape or not np.all(np.isfinite(array)):
            return Check(
                "stops", False, f"The plan's stops are not usable: stop_{name} is not an array of numbers {shape}."
            )
    in_time = np.all(np.diff(stops.t) > 0) and np.all((stops.t > 0) & (stops.t < joint.duration))
    if not in_time or not np.all(stops.duration > 0) or stops.s[0] != 0 or not np.all(np.diff(stops.s) > 0):
        return Check("stops", False, "The plan's stops are not usable: their times do not increase within the plan.")
    for now, found in verdicts(plan):
        if not found.ok:
            return Check("stops", False, f"The stop from {now:.2f} s is not safe: {found.sentence}.")
    return Check("stops", True, stops.sentence)


def _rest(joint: JointMotion, allowed: float) -> Check:
    still = max(float(np.abs(x[[0, -1]]).max()) for x in (joint.dq, joint.ddq))
    return Check(
        "rest",
        bool(still <= allowed),
        f"The motion starts and ends with a joint rate of {still:.1g} rad/s or rad/s^2; it must be at rest there.",
    )


def check_posture(
    joint: JointMotion, arm: ArmModel, state: ArmState, options: PreflightOptions = STANDARD
) -> list[Check]:
    """Whether the arm stands at the start of the motion, at rest."""
    start = joint.q[0]
    q, dq = state.q, state.dq
    if q.shape != start.shape or dq.shape != start.shape or not np.all(np.isfinite([q, dq])):
        return [Check("state", False, "The arm does not report numbers for the positions and speeds of its joints.")]
    error = np.abs(q - start)
    j, k = int(np.argmax(error)), int(np.argmax(np.abs(dq)))
    rate = f"{arm.unit(k)}/s"
    return [
        Check(
            "start posture",
            bool(error[j] <= options.posture),
            f"{arm.joint_names[j]} is at {q[j]:.4f} {arm.unit(j)}, the motion starts at {start[j]:.4f} {arm.unit(j)}; "
            f"{options.posture:g} {arm.unit(j)} apart are allowed (--move-to-start takes the arm there, slowly).",
        ),
        Check(
            "at rest",
            bool(abs(dq[k]) <= options.posture_rate),
            f"{arm.joint_names[k]} moves at {dq[k]:.4f} {rate}; {options.posture_rate:g} {rate} are allowed.",
        ),
    ]


def check_approach(joint: JointMotion, plan: Plan, arm: ArmModel) -> list[Check]:
    """The way to the start posture, with an empty tray: limits, and clear of the arm itself and of obstacles."""
    return [Check(f"way there: {c.name}", c.ok, c.sentence) for c in _arm(joint, arm, (), plan)]


def demand(checks: Sequence[Check]) -> None:
    """Raise SalverError with the sentences of what failed."""
    failed = [check.sentence for check in checks if check.required and not check.ok]
    if failed:
        raise SalverError("Not moved. " + " ".join(failed))
