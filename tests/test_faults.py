"""The driver survives its inputs: faults in samples, calls and torques, one by one and drawn at random."""

from __future__ import annotations

import os
import signal
import sys
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from faults import CASE, Fault, Outcome, Rig, draw
from pylibfranka_stand_in import Library
from salver.control.arm import ArmState, controller_for
from salver.driver import execute, logs
from salver.driver.execution import Drive, Watchdog
from salver.driver.gate import TorqueGate
from salver.driver.logs import arrays_of, check_place, keep
from salver.driver.preflight import Check
from salver.driver.robots import SimulatedRobot
from salver.driver.sensing import Senses
from salver.driver.signals import Signals, noted_signals
from salver.driver.stops import PlannedStop, PlannedStops, cool_stops, stops_of
from salver.errors import SalverError
from salver.files import load_npz, read_json
from salver.geometry import Array
from salver.models.arm import load_arm, with_load
from salver.planning.make import make_plan
from salver.planning.plan import Plan

NAN = float("nan")
# A clock that runs ahead while the arm is stopped; frozen, false, swapped readings; torques that shake it, or throw a
# joint against its stop.
LEFT_TURNING = (20082, 20033, 20749, 20903, 20595, 20621, 20779, 20873, 20069, 20243, 20425, 20443, 20689, 20708)


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Rig:
    return Rig(tmp_path_factory.mktemp("faults") / "run")


def spoilt(name: str, value: float) -> Any:
    def change(answer: Any) -> Any:
        state, elapsed = answer
        values = {"q": state.q.copy(), "dq": state.dq.copy()}
        values[name][3] = value
        return ArmState(**values), elapsed

    return change


def one(rig: Rig, *faults: Fault, franka: bool = False) -> Outcome:
    outcome = rig.throw(list(faults), franka)
    assert outcome.wrong() == []
    return outcome


# One by one ----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "value", "franka"),
    [
        ("q", NAN, False),
        ("q", NAN, True),
        ("dq", NAN, False),
        ("dq", -np.inf, True),
        ("q", 1e300, True),
        ("dq", 2.5, 0),
    ],
)
def test_one_bad_sample_is_bridged_and_the_motion_goes_on(rig: Rig, name: str, value: float, franka: bool) -> None:
    outcome = one(rig, Fault("read", 500, 1, "", spoilt(name, value)), franka=franka)
    summary = outcome.result.summary
    assert summary["stopped"] == ""
    assert summary["bridged"] == 1
    assert outcome.result.arrays["tray_e_p"].max() < 5e-4


@pytest.mark.slow
@pytest.mark.parametrize("franka", [False, True])
@pytest.mark.parametrize("lasts", [10, 11, 10**6])
def test_the_model_bridges_ten_periods_and_not_eleven(rig: Rig, lasts: int, franka: bool) -> None:
    """At 500 the arm moves fast; without any believable state it is braked by the model alone, and rests."""
    outcome = one(rig, Fault("read", 500, lasts, "", spoilt("dq", NAN)), franka=franka)
    summary = outcome.result.summary
    if lasts == 10:
        assert summary["stopped"] == ""
        assert summary["bridged"] == 10
        return
    assert summary["stopped"].startswith("The arm's state could not be believed for 11 periods up to t = 0.46")
    assert "10 are bridged: the speed of panda_joint4 is nan" in summary["stopped"]
    assert summary["load_kept_in_stop"] is False
    assert not outcome.result.achieved
    assert np.abs(outcome.robot.true().dq).max() < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("elapsed", [NAN, np.inf, -1e-3, 1e308, None])
def test_a_clock_that_is_wrong_once_is_bridged(rig: Rig, elapsed: Any) -> None:
    outcome = one(rig, Fault("read", 500, 1, "", lambda answer: (answer[0], elapsed)))
    assert outcome.result.summary["stopped"] == ""
    assert outcome.result.summary["bridged"] == 1


def test_a_clock_that_stands_still_is_a_reason_to_stop(rig: Rig) -> None:
    outcome = one(rig, Fault("read", 500, 10**6, "", lambda answer: (answer[0], 0.0)))
    assert "its clock says that 0 s passed" in outcome.result.summary["stopped"]


@pytest.mark.slow
def test_late_periods_are_seen_and_stop_the_arm(rig: Rig) -> None:
    for periods, stops in ((21, False), (22, True)):  # at rest, where the joints cannot say otherwise
        late = Fault("read", 20, 1, "", lambda answer, n=periods: (answer[0], n * 1e-3))
        stopped = one(rig, late).result.summary["stopped"]
        assert ("21 control periods in a row were missed" in stopped) == stops, stopped


def test_a_sensor_that_is_stuck_while_the_arm_moves_is_seen(rig: Rig) -> None:
    kept: list[Any] = []

    def stuck(answer: Any) -> Any:
        kept.append(answer)
        return kept[0]

    outcome = one(rig, Fault("read", 500, 10**6, "", stuck))
    assert "it reports the same state again though it moves" in outcome.result.summary["stopped"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("site", "error"),
    [
        ("read", OSError(5, "Input/output error")),
        ("write", RuntimeError("reflex")),
        ("start", MemoryError()),
        ("look", OSError("gone")),
    ],
)
def test_a_robot_that_fails_is_left_and_the_log_says_why(rig: Rig, site: str, error: BaseException) -> None:
    outcome = one(rig, Fault(site, 500 if site in ("read", "write") else 0, 1, site, error=lambda: error))
    stopped = outcome.result.summary["stopped"]
    assert type(error).__name__ in stopped
    assert outcome.robot.said[-1] == "stop"
    if site in ("read", "write"):
        assert "Torque control ended at t = 0.4" in stopped
        assert outcome.result.arrays["t"][-1] == pytest.approx(0.445)  # kept to a fifth of the rate
    assert not outcome.result.achieved


@pytest.mark.slow
def test_a_load_of_which_nothing_is_known_is_said_to_be_so_and_the_joints_log_stays(rig: Rig) -> None:
    """All that there is on a real arm too: two hundred samples a second of what the joints said."""
    outcome = one(rig, Fault("record", 0, 10**6, "record", error=lambda: MemoryError("no room")))
    summary, arrays = outcome.result.summary, outcome.result.arrays
    assert summary["load"] == "What became of the load was not measured (MemoryError: no room)."
    assert not summary["stopped"]
    assert "slip" not in arrays
    np.testing.assert_allclose(np.diff(arrays["t"]), 1 / 200, atol=1e-9)


@pytest.mark.slow
def test_an_arm_that_never_seems_to_rest_is_waited_for_a_second_after_its_stop(rig: Rig) -> None:
    """Its speeds are told 0.03 rad/s too high from when it is asked to stop."""
    higher = Fault("read", 500, 10**6, "", lambda answer: (ArmState(answer[0].q, answer[0].dq + 0.03), answer[1]))
    outcome = one(rig, higher, Fault("read", 500, 1, "", signals=(signal.SIGINT,)))
    assert outcome.result.summary["stopped"] == "Interrupted at t = 0.450 s."
    assert 1.0 < 1e-3 * (len(outcome.robot.sent) - 500) < 2.0


def test_what_the_robot_says_of_itself_is_quoted(rig: Rig) -> None:
    fault = Fault("read", 500, 1, "", error=lambda: RuntimeError("libfranka: joint_velocity_violation"))
    stopped = one(rig, fault, franka=True).result.summary["stopped"]
    assert stopped == "The arm at arm says: joint_velocity_violation"


@pytest.mark.slow
@pytest.mark.parametrize("signals", [(signal.SIGINT,), (signal.SIGINT,) * 3, (signal.SIGTERM, signal.SIGHUP)])
def test_ctrl_c_brakes_however_often_it_is_pressed(rig: Rig, signals: tuple[int, ...]) -> None:
    """Once, three times at once, and again and again while the arm brakes and the log is written."""
    for lasts in (1, 300)[: len(signals)]:
        outcome = one(rig, Fault("read", 500, lasts, "", signals=signals))
        word = {signal.SIGINT: "Interrupted", signal.SIGTERM: "Terminated"}[signal.Signals(signals[0])]
        assert outcome.result.summary["stopped"] == f"{word} at t = 0.450 s."
        assert outcome.robot.said[-2:] == ["last", "stop"]
        assert np.abs(outcome.robot.true().dq).max() < 0.02
        moving = np.abs(outcome.result.arrays["dq"]).max(axis=1)
        t = outcome.result.arrays["t"]
        assert moving[t < 0.45].max() > 0.3
        assert t[-1] < 1.3


@pytest.mark.slow
def test_an_interruption_anywhere_in_the_loop_or_while_the_log_is_written(rig: Rig) -> None:
    for site in ("read", "write", "row", "controller"):
        outcome = one(rig, Fault(site, 500, 1, site, error=KeyboardInterrupt))
        assert outcome.result.summary["stopped"].startswith("Interrupted at t = 0.45")
    assert one(rig, Fault("save", 0, 1, "save", error=KeyboardInterrupt)).result.achieved


def test_signals_are_as_before_afterwards() -> None:
    before = signal.getsignal(signal.SIGINT)
    with noted_signals() as signals:
        assert not signals.wish(0.0)
        os.kill(os.getpid(), signal.SIGINT)
        assert signals.wish(0.1) == "Interrupted at t = 0.100 s."
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.slow
@pytest.mark.parametrize("torque", [np.full(7, NAN), np.full(7, 1e300), np.zeros(6), None, "no"])
def test_a_controller_that_fails_ends_in_a_stop(rig: Rig, torque: Any) -> None:
    outcome = one(rig, Fault("controller", 500, 1, "", lambda _: torque))
    huge = isinstance(torque, np.ndarray) and np.isfinite(torque).all() and torque.shape == (7,)
    if huge:  # a number, only cut: one period of full torque rate, then the controller goes on
        assert outcome.result.summary["saturation"]["gate_cut"] > 0
    else:
        assert outcome.result.summary["stopped"].startswith("The controller failed at t = 0.450 s")
        assert outcome.robot.said[-2:] == ["last", "stop"]


@pytest.mark.slow
@pytest.mark.parametrize(("site", "words"), [("controller", "The controller failed"), ("row", "The log failed")])
def test_whatever_our_own_code_raises_the_arm_is_braked(rig: Rig, site: str, words: str) -> None:
    outcome = one(rig, Fault(site, 500, 10**6, site, error=lambda: SystemExit(1)))
    assert outcome.result.summary["stopped"].startswith(words)
    assert "SystemExit: 1" in outcome.result.summary["stopped"]
    assert outcome.robot.said[-2:] == ["last", "stop"]


@pytest.mark.slow
def test_a_disk_that_is_full_does_not_cost_the_log(rig: Rig) -> None:
    outcome = one(rig, Fault("save", 0, 10**6, "save", error=lambda: OSError(28, "No space left on device")))
    assert "salver-log-" in str(outcome.result.path)
    assert "No space left on device" in outcome.result.summary["log_elsewhere"]
    assert len(load_npz(outcome.result.path)["t"]) > 200


@pytest.mark.slow
def test_a_robot_that_cannot_be_told_to_stop_is_said_so(rig: Rig) -> None:
    assert rig.throw([Fault("stop", 0, 2, "stop", error=lambda: OSError("gone"))]).result.achieved  # the third time
    outcome = rig.throw([Fault("stop", 0, 9, "stop", error=lambda: OSError("gone"))])
    assert outcome.result.summary["stopped"] == "simulated arm could not be told to stop (OSError: gone)."


# Drawn at random -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("seed", [*range(12), *LEFT_TURNING])
def test_nothing_unsafe_leaves_and_no_log_is_lost(rig: Rig, safe: Rig, seed: int) -> None:
    """`python tests/faults.py -n 1000` throws a thousand."""
    faults = draw(seed)
    franka = seed % 3 == 0 and not any(fault.odd for fault in faults)
    assert (rig, safe)[seed % 2].throw(faults, franka).wrong() == [], [fault.words for fault in faults]


# The parts -----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@settings(max_examples=200, deadline=None, derandomize=True)
@given(st.lists(st.lists(st.floats() | st.just(NAN), min_size=1, max_size=4), max_size=12), st.floats())
def test_only_numbers_within_the_limits_pass_the_gate(wanted: list[list[float]], start: float) -> None:
    limit, rate, period = np.array([87.0, 12.0, np.inf]), np.array([1000.0, np.inf, 10.0]), 1e-3
    gate = TorqueGate(limit, rate, period, np.full(3, start))
    last = gate(np.full(3, NAN))
    for torque in wanted:
        sent = gate(np.array(torque))
        assert np.all(np.isfinite(sent))
        assert np.all(np.abs(sent) <= limit)
        assert np.all(np.abs(sent - last) <= rate * period + 1e-12 * np.abs(last))
        last = sent


def test_the_gate_lets_through_what_is_within_the_limits() -> None:
    gate = TorqueGate(np.full(2, 10.0), np.full(2, 1000.0), 1e-3, np.array([1.0, -1.0]))
    assert gate(np.array([1.5, -1.9])).tolist() == [1.5, -1.9]
    assert gate(np.array([4.0, NAN])).tolist() == [2.5, -1.9]  # a step of 1 N m; what it had
    assert (gate.cut, gate.closed) == (1, 1)


def test_the_model_goes_on_where_the_arm_goes(rig: Rig) -> None:
    """Ten periods bridged at full speed, beside the engine's own arm: off by what its load's contact makes, no more."""
    arm, carried, plan = rig.arm, rig.carried, rig.plan
    robot = SimulatedRobot(plan, arm, 1.0, realtime=False)
    controller = controller_for(plan.scenario, plan.joint, plan.reference, arm=arm)  # type: ignore[arg-type]
    robot.start()
    senses, t, torque = Senses(arm, carried, 1e-3, robot.look()), robot.start_time, np.zeros(7)
    for k in range(510):
        state, elapsed = robot.read()
        t += elapsed
        sensed = senses.take((state, elapsed) if k < 500 else None, torque)
        torque = controller.step(sensed.state, t)
        robot.write(torque, sensed)
        if k == 499:
            assert sensed.wrong == ""
            assert np.abs(state.dq).max() > 0.3
    assert np.abs(sensed.state.q - state.q).max() < 2e-5
    assert np.abs(sensed.state.dq - state.dq).max() < 5e-3


def test_senses_name_what_is_wrong(rig: Rig) -> None:
    q = rig.plan.joint.q[0]  # type: ignore[union-attr]
    good = ArmState(q.copy(), np.zeros(7))

    def said(state: Any, elapsed: Any = 1e-3) -> str:
        senses = Senses(rig.arm, rig.carried, 1e-3, good)
        return senses.take((state, elapsed), with_load(rig.arm, rig.carried).gravity(q)).wrong

    turn = np.eye(7)[2]
    assert said(good) == ""
    # 0.1 of 2.175 rad/s and 100 rad/s^2 for 1 ms are 0.3175 rad/s; 2 * 2.175 rad/s for 1 ms are 0.00435 rad.
    assert said(ArmState(q + 3.1e-4 * turn, np.zeros(7))) == ""
    assert "panda_joint3 is said to turn at 0 rad/s and goes elsewhere" in said(
        ArmState(q + 3.3e-4 * turn, np.zeros(7))
    )
    assert "panda_joint3 is said to have jumped by 0.0048 rad" in said(ArmState(q + 4.8e-3 * turn, np.zeros(7)))
    assert said(ArmState(q, 0.31 * turn)) == ""
    assert "the speed of panda_joint3 is said to have jumped by 0.33" in said(ArmState(q, 0.33 * turn))
    assert "panda_joint3 is said to be at 4 rad" in said(ArmState(np.where(turn > 0, 4.0, q), np.zeros(7)))
    assert "the speed of panda_joint3 is said to have jumped by 5" in said(ArmState(q, 5.0 * turn))
    assert "turn at 44 rad/s, which it cannot" in said(ArmState(q, 44.0 * turn))  # 20 times its limit are 43.5
    assert "no state of its joints" in said(ArmState(q[:6], np.zeros(7)))
    assert "no state of its joints" in said(ArmState(np.array(["x"] * 7), np.zeros(7)))
    assert "its clock says that 2 s passed" in said(good, 2.0)
    with pytest.raises(SalverError, match="cannot be believed: the speed of panda_joint1 is nan"):
        Senses(rig.arm, rig.carried, 1e-3, ArmState(q, np.full(7, NAN)))


class Watched:
    """An arm as the model has it, at a steady torque beyond gravity's; what is believed of readings of it."""

    def __init__(self, rig: Rig, beyond: Array) -> None:
        self.model = with_load(rig.arm, rig.carried)
        self.q, self.dq = rig.plan.joint.q[0].copy(), np.zeros(7)  # type: ignore[union-attr]
        self.beyond, self.senses = beyond, Senses(rig.arm, rig.carried, 1e-3, ArmState(self.q, self.dq))

    def goes(self, periods: int, reading: Any = lambda q, dq, k: (q, dq)) -> Any:
        """What is sensed after the last of some periods, when (q, dq) are reported as `reading` says."""
        for k in range(periods):
            torque = self.model.gravity(self.q) + self.beyond
            ddq = pin.aba(self.model.pin_model, self.model.data, self.q, self.dq, torque)
            self.dq = self.dq + 1e-3 * ddq
            self.q = self.q + 1e-3 * self.dq
            sensed = self.senses.take((ArmState(*reading(self.q, self.dq, k)), 1e-3), torque)
        return sensed

    def off(self, sensed: Any) -> float:
        return float(np.abs(sensed.state.dq - self.dq).max())


ACTING = np.array([1.0, -2.0, 1.0, 1.0, 0.05, 0.05, 0.02])  # N m beyond gravity's


def test_a_state_that_froze_at_rest_is_told_by_the_torques(rig: Rig) -> None:
    """Before it counts as moving: nothing is new in it, so the model's word is taken, and no torque is made of it."""
    arm = Watched(rig, ACTING)
    arm.goes(1)
    q, dq = arm.q, arm.dq
    assert np.abs(dq).max() < 0.01
    sensed = arm.goes(100, lambda *_: (q, dq))
    assert "reports the same state again though it moves" in sensed.wrong
    assert arm.senses.blind > 10
    assert np.abs(arm.dq - dq).max() > 0.1
    assert arm.off(sensed) < 1e-6
    assert arm.senses.dark


def test_what_stands_still_and_is_repeated_is_no_fault(rig: Rig) -> None:
    arm = Watched(rig, np.zeros(7))
    q = arm.q
    assert arm.goes(300, lambda *_: (q, np.zeros(7))).wrong == ""


@pytest.mark.parametrize(("value", "relative"), [(0.0, False), (-3.0, False), (0.8, True), (-0.05, True)])
def test_a_joint_that_is_said_to_be_elsewhere_is_not_followed_there(rig: Rig, value: float, relative: bool) -> None:
    """However long it is said: only its own speed and the model move it."""
    arm = Watched(rig, 0.3 * ACTING)
    arm.goes(50)

    def false(q: Array, dq: Array, k: int) -> tuple[Array, Array]:
        return np.where(np.arange(7) == 3, value + relative * q, q), dq

    for periods in (1, 5):  # what repeats and what jumps, for a while; then readings that follow from one another
        sensed = arm.goes(periods, false)
        assert sensed.wrong
        assert abs(sensed.state.q[3] - arm.q[3]) < 1e-4
        assert arm.off(sensed) < 1e-3
    if abs(value) > 0.3:
        sensed = arm.goes(400, false)
        assert abs(sensed.state.q[3] - arm.q[3]) < 5e-3


@pytest.mark.parametrize("factor", [-1.0, 0.5, 2.0])
def test_a_speed_that_is_not_that_of_its_positions_is_told_and_replaced_by_theirs(rig: Rig, factor: float) -> None:
    arm = Watched(rig, ACTING)

    def false(q: Array, dq: Array, k: int) -> tuple[Array, Array]:
        return q, np.where(np.arange(7) == 1, factor * dq, dq)

    arm.goes(150)
    assert abs(arm.dq[1]) > 0.2
    sensed = arm.goes(100, false)
    assert "panda_joint2" in sensed.wrong
    assert arm.off(sensed) < 0.03
    assert not arm.senses.dark  # its positions still tell
    arm.beyond = -4 * ACTING
    while arm.dq[1] * arm.beyond[1] < 0:
        sensed = arm.goes(1, false)
        assert arm.off(sensed) < 0.1  # what is too little to be told: 5e-3 rad in 50 ms


def test_an_arm_that_is_pushed_is_believed_against_its_model(rig: Rig) -> None:
    """Positions and speeds agree and move: it is the model that does not know of a hand, a friction, a weak motor."""
    arm = Watched(rig, ACTING)
    for _ in range(150):
        arm.goes(1)
        arm.dq = arm.dq + 1e-3 * np.array([6.0, -3.0, 4.0, 5.0, -8.0, 8.0, 8.0])
    sensed = arm.goes(1)
    assert sensed.wrong == ""
    assert arm.off(sensed) == 0.0


def thrown_against_its_stop(rig: Rig, bounce: float) -> tuple[Watched, list[Any]]:
    """Joint 2 goes out at 1 rad/s until it meets its stop and is thrown back at a share of its speed; the impulse moves
    the other joints too, as M says. A spring of 8 Hz at the stop holds it from then on."""
    arm = Watched(rig, np.zeros(7))
    end = arm.model.limits.q_max[1]
    arm.q[1], arm.dq[1] = end - 0.05, 1.0
    arm.senses = Senses(rig.arm, rig.carried, 1e-3, ArmState(arm.q, arm.dq))
    sensed = []
    for _ in range(300):
        held = arm.q[1] > end
        if held and arm.dq[1] > 0:
            gives = np.linalg.inv(arm.model.mass_matrix(arm.q))[:, 1]
            arm.dq = arm.dq - (1 + bounce) * arm.dq[1] * gives / gives[1]
        elif not held:
            arm.beyond = 50.0 * (np.arange(7) == 1)  # pressed outwards all the while, and held where the stop begins
        sensed.append(arm.goes(1))
    return arm, sensed


@pytest.mark.parametrize("bounce", [0.0, 0.5, 1.0])
def test_a_joint_that_meets_its_stop_is_believed(rig: Rig, bounce: float) -> None:
    """However it is thrown back, and while it rests there though a torque presses it outwards."""
    arm, sensed = thrown_against_its_stop(rig, bounce)
    assert arm.q[1] == pytest.approx(arm.model.limits.q_max[1], abs=0.05)
    assert [s.wrong for s in sensed if s.wrong] == []


def test_a_joint_that_is_not_seen_meets_its_stop_in_the_model(rig: Rig) -> None:
    arm = Watched(rig, np.zeros(7))
    end = arm.model.limits.q_max[1]
    arm.q[1], arm.dq[1] = end - 0.02, 1.0
    arm.senses = Senses(rig.arm, rig.carried, 1e-3, ArmState(arm.q, arm.dq))
    for _ in range(100):
        state = arm.senses.take(None, arm.model.gravity(arm.q)).state
    assert end - 0.02 < state.q[1] < end + 1e-3
    assert abs(state.dq[1]) < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2, 9, 16, 29])
def test_an_arm_that_was_struck_comes_to_rest(rig: Rig, seed: int) -> None:
    """Some tens of a millisecond of up to all the torque of a joint: what is true is believed, however violent."""
    rng = np.random.default_rng([seed, 5])
    joint, sign, share = int(rng.integers(7)), rng.choice([-1, 1]), rng.uniform(0.1, 1)
    strength = sign * share * (87 if joint < 4 else 12)
    at, lasts = int(1000 * rng.uniform(0, 1.3)), int(1000 * 10 ** rng.uniform(-2, -0.5))
    push = Fault("motor", at, lasts, "", lambda tau: tau + strength * (np.arange(7) == joint))
    assert one(rig, push).wrong() == []


def test_a_clock_that_runs_ahead_is_told_by_the_joints(rig: Rig) -> None:
    arm = Watched(rig, ACTING)
    arm.goes(200)
    torque = arm.model.gravity(arm.q) + ACTING
    sensed = arm.senses.take((ArmState(arm.q + 1e-3 * arm.dq, arm.dq), 0.05), torque)
    assert "its clock says that 0.05 s passed, and its joints went as far as in 0.001 s" in sensed.wrong
    assert sensed.elapsed == 1e-3


def test_an_arm_is_not_left_with_a_torque_that_would_move_it(rig: Rig) -> None:
    """At rest in the last period of its motion, with a controller that then fails: 80 N m in joint 7."""
    assert one(rig, *draw(20621)).result.summary["stopped"] == ""


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
        self.inner, self.t, self.fails = cool_stops(arm, plan.scenario.payload.bodies)(state, t), t, fails
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


# Planned stops -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def safe(tmp_path_factory: pytest.TempPathFactory) -> Rig:
    """The same plan with load-safe stops."""
    return Rig(tmp_path_factory.mktemp("safe") / "run", every=0.2)


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


def test_what_becomes_of_the_arm_in_a_stop_is_said_as_it_is(safe: Rig) -> None:
    """A planned stop that fails, one in which the arm is not seen, and one that it does not follow."""
    ask = Fault("read", 600, 1, "", signals=(signal.SIGINT,))
    failed = one(safe, ask, Fault("stopping", 630, 10**6, "", error=lambda: ArithmeticError("table"))).result.summary
    assert "The stop failed at t = 0.580 s (ArithmeticError: table)." in failed["stopped"]
    blind = one(safe, ask, Fault("read", 620, 1, "", spoilt("q", NAN))).result.summary
    pushed = one(safe, ask, Fault("stopping", 605, 40, "", lambda torque: torque + 20.0 * np.eye(7)[0])).result.summary
    assert [x["load_kept_in_stop"] for x in (failed, blind, pushed)] == [False, False, False]
    cannot = one(safe, ask, Fault("planned", 0, 10**6, "", error=lambda: MemoryError())).result.summary
    assert "A stop could not begin (MemoryError)." in cannot["stopped"]
    assert cannot["load_kept_in_stop"] is False


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
    for value, expected in zip(beside.reference(0.0), (q + off, dq + faster, ddq), strict=True):
        assert np.allclose(value, expected, atol=2e-3)  # between two samples of the loop's table
    for s in (0.1, beside.duration):  # the speed is gone after 0.15 s at these limits
        difference = beside.reference(s)[0] - there.reference(s)[0] - off
        assert np.all(np.sign(difference) == np.sign(faster))
        assert np.all(np.abs(difference) < np.abs(faster) * 0.15)
    assert np.abs(beside.reference(beside.duration)[1]).max() < 1e-9
    again = beside.renewed(ArmState(q, dq), 0.06)
    assert isinstance(again, PlannedStop)
    assert np.allclose(again.course(0.1)[0], beside.course(0.16)[0])


# Before and after ----------------------------------------------------------------------------------------------------


def test_checks_are_demanded_before_the_arm_is_connected(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the plan, and of what a Franka asks for: neither may be found out with the arm already in hand."""
    library = Library(rig.plan)
    monkeypatch.setitem(sys.modules, "pylibfranka", library)
    for name in ("check_plan", "check_franka"):
        with monkeypatch.context() as patched:
            patched.setattr(execute, name, lambda *args: [Check("x", False, "It is not fit.")])
            with pytest.raises(SalverError, match=r"Not moved\. It is not fit\."):
                execute.run_on_franka(rig.folder, "arm")
    assert library.calls == []


def test_a_way_to_the_start_that_is_not_fit_is_not_gone(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pylibfranka", Library(rig.plan))
    monkeypatch.setattr(execute, "check_approach", lambda *args: [Check("x", False, "A wall is in between.")])
    with pytest.raises(SalverError, match=r"Not moved\. A wall is in between\."):
        execute.run_on_franka(rig.folder, "arm", move_to_start=True, confirm=lambda _: pytest.fail("it was asked for"))


def test_where_no_log_can_be_written_nothing_moves(rig: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "execution").write_text("in the way")
    assert "cannot be written" in check_place(tmp_path).sentence
    assert check_place(rig.folder).ok
    monkeypatch.setattr(logs, "ROOM", 1e30)
    with pytest.raises(SalverError, match=r"Not moved\. .* MB left for the log"):
        execute.dry_run(rig.folder, realtime=False)


@pytest.mark.slow
def test_a_second_run_keeps_the_first_ones_log(rig: Rig, tmp_path: Path) -> None:
    make_plan(CASE).save(tmp_path)
    first = execute.dry_run(tmp_path, realtime=False)
    kept = load_npz(first.path)
    second = execute.dry_run(tmp_path, watchdog=Watchdog(joint_error=1e-5), realtime=False)
    assert second.path == tmp_path / "execution" / "plan.npz"
    assert second.summary["stopped"]
    again = load_npz(tmp_path / "execution" / "plan-1.npz")
    assert all(np.array_equal(kept[name], again[name], equal_nan=True) for name in kept)
    assert read_json(tmp_path / "execution" / "plan-1.json")["stopped"] == ""
    for _ in range(3):
        assert keep(tmp_path, "plan", {"t": np.zeros(2)}, {"n": 1}).name == "plan.npz"


def test_errors_of_the_tray_are_those_of_a_turned_frame(tmp_path: Path) -> None:
    """Joint 7 of a level tray turns it about the vertical: its error is that very angle, wherever the tray looks."""
    from salver import scenario

    case = scenario.load("panda-cube-yaw").with_changes(motion__nodes=21)
    plan = make_plan(case)
    arm, first = load_arm(case.arm, case.tray), case.payload.first  # type: ignore[arg-type]
    joint = plan.joint
    assert joint is not None
    t = np.linspace(0, joint.duration, 301)
    q, dq, _ = joint.sample(t)
    turned = np.array([arm.tray_pose(posture)[1] for posture in q])
    assert np.abs(np.arctan2(turned[:, 1, 0], turned[:, 0, 0])).max() > 0.3
    log_ = _log_of(t, q, dq)
    faithful = arrays_of(plan, arm, first, log_)
    assert faithful["tray_e_o"].max() < 1e-6
    assert faithful["tray_e_p"].max() < 1e-6
    away = q.copy()
    away[:, 6] += 0.02
    assert arrays_of(plan, arm, first, replace(log_, q=away))["tray_e_o"] == pytest.approx(0.02, abs=1e-6)


def _log_of(t: Array, q: Array, dq: Array) -> Any:
    from salver.driver.execution import Log

    none = np.zeros(len(t))
    return Log(t, q, dq, 0 * q, q, none, none, none, none.astype(bool))
