"""A controller of Universal Robots as its clients see it: RTDE on one port, URScript programs on another.

Programs are run as they are written: what of URScript they use is Python but for `end`, `local`, `thread` and `run`.
`servoj` and `sync` take one period; the arm follows `servoj` a lag late. In lock-step the controller waits in every
period for its client's registers, so that tests take no longer than they must. It speaks the protocol as the maker
documents it; it was not compared with a real controller.
"""

from __future__ import annotations

import contextlib
import re
import socket
import struct
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from salver.geometry import Array

PERIOD = 2e-3
FIELDS = {
    "timestamp": ("DOUBLE", "d"), "actual_q": ("VECTOR6D", "6d"), "actual_qd": ("VECTOR6D", "6d"),
    "actual_TCP_pose": ("VECTOR6D", "6d"), "tcp_offset": ("VECTOR6D", "6d"),
    "speed_scaling": ("DOUBLE", "d"), "target_speed_fraction": ("DOUBLE", "d"), "safety_mode": ("INT32", "i"),
}  # fmt: skip
FIELDS |= {f"output_int_register_{k}": ("INT32", "i") for k in range(24, 48)}
# Denavit-Hartenberg parameters as the maker publishes them: d (6,), a (6,), m; alpha (6,), rad.
DH = {
    "ur5": ((0.089159, 0, 0, 0.10915, 0.09465, 0.0823), (0, -0.425, -0.39225, 0, 0, 0)),
    "ur5e": ((0.1625, 0, 0, 0.1333, 0.0997, 0.0996), (0, -0.425, -0.3922, 0, 0, 0)),
}
ALPHA = np.pi / 2 * np.array([1, 0, 0, 1, -1, 0])
INPUTS = {f"input_int_register_{k}": ("INT32", "i") for k in range(24, 48)}
INPUTS |= {f"input_double_register_{k}": ("DOUBLE", "d") for k in range(24, 48)}


def flange(model: str, q: Array) -> Array:
    """Pose (4, 4) of an arm's flange in its base."""
    pose = np.eye(4)
    for theta, d, a, alpha in zip(q, *DH[model], ALPHA, strict=True):
        (c, s), (ca, sa) = (np.cos(theta), np.sin(theta)), (np.cos(alpha), np.sin(alpha))
        pose = pose @ [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]]
    return pose


class Ended(Exception):
    """The program is ended from outside."""


def python_of(program: str) -> str:
    """A URScript program as Python."""
    lines = [line for line in program.splitlines() if line.strip() != "end"]
    text = "\n".join(lines)
    text = re.sub(r"\blocal ", "", text)
    for name in re.findall(r"\bglobal (\w+) =", text):
        text = re.sub(rf"(\bglobal )?\b{name}\b(?!\()", f'everywhere["{name}"]', text)
    text = re.sub(r"\bthread (\w+)\(\)", r"def \1()", text)
    return re.sub(r"\brun (\w+)\(\)", r"run(\1)", text)


class Program:
    """A program without a controller, run in periods, s; its threads run in turn with it, each to its `sync`.

    q (6,): where the arm stands. low_from: time, s, from when on its digital input is low, for one period.
    sent: what servoj was told, one a period. said: popups.
    """

    def __init__(self, text: str, q: Array, low_at: float = np.inf, period: float = PERIOD) -> None:
        self.period = period
        self.sent: list[Array] = []
        self.said: list[str] = []
        self.stopped = 0.0
        self._threads: list[Any] = []
        names: dict[str, Any] = {
            "everywhere": {}, "servoj": self._servoj, "stopj": lambda a: setattr(self, "stopped", a),
            "popup": lambda text, *_, **__: self.said.append(text), "halt": None,
            "get_actual_joint_positions": lambda: list(q), "run": lambda f: self._threads.append(iter(f())),
            "get_standard_digital_in": lambda n: n != 3 or not low_at <= self.t < low_at + period,
        }  # fmt: skip
        text = re.sub(r"\bhalt\b", "raise Ended", python_of(text))
        # A thread gives way at its `sync`.
        text = re.sub(r"\bsync\(\)", "yield", re.sub(r"run\((\w+)\)", r"run(\1)", text))
        with contextlib.suppress(Ended):
            exec(text, {**names, "Ended": Ended})

    @property
    def t(self) -> float:
        return self.period * len(self.sent)

    def _servoj(self, q: list[float], *, t: float, lookahead_time: float, gain: float) -> None:
        assert t == self.period
        for thread in self._threads:
            next(thread, None)
        self.sent.append(np.array(q))


def package(kind: str, body: bytes) -> bytes:
    return struct.pack(">HB", 3 + len(body), ord(kind)) + body


class Controller:
    """Joints q (6,) at rest. refuse: a field that another client has. lag: s. tcp (6,): its tool's pose in the flange.
    odd: called with each answer of the data exchange (kind, body); gives the bytes that are sent."""

    def __init__(
        self, q: Array, lag: float = 0.03, *, lockstep: bool = True, refuse: str = "", model: str = "ur5e",
        tcp: tuple[float, ...] = (0.01, -0.02, 0.1, 0.3, 0.2, -0.4), version: tuple[int, ...] = (5, 20, 1, 7),
        odd: Callable[[str, bytes], bytes] = package, paced: bool = False,
    ) -> None:  # fmt: skip
        self.paced = paced or not lockstep
        self.model, self.tcp, self.version, self.odd = model, np.array(tcp), version, odd
        self.q, self.dq, self.lockstep, self.refuse = np.array(q, dtype=float), np.zeros(6), lockstep, refuse
        self.registers: dict[str, float] = dict.fromkeys(INPUTS, 0)
        self.outputs = {name: 0 for name in FIELDS if name.startswith("output")}
        self.t, self.scaling, self.slider, self.mode = 100.0, 1.0, 1.0, 1
        self.late: deque[Array] = deque([self.q] * round(lag / PERIOD))
        self.each: Any = lambda controller: None  # called in every period
        self.payload: tuple[Any, ...] = ()
        self.commands: list[Array] = []
        self.steps, self.program, self.over, self.inputs = 0, "", False, 0
        self.gone = False  # its client; the program goes on
        self.failed: BaseException | None = None
        self.client: socket.socket | None = None
        self.recipes: dict[str, list[str]] = {}
        self._came = b""
        self._rtde, self._script = (socket.create_server(("127.0.0.1", 0)) for _ in range(2))
        self.ports = self._rtde.getsockname()[1], self._script.getsockname()[1]
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self.over = True
        self._thread.join(5)
        for wire in (self._rtde, self._script, self.client):
            if wire is not None:
                wire.close()

    def _serve(self) -> None:
        self._script.settimeout(1e-3)
        self.client, _ = self._rtde.accept()
        self.client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        while not self.over:
            try:
                wire, _ = self._script.accept()
            except TimeoutError:
                with contextlib.suppress(OSError, Ended):
                    self._period(wait=False)
                continue
            with wire:
                self.program = b"".join(iter(lambda w=wire: w.recv(1 << 16), b"")).decode()  # type: ignore[misc]
            try:
                self.run(self.program)
            except (Ended, OSError):
                pass
            except BaseException as error:
                self.failed = error
                raise

    def run(self, program: str) -> None:
        """A program, to its end."""
        name = re.findall(r"^def (\w+)\(\):", program, re.MULTILINE)[-1]
        names: dict[str, Any] = {
            "servoj": self._servoj, "stopj": self._stopj, "sync": self._sync,
            "set_target_payload": lambda *values: setattr(self, "payload", values),
            "write_output_integer_register": lambda k, value: self.outputs.update({f"output_int_register_{k}": value}),
            "read_input_integer_register": lambda k: self.registers[f"input_int_register_{k}"],
            "get_actual_joint_positions": lambda: self.q.tolist(),
            "read_input_float_register": lambda k: self.registers[f"input_double_register_{k}"],
        }  # fmt: skip
        exec(python_of(program), names)
        if f"\n{name}()" not in program:
            names[name]()

    def _servoj(self, q: list[float], *, t: float, lookahead_time: float, gain: float) -> None:
        assert t == PERIOD
        assert 0.03 <= lookahead_time <= 0.2
        assert 100 <= gain <= 2000
        self.commands.append(np.array(q))
        self.late.append(np.array(q))
        self._moved(self.late.popleft())
        time.sleep(PERIOD if self.paced else 0.0)
        # Not before the client's first command: it waits for a state as long.
        self._period(
            wait=self.lockstep and self.registers["input_int_register_24"] != self.outputs["output_int_register_24"]
        )

    def _sync(self) -> None:
        time.sleep(2e-4)
        self._period(wait=False)

    def _stopj(self, deceleration: float) -> None:
        dq = self.dq
        while np.abs(dq).max() > 0:
            dq = np.sign(dq) * np.maximum(np.abs(dq) - deceleration * PERIOD, 0)
            self._moved(self.q + PERIOD * dq)
            self._period(wait=False)

    def _moved(self, q: Array) -> None:
        self.dq, self.q = (q - self.q) / PERIOD, q

    def _period(self, wait: bool) -> None:
        """A state is sent, registers come."""
        self.t += PERIOD
        self.steps += 1
        self.each(self)
        if self.mode not in (1, 2):
            self.dq = np.zeros(6)
        if "O" in self.recipes and "S" in self.recipes:
            values = {"timestamp": self.t, "actual_q": self.q, "actual_qd": self.dq, "speed_scaling": self.scaling,
                      "target_speed_fraction": self.slider, "safety_mode": self.mode, "tcp_offset": self.tcp,
                      "actual_TCP_pose": self._tcp_pose(), **self.outputs}  # fmt: skip
            names = self.recipes["O"]
            flat = [x for name in names for x in np.atleast_1d(values[name]).tolist()]
            self._send("U", struct.pack(">B" + "".join(FIELDS[name][1] for name in names), 1, *flat))
        count = self.inputs
        deadline = time.monotonic() + (1.0 if wait else 0.0)
        self._hear()
        while wait and self.inputs == count and time.monotonic() < deadline and not (self.over or self.gone):
            self._hear(1e-3)
        if self.over or self.mode not in (1, 2):
            raise Ended

    def _tcp_pose(self) -> Array:
        tool = np.eye(4)
        tool[:3, :3], tool[:3, 3] = Rotation.from_rotvec(self.tcp[3:]).as_matrix(), self.tcp[:3]
        pose = flange(self.model, self.q) @ tool
        return np.concatenate([pose[:3, 3], Rotation.from_matrix(pose[:3, :3]).as_rotvec()])

    def _hear(self, patience: float = 0.0) -> None:
        assert self.client is not None
        if self.gone:
            return
        self.client.settimeout(patience or None)
        self.client.setblocking(bool(patience))
        if patience:
            self.client.settimeout(patience)
        try:
            came = self.client.recv(1 << 16)
            self.gone = not came
            self._came += came
        except (BlockingIOError, TimeoutError):
            pass
        except OSError:
            self.gone = True
        self.client.setblocking(True)
        while len(self._came) >= 3 and len(self._came) >= (size := struct.unpack_from(">H", self._came)[0]):
            kind, body = chr(self._came[2]), self._came[3:size]
            self._came = self._came[size:]
            self._answer(kind, body)

    def _answer(self, kind: str, body: bytes) -> None:
        if kind == "V":
            self._send("V", struct.pack(">B", struct.unpack(">H", body)[0] == 2))
        elif kind == "v":
            self._send("v", struct.pack(">4I", *self.version))
        elif kind in "OI":
            names = body[8 * (kind == "O") :].decode().split(",")
            known = FIELDS if kind == "O" else INPUTS
            types = [known.get(name, ("NOT_FOUND",))[0] if name != self.refuse else "IN_USE" for name in names]
            self.recipes[kind] = names
            self._send(kind, struct.pack(">B", 1) + ",".join(types).encode())
        elif kind == "S":
            self.recipes["S"] = []
            self._send("S", b"\x01")
        elif kind == "P":
            self.recipes.pop("S", None)
            self._send("P", b"\x01")
        elif kind == "U":
            names = self.recipes["I"]
            values = struct.unpack(">B" + "".join(INPUTS[name][1] for name in names), body)[1:]
            self.registers.update(zip(names, values, strict=True))
            self.inputs += 1

    def _send(self, kind: str, body: bytes) -> None:
        assert self.client is not None
        try:
            self.client.sendall(self.odd(kind, body))
        except OSError:
            self.gone = True
