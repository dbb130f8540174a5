"""Audits of joint motions: the arm's limits, and what it would touch."""

import json
import re

import numpy as np
import pytest

import salver as sv
from salver.auditing.arm import NOT_CHECKED, arm_status
from salver.auditing.verdict import audit_samples
from salver.errors import ScenarioError
from salver.geometry import quat_wxyz_from_matrix
from salver.models.arm.arm import load_arm
from salver.motion_files.samples import JointSamples

T = np.linspace(0.0, 3.0, 301)
BLEND = np.polyval([6, -15, 10, 0, 0, 0], T / T[-1])
RATE = np.polyval([30, -60, 30, 0, 0], T / T[-1]) / T[-1]
BEND = np.polyval([120, -180, 60, 0], T / T[-1]) / T[-1] ** 2
START = np.array([-0.51, -1.2, 2.02, -2.39, 1.571, -1.06])
LEVEL_DOWN = np.array([0.0, 0.9, 0.0, -0.9, 0.0, 0.0])


@pytest.fixture(scope="module")
def ur10():
    return sv.load_scenario("ur10-bottle")


def columns(scenario, way):
    names = load_arm(scenario.arm, scenario.tray).joint_names
    return {"t": T, **{f"q_{name}": START[j] + way[j] * BLEND for j, name in enumerate(names)}}


def rotation_z(angle):
    return np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])


def commanded(scenario, way):
    """The same as waypoints with velocities and accelerations."""
    names = load_arm(scenario.arm, scenario.tray).joint_names
    q, dq, ddq = (np.outer(x, way) for x in (BLEND, RATE, BEND))
    return JointSamples(T, names, START + q, dq, ddq, "command", commanded=True)


@pytest.mark.slow
@pytest.mark.parametrize("told", [False, True], ids=["recorded", "commanded"])
def test_an_arm_that_goes_into_its_table_is_said_to_whatever_becomes_of_the_load(ur10, told):
    """The load would ride into the table as safely as anywhere."""
    found = audit_samples(commanded(ur10, LEVEL_DOWN), ur10) if told else sv.audit(columns(ur10, LEVEL_DOWN), ur10)
    assert found.nominal.ok
    assert found.worst.ok
    assert not found.arm.ok
    assert "touch at" in found.arm.sentence
    assert not found.ok
    if told:
        return
    summary = json.loads(json.dumps(found.summary()))
    assert summary["holds"]
    assert summary["arm"] == {"code": found.arm.code, "ok": False, "sentence": found.arm.sentence}


@pytest.mark.slow
def test_joints_beside_a_tray_motion_tell_of_the_arm(ur10, tmp_path):
    """As `salver export` writes both in one table; joints in degrees, or of another arm, tell nothing, and that is
    said."""
    arm = load_arm(ur10.arm, ur10.tray)
    q = np.array(list(columns(ur10, LEVEL_DOWN).values())[1:]).T
    poses = [arm.tray_pose(each) for each in q]
    tray = [np.hstack([p, quat_wxyz_from_matrix(R)]) for p, R in poses]

    def audited(names, q, in_memory=False):
        path = tmp_path / "both.csv"
        header = ",".join(["t", "x", "y", "z", "qw", "qx", "qy", "qz", *names])
        table = np.column_stack([T, tray, q])
        np.savetxt(path, table, delimiter=",", header=header, comments="")
        found = sv.audit(path, ur10)
        if in_memory:
            same = sv.audit(dict(zip(header.split(","), table.T, strict=True)), ur10)
            assert (same.arm, same.ok) == (found.arm, found.ok)
        return found

    own = [f"q_{name}" for name in arm.joint_names]
    alone, both = audited([], q[:, :0]), audited(own, q, in_memory=True)
    assert alone.arm == NOT_CHECKED
    assert both.arm.sentence == sv.audit(columns(ur10, LEVEL_DOWN), ur10).arm.sentence
    assert not both.ok
    assert both.worst.sentence == alone.worst.sentence
    for names, other, why in (
        (own, np.rad2deg(q), "these are degrees"),
        ([f"q{k}" for k in range(1, 8)], np.column_stack([q, q[:, 0]]), "no joint"),
    ):
        found = audited(names, other, in_memory=names is own)
        assert found.arm == NOT_CHECKED
        assert re.search(f"The joints in the file are not used: .*({why})", found.motion.notes[-1])
    unknown = audited([f"Joint{k}" for k in range(1, 7)], q)
    assert unknown.arm == NOT_CHECKED
    names = ", ".join(arm.joint_names)
    assert unknown.motion.notes[-1].endswith(f"Joint5, Joint6 are not used: the arm's joints are {names}.")
    assert not audited(["force_x"], q[:, :1]).motion.notes
    tray[1:3], T_twice = [tray[1]] * 2, np.array([*T[:2], T[1], *T[3:]])
    columns_twice = dict(
        zip(["t", "x", "y", "z", "qw", "qx", "qy", "qz"], np.column_stack([T_twice, tray]).T, strict=True)
    )
    columns_twice |= {f"q_{name}": q[:, j] for j, name in enumerate(arm.joint_names)}
    found = sv.audit(columns_twice, ur10)
    assert found.arm == NOT_CHECKED
    assert "repeats times" in found.motion.notes[-1]


@pytest.mark.parametrize(
    ("moved", "turned", "told"), [(0.0, 0.0, False), (0.04, 0.08, False), (0.06, 0.0, True), (0.0, 0.12, True)]
)
def test_joints_that_carry_the_tray_elsewhere_leave_the_verdict_open(ur10, tmp_path, moved, turned, told):
    """The tray's columns alone hold; joints and tray agree at the ends and disagree on the way."""
    arm = load_arm(ur10.arm, ur10.tray)
    q, share = START - 0.1 * np.outer(BLEND, LEVEL_DOWN), 4 * BLEND * (1 - BLEND)
    poses = [arm.tray_pose(each) for each in q]
    tray = [
        np.hstack([p - [x * moved, 0, 0], quat_wxyz_from_matrix(rotation_z(x * turned) @ R)])
        for x, (p, R) in zip(share, poses, strict=True)
    ]
    path = tmp_path / "both.csv"
    header = ",".join(["t", "x", "y", "z", "qw", "qx", "qy", "qz", *(f"q_{name}" for name in arm.joint_names)])
    np.savetxt(path, np.column_stack([T, tray, q]), delimiter=",", header=header, comments="")
    found = sv.audit(path, ur10)
    assert found.ok != told
    if told:
        assert found.worst.code == "cannot_tell"
        assert f"{1e3 * moved:.0f} mm and {np.rad2deg(turned):.1f} deg" in found.worst.sentence


def test_joints_beside_the_tray_leave_the_doubts_about_its_recording(ur10):
    """The table lacks 0.3 s of both."""
    arm = load_arm(ur10.arm, ur10.tray)
    q = START - 0.1 * np.outer(BLEND, LEVEL_DOWN)
    tray = [np.hstack([p, quat_wxyz_from_matrix(R)]) for p, R in map(arm.tray_pose, q)]
    header = ["t", "x", "y", "z", "qw", "qx", "qy", "qz", *(f"q_{name}" for name in arm.joint_names)]
    table = np.column_stack([T, tray, q])
    assert sv.audit(dict(zip(header, table.T, strict=True)), ur10).ok
    found = sv.audit(dict(zip(header, np.delete(table, slice(140, 170), axis=0).T, strict=True)), ur10)
    assert found.arm.ok
    assert found.worst.details["reasons"] == ["gap"]


def test_the_floor_is_what_the_scenario_says(ur10):
    """Of a motion that lowers the arm beyond its table, and touches nothing else."""
    low, nowhere = 0.6 * np.eye(6)[1], ur10.with_changes(surroundings__floor="none")
    into, free = sv.audit(columns(ur10, low), ur10), sv.audit(columns(nowhere, low), nowhere)
    assert into.arm.sentence == "wrist_2_link and floor touch at 1.50 s."
    assert free.arm.ok
    assert "Not checked" in free.arm.sentence
    assert "anything around the arm" in free.arm.sentence
    assert "floor" not in free.arm.sentence


def test_the_nearest_obstacle_is_named_though_parts_of_the_arm_are_nearer_to_one_another(ur10):
    lamp = {"type": "sphere", "name": "lamp", "radius": 0.1, "position": (0, 0, 4)}
    hung = ur10.with_changes(surroundings__floor="none", obstacles=[lamp])
    assert "passes lamp at" in sv.audit(columns(hung, -0.1 * LEVEL_DOWN), hung).arm.sentence


def test_the_last_sample_is_compared_too(ur10):
    """It comes less than the usual 5 ms after the one before."""
    names = load_arm(ur10.arm, ur10.tray).joint_names
    q = np.array([START, START, START + 0.6 * np.eye(6)[1]])
    recorded = JointSamples(np.array([0.0, 0.005, 0.009]), names, q, None, None, "recording")
    assert (
        arm_status(recorded, load_arm(ur10.arm, ur10.tray), ur10).sentence == "wrist_2_link and floor touch at 0.01 s."
    )


def test_a_good_motion_says_first_what_was_not_checked_of_the_arm(ur10):
    found = sv.audit(columns(ur10, -0.1 * LEVEL_DOWN), ur10)
    assert found.ok
    assert found.arm.sentence.startswith("Not checked: how fast the joints move, and their torques")
    assert "anything around the arm but the floor" in found.arm.sentence


def test_joints_out_of_their_range_are_named(ur10):
    arm = load_arm(ur10.arm, ur10.tray)
    turned = (arm.limits.q_max[5] + 0.1 - START[5]) * np.eye(6)[5]
    found = sv.audit(columns(ur10, turned), ur10)
    assert not found.arm.ok
    assert found.arm.sentence.startswith(
        f"wrist_3_joint is at {arm.limits.q_max[5] + 0.1:.4g} rad at 3.00 s, 0.1 rad out"
    )


@pytest.mark.parametrize("model", ["ur10", "without shapes"])
def test_a_joint_out_of_its_range_in_one_sample_of_many_is_seen_whatever_is_known_of_shapes(ur10, model, tmp_path):
    """Samples come five times as often as postures are compared."""
    if model != "ur10":
        arm = load_arm(ur10.arm, ur10.tray)
        (tmp_path / "arm.urdf").write_text(re.sub('filename="[^"]*"', 'filename="gone.stl"', arm.urdf))
        ur10 = ur10.with_changes(arm__model=str(tmp_path / "arm.urdf"), arm__flange="tool0")
    arm = load_arm(ur10.arm, ur10.tray)
    q = np.tile(START, (101, 1))
    q[52, 5] = arm.limits.q_max[5] + 0.1
    recorded = JointSamples(np.arange(101) * 1e-3, arm.joint_names, q, None, None, "recording")
    status = arm_status(recorded, arm, ur10)
    assert not status.ok
    assert status.sentence.endswith("at 0.05 s, 0.1 rad out of its range.")


def test_of_a_motion_of_the_tray_nothing_is_known_of_an_arm(ur10):
    still = {"t": T, "x": 0.6 + 0 * T, "y": 0.01 * BLEND, "z": 0.4 + 0 * T, "qw": 1 + 0 * T}
    still |= dict.fromkeys(("qx", "qy", "qz"), 0 * T)
    assert sv.audit(still, ur10).arm is NOT_CHECKED


def test_a_load_inside_the_wrist_is_refused(ur10):
    """Nothing is said of such a load: not that the arm was not checked, and that the load holds."""
    inside = ur10.with_changes(tray__height=-0.02)
    with pytest.raises(ScenarioError, match=r"^bottle lies inside wrist_3_link in every posture"):
        _ = sv.audit(columns(inside, 0.0 * START), inside).ok


def test_joints_go_by_their_names(ur10):
    """In a message they may come in any order."""
    names = load_arm(ur10.arm, ur10.tray).joint_names
    q = START + BLEND[:, None] * 0.6 * np.eye(6)[1]
    turned = JointSamples(T, names[::-1], q[:, ::-1], None, None, "message", commanded=False)
    assert audit_samples(turned, ur10).arm.sentence == "wrist_2_link and floor touch at 1.50 s."


@pytest.mark.slow
def test_what_a_command_does_not_say_of_vibration_is_said_first(ur10):
    """A recording shows how the tray shook; a command does not."""
    up = -0.1 * LEVEL_DOWN
    shaken = ur10.with_changes(uncertainty__shake={"amplitude": 1e-5, "frequency": 15.0})
    told, counted = (audit_samples(commanded(of, up), of).worst.sentence for of in (ur10, shaken))
    recorded = sv.audit(columns(ur10, up), ur10).worst.sentence
    said = [text.startswith("Not checked: vibration of the tray") for text in (told, counted, recorded)]
    assert said == [True, False, False]


def test_a_link_that_is_below_the_floor_in_every_posture_is_named(ur10):
    """The base stands 6 cm below it: the lower end of the upper arm is in it wherever the arm goes."""
    sunk = ur10.with_changes(arm__base_position=[0.0, 0.0, -0.06], surroundings__floor=0.0)
    told = sv.audit(columns(sunk, -0.1 * LEVEL_DOWN), sunk).arm.sentence
    assert "upper_arm_link against the floor (nearer to it than 10 mm in every posture)" in told
    assert "against the floor" not in sv.audit(columns(ur10, -0.1 * LEVEL_DOWN), ur10).arm.sentence
