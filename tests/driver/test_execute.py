"""Driving an arm: the loop on the simulated arm, its safety, the Franka adapter."""

from __future__ import annotations

import itertools
import os
import signal
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pylibfranka_stand_in import Library
from salver import scenario
from salver.control.arm import ArmState, controller_for
from salver.driver import execute
from salver.driver.execution import Drive, ExecutionLog, Watchdog, timing
from salver.driver.robots.simulated import SimulatedRobot
from salver.driver.sensing import Plausible, Sensed
from salver.driver.stops import controlled_stops
from salver.errors import MissingDependencyError, SalverError
from salver.geometry import Array
from salver.models.arm.arm import load_arm, with_load
from salver.planning.make import make_plan
from salver.planning.plan import Plan, load_plan
from salver.simulation.physics import simulate

# For tests of time itself: on a machine with other work, hundreds of periods may pass.
PATIENT = Watchdog(joint_error=3.0, velocity_share=100.0, late_periods=10**6)
SHORT = {"physics__settle_before": 0.05, "physics__settle_after": 0.1}


@pytest.fixture(scope="module")
def directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    case = scenario.load("panda-cube").with_changes(motion__duration=1.4, **SHORT)
    folder = tmp_path_factory.mktemp("run")
    make_plan(case, "baseline").save(folder, "plan")
    return folder


@pytest.fixture(scope="module")
def plan(directory: Path) -> Plan:
    return load_plan(directory)


def _parts(plan: Plan) -> tuple[Any, Any, Any]:
    arm = load_arm(plan.scenario.arm, plan.scenario.tray)  # type: ignore[arg-type]
    return arm, plan.scenario.payload.bodies, controller_for(plan.scenario, plan.joint, plan.reference, arm=arm)  # type: ignore[arg-type]


@pytest.mark.slow
def test_dry_run_without_waiting_is_the_simulation(directory: Path, plan: Plan) -> None:
    """The driver's loop and `salver simulate` step the same controller on the same arm: the same motion."""
    result = execute.run_plan(directory, realtime=False)
    assert result.achieved
    assert result.summary["outcome"] == "holds"
    assert result.summary["timing"]["missed"] == 0
    assert [check.name for check in result.checks if not check.ok] == ["stops"]
    record = simulate(plan)
    for name in ("q", "dq", "p_SB", "e_p"):
        mine, theirs = result.arrays[name], getattr(record, name)
        k = min(len(mine), len(theirs))
        assert k > 200
        assert np.abs(mine[:k] - theirs[:k]).max() < 1e-6, name


@pytest.mark.slow
def test_a_dry_run_in_real_time_takes_the_time_of_the_motion(plan: Plan) -> None:
    """0.05 s + 1.4 s + 0.1 s of motion: every millisecond of it is commanded or counted as missed."""
    arm, carried, controller = _parts(plan)
    robot = SimulatedRobot(plan, arm, 0.0)
    log_ = Drive(robot, controller, plan.joint, arm, carried, -0.05, 1.5, PATIENT, controlled_stops(arm, carried)).run()  # type: ignore[arg-type]
    assert log_.woken[-1] - log_.woken[0] >= 1.549
    clock = timing(log_, 1e-3)
    assert clock["periods"] + clock["missed"] == 1 + round((log_.t[-1] + 0.05) / 1e-3)
    assert log_.t[-1] == pytest.approx(1.5, abs=1e-9) or clock["missed"] > 0


def test_timing_by_hand() -> None:
    """Six states: on time, 0.3 ms late, one period missed, 0.1 and 0.2 ms early."""
    woken = np.array([0.0, 1.0, 2.3, 4.3, 5.2, 6.0]) * 1e-3
    elapsed = np.array([0.0, 1.0, 1.0, 2.0, 1.0, 1.0]) * 1e-3
    rows, spent = np.zeros((6, 7)), np.array([1.0, 1.0, 1.0, 1.0, 1.0, 5.0]) * 1e-4
    none = np.zeros(6, bool)
    clock = timing(ExecutionLog(np.cumsum(elapsed), rows, rows, rows, rows, woken, spent, elapsed, none), 1e-3)
    assert set(clock) == {
        "periods", "period", "jitter_median", "jitter_p999", "jitter_max", "late", "missed", "longest_gap",
        "step_median", "step_p999", "step_max",
    }  # fmt: skip
    assert clock["periods"] == 6
    assert clock["period"] == 1e-3
    assert clock["missed"] == 1
    assert clock["late"] == pytest.approx(0.2)  # one of five gaps is longer than a period and a half
    assert clock["longest_gap"] == pytest.approx(2e-3)
    assert clock["jitter_max"] == pytest.approx(1e-3)
    assert clock["jitter_median"] == pytest.approx(2e-4)
    assert clock["step_median"] == pytest.approx(1e-4)
    assert clock["step_max"] == pytest.approx(5e-4)


class _Sleepy(SimulatedRobot):
    """Its caller is held up for 5.2 ms every 100 periods."""

    calls = 0

    def read(self) -> tuple[ArmState, float]:
        self.calls += 1
        if self.calls % 100 == 0:
            time.sleep(5.2e-3)
        return super().read()


@pytest.mark.slow
def test_missed_periods_are_seen_and_time_goes_on(plan: Plan) -> None:
    arm, carried, controller = _parts(plan)
    robot = _Sleepy(plan, arm, 1.0)
    log_ = Drive(
        robot, controller, plan.joint, arm, carried, robot.start_time, 0.25, PATIENT, controlled_stops(arm, carried)
    ).run()  # type: ignore[arg-type]
    clock = timing(log_, 1e-3)
    assert clock["missed"] >= 4 * (robot.calls // 100)
    assert clock["jitter_max"] > 4e-3
    assert log_.t[-1] >= 0.249
    behind = (log_.woken - log_.woken[0]) - (log_.t - log_.t[0])
    assert np.median(np.abs(behind)) < 2e-3


class _Pushed(SimulatedRobot):
    """Somebody leans on joint 2 from t = 0.4 s on, for 0.1 s, with 40 N m."""

    def write(self, torque: Array, sensed: Any, *, last: bool = False) -> None:
        t = float(self._t[self._recorder.count - 1]) if self._recorder.count else 0.0
        push = np.zeros(7)
        push[1] = 40.0 if 0.4 < t < 0.5 else 0.0
        super().write(torque + push, sensed, last=last)


def test_watchdog_brakes_to_rest_within_the_torque_rate(plan: Plan) -> None:
    arm, carried, controller = _parts(plan)
    robot = _Pushed(plan, arm, 3.0, realtime=False)
    log_ = Drive(
        robot,
        controller,
        plan.joint,
        arm,
        carried,
        robot.start_time,
        1.5,
        Watchdog(0.02),
        controlled_stops(arm, carried),
    ).run()  # type: ignore[arg-type]
    assert "panda_joint" in log_.stopped
    assert "0.02 rad are allowed" in log_.stopped
    stopped_at = float(log_.stopped.split("t = ")[1].split(" s")[0])
    assert 0.4 < stopped_at < 0.55
    # Pushed: every reading is plausible, until the joint strikes its stop, where speeds change at once.
    struck = int(np.argmax(log_.q[:, 1] > arm.limits.q_max[1]))
    assert not log_.bridged[: struck - 1].any()
    assert log_.bridged.sum() <= Plausible().confirmations  # thrown back: believed again then
    # The last stop's own law: a quintic step within 0.8 of the acceleration, 0.25 s of rest after it; nothing on top.
    began = float(log_.stopped.split("t = ")[-1].split(" s")[0])
    dq = log_.dq[np.argmin(np.abs(log_.t - began))]
    assert log_.t[-1] == pytest.approx(
        began + (1.875 * np.abs(dq) / (0.8 * arm.limits.acceleration)).max() + 0.25, abs=2e-3
    )
    assert np.abs(log_.dq[-1]).max() < 0.02
    assert np.abs(robot.look().dq).max() < 0.02
    assert log_.q[:, 1].max() > arm.limits.q_max[1]
    rate = np.abs(np.diff(log_.sent[log_.t > stopped_at], axis=0)).max() / 1e-3
    assert rate <= 1000.0 * (1 + 1e-9)
    assert np.abs(log_.sent).max() <= 87.0


@pytest.mark.slow
def test_undisturbed_the_watchdog_is_silent_and_torques_are_the_controllers(plan: Plan) -> None:
    arm, carried, controller = _parts(plan)
    robot = SimulatedRobot(plan, arm, 0.1, realtime=False)
    log_ = Drive(
        robot, controller, plan.joint, arm, carried, robot.start_time, 1.6, Watchdog(), controlled_stops(arm, carried)
    ).run()  # type: ignore[arg-type]
    t = robot.record({}, 0.0).t
    np.testing.assert_allclose(t, np.linspace(0.0, 1.6, 321), atol=1e-9)  # evenly, beyond the plan's end too
    assert log_.stopped == ""
    assert np.abs(log_.q - log_.q_wanted).max() < 2e-3
    _, _, again = _parts(plan)
    for k in range(200):
        tau = again.step(ArmState(log_.q[k], log_.dq[k]), float(log_.t[k]))
        assert np.abs(tau - log_.sent[k]).max() < 1e-9


def test_watchdog_complains_in_words(plan: Plan) -> None:
    arm, _, _ = _parts(plan)
    q = plan.joint.sample(0.0)[0][0]  # type: ignore[union-attr]
    good = ArmState(q.copy(), np.zeros(7))
    dog = Watchdog()
    assert dog.complaint(arm, good, q, 0, 0.0) == ""
    assert "off its reference" in str(dog.complaint(arm, ArmState(q * np.nan, np.zeros(7)), q, 0, 0.1))
    assert "moves at nan" in str(dog.complaint(arm, ArmState(q.copy(), q * np.nan), q, 0, 0.1))
    fast = ArmState(q.copy(), np.array([0, 0, 0, 0, 0, -3.0, 0]))
    assert "panda_joint6 moves at -3.000 rad/s at t = 0.100 s, 115 % of its limit" in str(
        dog.complaint(arm, fast, q, 0, 0.1)
    )
    assert "30 control periods in a row" in str(dog.complaint(arm, good, q, 30, 0.1))


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_a_joint_off_its_reference_or_too_fast_is_seen_either_way(plan: Plan, way: float) -> None:
    """Every joint, beyond 0.05 rad and beyond the maker's speed."""
    arm, _, _ = _parts(plan)
    q, dog = plan.joint.sample(0.0)[0][0], Watchdog()  # type: ignore[union-attr]
    for name, turn, fastest in zip(arm.joint_names, way * np.eye(7), arm.limits.velocity, strict=True):
        assert dog.complaint(arm, ArmState(q + 0.049 * turn, 0.99 * fastest * turn), q, 0, 0.2) == ""
        off = dog.complaint(arm, ArmState(q + 0.051 * turn, 0 * q), q, 0, 0.2)
        assert off == f"{name} is 0.051 rad off its reference at t = 0.200 s; 0.05 rad are allowed."
        fast = dog.complaint(arm, ArmState(q, 1.02 * fastest * turn), q, 0, 0.2)
        assert fast.startswith(f"{name} moves at {1.02 * way * fastest:.3f} rad/s")


def test_cool_stop_reference_is_smooth_and_within_its_share(plan: Plan) -> None:
    arm, carried, _ = _parts(plan)
    dq = np.array([1.5, -0.4, 0.3, 0.0, 2.0, -1.0, 0.5])
    q = plan.joint.sample(0.0)[0][0]  # type: ignore[union-attr]
    torque = with_load(arm, carried).inverse_dynamics(q, dq, np.zeros(7))
    stop: Any = controlled_stops(arm, carried)(ArmState(q, dq), 0.0)
    s = np.linspace(0.0, stop.braking, 4001)
    positions, rates, slopes = (np.array(x) for x in zip(*(stop.reference(x) for x in s), strict=True))
    assert np.array_equal(positions[0], q)
    assert np.array_equal(rates[0], dq)
    assert np.abs(rates[-1]).max() < 1e-12
    assert np.abs(np.gradient(positions, s, axis=0) - rates)[2:-2].max() < 1e-5
    assert np.abs(np.gradient(rates, s, axis=0) - slopes)[2:-2].max() < 1e-3
    assert (np.abs(slopes) / arm.limits.acceleration).max() == pytest.approx(0.8, rel=1e-4)  # the busiest joint
    assert np.abs(stop.step(ArmState(q, dq), 0.0) - torque).max() < 1e-9  # no jump


def test_approach_keeps_its_share_of_the_limits(plan: Plan) -> None:
    arm, _, _ = _parts(plan)
    start = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])
    goal = plan.joint.sample(0.0)[0][0]  # type: ignore[union-attr]
    motion = execute.approach(start, goal, arm)
    q, dq, ddq = motion.sample(np.linspace(0, motion.duration, 3001))
    assert np.abs(q[0] - start).max() < 1e-12
    assert np.abs(q[-1] - goal).max() < 1e-12
    assert (np.abs(dq) / arm.limits.velocity).max() <= 0.1 + 1e-6
    assert (np.abs(ddq) / arm.limits.acceleration).max() <= 0.1 + 1e-6


@pytest.mark.slow
def test_franka_adapter_runs_the_plan(directory: Path, plan: Plan, monkeypatch: pytest.MonkeyPatch) -> None:
    """All but the network: gravity is left to the arm, the load is told, the last torque ends the motion."""
    fake = Library(plan)
    monkeypatch.setitem(sys.modules, "pylibfranka", fake)
    asked: list[int] = []
    result = execute.run_plan(
        directory,
        "franka",
        "172.16.0.2",
        confirm=lambda checks: asked.append(len(checks)) or True,  # type: ignore[func-returns-value]
    )
    assert result.achieved
    assert result.summary["source"] == "franka at 172.16.0.2"
    assert asked == [len(result.checks)]
    assert fake.calls[0] == ("connected", fake.RealtimeConfig.kEnforce)
    assert fake.calls[1][:2] == ("load", 0.15)
    assert fake.calls[1][2] == pytest.approx([0.0, 0.0, 0.045])
    assert fake.calls[1][3] == [1.25e-4, 0, 0, 0, 1.25e-4, 0, 0, 0, 1.25e-4]
    contact, collision, push, hit = (max(each) for each in fake.thresholds)
    assert 0 < contact < collision < 87.0  # N m, the most that a Panda's joint gives: the arm can stop by itself
    assert 0 < push < hit
    finished = [call[1] for call in fake.calls if call[0] == "finished"]
    assert finished == [False] * (len(finished) - 1) + [True]
    assert fake.calls[-1] == ("stopped",)
    assert result.arrays["tray_e_p"].max() < 1e-3
    assert result.summary["joint_error_peak"] < 5e-3


@pytest.mark.parametrize("away", [True, False])
def test_nothing_moves_that_was_not_confirmed(
    directory: Path, plan: Plan, monkeypatch: pytest.MonkeyPatch, away: bool
) -> None:
    """Neither to the start, from where the arm stands elsewhere, nor along the plan."""
    at = plan.joint.q[0] + (0.05 if away else 0.0)  # type: ignore[union-attr]
    fake = Library(plan, at)
    monkeypatch.setitem(sys.modules, "pylibfranka", fake)
    with pytest.raises(SalverError, match="you did not confirm"):
        execute.run_plan(directory, "franka", "arm", move_to_start=away, confirm=lambda checks: False)
    assert "connected" in {call[0] for call in fake.calls}
    assert "controlled" not in {call[0] for call in fake.calls}


@pytest.mark.slow
def test_franka_moves_to_the_start_first_when_told(
    directory: Path, plan: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    posture = plan.joint.sample(0.0)[0][0] + np.array([0.05, -0.04, 0.0, 0.03, 0.0, 0.05, -0.05])  # type: ignore[union-attr]
    fake = Library(plan, posture)
    monkeypatch.setitem(sys.modules, "pylibfranka", fake)
    with pytest.raises(SalverError, match="--move-to-start"):
        execute.run_plan(directory, "franka", "arm")
    with pytest.raises(SalverError, match="you did not confirm"):
        execute.run_plan(directory, "franka", "arm", move_to_start=True, confirm=lambda checks: False)
    result = execute.run_plan(directory, "franka", "arm", move_to_start=True)
    assert result.achieved
    (put,) = (call[1] for call in fake.calls if call[0] == "put")
    assert put == pytest.approx(plan.joint.q[0], abs=1e-12)  # type: ignore[union-attr]


def test_ctrl_c_on_the_way_to_the_start_stops_the_arm(
    directory: Path, plan: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    posture = plan.joint.sample(0.0)[0][0] + 0.05  # type: ignore[union-attr]
    fake = Library(plan, posture)
    monkeypatch.setitem(sys.modules, "pylibfranka", fake)
    positions: list[Any] = []

    class Pressed(fake.JointPositions):  # type: ignore[name-defined, misc]
        def __init__(self, q: list[float]) -> None:
            super().__init__(q)
            positions.append(q)
            if len(positions) > 200:
                os.kill(os.getpid(), signal.SIGINT)

    fake.JointPositions = Pressed
    with pytest.raises(SalverError, match=r"Interrupted at t = 0\.2\d\d s\. The arm was stopped on its way"):
        execute.run_plan(directory, "franka", "arm", move_to_start=True)
    assert len(positions) == 201
    assert positions[0] == pytest.approx(posture, abs=1e-8)  # no jump: a millisecond moves it by 1e-9 rad
    assert fake.calls[-1] == ("stopped",)


@pytest.mark.parametrize("q_d", [[0.1] * 6 + [np.nan], [0.1] * 6], ids=["nan", "six"])
def test_an_arm_that_does_not_say_where_it_is_is_not_moved(
    plan: Plan, monkeypatch: pytest.MonkeyPatch, q_d: list[float]
) -> None:
    from salver.driver.robots.franka import FrankaRobot

    monkeypatch.setitem(sys.modules, "pylibfranka", Library(plan))
    robot = FrankaRobot("arm", _parts(plan)[0], 0.15, np.full(3, 1e-4), realtime=False)
    monkeypatch.setattr(robot._robot, "read_once", lambda: SimpleNamespace(q_d=q_d))
    with pytest.raises(SalverError, match="The arm at arm reports no numbers for its joints"):
        robot.move(lambda q: pytest.fail("a motion from nowhere was asked for"))


def test_franka_that_does_not_answer(directory: Path, plan: Plan, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pylibfranka", Library(plan))
    with pytest.raises(SalverError, match=r"The arm at nowhere says: Connection timed out\."):
        execute.run_plan(directory, "franka", "nowhere")
    monkeypatch.setitem(sys.modules, "pylibfranka", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'salver\[robot\]'"):
        execute.run_plan(directory, "franka", "172.16.0.2")


def test_a_franka_is_sent_what_it_does_not_add_by_itself(plan: Plan, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its own model of gravity differs from ours by what it says for its last state; a state that is not believed says
    nothing, and the difference stays."""
    from salver.driver.robots.franka import FrankaRobot

    monkeypatch.setitem(sys.modules, "pylibfranka", fake := Library(plan))
    arm, q = _parts(plan)[0], plan.joint.q[0]  # type: ignore[union-attr]
    robot = FrankaRobot("arm", arm, 0.15, np.full(3, 1e-4), realtime=False)
    differs = [np.zeros(7)]
    monkeypatch.setattr(robot._model, "gravity", lambda state: arm.gravity(q) + differs[0])
    robot.look()
    robot.start()
    off, wanted = np.linspace(0.3, -0.2, 7), np.linspace(-0.1, 0.2, 7)
    for said, wrong, known in ((off, "", off), (-off, "it froze", off), (-off, "", -off)):
        differs[0] = said
        for _ in range(3):  # within the limits of the torque rate
            robot.write(arm.gravity(q) + wanted, Sensed(ArmState(q, 0 * q), np.ones(7, dtype=bool), 1e-3, wrong))
        assert fake.commands[-1] == pytest.approx(wanted - known, abs=1e-9)


def test_a_franka_that_cannot_be_told_to_stop_says_so(plan: Plan, monkeypatch: pytest.MonkeyPatch) -> None:
    """The loop tries again, and writes into the log that the arm was not told."""
    from salver.driver.robots.franka import FrankaRobot

    monkeypatch.setitem(sys.modules, "pylibfranka", Library(plan))
    robot = FrankaRobot("arm", _parts(plan)[0], 0.15, np.full(3, 1e-4), realtime=False)

    def gone() -> None:
        raise RuntimeError("libfranka: connection lost")

    monkeypatch.setattr(robot._robot, "stop", gone)
    with pytest.raises(RuntimeError, match="connection lost"):
        robot.stop()


def test_pylibfranka_has_the_names_that_are_used() -> None:
    real = pytest.importorskip("pylibfranka", reason="pylibfranka is not installed (pip install 'salver[robot]')")
    robot = (
        "set_load",
        "set_collision_behavior",
        "load_model",
        "read_once",
        "start_torque_control",
        "start_joint_position_control",
        "stop",
    )
    assert all(hasattr(real.Robot, name) for name in robot)
    assert hasattr(real.ActiveControlBase, "readOnce")
    assert hasattr(real.ActiveControlBase, "writeOnce")
    assert hasattr(real.Model, "gravity")
    assert hasattr(real.Duration, "to_sec")
    command = real.Torques([0.0] * 7)
    command.motion_finished = True
    assert hasattr(real.ControllerMode, "JointImpedance")
    assert real.JointPositions([0.1] * 7).motion_finished is False
    assert {"q", "q_d", "dq"} <= set(dir(real.RobotState))
    from salver.driver.robots.franka import FrankaRobot

    case = scenario.load("panda-cube")
    with pytest.raises(SalverError, match=r"The arm at 127\.0\.0\.1 says: "):
        FrankaRobot("127.0.0.1", load_arm(case.arm, case.tray), 0.15, np.full(3, 1e-4), realtime=False)  # type: ignore[arg-type]


# The command ----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_commands_that_cannot_be(directory: Path, tmp_path: Path) -> None:
    from typer.testing import CliRunner

    from salver.cli import app

    def said(*words: str) -> str:
        result = CliRunner().invoke(app, ["execute", str(directory), *words])
        assert result.exit_code == 2, result.output
        return result.output + (result.stderr or "")

    assert 'no robot "spot"; known are simulated, franka' in said("--robot", "spot")
    assert 'has no motion "../plan"; it has plan' in said("--plan", "../plan", "--dry-run")
    assert "Give the arm's --address" in said()
    assert "--watchdog is 3 rad" in said("--watchdog", "3", "--dry-run")
    bare = tmp_path / "no-arm"
    make_plan(scenario.load("panda-cube").with_changes(arm=None), "baseline").save(bare, "plan")
    result = CliRunner().invoke(app, ["execute", str(bare), "--dry-run"])
    assert result.exit_code == 2
    assert "has no arm" in result.output + (result.stderr or "")


@pytest.mark.slow
def test_what_a_busy_machine_misses_is_not_told_as_if_an_arm_had(
    directory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It holds this loop up for 30 ms."""
    from typer.testing import CliRunner

    from salver.cli import app

    read, calls = SimulatedRobot.read, itertools.count()

    def held_up(robot: SimulatedRobot) -> tuple[ArmState, float]:
        if next(calls) == 400:
            time.sleep(0.03)
        return read(robot)

    monkeypatch.setattr(SimulatedRobot, "read", held_up)
    busy = CliRunner().invoke(app, ["execute", str(directory), "--dry-run"]).stdout
    assert "control periods in a row were missed" in busy
    assert "This machine missed those periods, not an arm" in busy
    assert "of the robot" not in busy
    waited = CliRunner().invoke(app, ["execute", str(directory), "--dry-run", "--no-realtime"]).stdout
    assert "Ran to its end" in waited
    assert "missed" not in waited


def test_an_edited_plan_is_refused_by_name(directory: Path, tmp_path: Path) -> None:
    """On the command line, with exit code 2; and an edit that its certificate was made to fit, by what it does."""
    import shutil

    from typer.testing import CliRunner

    from rewritten_runs import rewrite
    from salver.cli import app

    run = Path(shutil.copytree(directory, tmp_path / "run"))
    shutil.rmtree(run / "execution", ignore_errors=True)
    for certified, words in (
        (False, "array joint_ddq is not what was judged"),
        (True, "holds nan where a number must"),
    ):
        rewrite(run, arrays=lambda held: held["joint_ddq"].__setitem__((40, 2), np.nan), certified=certified)
        result = CliRunner().invoke(app, ["execute", str(run), "--dry-run", "--no-realtime"])
        assert result.exit_code == 2
        assert words in result.output + (result.stderr or "")
        assert not (run / "execution").exists()
