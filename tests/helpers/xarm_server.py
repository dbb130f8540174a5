"""A controller of UFACTORY as its clients see it: requests on one port, reports on two others.

It speaks the protocol as the maker documents it and as xarm-python-sdk 1.18 reads it: the header of ten requests
(version, enabling, state, mode, errors, payload, servoj, the limit of the tool's speed), states and modes, and the
reports of ports 30000 (each period) and 30002. `servoj` moves the joints by 180 degrees a second at most, a lag late.
In lock-step the controller waits in every period for its client's command, so that tests take no longer than they must;
paced, it takes no less than its period either.
It was not compared with a real controller.
"""

from __future__ import annotations

import contextlib
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

PERIOD = 4e-3
FASTEST, BRAKING = np.pi, 20.0  # rad/s, rad/s^2 of each joint
# Modified Denavit-Hartenberg parameters as the maker publishes them: offset of theta, d, alpha, a; rad and m.
TILT = 1.3849179
DH = {
    "xarm6": ((0, -TILT, TILT, 0, 0, 0), (0.267, 0, 0, 0.3425, 0, 0.097),
              (0, -90, 0, -90, 90, -90), (0, 0, 0.28948866, 0.0775, 0, 0.076)),
    "xarm7": ((0,) * 7, (0.267, 0, 0.293, 0, 0.3425, 0, 0.097),
              (0, -90, 90, 90, 90, 90, -90), (0, 0, 0, 0.0525, 0.0775, 0, 0.076)),
    "lite6": ((0, -np.pi / 2, -np.pi / 2, 0, 0, 0), (0.2433, 0, 0, 0.2276, 0, 0.0615),
              (0, -90, 180, 90, 90, -90), (0, 0, 0.2, 0.087, 0, 0)),
}  # fmt: skip
TYPE = {"xarm6": (6, 6), "xarm7": (7, 7), "lite6": (6, 9)}  # joints, type of device


def flange(model: str, q: Array) -> Array:
    """Pose (4, 4) of an arm's flange in its base."""
    pose = np.eye(4)
    for at, offset, d, alpha, a in zip(q, *DH[model], strict=True):
        (c, s), (ca, sa) = (np.cos(at + offset), np.sin(at + offset)), (f(np.deg2rad(alpha)) for f in (np.cos, np.sin))
        pose = pose @ [[c, -s, 0, a], [s * ca, c * ca, -sa, -d * sa], [s * sa, c * sa, ca, d * ca], [0, 0, 0, 1]]
    return pose


class Controller:
    """Joints q (n,) at rest. lag: s. tcp, world (6,): mm and rad, offsets of its tool and of its base. factor: of its
    tool's speed limit. load: what it is set to. odd: called with each report (port, bytes) and answer (0, bytes); gives
    the bytes that are sent."""

    def __init__(
        self, q: Array, lag: float = 0.03, *, lockstep: bool = True, model: str = "xarm6", version: str = "v2.5.0",
        tcp: tuple[float, ...] = (10.0, -20.0, 100.0, 0.3, 0.2, -0.4), world: tuple[float, ...] = (0.0,) * 6,
        error: int = 0, factor: float = 1.2, paced: bool = False,
        odd: Callable[[int, bytes], bytes] = lambda port, data: data,
    ) -> None:  # fmt: skip
        self.model, self.version, self.tcp, self.world, self.odd = model, version, np.array(tcp), world, odd
        self.q, self.dq, self.lockstep = np.array(q, dtype=float), np.zeros(len(q)), lockstep
        self.target, self.late = self.q, deque([self.q] * round(lag / PERIOD))
        self.t, self.state, self.mode, self.enabled, self.error, self.warning = 100.0, 4, 0, False, error, 0
        self.load, self.factor, self.paced, self.deaf = np.zeros(4), factor, paced, False
        self.each: Any = lambda controller: None  # called in every period
        self.commands: list[Array] = []
        self.asked: list[int] = []  # registers of requests
        self.steps, self.over, self.silent, self.followed = 0, False, 0, False
        self.failed: BaseException | None = None
        self._servers = [socket.create_server(("127.0.0.1", 0)) for _ in range(3)]
        self.ports = [server.getsockname()[1] for server in self._servers]  # of requests, reports, settings
        self.clients: list[list[socket.socket]] = [[], [], []]
        self._came = b""
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self.over = True
        self._thread.join(5)
        for wire in (*self._servers, *(client for group in self.clients for client in group)):
            wire.close()

    def hang_up(self) -> None:
        """Close all connections."""
        for group in self.clients:
            for client in group:
                with contextlib.suppress(OSError):
                    client.shutdown(socket.SHUT_RDWR)

    def fail(self, error: int) -> None:
        """An error of the controller, which stops the arm."""
        self.error, self.state = error, 4

    def _serve(self) -> None:
        try:
            for server in self._servers:
                server.setblocking(False)
            while not self.over:
                for server, group in zip(self._servers, self.clients, strict=True):
                    with contextlib.suppress(BlockingIOError):
                        client, _ = server.accept()
                        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                        client.setblocking(False)
                        group.append(client)
                self._period()
        except BaseException as error:
            self.failed = error
            raise

    def _period(self) -> None:
        """The arm moves, a report is sent, requests come."""
        self.t, self.steps = self.t + PERIOD, self.steps + 1
        self.each(self)
        before = self.q
        if self.enabled and self.mode == 1 and self.state in (1, 2):
            self.late.append(self.target)
            self.q = before + np.clip(self.late.popleft() - before, -FASTEST * PERIOD, FASTEST * PERIOD)
            self.state = 1 if (self.q != before).any() else 2
            tool = np.linalg.norm(self._pose(self.q)[:3, 3] - self._pose(before)[:3, 3]) / PERIOD
            if tool > self.factor * (0.5 / 1.2 if self.model == "lite6" else 1.0):
                self.fail(60)
        else:
            self.q = before + PERIOD * np.sign(self.dq) * np.maximum(np.abs(self.dq) - BRAKING * PERIOD, 0.0)
            self.late = deque([self.q] * len(self.late))
            self.target = self.q
        self.dq = (self.q - before) / PERIOD
        if self.silent > 0:
            self.silent -= 1
        else:
            self._send(1, self._report())
        if self.steps % 10 == 0:
            self._send(2, self._settings())
        count, began = len(self.commands), time.monotonic()
        serving = self.lockstep and self.followed and self.mode == 1 and self.state in (1, 2) and self.clients[0]
        until = began + (1.0 if serving else 3e-4 if self.lockstep and self.mode == 0 else PERIOD)
        while time.monotonic() < until and not self.over:
            self._hear()
            if serving and (len(self.commands) > count or self.state not in (1, 2) or not self.clients[0]):
                break
            time.sleep(2e-5 if serving else 1e-4)
        time.sleep(max(0.0, began + PERIOD - time.monotonic()) if self.paced else 0.0)

    def _pose(self, q: Array) -> Array:
        tool = np.eye(4)
        tool[:3, :3], tool[:3, 3] = Rotation.from_euler("xyz", self.tcp[3:]).as_matrix(), 1e-3 * self.tcp[:3]
        return flange(self.model, q) @ tool

    def _seven(self, x: Array) -> bytes:
        return struct.pack("<7f", *x, *([0.0] * (7 - len(x))))

    def _report(self) -> bytes:
        body = struct.pack(">QBH17x", round(1e6 * self.t), self.state | self.mode << 4, 0)
        body += 2 * self._seven(self.target) + self._seven(0 * self.q)
        body += self._seven(self.q) + self._seven(self.dq)
        return self.odd(30000, self._sized(body, 784))

    def _settings(self) -> bytes:
        pose = self._pose(self.q)
        tcp = [*1e3 * pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_euler("xyz")]
        body = struct.pack(">BH", self.state | self.mode << 4, 0) + self._seven(self.q) + struct.pack("<6f", *tcp)
        body += self._seven(0 * self.q) + bytes([255, 255 * self.enabled, self.error, self.warning])
        body += struct.pack("<6f", *self.tcp) + struct.pack("<4f", *self.load) + bytes([3, 3])
        body += struct.pack("<3f", 0, 0, -1) + bytes([TYPE[self.model][1], TYPE[self.model][0], 0xAA, 0x55, 0, 0])
        body = body.ljust(284) + struct.pack("<6f", *self.world)  # where the base's offset stands, behind its length
        return self.odd(30002, self._sized(body, 587))

    def _sized(self, body: bytes, size: int) -> bytes:
        return struct.pack(">I", size) + body.ljust(size - 4, b"\0")

    def _send(self, group: int, data: bytes) -> None:
        for client in list(self.clients[group]):
            try:
                client.sendall(data)
            except BlockingIOError:
                pass  # it reads no more
            except OSError:
                self.clients[group].remove(client)

    def _hear(self) -> None:
        for client in list(self.clients[0]):
            try:
                if not (more := client.recv(1 << 16)):
                    self.clients[0].remove(client)
                self._came += more
            except BlockingIOError:
                pass
            except OSError:
                self.clients[0].remove(client)
        while len(self._came) >= 6 and len(self._came) >= (size := 6 + struct.unpack_from(">H", self._came, 4)[0]):
            number, protocol, _, register = struct.unpack_from(">HHHB", self._came)
            body, self._came = self._came[7:size], self._came[size:]
            answer = self._answer(register, body)
            flags = 0x40 * bool(self.error) | 0x20 * bool(self.warning) | 0x10 * (self.state not in (1, 2))
            reply = struct.pack(">HHHBB", number, protocol, 2 + len(answer), register, flags) + answer
            if not self.deaf:
                self._send(0, self.odd(0, reply))

    def _answer(self, register: int, body: bytes) -> bytes:
        """What a request does, and the data of its answer."""
        self.asked.append(register)
        if register == 1:
            joints, kind = TYPE[self.model]
            return f"{joints},{kind},XI1304,AC1304,{self.version}".encode().ljust(40, b"\0")
        if register == 11:
            self.enabled, self.state = bool(body[1]), 4 if self.state == 4 else 5
        elif register == 12:
            if body[0] == 0:
                self.error, self.state = 0, 2
            else:
                self.state = {3: 3, 4: 4}[body[0]]
        elif register == 13:
            return bytes([self.state])
        elif register == 14:
            return b"\0\0"
        elif register == 15:
            return bytes([self.error, self.warning])
        elif register == 17:
            self.warning = 0
        elif register == 19:
            self.mode, self.state, self.followed = body[0], 5, False
        elif register == 29:
            joints = struct.unpack("<10f", body)[:7]
            self.followed = True
            self.commands.append(np.array(joints[: len(self.q)]))
            if self.state in (1, 2) and self.mode == 1:
                self.target = self.commands[-1]
        elif register == 36:
            self.load, self.state = np.array(struct.unpack("<4f", body)), 5
        elif register == 233:
            return struct.pack("<f", self.factor)
        else:
            self.warning = 13  # the instruction does not exist
        return b""
