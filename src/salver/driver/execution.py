"""Driving an arm along a plan: the control loop, its watchdog, and its log.

In each period `sensing` checks the measured state, the watchdog decides whether to go on, the controller or a stop
computes the command, and `gate` limits it. Robots with a position or velocity interface get the reference, robots with
a torque interface the controller's torque.
"""

from __future__ import annotations

import gc
import time
from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from salver.control.arm import ArmController, ArmState, Course, JointTable
from salver.driver.gate import Gate
from salver.driver.sensing import Plausible, Sensed, Senses
from salver.driver.signals import Signals, noted_signals
from salver.driver.stops import PathStop, Stop, StopFrom, StopOptions, controlled_stops
from salver.errors import SalverError
from salver.geometry import Array
from salver.models.arm.arm import ArmModel, with_load
from salver.trajectory import JointMotion

if TYPE_CHECKING:
    from collections.abc import Sequence

    from salver.driver.robots.robots import Robot
    from salver.models.bodies import Body

STOP_ROOM = 60.0  # s that the log has for a stop
ATTEMPTS = 3  # to leave control


@dataclass(frozen=True)
class Watchdog:
    """Conditions that stop the arm. joint_error: deviation from the reference, rad. velocity_share: of the
    manufacturer's limit.

    late_periods: missed control periods in a row. at_rest: rad/s; control ends only below this velocity, or
    longest_wait seconds after the expected end of the stop. plausible: thresholds of plausible readings. stop: options
    of the stop.
    """

    joint_error: float = 0.05
    velocity_share: float = 1.0
    late_periods: int = 20
    at_rest: float = 0.02
    longest_wait: float = 1.0
    plausible: Plausible = field(default_factory=Plausible)
    stop: StopOptions = field(default_factory=StopOptions)

    def complaint(self, arm: ArmModel, state: ArmState, q_wanted: Array, missed: int, t: float) -> str:
        """The reason to stop, in one sentence; "" without one."""
        if astray := self.astray(arm, state, q_wanted, t):
            return astray
        share = np.abs(state.dq) / arm.limits.velocity
        j = int(np.argmax(share))
        if not share[j] <= self.velocity_share:
            return (
                f"{arm.joint_names[j]} moves at {state.dq[j]:.3f} {arm.unit(j)}/s at t = {t:.3f} s, "
                f"{100 * share[j]:.0f} % of its limit."
            )
        if missed > self.late_periods:
            return f"{missed} control periods in a row were missed at t = {t:.3f} s; {self.late_periods} are allowed."
        return ""

    def astray(self, arm: ArmModel, state: ArmState, q_wanted: Array, t: float) -> str:
        """One sentence when a joint is too far off its reference."""
        error = np.abs(state.q - q_wanted)
        j = int(np.argmax(error))
        if error[j] <= self.joint_error:
            return ""
        return (
            f"{arm.joint_names[j]} is {error[j]:.3f} {arm.unit(j)} off its reference at t = {t:.3f} s; "
            f"{self.joint_error:g} {arm.unit(j)} are allowed."
        )


@dataclass(frozen=True)
class ExecutionLog:
    """The log of a loop over K periods.

    t (K,): s, 0 when the motion starts. q, dq, q_wanted (K, n). sent (K, n): commands.

    woken (K,): clock time at which the state arrived, s. spent (K,): time until the torque was sent, s. elapsed (K,):
    time since the last state according to the robot, s. bridged (K,): whether the reported state was implausible; of
    such joints q and dq are the commanded ones. stopped: why it was stopped early; "" if it was not. keeps_load:
    whether the stop is verified to keep the load; None when it was not stopped by torque.
    """

    t: Array
    q: Array
    dq: Array
    sent: Array
    q_wanted: Array
    woken: Array
    spent: Array
    elapsed: Array
    bridged: Array
    stopped: str = ""
    saturation: dict[str, float] = field(default_factory=dict)
    keeps_load: bool | None = None


@dataclass(eq=False)
class Drive:
    """The loop from t = start to t = end, s; the arm is at rest before 0 and after the motion.

    stop_from: the stop after an error (`salver.driver.stops`). speed_rate: largest rate, 1/s, of the speed factor at
    which the load stays in place; None when it does at full speed only. signals: requests to stop from outside, also
    from another thread (`Signals.note`).
    """

    robot: Robot
    controller: ArmController
    joint: JointMotion | Course
    arm: ArmModel
    bodies: Sequence[Body]
    start: float
    end: float
    watchdog: Watchdog
    stop_from: StopFrom
    signals: Signals = field(default_factory=Signals)
    speed_rate: float | None = None

    def __post_init__(self) -> None:
        self.loaded, self.period = with_load(self.arm, self.bodies), self.robot.period
        self.by_torque = self.robot.takes == "torque"
        self.gains = (self.controller.gains.kp[0], self.controller.gains.kd[0])
        self.drawn_back = self.gains[0] / self.gains[1]  # 1/s; an arm that takes velocities, to its reference
        self.t = self.start  # s of the motion
        joint = self.joint
        self.wanted: Course = JointTable(joint, self.controller.period) if isinstance(joint, JointMotion) else joint
        # Tried in this order, each when the one before it fails.
        self.last_resort = controlled_stops(self.arm, self.bodies, self.watchdog.stop)
        self.stops = [self.stop_from, self.last_resort]
        self.stop: Stop | None = None
        self.gate: Gate | None = None
        self.stopped, self.since, self.unsure = "", 0.0, False
        self.stopping = 0  # periods of the stop
        self.seen = True  # all along the stop
        self.guessed = False  # whether the stop began in a state that was not measured in every joint
        self.factor = 1.0  # of full speed
        # Time never advances by less than half a period, so this is enough.
        self.book = _Book(2 * int((self.end - self.start + STOP_ROOM) / self.period), self.arm.n)

    def run(self) -> ExecutionLog:
        """Run the loop. Never raises: after any error the arm is stopped as well as possible, the robot leaves torque
        control, and the log says why. A complaint of the watchdog, an implausible state, a failure of the controller,
        Ctrl-C and the other signals that ask a process to end lead to a stop by torque; a robot that does not answer is
        left to its own brakes.
        """
        collecting = gc.isenabled()
        with noted_signals(self.signals):
            gc.collect()
            gc.disable()  # a collection takes longer than a period
            try:
                return self._run()
            finally:
                if collecting:
                    gc.enable()

    def _run(self) -> ExecutionLog:
        try:
            gate = self.begin()
            while not self.one_period(gate):
                pass
        except BaseException as error:  # torque control cannot go on; nothing may keep the robot from being stopped
            self.stopped = " ".join([*filter(None, [self.stopped]), self.failure(error)])
        self.leave()
        report = self.controller.saturation
        cut = {"torque": report.torque, "torque_rate": report.torque_rate, "peak_share": report.peak_share}
        cut |= {"gate_closed": self.gate.closed, "gate_cut": self.gate.cut} if self.gate is not None else {}
        return self.book.closed(self.stopped, cut, None if self.stop is None else self.stop.keeps_load and self.seen)

    def begin(self) -> Gate:
        state = self.robot.look()
        self.senses = Senses(self.arm, self.period, state, self.watchdog.plausible)
        q, limits = np.array(state.q, dtype=float), self.arm.limits
        if self.by_torque:
            first, least, most, rate = self.loaded.gravity(q), -limits.torque, limits.torque, limits.torque_rate
        elif self.robot.takes == "position":
            first, least, most, rate = q, limits.q_min, limits.q_max, limits.velocity
        else:
            first, least, most, rate = 0.0 * q, -limits.velocity, limits.velocity, limits.acceleration
        self.gate, self.sent = Gate(least, most, rate, self.period, first), first
        # Commanded references, the first of them a period and a lag ago: an arm with its own control should be there.
        count = 2 + round(self.robot.lag / self.period)
        self.late = deque([(self.reference()[0], 0.0 * q)] * count, count)
        self.expected = ArmState(*self.late[0])  # in which the arm should be by now
        self.robot.start()
        return self.gate

    def one_period(self, gate: Gate) -> bool:
        """Whether this was the last period."""
        answer = self.robot.read()
        woken = time.perf_counter()
        sensed = self.senses.take(answer, self.expected)
        slowed = self.scaled(sensed.elapsed)
        went = sensed.elapsed
        if self.robot.takes == "position":  # in periods that were missed it held the last command
            went -= max(round(went / self.period) - 1, 0) * self.period
        self.t += went * (self.factor if self.stop is None else 1.0)
        self.late.append(self.reference()[:2])
        self.expected = ArmState(*self.late[-1 if self.by_torque else 0])
        sensed.take_for(self.expected)
        self.believed = bool(sensed.believed.all())
        wish = "" if self.stop is not None else self.signals.wish(self.t)
        demanded = self.demand(sensed.state, wish or self.complaint(sensed) or slowed)
        if self.stop is not None:
            self.seen &= self.senses.sees and (self.by_torque or self.near(self.stop, sensed.state))
        # After a write with an unknown result the same command is sent again, so that no rate limit is exceeded.
        self.sent = gate(self.sent if self.unsure else demanded)
        self.stopping += self.stop is not None
        last = self.over(sensed)
        self.unsure = True
        self.robot.write(self.sent, sensed, last=last)
        self.unsure = False
        try:
            self.book.add(self.t, sensed, self.sent, self.q_wanted, woken)
        except BaseException as error:  # the command has left; a row less is no reason to leave the arm alone
            self.signals.note(f"The log failed ({named(error)})")
        if not self.book.left and not last:
            raise SalverError("The run exceeded the longest time that is allowed.")
        return last

    def scaled(self, elapsed: float) -> str:
        """Let the speed factor follow the robot's, as fast as the load allows; returns why to stop if it does not."""
        target = self.robot.speed
        if self.stop is not None or target == self.factor:
            return ""
        if self.speed_rate is None or (self.speed_rate == 0 and self.t > 0):
            kept = "full" if self.speed_rate is None else "constant"
            return f"The robot's speed is at {100 * target:.0f} %, and this motion keeps its load at {kept} speed only."
        most = self.speed_rate * elapsed if self.t > 0 else 1.0
        self.factor += min(max(target - self.factor, -most), most)
        return ""

    def reference(self) -> tuple[Array, Array, Array]:
        """q, dq, ddq of the motion or the stop, as commanded now."""
        if self.stop is not None:
            return self.stop.reference(self.s)
        q, dq, ddq = self.wanted.at(*self.wanted.instant(self.t))
        return (q, dq, ddq) if self.factor == 1.0 else (q, self.factor * dq, self.factor**2 * ddq)

    @property
    def q_wanted(self) -> Array:
        """Commanded joint positions a lag ago: where the arm should be now."""
        return self.reference()[0] if self.by_torque else self.late[0][0]

    def near(self, stop: Stop, state: ArmState) -> bool:
        """Whether an arm with its own control follows this stop closely enough to keep the load for certain."""
        return bool((np.abs(state.q - self.late[0][0]) <= stop.allowed + self.watchdog.stop.sensed).all())

    def complaint(self, sensed: Sensed) -> str:
        """Why to stop, or to change the stop; "" to go on."""
        if self.stop is not None:
            # An arm that does not follow a planned stop is braked from its state. The last kind of stop is kept, unless
            # nobody knew where the arm was when it began.
            if self.guessed and self.believed:
                self.guessed, self.stops = False, self.stops or [self.last_resort]
            return self.watchdog.astray(self.arm, sensed.state, self.q_wanted, self.t) if self.stops else ""
        if self.book.left < STOP_ROOM / self.period:  # slowed or paused for long
            return f"The run took longer than any run may at t = {self.t:.3f} s."
        if sensed.wrong:
            return f"What the arm reports at t = {self.t:.3f} s cannot be true: {sensed.wrong}."
        missed = round(sensed.elapsed / self.period) - 1
        return self.watchdog.complaint(self.arm, sensed.state, self.q_wanted, missed, self.t)

    def demand(self, state: ArmState, wish: str) -> Array:
        """Torque of the controller or the stop; if that fails, of the next stop."""
        if wish:
            self.brake(state, wish)
        while True:
            try:
                step = self.wanted_command(state)
                if np.shape(step) != self.sent.shape or not np.all(np.isfinite(step)):
                    raise ArithmeticError("a command that is not a finite number for each joint")
                return step
            except BaseException as error:
                if not self.stops:
                    raise
                who = "The controller" if self.stop is None else "The stop"
                self.brake(state, f"{who} failed at t = {self.t:.3f} s ({named(error)}).")

    def wanted_command(self, state: ArmState) -> Array:
        if self.by_torque:
            return self.controller.step(state, self.t) if self.stop is None else self.stop.step(state, self.s)
        q, dq, _ = self.reference()
        return q if self.robot.takes == "position" else dq + self.drawn_back * (self.q_wanted - state.q)

    @property
    def s(self) -> float:
        """Time since the stop began, s."""
        return self.t - self.since

    def brake(self, state: ArmState, why: str) -> None:
        self.stopped = " ".join([*filter(None, [self.stopped]), why])
        if not self.by_torque:  # an arm with its own control goes on from the last command
            state = ArmState(*self.reference()[:2])
        if self.stop is None and self.factor < 1.0:  # the motion's own stops were checked at full speed
            del self.stops[0]
            factor = self.factor
            if rate := self.speed_rate:
                loaded, gains, path, how = self.loaded, self.gains, self.wanted, self.watchdog.stop
                self.stops.insert(0, lambda state, t: PathStop(loaded, gains, state, path, t, factor, rate, how))
        self.since, self.stopping, self.guessed = self.t, 0, not self.believed
        while self.stops:
            try:
                self.stop = self.stops.pop(0)(state, self.t)
                return
            except BaseException as error:
                self.stopped += f" A stop could not begin ({named(error)})."
        raise SalverError("No stop could begin.")

    def over(self, sensed: Sensed) -> bool:
        """Whether control may end: the arm is at rest."""
        if self.stop is None:
            due, waited = self.t >= self.end - 0.5 * self.period, self.t - self.end
        else:
            # Counted in periods: a robot's clock that runs ahead must not end a stop while the arm still moves.
            due, waited = self.s >= self.stop.duration, self.stopping * self.period - self.stop.duration
            if not self.senses.sees:  # no holding without measurements
                return min(self.s, self.stopping * self.period) >= self.stop.duration - self.watchdog.stop.hold
        return due and (waited >= self.watchdog.longest_wait or self.at_rest(sensed))

    def at_rest(self, sensed: Sensed) -> bool:
        return bool((np.abs(sensed.state.dq) <= self.watchdog.at_rest).all())

    def leave(self) -> None:
        """Leave torque control, with several attempts if necessary."""
        for _ in range(ATTEMPTS):
            try:
                self.robot.stop()
                return
            except BaseException as error:
                failure = named(error)
        self.stopped = " ".join(
            [*filter(None, [self.stopped]), f"{self.robot.source} could not be told to stop ({failure})."]
        )

    def failure(self, error: BaseException) -> str:
        """The reason of the stop in one sentence, which quotes the robot if it gave one."""
        if isinstance(error, SalverError):
            return str(error)
        return f"Torque control ended at t = {self.t:.3f} s: {named(error)}."


def named(error: BaseException) -> str:
    """An exception in words."""
    return f"{type(error).__name__}: {error}" if str(error) else type(error).__name__


class _Book:
    """Rows of the log in an array that exists before the loop starts: nothing is allocated in it."""

    def __init__(self, room: int, n: int) -> None:
        joints = [(name, float, (n,)) for name in ("q", "dq", "sent", "q_wanted")]
        kinds = [*((name, float) for name in ("t", "woken", "elapsed")), ("bridged", bool), *joints, ("spent", float)]
        try:
            self._rows = np.zeros(room, kinds)
        except MemoryError:
            raise SalverError(
                f"The log of {room} periods does not fit into memory; make the run shorter (--option longest)."
            ) from None
        self._count = 0

    @property
    def left(self) -> int:
        return len(self._rows) - self._count

    def add(self, t: float, sensed: Sensed, sent: Array, q_wanted: Array, woken: float) -> None:
        state, wrong = sensed.state, bool(sensed.wrong)
        row = (t, woken, sensed.elapsed, wrong, state.q, state.dq, sent, q_wanted, time.perf_counter() - woken)
        self._rows[self._count] = row
        self._count += 1

    def closed(self, stopped: str, saturation: dict[str, float], keeps_load: bool | None) -> ExecutionLog:
        rows = self._rows[: self._count]
        columns = {name: np.ascontiguousarray(rows[name]) for name in rows.dtype.names or ()}
        return ExecutionLog(**columns, stopped=stopped, saturation=saturation, keeps_load=keeps_load)


def timing(log: ExecutionLog, period: float) -> dict[str, Any]:
    """Statistics of the loop's period. Times in s.

    jitter: deviation of the time between two states from the period. late: share of deviations above half a period.
    missed: periods without a torque from this loop. step: time from state to torque.
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
