"""An xArm driven through the maker's SDK, against a controller on this machine that speaks the protocol."""

from __future__ import annotations

import os
import re
import signal
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from salver.control.arm import ArmState
from salver.driver import execute
from salver.driver.live import run_live
from salver.driver.robots import xarm
from salver.driver.robots.positions import payload
from salver.driver.sensing import Sensed
from salver.driver.signals import Signals
from salver.errors import MissingDependencyError, SalverError
from salver.models.arm.arm import ArmModel
from salver.planning.plan import Plan, load_plan
from salver.trajectory import JointMotion
from wire import CASES, asked_at, until
from xarm_server import Controller, flange

pytest.importorskip("xarm", reason="xarm-python-sdk is not installed")

ROBOT = "xarm"
Make = Callable[..., Controller]
ROUNDED = 1e-6  # rad; joints travel as numbers of 32 bits


def run(directory: Path, **options: Any) -> execute.Execution:
    return execute.run_plan(directory, "xarm", "127.0.0.1", **options)


def connected(arm: ArmModel, **options: Any) -> xarm.XArmRobot:
    robot = xarm.XArmRobot("127.0.0.1", 1.0, np.zeros(3), xarm.XArmOptions(**options))
    robot.recognise(arm)
    return robot


def driven(plan: Plan, **options: Any) -> xarm.XArmRobot:
    return connected(plan.scenario.load_arm(), **options)


def test_where_it_stands_is_known_however_long_nobody_read(plan: Plan, controller: Make) -> None:
    """While an operator is asked, or plans are made, reports fill what buffers there are, and newer ones are lost."""
    robot, full = controller(lockstep=False), []

    def flood(robot: Controller) -> None:
        if not full:
            report = robot._report()
            for _ in range(20_000):
                robot._send(1, report)
            robot.q = robot.q + 0.1
            full.append(1)

    arm = driven(plan)
    robot.each = flood
    until(lambda: full)
    assert np.abs(arm.look().q - plan.joint.q[0] - 0.1).max() < ROUNDED  # type: ignore[union-attr]


def test_an_xarm_is_sent_the_plan_and_told_its_payload(
    directory: Path, plan: Plan, controller: Make, capsys: pytest.CaptureFixture[str]
) -> None:
    robot = controller()
    result = run(directory)
    assert result.achieved, result.summary["stopped"]
    assert result.summary["source"] == "xarm at 127.0.0.1"
    joint, sent = plan.joint, np.array(robot.commands)
    assert joint is not None
    t = 4e-3 * np.arange(len(sent)) - 0.05  # whatever was missed
    np.testing.assert_allclose(sent, joint.sample(np.clip(t, 0, plan.duration))[0], atol=1e-5)
    limits = plan.scenario.load_arm().limits
    assert np.all(np.abs(np.diff(sent, axis=0)) <= 4e-3 * limits.velocity)
    assert np.abs(robot.q - joint.q[-1]).max() < ROUNDED
    assert result.summary["joint_error_peak"] < ROUNDED  # as late as it said
    assert result.summary["timing"]["period"] == 4e-3
    assert result.summary["timing"]["missed"] < 20  # until the controller waits for its first command
    assert robot.state == 4  # no more commands are taken
    body, arm = plan.scenario.payload.bodies[0], plan.scenario.load_arm()
    tray = plan.scenario.tray
    mass = tray.mass + body.inertial.mass
    com = arm.p_FE + arm.R_FE @ (tray.mass * arm.tray_com_E + body.inertial.mass * body.p_EB) / mass
    np.testing.assert_allclose(robot.load, [mass, *1e3 * com], rtol=1e-6, atol=1e-4)
    assert capsys.readouterr().out == ""  # the SDK prints


def test_a_lag_is_an_error_as_far_as_it_is_not_told(directory: Path, plan: Plan, controller: Make) -> None:
    controller(lag=0.048)
    result = run(directory, options=xarm.XArmOptions(lag=0.048))
    assert result.achieved, result.summary["stopped"]
    assert result.summary["joint_error_peak"] < ROUNDED
    controller(lag=0.048)
    speed = np.abs(plan.joint.dq).max()  # type: ignore[union-attr]
    result = run(directory, options=xarm.XArmOptions(lag=0.068))
    assert result.summary["joint_error_peak"] == pytest.approx(0.02 * speed, rel=0.05)


def test_a_stop_keeps_the_load_on_an_xarm(directory: Path, plan: Plan, controller: Make) -> None:
    signals = Signals()
    robot = controller()
    robot.each = asked_at(150, lambda _: signals.note("Asked"))
    result = run(directory, signals=signals)
    assert result.summary["stopped"].startswith("Asked at t = ")
    assert result.summary["load_kept_in_stop"] is True
    begun = float(result.summary["stopped"].split("t = ")[1].split(" s")[0])
    course = plan.stops.course(begun)  # type: ignore[union-attr]
    assert course.stop is not None
    assert np.abs(robot.q - plan.stops.motion(course.stop).q[-1]).max() < ROUNDED  # type: ignore[union-attr]
    assert result.arrays["tray_e_p"].max() < 1e-4


@pytest.mark.parametrize(
    ("what", "words"),
    [
        (lambda robot: robot.fail(2), "error 2, The Emergency IO of the Control Box is triggered"),
        (lambda robot: robot.fail(31), "error 31, Collision Caused Abnormal Current"),
        (lambda robot: setattr(robot, "state", 4), "it was stopped"),
        (lambda robot: setattr(robot, "state", 3), "it is paused"),
        (lambda robot: setattr(robot, "mode", 0), "its mode was changed to 0"),
        (lambda robot: robot.hang_up(), "it closed the connection"),
        (lambda robot: setattr(robot, "silent", 10**6), "timed out"),
        (lambda robot: setattr(robot, "deaf", True), "it does not answer"),
    ],
)
def test_an_arm_that_stops_by_itself_or_is_gone_is_a_sentence(
    directory: Path, controller: Make, what: Callable[[Controller], Any], words: str
) -> None:
    """And a whole log, and an arm at rest."""
    robot = controller()
    robot.each = asked_at(150, what)
    result = run(directory, options=xarm.XArmOptions(timeout=0.3))
    stopped = result.summary["stopped"].lower()
    assert stopped.startswith("the arm at 127.0.0.1 says: ")
    assert words.lower() in stopped or "the connection is lost" in stopped
    assert len(result.arrays["t"]) > 100
    assert result.summary["load_kept_in_stop"] is None
    until(lambda: not robot.dq.any())


@pytest.mark.slow
def test_a_clock_that_jumps_stops_it(directory: Path, controller: Make) -> None:
    robot = controller()
    robot.each = asked_at(150, lambda robot: setattr(robot, "t", robot.t + 0.5))
    result = run(directory)
    assert "cannot be true: its clock says that 0.504 s passed" in result.summary["stopped"]
    assert np.abs(robot.dq).max() == 0.0


def test_damaged_reports_are_sentences(directory: Path, controller: Make) -> None:
    for bad, words in ((b"\0\0\0\2", "a package of the data exchange has 2 bytes"),
                       (b"\0\0\0\x20" + bytes(28), "its report has 32 bytes; 784 are needed")):  # fmt: skip
        controller(odd=lambda port, data, bad=bad: bad if port == 30000 else data)
        with pytest.raises(SalverError, match=rf"^The arm at 127\.0\.0\.1 says: {words}\.$"):
            run(directory)


def test_replies_of_other_requests_are_not_taken_for_ones_own(directory: Path, controller: Make) -> None:
    """An old answer comes before each answer to a command."""

    def late(port: int, data: bytes) -> bytes:
        return b"\0\0" + data[2:] + data if port == 0 and data[6] == 29 else data

    controller(odd=late)
    assert run(directory).achieved


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"error": 31}, "error 31, Collision Caused Abnormal Current"),
        ({"version": "v2.1.9"}, r"its firmware is 2\.1\.9; --robot xarm drives arms with 2\.2\.0 and later"),
        ({"world": (0.0, 5.0, 0.0, 0.0, 0.0, 0.0)}, r"the offset of its base coordinates is \[0\.0, 5\.0"),
        ({"model": "xarm6", "q": np.zeros(6)}, "it has 6 joints; the plan is for 7"),
    ],
)
def test_an_arm_that_is_not_that_of_the_plan_or_not_ready_is_not_moved(
    directory: Path, controller: Make, options: dict[str, Any], words: str
) -> None:
    robot = controller(**options)
    with pytest.raises(SalverError, match=rf"^The arm at 127\.0\.0\.1 says: {words}"):
        run(directory)
    assert not {11, 12, 19} & set(robot.asked)  # nothing was enabled, no state or mode set


def test_an_error_that_comes_after_it_was_seen_is_not_cleared(plan: Plan, controller: Make) -> None:
    robot = controller()
    arm = driven(plan)
    robot.fail(1)
    with pytest.raises(SalverError, match="says: error 1, "):
        arm.start()
    assert robot.error == 1


def test_an_arm_that_does_not_take_its_payload_is_not_moved(plan: Plan, controller: Make) -> None:
    robot = controller(odd=lambda port, data: b"" if port == 0 and data[6] == 36 else data)
    with pytest.raises(SalverError, match="says: it does not answer"):
        driven(plan, timeout=0.3).start()
    assert robot.mode == 0


def test_a_payload_off_the_middle_of_a_turned_tray_is_told_in_the_flanges_frame() -> None:
    case = CASES[ROBOT].with_changes(tray__rpy_deg=(0.0, 0.0, 50.0), objects__0__at=(0.05, -0.02))
    arm, body, tray = case.load_arm(), case.payload.first, case.tray
    q = np.random.default_rng(1).uniform(-1, 1, arm.n)
    (p_SE, R_SE), flange_S = arm.tray_pose(q), arm.link_pose(q, arm.flange)
    coms_S = [p_SE + R_SE @ x for x in (arm.tray_com_E, body.p_EB + body.R_EB @ body.inertial.com_B)]
    mass, com_F = payload(case, arm)
    assert mass == pytest.approx(tray.mass + body.inertial.mass)
    com_S = (tray.mass * coms_S[0] + body.inertial.mass * coms_S[1]) / mass
    np.testing.assert_allclose(flange_S[0] + flange_S[1] @ com_F, com_S, atol=1e-12)


def test_an_arm_rests_at_the_start_as_long_as_is_asked(plan: Plan, controller: Make) -> None:
    start = plan.joint.q[0]  # type: ignore[union-attr]
    robot = controller(q=start + 0.001)
    driven(plan, settling=0.4).move(lambda q: execute.approach(q, start, plan.scenario.load_arm()))
    there = np.abs(np.array(robot.commands) - start).max(axis=1) < ROUNDED
    assert 100 <= there.sum() < 110


def test_an_arm_that_is_not_ready_at_once_is_waited_for(plan: Plan, controller: Make) -> None:
    robot, held = controller(), list[int]()

    def slow(robot: Controller) -> None:
        if robot.mode == 1 and len(held) < 20:
            held.append(1)
            robot.state = 5 if len(held) < 20 else 2

    robot.each = slow
    driven(plan).start()
    assert len(held) == 20


@pytest.mark.parametrize("model", ["xarm6", "xarm7", "lite6"])
def test_each_model_is_recognised_where_it_stands_and_no_other(
    controller: Make, model: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the maker's own kinematics, under a base that is placed and tilted, with a tool of its own."""
    rng = np.random.default_rng(3)
    changes = {
        "arm__base_position": (0.5, -2.0, 0.8), "arm__base_rpy_deg": (35.0, -70.0, 40.0), "surroundings__floor": "none",
    }  # fmt: skip
    case = CASES[ROBOT].with_changes(arm__model=model, **changes)
    arm = case.load_arm()
    q = rng.uniform(-1.2, 1.2, arm.n)
    robot = controller(model=model, q=q)
    connected(arm)
    if arm.n == 6:
        robot.model = "lite6" if model == "xarm6" else "xarm6"
        with pytest.raises(SalverError, match=rf"the flange is .* mm and .* from where {model} has link6; 10"):
            connected(arm)


@pytest.mark.parametrize(("model", "factor", "limit"), [("xarm7", 1.2, 1.2), ("xarm7", 0.3, 0.3)])
def test_a_tool_too_fast_for_servo_mode_is_refused_before_it_moves(
    directory: Path, plan: Plan, controller: Make, model: str, factor: float, limit: float
) -> None:
    """The controller would stop it with C60."""
    robot = controller(factor=factor, tcp=(0.0, 0.0, 100.0, 0.0, 0.0, 0.0))
    q = plan.joint.sample(np.arange(0, plan.duration, 4e-3))[0]  # type: ignore[union-attr]
    at = np.array([(flange("xarm7", x) @ [0.0, 0.0, 0.1, 1.0])[:3] for x in q])
    fastest = np.linalg.norm(np.diff(at, axis=0), axis=1).max() / 4e-3
    if fastest < limit:
        assert driven(plan).permit(plan.joint) == ""  # type: ignore[arg-type]
        return
    with pytest.raises(SalverError, match=rf"^Not moved\. The tool moves at {fastest:.2f} m/s .* allows 0\.30 m/s"):
        run(directory)
    assert robot.commands == []
    robot.enabled, robot.mode, robot.state = True, 1, 2  # and so it would
    until(lambda: setattr(robot, "target", robot.q + 4e-3) or robot.error == 60)  # type: ignore[func-returns-value]


def test_the_speed_of_the_tool_is_that_of_its_tip(plan: Plan, controller: Make) -> None:
    """As the wrist turns at 2 rad/s, a tool 0.3 m long is faster than the flange."""
    controller(factor=0.5, tcp=(0.0, 0.0, 300.0, 0.0, 0.0, 0.0))
    q = np.tile(plan.joint.q[0], (2, 1))  # type: ignore[union-attr]
    q[1, 5] += 0.2
    dq = np.diff(q, axis=0).repeat(2, axis=0) / 0.1
    ends = np.array([(flange("xarm7", x) @ [0.0, 0.0, 0.3, 1.0])[:3] for x in (q[0], q[0] + 4e-3 * dq[0])])
    fastest = np.linalg.norm(np.diff(ends, axis=0)) / 4e-3
    said = driven(plan).permit(JointMotion(np.array([0.0, 0.1]), q, dq, 0 * dq))
    assert said.startswith(f"The tool moves at {fastest:.2f} m/s")


def test_a_lite_6_allows_its_tool_half_a_metre_a_second(controller: Make) -> None:
    case = CASES[ROBOT].with_changes(arm__model="lite6")
    arm = case.load_arm()
    controller(model="lite6", q=np.zeros(6))
    robot = connected(arm)
    assert robot._fastest == pytest.approx(0.5)


@pytest.mark.slow
def test_an_arm_elsewhere_is_taken_to_the_start(directory: Path, plan: Plan, controller: Make) -> None:
    start = plan.joint.q[0]  # type: ignore[union-attr]
    robot = controller(q=start + 0.02)
    with pytest.raises(SalverError, match="--move-to-start"):
        run(directory)
    result = run(directory, move_to_start=True)
    assert result.achieved, result.summary["stopped"]
    assert np.abs(np.diff(robot.commands[:100], axis=0)).max() / 4e-3 < 0.11 * np.pi


def test_ctrl_c_on_the_way_to_the_start_stops_the_arm(plan: Plan, controller: Make) -> None:
    start = plan.joint.q[0]  # type: ignore[union-attr]
    robot = controller(q=start + 0.03)
    robot.each = asked_at(70, lambda _: os.kill(os.getpid(), signal.SIGINT))
    with pytest.raises(SalverError, match=r"The arm was stopped on its way to the start\."):
        driven(plan).move(lambda q: execute.approach(q, start, plan.scenario.load_arm()))
    until(lambda: robot.state == 4 and not robot.dq.any())
    assert np.abs(robot.q - start).max() > 0.005


def test_one_command_leaves_for_each_report(plan: Plan, controller: Make) -> None:
    """Of two in one period the controller would drop one; reports that pile up are one reading."""
    robot = controller(lockstep=False)
    arm = driven(plan)
    arm.start()
    assert arm.read()[1] == 0.0
    begun = robot.t
    until(lambda: robot.t > begun + 0.04)
    assert arm.read()[1] > 0.02
    q, steps, count = plan.joint.q[0], robot.steps, len(robot.commands)  # type: ignore[union-attr]
    for _ in range(50):
        arm.read()
        arm.write(q, Sensed(ArmState(q, 0 * q), np.ones(7, dtype=bool), 4e-3))
    assert len(robot.commands) - count == 50 <= robot.steps - steps + 1


def test_an_arm_holds_its_place_when_commands_stay_away(plan: Plan, controller: Make) -> None:
    robot = controller(lockstep=False)
    arm = driven(plan)
    arm.start()
    q = plan.joint.q[0]  # type: ignore[union-attr]
    for k in range(5):
        arm.read()
        arm.send(q + 1e-3 * (k + 1))
    steps = robot.steps
    until(lambda: robot.steps > steps + 50)
    assert not robot.dq.any()
    assert np.abs(robot.q - q - 5e-3).max() < ROUNDED


@pytest.mark.slow
def test_goals_and_a_stop_are_carried_out_while_it_moves(plan: Plan, controller: Make, tmp_path: Path) -> None:
    robot = controller(paced=True)
    here = plan.scenario.motion.start.position  # type: ignore[union-attr]
    lines = [f'{{"t": 0.0, "goto": [{here[0] - 0.05}, {here[1] + 0.15}, {here[2]}]}}', '{"t": 3.0, "stop": true}']
    result = run_live(CASES[ROBOT], lines, tmp_path / "live", "xarm", "127.0.0.1")
    assert result.achieved, result.summary["stopped"]
    assert result.summary["requests"] == {"accepted": 2, "refused": 0, "dropped": 0}
    sent = np.array(robot.commands)
    assert np.abs(sent[-1] - sent[0]).max() > 0.05
    assert np.abs(robot.q - load_plan(tmp_path / "live").joint.q[-1]).max() < 1e-4  # type: ignore[union-attr]
    assert np.all(np.abs(np.diff(sent, axis=0)) <= 4e-3 * plan.scenario.load_arm().limits.velocity * (1 + 1e-5))
    assert not robot.dq.any()


@pytest.mark.slow
def test_a_live_motion_that_is_too_fast_for_the_tool_is_not_committed(
    plan: Plan, controller: Make, tmp_path: Path
) -> None:
    robot = controller(paced=True, factor=0.02)
    here = plan.scenario.motion.start.position  # type: ignore[union-attr]
    lines = [f'{{"t": 0.0, "goto": [{here[0] - 0.05}, {here[1] + 0.15}, {here[2]}]}}', '{"t": 2.0, "stop": true}']
    result = run_live(CASES[ROBOT], lines, tmp_path / "live", "xarm", "127.0.0.1")
    assert any("allows 0.02 m/s in servo mode" in outcome for outcome in result.summary["outcomes"])
    assert robot.error == 0
    assert np.abs(np.diff(robot.commands, axis=0)).max() < 1e-3


def test_nobody_at_the_address_and_no_sdk_are_told(
    directory: Path, plan: Plan, controller: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    controller().close()
    with pytest.raises(SalverError, match=r"^The arm at 127\.0\.0\.1 says: "):
        run(directory)
    monkeypatch.setitem(__import__("sys").modules, "xarm.wrapper", None)
    with pytest.raises(MissingDependencyError, match=re.escape("pip install 'salver[xarm]'")):
        run(directory)


def test_a_plan_for_another_arm_is_refused_before_it_is_connected() -> None:
    for names, fits in (
        (tuple(f"joint{k}" for k in range(1, 7)), True),
        (tuple(f"L_joint{k}" for k in range(1, 8)), True),
        (("joint2", "joint1", "joint3", "joint4", "joint5", "joint6"), False),
        (tuple(f"joint{k}" for k in range(1, 6)), False),
    ):
        arm = SimpleNamespace(joint_names=names, n=len(names))
        assert xarm.XArmRobot.check(None, arm)[0].ok is fits  # type: ignore[arg-type]
