"""`salver execute --live`: an arm that follows requests while it moves, real or simulated.

The loop, its watchdog, the gate and the log are those of a plan (`salver.driver.execution`). It follows a live motion,
which is planned in another process and committed in this one, together with its stops. So the load is brought to rest
after any error, even if the planner's process has died.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from contextlib import nullcontext
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from salver.control.arm import ArmController, ArmState, controller_for
from salver.driver.execute import Execution, seen_in_the_engine
from salver.driver.execution import Drive, ExecutionLog, Watchdog, named
from salver.driver.gate import Gate
from salver.driver.logs import arrays_of, check_place, keep, summary_of
from salver.driver.preflight import Check, check_plan, check_posture, demand
from salver.driver.robots.robots import Robot, robot_class
from salver.driver.robots.simulated import SimulatedRobot
from salver.driver.sensing import Sensed
from salver.driver.signals import Signals, noted_signals
from salver.driver.stops import Along, Stop, StopOptions
from salver.errors import SalverError, Status
from salver.files import provenance
from salver.geometry import Array, quat_wxyz_from_matrix
from salver.live import Live, LiveCourse, Worker
from salver.live.committed.motion import SAME
from salver.live.options import LiveOptions
from salver.live.script import Prompter, ScriptOptions, script
from salver.live.standing import live_scenario
from salver.models.arm.arm import ArmModel, with_load
from salver.models.arm.arm_limits import JointLimits
from salver.models.arm.tables import ArmLimits
from salver.planning import plan_files
from salver.planning.fastest import joint_plan, transport_problem
from salver.planning.plan import Plan
from salver.scenario import Scenario
from salver.trajectory import JointMotion


@dataclass(frozen=True)
class LiveRunOptions:
    """Options of a run that follows a live motion.

    longest: largest duration of a run, s. ending: s before that at which it is stopped, to be at rest then.
    patience: s after the last request, at rest, in which the planner may still find a motion for it.
    resting: duration, s, of the motion at rest that is committed before the first request.
    lead, every, planning: without real time, when the arm waits for the planner: s to a hand-over; periods between two
    calls of the planner; time limit of planning, s, so large that a busy machine does not change the result.
    script: limits of the script's lines. live: options of the live motion, which records the whole run for its plan.
    """

    longest: float = 120.0
    ending: float = 5.0
    patience: float = 10.0
    resting: float = 0.5
    lead: float = 0.1
    every: int = 20
    planning: float = 60.0
    script: ScriptOptions = field(default_factory=ScriptOptions)
    live: LiveOptions = field(default_factory=LiveOptions)

    @property
    def kept(self) -> LiveOptions:
        """Options of the live motion, whose record is as long as the longest run."""
        return replace(self.live, record=max(self.live.record, self.longest))


STANDARD = LiveRunOptions()


def commanded(scenario: Scenario, joint: JointMotion) -> Plan:
    """The commanded motion, from rest to rest, as a plan that is judged like any joint motion."""
    q = joint.q
    first, arm = scenario.payload.bodies[0], scenario.load_arm()
    ends: dict[str, Any] = {"arm__start_posture": q[0].tolist()}
    for name, posture in (("start", q[0]), ("goal", q[-1])):
        p, R = arm.object_pose(posture, first.p_EB, first.R_EB)
        ends[f"motion__{name}"] = {"position": p.tolist(), "quat_wxyz": quat_wxyz_from_matrix(R).tolist()}
    moved = live_scenario(scenario).with_changes(**ends)
    status = Status("recorded", "This is what was commanded.", True)
    return joint_plan(moved, transport_problem(moved), joint, status, {}, method="live")


class LiveStop(Along):
    """The rest of the committed motion, or the earliest stop from it that is ready or can be planned."""

    def __init__(self, live: Live, course: LiveCourse, controller: ArmController, loaded: ArmModel, state: ArmState,
                 begun: float, options: StopOptions) -> None:  # fmt: skip
        """begun: s of the loop's time, now."""
        self._live, self._course, self._controller, self._begun = live, course, controller, begun
        super().__init__(loaded, (controller.gains.kp[0], controller.gains.kd[0]), state, options)

    @property
    def allowed(self) -> Array:
        return self._live.stray

    @property
    def rests(self) -> float:
        live = self._live
        return live.committed.ends - live.now + self._course.t - self._begun

    def following(self, state: ArmState, s: float) -> Array | None:
        return self._controller.step(state, self._begun + s)

    def course(self, s: float) -> tuple[Array, Array, Array]:
        return self._course.at(*self._course.instant(self._begun + s))


@dataclass(eq=False)
class LiveDrive(Drive):
    """The loop with a source of requests, and a record of the commanded motion.

    rest_after: s at rest after which the run ends. planned_here: the planner that runs in the loop itself, without real
    time.
    """

    live: Live = field(kw_only=True)
    prompter: Prompter = field(kw_only=True)
    rest_after: float = field(kw_only=True)
    planned_here: Callable[[], Any] | None = field(kw_only=True, default=None)
    options: LiveRunOptions = field(kw_only=True, default=STANDARD)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.begun, self.offset = 0.0, np.nan  # live time of the first period after 0, s; and of the live clock
        self.as_planned = True
        self.periods, self.rested, self.patience = 0, 0.0, self.options.patience

    def one_period(self, gate: Gate) -> bool:
        if self.stop is None:
            self.prompter.period(self.t)  # there is time before the next sample comes
        self.periods += 1
        if self.planned_here is not None and self.periods % self.options.every == 0:
            self.planned_here()
        last = super().one_period(gate)
        if self.t >= 0:
            self.noted()
        if self.stop is None and self.t > self.options.longest - self.rest_after - self.options.ending:
            self.signals.note(f"It was told what to do for {self.t:.0f} s, which is the most that one run may take")
        return last

    def noted(self) -> None:
        """Note whether the arm still follows the committed motion."""
        live = self.live
        if np.isnan(self.offset):
            self.begun, self.offset = live.now, live.now - self.t
        beside = self.stop is not None and not (isinstance(self.stop, LiveStop) and self.stop.exact)
        self.as_planned &= not beside and abs(live.now - self.t - self.offset) < SAME

    def commanded(self, log_: ExecutionLog) -> JointMotion:
        """The motion from the first period after 0 to the last: as committed, or as in the log where it deviates."""
        if not self.as_planned:
            some = (log_.t >= 0) & np.append(True, np.diff(log_.t) > SAME)
            t, q = log_.t[some], log_.q_wanted[some]
            dq = np.gradient(q, t, axis=0)
            return JointMotion(t - t[0], q, dq, np.gradient(dq, t, axis=0))
        found = self.live.commanded(self.begun)
        assert found is not None
        return found

    def over(self, sensed: Sensed) -> bool:
        if self.stop is not None:
            return super().over(sensed)
        if not (self.prompter.over and self.live.now >= self.live.committed.ends):
            self.rested, self.patience = 0.0, self.options.patience
            return False
        if not self.live.settled:  # somebody still looks for a way
            self.patience -= self.period
            return self.patience < 0
        self.rested += self.period
        waited = self.rested - self.rest_after
        return waited >= 0 and (waited >= self.watchdog.longest_wait or self.at_rest(sensed))


def run_live(
    scenario: Scenario,
    wishes: Iterable[str | bytes],
    directory: str | Path,
    robot: str = "simulated",
    address: str = "",
    watchdog: Watchdog | None = None,
    *,
    realtime: bool = True,
    source: str = "the script",
    listen: bool = False,
    signals: Signals | None = None,
    confirm: Callable[[list[Check]], bool] = lambda checks: True,
    options: LiveRunOptions = STANDARD,
    robot_options: Any = None,
) -> Execution:
    """Run a live motion by the lines of a script (`salver.live.script`) and write a run directory: the commanded motion
    is its plan, and the log is in `execution`.

    robot: "simulated"; or another name of `salver.driver.robots.robots.ROBOTS`, which starts where it stands, with the
    load in place, and keeps limits of its own. realtime: keep real time, with a planner in a process of its own;
    otherwise the simulated arm waits for the planner, and a script gives the same run again. listen: the lines come
    while the arm moves. signals: through which the caller may ask for a stop. confirm: called with the checks after all
    of them passed, before anything moves. robot_options: as `options` of `run_plan`. Raises SalverError when the script
    or a check fails, ScenarioError when there is no arm or the load is not safe, MissingDependencyError without the
    robot's library.
    """
    if options.longest <= (least := options.ending + scenario.physics.settle_after):
        raise SalverError(
            f"A run of at most {options.longest:g} s is too short: the last {least:g} s are for its stop."
        )
    if robot == "simulated":
        known = _simulated(scenario, realtime, options)
    else:
        known = _real(robot_class(robot), scenario, address, realtime, options, robot_options)
    directory, live, plan, driven = Path(directory), known.live, known.plan, known.robot
    scenario, arm, carried = plan.scenario, live.problem.arm, plan.scenario.payload.bodies
    prompter = Prompter(live, options.script)
    if not listen:
        lines = [x if isinstance(x, str) else x.decode() for x in wishes]
        prompter.of(list(script(lines, source, options=options.script)))
    plan_files.check_place(scenario, directory, edited=True, force=True)
    checks = [c for c in check_plan(plan, arm, carried) if c.name not in ("stops", "rest", "speeds")]
    checks += known.checks
    demand(checks)
    checks.append(check_place(directory))
    joint = plan.joint
    assert joint is not None
    checks += check_posture(joint, arm, driven.look())
    demand(checks)
    if not confirm(checks):
        raise SalverError("The arm was not moved: you did not confirm.")
    watchdog, course = watchdog or Watchdog(), LiveCourse(live)
    controller = controller_for(scenario, course, None, arm=arm, space="joint")
    loaded = with_load(arm, carried)

    def stop_from(state: ArmState, t: float) -> Stop:
        live.stop("the loop that drives the arm stopped it", source="monitor")
        return LiveStop(live, course, controller, loaded, state, t, watchdog.stop)

    for _ in range(50):  # first calls load code; they must not happen in the loop
        controller.step(ArmState(joint.q[0], joint.dq[0]), known.start)
        state = ArmState(joint.q[0], joint.dq[0])
        LiveStop(live, course, controller, loaded, state, known.start, watchdog.stop).reference(0.0)
    controller.reset()
    if listen:
        prompter.listening(wishes, source)

    def plan_here() -> None:
        if not live.idle:
            live.plan(options.planning)
        else:
            live.prepare(options.planning)

    began = time.perf_counter()
    with noted_signals():  # nothing may come between the run and its log
        with nullcontext() if known.waits else Worker(live, process=True, stops=True):
            drive = LiveDrive(
                driven, controller, course, arm, carried, known.start, options.longest, watchdog, stop_from,
                signals or Signals(), live=live, prompter=prompter, rest_after=scenario.physics.settle_after,
                planned_here=plan_here if known.waits else None, options=options,
            )  # fmt: skip
            log_ = drive.run()
        return _kept(drive, log_, known, directory, checks, began)


@dataclass(frozen=True)
class _Standing:
    """An arm before the first request. plan: of staying at rest. start: loop time, s. waits: whether time waits for the
    planner. checks: of the robot itself."""

    live: Live
    plan: Plan
    robot: Robot
    start: float
    waits: bool
    checks: list[Check]


def _simulated(scenario: Scenario, realtime: bool, options: LiveRunOptions) -> _Standing:
    live = Live(scenario, lead=None if realtime else options.lead, options=options.kept)
    plan = _resting(scenario, live, options.resting)
    robot = SimulatedRobot(plan, live.problem.arm, options.longest, realtime)
    return _Standing(live, plan, robot, robot.start_time, not realtime, [])


def _real(
    kind: Any, scenario: Scenario, address: str, realtime: bool, options: LiveRunOptions, robot_options: Any
) -> _Standing:
    arm = scenario.load_arm()
    demand(kind.check(scenario, arm))
    robot: Robot = kind.connect(address, scenario, arm, realtime, robot_options)
    if robot.limits is not None:
        scenario = scenario.with_changes(arm__limits=slower(arm.limits, robot.limits))
    live = Live(scenario, robot.look().q, permit=robot.permit, options=options.kept)
    plan = _resting(scenario, live, options.resting)
    checks = kind.check(scenario, arm, plan.joint)
    return _Standing(live, plan, robot, -scenario.physics.settle_before, False, checks)


def slower(limits: JointLimits, others: JointLimits) -> dict[str, list[float]]:
    """The smaller one of each limit of two arms, for a scenario's `arm.limits`."""
    names = [field.name for field in fields(limits) if field.name in ArmLimits.model_fields]
    least = {name: np.minimum(getattr(limits, name), getattr(others, name)) for name in names}
    return {name: values.tolist() for name, values in least.items() if np.all(np.isfinite(values))}


def _resting(scenario: Scenario, live: Live, seconds: float) -> Plan:
    """The arm where it is for some seconds, as a plan."""
    q = live.committed.motion.q[0]
    still = np.zeros((2, len(q)))
    return commanded(scenario, JointMotion(np.array([0.0, seconds]), np.tile(q, (2, 1)), still, still))


def _kept(
    drive: LiveDrive, log_: ExecutionLog, known: _Standing, directory: Path, checks: list[Check], began: float
) -> Execution:
    """Keep the commanded motion as a plan and the executed one as its log."""
    plan, robot, unjudged = known.plan, known.robot, ""
    try:
        plan = commanded(plan.scenario, drive.commanded(log_))
    except Exception as error:  # a run that ended as none should: the log comes first
        unjudged = f"What was commanded is no motion from rest to rest ({named(error)}); the plan is where it began."
    summary = {
        **summary_of(plan, robot, log_, checks, drive.watchdog),
        "wishes": drive.prompter.notes,
        "requests": {name: getattr(drive.prompter, name) for name in ("accepted", "refused", "dropped")},
        "outcomes": [str(request) for request in drive.live.state.requests],
        "unjudged": unjudged,
        "provenance": provenance(plan.scenario),
    }
    arrays = arrays_of(drive.arm, log_, robot)
    if isinstance(robot, SimulatedRobot):
        arrays, summary = seen_in_the_engine(robot, began, arrays, {**summary, "realtime": not known.waits}, plan)
    plan_files.make_way(plan.scenario, directory, force=True)
    plan.save(directory)
    return Execution(arrays, summary, checks, keep(directory, "plan", arrays, summary))
