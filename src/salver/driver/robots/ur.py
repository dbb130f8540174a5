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
from salver.driver.robots.positions import Packages, PositionOptions, PositionRobot, unlike
from salver.errors import SalverError
from salver.geometry import Array, compose, exp, invert
from salver.models.arm.known_arms import UR_JOINTS

if TYPE_CHECKING:
    from salver.models.arm.arm import ArmModel
    from salver.scenario import Scenario
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
SERVOJ = {"lookahead": (0.03, 0.2), "gain": (100, 2000)}  # s, 1: what it takes
STATUS = f"output_int_register_{FIRST}"  # the number that a program began with, while it runs
OUTPUTS = {
    "timestamp": "d", "actual_q": "6d", "actual_qd": "6d", "speed_scaling": "d", "target_speed_fraction": "d",
    "safety_mode": "i", STATUS: "i", "actual_TCP_pose": "6d", "tcp_offset": "6d",
}  # fmt: skip
INPUTS = {f"input_int_register_{FIRST}": "i"} | {f"input_double_register_{FIRST + k}": "d" for k in range(6)}
TYPES = {"d": "DOUBLE", "6d": "VECTOR6D", "i": "INT32"}


@dataclass(frozen=True)
class UROptions(PositionOptions):
    """Options of driving an arm of Universal Robots, beside those of `PositionOptions`.

    lookahead, gain: parameters of `servoj`, 0.03 to 0.2 s and 100 to 2000; with more lookahead the arm is smoother and
    later.
    patience: periods without a new command after which the program stops the arm by itself.
    """

    lookahead: float = 0.03
    gain: float = 300.0
    patience: int = 100
    timeout: float = 2.0

    def __post_init__(self) -> None:
        for name, (low, high) in SERVOJ.items():
            if not low <= (value := getattr(self, name)) <= high:
                raise SalverError(f"{name} of servoj is {value:g}; it must be from {low:g} to {high:g}.")


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
        self._packages = Packages(address, RTDE_PORT, timeout, ">H")
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
        self._streams = False

    def send(self, number: int, q: Array) -> None:
        """Fill the input registers."""
        self._write("U", struct.pack(">Bi6d", self._recipe, number, *q))

    def stream(self, on: bool) -> None:
        """Have a state sent each period, or none."""
        if on is not self._streams:
            self._ask("S" if on else "P", b"")
            self._streams = on

    def once(self) -> dict[str, Any]:
        """The state now. None is sent before and after: states that nobody reads fill the buffers, and newer ones are
        lost."""
        self.stream(True)
        state = self.newest()
        self.stream(False)
        return state

    def newest(self) -> dict[str, Any]:
        """The latest state; waits until there is one."""
        state = b""
        while not state or self._packages.waiting():
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
        if kind in "VSP" and answer != b"\x01":
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
        self._packages.wire.sendall(struct.pack(">HB", 3 + len(body), ord(kind)) + body)

    def _package(self) -> tuple[str, bytes]:
        package = self._packages.next()
        return chr(package[2]), package[3:]


class URRobot(PositionRobot):
    """An arm of Universal Robots, e-Series, in remote control. `servoj` follows `lag` late, or more."""

    kind, period, standard = "ur", PERIOD, UROptions()

    @staticmethod
    def check(scenario: Scenario, arm: ArmModel, motion: JointMotion | None = None) -> list[Check]:
        names = arm.joint_names
        fits = len(names) == len(UR_JOINTS) and all(map(str.endswith, names, UR_JOINTS))
        sentence = f"The plan is for the joints {', '.join(names)}; --robot ur drives {', '.join(UR_JOINTS)}."
        return [Check("arm", fits, sentence)]

    def __init__(self, address: str, mass: float, com_F: Array, options: UROptions | None = None) -> None:
        """Connect. Raises SalverError."""
        super().__init__(address, mass, com_F, options)
        self.lag, self._number, self._begun, self._controlled = self._options.lookahead, 0, 0, False
        try:
            self._exchange = Exchange(address, self._options.timeout)
        except (OSError, SalverError, struct.error) as error:
            raise self.said(error) from None
        self.look()

    def look(self) -> ArmState:
        state = self._state()
        self._at = state["timestamp"]
        return ArmState(state["actual_q"], state["actual_qd"])

    def recognise(self, arm: ArmModel) -> None:
        state = self._state()
        tcp, offset = state["actual_TCP_pose"], state["tcp_offset"]
        p, R = compose(tcp[:3], exp(tcp[3:]), *invert(offset[:3], exp(offset[3:])))
        half_turn = np.diag([-1.0, -1.0, 1.0])  # of ROS's base_link to the controller's base
        if why := unlike(arm, state["actual_q"], p, R, self._options, (np.eye(3), half_turn)):
            raise self.said(why)

    def start(self) -> None:
        """Send the program, and wait until it reads the registers. It has a number of its own, so that it ignores
        values that another program left there, and holds the arm in place until the first command."""
        self._begun = self._number = secrets.randbelow(2**30) + 1
        self._first, self._controlled, options = True, True, self._options
        self._send(np.zeros(6))
        registers = ", ".join(f"read_input_float_register({FIRST + k})" for k in range(6))
        program = PROGRAM.format(
            begun=self._begun, mass=float(self._mass), com=[float(x) for x in self._com], first=FIRST, period=PERIOD,
            patience=options.patience, lookahead=options.lookahead, gain=options.gain, registers=f"[{registers}]",
        )  # fmt: skip
        try:
            self._exchange.stream(True)
            with socket.create_connection((self._address, SCRIPT_PORT), self._options.timeout) as wire:
                wire.sendall(program.encode())
        except (OSError, SalverError) as error:
            raise self.said(error) from None
        for _ in range(round(self._options.timeout / PERIOD)):
            if self._state()[STATUS] == self._begun:
                self.look()
                return
        raise self.said("the program does not run; is the robot in remote control?")

    def read(self) -> tuple[ArmState, float]:
        before = self._at
        state = self._state()
        if state[STATUS] != self._begun:
            raise self.said("the program has ended")
        self._at = state["timestamp"]
        first, self._first = self._first, False
        return ArmState(state["actual_q"], state["actual_qd"]), 0.0 if first else self._at - before

    def stop(self) -> None:
        """End the program, which stops an arm that still moves; it ends by itself when no more commands come."""
        self._number, self._controlled = -1, False
        self._send(np.zeros(6))

    def send(self, q: Array) -> None:
        self._number += 1
        self._send(q)

    def _send(self, q: Array) -> None:
        try:
            self._exchange.send(self._number, q)
        except OSError as error:
            raise self.said(error) from None

    def _state(self) -> dict[str, Any]:
        """The newest; raises SalverError when there is none, or the arm was stopped by its own safety."""
        try:
            state = self._exchange.newest() if self._controlled else self._exchange.once()
        except (OSError, SalverError, struct.error) as error:
            raise self.said(error) from None
        if (mode := state["safety_mode"]) not in MOVES:
            raise self.said(STOPPED.get(mode, f"safety mode {mode}"))
        self.speed = min(max(0.0, state["speed_scaling"] * state["target_speed_fraction"]), 1.0)
        return state
