"""Franka arms, through pylibfranka's torque interface.

pylibfranka drives the Franka Research 3, whose joints turn as the Panda's do, within tighter limits: a plan made for
the Panda is checked against these before the arm moves. Source: Franka Robotics, "Limits for Franka Research 3" in the
robot and interface specifications; the same numbers in libfranka, include/franka/rate_limiting.h.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from salver.control.arm import ArmState
from salver.driver.gate import Gate
from salver.driver.preflight import Check, looked_at
from salver.driver.signals import Signals, noted_signals
from salver.errors import SalverError, needs
from salver.geometry import Array
from salver.models.arm.arm_limits import JointLimits
from salver.models.arm.known_arms import KNOWN_ARMS

if TYPE_CHECKING:
    from collections.abc import Callable

    from salver.driver.robots.robots import Takes
    from salver.driver.sensing import Sensed
    from salver.models.arm.arm import ArmModel
    from salver.scenario import Scenario
    from salver.trajectory import JointMotion

ARMS = ("panda", "fr3")  # whose models this driver knows
PERIOD = 1e-3  # s

_KNOWN = KNOWN_ARMS["fr3"]
FR3 = JointLimits(
    **{key: np.array(values) for key, values in _KNOWN.limits.items()},
    velocity_by_position=_KNOWN.velocity_by_position,
)


@dataclass(frozen=True)
class FrankaOptions:
    """Options of driving a Franka.

    rate_share: share of the limit of the torque rate that is used; below 1, because the arm refuses torques at the
    limit.
    longest_step: s between two states on the way to the start; after a longer time the arm has ended the motion by
    itself.
    contact, collision: thresholds, N m of each joint and N and N m of the flange, at which the arm reports a contact,
    and stops by itself; well above the values that planned accelerations need.
    """

    rate_share: float = 0.999
    longest_step: float = 0.02
    contact: tuple[float, float] = (40.0, 60.0)
    collision: tuple[float, float] = (60.0, 90.0)


class FrankaRobot:
    """A Franka arm through pylibfranka's torque interface. Run with pylibfranka 0.20 and 0.21."""

    takes: Takes = "torque"
    limits: JointLimits | None = FR3
    period, lag, speed, standard = PERIOD, 0.0, 1.0, FrankaOptions()

    @classmethod
    def connect(
        cls, address: str, scenario: Scenario, arm: ArmModel, realtime: bool, options: FrankaOptions | None = None
    ) -> FrankaRobot:
        tray = scenario.tray
        return cls(address, arm, tray.mass, np.array(tray.inertia), realtime, options or cls.standard)

    @staticmethod
    def check(scenario: Scenario, arm: ArmModel, motion: JointMotion | None = None) -> list[Check]:
        return check_franka(scenario, arm, motion)

    def permit(self, motion: JointMotion) -> str:
        return within_fr3(self._arm, motion)

    def __init__(
        self,
        address: str,
        arm: ArmModel,
        tray_mass: float,
        tray_inertia: Array,
        realtime: bool = True,
        options: FrankaOptions = standard,
    ) -> None:
        """Connect and tell the arm of the tray. Raises MissingDependencyError without pylibfranka, SalverError when the
        arm does not answer.

        realtime: refuse to run on a kernel that gives no real-time priority, as libfranka advises.
        """
        self._library = library()
        config = self._library.RealtimeConfig
        try:
            self._robot = self._library.Robot(address, config.kEnforce if realtime else config.kIgnore)
            com_F = arm.p_FE + arm.R_FE @ arm.tray_com_E
            inertia_F = arm.R_FE @ np.diag(tray_inertia) @ arm.R_FE.T
            self._robot.set_load(tray_mass, com_F.tolist(), inertia_F.ravel().tolist())
            (contact, push), (collision, hit) = options.contact, options.collision
            self._robot.set_collision_behavior([contact] * 7, [collision] * 7, [push] * 6, [hit] * 6)
            self._model = self._robot.load_model()
        except RuntimeError as error:  # pylibfranka's exceptions are RuntimeErrors, not all of them FrankaExceptions
            raise _said(address, error) from None
        self._address, self._arm, self._options = address, arm, options
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
        rate = self._options.rate_share * self._arm.limits.torque_rate
        limit = self._arm.limits.torque
        self._gate = Gate(-limit, limit, rate, PERIOD, np.zeros(self._arm.n))
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
        """Keep the difference between the torque that the arm adds by itself and our model of it, if it is finite."""
        if not np.any(self._state.O_ddP_O):  # a simulated arm that reports no acceleration of its base
            self._state.O_ddP_O = [0.0, 0.0, -9.81]
        adds = np.array(self._model.gravity(self._state), dtype=float)
        if np.all(np.isfinite(adds)):
            self._differs = adds - self._arm.gravity(q)

    def stop(self) -> None:
        try:
            self._robot.stop()
        finally:
            self._control = None

    def move(self, motion_from: Callable[[Array], JointMotion]) -> None:
        """Follow a joint motion by the arm's own position control, from where it holds itself. Raises SalverError on
        failure or interruption, after the arm was commanded to stop.
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
            if not 0 <= elapsed <= self._options.longest_step:
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
    with needs("robot", "Driving a Franka"):
        import pylibfranka
    return pylibfranka


def _said(address: str, error: Exception) -> SalverError:
    return SalverError(f"The arm at {address} says: {str(error).removeprefix('libfranka: ').rstrip('.')}.")


def _arm_state(state: Any) -> ArmState:
    return ArmState(np.array(state.q), np.array(state.dq))


def check_franka(scenario: Scenario, arm: ArmModel, motion: JointMotion | None = None) -> list[Check]:
    """Requirements of the Franka Research 3 beyond the Panda's, and limits of its interface."""
    physics = scenario.physics
    right = check_arm(scenario)
    checks = [
        right,
        Check(
            "period",
            physics.command_period == PERIOD,
            f"physics.command_period is {physics.command_period:g} s; the arm wants a torque every {PERIOD:g} s.",
        ),
    ]
    return checks + (_within(FR3, arm, looked_at(motion)) if right.ok and motion is not None else [])


def check_arm(scenario: Scenario) -> Check:
    """Whether a scenario's arm is one of `ARMS`, with the tray on the flange in whose frame the arm is given the tray's
    mass."""
    described = scenario.arm
    if described is None or described.model not in ARMS:
        of = "no arm" if described is None else f"the arm {described.model}"
        return Check("arm", False, f"The plan is for {of}; --robot franka drives a {' or an '.join(ARMS)}.")
    own = KNOWN_ARMS[described.model].flange
    if described.flange not in (None, own):
        said = f"arm.flange is {described.flange}; the arm is told of its tray in the frame of its own flange, {own}."
        return Check("arm", False, said)
    return Check("arm", True, f"A {described.model} with the tray on its flange {own}.")


def within_fr3(arm: ArmModel, motion: JointMotion) -> str:
    """The part of a motion that exceeds the Franka Research 3, in a sentence; empty if none does."""
    return next((check.sentence for check in _within(FR3, arm, looked_at(motion)) if not check.ok), "")


def _within(limits: JointLimits, arm: ArmModel, motion: JointMotion) -> list[Check]:
    curves = {"position": motion.q, "velocity": motion.dq, "acceleration": motion.ddq, "jerk": motion.jerk(motion.t)}
    made = []
    for kind, signed in limits.shares(curves).items():
        share = np.abs(signed)
        k, j = np.unravel_index(int(np.argmax(share)), share.shape)
        made.append(
            Check(
                f"FR3 {kind}",
                bool(share[k, j] <= 1.0),
                f"{arm.joint_names[j]} uses {100 * share[k, j]:.0f} % of the Franka Research 3's {kind} limit "
                f"at t = {motion.t[k]:.2f} s.",
            )
        )
    return made
