"""Driving an arm along a plan: the control loop, its watchdog, the cool stop, and what is logged."""

from __future__ import annotations

import gc
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from salver.control.arm import ArmController, ArmState
from salver.errors import SalverError
from salver.geometry import Array
from salver.models.arm import ArmModel, with_load

if TYPE_CHECKING:
    from collections.abc import Sequence

    from salver.driver.robots import Robot
    from salver.models.bodies import Body
    from salver.trajectory import JointMotion

STOP_GAINS = (200.0, 28.0)  # 1/s^2, 1/s of the cool stop, in every joint
STOP_SHARE = 0.8  # of the maker's acceleration: what is on the tray may go, the arm must not go far
LEAST_STOP_TIME = 0.15  # s
HOLD_AFTER_STOP = 0.25  # s


@dataclass(frozen=True)
class Watchdog:
    """When to stop. joint_error: rad off the reference. velocity_share: of the maker's limit.

    late_periods: control periods in a row that were missed.
    """

    joint_error: float = 0.05
    velocity_share: float = 1.0
    late_periods: int = 20

    def complaint(self, arm: ArmModel, state: ArmState, q_wanted: Array, missed: int, t: float) -> str | None:
        """One sentence when something is wrong, else None."""
        error = np.abs(state.q - q_wanted)
        if not np.all(np.isfinite(error)):
            return f"The arm reported a position that is no number at t = {t:.3f} s."
        j = int(np.argmax(error))
        if error[j] > self.joint_error:
            return (
                f"{arm.joint_names[j]} is {error[j]:.3f} rad off its reference at t = {t:.3f} s; "
                f"{self.joint_error:g} rad are allowed."
            )
        share = np.abs(state.dq) / arm.limits.velocity
        j = int(np.argmax(share))
        if share[j] > self.velocity_share:
            return (
                f"{arm.joint_names[j]} turns at {state.dq[j]:.3f} rad/s at t = {t:.3f} s, "
                f"{100 * share[j]:.0f} % of its limit."
            )
        if missed > self.late_periods:
            return f"{missed} control periods in a row were missed at t = {t:.3f} s; {self.late_periods} are allowed."
        return None


class CoolStop:
    """Brings the arm to rest from any state, smoothly and within a share of its acceleration, and holds it there.

    The velocity of every joint goes to zero along a quintic step, so neither acceleration nor torque jumps.
    """

    def __init__(self, arm: ArmModel, bodies: Sequence[Body], state: ArmState, torque: Array, period: float) -> None:
        loaded = with_load(arm, bodies)
        self._model, self._data = loaded.pin_model, loaded.data
        self._q, self._dq = state.q.copy(), state.dq.copy()
        needed = 1.875 * np.abs(self._dq) / (STOP_SHARE * arm.limits.acceleration)  # 1.875: steepest slope of the step
        self.braking = max(LEAST_STOP_TIME, float(np.max(np.where(np.isfinite(needed), needed, 0.0))))
        self._torque, self._step = torque, arm.limits.torque_rate * period
        self._limit = arm.limits.torque

    @property
    def duration(self) -> float:
        return self.braking + HOLD_AFTER_STOP

    def reference(self, s: float) -> tuple[Array, Array, Array]:
        """(q, dq, ddq) a time s after the stop began."""
        x = min(max(s / self.braking, 0.0), 1.0)
        left = 1 - x**3 * (10 - 15 * x + 6 * x**2)
        slope = -30 * x**2 * (1 - x) ** 2 / self.braking
        area = self.braking * (x - x**4 * (2.5 - 3 * x + x**2))
        return self._q + area * self._dq, left * self._dq, slope * self._dq

    def step(self, state: ArmState, s: float) -> Array:
        """Torque (n,) a time s after the stop began."""
        q, dq, ddq = self.reference(s)
        kp, kd = STOP_GAINS
        wanted = pin.rnea(self._model, self._data, state.q, state.dq, ddq + kp * (q - state.q) + kd * (dq - state.dq))
        wanted = np.clip(wanted, -self._limit, self._limit)
        self._torque = self._torque + np.clip(wanted - self._torque, -self._step, self._step)
        return self._torque


@dataclass(frozen=True)
class Log:
    """What the loop saw, K periods. t (K,): s, 0 when the motion starts. q, dq, tau (K, n). q_wanted (K, n).

    woken (K,): s on the clock when the state came. spent (K,): s until the torque was sent. elapsed (K,): s that the
    robot says passed since the last state. stopped: why it was stopped early, empty when it was not.
    """

    t: Array
    q: Array
    dq: Array
    tau: Array
    q_wanted: Array
    woken: Array
    spent: Array
    elapsed: Array
    stopped: str = ""
    saturation: dict[str, float] = field(default_factory=dict)


def drive(
    robot: Robot,
    controller: ArmController,
    joint: JointMotion,
    arm: ArmModel,
    bodies: Sequence[Body],
    *,
    start: float,
    end: float,
    watchdog: Watchdog,
) -> Log:
    """Run the loop from t = start to t = end, s; the arm is at rest before 0 and after the motion.

    Whatever goes wrong in here, the robot leaves torque control; what the watchdog sees ends in a cool stop.
    Interrupting (Ctrl-C) does too.
    """
    period = controller.period
    room = int((end - start) / period) + int(60 / period)
    log = _Book(room, arm.n)
    grid = np.arange(int(np.ceil(joint.duration / period)) + 1) * period
    wanted = joint.sample(np.minimum(grid, joint.duration))[0]
    stop: CoolStop | None = None
    stopped, since, t = "", 0.0, start
    torque = np.zeros(arm.n)
    state = robot.look()
    collecting = gc.isenabled()
    gc.collect()
    gc.disable()  # a collection takes longer than a period
    robot.start()
    try:
        while True:
            try:
                state, elapsed = robot.read()
                woken = time.perf_counter()
                t += elapsed
                q_wanted = wanted[min(max(round(t / period), 0), len(wanted) - 1)]
                if stop is None:
                    missed = round(elapsed / period) - 1
                    complaint = watchdog.complaint(arm, state, q_wanted, missed, t)
                    if complaint is None:
                        torque = controller.step(state, t)
                    else:
                        stopped, since = complaint, t
                        stop = CoolStop(arm, bodies, state, torque, period)
                if stop is not None:
                    torque = stop.step(state, t - since)
                last = t >= end - 0.5 * period if stop is None else t - since >= stop.duration
                robot.write(torque, last=last)
                log.add(t, state, torque, q_wanted, woken, elapsed)
                if last or log.full:
                    break
            except KeyboardInterrupt:
                if stop is not None:
                    raise
                stopped, since = f"Interrupted at t = {t:.3f} s.", t
                stop = CoolStop(arm, bodies, state, torque, period)
    except SalverError as error:  # the robot itself stopped: its reflexes brake it
        stopped = str(error)
    finally:
        robot.stop()
        if collecting:
            gc.enable()
    report = controller.saturation
    cut = {"torque": report.torque, "torque_rate": report.torque_rate, "peak_share": report.peak_share}
    return log.closed(stopped, cut)


class _Book:
    """Rows of the log in arrays that exist before the loop starts: nothing is allocated in it."""

    def __init__(self, room: int, n: int) -> None:
        self._columns = {
            "t": np.empty(room),
            "woken": np.empty(room),
            "spent": np.empty(room),
            "elapsed": np.empty(room),
        }
        self._columns |= {name: np.empty((room, n)) for name in ("q", "dq", "tau", "q_wanted")}
        self._count, self._room = 0, room

    @property
    def full(self) -> bool:
        return self._count == self._room

    def add(self, t: float, state: ArmState, tau: Array, q_wanted: Array, woken: float, elapsed: float) -> None:
        k, c = self._count, self._columns
        c["t"][k], c["woken"][k], c["elapsed"][k] = t, woken, elapsed
        c["q"][k], c["dq"][k], c["tau"][k], c["q_wanted"][k] = state.q, state.dq, tau, q_wanted
        c["spent"][k] = time.perf_counter() - woken
        self._count = k + 1

    def closed(self, stopped: str, saturation: dict[str, float]) -> Log:
        return Log(**{k: v[: self._count] for k, v in self._columns.items()}, stopped=stopped, saturation=saturation)


def timing(log: Log, period: float) -> dict[str, Any]:
    """How well the loop kept its period. Times in s.

    jitter: how far the time between two states was from the period. late: the share beyond half a period.
    missed: periods that passed without a torque of ours. step: from state to torque sent.
    """
    if len(log.t) < 2:
        return {"periods": len(log.t)}
    between = np.diff(log.woken)
    jitter = np.abs(between - period)
    periods = np.round(log.elapsed[1:] / period).astype(int)
    return {
        "periods": len(log.t),
        "period": period,
        "jitter_median": float(np.median(jitter)),
        "jitter_p999": float(np.quantile(jitter, 0.999)),
        "jitter_max": float(jitter.max()),
        "late": float(np.mean(between > 1.5 * period)),
        "missed": int(np.maximum(periods - 1, 0).sum()),
        "longest_gap": float(between.max()),
        "step_median": float(np.median(log.spent)),
        "step_p999": float(np.quantile(log.spent, 0.999)),
        "step_max": float(log.spent.max()),
    }
