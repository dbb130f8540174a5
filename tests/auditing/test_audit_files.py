"""Files of every format that an audit reads give the same motion; each mistake in one is a sentence."""

import json

import numpy as np
import pytest

from recorded_motions import HEADER, JOINTS, joint_motion, line, series_of, write_csv
from salver import scenario as scenarios
from salver.auditing import audit
from salver.auditing.motion import tray_motion
from salver.errors import FileFormatError, SalverError, ScenarioError
from salver.geometry import exp, quat_wxyz_from_matrix
from salver.models.arm.arm import load_arm
from salver.motion_files import write
from salver.motion_files.readers import read, read_path
from salver.motion_files.samples import tray_samples
from salver.motion_files.units import Units
from salver.planning.follow import forward
from salver.trajectory import JointMotion


@pytest.fixture(scope="module")
def arm():
    case = scenarios.load("panda-cube")
    return load_arm(case.arm, case.tray)


# Reading ------------------------------------------------------------------------------------------------------


def test_a_task_of_several_legs_is_not_judged_as_one_motion():
    s = line(1.5)
    columns = dict(
        zip(HEADER.split(","), np.column_stack([s.t, s.p_SB, np.tile([1.0, 0, 0, 0], (len(s.t), 1))]).T, strict=True)
    )
    with pytest.raises(ScenarioError, match=r"is a task of \d legs, and this audit takes one motion"):
        audit(columns, scenarios.load("waiters-round"))


def test_joint_positions_in_degrees_are_refused_and_a_joint_beyond_its_range_is_not(arm):
    case, t = scenarios.load("panda-cube"), np.arange(0, 1, 0.01)
    q = np.array(case.arm.start_posture) + np.outer(np.sin(t), 0.1 * np.ones(7))
    columns = dict(zip(arm.joint_names, np.rad2deg(q).T, strict=True))
    with pytest.raises(FileFormatError, match=r"panda_joint\d at -?\d+.*, which goes from .* rad; these are degrees"):
        audit({"t": t, **columns}, case)
    q[:, 6] = 14.0  # a wrist that somebody has wound up twice; as degrees the others would be no posture of this arm
    q[:, 3] = -np.pi
    audit({"t": t, **dict(zip(arm.joint_names, q.T, strict=True))}, case)


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


@pytest.mark.parametrize("separator", [";", "; ", "\t", " ", "  ", ", "])
def test_columns_are_separated_by_commas_semicolons_tabs_or_blanks(tmp_path, separator):
    s = line(1.5, 100.0)
    quat = quat_wxyz_from_matrix(exp(np.outer(s.t, [0.1, 0.2, 0.3])))
    first = write_csv(tmp_path / "a.csv", HEADER, s.t, s.p_SB, quat)
    other = tmp_path / "b.csv"
    other.write_text(first.read_text().replace(",", separator))
    one, again = read(first), read(other)
    for name in ("t", "p", "quat_wxyz"):
        assert np.array_equal(getattr(one, name), getattr(again, name))


def test_sign_flips_of_quaternions_are_no_turns(tmp_path):
    s = line(1.0)
    quat = s.quat_SB_wxyz * np.where(np.arange(len(s.t)) % 3 == 0, -1, 1)[:, None]
    samples = read(write_csv(tmp_path / "a.csv", "t,x,y,z,qw,qx,qy,qz", s.t, s.p_SB, quat))
    motion = tray_motion(samples, None)
    assert np.abs(motion.samples.omega_B).max() < 1e-9


def test_joint_columns_by_name_in_any_order_or_by_number(tmp_path):
    t, q = joint_motion()
    mixed = [3, 1, 0, 2, 6, 5, 4]
    named = write_csv(tmp_path / "a.csv", "t," + ",".join(JOINTS[i] for i in mixed) + ",gripper", t, q[:, mixed], t)
    exported = write_csv(
        tmp_path / "d.csv", "t," + ",".join(f"q_{name},dq_{name}" for name in JOINTS), t, np.repeat(q, 2, 1)
    )
    numbered = write_csv(tmp_path / "b.csv", "t," + ",".join(f"q{i}" for i in range(1, 8)), t, q)
    position = write_csv(tmp_path / "c.csv", "t," + ",".join(f"{name}_position" for name in JOINTS), t, q)
    for path in (numbered, named, position, exported):
        assert np.allclose(read(path, lambda: JOINTS).q, q, rtol=0, atol=1e-9)


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


@pytest.mark.slow
def test_ros_messages_as_json_and_yaml_give_the_motion_of_the_csv(tmp_path, arm):
    from ruamel.yaml import YAML

    t, q = joint_motion(rate=100)
    csv = write_csv(tmp_path / "a.csv", "t," + ",".join(JOINTS), t, q)
    message = trajectory_message(t, q)
    (tmp_path / "b.json").write_text(json.dumps({"trajectory": message}))
    with open(tmp_path / "c.yaml", "w") as file:
        YAML(typ="safe").dump(trajectory_message(t, q, stamp=("secs", "nsecs")), file)
        file.write("---\n")
    expected = tray_motion(read(csv, lambda: JOINTS), arm).samples
    for name in ("b.json", "c.yaml"):
        motion = tray_motion(read(tmp_path / name), arm).samples
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
    motion = tray_motion(read(tmp_path / "a.json"), arm)
    expected = forward.tray_motion(arm, JointMotion(t, q, dq, ddq))
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


@pytest.mark.parametrize(
    ("name", "text", "sentence"),
    [
        ("a.csv", "", "is empty; the first line must name the columns"),
        ("a.csv", lines(*GOOD), "has no header"),
        ("a.csv", lines(HEADER), "has no samples below its header; an audit needs at least 8"),
        ("a.csv", lines("t,x,y,z,qw,qx,qy", *(g[:-2] for g in GOOD)), "no column for qz"),
        ("a.csv", lines("time_in_s,x,y,z,qw,qx,qy,qz", *GOOD), "has no columns of time"),
        ("a.csv", lines(HEADER, *GOOD[:5], "0.05,0,zero,0.4,1,0,0,0"), 'line 7: "zero" is not a number'),
        (
            "a.csv",
            lines(f"{HEADER},X", *(f"{row},9" for row in GOOD)),
            'two columns "X", 2. and 9., that differ',
        ),
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
        tray_motion(samples, arm)
    with pytest.raises(SalverError, match="the scenario has no arm"):
        tray_motion(samples, None)


def test_repeated_times_are_left_out_and_told(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(lines(HEADER, *GOOD[:10], GOOD[9], GOOD[9], *GOOD[10:]))
    samples = read(path)
    assert len(samples.t) == 20
    assert "2 samples repeat the time" in samples.notes[0]


def test_a_sampling_too_fast_to_be_one_is_told_whenever_it_begins(tmp_path):
    for begin in (0.0, 100.0):
        t = begin + 1e-7 * np.arange(60)
        p = np.zeros((60, 3))
        path = write_csv(tmp_path / "a.csv", HEADER, t, p, np.tile([1.0, 0, 0, 0], (60, 1)))
        with pytest.raises(FileFormatError, match=r"samples come every 1e-07 s.*the unit of its times is another"):
            read(path)


@pytest.mark.slow
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


def test_different_samples_at_one_time_are_spread_till_the_next():
    """A clock of 30 ms over samples of 100 Hz."""
    t = np.arange(30) / 100
    p = np.stack([t**2, 0 * t, 0 * t], axis=1)
    samples = tray_samples(np.floor(t / 0.03 + 1e-9) * 0.03, p, np.tile([1.0, 0, 0, 0], (30, 1)), "by hand")
    assert np.allclose(samples.t, t, atol=1e-12)
    assert np.array_equal(samples.p, p)
    assert "20 samples have the time of the one before and were spread" in samples.notes[0]


# Tables of industrial controllers -----------------------------------------------------------------------------


def decimal_commas(path, header, *columns):
    """A table as a spreadsheet in German writes it."""
    rows = [";".join(f"{x:.9f}".replace(".", ",") for x in row) for row in np.column_stack(columns)]
    path.write_text("\n".join([header, *rows, ""]))
    return path


@pytest.mark.parametrize("names", ["J1 J2 J3 J4 J5 J6 J7", "j1 j2 j3 j4 j5 j6 j7", "A1 A2 A3 A4 A5 A6 A7"])
def test_a_controllers_table_in_its_units_is_the_motion_in_rad_and_s(tmp_path, names):
    t, q = joint_motion(rate=100)
    si = read(write_csv(tmp_path / "si.csv", "t," + ",".join(JOINTS), t, q), lambda: JOINTS)
    own = decimal_commas(tmp_path / "own.csv", "Time;" + ";".join(names.split()), 1e3 * t, np.rad2deg(q))
    again = read(own, lambda: JOINTS, units=Units.parse("deg,ms"))
    assert again.names == tuple(names.split())
    assert np.allclose(again.t, si.t, rtol=0, atol=1e-11)
    assert np.allclose(again.q, si.q, rtol=0, atol=1e-10)
    assert "deg, ms" in again.notes[0]
    written = read(write(series_of(again), tmp_path / "written.csv")[0], lambda: JOINTS)
    assert written.names == again.names
    assert np.array_equal(written.q, again.q)
    assert not si.notes


def test_numbered_positions_go_before_columns_that_may_be_accelerations(tmp_path):
    t, q = joint_motion(rate=100)
    names = [f"A{k}" for k in range(1, 8)] + [f"q{k}" for k in range(1, 8)]
    path = write_csv(tmp_path / "a.csv", "t," + ",".join(names), t, 9.0 + q, q)
    assert np.allclose(read(path, lambda: JOINTS).q, q, atol=1e-9)


def test_only_the_named_units_are_converted_and_a_time_whose_name_has_a_unit_is_not(tmp_path):
    s = line(1.5, 100.0)
    path = write_csv(tmp_path / "a.csv", HEADER, s.t, 1e3 * s.p_SB, s.quat_SB_wxyz)
    found = read(path, units=Units.parse("mm"))
    assert np.allclose(found.p, s.p_SB, atol=1e-9)
    assert np.allclose(found.t, s.t, atol=1e-11)
    assert found.notes[0] == "Units of the table: mm; every answer and every written file is in rad, m, s."
    header = HEADER.replace("t,", "t_us,", 1)
    named = read(write_csv(tmp_path / "b.csv", header, 1e6 * s.t, s.p_SB, s.quat_SB_wxyz), units=Units.parse("ms"))
    assert np.allclose(named.t, s.t, atol=1e-11)
    assert np.allclose(named.p, s.p_SB, atol=1e-9)


def test_a_prismatic_joint_has_the_unit_of_lengths(tmp_path):
    t, names = np.arange(20) * 0.01, ("lift", "turn")
    q = np.column_stack([0.2 + 0.1 * t, 0.5 - 0.3 * t])
    path = write_csv(tmp_path / "a.csv", "t,J1,J2", t, 1e3 * q[:, 0], np.rad2deg(q[:, 1]))
    found = read(path, lambda: names, units=Units.parse("deg,mm", (True, False)))
    assert np.allclose(found.q, q, atol=1e-9)
    postures = write_csv(tmp_path / "b.csv", "", 1e3 * q[:, 0], np.rad2deg(q[:, 1]))
    assert np.allclose(read_path(postures, names, units=Units.parse("deg,mm", (True, False))), q, atol=1e-9)


def test_postures_with_decimal_commas_need_no_heading(tmp_path):
    path = tmp_path / "taught.csv"
    path.write_text("10,5;-20\n30;40,25\n")
    assert read_path(path, ("a", "b")).tolist() == [[10.5, -20.0], [30.0, 40.25]]


@pytest.mark.parametrize(
    ("rows", "sentence"),
    [
        ("0;1.234,5;0\n", r'line 2: "1.234,5" is not a number; decimal commas are read where no number has a point'),
        ("0.5;1,234;0\n", r'line 2: "1,234" is not a number; decimal commas'),  # thousands, or a little over one
        ("0,5;1,2;x\n", r'line 2: "x" is not a number'),
    ],
)
def test_a_comma_that_may_stand_between_thousands_is_refused(tmp_path, rows, sentence):
    path = tmp_path / "a.csv"
    path.write_text("t;J1;J2\n" + rows)
    with pytest.raises(FileFormatError, match=sentence):
        read(path)


@pytest.mark.parametrize("text", ["deg,rad", "inch", "", "deg,,mm", "deg,deg"])
def test_units_that_are_none_or_are_named_twice_are_refused(text):
    with pytest.raises(SalverError, match=r"must name at most one of each.*rad or deg; m or cm or mm; s or ms"):
        Units.parse(text)


def test_a_message_has_units_of_its_own(tmp_path):
    t, q = joint_motion(rate=100)
    (tmp_path / "b.json").write_text(json.dumps({"trajectory": trajectory_message(t, q)}))
    with pytest.raises(FileFormatError, match=r"b\.json is not a table .* leave --units out"):
        read(tmp_path / "b.json", units=Units.parse("deg"))


def test_an_audit_in_degrees_is_the_audit_in_radians_and_the_refusal_says_how(tmp_path):
    case, (t, q) = scenarios.load("panda-cube"), joint_motion(rate=100)
    path = decimal_commas(tmp_path / "own.csv", "t;" + ";".join(f"J{k}" for k in range(1, 8)), 1e3 * t, np.rad2deg(q))
    with pytest.raises(FileFormatError, match="these are degrees: give --units deg"):
        audit(path, case, units="ms")
    found = audit(path, case, units="deg,ms")
    expected = audit({"t": t, **dict(zip(JOINTS, q.T, strict=True))}, case)
    assert np.allclose(found.motion.samples.a_S, expected.motion.samples.a_S, atol=1e-5)
    assert found.worst.sentence == expected.worst.sentence


def test_a_message_in_degrees_is_not_told_to_take_an_option_for_tables(tmp_path):
    t, q = joint_motion(rate=100)
    (tmp_path / "b.json").write_text(json.dumps({"trajectory": trajectory_message(t, np.rad2deg(q))}))
    with pytest.raises(FileFormatError, match="these are degrees: joint positions must be in rad"):
        audit(tmp_path / "b.json", scenarios.load("panda-cube"))
