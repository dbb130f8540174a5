"""Driving an arm: the loop on the simulated arm, its safety, the Franka adapter, motion capture."""

from __future__ import annotations

import csv
import sys
import time
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from salver import scenario
from salver.control.arm import ArmState, controller_for
from salver.driver import execute, mocap
from salver.driver.execution import CoolStop, Watchdog, drive, timing
from salver.driver.robots import SimulatedRobot
from salver.errors import FileFormatError, MissingDependencyError, SalverError
from salver.geometry import Array, compose, exp, log, matrix_from_quat_wxyz, quat_wxyz_from_matrix
from salver.models.arm import load_arm, with_load
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


def test_dry_run_without_waiting_is_the_simulation(directory: Path, plan: Plan) -> None:
    """The driver's loop and `salver simulate` step the same controller on the same arm: the same motion."""
    result = execute.dry_run(directory, realtime=False)
    assert result.achieved
    assert result.summary["outcome"] == "holds"
    assert result.summary["timing"]["missed"] == 0
    assert all(check.ok for check in result.checks)
    record = simulate(plan)
    for name in ("q", "dq", "p_SB", "e_p"):
        mine, theirs = result.arrays[name], getattr(record, name)
        k = min(len(mine), len(theirs))
        assert k > 200
        assert np.abs(mine[:k] - theirs[:k]).max() < 1e-6, name


def test_dry_run_in_real_time_takes_real_time_and_counts_what_it_missed(directory: Path) -> None:
    began = time.perf_counter()
    result = execute.dry_run(directory, watchdog=PATIENT)
    clock = result.summary["timing"]
    assert time.perf_counter() - began > 1.55  # 0.05 s + 1.4 s + 0.1 s
    assert clock["periods"] + clock["missed"] >= 1549
    assert clock["step_median"] < 1e-3
    assert clock["jitter_median"] <= clock["jitter_p999"] <= clock["jitter_max"]


class _Sleepy(SimulatedRobot):
    """Its caller is held up for 5.2 ms every 100 periods."""

    calls = 0

    def read(self) -> tuple[ArmState, float]:
        self.calls += 1
        if self.calls % 100 == 0:
            time.sleep(5.2e-3)
        return super().read()


def test_missed_periods_are_seen_and_time_goes_on(plan: Plan) -> None:
    arm, carried, controller = _parts(plan)
    robot = _Sleepy(plan, arm, 1.0)
    log_ = drive(robot, controller, plan.joint, arm, carried, start=robot.start_time, end=0.5, watchdog=PATIENT)  # type: ignore[arg-type]
    clock = timing(log_, 1e-3)
    assert clock["missed"] >= 4 * (robot.calls // 100)
    assert clock["jitter_max"] > 4e-3
    assert log_.t[-1] >= 0.499
    behind = (log_.woken - log_.woken[0]) - (log_.t - log_.t[0])
    assert np.median(np.abs(behind)) < 2e-3


class _Pushed(SimulatedRobot):
    """Somebody leans on joint 2 from t = 0.4 s on, for 0.1 s, with 40 N m."""

    def write(self, torque: Array, *, last: bool = False) -> None:
        t = float(self._t[self._recorder.count - 1]) if self._recorder.count else 0.0
        push = np.zeros(7)
        push[1] = 40.0 if 0.4 < t < 0.5 else 0.0
        super().write(torque + push, last=last)


def test_watchdog_brakes_to_rest_within_the_torque_rate(plan: Plan) -> None:
    arm, carried, controller = _parts(plan)
    robot = _Pushed(plan, arm, 3.0, realtime=False)
    log_ = drive(robot, controller, plan.joint, arm, carried, start=robot.start_time, end=1.5, watchdog=Watchdog(0.02))  # type: ignore[arg-type]
    assert "panda_joint" in log_.stopped
    assert "0.02 rad are allowed" in log_.stopped
    stopped_at = float(log_.stopped.split("t = ")[1].split(" s")[0])
    assert 0.4 < stopped_at < 0.55
    assert log_.t[-1] < stopped_at + 1.2
    assert np.abs(log_.dq[-1]).max() < 0.02
    rate = np.abs(np.diff(log_.tau[log_.t > stopped_at], axis=0)).max() / 1e-3
    assert rate <= 1000.0 * (1 + 1e-9)
    assert np.abs(log_.tau).max() <= 87.0


def test_undisturbed_the_watchdog_is_silent_and_torques_are_the_controllers(plan: Plan) -> None:
    arm, carried, controller = _parts(plan)
    robot = SimulatedRobot(plan, arm, 0.0, realtime=False)
    log_ = drive(robot, controller, plan.joint, arm, carried, start=robot.start_time, end=1.5, watchdog=Watchdog())  # type: ignore[arg-type]
    assert log_.stopped == ""
    assert np.abs(log_.q - log_.q_wanted).max() < 2e-3
    _, _, again = _parts(plan)
    for k in range(200):
        tau = again.step(ArmState(log_.q[k], log_.dq[k]), float(log_.t[k]))
        assert np.abs(tau - log_.tau[k]).max() < 1e-9


def test_watchdog_complains_in_words(plan: Plan) -> None:
    arm, _, _ = _parts(plan)
    q = plan.joint.sample(0.0)[0][0]  # type: ignore[union-attr]
    good = ArmState(q.copy(), np.zeros(7))
    dog = Watchdog()
    assert dog.complaint(arm, good, q, 0, 0.0) is None
    assert "no number" in str(dog.complaint(arm, ArmState(q * np.nan, np.zeros(7)), q, 0, 0.1))
    fast = ArmState(q.copy(), np.array([0, 0, 0, 0, 0, -3.0, 0]))
    assert "panda_joint6 turns at -3.000 rad/s at t = 0.100 s, 115 % of its limit" in str(
        dog.complaint(arm, fast, q, 0, 0.1)
    )
    assert "30 control periods in a row" in str(dog.complaint(arm, good, q, 30, 0.1))


def test_cool_stop_reference_is_smooth_and_within_its_share(plan: Plan) -> None:
    arm, carried, _ = _parts(plan)
    dq = np.array([1.5, -0.4, 0.3, 0.0, 2.0, -1.0, 0.5])
    q = plan.joint.sample(0.0)[0][0]  # type: ignore[union-attr]
    torque = with_load(arm, carried).inverse_dynamics(q, dq, np.zeros(7))
    stop = CoolStop(arm, carried, ArmState(q, dq), torque, 1e-3)
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


class _Library(types.ModuleType):
    """Stands in for pylibfranka, names and units as its own; its arm is the physics engine's, which it holds against
    gravity as the real one does."""

    class RealtimeConfig:
        kEnforce, kIgnore = 0, 1

    class ControllerMode:
        JointImpedance = 0

    class FrankaException(RuntimeError):
        pass

    class JointPositions:
        def __init__(self, q: list[float]) -> None:
            self.q, self.motion_finished = q, False

    class Torques:
        def __init__(self, tau_J: list[float]) -> None:
            assert len(tau_J) == 7
            self.tau_J, self.motion_finished = tau_J, False

    def __init__(self, plan: Plan, posture: Array | None = None) -> None:
        super().__init__("pylibfranka")
        arm, _, _ = _parts(plan)
        inner = SimulatedRobot(plan, arm, 60.0, realtime=False)
        if posture is not None:
            inner._run.scene.place(inner._data, posture)
        outer, self.calls = self, []

        class Model:
            def gravity(self, state: Any) -> list[float]:
                return list(arm.gravity(np.array(state.q)))

        class Control:
            def readOnce(self) -> tuple[Any, Any]:
                state, elapsed = inner.read()
                return _state(state), types.SimpleNamespace(to_sec=lambda: elapsed)

            def writeOnce(self, command: Any) -> None:
                outer.calls.append(("finished", command.motion_finished))
                inner.write(np.array(command.tau_J) + arm.gravity(inner.look().q))

        class Position:
            last = inner.look().q

            def readOnce(self) -> tuple[Any, Any]:
                return _state(inner.look()), types.SimpleNamespace(to_sec=lambda: 1e-3)

            def writeOnce(self, command: Any) -> None:
                assert np.abs(np.array(command.q) - self.last).max() < 5e-4  # no jump: 0.5 rad/s
                self.last = np.array(command.q)
                inner._run.scene.place(inner._data, self.last)

        class Robot:
            def __init__(self, address: str, config: int) -> None:
                if address == "nowhere":
                    raise outer.FrankaException("libfranka: Connection timed out.")
                outer.calls.append(("connected", config))

            def set_load(self, mass: float, com: list[float], inertia: list[float]) -> None:
                outer.calls.append(("load", mass, com, inertia))

            def set_collision_behavior(self, *thresholds: list[float]) -> None:
                assert [len(x) for x in thresholds] == [7, 7, 6, 6]

            def load_model(self) -> Any:
                return Model()

            def read_once(self) -> Any:
                return _state(inner.look())

            def start_torque_control(self) -> Any:
                inner.start()
                return Control()

            def start_joint_position_control(self, mode: int) -> Any:
                return Position()

            def stop(self) -> None:
                outer.calls.append(("stopped",))

        self.Robot = Robot


def _state(state: ArmState) -> Any:
    return types.SimpleNamespace(q=list(state.q), q_d=list(state.q), dq=list(state.dq))


def test_franka_adapter_runs_the_plan(directory: Path, plan: Plan, monkeypatch: pytest.MonkeyPatch) -> None:
    """All but the network: gravity is left to the arm, the load is told, the last torque ends the motion."""
    fake = _Library(plan)
    monkeypatch.setitem(sys.modules, "pylibfranka", fake)
    asked: list[int] = []
    result = execute.run_on_franka(directory, "172.16.0.2", confirm=lambda checks: asked.append(len(checks)) or True)  # type: ignore[func-returns-value]
    assert result.achieved
    assert result.summary["source"] == "franka at 172.16.0.2"
    assert asked == [len(result.checks)]
    assert fake.calls[0] == ("connected", fake.RealtimeConfig.kEnforce)
    assert fake.calls[1][:2] == ("load", 0.15)
    assert fake.calls[1][2] == pytest.approx([0.0, 0.0, 0.045])
    assert fake.calls[1][3] == [1.25e-4, 0, 0, 0, 1.25e-4, 0, 0, 0, 1.25e-4]
    finished = [call[1] for call in fake.calls if call[0] == "finished"]
    assert finished == [False] * (len(finished) - 1) + [True]
    assert fake.calls[-1] == ("stopped",)
    assert result.arrays["tray_e_p"].max() < 1e-3
    assert result.summary["joint_error_peak"] < 5e-3


def test_franka_moves_to_the_start_first_when_told(
    directory: Path, plan: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    posture = plan.joint.sample(0.0)[0][0] + np.array([0.05, -0.04, 0.0, 0.03, 0.0, 0.05, -0.05])  # type: ignore[union-attr]
    fake = _Library(plan, posture)
    monkeypatch.setitem(sys.modules, "pylibfranka", fake)
    with pytest.raises(SalverError, match="--move-to-start"):
        execute.run_on_franka(directory, "arm")
    with pytest.raises(SalverError, match="it was not confirmed"):
        execute.run_on_franka(directory, "arm", move_to_start=True, confirm=lambda checks: False)
    result = execute.run_on_franka(directory, "arm", move_to_start=True)
    assert result.achieved


def test_franka_that_does_not_answer(directory: Path, plan: Plan, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pylibfranka", _Library(plan))
    with pytest.raises(SalverError, match=r"The arm at nowhere says: Connection timed out\."):
        execute.run_on_franka(directory, "nowhere")
    monkeypatch.setitem(sys.modules, "pylibfranka", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'salver\[robot\]'"):
        execute.run_on_franka(directory, "172.16.0.2")


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
    from salver.driver.robots import FrankaRobot

    case = scenario.load("panda-cube")
    with pytest.raises(SalverError, match=r"The arm at 127\.0\.0\.1 says: "):
        FrankaRobot("127.0.0.1", load_arm(case.arm, case.tray), 0.15, np.full(3, 1e-4), realtime=False)  # type: ignore[arg-type]


# Motion capture ------------------------------------------------------------------------------------------------------

WORLD = (np.array([1.0, -2.0, 0.3]), exp(np.array([0.0, 0.0, 0.7])))  # of the capture, in S
MARKERS = (np.array([0.003, 0.012, 0.021]), exp(np.array([0.2, -0.1, 0.4])))  # on the object, in B
STARTS_AT = 3.37  # s of the capture's clock


def _capture(
    plan: Plan, path: Path, *, slides: float = 0.0, blind: float | None = None, quaternions: bool = False
) -> None:
    """What Vicon would write at 200 Hz of a cube that follows the plan or slides along the tray, markers anywhere."""
    t = np.arange(0.0, 6.0, 0.005)
    m = plan.reference.sample(t - STARTS_AT)
    body = plan.scenario.payload.first
    gone = slides * np.clip(t - STARTS_AT - 0.4, 0.0, 0.2) / 0.2
    p_SB = m.p_SB + np.einsum("tij,tj->ti", m.R_SB, np.outer(gone, [0.0, 1.0, 0.0]))
    tray = m.of_frame(*compose(np.zeros(3), body.R_EB.T, -body.p_EB, np.eye(3)))
    back = (-WORLD[1].T @ WORLD[0], WORLD[1].T)
    columns = [np.arange(1, len(t) + 1), np.zeros(len(t))]
    for p, R in ((p_SB, m.R_SB), (tray.p_SB, tray.R_SB)):
        p_V, R_V = compose(*back, *compose(p, R, *MARKERS))
        turn = quat_wxyz_from_matrix(R_V) if quaternions else np.rad2deg(log(R_V))
        turn = turn[:, [1, 2, 3, 0]] if quaternions else turn
        seen = np.ones(len(t), bool) if blind is None else np.abs(t - STARTS_AT - blind) > 0.02
        columns += [np.where(seen, x, 0.0) for x in [*turn.T, *(1e3 * p_V.T)]]
    names = "RX,RY,RZ,RW,TX,TY,TZ" if quaternions else "RX,RY,RZ,TX,TY,TZ"
    units = ",,,,mm,mm,mm" if quaternions else "deg,deg,deg,mm,mm,mm"
    gap = "," * names.count(",")
    with open(path, "w", newline="") as file:
        file.write(f"Objects\n200\n,,Global:cube{gap},Global:tray{gap}\n")
        file.write(f"Frame,Sub Frame,{names},{names}\n,,{units},{units}\n")
        csv.writer(file).writerows(zip(*columns, strict=True))


def _merged(plan: Plan, path: Path, **more: Any) -> dict[str, np.ndarray]:
    t = np.arange(-0.05, 1.5, 0.005)
    arm, carried, _ = _parts(plan)
    poses = [arm.tray_pose(q) for q in plan.joint.sample(np.clip(t, 0, 1.4))[0]]  # type: ignore[union-attr]
    arrays = {
        "t": t,
        "p_SE": np.array([p for p, _ in poses]),
        "quat_SE_wxyz": quat_wxyz_from_matrix(np.array([R for _, R in poses])),
    }
    tracks = mocap.read_tracks(path)
    assert set(tracks) == {"cube", "tray"}
    return mocap.merge(
        arrays, tracks, plan.reference, carried[0], object_name="cube", p_SV=WORLD[0], R_SV=WORLD[1], **more
    )


@pytest.mark.parametrize("quaternions", [False, True])
def test_motion_capture_of_a_faithful_cube_shows_no_error(plan: Plan, tmp_path: Path, quaternions: bool) -> None:
    _capture(plan, tmp_path / "vicon.csv", quaternions=quaternions)
    merged = _merged(plan, tmp_path / "vicon.csv", tray_name="tray", offset=STARTS_AT)
    assert merged["e_p"].max() < 2e-5  # straight lines between samples of 200 Hz
    assert merged["e_o"].max() < 1e-6
    assert merged["slip"].max() < 1e-6


def test_motion_capture_sees_a_slide_and_finds_the_time(plan: Plan, tmp_path: Path) -> None:
    _capture(plan, tmp_path / "vicon.csv", slides=0.012)
    merged = _merged(plan, tmp_path / "vicon.csv", tray_name="tray")
    assert float(merged["mocap_offset"]) == pytest.approx(STARTS_AT, abs=0.02)
    exact = _merged(plan, tmp_path / "vicon.csv", tray_name="tray", offset=STARTS_AT)
    assert exact["slip"][-1, 0] == pytest.approx(0.012, abs=1e-5)
    assert exact["e_p"][-1] == pytest.approx(0.012, abs=1e-5)
    assert exact["slip"][exact["t"] < 0.39].max() < 1e-6


def test_motion_capture_with_a_gap_leaves_the_gap_open(plan: Plan, tmp_path: Path) -> None:
    _capture(plan, tmp_path / "vicon.csv", blind=0.5)
    merged = _merged(plan, tmp_path / "vicon.csv", offset=STARTS_AT)
    assert np.all(np.isfinite(merged["e_p"]))  # 40 ms are bridged
    tracks = mocap.read_tracks(tmp_path / "vicon.csv")
    assert len(tracks["cube"].t) < 1200
    late = mocap.Track(tracks["cube"].t + 0.0, tracks["cube"].p, tracks["cube"].R)
    keep = late.t < STARTS_AT + 0.7
    carried = plan.scenario.payload.bodies
    t = np.arange(0, 1.0, 0.01)
    arrays = {"t": t, "p_SE": np.zeros((100, 3)), "quat_SE_wxyz": np.tile([1.0, 0, 0, 0], (100, 1))}
    cut = {"cube": mocap.Track(late.t[keep], late.p[keep], late.R[keep])}
    out = mocap.merge(arrays, cut, plan.reference, carried[0], object_name="cube", offset=STARTS_AT)
    assert np.array_equal(np.isfinite(out["e_p"]), np.isfinite(out["e_o"]))
    assert not np.isfinite(out["e_p"][t > 0.71]).any()
    assert np.isfinite(out["e_p"][t < 0.69]).all()


def test_motion_capture_merges_into_the_log(directory: Path, plan: Plan, tmp_path: Path) -> None:
    execute.dry_run(directory, realtime=False)
    _capture(plan, tmp_path / "vicon.csv", slides=0.012)
    result = execute.merge_mocap(
        directory, "plan", tmp_path / "vicon.csv", tray_name="tray", offset=STARTS_AT, world=WORLD
    )
    assert result.summary["outcome"] == "slides"
    assert not result.achieved
    assert result.summary["slip_peak"] == pytest.approx(0.012, abs=1e-4)
    assert result.arrays["p_SB"].shape[1:] == (1, 3)
    with pytest.raises(SalverError, match='has no object "cup"; it has cube, tray'):
        execute.merge_mocap(directory, "plan", tmp_path / "vicon.csv", object_name="cup")


def test_plain_table_of_motion_capture(tmp_path: Path) -> None:
    path = tmp_path / "plain.csv"
    path.write_text("t,p_x,p_y,p_z,q_w,q_x,q_y,q_z\n0,1,2,3,2,0,0,0\n0.1,1,2,4,0,0,0,-1\n0.2,,,,,,,\n")
    track = mocap.read_tracks(path)["object"]
    assert np.array_equal(track.t, [0, 0.1])
    assert np.array_equal(track.p, [[1, 2, 3], [1, 2, 4]])
    assert np.abs(track.R - matrix_from_quat_wxyz(np.array([[1, 0, 0, 0], [0, 0, 0, 1.0]]))).max() < 1e-15


@pytest.mark.parametrize(
    "content", ["", "hello\nworld\n", "t,p_x\n0,1\n", "t,p_x,p_y,p_z,q_w,q_x,q_y,q_z\n0,a,b,c,d,e,f,g\n"]
)
def test_other_files_are_not_motion_capture(tmp_path: Path, content: str) -> None:
    (tmp_path / "x.csv").write_text(content)
    with pytest.raises(FileFormatError, match="no motion capture that can be read; accepted are"):
        mocap.read_tracks(tmp_path / "x.csv")


def test_commands_that_cannot_be(directory: Path, tmp_path: Path) -> None:
    from typer.testing import CliRunner

    from salver.cli import app

    def said(*words: str) -> str:
        result = CliRunner().invoke(app, ["execute", str(directory), *words])
        assert result.exit_code == 2, result.output
        return result.output + (result.stderr or "")

    assert 'no robot "ur"' in said("--robot", "ur")
    assert "Give the arm's --address" in said()
    assert "--watchdog is 3 rad" in said("--watchdog", "3", "--dry-run")
    assert "six numbers" in said("--mocap", "x.csv", "--mocap-world", "1 2")
    assert "cannot be read as a text file" in said("--mocap", str(tmp_path / "none.csv"))
    bare = tmp_path / "no-arm"
    make_plan(scenario.load("panda-cube").with_changes(arm=None), "baseline").save(bare, "plan")
    result = CliRunner().invoke(app, ["execute", str(bare), "--dry-run"])
    assert result.exit_code == 2
    assert "has no arm" in result.output + (result.stderr or "")
