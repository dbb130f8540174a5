"""Audits: files of every format read to the same motion, accelerations found in noise, verdicts derived by hand."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from salver import scenario as scenarios
from salver.auditing import audit, audit_motion
from salver.auditing.motion import TrayMotion, forward, tray_motion
from salver.auditing.noise import Level, found, level, resolution, spikes
from salver.auditing.readers import read
from salver.auditing.recorded import sensor_of, stretches
from salver.auditing.spline import fit
from salver.cli import app
from salver.errors import FileFormatError, SalverError
from salver.geometry import exp, quat_wxyz_from_matrix
from salver.models.arm import load_arm
from salver.trajectory import MotionSamples, min_jerk_line

START, GOAL = np.array([0.5, -0.25, 0.4]), np.array([0.5, 0.25, 0.4])
PEAK = 10 / np.sqrt(3) * 0.5  # of the min-jerk acceleration over 0.5 m, times T^2
JOINTS = tuple(f"panda_joint{i}" for i in range(1, 8))
Q0 = np.array([0.082565, 1.039634, -0.777333, -1.678140, -2.197384, 0.842888, 1.123073])
AT_B, NO_TURN = np.zeros(3), np.eye(3)


@pytest.fixture(scope="module")
def arm():
    case = scenarios.load("panda-cube")
    return load_arm(case.arm, case.tray)


def line(duration, rate=1000.0):
    t = np.arange(round(duration * rate) + 1) / rate
    return min_jerk_line(duration, START, GOAL, np.eye(3), np.eye(3)).sample(t)


def write_csv(path: Path, header: str, *columns) -> Path:
    np.savetxt(path, np.column_stack(columns), delimiter=",", header=header, comments="", fmt="%.12g")
    return path


def tray_csv(path: Path, duration=1.5, noise=0.0, rate=1000.0) -> Path:
    s = line(duration, rate)
    p = s.p_SB + noise * np.random.default_rng(0).standard_normal(s.p_SB.shape)
    return write_csv(path, "t,x,y,z,qw,qx,qy,qz", s.t, p, s.quat_SB_wxyz)


def joint_motion(duration=2.0, rate=1000.0):
    t = np.arange(round(duration * rate) + 1) / rate
    u = t / duration
    s = 10 * u**3 - 15 * u**4 + 6 * u**5
    return t, Q0 + np.outer(s, [0.5, 0.1, -0.1, 0.1, 0.1, 0.0, 0.2])


# Reading ------------------------------------------------------------------------------------------------------


def test_the_names_of_the_columns_decide_not_their_order(tmp_path):
    s = line(1.5)
    quat = quat_wxyz_from_matrix(exp(np.outer(s.t, [0.1, 0.2, 0.3])))
    one = write_csv(tmp_path / "a.csv", "t,x,y,z,qw,qx,qy,qz", s.t, s.p_SB, quat)
    xyzw = quat[:, [1, 2, 3, 0]]
    other = write_csv(
        tmp_path / "b.csv",
        "time_ns,quat_SE_x,quat_SE_y,quat_SE_z,quat_SE_w,p_SE_x,p_SE_y,p_SE_z,extra",
        s.t * 1e9,
        xyzw,
        s.p_SB,
        s.t,
    )
    ros = write_csv(
        tmp_path / "c.csv",
        "time,"
        + ",".join(f"pose.orientation.{a}" for a in "xyzw")
        + ","
        + ",".join(f"pose.position.{a}" for a in "xyz"),
        s.t,
        xyzw,
        s.p_SB,
    )
    first = read(one)
    for path in (other, ros):
        again = read(path)
        assert np.allclose(again.quat_wxyz, first.quat_wxyz, atol=1e-11)
        assert np.allclose(again.p, first.p, atol=1e-11)
        assert np.allclose(again.t, first.t, atol=1e-11)


def test_sign_flips_of_quaternions_are_no_turns(tmp_path):
    s = line(1.0)
    quat = s.quat_SB_wxyz * np.where(np.arange(len(s.t)) % 3 == 0, -1, 1)[:, None]
    samples = read(write_csv(tmp_path / "a.csv", "t,x,y,z,qw,qx,qy,qz", s.t, s.p_SB, quat))
    motion = tray_motion(samples, None, AT_B, NO_TURN)
    assert np.abs(motion.samples.omega_B).max() < 1e-9


def test_the_motion_of_the_object_is_told_of_the_tray(tmp_path):
    # The tray turns about z at constant rate below an object frame B on its axis, 0.3 m up and moving in x.
    t = np.linspace(0, 2, 2001)
    p = np.column_stack([0.1 * t**2, 0 * t, 0 * t + 0.5])
    quat = quat_wxyz_from_matrix(exp(np.outer(t, [0, 0.2, 0])))
    header = "t,p_SB_x,p_SB_y,p_SB_z,quat_SB_w,quat_SB_x,quat_SB_y,quat_SB_z"
    samples = read(write_csv(tmp_path / "a.csv", header, t, p, quat))
    motion = tray_motion(samples, None, np.array([0, 0, -0.3]), NO_TURN).samples
    middle = len(motion.t) // 2
    now = motion.t[middle]
    expected = p[0] + [0.1 * now**2, 0, 0] - 0.3 * np.array([np.sin(0.2 * now), 0, np.cos(0.2 * now)])
    assert np.allclose(motion.p_SB[middle], expected, atol=1e-6)
    centripetal = 0.3 * 0.04 * np.array([np.sin(0.2 * now), 0, np.cos(0.2 * now)])
    assert np.allclose(motion.a_S[middle], np.array([0.2, 0, 0]) + centripetal, atol=1e-4)


def test_joint_columns_by_name_in_any_order_or_by_number(tmp_path, arm):
    t, q = joint_motion()
    mixed = [3, 1, 0, 2, 6, 5, 4]
    named = write_csv(tmp_path / "a.csv", "t," + ",".join(JOINTS[i] for i in mixed) + ",gripper", t, q[:, mixed], t)
    exported = write_csv(
        tmp_path / "d.csv", "t," + ",".join(f"q_{name},dq_{name}" for name in JOINTS), t, np.repeat(q, 2, 1)
    )
    numbered = write_csv(tmp_path / "b.csv", "t," + ",".join(f"q{i}" for i in range(1, 8)), t, q)
    position = write_csv(tmp_path / "c.csv", "t," + ",".join(f"{name}_position" for name in JOINTS), t, q)
    expected = tray_motion(read(numbered, lambda: JOINTS), arm, AT_B, NO_TURN).samples
    for path in (named, position, exported):
        assert np.allclose(tray_motion(read(path, lambda: JOINTS), arm, AT_B, NO_TURN).samples.a_S, expected.a_S)


def trajectory_message(t, q, dq=None, ddq=None, stamp=("sec", "nanosec")):
    points = []
    for k, now in enumerate(t):
        point = {"positions": q[k].tolist(), "velocities": [], "accelerations": []}
        if dq is not None:
            point["velocities"] = dq[k].tolist()
        if ddq is not None:
            point["accelerations"] = ddq[k].tolist()
        whole = int(now + 1e-10)
        point["time_from_start"] = {stamp[0]: whole, stamp[1]: round((now - whole) * 1e9)}
        points.append(point)
    return {"header": {"frame_id": ""}, "joint_names": list(JOINTS), "points": points}


def test_ros_messages_as_json_and_yaml_give_the_motion_of_the_csv(tmp_path, arm):
    from ruamel.yaml import YAML

    t, q = joint_motion(rate=100)
    csv = write_csv(tmp_path / "a.csv", "t," + ",".join(JOINTS), t, q)
    message = trajectory_message(t, q)
    (tmp_path / "b.json").write_text(json.dumps({"trajectory": message}))
    with open(tmp_path / "c.yaml", "w") as file:
        YAML(typ="safe").dump(trajectory_message(t, q, stamp=("secs", "nsecs")), file)
        file.write("---\n")
    expected = tray_motion(read(csv, lambda: JOINTS), arm, AT_B, NO_TURN).samples
    for name in ("b.json", "c.yaml"):
        motion = tray_motion(read(tmp_path / name), arm, AT_B, NO_TURN).samples
        assert np.allclose(motion.a_S, expected.a_S, atol=1e-6)


def test_waypoints_with_velocities_are_joined_as_the_controller_does(tmp_path, arm):
    # A quintic through two waypoints with velocity and acceleration is the min-jerk polynomial itself.
    t, q = joint_motion(duration=2.0, rate=1000)
    u = t / 2
    direction = np.array([0.5, 0.1, -0.1, 0.1, 0.1, 0.0, 0.2])
    dq = np.outer((30 * u**2 - 60 * u**3 + 30 * u**4) / 2, direction)
    ddq = np.outer((60 * u - 180 * u**2 + 120 * u**3) / 4, direction)
    at = np.arange(0, 2001, 250)
    (tmp_path / "a.json").write_text(json.dumps(trajectory_message(t[at], q[at], dq[at], ddq[at])))
    motion = tray_motion(read(tmp_path / "a.json"), arm, AT_B, NO_TURN)
    expected = forward(arm, t, q, dq, ddq)
    k = 777
    nearest = np.argmin(np.abs(motion.samples.t - t[k]))
    found = np.array([np.interp(t[k], motion.samples.t, motion.samples.a_S[:, i]) for i in range(3)])
    assert abs(motion.samples.t[nearest] - t[k]) < 2e-3
    assert np.allclose(found, expected.a_S[k], atol=1e-4)
    assert any("9 waypoints with velocities, joined by quintics" in note for note in motion.notes)


@pytest.mark.parametrize("version", [1, 2])
def test_bags_of_both_ros_versions(tmp_path, arm, version):
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE if version == 2 else Stores.ROS1_NOETIC)
    types = store.types
    t, q = joint_motion(rate=100)
    s = line(1.0, 200)

    def time(now, kind="Time"):
        name = f"builtin_interfaces/msg/{kind}"
        return types[name](sec=int(now), nanosec=round((now - int(now)) * 1e9))

    def header(now, k):
        extra = {"seq": k} if version == 1 else {}
        return types["std_msgs/msg/Header"](stamp=time(100 + now), frame_id="world", **extra)

    empty = np.zeros(0)
    states = [
        (now, types["sensor_msgs/msg/JointState"](header(now, k), list(JOINTS), q[k], empty, empty))
        for k, now in enumerate(t)
    ]
    point, turn = types["geometry_msgs/msg/Point"], types["geometry_msgs/msg/Quaternion"]
    poses = [
        (
            now,
            types["geometry_msgs/msg/PoseStamped"](
                header(now, k), types["geometry_msgs/msg/Pose"](point(*s.p_SB[k]), turn(x=0.0, y=0.6, z=0.0, w=0.8))
            ),
        )
        for k, now in enumerate(s.t)
    ]
    path = tmp_path / ("run.bag" if version == 1 else "run")
    _write_bag(path, store, version, {"/joint_states": states, "/tray": poses})
    with pytest.raises(FileFormatError, match=r"holds 2 motions; name one with --topic.*/tray"):
        read(path)
    with pytest.raises(FileFormatError, match="no motion on the topic /nothing"):
        read(path, topic="/nothing")
    joints = read(path, topic="/joint_states")
    assert joints.names == JOINTS
    assert np.allclose(joints.q, q)
    assert np.allclose(joints.t, t, atol=1e-8)
    tray = read(path, topic="/tray")
    assert np.allclose(tray.quat_wxyz, [0.8, 0, 0.6, 0])
    assert np.allclose(tray.p, s.p_SB)


def _write_bag(path, store, version, topics):
    if version == 1:
        from rosbags.rosbag1 import Writer

        writer = Writer(path)
        serialize = store.serialize_ros1
    else:
        from rosbags.rosbag2 import Writer

        writer = Writer(path, version=9)
        serialize = store.serialize_cdr
    with writer:
        for topic, messages in topics.items():
            kind = messages[0][1].__msgtype__
            connection = writer.add_connection(topic, kind, typestore=store)
            for now, message in messages:
                writer.write(connection, int((100 + now) * 1e9), serialize(message, kind))


def test_a_trajectory_in_a_bag(tmp_path):
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    types = store.types
    t, q = joint_motion(rate=50)
    stamp = types["builtin_interfaces/msg/Time"](sec=0, nanosec=0)
    header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="")
    empty = np.zeros(0)
    points = [
        types["trajectory_msgs/msg/JointTrajectoryPoint"](
            q[k], empty, empty, empty, types["builtin_interfaces/msg/Duration"](int(now), round((now % 1) * 1e9))
        )
        for k, now in enumerate(t)
    ]
    message = types["trajectory_msgs/msg/JointTrajectory"](header, list(JOINTS), points)
    _write_bag(tmp_path / "run", store, 2, {"/planned": [(0.0, message)]})
    samples = read(tmp_path / "run")
    assert np.allclose(samples.q, q)
    assert np.allclose(samples.t, t)


def lines(*rows):
    return "\n".join(rows) + "\n"


GOOD = [f"{k / 100},0,0,0.4,1,0,0,0" for k in range(20)]
HEADER = "t,x,y,z,qw,qx,qy,qz"


@pytest.mark.parametrize(
    ("name", "text", "sentence"),
    [
        ("a.csv", "", "is empty; the first line must name the columns"),
        ("a.csv", lines(*GOOD), "has no header"),
        ("a.csv", lines(HEADER), "has no samples below its header; an audit needs at least 8"),
        ("a.csv", lines("t,x,y,z,qw,qx,qy", *(g[:-2] for g in GOOD)), "no column for qz"),
        ("a.csv", lines("time_in_s,x,y,z,qw,qx,qy,qz", *GOOD), "has no columns of time"),
        ("a.csv", lines(HEADER, *GOOD[:5], "0.05,0,zero,0.4,1,0,0,0"), 'line 7: "zero" is not a number'),
        ("a.csv", lines(HEADER, *GOOD[:5], "0.05,0,0,0.4,1,0,0"), "line 7: 7 values, but the header names 8"),
        (
            "a.csv",
            lines(HEADER, *GOOD[:5], "0.05,0,nan,0.4,1,0,0,0", *GOOD[6:]),
            "the position of sample 6 is not a finite",
        ),
        ("a.csv", lines(HEADER, *GOOD[:6], *GOOD[4:]), "time runs backwards from 0.050000 s to 0.040000 s at sample 7"),
        ("a.csv", lines(HEADER, *GOOD[:5]), "has 5 samples at different times; an audit needs at least 8"),
        ("a.csv", lines(HEADER, *(g.replace("1,0,0,0", "0,0,0,0") for g in GOOD)), "quaternion of sample 1 has norm 0"),
        ("a.csv", lines(HEADER, *(g.replace("0.4,1", "400,1") for g in GOOD)), "positions are in metres"),
        ("a.json", "{", "is not JSON"),
        ("a.json", "[]", "holds no JointTrajectory"),
        ("a.yaml", "a: [1", "is not YAML"),
        ("a.json", '{"joint_names": ["a"], "points": []}', "1 joint names and 0 points"),
        (
            "a.json",
            '{"joint_names": ["a"], "points": [{"positions": [1, 2], "time_from_start": 0}]}',
            "2 positions; there are 1",
        ),
        ("a.json", '{"joint_names": ["a"], "points": [{"positions": [1]}]}', "no time_from_start"),
        ("a.xlsx", "x", 'ends in ".xlsx"; accepted are .csv'),
        ("a.bag", "not a bag", "cannot be read as a ROS bag"),
    ],
)
def test_each_mistake_in_a_file_is_one_sentence(tmp_path, name, text, sentence):
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(FileFormatError) as caught:
        read(path)
    assert sentence in str(caught.value)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_files_joints_and_arms_are_told(tmp_path, arm):
    with pytest.raises(FileFormatError, match="does not exist"):
        read(tmp_path / "no.csv")
    t, q = joint_motion()
    path = write_csv(tmp_path / "a.csv", "t," + ",".join([*JOINTS[:6], "elbow"]), t, q)
    samples = read(path, lambda: JOINTS)
    with pytest.raises(FileFormatError, match="has no joint panda_joint7; it has panda_joint1"):
        tray_motion(samples, arm, AT_B, NO_TURN)
    with pytest.raises(SalverError, match="the scenario has no arm"):
        tray_motion(samples, None, AT_B, NO_TURN)


def test_repeated_times_are_left_out_and_told(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(lines(HEADER, *GOOD[:10], GOOD[9], GOOD[9], *GOOD[10:]))
    samples = read(path)
    assert len(samples.t) == 20
    assert "2 samples repeat the time" in samples.notes[0]


def test_times_in_a_wrong_unit_are_told(tmp_path):
    s = line(1.5)
    quick = write_csv(tmp_path / "a.csv", HEADER.replace("t,", "t_ns,"), s.t, s.p_SB, s.quat_SB_wxyz)
    with pytest.raises(FileFormatError, match=r"samples come every 1e-12 s.*the unit of its times is another"):
        read(quick)
    milliseconds = write_csv(tmp_path / "b.csv", HEADER.replace("t,", "t_ms,"), 1000 * s.t, s.p_SB, s.quat_SB_wxyz)
    assert np.allclose(read(milliseconds).t, s.t)
    slow = write_csv(tmp_path / "c.csv", HEADER, 1000 * s.t, s.p_SB, s.quat_SB_wxyz)
    found = audit(slow, scenarios.load("panda-cube"))
    assert found.outcome == "cannot_tell"
    assert "samples come every 1 s, as if the times were in ms" in found.nominal.sentence


# Curves -------------------------------------------------------------------------------------------------------


def test_a_quintic_is_met_exactly_however_it_is_sampled():
    t = np.sort(np.random.default_rng(1).random(300)) * 2
    y = np.stack([t**5 - 3 * t**2, 2 * t**3 - t], axis=1)
    curve = fit(t, y, np.full(300, 5.0))
    value, rate, bend = curve(t)
    assert np.abs(value - y).max() < 1e-9
    assert np.abs(rate - np.stack([5 * t**4 - 6 * t, 6 * t**2 - 1], axis=1)).max() < 1e-6
    assert np.abs(bend - np.stack([20 * t**3 - 6, 12 * t], axis=1)).max() < 1e-4


def test_a_curve_at_rest_has_no_velocity_and_no_acceleration_at_its_end():
    t = np.linspace(0, 2, 401)
    curve = fit(t, np.cos(3 * t)[:, None], np.full(401, 8.0), (True, False))
    value, rate, bend = curve(np.array([0.0, 2.0]))
    assert np.abs([rate[0], bend[0]]).max() < 1e-9
    assert np.allclose([value[1, 0], bend[1, 0]], [np.cos(6), -9 * np.cos(6)], atol=2e-2)


def test_the_stated_error_of_the_acceleration_is_that_of_many_trials():
    t = np.linspace(0, 2, 1001)
    at = np.concatenate([[0.0, 0.01, 0.02, 0.04], np.linspace(0.9, 1.1, 41)])
    bends = []
    for k in range(300):
        curve = fit(t, np.random.default_rng(k).standard_normal((1001, 1)), np.full(1001, 8.0))
        bends.append(curve(at)[2][:, 0])
    stated, seen = curve.acceleration_error(at, t[1]), np.std(bends, axis=0)
    # A standard deviation from 300 trials is right to 4 %. At the knots it is larger than between them.
    assert seen[:4] == pytest.approx(stated[:4], rel=0.15)
    assert seen[4:].max() == pytest.approx(stated[4:].max(), rel=0.15)


# Noise --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("noise", [1e-6, 1e-4, 1e-3])
@pytest.mark.parametrize("rate", [100, 1000])
def test_noise_is_measured_under_a_motion(noise, rate):
    s = line(2.0, rate)
    p = s.p_SB + noise * np.random.default_rng(2).standard_normal(s.p_SB.shape)
    assert sensor_of(s.t, p, s.quat_SB_wxyz).position.sizes.max() == pytest.approx(noise, rel=0.15)


def test_a_violent_motion_is_not_taken_for_noise():
    # 71 m/s^2 at 6 Hz, at 25 Hz and as a chirp from 1 to 40 Hz: noise-free, so next to nothing is noise.
    t = np.arange(2001) / 1000
    for y in (
        0.05 * np.sin(12 * np.pi * t),
        0.003 * np.sin(50 * np.pi * t),
        1e-3 * np.sin(2 * np.pi * (t + 39 / 4 * t**2)),
    ):
        p = np.stack([y, 0 * t, 0 * t], axis=1)
        quat = np.tile([1.0, 0, 0, 0], (len(t), 1))
        assert sensor_of(t, p, quat).position.sizes.max() < 1e-6 * np.abs(y).max()


def test_white_noise_is_hardly_ever_taken_for_motion():
    alarms = 0
    for seed in range(40):
        y = np.random.default_rng(seed).standard_normal((1000, 3))
        alarms += any(len(cells.first) for cells in found(y, 500.0, Level.even(1.0), 1e-9))
    assert alarms <= 12  # the probability is 0.1 each; more than 12 of 40 would come by chance once in 10^4


@pytest.mark.parametrize(("frequency", "cycles"), [(50, 1), (50, 16), (20, 8), (5, 4)])
def test_a_shake_is_found_in_noise_by_its_energy(frequency, cycles):
    # Nine standard deviations over its own window, wherever it begins.
    rate, missed = 1000, 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        y = rng.standard_normal((2000, 3))
        count = cycles * rate // frequency
        first = rng.integers(0, 2001 - count)
        size = 9 * np.sqrt(2 / count)
        y[first : first + count, 0] += size * np.sin(2 * np.pi * frequency * np.arange(count) / rate)
        hits = [k for cells in found(y, rate, Level.even(1.0), 1e-9) for k in range(len(cells.first))
                if cells.first[k] < first + count and cells.last[k] > first]  # fmt: skip
        missed += not hits
    assert missed <= 2


def test_noise_of_a_band_is_found_at_the_quietest():
    rng = np.random.default_rng(0)
    t = np.arange(4096)
    y = rng.standard_normal((4096, 3)) + 5 * np.sin(2 * np.pi * 0.31 * t)[:, None]  # one frequency far above it
    assert level(y, 0.25) == pytest.approx(np.ones(3), rel=0.15)


def test_resolution_is_the_step_of_rounded_values_and_of_nothing_else():
    t = np.linspace(0, 1, 500)
    y = np.sin(3 * t)[:, None]
    assert resolution(np.round(y, 3)) == pytest.approx(1e-3, rel=1e-6)
    assert resolution(y) == 0
    assert resolution(0.002 * np.arange(500.0)[:, None]) == 0  # constant speed
    assert resolution(np.full((500, 3), 0.4)) == 0


def test_a_spike_is_one_sample_that_is_off_its_neighbours():
    t = np.arange(400) / 100
    y = np.stack([np.sin(t), np.cos(t), t**2], axis=1)
    assert len(spikes(t, y, 0.0)) == 0
    y[123, 1] += 0.01
    assert list(spikes(t, y, 0.0)) == [123]


# From poses to accelerations ----------------------------------------------------------------------------------


def one(t, y, noise=0.0, highest=50.0):
    p = np.stack([0 * t, y, 0 * t], axis=1) + noise * np.random.default_rng(7).standard_normal((len(t), 3))
    quat = np.tile([1.0, 0, 0, 0], (len(t), 1))
    (part,) = stretches(t, p, quat, sensor_of(t, p, quat), highest)
    return part


@pytest.mark.parametrize(("frequency", "rate"), [(1, 100), (6, 1000), (15, 100), (20, 200), (45, 400), (80, 1000)])
def test_the_acceleration_of_a_shake_is_met_at_any_frequency(frequency, rate):
    t = np.arange(2 * rate + 1) / rate
    omega = 2 * np.pi * frequency
    part = one(t, 2.0 / omega**2 * np.sin(omega * t + 0.3))
    error = np.abs(part.motion.a_S[:, 1] + 2.0 * np.sin(omega * part.motion.t + 0.3))
    edge = max(3 / rate, 0.02)  # what is one-sided is less certain
    inner = (part.motion.t > edge) & (part.motion.t < 2 - edge)
    assert np.all(error[inner] < 0.06 + part.acceleration_error[inner] + part.missed[inner])
    assert part.missed.max() < 0.55


@pytest.mark.parametrize("noise", [1e-6, 1e-5, 1e-4, 1e-3])
def test_noise_does_not_become_acceleration(noise):
    s = line(2.0)
    part = one(s.t, s.p_SB[:, 1], noise)
    truth = min_jerk_line(2.0, START, GOAL, np.eye(3), np.eye(3)).sample(part.motion.t)
    error = np.abs(part.motion.a_S - truth.a_S).max(axis=1)
    # Twice differenced, noise n at 1 kHz would be sqrt(6) n * 10^6; what is stated is 4.5 standard deviations.
    assert np.all(error < part.acceleration_error + 0.02)
    assert np.median(part.acceleration_error) < 0.2


def test_a_short_jolt_is_followed_where_it_is_and_nowhere_else():
    t = np.arange(6001) / 1000
    a = np.where((t > 3) & (t < 3.05), 10.0, 0) - np.where((t > 3.05) & (t < 3.1), 10.0, 0)
    part = one(t, np.cumsum(np.cumsum(a)) * 1e-6, 1e-4)
    near = np.abs(part.motion.t - 3.05) < 0.5
    assert np.abs(part.motion.a_S[:, 1]).max() == pytest.approx(10, rel=0.45)  # its edges are sharper than any curve
    assert part.bandwidth[near].max() > 20
    assert part.bandwidth[~near].max() < 15


def test_what_the_samples_are_too_few_for_is_left_over_and_told():
    t = np.arange(401) / 200
    part = one(t, 1e-4 * np.sin(2 * np.pi * 93 * t))
    assert max(cells.amplitude.max() for cells in part.unseen if len(cells.first)) == pytest.approx(1e-4, rel=0.4)
    assert any(np.any(np.abs(cells.frequency - 93) < 4) for cells in part.unseen)


def test_what_may_be_mirrored_at_the_sampling_rate_is_told():
    # At 60 samples a second 45 Hz looks like 15 Hz; what is below 60 - 50 Hz is what it seems.
    t = np.arange(181) / 60
    seen = one(t, 1e-3 * np.sin(2 * np.pi * 45 * t))
    assert any(np.any(np.abs(cells.frequency - 15) < 3) for cells in seen.mirrored)
    slow = one(t, 1e-2 * np.sin(2 * np.pi * 2 * t))
    assert not any(np.any(cells.amplitude > 3e-5) for cells in slow.mirrored)


def test_uneven_times_are_no_noise(tmp_path):
    rng = np.random.default_rng(3)
    t = np.arange(1501) / 1000 + 2e-4 * rng.uniform(-1, 1, 1501)
    truth = min_jerk_line(1.5, START, GOAL, np.eye(3), np.eye(3)).sample(t)
    sensor = sensor_of(t, truth.p_SB, truth.quat_SB_wxyz)
    assert sensor.position.sizes.max() < 1e-9


def test_turning_about_a_fixed_axis(tmp_path):
    t = np.arange(0, 2.0005, 1e-3)
    u = t / 2
    angle = 1.2 * (10 * u**3 - 15 * u**4 + 6 * u**5)
    axis = np.array([1.0, 2.0, 2.0]) / 3
    quat = quat_wxyz_from_matrix(exp(np.outer(angle, axis)))
    samples = read(write_csv(tmp_path / "a.csv", HEADER, t, np.tile(START, (len(t), 1)), quat))
    motion = tray_motion(samples, None, AT_B, NO_TURN).samples
    v = motion.t / 2
    assert np.allclose(motion.omega_B, np.outer(0.6 * (30 * v**2 - 60 * v**3 + 30 * v**4), axis), atol=1e-5)
    assert np.allclose(motion.alpha_B, np.outer(0.3 * (60 * v - 180 * v**2 + 120 * v**3), axis), atol=1e-3)


def test_the_tray_of_a_moving_arm_against_differences_of_its_pose(arm):
    t, q = joint_motion()
    h, k = 1e-4, 700
    u = t / 2
    direction = np.array([0.5, 0.1, -0.1, 0.1, 0.1, 0.0, 0.2])
    dq = np.outer((30 * u**2 - 60 * u**3 + 30 * u**4) / 2, direction)
    ddq = np.outer((60 * u - 180 * u**2 + 120 * u**3) / 4, direction)
    motion = forward(arm, t[k : k + 1], q[k : k + 1], dq[k : k + 1], ddq[k : k + 1])

    def pose(step):
        return arm.tray_pose(q[k] + step * dq[k] + 0.5 * step**2 * ddq[k])

    before, now, after = (pose(step) for step in (-h, 0.0, h))
    assert np.allclose(motion.p_SB[0], now[0])
    assert np.allclose(motion.R_SB[0], now[1])
    assert np.allclose(motion.v_S[0], (after[0] - before[0]) / (2 * h), atol=1e-7)
    assert np.allclose(motion.a_S[0], (after[0] - 2 * now[0] + before[0]) / h**2, atol=1e-5)
    rate = (after[1] - before[1]) / (2 * h)
    spin = now[1].T @ rate
    assert np.allclose(motion.omega_B[0], [spin[2, 1], spin[0, 2], spin[1, 0]], atol=1e-7)
    bend = now[1].T @ (after[1] - 2 * now[1] + before[1]) / h**2 - spin @ spin
    assert np.allclose(motion.alpha_B[0], [bend[2, 1], bend[0, 2], bend[1, 0]], atol=1e-5)


# Verdicts -----------------------------------------------------------------------------------------------------


def case(friction=0.3, height=0.04, friction_range=None):
    data = scenarios.load("panda-cube").model_dump(mode="json", exclude_none=True)
    data["objects"][0] |= {
        "friction": friction,
        "uncertainty": {"friction": friction_range} if friction_range else {},
    }
    data["objects"][0]["shape"] = {"type": "box", "size": [0.04, 0.04, height]}
    data["objects"][0].pop("inertia")
    return scenarios.parse(data, "test")


def of_line(duration):
    return TrayMotion(line(duration))


def test_the_friction_that_a_level_move_needs_is_its_peak_acceleration_over_gravity():
    duration = 1.2
    result = audit_motion(of_line(duration), case(friction=0.3))
    needed = PEAK / duration**2 / 9.81
    assert result.nominal.code == "holds"
    assert result.margins.interfaces[0].friction_needed.max() == pytest.approx(needed, rel=1e-4)
    assert result.margins.interfaces[0].friction_needed_worst == pytest.approx(needed, rel=1e-3)


def test_it_slides_when_the_acceleration_passes_friction_times_gravity():
    duration = 0.9
    result = audit_motion(of_line(duration), case(friction=0.3))
    s = line(duration)
    first = s.t[np.argmax(np.abs(s.a_S[:, 1]) > 0.3 * 9.81)]
    assert result.nominal.code == "slides"
    assert result.nominal.details["time"] == pytest.approx(first, abs=1e-3)
    assert result.pace.factor == pytest.approx(np.sqrt(PEAK / duration**2 / (0.3 * 9.81)), rel=1e-4)
    assert not result.ok


def test_a_tall_box_tips_where_its_base_ends():
    # Base half-width 2 cm, centre of mass 10 cm up: it tips at a = g / 5, well below friction 0.8.
    duration = 1.0
    result = audit_motion(of_line(duration), case(friction=0.8, height=0.2))
    s = line(duration)
    first = s.t[np.argmax(np.abs(s.a_S[:, 1]) > 9.81 / 5)]
    assert result.nominal.code == "tips"
    assert result.nominal.details["time"] == pytest.approx(first, abs=1e-3)
    assert result.pace.factor == pytest.approx(np.sqrt(PEAK * 5 / 9.81), rel=1e-4)
    assert result.margins.interfaces[0].tip_over.min() == pytest.approx(0.02 - 0.1 * PEAK / 9.81, rel=1e-3)


def test_run_at_its_pace_the_path_just_holds():
    uncertain = case(0.3, friction_range="10%")
    slow = audit_motion(of_line(0.9), uncertain).pace_worst.factor
    assert audit_motion(of_line(0.9 * slow * 1.001), uncertain).worst.code == "holds"
    assert audit_motion(of_line(0.9 * slow * 0.999), uncertain).worst.code == "slides"


def test_what_holds_nominally_may_not_hold_in_the_worst_case():
    duration = np.sqrt(PEAK / (0.28 * 9.81))  # needs friction 0.28
    result = audit_motion(of_line(duration), case(0.3, friction_range="10%"))
    assert result.nominal.ok
    assert not result.worst.ok
    assert not result.ok
    assert result.pace_worst.factor == pytest.approx(np.sqrt(0.28 / 0.27), rel=1e-3)
    assert next(iter(result.costs)) == "friction"


def test_a_tray_tilted_beyond_the_friction_angle_has_no_pace():
    s = line(2.0)
    tilt = np.deg2rad(20) * np.sin(np.pi * s.t / 2) ** 2
    R = exp(np.column_stack([tilt, 0 * tilt, 0 * tilt]))
    zero = np.zeros_like(s.a_S)
    motion = TrayMotion(MotionSamples(s.t, s.p_SB, s.v_S, s.a_S, R, zero, zero))
    result = audit_motion(motion, case(friction=0.3))  # 16.7 degrees
    assert result.pace.factor is None
    assert "tilted too far at 1.000 s" in result.pace.status.sentence


# The command --------------------------------------------------------------------------------------------------


def run(*arguments):
    return CliRunner().invoke(app, ["audit", *map(str, arguments)])


def test_the_exit_code_tells(tmp_path):
    held = run(tray_csv(tmp_path / "slow.csv", 2.5), "--scenario", "panda-cube")
    assert held.exit_code == 0
    assert "Everything holds" in held.stdout
    slid = run(tray_csv(tmp_path / "fast.csv", 0.6), "--scenario", "panda-cube")
    assert slid.exit_code == 3
    assert "slides at" in slid.stdout
    assert "times as long" in slid.stdout
    wrong = run(tmp_path / "none.csv", "--scenario", "panda-cube")
    assert wrong.exit_code == 2
    assert "does not exist" in wrong.stderr


def test_json_has_every_figure(tmp_path):
    result = run(tray_csv(tmp_path / "a.csv", 0.9, noise=1e-5), "--scenario", "panda-cube", "--json")
    found = json.loads(result.stdout)
    # 5.77 * 0.5 / 0.81 m/s^2; the cube has friction 0.5, and noise adds a little to the peak.
    assert found["interfaces"][0]["friction_needed"] == pytest.approx(PEAK / 0.81 / 9.81, rel=0.03)
    assert found["motion"]["recording"]["position_noise"] == pytest.approx(1e-5, rel=0.1)
    assert found["holds"] is True
    assert found["pace"]["nominal"]["factor"] == pytest.approx(np.sqrt(PEAK / 0.81 / 9.81 / 0.5), rel=0.03)


def test_a_joint_file_of_the_scenarios_arm(tmp_path):
    t, q = joint_motion(duration=4.0)
    path = write_csv(tmp_path / "a.csv", "t," + ",".join(JOINTS), t, q)
    result = audit(path, scenarios.load("panda-cube"))
    assert result.nominal.ok
    assert result.summary()["motion"]["peak_tilt"] > 0.05
