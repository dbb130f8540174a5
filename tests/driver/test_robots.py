"""Robots that take positions or velocities, driven by the loop that drives a torque: late, slowed, stopped."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
import pytest

from driver_rig import Rig
from salver.control.arm import ArmState, controller_for
from salver.driver import execution
from salver.driver.execution import Drive, ExecutionLog, Watchdog
from salver.driver.robots.robots import robot_class, robot_options
from salver.driver.signals import Signals
from salver.driver.stops import PathStop, StopOptions, stops_of
from salver.errors import SalverError
from salver.geometry import Array

NAN = float("nan")


@pytest.mark.parametrize(
    ("robot", "values", "words"),
    [
        (
            "xarm",
            {"latency": 0.05},
            'The robot "xarm" has no option latency; it has timeout, settling, near, turned, lag.',
        ),
        ("simulated", {"lag": 0.05}, 'The robot "simulated" has no option lag; it has none.'),
        ("franka", {"contact": 30.0}, 'The robot "franka" has no option contact; it has rate_share, longest_step.'),
        ("ur", {"patience": 90.5}, "patience is 90.5; it must be a whole number above 0."),
        ("ur", {"lookahead": 0.3}, "lookahead of servoj is 0.3; it must be from 0.03 to 0.2."),
        ("ur", {"gain": 50.0}, "gain of servoj is 50; it must be from 100 to 2000."),
        ("ur", {"gain": NAN}, "gain is nan; it must be a number above 0."),
        ("reachy", {}, 'There is no robot "reachy"; known are simulated, franka, ur, xarm.'),
    ],
)
def test_options_that_a_robot_does_not_have_are_refused(robot: str, values: dict[str, float], words: str) -> None:
    with pytest.raises(SalverError) as refused:
        robot_options(robot, values)
    assert str(refused.value) == words


class Follower:
    """An arm that follows its commands exactly, a lag late. speeds: the factor at which it runs, from a time on."""

    source, period = "follower", 2e-3

    def __init__(self, rig: Rig, takes: str, lag: float = 0.03, speeds: Any = lambda t: 1.0) -> None:
        self.takes, self.lag, self.speeds, self.t = takes, lag, speeds, -0.052
        self.q, self.dq = rig.plan.joint.q[0].copy(), np.zeros(7)  # type: ignore[union-attr]
        first = self.q if takes == "position" else self.dq
        self.sent, self.late = [], deque([first] * round(lag / self.period))
        self.spoil: Any = lambda state, t: state
        self.asked: Any = lambda t: None
        self.speed, self.over, self.blocked_from = speeds(self.t), False, np.inf
        self.rng = np.random.default_rng(1)

    def look(self) -> ArmState:
        return ArmState(self.q.copy(), self.dq.copy())

    def start(self) -> None:
        self.first = True

    def read(self) -> tuple[ArmState, float]:
        self.t += self.period
        self.speed = self.speeds(self.t)
        self.asked(self.t)
        first, self.first = self.first, False
        return self.spoil(self.look(), self.t), 0.0 if first else self.period

    def write(self, command: Array, sensed: Any, *, last: bool = False) -> None:
        self.sent.append(command)
        self.late.append(command)
        command = self.late.popleft()
        before = self.q
        if self.t > self.blocked_from:
            command = self.q + 1e-7 * self.rng.normal(size=7) if self.takes == "position" else 0 * self.q
        self.q = command if self.takes == "position" else before + self.period * command
        self.dq = (self.q - before) / self.period

    def stop(self) -> None:
        self.over = True


def drive(rig: Rig, robot: Follower, signals: Signals | None = None, rate: float | None = 0.25) -> ExecutionLog:
    plan, arm, carried = rig.plan, rig.arm, rig.carried
    controller = controller_for(plan.scenario, plan.joint, plan.reference, arm=arm)  # type: ignore[arg-type]
    stops = stops_of(plan, controller, arm, carried)
    end = plan.duration + 0.1
    log = Drive(
        robot,
        controller,
        plan.joint,
        arm,
        carried,
        -0.05,
        end,
        Watchdog(),
        stops,
        signals or Signals(),
        rate,  # type: ignore[arg-type]
    ).run()
    assert robot.over
    assert np.abs(robot.dq).max() < 0.02
    return log


@pytest.mark.parametrize("takes", ["position", "velocity"])
def test_a_plan_is_followed_by_who_takes_positions_or_velocities(safe: Rig, takes: str) -> None:
    robot = Follower(safe, takes)
    if takes == "velocity":
        robot.q[2] += 5e-3  # drawn back, by a factor of e in 0.2 s
    log = drive(safe, robot)
    joint = safe.plan.joint
    assert log.stopped == ""
    assert log.keeps_load is None
    assert np.abs(robot.q - joint.q[-1]).max() < 2e-3
    wanted = joint.sample(np.clip(log.t, 0, joint.duration))
    if takes == "position":
        np.testing.assert_allclose(log.sent, wanted[0], atol=1e-9)
        assert np.abs(log.q - log.q_wanted).max() < 1e-9  # nothing is amiss: it is late, as it said
    else:
        assert np.abs(log.sent - wanted[1])[log.t > 0.6].max() < 0.02
    assert np.abs(log.q - wanted[0]).max() > 0.01


def test_positions_do_not_catch_up_on_periods_that_were_missed(safe: Rig) -> None:
    """Three periods pass now and then, in which the arm holds its last command: no step is longer for that."""

    class Missing(Follower):
        def read(self) -> tuple[ArmState, float]:
            state, elapsed = super().read()
            if len(self.sent) % 60 != 59:
                return state, elapsed
            self.dq = np.zeros(7)
            return self.look(), 3 * self.period

    robot = Missing(safe, "position")
    log = drive(safe, robot)
    assert log.stopped == ""
    steps = np.abs(np.diff(robot.sent, axis=0)).max(axis=0)
    assert np.all(steps <= robot.period * np.abs(safe.plan.joint.dq).max(axis=0) * 1.01 + 1e-9)  # type: ignore[union-attr]


def test_a_robot_at_half_speed_is_commanded_the_motion_at_half_speed(safe: Rig) -> None:
    robot = Follower(safe, "position", speeds=lambda t: 0.5)
    log = drive(safe, robot)
    joint = safe.plan.joint
    assert log.stopped == ""
    np.testing.assert_allclose(robot.sent, joint.sample(np.clip(log.t, 0, joint.duration))[0], atol=1e-9)
    assert len(log.t) == pytest.approx((joint.duration + 0.15) / 0.5 / robot.period, abs=30)


@pytest.mark.parametrize("to", [0.6, 1.0])
def test_the_speed_factor_changes_as_fast_as_the_load_allows(safe: Rig, to: float) -> None:
    """From 0.8 at 0.25 1/s, whatever the slider does at once."""
    robot = Follower(safe, "position", speeds=lambda t: 0.8 if t < 0.4 else to)
    log = drive(safe, robot)
    assert log.stopped == ""
    factors = np.diff(log.t) / robot.period
    moving = (log.t[1:] > 0.01) & (log.t[1:] < safe.plan.duration)
    changes = np.diff(factors[moving])
    assert np.abs(changes).max() == pytest.approx(0.25 * robot.period)
    assert factors[moving][0] == pytest.approx(0.8)
    assert factors[-1] == pytest.approx(to)


@pytest.mark.parametrize("factor", [1.0, 0.5])
def test_a_stop_is_the_planned_one_at_full_speed_and_along_the_path_at_less(safe: Rig, factor: float) -> None:
    signals = Signals()
    robot = Follower(safe, "position", speeds=lambda t: factor)
    robot.asked = lambda t: signals.note("Protective stop") if t > 0.5 else None
    log = drive(safe, robot, signals)
    assert log.stopped.startswith("Protective stop at t = ")
    assert log.keeps_load is True
    begun = float(log.stopped.split("t = ")[1].split(" s")[0])
    if factor == 1.0:
        course = safe.plan.stops.course(begun)  # type: ignore[union-attr]
        end = safe.plan.stops.motion(course.stop).q[-1]  # type: ignore[union-attr, arg-type]
    else:
        end = safe.plan.joint.sample(begun + 0.5 * factor * factor / 0.25)[0][0]  # type: ignore[union-attr]
    assert np.abs(robot.sent[-1] - end).max() < 2e-3
    steps = np.diff(robot.sent, axis=0) / robot.period
    assert np.abs(np.diff(steps, axis=0)).max() / robot.period < 1.2 * safe.arm.limits.acceleration.max()


def test_an_arm_that_does_not_follow_its_stop_is_not_said_to_keep_its_load(safe: Rig) -> None:
    signals = Signals()
    robot = Follower(safe, "position")
    robot.asked = lambda t: signals.note("Asked") if t > 0.5 else None
    off = 0.02 * np.eye(7)[2]
    robot.spoil = lambda state, t: ArmState(
        state.q + off * np.clip((t - 0.5) / 0.2, 0, 1), state.dq + off * 5 * (0.5 < t < 0.7)
    )
    log = drive(safe, robot, signals)
    assert log.stopped.startswith("Asked at t = 0.50")
    assert log.keeps_load is False


def test_a_motion_for_full_speed_only_is_stopped_where_the_robot_is_slowed(safe: Rig) -> None:
    robot = Follower(safe, "position", speeds=lambda t: 1.0 if t < 0.5 else 0.9)
    log = drive(safe, robot, rate=None)
    assert log.stopped == "The robot's speed is at 90 %, and this motion keeps its load at full speed only."
    assert log.keeps_load is True


def test_a_motion_whose_speed_may_not_change_underway_is_stopped_where_the_robot_is_slowed(safe: Rig) -> None:
    """`motion.speed_rate = 0`. Slowed before it begins it runs at that speed; its stops are for full speed."""
    log = drive(safe, Follower(safe, "position", speeds=lambda t: 1.0 if t < 0.5 else 0.5), rate=0.0)
    assert log.stopped == "The robot's speed is at 50 %, and this motion keeps its load at constant speed only."
    assert log.keeps_load is True
    signals = Signals()
    robot = Follower(safe, "position", speeds=lambda t: 0.5)
    robot.asked = lambda t: signals.note("Asked") if t > 0.5 else None
    log = drive(safe, robot, signals, rate=0.0)
    assert log.stopped.startswith("Asked at t = 0.2")
    assert log.keeps_load is False


@pytest.mark.parametrize("takes", ["position", "velocity"])
def test_a_reading_that_cannot_be_true_stops_a_robot_that_follows_by_itself(safe: Rig, takes: str) -> None:
    robot = Follower(safe, takes)
    robot.spoil = lambda state, t: ArmState(state.q, state.dq + (NAN if 0.5 < t < 0.503 else 0.0))
    log = drive(safe, robot)
    assert log.stopped.startswith("What the arm reports at t = 0.50")
    assert log.keeps_load is True


def test_an_arm_that_is_blocked_is_stopped(safe: Rig) -> None:
    robot = Follower(safe, "position")
    robot.blocked_from = 0.4
    log = drive(safe, robot)
    assert "rad off its reference at t = 0.4" in log.stopped
    assert log.keeps_load is False


def test_a_run_that_is_paused_for_long_is_stopped_with_its_load(safe: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """The log has room for the motion and half a second, twice; a stop gets half a second of it."""
    monkeypatch.setattr(execution, "STOP_ROOM", 0.5)
    robot = Follower(safe, "position", speeds=lambda t: 0.8 if t < 0.3 else 0.0)
    log = drive(safe, robot, rate=2.0)
    assert log.stopped.startswith("The run took longer than any run may at t = ")
    assert log.keeps_load is True
    assert len(log.t) < 2 * (safe.plan.duration + 0.15 + 0.5) / robot.period


def test_a_path_stop_is_smooth_and_ends_at_rest(safe: Rig) -> None:
    """Rates agree with differences."""
    plan, arm = safe.plan, safe.arm
    controller = controller_for(plan.scenario, plan.joint, plan.reference, arm=arm)  # type: ignore[arg-type]
    q, dq, _ = plan.joint.sample(0.4)  # type: ignore[union-attr]
    state = ArmState(q[0], 0.6 * dq[0])
    stop = PathStop(controller.arm, (100.0, 20.0), state, controller._joint, 0.4, 0.6, 0.5, StopOptions())
    assert stop.exact
    assert stop.rests == pytest.approx(1.2)
    for s in (0.0, 0.3, 0.9):
        q, dq, ddq = stop.reference(s)
        before, after = stop.reference(max(s - 1e-4, 0)), stop.reference(s + 1e-4)
        width = 1e-4 if s == 0 else 2e-4
        assert np.abs((after[0] - before[0]) / width - dq).max() < 1e-3
        assert np.abs((after[1] - before[1]) / width - ddq).max() < 2e-2
    assert np.abs(stop.reference(1.3)[1]).max() == 0.0


def test_robots_are_known_by_name() -> None:
    assert robot_class("franka").takes == "torque"
    with pytest.raises(SalverError, match='no robot "spot"; known are simulated, franka'):
        robot_class("spot")
