"""A UR driven over RTDE, against a controller on this machine that speaks the protocol and runs the program."""

from __future__ import annotations

import os
import signal
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from salver.cli import app
from salver.control.arm import ArmState
from salver.driver import execute
from salver.driver.live import LiveRunOptions, run_live
from salver.driver.robots import ur
from salver.driver.sensing import Sensed
from salver.driver.signals import Signals
from salver.errors import SalverError
from salver.models.arm.arm import load_arm
from salver.models.arm.known_arms import UR_JOINTS
from salver.planning.plan import Plan
from ur_server import Controller, package
from wire import CASES, asked_at, until

ROBOT = "ur"
Make = Callable[..., Controller]


def run(directory: Path, **options: Any) -> execute.Execution:
    return execute.run_plan(directory, "ur", "127.0.0.1", **options)


def test_a_ur_is_sent_the_plan_and_told_its_payload(directory: Path, plan: Plan, controller: Make) -> None:
    robot = controller()
    result = run(directory, options=ur.UROptions(gain=450.0))
    assert "gain=450.0" in robot.program
    assert result.achieved
    assert result.summary["source"] == "ur at 127.0.0.1"
    log, joint = result.arrays, plan.joint
    sent = np.array(robot.commands)
    first = np.flatnonzero(np.abs(sent - joint.q[0]).max(axis=1) > 1e-9)[0] - 1  # type: ignore[union-attr]
    t = np.clip(2e-3 * (np.arange(len(sent)) - first), 0, plan.duration)
    np.testing.assert_allclose(sent, joint.sample(t)[0], atol=3e-3)  # type: ignore[union-attr]
    assert np.abs(robot.q - joint.q[-1]).max() < 1e-9  # type: ignore[union-attr]
    assert result.summary["joint_error_peak"] < 1e-9  # as late as it said
    assert result.summary["timing"]["period"] == 2e-3
    assert result.summary["timing"]["missed"] < 20  # until the controller waits for its first command
    assert "tau" not in log
    assert log["tray_e_p"].max() < 1e-4
    mass, com = robot.payload
    body = plan.scenario.payload.bodies[0]
    assert mass == pytest.approx(plan.scenario.tray.mass + body.inertial.mass)
    arm = load_arm(plan.scenario.arm, plan.scenario.tray)  # type: ignore[arg-type]
    assert com == pytest.approx(
        arm.p_FE + (plan.scenario.tray.mass * arm.tray_com_E + body.inertial.mass * body.p_EB) / mass
    )


@pytest.mark.parametrize("live", [False, True])
def test_the_command_sets_the_robots_options(directory: Path, controller: Make, tmp_path: Path, live: bool) -> None:
    robot = controller(paced=live)
    words = ["execute", str(directory), "--robot", "ur", "--address", "127.0.0.1", "--yes", "--set", "gain=450"]
    if live:
        (tmp_path / "s.jsonl").write_text('{"t": 0.0, "stop": true}\n')
        words += ["--live", str(tmp_path / "s.jsonl"), "--longest", "10", "-o", str(tmp_path / "live")]
    done = CliRunner().invoke(app, [*words, "--set", "patience=90"])
    assert "Ran to its end" in done.output
    assert "gain=450.0" in robot.program
    assert "missed < 90" in robot.program


def test_a_stop_keeps_the_load_on_a_ur(directory: Path, plan: Plan, controller: Make) -> None:
    signals = Signals()
    robot = controller()
    robot.each = asked_at(300, lambda _: signals.note("Asked"))
    result = run(directory, signals=signals)
    assert result.summary["stopped"].startswith("Asked at t = ")
    assert result.summary["load_kept_in_stop"] is True
    begun = float(result.summary["stopped"].split("t = ")[1].split(" s")[0])
    course = plan.stops.course(begun)  # type: ignore[union-attr]
    assert course.stop is not None
    assert np.abs(robot.q - plan.stops.motion(course.stop).q[-1]).max() < 1e-9  # type: ignore[union-attr]
    assert robot.outputs["output_int_register_24"] == 0
    assert result.arrays["tray_e_p"].max() < 1e-4
    assert not result.achieved


@pytest.mark.slow
def test_the_speed_slider_is_honoured(directory: Path, plan: Plan, controller: Make) -> None:
    """The slider and the controller's own scaling, 0.8 of 0.9: the plan in 1 / 0.72 of its time."""
    robot = controller()
    robot.slider, robot.scaling = 0.8, 0.9
    result = run(directory)
    assert result.summary["stopped"] == ""
    whole = (plan.duration + 0.15) / 0.72 / 2e-3
    assert whole - 50 < len(robot.commands) < whole + 600  # it rests 0.05 s before and 0.1 s after
    speeds = np.abs(np.diff(robot.commands, axis=0)).max(axis=0) / 2e-3
    assert result.arrays["tray_e_p"].max() < 1e-3
    np.testing.assert_allclose(speeds, 0.72 * np.abs(plan.joint.dq).max(axis=0), rtol=0.02, atol=1e-9)  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("mode", "words"),
    [
        (3, "a protective stop"),
        *(pytest.param(*x, marks=pytest.mark.slow) for x in ((7, "its emergency stop"), (11, "safety mode 11"))),
    ],
)
def test_a_protective_stop_is_noticed(directory: Path, controller: Make, mode: int, words: str) -> None:
    robot = controller()
    robot.each = asked_at(300, lambda robot: setattr(robot, "mode", mode))
    result = run(directory)
    assert result.summary["stopped"] == f"The arm at 127.0.0.1 says: {words}."
    assert len(result.arrays["t"]) > 50
    assert result.summary["load_kept_in_stop"] is None


@pytest.mark.slow
def test_a_reading_of_a_ur_that_cannot_be_true_stops_it(directory: Path, controller: Make) -> None:
    robot = controller()

    def jump(robot: Controller) -> None:
        robot.t += 0.5

    robot.each = asked_at(300, jump)
    result = run(directory)
    assert "cannot be true: its clock says that 0.502 s passed" in result.summary["stopped"]
    assert np.abs(robot.dq).max() == 0.0


@pytest.mark.slow
def test_a_connection_that_breaks_ends_in_a_log_and_the_program_stops_the_arm(
    directory: Path, controller: Make
) -> None:
    robot = controller()
    robot.each = asked_at(300, lambda robot: robot.client.shutdown(2))  # type: ignore[union-attr]
    result = run(directory)
    assert "The arm at 127.0.0.1 says: " in result.summary["stopped"]
    assert len(result.arrays["t"]) > 50


def test_a_program_whose_commands_stay_away_stops_the_arm_by_itself(plan: Plan, controller: Make) -> None:
    robot = controller(lockstep=False)
    driven = ur.URRobot("127.0.0.1", 1.5, np.array([0.0, 0.01, 0.05]))
    driven.start()
    assert robot.payload == (1.5, [0.0, 0.01, 0.05])
    q = plan.joint.q[0]  # type: ignore[union-attr]
    for k in range(10):
        driven.read()
        driven.write(q + 1e-3 * (k + 1), Sensed(ArmState(q, 0 * q), np.ones(6, dtype=bool), 2e-3))
    with pytest.raises(SalverError, match=r"The arm at 127\.0\.0\.1 says: the program has ended\."):
        [driven.read() for _ in range(2000)]
    assert 100 <= len(robot.commands) < 400
    assert np.abs(robot.dq).max() == 0.0


def test_old_registers_move_nothing(plan: Plan, controller: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    """What another session left in them: the program waits for its own first command, and holds the arm then."""
    robot = controller(lockstep=False)
    robot.registers |= {"input_int_register_24": 17, **{f"input_double_register_{k}": 1.0 for k in range(24, 30)}}
    driven = ur.URRobot("127.0.0.1", 1.0, np.zeros(3))
    with monkeypatch.context() as patched:
        patched.setattr(driven, "_send", lambda q: None)
        with pytest.raises(SalverError, match="the program does not run"):
            driven.start()
    assert robot.commands == []
    robot = controller(lockstep=False)
    driven = ur.URRobot("127.0.0.1", 1.0, np.zeros(3))
    driven.start()
    driven.read()
    assert np.abs(np.array(robot.commands) - plan.joint.q[0]).max() < 1e-12  # type: ignore[union-attr]


def test_where_it_stands_is_known_however_long_nobody_read(plan: Plan, controller: Make) -> None:
    """While an operator is asked, or plans are made, no states fill the buffers."""
    sent: list[str] = []
    robot = controller(odd=lambda kind, body: sent.append(kind) or package(kind, body))  # type: ignore[func-returns-value]
    driven = ur.URRobot("127.0.0.1", 1.0, np.zeros(3))
    count, steps = len(sent), robot.steps
    until(lambda: robot.steps > steps + 50)
    assert len(sent) == count
    robot.q = robot.q + 0.1
    assert np.abs(driven.look().q - plan.joint.q[0] - 0.1).max() < 1e-12  # type: ignore[union-attr]
    driven.start()
    driven.read()
    driven.stop()
    driven.look()
    count, steps = len(sent), robot.steps
    until(lambda: robot.steps > steps + 50)
    assert len(sent) == count


def test_an_arm_that_was_moved_since_it_was_seen_is_held_where_it_is(plan: Plan, controller: Make) -> None:
    """While a person is asked, states wait in the connection: the first that are read then are old."""
    old: list[bytes] = []

    def late(kind: str, body: bytes) -> bytes:
        if kind == "U" and not robot.program:
            old.append(body)
            body = old[0]
        return package(kind, body)

    robot = controller(odd=late)
    driven = ur.URRobot("127.0.0.1", 1.0, np.zeros(3))
    robot.q = moved = robot.q + 0.05
    robot.late = deque([moved] * 15)
    driven.start()
    driven.read()
    until(lambda: len(robot.commands) > 0)
    assert np.abs(np.array(robot.commands) - moved).max() < 1e-12


@pytest.mark.slow
def test_an_arm_elsewhere_is_taken_to_the_start(directory: Path, plan: Plan, controller: Make) -> None:
    start = plan.joint.q[0]  # type: ignore[union-attr]
    robot = controller(q=start + 0.01)
    result = run(directory, move_to_start=True)
    assert result.achieved, result.summary["stopped"]
    assert np.abs(np.diff(robot.commands[:300], axis=0)).max() / 2e-3 < 0.11 * np.pi


def test_a_clock_that_jumps_on_the_way_to_the_start_does_not_make_the_arm_jump(plan: Plan, controller: Make) -> None:
    start = plan.joint.q[0]  # type: ignore[union-attr]
    robot = controller(q=start + 0.03)
    robot.each = asked_at(150, lambda robot: setattr(robot, "t", robot.t + 0.1))
    driven = ur.URRobot("127.0.0.1", 1.0, np.zeros(3))
    arm = load_arm(plan.scenario.arm, plan.scenario.tray)  # type: ignore[arg-type]
    driven.move(lambda q: execute.approach(q, start, arm))
    assert np.abs(np.diff(robot.commands, axis=0)).max() / 2e-3 < 0.11 * np.pi
    assert np.abs(robot.commands[-1] - start).max() < 1e-12
    until(lambda: robot.outputs["output_int_register_24"] == 0)  # the program was told to end


def test_ctrl_c_on_the_way_to_the_start_stops_the_arm(plan: Plan, controller: Make) -> None:
    start = plan.joint.q[0]  # type: ignore[union-attr]
    robot = controller(q=start + 0.03)
    robot.each = asked_at(150, lambda _: os.kill(os.getpid(), signal.SIGINT))
    driven = ur.URRobot("127.0.0.1", 1.0, np.zeros(3))
    arm = load_arm(plan.scenario.arm, plan.scenario.tray)  # type: ignore[arg-type]
    with pytest.raises(SalverError, match=r"The arm was stopped on its way to the start\."):
        driven.move(lambda q: execute.approach(q, start, arm))
    until(lambda: robot.outputs["output_int_register_24"] == 0 and not robot.dq.any())
    assert np.abs(robot.q - start).max() > 0.01


@pytest.mark.parametrize(("scaling", "speed"), [(1.3, 1.0), (-0.1, 0.0), (np.nan, 0.0), (0.7, 0.7)])
def test_a_speed_is_a_share_of_full_speed(controller: Make, scaling: float, speed: float) -> None:
    robot = controller()
    driven = ur.URRobot("127.0.0.1", 1.0, np.zeros(3))
    robot.scaling = scaling
    for _ in range(10):
        driven.look()
    assert driven.speed == speed


@pytest.mark.slow
@pytest.mark.parametrize("slowed", [False, True])
def test_a_ur_is_driven_live_until_it_is_slowed(plan: Plan, controller: Make, tmp_path: Path, slowed: bool) -> None:
    """To a goal; a live motion keeps its load at full speed only."""
    robot = controller(paced=True)

    def slow(robot: Controller) -> None:
        if slowed and np.abs(robot.dq).max() > 0.3:
            robot.slider = 0.5

    robot.each = slow
    result = run_live(CASES[ROBOT], ['{"t": 0.0, "goto": [0.6, 0.05, 0.45]}'], tmp_path / "live", "ur", "127.0.0.1",
                      options=LiveRunOptions(patience=60.0))  # fmt: skip
    sent, arm, body = np.array(robot.commands), plan.scenario.load_arm(), plan.scenario.payload.bodies[0]
    assert result.summary["requests"] == {"accepted": 1, "refused": 0, "dropped": 0}
    assert "realtime" not in result.summary  # by which the command takes it for a simulated arm
    if slowed:
        assert "The robot's speed is at 50 %, and this motion keeps its load at full" in result.summary["stopped"]
        assert result.summary["load_kept_in_stop"] is True
    else:
        assert result.achieved, result.summary["stopped"]
        assert np.abs(arm.object_pose(sent[-1], body.p_EB, body.R_EB)[0] - [0.6, 0.05, 0.45]).max() < 2e-3
    assert np.all(np.abs(np.diff(sent, axis=0)) <= 2e-3 * arm.limits.velocity * (1 + 1e-9))
    assert not robot.dq.any()


@pytest.mark.parametrize("refuse", ["input_double_register_27", "safety_mode"])
def test_a_register_that_another_client_has_is_named(directory: Path, controller: Make, refuse: str) -> None:
    controller(refuse=refuse)
    with pytest.raises(SalverError, match=rf"The arm at 127\.0\.0\.1 says: {refuse} of the data exchange is IN_USE\."):
        run(directory)


def test_a_plan_for_another_arm_of_the_maker_is_not_sent(directory: Path, plan: Plan, controller: Make) -> None:
    """The joints of a UR5 and of a UR5e have the same names; its shoulder is 73 mm higher."""
    robot = controller(model="ur5")
    with pytest.raises(SalverError, match=r"the flange is 94\.0 mm and 0\.0 degrees from where ur5e has tool0; 10 mm"):
        run(directory)
    assert robot.program == ""
    controller()
    arm = plan.scenario.arm.model_copy(update={"flange": "flange"})  # type: ignore[union-attr]
    driven = ur.URRobot("127.0.0.1", 1.0, np.zeros(3))
    with pytest.raises(SalverError, match=r"says: the flange is 0\.0 mm and 120\.0 degrees from where ur5e has flange"):
        driven.recognise(load_arm(arm, plan.scenario.tray))


def test_an_arm_is_recognised_wherever_it_stands_and_however_its_base_is_turned(
    plan: Plan, controller: Make, tmp_path: Path
) -> None:
    """In today's descriptions of these arms the first joint's parent is turned by half a turn to base_link, in older
    ones it is not."""
    controller(q=np.array([0.3, -1.2, 1.5, -0.4, 0.8, 2.0]))
    driven = ur.URRobot("127.0.0.1", 1.0, np.zeros(3))
    arm = plan.scenario.arm.model_copy(update={"base_position": (0.5, -2.0, 0.8), "base_rpy_deg": (35.0, -70.0, 40.0)})  # type: ignore[union-attr]
    moved = load_arm(arm, plan.scenario.tray)
    driven.recognise(moved)
    text = moved.urdf_path.read_text()
    unturned = text.replace('<origin rpy="0 0 3.141592653589793" xyz="0 0 0" />', '<origin rpy="0 0 0" xyz="0 0 0" />')
    assert unturned != text
    (tmp_path / "ur5e.urdf").write_text(unturned)
    described = arm.model_copy(update={"model": str(tmp_path / "ur5e.urdf"), "flange": "tool0", "collisions": "ignore"})
    driven.recognise(load_arm(described, plan.scenario.tray))


def test_a_cb3_is_refused_by_its_version(directory: Path, controller: Make) -> None:
    controller(version=(3, 15, 4, 0))
    with pytest.raises(SalverError, match=r"says: its software is 3\.15; --robot ur drives arms with 5\.10 and later"):
        run(directory)


@pytest.mark.parametrize(
    ("kind", "answer", "words"),
    [
        ("O", b"\x01DOUBLE,VECTOR6D", "types for 2 fields of the data exchange, where 9 were"),
        ("I", b"", "types for 1 fields of the data exchange, where 7 were"),
        ("I", b"\x01\xff\xfe", "types for 1 fields of the data exchange, where 7 were"),
        ("v", b"\0", "unpack requires a buffer of 16 bytes"),
        ("S", b"\0", 'refuses the request "S"'),
        ("V", b"\0", 'refuses the request "V"'),
        ("U", b"\x01", "unpack_requires"),
    ],
)
def test_an_answer_that_is_none_is_a_sentence(
    directory: Path, controller: Make, kind: str, answer: bytes, words: str
) -> None:
    controller(odd=lambda k, body: package(k, answer if k == kind else body))
    with pytest.raises(SalverError, match=rf"^The arm at 127\.0\.0\.1 says: .*{words.replace('_', ' ')}"):
        run(directory)


def test_a_package_shorter_than_its_head_does_not_hold_the_client(directory: Path, controller: Make) -> None:
    controller(odd=lambda kind, body: b"\0\0V" + package(kind, body))
    with pytest.raises(SalverError, match="a package of the data exchange has 0 bytes"):
        run(directory)


def test_messages_between_states_delay_none(plan: Plan, controller: Make) -> None:
    """A text message comes with each state, after it. The controller waits up to 1 s for the answer to a state."""
    controller(odd=lambda kind, body: package(kind, body) + package("M", b"\x02hi\x00\x01"))
    driven = ur.URRobot("127.0.0.1", 1.0, np.zeros(3))
    driven.start()
    q, began = plan.joint.q[0], time.monotonic()  # type: ignore[union-attr]
    for _ in range(5):
        driven.read()
        driven.write(q, Sensed(ArmState(q, 0 * q), np.ones(6, dtype=bool), 2e-3))
    assert time.monotonic() - began < 4.0  # delayed by one state each, it would be 5 s


def test_nobody_at_the_address_and_no_remote_control_are_told(
    directory: Path, controller: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = controller()
    monkeypatch.setattr(ur, "SCRIPT_PORT", 1)
    assert "The arm at 127.0.0.1 says: " in run(directory).summary["stopped"]
    assert robot.commands == []
    monkeypatch.setattr(ur, "RTDE_PORT", 1)
    with pytest.raises(SalverError, match=r"The arm at 127\.0\.0\.1 says: .*refused"):
        run(directory)


def test_a_plan_for_another_arm_is_refused_before_it_is_connected(rig: Any) -> None:
    with pytest.raises(
        SalverError, match=r"Not moved\. The plan is for the joints panda_joint1, .* drives shoulder_pan"
    ):
        execute.run_plan(rig.folder, "ur", "nowhere")
    names = ("a_" + UR_JOINTS[1], "a_" + UR_JOINTS[0], *UR_JOINTS[2:])
    assert not ur.URRobot.check(None, SimpleNamespace(joint_names=names))[0].ok  # type: ignore[arg-type]


def test_the_newest_of_several_states_is_read(controller: Make) -> None:
    robot = controller(lockstep=False)
    driven = ur.URRobot("127.0.0.1", 1.0, np.zeros(3))
    driven.start()
    assert driven.read()[1] == 0.0
    begun = robot.t
    until(lambda: robot.t > begun + 0.02)
    assert driven.read()[1] > 0.01
