"""`salver render -o NAME.mcap`: a run as ROS 2 messages, read again by rosbags."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from salver.cli import main
from salver.errors import FileFormatError, SalverError, ScenarioError
from salver.files import read_result
from salver.geometry import matrix_from_quat_wxyz
from salver.models.arm.arm import load_arm
from salver.motion_files import read
from salver.planning.make import make_plan
from salver.planning.plan import load_plan
from salver.reports.pages.mcap import write_mcap
from salver.scenario import load


def content(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """Topic to its messages with their times, ns."""
    from rosbags.highlevel import AnyReader

    found: dict[str, list[tuple[int, Any]]] = {}
    with AnyReader([path]) as reader:
        for connection, ns, raw in reader.messages():
            found.setdefault(connection.topic, []).append((ns, reader.deserialize(raw, connection.msgtype)))
    return found


def frames(message: Any) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Name to position and rotation in the world."""
    out = {}
    for one in message.transforms:
        assert one.header.frame_id == "world"
        p, turn = one.transform.translation, one.transform.rotation
        out[one.child_frame_id] = (
            np.array([p.x, p.y, p.z]),
            matrix_from_quat_wxyz(np.array([turn.w, turn.x, turn.y, turn.z])),
        )
    return out


@pytest.fixture(scope="module")
def planned(cube_plans: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[tuple[int, Any]]]:
    """What a recording of a plan holds."""
    return content(write_mcap(cube_plans, tmp_path_factory.mktemp("mcap") / "cube.mcap"))


@pytest.fixture(scope="module")
def recording(cube_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of a run."""
    return write_mcap(cube_run, tmp_path_factory.mktemp("mcap") / "run.mcap")


def test_a_plan_is_where_it_is_planned_at_each_instant(
    cube_plans: Path, planned: dict[str, list[tuple[int, Any]]]
) -> None:
    plan, found = load_plan(cube_plans), planned
    assert plan.scenario.arm is not None
    assert plan.joint is not None
    arm = load_arm(plan.scenario.arm, plan.scenario.tray)
    assert len(found["/tf"]) == len(found["/joint_states"]) == len(plan.t)
    for k in range(0, len(plan.t), 40):
        ns, message = found["/tf"][k]
        at, (_, state) = frames(message), found["/joint_states"][k]
        samples, q = plan.reference.sample(ns * 1e-9), plan.joint.sample(ns * 1e-9)[0][0]
        assert np.abs(at["cube"][0] - samples.p_SB[0]).max() < 1e-6
        assert np.abs(at["tray"][0] - arm.tray_pose(q)[0]).max() < 1e-5
        assert np.abs(state.position - q).max() < 1e-6
        pin.framesForwardKinematics(arm.pin_model, arm.data, q)
        for link in ("panda_link1", "panda_link4", "panda_link7"):
            frame = arm.data.oMf[arm.pin_model.getFrameId(link)]
            assert np.abs(at[link][0] - frame.translation).max() < 1e-6
            assert np.abs(at[link][1] - frame.rotation).max() < 1e-6
    ((_, verdict),) = found["/salver/verdict"]
    assert verdict.data == plan.verdict


def test_shapes_are_in_their_frames_and_the_cube_stands_on_the_tray(planned: dict[str, list[tuple[int, Any]]]) -> None:
    found = planned
    ((ns, markers),) = found["/salver/markers"]
    at = {"world": (np.zeros(3), np.eye(3)), **frames(found["/tf"][0][1])}
    assert ns == 0
    assert len({one.id for one in markers.markers}) == len(markers.markers)
    corners = {}
    for one in markers.markers:
        p, R = at[one.header.frame_id]
        assert len(one.points) % 3 == 0
        assert one.color.a == 1.0
        corners.setdefault(one.header.frame_id, []).append(p + np.array([[x.x, x.y, x.z] for x in one.points]) @ R.T)
    tray, cube = np.vstack(corners["tray"]), np.vstack(corners["cube"])
    assert tray[:, 2].max() == pytest.approx(cube[:, 2].min(), abs=1e-6)
    assert np.ptp(cube, axis=0) == pytest.approx([0.04] * 3, abs=1e-6)
    assert {f"panda_link{k}" for k in range(1, 8)} < set(corners)


@pytest.mark.slow
def test_a_run_is_as_the_engine_saw_it(cube_run: Path, recording: Path) -> None:
    found = content(recording)
    arrays, _ = read_result(cube_run / "simulation" / "plan.npz", ("t",))
    assert len(found["/tf"]) == len(arrays["t"])
    for k in range(0, len(arrays["t"]), 100):
        at, (ns, state) = frames(found["/tf"][k][1]), found["/joint_states"][k]
        assert ns * 1e-9 == pytest.approx(arrays["t"][k] - arrays["t"][0], abs=1e-9)
        assert np.abs(at["cube"][0] - arrays["p_SB"][k, 0]).max() < 1e-9
        assert np.array_equal(state.velocity, arrays["dq"][k])
        assert np.array_equal(state.effort, arrays["tau"][k])


@pytest.mark.slow
def test_its_joints_are_read_as_a_motion(cube_run: Path, recording: Path) -> None:
    """By `salver audit` and `report` too."""
    arrays, _ = read_result(cube_run / "simulation" / "plan.npz", ("t",))
    samples = read(recording, lambda: ())
    assert np.array_equal(samples.q, arrays["q"])
    assert samples.names[0] == "panda_joint1"


def test_a_tray_without_an_arm(tmp_path: Path) -> None:
    directory = make_plan(load("prisma-cube"), "baseline").save(tmp_path / "run")
    found = content(write_mcap(directory, tmp_path / "run.mcap"))
    assert "/joint_states" not in found
    assert {"tray", "cube"} == set(frames(found["/tf"][0][1]))


def test_what_cannot_be_written_is_told(cube_plans: Path, tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match='has no motion "nominal"; it has plan, baseline'):
        write_mcap(cube_plans, tmp_path / "x.mcap", "nominal")
    with pytest.raises(FileFormatError):
        write_mcap(tmp_path, tmp_path / "x.mcap")
    with pytest.raises(SalverError, match="cannot be written"):
        write_mcap(cube_plans, tmp_path / "none" / "x.mcap")


@pytest.mark.parametrize("name", ["world", "panda_link4"])
def test_an_object_with_the_name_of_another_frame_is_refused(cube_plans: Path, tmp_path: Path, name: str) -> None:
    plan = load_plan(cube_plans)
    replace(plan, scenario=plan.scenario.with_changes(objects__0__name=name)).save(tmp_path / "run")
    with pytest.raises(ScenarioError, match=f'Two frames would be called "{name}"'):
        write_mcap(tmp_path / "run", tmp_path / "x.mcap")
    assert not (tmp_path / "x.mcap").exists()


@pytest.mark.slow
def test_the_command_writes_it(
    cube_plans: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["render", str(cube_plans), "-o", str(tmp_path / "cube.mcap"), "--plan", "baseline", "--json"]
    monkeypatch.setattr("sys.argv", ["salver", *words])
    with pytest.raises(SystemExit) as ended:
        main()
    assert not ended.value.code
    path = Path(json.loads(capsys.readouterr().out)["recording"])
    assert len(content(path)["/tf"]) == len(load_plan(cube_plans, "baseline").t)
