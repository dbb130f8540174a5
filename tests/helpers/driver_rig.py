"""A plan in a run directory, the arm that it is driven on, faults in its calls, and what must hold after them.

`driver_faults.py` draws faults at random.

After each: no torque left that is no number or beyond the limits of torque and torque rate; the robot was told to leave
torque control, last of all; the log is on disk, whole and of numbers; and an arm that still took torques ended at rest.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from pylibfranka_stand_in import Library
from salver import scenario
from salver.control.arm import ArmController, ArmState
from salver.driver import execute, logs, stops
from salver.driver.robots.franka import FrankaRobot
from salver.driver.robots.simulated import STOP_ROOM, SimulatedRobot
from salver.files import load_npz, read_json
from salver.geometry import Array
from salver.models.arm.arm import load_arm
from salver.planning.make import make_plan
from salver.planning.plan import Plan, load_plan
from salver.planning.stops import plan_stops, stop_problem

CASE = scenario.load("panda-cube").with_changes(
    motion__duration=1.25, motion__nodes=21, physics__settle_before=0.05, physics__settle_after=0.1
)
ONCE = ("look", "start", "stop", "save", "record", "planned", "brake")  # sites that are not passed every period
Change = Callable[[Any], Any]


@dataclass
class Fault:
    """From period `at` on, for `lasts` periods: what is changed or raised at a site. words: for a person.

    odd: no state as pylibfranka could ever give it.
    """

    site: str
    at: int
    lasts: int
    words: str
    change: Change | None = None
    error: Callable[[], BaseException] | None = None
    signals: tuple[int, ...] = ()
    odd: bool = False

    def now(self, period: int) -> bool:
        return self.at <= period < self.at + self.lasts


class Arm(SimulatedRobot):
    """The simulated arm with faults in its calls. sent: all torques. said: what it was told, call by call."""

    def __init__(self, plan: Plan, arm: Any, extra_time: float, realtime: bool, bench: Bench) -> None:
        super().__init__(plan, arm, extra_time, realtime=False)
        self.bench, self.sent, self.said, self.failed = bench, [], [], False
        self.begun = False

    def _fail(self, site: str) -> None:
        try:
            self.bench.fail(site)
        except BaseException:
            self.failed = True
            raise

    def look(self) -> ArmState:
        if self.bench.armed and not self.begun:
            self._fail("look")
        return self.true()

    def true(self) -> ArmState:
        return super().look()

    def start(self) -> None:
        self.begun = True
        self._fail("start")
        super().start()

    def read(self) -> tuple[ArmState, float]:
        bench = self.bench
        bench.period += 1
        self._fail("read")
        for fault in bench.faults:
            if fault.signals and fault.now(bench.period):
                for number in fault.signals:
                    os.kill(os.getpid(), number)
        periods = 0 if self._first else 1
        self._first = False
        return bench.changed("read", (self.true(), periods * self.period))

    def write(self, torque: Array, sensed: Any = None, *, last: bool = False) -> None:
        self._fail("write")
        self.sent.append(np.array(torque, dtype=float))
        self.said.append("last" if last else "torque")
        super().write(self.bench.changed("motor", torque), sensed, last=last)

    def stop(self) -> None:
        self.said.append("stop")
        self.bench.fail("stop")


@dataclass
class Bench:
    """One set of faults, and the period that it is. armed: from when on they count."""

    faults: list[Fault]
    period: int = -1
    armed: bool = False
    raised: Counter[str] = field(default_factory=Counter)

    def changed(self, site: str, value: Any) -> Any:
        for fault in self.faults:
            if fault.change is not None and fault.site == site and fault.now(self.period):
                with contextlib.suppress(TypeError, ValueError, AttributeError):  # another fault left nothing to spoil
                    value = fault.change(value)
        return value

    def fail(self, site: str) -> None:
        for fault in self.faults:
            if fault.error is None or fault.site != site:
                continue
            here = fault.now(self.period)
            if site in ONCE:
                here = self.raised[fault.words] < fault.lasts
            if here:
                self.raised[fault.words] += 1
                raise fault.error()


class Rig:
    """A plan in a run directory, and all that need not be made anew for each fault."""

    def __init__(self, folder: Path, every: float | None = None) -> None:
        """every: s between the instants with a load-safe stop; None for a plan without any."""
        self.folder = folder
        plan = make_plan(CASE)
        if every is not None:
            assert plan.joint is not None
            plan = replace(plan, stops=plan_stops(stop_problem(plan), plan.joint, every, plan.space))
        plan.save(folder)
        self.plan = load_plan(folder)
        self.arm = load_arm(self.plan.scenario.arm, self.plan.scenario.tray)  # type: ignore[arg-type]
        self.carried = self.plan.scenario.payload.bodies
        self.checks = execute.check_plan(self.plan, self.arm, self.carried)
        execute.demand(self.checks)
        self.franka = FrankaRobot.check(self.plan.scenario, self.arm, self.plan.joint)

    def throw(self, faults: list[Fault], franka: bool = False) -> Outcome:
        """One run with faults, through the very functions of `salver execute`."""
        bench, robots = Bench(faults), []

        def robot(plan: Plan, arm: Any, extra_time: float, realtime: bool = True) -> Arm:
            robots.append(Arm(plan, arm, extra_time, realtime, bench))
            return robots[-1]

        with ExitStack() as stack:
            for change in self._patches(bench, robot):
                stack.enter_context(change)
            library = None
            if franka:
                library = Library(self.plan, inner=robot(self.plan, self.arm, 10.0))
                stack.enter_context(patch.dict(sys.modules, {"pylibfranka": library}))
            try:
                result = execute.run_plan(self.folder, "franka", "arm") if franka else execute.run_plan(self.folder)
            except BaseException as error:
                result = error
        return Outcome(self, faults, robots[-1], result, library)

    def _patches(self, bench: Bench, robot: Callable[..., Arm]) -> Iterator[Any]:
        step, brake, braking = ArmController.step, stops.ControlledStop.__init__, stops.ControlledStop.step
        row, save, record, run = execute_book().add, logs.save_record, SimulatedRobot.record, execute.Drive.run
        plan, stop = stops.PlannedStop.__init__, stops.PlannedStop.step

        def armed_run(drive: Any) -> Any:
            bench.armed = True
            return run(drive)

        def faulty(site: str, inner: Callable[..., Any]) -> Callable[..., Any]:
            def call(*args: Any, **options: Any) -> Any:
                if bench.armed:
                    bench.fail(site)
                value = inner(*args, **options)
                return bench.changed(site, value) if bench.armed else value

            return call

        yield patch.object(execute, "check_plan", lambda *args: list(self.checks))
        yield patch.object(FrankaRobot, "check", lambda *args: list(self.franka))
        yield patch.object(SimulatedRobot, "of", lambda plan, arm, *given: robot(plan, arm, STOP_ROOM))
        yield patch.object(execute.Drive, "run", armed_run)
        yield patch.object(ArmController, "step", faulty("controller", step))
        yield patch.object(stops.PlannedStop, "__init__", faulty("planned", plan))
        yield patch.object(stops.PlannedStop, "step", faulty("stopping", stop))
        yield patch.object(stops.ControlledStop, "__init__", faulty("brake", brake))
        yield patch.object(stops.ControlledStop, "step", faulty("braking", braking))
        yield patch.object(execute_book(), "add", faulty("row", row))
        yield patch.object(logs, "save_record", faulty("save", save))
        yield patch.object(SimulatedRobot, "record", faulty("record", record))


def execute_book() -> Any:
    from salver.driver import execution

    return execution._Book


@dataclass
class Outcome:
    """What came of it. wrong: what must not be; empty when all is well."""

    rig: Rig
    faults: list[Fault]
    robot: Arm
    result: Any
    library: Library | None

    def wrong(self) -> list[str]:
        return [*self._unsafe(), *self._left(), *self._log()]

    def _unsafe(self) -> Iterator[str]:
        limits, period = self.rig.arm.limits, self.rig.plan.scenario.physics.command_period
        sent = np.array(self.robot.sent).reshape(-1, 7)
        if not np.all(np.isfinite(sent)):
            yield "a torque that is no number left"
            return
        if np.any(np.abs(sent) > limits.torque * (1 + 1e-9) + (0.5 if self.library else 0.0)):
            yield f"a torque beyond its limit left: {np.abs(sent / limits.torque).max():.3f} of it"
        if self.library is None:
            rates = np.abs(np.diff(sent, axis=0)) / period
            if np.any(rates > limits.torque_rate * (1 + 1e-9)):
                yield f"a torque rate beyond its limit left: {(rates / limits.torque_rate).max():.3f} of it"
        else:
            commands = np.array([np.zeros(7), *self.library.commands])
            rates = np.abs(np.diff(commands, axis=0)) / period
            if not np.all(np.isfinite(commands)) or np.any(rates > limits.torque_rate):
                yield "a command that is no number or beyond the rate left"
            if np.any(np.abs(commands) > limits.torque):
                yield "a command beyond its limit left"

    def _left(self) -> Iterator[str]:
        if self.robot.begun and self.robot.said[-1:] != ["stop"]:
            yield "the robot was left in torque control"
        if not self.robot.sent or self.robot.failed or self._cannot_brake():
            return
        speed = float(np.abs(self.robot.true().dq).max())
        if speed > 0.1:
            yield f"the arm was left turning at {speed:.2f} rad/s"
        if "last" not in self.robot.said:
            yield "the motion was not ended"

    def _cannot_brake(self) -> bool:
        """Where the faults leave nothing to brake with: no stop that can begin or be stepped, endless interruptions."""
        endless = [f for f in self.faults if f.lasts > 40 and f.error is not None]
        return any(f.site in ("brake", "braking") for f in self.faults) or any(
            f.site in ("read", "write") for f in endless
        )

    def _log(self) -> Iterator[str]:
        if not isinstance(self.result, execute.Execution):
            yield f"no log: {self.result!r}"
            return
        path = self.result.path
        arrays, summary = load_npz(path, ("t", "q", "dq", "tau")), read_json(path.with_suffix(".json"))
        for name in ("t", "q", "dq", "tau"):
            if not np.all(np.isfinite(arrays[name])):
                yield f"{name} in the log holds what is no number"
        if self.robot.failed and not summary["stopped"]:
            yield "the log does not say that the robot failed"
        if summary["load_kept_in_stop"] and summary.get("outcome") not in ("holds", "stopped"):
            yield f"the load is said to be kept, and it {summary['outcome']}"
        if summary["stopped"] and self.result.achieved:
            yield "a run that was stopped is said to have achieved what was asked for"
        json.dumps(summary)


def spoilt(name: str, value: float) -> Change:
    """One joint's reading replaced by a value."""

    def change(answer: Any) -> Any:
        state, elapsed = answer
        values = {"q": state.q.copy(), "dq": state.dq.copy()}
        values[name][3] = value
        return ArmState(**values), elapsed

    return change


def one(rig: Rig, *faults: Fault, franka: bool = False) -> Outcome:
    """What comes of these faults; nothing of it may be wrong."""
    outcome = rig.throw(list(faults), franka)
    assert outcome.wrong() == []
    return outcome
