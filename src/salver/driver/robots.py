"""Arms that can be driven by torque: the Franka through pylibfranka, and the simulated one in real time.

A robot is asked for its state and given a torque, once per control period; `salver.driver.execution` does both.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from salver.control.arm import ArmState
from salver.driver.gate import TorqueGate
from salver.driver.signals import Signals, noted_signals
from salver.errors import MissingDependencyError, SalverError
from salver.geometry import Array

if TYPE_CHECKING:
    from collections.abc import Callable

    from salver.driver.sensing import Sensed
    from salver.models.arm import ArmModel
    from salver.planning.plan import Plan
    from salver.simulation.record import SimulationRecord
    from salver.trajectory import JointMotion

PERIOD = 1e-3  # s, of the Franka
COMMAND_RATE_SHARE = 0.999  # of the limit: the arm refuses what touches it
LONGEST_STEP = 0.02  # s between two states on the way to the start; then the arm has given up by itself
SPIN = 2e-4  # s before a deadline from where on the clock is watched: the operating system wakes no more exactly


class Robot(Protocol):
    """An arm with torque control. torque: all of it, gravity included; an adapter takes off what its robot adds."""

    @property
    def source(self) -> str:
        """What it is, for the log."""
        ...

    def look(self) -> ArmState:
        """The state now, without control."""
        ...

    def start(self) -> None:
        """Begin torque control; the first `read` follows."""
        ...

    def read(self) -> tuple[ArmState, float]:
        """Wait for the next period. The state, and the time since the last read, s (0 at first)."""
        ...

    def write(self, torque: Array, sensed: Sensed, *, last: bool = False) -> None:
        """Torque for this period. sensed: the state that is believed. last: the motion ends with it."""
        ...

    def stop(self) -> None:
        """Leave torque control, whatever happened."""
        ...


class FrankaRobot:
    """A Franka arm through pylibfranka's torque interface. Written for pylibfranka 0.19 and later."""

    def __init__(
        self, address: str, arm: ArmModel, tray_mass: float, tray_inertia: Array, realtime: bool = True
    ) -> None:
        """Connect and tell the arm of the tray. Raises MissingDependencyError without pylibfranka, SalverError when the
        arm does not answer.

        realtime: refuse to run on a kernel that gives no real-time priority, as libfranka advises.
        """
        self._library = library()
        config = self._library.RealtimeConfig
        try:
            self._robot = self._library.Robot(address, config.kEnforce if realtime else config.kIgnore)
            self._robot.set_load(tray_mass, arm.tray_com_F.tolist(), np.diag(tray_inertia).ravel().tolist())
            # Thresholds of a collision, N m and N: well above what the planned accelerations need.
            self._robot.set_collision_behavior([40.0] * 7, [60.0] * 7, [60.0] * 6, [90.0] * 6)
            self._model = self._robot.load_model()
        except self._library.FrankaException as error:
            raise _said(address, error) from None
        except RuntimeError as error:  # pylibfranka's exceptions are RuntimeErrors, not all of them FrankaExceptions
            raise _said(address, error) from None
        self._address, self._arm = address, arm
        self._control: Any = None
        self._state: Any = None

    @property
    def source(self) -> str:
        return f"franka at {self._address}"

    def look(self) -> ArmState:
        try:
            self._state = self._robot.read_once()
        except RuntimeError as error:
            raise _said(self._address, error) from None
        return _arm_state(self._state)

    def start(self) -> None:
        # The arm bears itself and the tray; what is commanded beyond that begins at nothing.
        rate = COMMAND_RATE_SHARE * self._arm.limits.torque_rate
        self._gate = TorqueGate(self._arm.limits.torque, rate, PERIOD, np.zeros(self._arm.n))
        self._differs = np.zeros(self._arm.n)
        self._compare(_arm_state(self._state).q)
        self._control = self._robot.start_torque_control()

    def read(self) -> tuple[ArmState, float]:
        try:
            self._state, elapsed = self._control.readOnce()
        except RuntimeError as error:
            raise _said(self._address, error) from None
        return _arm_state(self._state), elapsed.to_sec()

    def write(self, torque: Array, sensed: Sensed, *, last: bool = False) -> None:
        if not sensed.wrong:
            self._compare(sensed.state.q)
        adds = self._arm.gravity(sensed.state.q) + self._differs
        command = self._library.Torques(self._gate(torque - adds).tolist())
        command.motion_finished = last
        try:
            self._control.writeOnce(command)
        except RuntimeError as error:
            raise _said(self._address, error) from None

    def _compare(self, q: Array) -> None:
        """How the torque that the arm adds by itself differs from our model of it: of its own state, when that can be
        believed. Where it cannot, our model alone tells how it goes on."""
        adds = np.array(self._model.gravity(self._state), dtype=float)
        if np.all(np.isfinite(adds)):
            self._differs = adds - self._arm.gravity(q)

    def stop(self) -> None:
        try:
            self._robot.stop()
        finally:
            self._control = None

    def move(self, motion_from: Callable[[Array], JointMotion]) -> None:
        """Follow a joint motion by the arm's own position control, from where it holds itself. Raises SalverError, when
        it is interrupted too; the arm has been told to stop then.
        """
        with noted_signals() as signals:
            try:
                self._move(motion_from(self._finite(self._robot.read_once().q_d)), signals)
            except RuntimeError as error:
                raise _said(self._address, error) from None
            finally:
                self._robot.stop()

    def _move(self, motion: JointMotion, signals: Signals) -> None:
        control = self._robot.start_joint_position_control(self._library.ControllerMode.JointImpedance)
        t = 0.0
        while t < motion.duration:
            elapsed = float(control.readOnce()[1].to_sec())
            if not 0 <= elapsed <= LONGEST_STEP:
                raise SalverError(f"The arm at {self._address} says that {elapsed:g} s passed between two states.")
            if signals.seen:
                raise SalverError(f"{signals.wish(t)} The arm was stopped on its way to the start.")
            t += elapsed
            command = self._library.JointPositions(motion.sample(t)[0][0].tolist())
            command.motion_finished = t >= motion.duration
            control.writeOnce(command)

    def _finite(self, values: Any) -> Array:
        found = np.array(values, dtype=float)
        if found.shape != (self._arm.n,) or not np.all(np.isfinite(found)):
            raise SalverError(f"The arm at {self._address} reports no numbers for its joints.")
        return found


def library() -> Any:
    """pylibfranka, or one sentence that says how to get it."""
    try:
        import pylibfranka
    except ImportError:
        raise MissingDependencyError(
            "Driving a Franka needs the package pylibfranka; install it with: pip install 'salver[robot]'."
        ) from None
    return pylibfranka


def _said(address: str, error: Exception) -> SalverError:
    return SalverError(f"The arm at {address} says: {str(error).removeprefix('libfranka: ')}")


def _arm_state(state: Any) -> ArmState:
    return ArmState(np.array(state.q), np.array(state.dq))


class SimulatedRobot:
    """The arm in the physics engine, which waits for its caller no more than a real one does.

    Every period that the caller misses, the engine goes on with the last torque. realtime = False: as fast as it can,
    no period is missed. The time that the engine itself takes is part of the caller's period, so a real arm leaves
    the controller more of it.
    """

    def __init__(self, plan: Plan, arm: ArmModel, extra_time: float, realtime: bool = True) -> None:
        """extra_time: s that the run may last beyond the planned one (a cool stop)."""
        from salver.simulation.engine import mujoco
        from salver.simulation.run import prepare
        from salver.simulation.trace import Recorder

        self._plan, self._arm, self._realtime, self._engine = plan, arm, realtime, mujoco
        self._run = prepare(plan.scenario, None, None, plan.reference, arm)
        period = plan.scenario.physics.command_period
        self._period, self._steps = period, round(period / plan.scenario.physics.timestep)
        self._t = np.append(self._run.t, self._run.t[-1] + period * np.arange(1, int(extra_time / period) + 1))
        self._data = mujoco.MjData(self._run.scene.model)
        assert plan.joint is not None
        self._run.scene.place(self._data, plan.joint.sample(0.0)[0][0])
        self._recorder = Recorder(self._run.scene, len(self._t))
        self._torque = np.zeros(arm.n)
        self._next = 0.0  # time.perf_counter() of the next period

    source = "simulated arm"

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
            for _ in range(int((time.perf_counter() - self._next) / self._period)):
                self._advance()
                self._next += self._period
                periods += 1
        return self.look(), periods * self._period

    def write(self, torque: Array, sensed: Sensed, *, last: bool = False) -> None:
        self._torque = torque
        self._advance()
        self._next += self._period

    def stop(self) -> None:
        pass

    def _advance(self) -> None:
        """One period of the engine under the last torque."""
        recorder, data, n = self._recorder, self._data, self._arm.n
        if recorder.count == len(self._t):
            return
        recorder.joints(self._t[recorder.count], data.qpos[:n], data.qvel[:n], self._torque)
        data.qfrc_applied[:n] = self._torque
        self._engine.mj_step(self._run.scene.model, data)
        recorder.take(data)
        self._engine.mj_step(self._run.scene.model, data, nstep=self._steps - 1)

    def record(self, summary: dict[str, Any], began: float, plan: Plan | None = None) -> SimulationRecord:
        """What happened to arm and objects, as of any simulation. plan: what was wanted, where that was not known
        beforehand."""
        from salver.simulation import creep
        from salver.simulation.run import measure

        trace = self._recorder.trace()
        bias = creep.tray_bias(self._arm, trace.q, trace.dq, self._run.scene.world.R_tilt)
        reference = (plan or self._plan).reference
        run = replace(self._run, reference=reference, wanted=reference.sample(trace.t))
        return measure(run, trace, bias, (trace.p_XE, trace.R_XE), summary, began)


def wait_until(deadline: float) -> None:
    """Sleep, then watch the clock, until time.perf_counter() reaches the deadline."""
    remaining = deadline - time.perf_counter()
    if remaining > SPIN:
        time.sleep(remaining - SPIN)
    while time.perf_counter() < deadline:
        pass
