"""Faults thrown at the adapters of a UR and an xArm, on the wire, against servers that speak their protocols.

`python tests/helpers/driver_faults.py --robot xarm -n 1000` (or `ur`) throws a thousand. After each: no command that is
no number, outside the joints' range or faster than they turn came to the controller; the arm rests; the log is whole.
"""

from __future__ import annotations

import os
import signal
import struct
import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

import ur_server
import wire
from salver.driver import execute
from salver.driver.robots import ur, xarm
from salver.driver.signals import noted_signals
from salver.errors import SalverError
from salver.files import load_npz, read_json
from salver.planning.plan import load_plan

NUMBERS = (np.nan, np.inf, -np.inf, 1e30, -1e9, -3.0, 3.0, 0.3, 0.01, 0.0)
KINDS = (
    "reading", "reading", "reading", "clock", "frozen", "garbage", "silence", "hang up", "stop", "signal", "signal",
    "blocked", "lag", "deaf", "slower",
)  # fmt: skip


class Fault:
    """From the period on in which the controller has had `at` commands, for `lasts` periods."""

    def __init__(self, rng: np.random.Generator, robot: str, periods: int) -> None:
        self.kind, self.robot = str(rng.choice(KINDS)), robot
        self.at, self.lasts = int(rng.integers(0, periods)), int(rng.choice([1, 2, 9, 12, 60, 10**6]))
        self.joint, self.value, self.relative = int(rng.integers(6)), float(rng.choice(NUMBERS)), rng.random() < 0.5
        self.speed = bool(rng.random() < 0.5)  # of a reading, or the position
        self.choice = int(rng.integers(10**6))
        self.begun: int | None = None
        self.kept: Any = None

    @property
    def words(self) -> str:
        more = f" {'dq' if self.speed else 'q'}[{self.joint}] {'+' * self.relative}= {self.value}"
        kind = self.kind + (more if self.kind == "reading" else "")
        return f"{kind} ({self.choice}) from {self.at} for {self.lasts}"

    def now(self, controller: Any) -> bool:
        if self.begun is None and len(controller.commands) >= max(self.at, 1):
            self.begun = controller.steps
        return self.begun is not None and controller.steps < self.begun + self.lasts

    def each(self, controller: Any) -> None:
        """What happens to the arm in a period."""
        if not self.now(controller):
            return
        first, kind, pick = controller.steps == self.begun, self.kind, self.choice
        if kind == "clock" and first:
            controller.t += (0.5, 0.02, -0.01, -50.0, 1e6)[pick % 5]
        elif kind == "hang up" and first:
            clients = [controller.client] if self.robot == "ur" else controller.clients[pick % 3]
            for client in clients:
                client.shutdown(2)
        elif kind == "stop" and first and self.robot == "ur":
            controller.mode = (3, 4, 5, 6, 7, 8, 9, 11)[pick % 8]
        elif kind == "stop" and first:
            what = (lambda: controller.fail(1 + pick % 60), lambda: setattr(controller, "state", 3 + pick % 4),
                    lambda: setattr(controller, "mode", (0, 2, 4)[pick % 3]))  # fmt: skip
            what[pick % 3]()
        elif kind == "signal" and self.lasts < 100:
            os.kill(os.getpid(), (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)[pick % 3])
        elif kind == "blocked":
            self.kept = controller.q if first else self.kept
            controller.late = deque([self.kept] * len(controller.late))
            if self.robot == "xarm":
                controller.target = self.kept
        elif kind == "lag" and first:
            controller.late.extendleft([controller.late[0]] * (1 + pick % 30))
        elif kind == "deaf" and self.robot == "xarm":
            controller.deaf = True
        elif kind == "slower" and self.robot == "ur":
            controller.slider = (0.0, 0.3, 0.9, 2.0, np.nan)[pick % 5]

    def report(self, controller: Any, data: bytes) -> bytes:
        """What becomes of a report of the controller, a package whole with its head."""
        if not data or not self.now(controller):
            return data
        if self.kind == "frozen":
            self.kept = self.kept or data
            return bytes(self.kept)
        if self.kind == "silence":
            return b""
        if self.kind == "garbage":
            rng = np.random.default_rng([self.choice, controller.steps])
            cut = int(rng.integers(len(data)))
            return (data[:cut], rng.bytes(len(data)), data[:4] + rng.bytes(len(data) - 4))[self.choice % 3]
        if self.kind != "reading":
            return data
        at, code = (12, "d") if self.robot == "ur" else (116, "f")  # where positions stand, behind head and clock
        size = struct.calcsize(code)
        at += (6 if self.robot == "ur" else 7) * size * self.speed + size * self.joint
        form = ">d" if self.robot == "ur" else "<f"
        value = self.value + self.relative * struct.unpack_from(form, data, at)[0]
        return data[:at] + struct.pack(form, value) + data[at + size :]


class WireRig:
    """A plan for a robot in a run directory, and its controller anew for each throw."""

    def __init__(self, folder: Path, robot: str) -> None:
        self.folder, self.robot = folder, robot
        self.plan = load_plan(wire.planned(robot, folder))
        self.arm = self.plan.scenario.load_arm()
        self.checks = execute.check_plan(self.plan, self.arm, self.plan.scenario.payload.bodies)
        execute.demand(self.checks)
        self.period = {"ur": ur.PERIOD, "xarm": xarm.PERIOD}[robot]

    def throw(self, seed: int) -> tuple[list[Fault], list[str], dict[str, Any]]:
        """Faults by a seed, what is wrong after them, and the log's summary."""
        rng = np.random.default_rng([seed, len(self.robot)])
        periods = round(self.plan.duration / self.period) + 60
        faults = [Fault(rng, self.robot, periods) for _ in range(int(rng.choice([1, 1, 2])))]
        # A signal may come when the run has ended, until the controller is closed.
        checked = patch.object(execute, "check_plan", lambda *_: list(self.checks))
        with noted_signals(), self.controller(faults) as controller, checked:
            try:
                options = {"ur": ur.UROptions(timeout=1.0), "xarm": xarm.XArmOptions(timeout=1.0)}[self.robot]
                result: Any = execute.run_plan(self.folder, self.robot, "127.0.0.1", options=options)
            except SalverError as error:
                result = error
            return faults, list(self.wrong(controller, result)), getattr(result, "summary", {})

    def controller(self, faults: list[Fault]) -> Any:
        return _Running(self, faults)

    def wrong(self, controller: Any, result: Any) -> Iterator[str]:
        controller.lockstep = controller.paced = False  # nobody commands it any more
        until = time.monotonic() + 60.0
        while controller.dq.any() and time.monotonic() < until:
            time.sleep(1e-3)
        if controller.dq.any():
            yield f"the arm was left turning at {np.abs(controller.dq).max():.2f} rad/s"
        sent, limits = np.array(controller.commands), self.arm.limits
        if len(sent):
            if not isinstance(result, execute.Execution):
                yield f"no log: {result}"
            if not np.isfinite(sent).all():
                yield "a command that is no number came"
            if (sent < limits.q_min - 1e-6).any() or (sent > limits.q_max + 1e-6).any():
                yield "a command outside the joints' range came"
            steps = np.abs(np.diff(sent, axis=0, prepend=[self.plan.joint.q[0]]))  # type: ignore[union-attr]
            if (steps > self.period * limits.velocity * (1 + 1e-6) + 1e-6).any():
                yield f"a command came {(steps / limits.velocity).max() / self.period:.2f} times as fast as joints turn"
        if isinstance(result, execute.Execution):
            arrays, summary = (
                load_npz(result.path, ("t", "q", "dq", "command")),
                read_json(result.path.with_suffix(".json")),
            )
            if not all(np.isfinite(arrays[name]).all() for name in ("t", "q", "dq", "command")):
                yield "the log holds what is no number"
            if not summary["stopped"] and np.abs(controller.q - self.plan.joint.q[-1]).max() > 0.05:  # type: ignore[union-attr]
                yield "the log does not say that the arm is elsewhere"


class _Running:
    """A controller with faults, at whose ports the adapter finds it."""

    def __init__(self, rig: WireRig, faults: list[Fault]) -> None:
        self._rig, self._faults = rig, faults

    def __enter__(self) -> Any:
        rig, faults, running = self._rig, self._faults, []

        def odd(source: Any, data: bytes) -> bytes:
            if rig.robot == "ur":
                data = ur_server.package(source, data)
            for fault in faults if running and source in ("U", 30000) and len(data) > 200 else ():
                data = fault.report(running[0], data)
            return data

        def each(controller: Any) -> None:
            for fault in faults:
                fault.each(controller)

        q = rig.plan.joint.q[0]  # type: ignore[union-attr]
        made = wire.controller(rig.robot, q=q, odd=odd)
        made.each = each
        running.append(made)
        self._made, self._patches = made, [patch.object(*port) for port in wire.ports(rig.robot, made)]
        for change in self._patches:
            change.start()
        return made

    def __exit__(self, *_: Any) -> None:
        for change in self._patches:
            change.stop()
        self._made.close()
