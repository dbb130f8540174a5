"""Exports are read back by other programs' readers and compared with the plan itself."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from ruamel.yaml import YAML

from salver import scenario
from salver.errors import FileFormatError, SalverError
from salver.export import FORMATS, urscript, write_export
from salver.export.motion import _stops, read_motion
from salver.motion_files import MotionSeries
from salver.planning.make import make_plan
from salver.planning.plan import load_plan
from salver.planning.stops import plan_stops, stop_problem
from ur_server import Program

TOLERANCE = 1e-12


@pytest.fixture(scope="module")
def directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run directory whose tray tilts, so that no quaternion is trivial."""
    case = scenario.load("panda-cube").with_changes(motion__goal__rpy_deg=[8.0, -5.0, 40.0])
    folder = tmp_path_factory.mktemp("run")
    make_plan(case, "baseline").save(folder, "plan")
    return folder


def _stacked(table: dict[str, np.ndarray], prefix: str, parts: str) -> np.ndarray:
    return np.stack([table[f"{prefix}_{c}"] for c in parts], axis=1)


@pytest.mark.slow
def test_csv_keeps_every_digit(directory: Path, tmp_path: Path) -> None:
    (path,) = write_export(directory, "csv", tmp_path / "motion.csv")
    with open(path, newline="") as file:
        rows = list(csv.DictReader(file))
    table = {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}
    motion = read_motion(directory)
    assert np.array_equal(table["t"], motion.t)
    assert np.array_equal(_stacked(table, "p_SE", "xyz"), motion.p_SE)
    assert np.array_equal(_stacked(table, "quat_SB", "wxyz"), motion.quat_SB_wxyz)
    assert np.array_equal(np.stack([table[f"tau_{j}"] for j in motion.joint_names], axis=1), motion.tau)


def test_exported_motion_is_the_plan(directory: Path) -> None:
    """Against the plan's own arrays, the tray by forward kinematics of the exported joints."""
    from salver.models.arm.arm import load_arm

    motion, plan = read_motion(directory), load_plan(directory)
    assert np.abs(motion.t - plan.t).max() < 0.5e-9 + TOLERANCE
    arrays = plan.arrays()
    speed = np.abs(arrays["v_S"]).max()
    assert np.abs(motion.p_SB - arrays["p_SB"]).max() < TOLERANCE + 1e-9 * speed
    arm = load_arm(plan.scenario.arm, plan.scenario.tray)  # type: ignore[arg-type]
    for k in (0, len(motion.t) // 3, -1):
        p_SE, _ = arm.tray_pose(motion.q[k])
        assert np.abs(p_SE - motion.p_SE[k]).max() < 1e-5
    body = plan.scenario.payload.first
    assert np.allclose(np.linalg.norm(motion.p_SB - motion.p_SE, axis=1), np.linalg.norm(body.p_EB), atol=1e-12)


def test_rate_gives_that_many_samples_a_second_and_the_end(directory: Path) -> None:
    motion = read_motion(directory, rate=1000.0)
    assert len(motion.ns) == 2501
    assert np.array_equal(motion.ns, np.arange(2501) * 1_000_000)
    odd = read_motion(directory, rate=7.0)
    assert odd.ns[-1] == 2_500_000_000
    assert np.array_equal(odd.ns[:-1], np.round(np.arange(18) / 7 * 1e9).astype(int))


def test_ros_bag_round_trip(directory: Path, tmp_path: Path) -> None:
    from rosbags.highlevel import AnyReader

    files = write_export(directory, "ros2", tmp_path / "bag")
    assert {f.suffix for f in files} == {".mcap", ".yaml"}
    motion = read_motion(directory)
    with AnyReader([tmp_path / "bag"]) as reader:
        read = {c.topic: reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages()}
    assert set(read) == {"/salver/joint_trajectory", "/salver/tray_path"}
    joints = read["/salver/joint_trajectory"]
    assert tuple(joints.joint_names) == motion.joint_names
    ns = np.array([p.time_from_start.sec * 10**9 + p.time_from_start.nanosec for p in joints.points])
    assert np.array_equal(ns, motion.ns)
    for field, values in (("positions", motion.q), ("velocities", motion.dq), ("accelerations", motion.ddq)):
        assert np.abs(np.array([getattr(p, field) for p in joints.points]) - values).max() <= TOLERANCE
    assert np.abs(np.array([p.effort for p in joints.points]) - motion.tau).max() <= TOLERANCE
    poses = read["/salver/tray_path"].poses
    assert poses[0].header.frame_id == "world"
    position = np.array([[q.pose.position.x, q.pose.position.y, q.pose.position.z] for q in poses])
    turn = [q.pose.orientation for q in poses]
    assert np.abs(position - motion.p_SE).max() <= TOLERANCE
    assert np.abs(np.array([[q.w, q.x, q.y, q.z] for q in turn]) - motion.quat_SE_wxyz).max() <= TOLERANCE
    stamps = [q.header.stamp.sec * 10**9 + q.header.stamp.nanosec for q in poses]
    assert np.array_equal(stamps, motion.ns)


@pytest.mark.slow
def test_yaml_messages_round_trip_in_both_versions_of_yaml(directory: Path, tmp_path: Path) -> None:
    """ROS 2 reads YAML 1.1, where 1e-05 would be a word."""
    files = write_export(directory, "yaml", tmp_path / "motion.yaml", rate=50.0)
    motion = read_motion(directory, rate=50.0)
    assert [f.name for f in files] == ["motion.yaml"]
    for version in ((1, 1), (1, 2)):
        yaml = YAML(typ="safe", pure=True)
        yaml.version = version
        joints = yaml.load(files[0])
        assert joints["joint_names"] == list(motion.joint_names)
        numbers = np.array([p["velocities"] for p in joints["points"]])
        assert numbers.dtype == float
        assert np.abs(numbers - motion.dq).max() <= TOLERANCE
        times = [p["time_from_start"]["sec"] * 10**9 + p["time_from_start"]["nanosec"] for p in joints["points"]]
        assert np.array_equal(times, motion.ns)


@pytest.mark.slow
def test_mujoco_scene_opens_elsewhere_and_holds_still(directory: Path, tmp_path: Path) -> None:
    """Loaded by MuJoCo alone from a directory that was moved: masses, start pose, and nothing falls or slides."""
    import mujoco

    write_export(directory, "mujoco", tmp_path / "scene")
    (tmp_path / "scene").rename(tmp_path / "moved")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "moved" / "scene.xml"))
    assert "vertex=" not in (tmp_path / "moved" / "scene.xml").read_text(), "converters to USD want meshes as files"
    data = mujoco.MjData(model)
    plan = load_plan(directory)
    body = plan.scenario.payload.first
    cube = model.body("salver:object:0").id
    assert model.body_mass[cube] == pytest.approx(body.inertial.mass, abs=TOLERANCE)
    assert np.abs(model.body_inertia[cube] - np.diag(body.inertial.inertia_com)).max() < TOLERANCE
    mujoco.mj_resetDataKeyframe(model, data, model.key("start").id)
    mujoco.mj_forward(model, data)
    assert np.abs(data.xpos[cube] - plan.scenario.motion.start.position).max() < 1e-5
    tray = model.body("salver:tray").id
    before = data.xpos[cube] - data.xpos[tray]
    for _ in range(1000):
        mujoco.mj_step(model, data)
    assert np.abs(data.xpos[cube] - data.xpos[tray] - before).max() < 2e-5
    assert np.abs(data.xpos[cube] - plan.scenario.motion.start.position).max() < 1e-3
    with open(tmp_path / "moved" / "motion.csv", newline="") as file:
        first = next(csv.DictReader(file))
    q = [float(first[f"q_{name}"]) for name in (model.actuator(i).name for i in range(model.nu))]
    assert np.abs(np.array(q) - model.key("start").ctrl).max() < TOLERANCE


@pytest.mark.slow
def test_mujoco_scene_of_a_stack_without_an_arm_stands(arch: Path, tmp_path: Path) -> None:
    import mujoco

    write_export(arch, "mujoco", tmp_path / "scene")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "scene" / "scene.xml"))
    assert np.array_equal(model.opt.gravity, [0, 0, -9.81])
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    before = data.qpos.copy()
    for _ in range(1000):
        mujoco.mj_step(model, data)
    assert np.abs(data.qpos - before).max() < 1e-4
    weight = sum(item.mass for item in load_plan(arch).scenario.objects) * 9.81
    normal = [
        data.efc_force[c.efc_address] for c in data.contact if model.body("salver:tray").id in model.geom_bodyid[c.geom]
    ]
    assert sum(normal) == pytest.approx(weight, rel=1e-3)


@pytest.mark.parametrize(("rate", "period"), [(None, 0.008), (500.0, 0.002)])
def test_a_urscript_streams_the_joints_of_the_plan_at_its_controllers_rate(
    tmp_path: Path, rate: float | None, period: float
) -> None:
    """Read as a robot's controller would: every servoj holds for one period, from the start to rest at the goal."""
    make_plan(scenario.load("ur5-bottle"), "baseline").save(tmp_path / "run", "plan")
    (path,) = write_export(tmp_path / "run", "urscript", rate=rate)
    plan = load_plan(tmp_path / "run", "plan")
    assert path.name == "plan.script"
    lines = [line.strip() for line in path.read_text().splitlines()]
    sent = [json.loads(line[len("servoj(") : line.index("]") + 1]) for line in lines if line.startswith("servoj(")]
    assert all(f"t={period}," in line for line in lines if line.startswith("servoj("))
    assert any("For the arm ur5 only" in line and ("For an e-Series" in line) == (rate is not None) for line in lines)
    instants = np.minimum(period * np.arange(1, len(sent) + 1), plan.duration)
    assert plan.duration <= period * len(sent) < plan.duration + period
    np.testing.assert_allclose(sent, plan.joint.sample(instants)[0], atol=1e-9)  # instants in whole nanoseconds
    (start,) = [line for line in lines if line.startswith("local start = ")]
    assert json.loads(start[len("local start = ") :]) == plan.joint.sample(0.0)[0][0].tolist()
    assert lines[-3:] == ["stopj(2.0)", "end", "salver_motion()"]
    assert sum(line == "end" for line in lines) == sum(line.startswith(("def ", "while ", "if ")) for line in lines)


@pytest.fixture(scope="module")
def stoppable(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run directory of a UR whose plan has stops."""
    folder = tmp_path_factory.mktemp("stoppable")
    plan = make_plan(scenario.load("ur5-bottle"), "baseline")
    assert plan.joint is not None
    replace(plan, stops=plan_stops(stop_problem(plan), plan.joint, 0.25, plan.space)).save(folder)
    return folder


@pytest.mark.parametrize("period", [pytest.param(0.002, marks=pytest.mark.slow), 0.008])
def test_a_urscript_that_is_stopped_follows_the_stop_of_the_instant(
    stoppable: Path, tmp_path: Path, period: float
) -> None:
    """Run period by period; its input is low for one period only, at instants before, at and between the stops."""
    (path,) = write_export(stoppable, "urscript", tmp_path / "m.script", stop_input=3, rate=1 / period)
    text, plan = path.read_text(), load_plan(stoppable)
    joint, library = plan.joint, plan.stops
    assert joint is not None
    assert library is not None
    assert len(library.taken) >= 2
    assert f"within {library.longest:.2f} s. Checked at full speed only." in text
    whole = Program(text, joint.q[0], period=period)
    t = np.minimum(period * np.arange(1, len(whole.sent) + 1), joint.duration)
    np.testing.assert_allclose(whole.sent, joint.sample(t)[0], atol=1e-9)
    ends = set()
    for now in (0.1, *(float(library.t[1]) + np.array([-2, 2]) * period), 0.7, plan.duration - 0.05):
        program = Program(text, joint.q[0], low_at=now, period=period)
        stopped = library.stopped(joint, now)
        ends.add(len(program.sent))
        t = np.minimum(period * np.arange(1, len(program.sent) + 1), stopped.duration)
        assert abs(len(program.sent) - stopped.duration / period) <= 1
        np.testing.assert_allclose(program.sent, stopped.sample(t)[0], atol=1e-8)
        assert program.stopped == 2.0
    assert len(ends) > 2


@pytest.mark.slow
def test_a_program_of_two_legs_that_is_stopped_in_the_pause_does_not_begin_the_next(stoppable: Path) -> None:
    motion, library = read_motion(stoppable, rate=500.0), load_plan(stoppable).stops
    assert motion.q is not None
    assert library is not None
    both = MotionSeries.in_turn([motion, motion], 1.0, 0.002)
    text = urscript.program(replace(both, about=motion.about, verdict=motion.verdict), 500.0, 3)
    assert f"within {library.longest:.2f} s. Checked at full speed only." in text  # the pause is no braking
    end, start = motion.t[-1], motion.q[0]
    whole = Program(text, start)
    assert len(whole.sent) == pytest.approx((2 * end + 1.0) / 0.002, abs=2)
    np.testing.assert_array_equal(whole.sent[int((end + 0.2) / 0.002)], motion.q[-1])
    paused = Program(text, start, low_at=end + 0.1)
    np.testing.assert_array_equal(paused.sent[-1], motion.q[-1])
    assert len(paused.sent) == pytest.approx((end + 1.0) / 0.002, abs=2)
    stopped = Program(text, start, low_at=end + 1.0 + float(library.t[1]) + 0.005)
    rest = library.motion(library.taken[2]).q[-1]
    np.testing.assert_allclose(stopped.sent[-1], rest, atol=1e-8)


def test_a_urscript_does_not_begin_while_its_stop_is_pressed_or_its_arm_is_elsewhere(
    stoppable: Path, tmp_path: Path
) -> None:
    (path,) = write_export(stoppable, "urscript", tmp_path / "m.script", stop_input=3, rate=500)
    q = load_plan(stoppable).joint.q[0]  # type: ignore[union-attr]
    for program, words in (
        (Program(path.read_text(), q, low_at=0.0), "Digital input 3 is low: it is the stop, and must be high."),
        (Program(path.read_text(), q + 0.02), "The arm is not at the start of this motion."),
    ):
        assert program.sent == []
        assert program.said == [words]
    with pytest.raises(SalverError, match="stop's digital input is 8; it must be 0 to 7"):
        write_export(stoppable, "urscript", tmp_path / "n.script", stop_input=8)


@pytest.mark.parametrize("rate", [1000.0, 300.0, 10.0])
def test_a_urscript_at_a_rate_that_no_controller_keeps_is_refused(stoppable: Path, tmp_path: Path, rate: float) -> None:
    """At 1000 Hz a controller of 500 Hz would take twice the plan's time."""
    with pytest.raises(SalverError, match=rf"A URScript of {rate:g} positions per second .* must be 500, 250 or"):
        write_export(stoppable, "urscript", tmp_path / "n.script", rate=rate)


@pytest.mark.parametrize(("form", "rate"), [("yaml", 100.0), ("moveit", None)])
def test_stops_are_trajectories_by_name_with_a_table_of_times(
    stoppable: Path, tmp_path: Path, form: str, rate: float | None
) -> None:
    from ruamel.yaml import YAML

    path = write_export(stoppable, form, tmp_path / "m.yaml", rate=rate)[-1]
    assert path.name == "m_stops.yaml"
    named, library = YAML(typ="safe").load(path), load_plan(stoppable).stops
    assert library is not None
    table = named.pop("table")
    assert [row["name"] for row in table] == list(named)
    for row, k in zip(table, library.taken, strict=True):
        message = named[row["name"]]["joint_trajectory"] if form == "moveit" else named[row["name"]]
        points = message["points"]
        assert _seconds(row["leave_at"]) == pytest.approx(library.t[k], abs=1e-9)
        assert _seconds(row["rests_at"]) == pytest.approx(library.t[k] + library.duration[k], abs=1e-8)
        t = np.array([_seconds(point["time_from_start"]) for point in points])
        assert t[0] == 0.0
        if rate is not None:
            ticks = (library.t[k] + t[1:-1]) * rate
            np.testing.assert_allclose(ticks, np.round(ticks), atol=1e-6)
        for name, values in zip(("positions", "velocities"), library.motion(k).sample(t), strict=False):
            np.testing.assert_allclose([point[name] for point in points], values, atol=1e-9)


@pytest.mark.slow
def test_a_bag_has_its_stops_beside_its_motion_and_is_read_as_that(stoppable: Path, tmp_path: Path) -> None:
    from rosbags.highlevel import AnyReader

    from salver.motion_files import read

    write_export(stoppable, "ros2", tmp_path / "bag")
    library = load_plan(stoppable).stops
    assert library is not None
    with AnyReader([tmp_path / "bag"]) as reader:
        stops = [
            (stamp, reader.deserialize(raw, c.msgtype))
            for c, stamp, raw in reader.messages()
            if c.topic == "/salver/stops"
        ]
    assert [stamp for stamp, _ in stops] == [round(1e9 * library.t[k]) for k in library.taken]
    for (stamp, message), k in zip(stops, library.taken, strict=True):
        assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == stamp
        np.testing.assert_allclose(message.points[-1].positions, library.q[k, -1], atol=1e-9)
    assert len(read(tmp_path / "bag").t) == len(read_motion(stoppable).t)


def test_a_stop_that_is_never_the_soonest_is_not_written(stoppable: Path) -> None:
    """The second one is at rest later than the third, so nobody leaves for it."""
    plan = load_plan(stoppable)
    assert plan.stops is not None
    assert plan.stops.taken == tuple(range(len(plan.stops.t)))
    duration = plan.stops.duration.copy()
    duration[1] = plan.stops.t[2] + duration[2] - plan.stops.t[1] + 1e-3
    slow = replace(plan.stops, duration=duration)
    assert slow.taken == (0, *range(2, len(slow.t)))
    written = [leave for leave, _ in _stops(replace(plan, stops=slow), ("a",), None)]
    assert written == [round(1e9 * slow.t[k]) for k in slow.taken]


def test_without_stops_there_is_no_file_of_them(directory: Path, tmp_path: Path) -> None:
    files = write_export(directory, "yaml", tmp_path / "m.yaml", rate=10)
    assert [f.name for f in files] == ["m.yaml"]
    assert read_motion(directory).stops == ()


def _seconds(time: dict[str, int]) -> float:
    return time["sec"] + 1e-9 * time["nanosec"]


def test_urscript_is_refused_for_another_makers_arm(directory: Path, tmp_path: Path) -> None:
    with pytest.raises(SalverError, match=r"for the arms of Universal Robots, .* has panda_joint1"):
        write_export(directory, "urscript", tmp_path / "m.script")
    assert not (tmp_path / "m.script").exists()


def test_without_an_arm_paths_alone_are_exported(tmp_path: Path) -> None:
    case = scenario.load("panda-cube").with_changes(arm=None)
    make_plan(case, "baseline").save(tmp_path / "run", "plan")
    files = write_export(tmp_path / "run", "yaml", tmp_path / "m.yaml", rate=10)
    assert [f.name for f in files] == ["m.yaml"]
    assert files[0].read_text().startswith("# nav_msgs/msg/Path\n")
    motion, path = read_motion(tmp_path / "run", rate=10), YAML(typ="safe").load(files[0])
    turn = [pose["pose"]["orientation"] for pose in path["poses"]]
    assert np.abs(np.array([[q["w"], q["x"], q["y"], q["z"]] for q in turn]) - motion.quat_SE_wxyz).max() <= TOLERANCE
    assert "q_" not in write_export(tmp_path / "run", "csv", rate=10)[0].read_text().splitlines()[0]


def test_mistakes_get_a_sentence(directory: Path, tmp_path: Path) -> None:
    with pytest.raises(SalverError, match=r'no export format "xml"; known are csv, ros2, .*, mujoco, urscript'):
        write_export(directory, "xml")
    for file_format in ("ros2", "mujoco"):
        (tmp_path / file_format).mkdir()
        with pytest.raises(SalverError, match=f"{file_format} exists; .* name another with -o"):
            write_export(directory, file_format, tmp_path / file_format)
    with pytest.raises(SalverError, match="rate of 0 samples per second"):
        write_export(directory, "csv", tmp_path / "x.csv", rate=0)
    for file_format in FORMATS:
        with pytest.raises(FileFormatError, match="not a run directory"):
            write_export(tmp_path, file_format, tmp_path / "out")
        assert not (tmp_path / "out").exists()
    with pytest.raises(FileFormatError, match=r'has no motion "nowhere"; it has plan'):
        write_export(directory, "csv", tmp_path / "x.csv", stem="nowhere")
