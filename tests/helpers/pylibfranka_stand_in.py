"""Stands in for pylibfranka where there is no arm: the physics engine behind the same names and units."""

from __future__ import annotations

import types
from typing import Any

import numpy as np

from salver.control.arm import ArmState
from salver.driver.robots.simulated import SimulatedRobot
from salver.geometry import Array
from salver.models.arm.arm import load_arm
from salver.planning.plan import Plan


class Library(types.ModuleType):
    """Stands in for pylibfranka, names and units as its own; its arm is the physics engine's, which it holds against
    gravity as the real one does."""

    class RealtimeConfig:
        kEnforce, kIgnore = 0, 1

    class ControllerMode:
        JointImpedance = 0

    class FrankaException(RuntimeError):
        pass

    class JointPositions:
        def __init__(self, q: list[float]) -> None:
            self.q, self.motion_finished = q, False

    class Torques:
        def __init__(self, tau_J: list[float]) -> None:
            assert len(tau_J) == 7
            self.tau_J, self.motion_finished = tau_J, False

    def __init__(self, plan: Plan, posture: Array | None = None, inner: SimulatedRobot | None = None) -> None:
        """posture: where the arm stands, its start unless given. inner: the simulated arm behind it."""
        super().__init__("pylibfranka")
        arm = load_arm(plan.scenario.arm, plan.scenario.tray)  # type: ignore[arg-type]
        inner = inner or SimulatedRobot(plan, arm, 60.0, realtime=False)
        if posture is not None:
            inner._run.scene.place(inner._data, posture)
        outer = self
        self.calls: list[Any] = []
        self.commands: list[Array] = []

        class Model:
            def gravity(self, state: Any) -> list[float]:
                return list(arm.gravity(np.array(state.q, dtype=float)))

        class Control:
            def readOnce(self) -> tuple[Any, Any]:
                state, elapsed = inner.read()
                return _state(state), types.SimpleNamespace(to_sec=lambda: elapsed)

            def writeOnce(self, command: Any) -> None:
                outer.calls.append(("finished", command.motion_finished))
                outer.commands.append(np.array(command.tau_J))
                sent = np.array(command.tau_J) + arm.gravity(true(inner).q)
                inner.write(sent, None, last=command.motion_finished)  # type: ignore[arg-type]

        class Position:
            last = inner.look().q

            def readOnce(self) -> tuple[Any, Any]:
                return _state(inner.look()), types.SimpleNamespace(to_sec=lambda: 1e-3)

            def writeOnce(self, command: Any) -> None:
                assert np.abs(np.array(command.q) - self.last).max() < 5e-4  # no jump: 0.5 rad/s
                self.last = np.array(command.q)
                if command.motion_finished:
                    outer.calls.append(("put", self.last))
                inner._run.scene.place(inner._data, self.last)

        class Robot:
            def __init__(self, address: str, config: int) -> None:
                if address == "nowhere":
                    raise outer.FrankaException("libfranka: Connection timed out.")
                outer.calls.append(("connected", config))

            def set_load(self, mass: float, com: list[float], inertia: list[float]) -> None:
                outer.calls.append(("load", mass, com, inertia))

            def set_collision_behavior(self, *thresholds: list[float]) -> None:
                assert [len(x) for x in thresholds] == [7, 7, 6, 6]
                outer.thresholds = thresholds

            def load_model(self) -> Any:
                return Model()

            def read_once(self) -> Any:
                return _state(inner.look())

            def start_torque_control(self) -> Any:
                outer.calls.append(("controlled", "torque"))
                inner.start()
                return Control()

            def start_joint_position_control(self, mode: int) -> Any:
                outer.calls.append(("controlled", "position"))
                return Position()

            def stop(self) -> None:
                outer.calls.append(("stopped",))
                inner.stop()

        self.Robot = Robot


def true(robot: SimulatedRobot) -> ArmState:
    """The state of the arm, whatever it reports."""
    return SimulatedRobot.look(robot)


def _state(state: ArmState) -> Any:
    return types.SimpleNamespace(q=list(state.q), q_d=list(state.q), dq=list(state.dq), O_ddP_O=[0.0, 0.0, -9.81])
