"""Arms of Universal Robots: joint positions, 500 times a second, over the controller's Real-Time Data Exchange (RTDE).

A URScript program on the controller reads joint positions from input registers and follows them with `servoj`. The
state comes back in the same exchange. Source: Universal Robots, "Real-Time Data Exchange (RTDE) Guide" (packages,
recipes, types) and Script Manual, e-Series SW 5.20 (`servoj`, `set_target_payload`, registers). The package ur-rtde
does the same with a long control script of its own; a program of twenty lines that stops by itself when commands no
longer come is easier to check, and needs no library. The controller's own kinematics show whether the arm is that of
the plan.
"""

from __future__ import annotations

import secrets
import socket
import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from salver.control.arm import ArmState
from salver.driver.preflight import Check
from salver.driver.signals import noted_signals
from salver.errors import SalverError
from salver.geometry import Array, compose, exp, invert
from salver.geometry import log as rotation_vector
from salver.models.arm.known_arms import UR_JOINTS

if TYPE_CHECKING:
    from collections.abc import Callable

    from salver.driver.robots.robots import Takes
    from salver.driver.sensing import Sensed
    from salver.models.arm.arm import ArmModel
    from salver.planning.plan import Plan
    from salver.trajectory import JointMotion

PERIOD = 2e-3  # s, of an e-Series
RTDE_PORT, SCRIPT_PORT = 30004, 30002
LEAST_VERSION = (5, 10)  # of the controller's software: has `set_target_payload`; before 5 it is a CB3, of 125 Hz
FIRST = 24  # of the registers for external clients
MOVES = (1, 2)  # safety modes: normal, reduced
STOPPED = {
    3: "a protective stop", 4: "recovery", 5: "a safeguard stop", 6: "an emergency stop of the system",
    7: "its emergency stop", 8: "a safety violation", 9: "a fault",
}  # fmt: skip
STATUS = f"output_int_register_{FIRST}"  # the number that a program began with, while it runs
OUTPUTS = {
    "timestamp": "d", "actual_q": "6d", "actual_qd": "6d", "speed_scaling": "d", "target_speed_fraction": "d",
    "safety_mode": "i", STATUS: "i", "actual_TCP_pose": "6d", "tcp_offset": "6d",
}  # fmt: skip
INPUTS = {f"input_int_register_{FIRST}": "i"} | {f"input_double_register_{FIRST + k}": "d" for k in range(6)}
TYPES = {"d": "DOUBLE", "6d": "VECTOR6D", "i": "INT32"}


@dataclass(frozen=True)
class UROptions:
    """Options of driving an arm of Universal Robots.

    lookahead, gain: parameters of `servoj`, 0.03 to 0.2 s and 100 to 2000; with more lookahead the arm is smoother and
    later.
    patience: periods without a new command after which the program stops the arm by itself.
    timeout: s within which the controller must answer. settling: s at rest after the way to the start.
    near, turned: largest difference, m and rad, of the flange's pose by the controller's calibrated kinematics and by
    the plan's model of the arm.
    """

    lookahead: float = 0.03
    gain: float = 300.0
    patience: int = 100
    timeout: float = 2.0
    settling: float = 0.5
    near: float = 0.01
    turned: float = 0.05


PROGRAM = """\
def salver_follow():
  set_target_payload({mass!r}, {com!r})
  while read_input_integer_register({first}) != {begun}:
    sync()
  end
  write_output_integer_register({first}, {begun})
  last = {begun}
  q = get_actual_joint_positions()
  missed = 0
  while missed < {patience}:
    n = read_input_integer_register({first})
    if n == last:
      missed = missed + 1
    else:
      missed = 0
      last = n
      q = {registers}
    end
    if n < 0:
      missed = {patience}
    else:
      servoj(q, t={period!r}, lookahead_time={lookahead!r}, gain={gain!r})
    end
  end
  stopj(2.0)
  write_output_integer_register({first}, 0)
end
"""


class Exchange:
    """A client of the controller's data exchange, protocol version 2."""

    def __init__(self, address: str, timeout: float) -> None:
        self._timeout = timeout
        self._socket = socket.create_connection((address, RTDE_PORT), timeout)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._came = b""
        self._ask("V", struct.pack(">H", 2))
        version = struct.unpack(">4I", self._ask("v", b""))
        if version < LEAST_VERSION:
            raise SalverError(
                f"its software is {version[0]}.{version[1]}; --robot ur drives arms with {LEAST_VERSION[0]}."
                f"{LEAST_VERSION[1]} and later, no CB3"
            )
        self._types(self._ask("O", struct.pack(">d", 1 / PERIOD) + ",".join(OUTPUTS).encode()), OUTPUTS)
        self._recipe = self._types(self._ask("I", ",".join(INPUTS).encode()), INPUTS)
        self._layout = struct.Struct(">B" + "".join(OUTPUTS.values()))
        self._ask("S", b"")

    def send(self, number: int, q: Array) -> None:
        """Fill the input registers."""
        self._write("U", struct.pack(">Bi6d", self._recipe, number, *q))

    def newest(self) -> dict[str, Any]:
        """The latest state; waits until there is one."""
        state = b""
        while not state or self._waiting():
            kind, body = self._package()
            state = body if kind == "U" else state
        values = iter(self._layout.unpack(state)[1:])
        return {
            name: np.array([next(values) for _ in range(6)]) if code == "6d" else next(values)
            for name, code in OUTPUTS.items()
        }

    def _ask(self, kind: str, body: bytes) -> bytes:
        """The controller's answer; raises SalverError when it is no."""
        self._write(kind, body)
        while True:
            came, answer = self._package()
            if came == kind:
                break
        if kind in "VS" and answer != b"\x01":
            raise SalverError(f'it refuses the request "{kind}" of the data exchange')
        return answer

    def _types(self, answer: bytes, wanted: dict[str, str]) -> int:
        """The recipe's number; raises SalverError when a field is not there, or is taken by another client."""
        types = answer[1:].decode("ascii", "replace").split(",")
        if len(types) != len(wanted):
            raise SalverError(
                f"it gives types for {len(types)} fields of the data exchange, where {len(wanted)} were asked for"
            )
        for (name, code), said in zip(wanted.items(), types, strict=True):
            if said != TYPES[code]:
                raise SalverError(f"{name} of the data exchange is {said}")
        return answer[0]

    def _write(self, kind: str, body: bytes) -> None:
        self._socket.sendall(struct.pack(">HB", 3 + len(body), ord(kind)) + body)

    def _waiting(self) -> bool:
        """Whether another whole package has come."""
        self._socket.setblocking(False)
        try:
            self._came += self._socket.recv(1 << 16)
        except BlockingIOError:
            pass
        finally:
            self._socket.settimeout(self._timeout)
        return len(self._came) >= 3 and len(self._came) >= struct.unpack_from(">H", self._came)[0]

    def _package(self) -> tuple[str, bytes]:
        while len(self._came) < 3 or len(self._came) < struct.unpack_from(">H", self._came)[0]:
            if not (more := self._socket.recv(1 << 16)):
                raise SalverError("it closed the connection")
            self._came += more
        size, kind = struct.unpack_from(">HB", self._came)
        if size < 3:
            raise SalverError(f"a package of the data exchange has {size} bytes")
        body, self._came = self._came[3:size], self._came[size:]
        return chr(kind), body


class URRobot:
    """An arm of Universal Robots, e-Series, in remote control. `servoj` follows `lag` late, or more."""

    takes: Takes = "position"
    period = PERIOD

    @classmethod
    def connect(
        cls, address: str, plan: Plan, arm: ArmModel, realtime: bool, options: UROptions | None = None
    ) -> URRobot:
        robot = cls(address, *payload(plan, arm), options or UROptions())
        robot.recognise(arm)
        return robot

    @staticmethod
    def check(plan: Plan, arm: ArmModel) -> list[Check]:
        names = arm.joint_names
        fits = len(names) == len(UR_JOINTS) and all(map(str.endswith, names, UR_JOINTS))
        sentence = f"The plan is for the joints {', '.join(names)}; --robot ur drives {', '.join(UR_JOINTS)}."
        return [Check("arm", fits, sentence)]

    def __init__(self, address: str, mass: float, com_F: Array, options: UROptions = UROptions()) -> None:
        """Connect. mass, com_F (3,): kg, m in the flange's frame, of all that it carries. Raises SalverError."""
        self._address, self._mass, self._com, self._options = address, mass, com_F, options
        self.lag = options.lookahead
        self.speed, self._number, self._begun, self._at, self._first = 1.0, 0, 0, 0.0, True
        try:
            self._exchange = Exchange(address, options.timeout)
        except (OSError, SalverError, struct.error) as error:
            raise self._said(error) from None
        self.look()

    @property
    def source(self) -> str:
        return f"ur at {self._address}"

    def look(self) -> ArmState:
        state = self._state()
        self._at = state["timestamp"]
        return ArmState(state["actual_q"], state["actual_qd"])

    def recognise(self, arm: ArmModel) -> None:
        """Compare the flange's pose in the base frame with the model's. Raises SalverError when they differ: the arm,
        or the frame of the payload's centre of mass, is another one."""
        state, options, model = self._state(), self._options, arm.pin_model
        base = model.frames[model.frames[model.getFrameId(arm.joint_names[0])].parentFrame].name
        q, tcp, offset = state["actual_q"], state["actual_TCP_pose"], state["tcp_offset"]
        p, R = compose(tcp[:3], exp(tcp[3:]), *invert(offset[:3], exp(offset[3:])))
        p_BF, R_BF = compose(*invert(*arm.link_pose(q, base)), *arm.link_pose(q, arm.flange))
        half_turn = np.diag([-1.0, -1.0, 1.0])  # of ROS's base_link to the controller's base
        off = (
            (float(np.linalg.norm(p - by @ p_BF)), float(np.linalg.norm(rotation_vector(R.T @ by @ R_BF))))
            for by in (np.eye(3), half_turn)
        )
        away, turn = min(off, key=lambda pair: pair[0] / options.near + pair[1] / options.turned)
        if not (away <= options.near and turn <= options.turned):
            raise self._said(
                SalverError(
                    f"the flange is {1e3 * away:.1f} mm and {np.rad2deg(turn):.1f} degrees from where {arm.name} has "
                    f"{arm.flange}; {1e3 * options.near:g} mm and {np.rad2deg(options.turned):.1f} degrees are "
                    "accepted. The plan is for another arm, or its arm.flange is not the frame tool0"
                )
            )

    def start(self) -> None:
        """Send the program, and wait until it reads the registers. It has a number of its own, so that it ignores
        values that another program left there, and holds the arm in place until the first command."""
        self._begun = self._number = secrets.randbelow(2**30) + 1
        self._first, options = True, self._options
        self._send(np.zeros(6))
        registers = ", ".join(f"read_input_float_register({FIRST + k})" for k in range(6))
        program = PROGRAM.format(
            begun=self._begun, mass=float(self._mass), com=[float(x) for x in self._com], first=FIRST, period=PERIOD,
            patience=options.patience, lookahead=options.lookahead, gain=options.gain, registers=f"[{registers}]",
        )  # fmt: skip
        try:
            with socket.create_connection((self._address, SCRIPT_PORT), self._options.timeout) as wire:
                wire.sendall(program.encode())
        except OSError as error:
            raise self._said(error) from None
        for _ in range(round(self._options.timeout / PERIOD)):
            if self._state()[STATUS] == self._begun:
                self.look()
                return
        raise self._said(SalverError("the program does not run; is the robot in remote control?"))

    def read(self) -> tuple[ArmState, float]:
        before = self._at
        state = self._state()
        if state[STATUS] != self._begun:
            raise self._said(SalverError("the program has ended"))
        self._at = state["timestamp"]
        first, self._first = self._first, False
        return ArmState(state["actual_q"], state["actual_qd"]), 0.0 if first else self._at - before

    def write(self, command: Array, sensed: Sensed, *, last: bool = False) -> None:
        self._follow(command)

    def stop(self) -> None:
        """End the program, which stops an arm that still moves; it ends by itself when no more commands come."""
        self._number = -1
        self._send(np.zeros(6))

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
                    t += PERIOD  # whatever its clock says: no command is further on
                    self._follow(motion.sample(min(t, motion.duration))[0][0])
            finally:
                self.stop()

    def _follow(self, q: Array) -> None:
        self._number += 1
        self._send(q)

    def _send(self, q: Array) -> None:
        try:
            self._exchange.send(self._number, q)
        except OSError as error:
            raise self._said(error) from None

    def _state(self) -> dict[str, Any]:
        """The newest; raises SalverError when there is none, or the arm was stopped by its own safety."""
        try:
            state = self._exchange.newest()
        except (OSError, SalverError, struct.error) as error:
            raise self._said(error) from None
        if (mode := state["safety_mode"]) not in MOVES:
            raise self._said(SalverError(STOPPED.get(mode, f"safety mode {mode}")))
        self.speed = min(max(0.0, state["speed_scaling"] * state["target_speed_fraction"]), 1.0)
        return state

    def _said(self, error: Exception) -> SalverError:
        return SalverError(f"The arm at {self._address} says: {error}.")


def payload(plan: Plan, arm: ArmModel) -> tuple[float, Array]:
    """Mass, kg, and centre of mass (3,) in the flange's frame, m, of tray and load."""
    masses, coms_E = [plan.scenario.tray.mass], [arm.tray_com_E]
    for body in plan.scenario.payload.bodies:
        masses.append(body.inertial.mass)
        coms_E.append(body.p_EB + body.R_EB @ body.inertial.com_B)
    return float(sum(masses)), arm.p_FE + arm.R_FE @ np.average(coms_E, axis=0, weights=masses)
