"""How a run is ended: by the plan's own stops, which keep the load, or by others, and what is said of it."""

from __future__ import annotations

import signal
import threading
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from driver_rig import Fault, Rig, one, spoilt
from salver.control.arm import ArmState, controller_for
from salver.driver.execution import Drive, Watchdog
from salver.driver.robots.simulated import SimulatedRobot
from salver.driver.signals import Signals
from salver.driver.stops import PlannedStops, controlled_stops, stops_of
from salver.geometry import Array
from salver.models.arm.arm import load_arm
from salver.planning.plan import Plan

NAN = float("nan")


class Asking(SimulatedRobot):
    """The simulated arm; at a period somebody else asks for a stop."""

    def __init__(self, plan: Plan, arm: Any, signals: Signals, at: int) -> None:
        super().__init__(plan, arm, 3.0, realtime=False)
        self.signals, self.left = signals, at

    def read(self) -> Any:
        self.left -= 1
        if self.left == 0:
            thread = threading.Thread(target=self.signals.note, args=("Protective stop",))
            thread.start()
            thread.join()
        return super().read()


class _Careful:
    """A stop that claims to keep the load; it begins as told and may fail later."""

    keeps_load = True

    def __init__(self, plan: Plan, state: ArmState, t: float, fails: bool) -> None:
        arm = load_arm(plan.scenario.arm, plan.scenario.tray)  # type: ignore[arg-type]
        self.inner, self.t, self.fails = controlled_stops(arm, plan.scenario.payload.bodies)(state, t), t, fails
        self.duration = self.inner.duration

    def step(self, state: ArmState, s: float) -> Array:
        if self.fails and s > 0.1:
            raise ArithmeticError("out of its table")
        return self.inner.step(state, s)

    def reference(self, s: float) -> Any:
        return self.inner.reference(s)


@pytest.mark.slow
@pytest.mark.parametrize("fails", [False, True])
def test_another_stop_can_be_given_and_the_cool_one_stands_behind_it(rig: Rig, fails: bool) -> None:
    plan, arm, carried = rig.plan, rig.arm, rig.carried
    begun: list[_Careful] = []

    def careful(state: ArmState, t: float) -> _Careful:
        begun.append(_Careful(plan, state, t, fails))
        return begun[-1]

    signals = Signals()
    robot = Asking(plan, arm, signals, at=500)
    controller = controller_for(plan.scenario, plan.joint, plan.reference, arm=arm)  # type: ignore[arg-type]
    log_ = Drive(robot, controller, plan.joint, arm, carried, -0.05, 1.3, Watchdog(), careful, signals).run()  # type: ignore[arg-type]
    assert len(begun) == 1
    assert log_.stopped.startswith(f"Protective stop at t = {begun[0].t:.3f} s.")
    assert log_.keeps_load is not fails
    assert ("The stop failed" in log_.stopped) == fails
    assert np.abs(robot.look().dq).max() < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("period", [20, 51, 120, 431, 777, 1295, 1330])
def test_ctrl_c_takes_the_planned_stop_of_the_instant_and_the_load_stays(safe: Rig, period: int) -> None:
    outcome = one(safe, Fault("read", period, 1, "", signals=(signal.SIGINT,)))
    summary, library = outcome.result.summary, safe.plan.stops
    now = (period - 50) * 1e-3
    assert summary["stopped"] == f"Interrupted at t = {now:.3f} s."
    assert summary["load_kept_in_stop"] is True
    assert summary["outcome"] == "holds"
    assert summary["saturation"]["gate_cut"] == summary["saturation"]["torque_rate"] == 0  # nothing jumped
    t, q = outcome.result.arrays["t"], outcome.result.arrays["q"]
    rests = library.course(now).rests  # type: ignore[union-attr]
    assert t[-1] < rests + 0.35
    assert np.abs(q[t >= rests] - q[-1]).max(initial=0.0) < 1e-3
    assert summary["joint_error_peak"] < 1e-3  # against what the stop wants, not against the plan


@pytest.mark.slow
def test_what_becomes_of_the_arm_in_a_stop_is_said_as_it_is(safe: Rig) -> None:
    """A planned stop that fails, one in which the arm is not seen, and one that it does not follow."""
    ask = Fault("read", 250, 1, "", signals=(signal.SIGINT,))
    failed = one(safe, ask, Fault("stopping", 280, 10**6, "", error=lambda: ArithmeticError("table"))).result.summary
    assert "The stop failed at t = 0.230 s (ArithmeticError: table)." in failed["stopped"]
    blind = one(safe, ask, Fault("read", 270, 11, "", spoilt("q", NAN))).result.summary
    pushed = one(safe, ask, Fault("stopping", 255, 40, "", lambda torque: torque + 20.0 * np.eye(7)[0])).result.summary
    assert [x["load_kept_in_stop"] for x in (failed, blind, pushed)] == [False, False, False]
    cannot = one(safe, ask, Fault("planned", 0, 10**6, "", error=lambda: MemoryError())).result.summary
    assert "A stop could not begin (MemoryError)." in cannot["stopped"]
    assert cannot["load_kept_in_stop"] is False


def test_a_stop_keeps_the_load_while_no_joint_is_farther_off_than_was_checked(safe: Rig) -> None:
    """Each stop has its own bounds, the plan's end the last, the same to both sides; what is measured may be 0.5 mrad
    off."""
    plan, arm, carried = safe.plan, safe.arm, safe.carried
    controller = controller_for(plan.scenario, plan.joint, plan.reference, arm=arm, space=plan.space)  # type: ignore[arg-type]
    stops = PlannedStops(plan, controller, arm, carried)
    count = len(stops.library.t)
    bounds = 1e-3 * (1 + np.arange(7 * (count + 1)).reshape(count + 1, 7))
    stops.library = replace(stops.library, stray=bounds)
    taken = set()
    for t in (0.1, 0.5, plan.duration + 0.1):
        number = stops.library.course(t).stop
        taken.add(number)
        own = bounds[-1 if number is None else number]
        for turn, bound in zip(np.diag([1.0, -1, 1, -1, 1, -1, 1]), own, strict=True):
            for beyond, keeps in ((4e-4, True), (6e-4, False)):
                q, dq, _ = stops(ArmState(np.zeros(7), np.zeros(7)), t).course(0.0)
                assert stops(ArmState(q + (bound + beyond) * turn, dq), t).keeps_load == keeps
                stop = stops(ArmState(q, dq), t)
                q, dq, _ = stop.course(0.2)
                stop.step(ArmState(q + (bound + beyond) * turn, dq), 0.2)
                assert stop.keeps_load == keeps
    assert None in taken
    assert len(taken - {0, count - 1}) > 1


@pytest.mark.slow
def test_an_arm_that_is_elsewhere_is_not_drawn_back_but_goes_the_same_way_beside(safe: Rig) -> None:
    """And its speed beyond the plan's fades within what the maker allows."""
    plan, arm, carried = safe.plan, safe.arm, safe.carried
    controller = controller_for(plan.scenario, plan.joint, plan.reference, arm=arm, space=plan.space)  # type: ignore[arg-type]
    stops = stops_of(plan, controller, arm, carried)
    assert isinstance(stops, PlannedStops)
    t = 0.52
    q, dq, ddq = (x[0] for x in plan.joint.sample(t))  # type: ignore[union-attr]
    off, faster = np.linspace(-0.03, 0.04, 7), np.linspace(0.2, -0.15, 7)
    there, beside = (stops(ArmState(q + x, dq + y), t) for x, y in ((0.0, 0.0), (off, faster)))
    assert there.keeps_load
    assert not beside.keeps_load
    one = stops(ArmState(q + 0.03 * np.eye(7)[2], dq), t)  # a joint alone
    assert np.allclose(one.reference(0.0)[0], q + 0.03 * np.eye(7)[2], atol=2e-3)
    for value, expected in zip(beside.reference(0.0), (q + off, dq + faster, ddq), strict=True):
        assert np.allclose(value, expected, atol=2e-3)  # between two samples of the loop's table
    for s in (0.1, beside.duration):  # the speed is gone after 0.15 s at these limits
        difference = beside.reference(s)[0] - there.reference(s)[0] - off
        assert np.all(np.sign(difference) == np.sign(faster))
        assert np.all(np.abs(difference) < np.abs(faster) * 0.15)
    assert np.abs(beside.reference(beside.duration)[1]).max() < 1e-9


def test_a_controlled_stop_that_began_blindly_begins_again_when_the_arm_is_seen_elsewhere(safe: Rig) -> None:
    """A joint is not seen while a fault of its drive turns it away: its stop goes on from where it is, not from where
    it was commanded to be."""
    outcome = one(
        safe,
        Fault("planned", 600, 1, "no planned stop", error=RuntimeError),
        Fault("read", 600, 150, "no speed of a joint", change=spoilt("dq", NAN)),
        Fault("motor", 600, 140, "a drive that pushes", change=lambda torque: torque + 40.0 * np.eye(7)[3]),
    )
    words = outcome.result.summary["stopped"]
    assert words.count("panda_joint4") == 2
    assert "off its reference" in words
