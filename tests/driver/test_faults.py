"""The driver survives its inputs: faults in samples, calls and torques, one by one and drawn at random."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from driver_faults import draw
from driver_rig import Fault, Rig, one, spoilt
from salver.control.arm import ArmState
from salver.driver.signals import noted_signals
from salver.files import load_npz
from wire_faults import WireRig

NAN = float("nan")
# A clock that runs ahead while the arm is stopped; frozen, false, swapped readings; torques that shake it, or throw a
# joint against its stop.
LEFT_TURNING = (20082, 20033, 20749, 20903, 20595, 20621, 20873, 20069, 20243, 20425, 20443, 20689)


# One by one -----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("franka", [False, True])
@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("q", NAN, "the position of panda_joint4 is nan"),
        ("dq", -np.inf, "the speed of panda_joint4 is -inf"),
        ("q", 1e300, "panda_joint4 is said to be at 1e+300 rad, far outside its range"),
        ("dq", 2.5, "panda_joint4 is said to move at 2.5 rad/s, after "),
    ],
)
def test_one_reading_that_cannot_be_true_stops_the_arm_with_its_load(
    safe: Rig, name: str, value: float, words: str, franka: bool
) -> None:
    """At 500 the arm moves fast. The command stands in for one period; all of the stop is seen."""
    outcome = one(safe, Fault("read", 500, 1, "", spoilt(name, value)), franka=franka)
    summary = outcome.result.summary
    assert summary["stopped"].startswith(f"What the arm reports at t = 0.450 s cannot be true: {words}")
    assert summary["load_kept_in_stop"] is True
    assert summary["bridged"] == 1
    assert not outcome.result.achieved
    if not franka:
        assert outcome.result.arrays["slip"].max() < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("franka", [False, True])
@pytest.mark.parametrize("lasts", [10, 11, 10**6])
def test_a_stop_surely_keeps_its_load_when_ten_periods_are_bridged_and_not_eleven(
    safe: Rig, lasts: int, franka: bool
) -> None:
    """Without any believable state the arm is braked by what is commanded alone, and rests."""
    outcome = one(safe, Fault("read", 500, lasts, "", spoilt("dq", NAN)), franka=franka)
    summary = outcome.result.summary
    assert summary["stopped"].startswith(
        "What the arm reports at t = 0.450 s cannot be true: the speed of panda_joint4"
    )
    assert summary["load_kept_in_stop"] is (lasts == 10)
    assert np.abs(outcome.robot.true().dq).max() < 0.05


@pytest.mark.parametrize(
    "wrong", [NAN, None, *(pytest.param(x, marks=pytest.mark.slow) for x in (np.inf, -1e-3, 1e308))]
)
def test_a_clock_that_is_wrong_once_stops_the_arm(rig: Rig, wrong: Any) -> None:
    outcome = one(rig, Fault("read", 300, 1, "", lambda answer: (answer[0], wrong)))
    words = "it says nothing" if wrong is None else f"its clock says that {wrong:g} s passed"
    assert outcome.result.summary["stopped"] == f"What the arm reports at t = 0.250 s cannot be true: {words}."
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
    assert stopped == "The arm at arm says: joint_velocity_violation."


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


def test_an_arm_is_not_left_with_a_torque_that_would_move_it(rig: Rig) -> None:
    """At rest in the last period of its motion, with a controller that then fails: 80 N m in joint 7."""
    assert one(rig, *draw(20621)).result.summary["stopped"] == ""


# Drawn at random -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("seed", [*range(4), *LEFT_TURNING])
def test_nothing_unsafe_leaves_and_no_log_is_lost(rig: Rig, safe: Rig, seed: int) -> None:
    """`python tests/helpers/driver_faults.py -n 1000` throws a thousand."""
    faults = draw(seed)
    franka = seed % 3 == 0 and not any(fault.odd for fault in faults)
    assert (rig, safe)[seed % 2].throw(faults, franka).wrong() == [], [fault.words for fault in faults]


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["ur", "xarm"])
def test_nothing_unsafe_comes_over_the_wire(tmp_path: Path, robot: str) -> None:
    """`python tests/helpers/driver_faults.py --robot xarm -n 1000` throws a thousand. Of a UR 5 and 15: no more
    commands come while it moves."""
    if robot == "xarm":
        pytest.importorskip("xarm", reason="xarm-python-sdk is not installed")
    wired = WireRig(tmp_path / "plan", robot)
    for seed in (2, 5, 15):
        faults, wrong, _ = wired.throw(seed)
        assert wrong == [], [fault.words for fault in faults]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 9, 29])
def test_an_arm_that_was_struck_comes_to_rest(rig: Rig, seed: int) -> None:
    """Some tens of a millisecond of up to all the torque of a joint: what is true is believed, however violent."""
    rng = np.random.default_rng([seed, 5])
    joint, sign, share = int(rng.integers(7)), rng.choice([-1, 1]), rng.uniform(0.1, 1)
    strength = sign * share * (87 if joint < 4 else 12)
    at, lasts = int(1000 * rng.uniform(0, 1.3)), int(1000 * 10 ** rng.uniform(-2, -0.5))
    push = Fault("motor", at, lasts, "", lambda tau: tau + strength * (np.arange(7) == joint))
    assert one(rig, push).wrong() == []
