"""Arms that follow joint positions by themselves: packages of data, the payload, the arm of the plan, the way to the
start."""

from __future__ import annotations

import socket
import struct
from abc import abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from salver.driver.robots.robots import Robot
from salver.driver.signals import noted_signals
from salver.errors import SalverError
from salver.geometry import Array, compose, invert
from salver.geometry import log as rotation_vector

if TYPE_CHECKING:
    from collections.abc import Callable

    from salver.driver.sensing import Sensed
    from salver.models.arm.arm import ArmModel
    from salver.scenario import Scenario
    from salver.trajectory import JointMotion


@dataclass(frozen=True)
class PositionOptions:
    """Options of driving an arm that follows joint positions.

    timeout: s within which the controller must answer. settling: s at rest after the way to the start.
    near, turned: largest difference, m and rad, of the flange's pose by the controller's kinematics and by the plan's
    model of the arm.
    """

    timeout: float = 1.0
    settling: float = 0.5
    near: float = 0.01
    turned: float = 0.05


class PositionRobot(Robot):
    """A robot that takes joint positions; subclasses connect, read the state and send positions.

    kind: its name in `ROBOTS`. standard: its default options.
    """

    kind: str
    standard: Any
    takes, speed, limits = "position", 1.0, None

    def __init__(self, address: str, mass: float, com_F: Array, options: Any = None) -> None:
        """mass, com_F (3,): kg, m in the flange's frame, of all that the arm carries. options: a `PositionOptions`."""
        self._address, self._mass, self._com, self._options = address, mass, com_F, options or self.standard
        self._at, self._first = 0.0, True  # its clock, s

    @classmethod
    def connect(
        cls, address: str, scenario: Scenario, arm: ArmModel, realtime: bool, options: PositionOptions | None = None
    ) -> Self:
        robot = cls(address, *payload(scenario, arm), options)
        robot.recognise(arm)
        return robot

    @abstractmethod
    def recognise(self, arm: ArmModel) -> None:
        """Compare the connected arm with that of the plan (`unlike`). Raises SalverError when it is another one."""

    @property
    def source(self) -> str:
        return f"{self.kind} at {self._address}"

    @abstractmethod
    def send(self, q: Array) -> None:
        """Command the joint positions q (n,), rad."""

    def permit(self, motion: JointMotion) -> str:
        return ""

    def write(self, command: Array, sensed: Sensed, *, last: bool = False) -> None:
        self.send(command)

    def move(self, motion_from: Callable[[Array], JointMotion]) -> None:
        with noted_signals() as signals:
            motion = motion_from(self.look().q)
            self.start()
            try:
                t = 0.0
                while t < motion.duration + self._options.settling:
                    self.read()
                    if signals.seen:
                        raise SalverError(f"{signals.wish(t)} The arm was stopped on its way to the start.")
                    t += self.period  # whatever its clock says: no command is further on
                    self.send(motion.sample(t)[0][0])
            finally:
                self.stop()

    def said(self, error: Exception | str) -> SalverError:
        """What the arm says, or what went wrong with it, as one sentence."""
        return SalverError(f"The arm at {self._address} says: {error}.")


class Packages:
    """A TCP connection whose packages begin with their own length.

    head: struct of the length, which counts itself.
    """

    def __init__(self, address: str, port: int, timeout: float, head: str) -> None:
        self._timeout, self._head = timeout, struct.Struct(head)
        self.wire = socket.create_connection((address, port), timeout)
        self.wire.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._came = b""

    def next(self) -> bytes:
        """The next package, with its head; waits until it has come. Raises OSError."""
        while not self._whole():
            if not (more := self.wire.recv(1 << 16)):
                raise ConnectionError("it closed the connection")
            self._came += more
        (size,) = self._head.unpack_from(self._came)
        if size <= self._head.size:
            raise ConnectionError(f"a package of the data exchange has {size} bytes")
        package, self._came = self._came[:size], self._came[size:]
        return package

    def waiting(self) -> bool:
        """Whether another whole package has come."""
        self.wire.setblocking(False)
        try:
            self._came += self.wire.recv(1 << 16)
        except BlockingIOError:
            pass
        finally:
            self.wire.settimeout(self._timeout)
        return self._whole()

    def _whole(self) -> bool:
        return len(self._came) >= self._head.size and len(self._came) >= self._head.unpack_from(self._came)[0]


def payload(scenario: Scenario, arm: ArmModel) -> tuple[float, Array]:
    """Mass, kg, and centre of mass (3,) in the flange's frame, m, of tray and load."""
    masses, coms_E = [scenario.tray.mass], [arm.tray_com_E]
    for body in scenario.payload.bodies:
        masses.append(body.inertial.mass)
        coms_E.append(body.p_EB + body.R_EB @ body.inertial.com_B)
    return float(sum(masses)), arm.p_FE + arm.R_FE @ np.average(coms_E, axis=0, weights=masses)


def unlike(
    arm: ArmModel, q: Array, p: Array, R: Array, options: PositionOptions, turns: tuple[Array, ...] = (np.eye(3),)
) -> str:
    """Why a controller's arm is not that of the plan, by the pose of its flange; "" if it may be.

    q (n,): its joints, rad. p (3,), R (3, 3): the flange in the controller's base frame, m.
    turns: rotations of the model's base frame, any of which may be the controller's.
    """
    near, turned = options.near, options.turned
    model = arm.pin_model
    base = model.frames[model.frames[model.getFrameId(arm.joint_names[0])].parentFrame].name
    p_BF, R_BF = compose(*invert(*arm.link_pose(q, base)), *arm.link_pose(q, arm.flange))
    off = (
        (float(np.linalg.norm(p - by @ p_BF)), float(np.linalg.norm(rotation_vector(R.T @ by @ R_BF)))) for by in turns
    )
    away, turn = min(off, key=lambda pair: pair[0] / near + pair[1] / turned)
    if away <= near and turn <= turned:
        return ""
    return (
        f"the flange is {1e3 * away:.1f} mm and {np.rad2deg(turn):.1f} degrees from where {arm.name} has {arm.flange}; "
        f"{1e3 * near:g} mm and {np.rad2deg(turned):.1f} degrees are accepted. The plan is for another arm, or its "
        "arm.flange is another frame than the controller's"
    )
