"""`salver execute`: a plan on an arm, real or simulated, with checks before the motion and a log after it."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from salver.control.arm import ArmController, ArmState, controller_for
from salver.driver.execution import Drive, ExecutionLog, Watchdog, named
from salver.driver.logs import arrays_of, check_place, keep, summary_of
from salver.driver.preflight import STANDARD as PREFLIGHT
from salver.driver.preflight import Check, PreflightOptions, check_approach, check_plan, check_posture, demand
from salver.driver.robots.robots import Robot, robot_class
from salver.driver.robots.simulated import SimulatedRobot
from salver.driver.signals import Signals, noted_signals
from salver.driver.stops import StopFrom, stops_of
from salver.errors import SalverError, UnreachableError
from salver.geometry import Array
from salver.models.arm.arm import ArmModel
from salver.models.bodies import Body
from salver.planning.plan import Plan, load_plan
from salver.trajectory import JointMotion, smooth_step

APPROACH_SHARE = 0.1  # of the velocity limits on the way to the start posture
# Of a simulated run, what is logged: figures and arrays.
JUDGED = ("outcome", "objects", "e_p_peak", "e_o_peak")
RECORDED = (
    "t", "q", "dq", "tau", "p_SE", "quat_SE_wxyz", "p_SB", "quat_SB_wxyz", "slip_E", "slip", "lift", "tip_angle",
    "contact_points_B", "contact_forces_B", "cone_coefficients", "e_p", "e_o", "tray_e_p", "tray_e_o",
)  # fmt: skip


@dataclass(frozen=True)
class Execution:
    """A run on an arm. arrays, summary: content of the log. checks: those of the pre-flight. path: path of the log."""

    arrays: dict[str, np.ndarray]
    summary: dict[str, Any]
    checks: list[Check] = field(default_factory=list)
    path: Path = Path()

    @property
    def achieved(self) -> bool:
        """The motion ran to its end, nothing slipped as far as is known, and not all that was requested was refused."""
        requests = self.summary.get("requests", {})
        in_vain = any(requests.values()) and not requests["accepted"]
        return not self.summary["stopped"] and self.summary["outcome"] in ("holds", "done") and not in_vain


def run_plan(
    directory: str | Path,
    robot: str = "simulated",
    address: str = "",
    stem: str = "plan",
    watchdog: Watchdog | None = None,
    *,
    move_to_start: bool = False,
    realtime: bool = True,
    full_speed_only: bool = False,
    confirm: Callable[[list[Check]], bool] = lambda checks: True,
    signals: Signals | None = None,
    preflight: PreflightOptions = PREFLIGHT,
    options: Any = None,
) -> Execution:
    """Run a plan on an arm.

    robot: a name of `salver.driver.robots.robots.ROBOTS`; "simulated" runs the very loop that drives a real one, in
    real time. confirm: called with the checks after all of them passed, before anything moves; False ends the run.
    signals: through which the caller may ask for a stop (`Signals.note`), from another thread.
    move_to_start: go to the start posture first, at a tenth of the speed limits, with nothing on the tray.
    full_speed_only: run also a plan that does not keep its load at every speed.
    preflight: tolerances of the checks. options: the robot's options, such as `UROptions` or `FrankaOptions`. Raises
    SalverError when a check fails or the arm refuses, UnreachableError when the plan has no joint motion,
    MissingDependencyError without the robot's library.
    """
    kind = robot_class(robot)
    plan, arm, carried = _prepared(directory, stem)
    checks = check_plan(plan, arm, carried, full_speed_only, preflight)
    demand(checks)
    checks.append(check_place(Path(directory)))
    checks += kind.check(plan.scenario, arm, _motion(plan))
    demand(checks)  # before the arm is even connected
    driven: Robot
    if kind is SimulatedRobot:
        driven = kind.of(plan, arm, realtime)
    else:
        driven = kind.connect(address, plan.scenario, arm, realtime, options)
    if why := driven.permit(_motion(plan)):
        raise SalverError(f"Not moved. {why}")
    watchdog = watchdog or Watchdog()
    posture = check_posture(_motion(plan), arm, driven.look(), preflight)
    if move_to_start:
        demand([check for check in posture if check.name == "state"])
        start = _motion(plan).q[0]
        checks += check_approach(approach(driven.look().q, start, arm), plan, arm)
        demand(checks)
        if not confirm([*checks, *posture]):
            raise SalverError("The arm was not moved: you did not confirm.")
        driven.move(lambda q: approach(q, start, arm))
        posture = check_posture(_motion(plan), arm, driven.look(), preflight)
    checks += posture
    demand(checks)
    if not confirm(checks):
        raise SalverError("The arm was not moved: you did not confirm.")
    began = time.perf_counter()
    with noted_signals():  # nothing may come between the run and its log
        log_ = _run(plan, arm, carried, driven, watchdog, -plan.scenario.physics.settle_before, signals)
        summary = summary_of(plan, driven, log_, checks, watchdog)
        arrays = arrays_of(arm, log_, driven)
        if isinstance(driven, SimulatedRobot):
            arrays, summary = seen_in_the_engine(driven, began, arrays, {**summary, "realtime": realtime})
        return Execution(arrays, summary, checks, keep(Path(directory), stem, arrays, summary))


def seen_in_the_engine(
    robot: SimulatedRobot,
    began: float,
    arrays: dict[str, np.ndarray],
    summary: dict[str, Any],
    plan: Plan | None = None,
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The log of a simulated run, with the outcome of the load. plan: as in `SimulatedRobot.record`."""
    try:
        record = robot.record({"with_arm": True}, began, plan)
    except BaseException as error:  # too short a run, an engine that diverged: the log comes first
        return arrays, {**summary, "load": f"What became of the load was not measured ({named(error)})."}
    known = {key: record.summary[key] for key in JUDGED if key in record.summary}
    return {name: np.asarray(getattr(record, name)) for name in RECORDED}, {**summary, **known}


def _prepared(directory: str | Path, stem: str) -> tuple[Plan, ArmModel, Sequence[Body]]:
    plan = load_plan(directory, stem)
    arm = plan.scenario.load_arm()
    if plan.joint is None:
        why = plan.no_arm_motion
        raise UnreachableError(f"{plan.scenario.name} has no joint motion to execute: {why}")
    return plan, arm, plan.scenario.payload.bodies


def _motion(plan: Plan) -> JointMotion:
    assert plan.joint is not None  # `_prepared` refuses a plan without
    return plan.joint


def _run(
    plan: Plan,
    arm: ArmModel,
    carried: Sequence[Body],
    robot: Robot,
    watchdog: Watchdog,
    start: float,
    signals: Signals | None,
) -> ExecutionLog:
    joint = _motion(plan)
    controller = controller_for(plan.scenario, joint, plan.reference, arm=arm, space=plan.space)
    stop_from = stops_of(plan, controller, arm, carried, watchdog.stop)
    _warm_up(controller, stop_from, joint)
    end = plan.duration + plan.scenario.physics.settle_after
    speed_rate = plan.scenario.motion.speed_rate if plan.speeds.every else None
    drive = Drive(
        robot, controller, joint, arm, carried, start, end, watchdog, stop_from, signals or Signals(), speed_rate
    )
    return drive.run()


def _warm_up(controller: ArmController, stop_from: StopFrom, joint: JointMotion) -> None:
    """First calls load code and fill caches; they must not happen in the loop."""
    for t in (0.0, 0.5 * joint.duration):
        q, dq, _ = joint.sample(t)
        state = ArmState(q[0], dq[0])
        for _ in range(50):
            controller.step(state, t)
        stop = stop_from(state, t)
        for s in (0.0, stop.duration):
            stop.step(state, s)
    controller.reset()


def approach(q_from: Array, q_to: Array, arm: ArmModel) -> JointMotion:
    """A quintic from rest to rest that keeps every joint below `APPROACH_SHARE` of its velocity and acceleration
    limits."""
    away = np.abs(q_to - q_from)
    by_speed = 1.875 * away / (APPROACH_SHARE * arm.limits.velocity)  # steepest slope of the quintic step
    by_force = np.sqrt(5.7735 * away / (APPROACH_SHARE * arm.limits.acceleration))  # and its largest curvature
    duration = max(0.5, float(by_speed.max()), float(np.where(np.isfinite(by_force), by_force, 0.0).max()))
    x = np.linspace(0.0, 1.0, 101)[:, None]
    change, rate, bend = ((q_to - q_from) * smooth_step(x, k) / duration**k for k in range(3))
    return JointMotion(duration * x[:, 0], q_from + change, rate, bend)
