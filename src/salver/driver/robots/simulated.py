"""The simulated arm in real time: the physics engine behind the calls of a robot."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from salver.control.arm import ArmState
from salver.geometry import Array

if TYPE_CHECKING:
    from collections.abc import Callable

    from salver.driver.preflight import Check
    from salver.driver.robots.robots import Takes
    from salver.driver.sensing import Sensed
    from salver.models.arm.arm import ArmModel
    from salver.models.arm.arm_limits import JointLimits
    from salver.planning.plan import Plan
    from salver.scenario import Scenario
    from salver.simulation.record import SimulationRecord
    from salver.trajectory import JointMotion

STOP_ROOM = 3.0  # s that a stop may take beyond the motion
SPIN = 2e-4  # s before a deadline from where on the clock is watched: the operating system wakes no more exactly


class SimulatedRobot:
    """The arm in the physics engine, which waits for its caller no more than a real one does.

    In every period that the caller misses, the engine continues with the last torque. realtime = False: the engine runs
    as fast as it can, and no period is missed. The time that the engine itself takes is part of the caller's period, so
    a real arm leaves the controller more of it.
    """

    takes: Takes = "torque"
    limits: JointLimits | None = None
    lag, speed, source = 0.0, 1.0, "simulated arm"

    @classmethod
    def of(cls, plan: Plan, arm: ArmModel, realtime: bool) -> SimulatedRobot:
        return cls(plan, arm, STOP_ROOM, realtime)

    @staticmethod
    def check(scenario: Scenario, arm: ArmModel, motion: JointMotion | None = None) -> list[Check]:
        return []

    def permit(self, motion: JointMotion) -> str:
        return ""

    def move(self, motion_from: Callable[[Array], JointMotion]) -> None:
        """Put the arm at the end of the motion."""
        self._run.scene.place(self._data, motion_from(self.look().q).q[-1])

    def __init__(self, plan: Plan, arm: ArmModel, extra_time: float, realtime: bool = True) -> None:
        """extra_time: s that the run may last beyond the planned one (a controlled stop)."""
        from salver.simulation.run import prepare
        from salver.simulation.scene.engine import mujoco
        from salver.simulation.trace import Recorder

        self._plan, self._arm, self._realtime = plan, arm, realtime
        self._run = prepare(plan.scenario, None, None, plan.reference, arm)
        period = plan.scenario.physics.command_period
        self.period, self._steps = period, round(period / plan.scenario.physics.timestep)
        self._t = np.append(self._run.t, self._run.t[-1] + period * np.arange(1, int(extra_time / period) + 1))
        self._data = mujoco.MjData(self._run.scene.model)
        assert plan.joint is not None
        self._run.scene.place(self._data, plan.joint.sample(0.0)[0][0])
        self._recorder = Recorder(self._run.scene, len(self._t))
        self._torque = np.zeros(arm.n)
        self._next = 0.0  # time.perf_counter() of the next period

    @property
    def start_time(self) -> float:
        """Time of the motion at the first read, s: before 0, while everything settles."""
        return float(self._t[0])

    def look(self) -> ArmState:
        n = self._arm.n
        return ArmState(self._data.qpos[:n].copy(), self._data.qvel[:n].copy())

    def start(self) -> None:
        self._next = time.perf_counter()
        self._first = True

    def read(self) -> tuple[ArmState, float]:
        periods = 0 if self._first else 1
        self._first = False
        if self._realtime:
            wait_until(self._next)
            for _ in range(int((time.perf_counter() - self._next) / self.period)):
                self._advance()
                self._next += self.period
                periods += 1
        return self.look(), periods * self.period

    def write(self, torque: Array, sensed: Sensed, *, last: bool = False) -> None:
        self._torque = torque
        self._advance()
        self._next += self.period

    def stop(self) -> None:
        pass

    def _advance(self) -> None:
        """One period of the engine under the last torque."""
        from salver.simulation.trace import step

        recorder = self._recorder
        if not recorder.full:
            t = float(self._t[recorder.count])
            step(self._run.scene, self._data, t, self._torque, self._steps, recorder.take)

    def record(self, summary: dict[str, Any], began: float, plan: Plan | None = None) -> SimulationRecord:
        """The record of arm and objects, as from any simulation.

        plan: the plan of the commanded motion, if that was not known beforehand.
        """
        from salver.simulation.run import measure

        trace = self._recorder.trace()
        reference = (plan or self._plan).reference
        run = replace(self._run, reference=reference, wanted=reference.sample(trace.t))
        return measure(run, trace, summary, began)


def wait_until(deadline: float) -> None:
    """Sleep, then watch the clock, until time.perf_counter() reaches the deadline."""
    remaining = deadline - time.perf_counter()
    if remaining > SPIN:
        time.sleep(remaining - SPIN)
    while time.perf_counter() < deadline:
        pass
