"""What is believed of the arm, sample by sample: false, frozen and missing readings beside what is commanded."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from driver_rig import Rig
from salver.control.arm import ArmState
from salver.driver.sensing import Senses
from salver.errors import SalverError
from salver.geometry import Array

NAN = float("nan")


def test_senses_name_what_is_wrong(rig: Rig) -> None:
    q = rig.plan.joint.q[0]  # type: ignore[union-attr]
    good = ArmState(q.copy(), np.zeros(7))

    def said(state: Any, elapsed: Any = 1e-3) -> str:
        return Senses(rig.arm, 1e-3, good).take((state, elapsed), good).wrong

    turn = np.eye(7)[2]
    assert said(good) == ""
    # Half of 2.175 rad/s are 1.0875 rad/s; 5 mrad may be left between positions and speeds.
    for way in (1.0, -1.0):
        assert said(ArmState(q + way * 0.0049 * turn, np.zeros(7))) == ""
        words = said(ArmState(q + way * 0.0051 * turn, np.zeros(7)))
        at = q[2] + way * 0.0051
        assert words == f"panda_joint3 is said to be at {at:.5g} rad, 0.0051 rad off what its speeds make of it"
        assert said(ArmState(q, way * 1.08 * turn)) == ""
        words = said(ArmState(q, way * 1.09 * turn))
        assert words == f"panda_joint3 is said to move at {way * 1.09:.3g} rad/s, after 0 rad/s"
    assert "panda_joint3 is said to be at 4 rad" in said(ArmState(np.where(turn > 0, 4.0, q), np.zeros(7)))
    for way in (1.0, -1.0):
        assert f"move at {way * 44:g} rad/s, which it cannot" in said(ArmState(q, 44.0 * way * turn))  # 20 limits: 43.5
    assert "no state of its joints" in said(ArmState(q[:6], np.zeros(7)))
    assert "no state of its joints" in said(ArmState(np.array(["x"] * 7), np.zeros(7)))
    for number in (NAN, np.inf, -np.inf):
        assert f"the position of panda_joint3 is {number}" in said(ArmState(np.where(turn > 0, number, q), 0.0 * q))
        assert f"the speed of panda_joint3 is {number}" in said(ArmState(q, np.where(turn > 0, number, 0.0)))
    assert "its clock says that 2 s passed" in said(good, 2.0)
    assert "its clock says that inf s passed" in said(good, np.inf)
    with pytest.raises(SalverError, match="cannot be believed: the speed of panda_joint1 is nan"):
        Senses(rig.arm, 1e-3, ArmState(q, np.full(7, NAN)))


class Watched:
    """An arm that is commanded to accelerate steadily, and does; what is believed of readings of it."""

    def __init__(self, rig: Rig, acceleration: Array) -> None:
        self.q, self.dq, self.ddq = rig.plan.joint.q[0].copy(), np.zeros(7), acceleration  # type: ignore[union-attr]
        self.commanded = ArmState(self.q, self.dq)
        self.senses = Senses(rig.arm, 1e-3, self.commanded)

    def goes(self, periods: int, reading: Any = lambda q, dq, k: (q, dq)) -> Any:
        """What is sensed after the last of some periods, when (q, dq) are reported as `reading` says."""
        for k in range(periods):
            before = self.commanded
            dq = before.dq + 1e-3 * self.ddq
            self.commanded = ArmState(before.q + 1e-3 * dq, dq)
            self.dq = self.dq + 1e-3 * self.ddq
            self.q = self.q + 1e-3 * self.dq
            sensed = self.senses.take((ArmState(*reading(self.q, self.dq, k)), 1e-3), before)
            sensed.take_for(self.commanded)
        return sensed

    def off(self, sensed: Any) -> float:
        return float(np.abs(sensed.state.dq - self.dq).max())


GOING = np.array([1.0, -2.0, 1.0, 1.0, 1.0, 1.0, 1.0])  # rad/s^2


def test_a_state_that_froze_at_rest_is_told_by_what_is_commanded(rig: Rig) -> None:
    """Nothing is new in it, so the arm is taken to be where it is commanded to be, and no torque is made of it."""
    arm = Watched(rig, GOING)
    arm.goes(1)
    q, dq = arm.q, arm.dq
    assert np.abs(dq).max() < 0.01
    sensed = arm.goes(100, lambda *_: (q, dq))
    assert "reports the same state again though it moves" in sensed.wrong
    assert arm.senses.blind > 10
    assert np.abs(arm.dq - dq).max() > 0.1
    assert arm.off(sensed) < 1e-6
    assert arm.senses.blind


def test_what_stands_still_and_is_repeated_is_no_fault(rig: Rig) -> None:
    arm = Watched(rig, np.zeros(7))
    q = arm.q
    assert arm.goes(300, lambda *_: (q, np.zeros(7))).wrong == ""


@pytest.mark.parametrize("value", [0.8, -0.05, -0.8])
def test_a_joint_that_is_said_to_be_elsewhere_is_named_and_for_a_while_not_followed_there(
    rig: Rig, value: float
) -> None:
    """What it is off by fades with 50 ms; after that and eight readings it is believed to be there."""
    arm = Watched(rig, 0.3 * GOING)
    arm.goes(50)

    def false(q: Array, dq: Array, k: int) -> tuple[Array, Array]:
        return np.where(np.arange(7) == 3, value + q, q), dq

    gone = int(1e3 * 0.05 * np.log(abs(value) / 0.005)) + 1 + 8
    for periods in (1, gone - 2):
        sensed = arm.goes(periods, false)
        assert sensed.wrong
        assert abs(sensed.state.q[3] - arm.q[3]) < 1e-3
        assert arm.off(sensed) < 1e-3
    sensed = arm.goes(2, false)
    assert sensed.wrong == ""
    assert sensed.state.q[3] == arm.q[3] + value


@pytest.mark.parametrize("factor", [-1.0, 0.5, 2.0])
def test_speeds_that_are_not_those_of_the_positions_are_noticed(rig: Rig, factor: float) -> None:
    arm = Watched(rig, GOING)

    def false(q: Array, dq: Array, k: int) -> tuple[Array, Array]:
        return q, np.where(np.arange(7) == 1, factor * dq, dq)

    arm.goes(150)
    assert abs(arm.dq[1]) > 0.2
    assert arm.senses.blind == 0
    assert "panda_joint2 is said to be at" in arm.goes(100, false).wrong
    assert arm.senses.blind > 50


def test_an_arm_that_is_pushed_is_believed_against_its_command(rig: Rig) -> None:
    """Positions and speeds agree and move: a hand, a friction, a weak motor."""
    arm = Watched(rig, GOING)
    for _ in range(150):
        arm.goes(1)
        arm.dq = arm.dq + 1e-3 * np.array([6.0, -3.0, 4.0, 5.0, -8.0, 8.0, 8.0])
    sensed = arm.goes(1)
    assert sensed.wrong == ""
    assert arm.off(sensed) == 0.0


def test_a_clock_that_runs_ahead_is_told_by_the_joints(rig: Rig) -> None:
    arm = Watched(rig, GOING)
    arm.goes(200)
    sensed = arm.senses.take((ArmState(arm.q + 1e-3 * arm.dq, arm.dq), 0.05), arm.commanded)
    assert "its clock says that 0.05 s passed, and its joints went as far as in 0.001 s" in sensed.wrong
    assert sensed.elapsed == 1e-3


@pytest.mark.parametrize("moved", [0.0, 0.0049, 0.0051, -0.4])
def test_a_joint_that_was_not_seen_is_believed_again_where_it_is_commanded_or_after_eight_readings(
    rig: Rig, moved: float
) -> None:
    arm, joint = Watched(rig, 0.1 * GOING), np.arange(7) == 1

    def reading(q: Array, dq: Array, k: int) -> tuple[Array, Array]:
        return np.where(joint, q + moved if k >= 15 else NAN, q), dq

    assert arm.goes(15, reading).wrong != ""
    assert not arm.senses.sees
    sensed = arm.goes(1, lambda q, dq, k: reading(q, dq, 15))
    assert (sensed.wrong == "") == (abs(moved) < 0.005)
    assert arm.senses.sees == (abs(moved) < 0.005)
    faded = 0 if abs(moved) < 0.005 else int(1e3 * 0.05 * np.log(abs(moved) / 0.005)) + 1
    sensed = arm.goes(faded + 8, lambda q, dq, k: reading(q, dq, 15))
    assert sensed.wrong == ""
    assert sensed.state.q[1] == arm.q[1] + moved


@pytest.mark.parametrize("way", [1.0, -1.0])
@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_a_speed_may_change_at_any_time_within_a_period(rig: Rig, share: float, way: float) -> None:
    """A joint that is struck, 300 rad/s^2 in 25 periods: its positions go by the old speeds, or by the new ones."""
    arm, turn = Watched(rig, np.zeros(7)), way * np.eye(7)[1]
    q, dq = arm.q, np.zeros(7)
    for k in range(25):
        before, dq = dq, dq + 0.3 * turn + 1e-9 * (turn == 0)  # no joint repeats its reading
        q = q + 1e-3 * ((1 - share) * before + share * dq)
        sensed = arm.senses.take((ArmState(q, dq), 1e-3), arm.commanded)
        assert sensed.wrong == "", k
        assert sensed.state.dq[1] == dq[1]


@pytest.mark.parametrize("periods", [1, 3])
def test_in_periods_that_were_missed_a_speed_changes_as_often(rig: Rig, periods: int) -> None:
    """By half of 2.175 rad/s in each."""
    for share, wrong in ((0.99, False), (1.01, True)):
        arm, turn = Watched(rig, np.zeros(7)), np.eye(7)[1]
        dq = share * periods * 0.5 * 2.175 * turn
        sensed = arm.senses.take((ArmState(arm.q + 0.5e-3 * periods * dq, dq), 1e-3 * periods), arm.commanded)
        assert bool(sensed.wrong) == wrong
