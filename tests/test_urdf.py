"""What arms may be made of: joints that slide or turn for ever, packages, xacro; what is not an arm gets a sentence."""

from __future__ import annotations

import re
from pathlib import Path

import mujoco
import numpy as np
import pytest

from salver import scenario
from salver.control.arm import ArmState
from salver.driver.execution import Watchdog
from salver.errors import ScenarioError, UnreachableError
from salver.learning.track import track
from salver.models import urdf
from salver.models.arm import ArmModel, load_arm
from salver.models.arm_geometry import arm_geometry
from salver.models.urdf import find_mesh
from salver.motion_files.samples import joint_samples
from salver.planning.fastest import plan_fastest
from salver.planning.follow.limits import peaks, unchecked, verdict
from salver.planning.follow.motion import follow_scenario
from salver.planning.make import make_plan, plan_baseline
from salver.planning.postures import PoseTarget, start_posture
from salver.simulation.loads import true_world
from salver.simulation.physics import simulate
from salver.simulation.scene import build
from salver.trajectory import JointMotion

LINK = """<link name="{name}"><inertial><mass value="{mass}"/><origin xyz="{com}"/>
  <inertia ixx="0.02" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial>
  <collision><origin xyz="{com}"/><geometry><box size="{size}"/></geometry></collision></link>"""
JOINT = """<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><origin xyz="{at}"/>
  <axis xyz="{axis}"/><limit lower="{low}" upper="{high}" effort="{effort}" velocity="{speed}"/>{more}</joint>"""


def joint(name: str, kind: str, parent: str, child: str, at: str, axis: str, **more: object) -> str:
    values = {"low": -2.0, "high": 2.0, "effort": 200.0, "speed": 2.0, "more": "", **more}
    return JOINT.format(name=name, kind=kind, parent=parent, child=child, at=at, axis=axis, **values)


def gantry(*, turn: str = "continuous", more: str = "") -> str:
    """Three slides along x, y, z that carry a wrist of three joints that turn about z, y, x."""
    links = [
        LINK.format(name="rail", mass=5, com="0 0 0", size="2 0.05 0.05"),
        LINK.format(name="beam", mass=4, com="0 0 0.2", size="0.05 2 0.05"),
        LINK.format(name="post", mass=3, com="0 0 0.4", size="0.05 0.05 0.05"),
        LINK.format(name="head", mass=1, com="0 0 0.5", size="0.05 0.05 0.05"),
        LINK.format(name="yaw", mass=0.5, com="0 0 0.02", size="0.04 0.04 0.04"),
        LINK.format(name="pitch", mass=0.5, com="0 0 0.02", size="0.04 0.04 0.02"),
        LINK.format(name="roll", mass=0.5, com="0 0 0.02", size="0.04 0.04 0.02"),
    ]
    joints = [
        joint("x", "prismatic", "rail", "beam", "0 0 0", "1 0 0", low=-0.8, high=0.8),
        joint("y", "prismatic", "beam", "post", "0 0 0", "0 1 0", low=-0.8, high=0.8),
        joint("z", "prismatic", "post", "head", "0 0 0", "0 0 1", low=-0.3, high=0.5),
        joint("turn", turn, "head", "yaw", "0 0 0.55", "0 0 1", more=more),
        joint("lean", "revolute", "yaw", "pitch", "0 0 0.06", "0 1 0"),
        joint("tip", "revolute", "pitch", "roll", "0 0 0.05", "1 0 0"),
    ]
    return f'<robot name="gantry">{"".join(links)}{"".join(joints)}</robot>'


CELL = {
    "name": "gantry",
    "motion": {"duration": 1.2, "start": {"position": [-0.2, -0.1, 0.9]}, "goal": {"position": [0.2, 0.2, 0.95]}},
    "objects": [{"name": "box", "shape": {"type": "box", "size": [0.06, 0.06, 0.08]}, "mass": 0.3, "friction": 0.4}],
    "contact": {"condition": "exact"},
    "tray": {"height": 0.08},
}


def cell(tmp_path: Path, text: str, **arm: object) -> scenario.Scenario:
    path = tmp_path / "gantry.urdf"
    path.write_text(text)
    return scenario.parse({**CELL, "arm": {"model": str(path), "flange": "roll", **arm}}, "the test")


def loaded(tmp_path: Path, text: str, **arm: object) -> ArmModel:
    case = cell(tmp_path, text, **arm)
    assert case.arm is not None
    return load_arm(case.arm, case.tray)


@pytest.mark.slow
def test_what_is_out_of_reach_is_told_with_how_far_and_with_the_heading_that_would_do(tmp_path):
    """By hand: the slide along y ends at 0.8 m, so a tray that stays level misses y = 1.8 by 1 m, and one that leans on
    its 0.3 m of wrist by no less than 0.7. A wrist that turns 0.5 rad either way reaches no heading of 60 degrees."""
    stiff = gantry(turn="revolute").replace('lower="-2.0" upper="2.0"', 'lower="-0.5" upper="0.5"', 1)
    case = cell(tmp_path, stiff)
    assert plan_fastest(case).ok
    far = case.with_changes(motion__start__position=[-0.2, 1.8, 0.9])
    with pytest.raises(UnreachableError, match="reaches the start: the nearest found misses it by") as told:
        plan_fastest(far)
    missed = re.search(r"by ([\d.]+) mm", str(told.value))
    assert missed is not None
    assert 700 < float(missed[1]) < 1020
    assert "Turned" not in str(told.value)
    with pytest.raises(UnreachableError, match="reaches the goal") as told:
        plan_fastest(case.with_changes(motion__goal__rpy_deg=[0, 0, 60]))
    turn = re.search(r"Turned by (-\d+) deg about its vertical it is reached", str(told.value))
    assert turn is not None
    assert abs(60 + int(turn[1])) < np.rad2deg(0.5)
    assert plan_fastest(case.with_changes(motion__goal__rpy_deg=[0, 0, 60 + int(turn[1])])).ok


# ---- joints that slide, joints that turn for ever --------------------------------------------------------------


@pytest.mark.slow
def test_a_gantry_is_planned_checked_and_run(tmp_path: Path) -> None:
    case = cell(tmp_path, gantry(), limits={"acceleration": 10.0, "jerk": 500.0})
    for method in ("robust", "fastest"):
        plan = make_plan(case, method)
        assert plan.ok, (plan.status, plan.arm_status)
        assert plan.arm_status is not None
        assert plan.arm_status.details["velocity"]["unit"] in ("m/s", "rad/s")
        assert simulate(plan).summary["outcome"] == "holds"


def test_units_of_a_joint_that_slides(tmp_path: Path) -> None:
    """A slide of 0.3 m in 1 s by min-jerk: 15/8 0.3 = 0.5625 m/s; gravity on z alone: all that hangs on it, 2.5 kg."""
    arm = loaded(tmp_path, gantry())
    assert arm.linear == (True, True, True, False, False, False)
    ends = np.zeros((2, 6))
    ends[1, 1] = 0.3
    motion = JointMotion(np.array([0.0, 1.0]), ends, np.zeros((2, 6)), np.zeros((2, 6)))
    fine = JointMotion(np.linspace(0, 1, 201), *motion.sample(np.linspace(0, 1, 201)))
    found = {peak.kind: peak for peak in peaks(arm, fine)}
    assert (found["velocity"].unit, found["acceleration"].unit) == ("m/s", "m/s^2")
    assert found["velocity"].value == pytest.approx(15 / 8 * 0.3)
    hanging = 1 + 3 * 0.5 + scenario.Tray().mass
    assert arm.gravity(np.zeros(6))[2] == pytest.approx(9.81 * hanging)
    down = loaded(tmp_path, gantry(), limits={"torque": [200, 200, 10, 200, 200, 200]})
    told = verdict(down, fine).sentence
    assert f"the torque of z reaches {9.81 * hanging:.4g} N at" in told


def test_a_continuous_joint_keeps_within_a_turn(tmp_path: Path) -> None:
    arm = loaded(tmp_path, gantry())
    assert (arm.limits.q_min[3], arm.limits.q_max[3]) == pytest.approx((-2 * np.pi, 2 * np.pi))


def test_a_name_without_end_is_not_quoted_in_full(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match="the name of <joint>") as error:
        loaded(tmp_path, gantry().replace('name="lean"', f'name="{"x" * 9999}"'))
    assert len(str(error.value)) < 400


# ---- what is no arm --------------------------------------------------------------------------------------------

MIMIC = '<mimic joint="lean" multiplier="1"/>'


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda t: gantry(turn="revolute", more=MIMIC), ["joint turn", "mimics lean", "move on their own"]),
        (
            lambda t: t.replace("</robot>", joint("loop", "fixed", "rail", "roll", "0 0 0", "0 0 1") + "</robot>"),
            ["closes a chain", "link roll", "tip and loop"],
        ),
        (
            lambda t: t.replace("</robot>", joint("loop", "fixed", "roll", "rail", "0 0 0", "0 0 1") + "</robot>"),
            ["closes a chain"],
        ),
        (lambda t: t.replace("<link", '<xacro:include filename="x"/><link', 1), ["xacro", "pip install xacrodoc"]),
        (lambda t: t.replace('type="prismatic"', 'type="planar"', 1), ["degrees of freedom"]),
        (lambda t: t.replace('<mass value="5"', '<mass value="heavy"'), ['value of <mass> in rail is "heavy"']),
        (lambda t: t.replace('<mass value="4"', '<mass value="nan"'), ['value of <mass> in beam is "nan"']),
        (lambda t: t.replace('<mass value="4"', '<mass value="-4"'), ["joint x moves weighs -4 kg"]),
        (lambda t: t.replace('ixx="0.02"', 'ixx="0,02"', 1), ['ixx of <inertia> in rail is "0,02"']),
        (lambda t: t.replace('xyz="0 0 0.55"', 'xyz="0 0.55"', 1), ["must be 3 finite numbers"]),
    ],
    ids=["mimic", "two parents", "ring", "xacro", "planar", "text", "nan", "negative", "comma", "two numbers"],
)
def test_what_is_no_arm_gets_one_sentence(tmp_path: Path, change, words: list[str]) -> None:
    with pytest.raises(ScenarioError) as refused:
        loaded(tmp_path, change(gantry()))
    message = str(refused.value)
    assert all(word in message for word in words), message
    assert "\n" not in message
    assert message.endswith(".")


def without_inertial(text: str, name: str) -> str:
    return re.sub(rf'(<link name="{name}">)<inertial>.*?</inertial>', r"\1", text, flags=re.DOTALL)


def without_inertia(text: str, name: str) -> str:
    """The link weighs what it did, in a point, as links do whose inertia nobody computed."""
    return re.sub(
        rf'(<link name="{name}">.*?)ixx="0.02" iyy="0.02" izz="0.02"',
        r'\1ixx="0" iyy="0" izz="0.015"',
        text,
        count=1,
        flags=re.DOTALL,
    )


LAMP = LINK.format(name="lamp", mass=0.3, com="0.02 0 0.01", size="0.01 0.01 0.01")
FIXED_LAMP = without_inertia(LAMP, "lamp") + joint("mount", "fixed", "head", "lamp", "0.1 0.05 0", "0 0 1")
FIXED_CAMERA = '<link name="camera"/>' + joint("mount", "fixed", "head", "camera", "0.1 0 0", "0 0 1")


@pytest.mark.parametrize(
    "change",
    [
        lambda t: without_inertial(t, "rail"),
        lambda t: without_inertial(t, "roll"),
        lambda t: t.replace("</robot>", FIXED_CAMERA + "</robot>"),
        lambda t: t.replace("</robot>", FIXED_LAMP + "</robot>"),
        lambda t: without_inertia(t, "rail"),
    ],
    ids=[
        "the root",
        "the flange, which carries the tray",
        "fixed to a link with mass",
        "fixed, with an inertia that no body has",
        "the root, with an inertia that no body has",
    ],
)
def test_what_is_fixed_to_a_link_moves_with_it(tmp_path: Path, change) -> None:
    """Whatever the URDF says of it alone. The engine's mass matrix is Pinocchio's, an independent code."""
    case, arm = cell(tmp_path, change(gantry())), loaded(tmp_path, change(gantry()))
    scene = build(case, true_world(case), arm)
    data, q = mujoco.MjData(scene.model), np.linspace(-0.2, 0.3, arm.n)
    data.qpos[: arm.n] = q
    mujoco.mj_forward(scene.model, data)
    columns = []
    for unit in np.eye(scene.model.nv)[: arm.n]:
        column = np.zeros(scene.model.nv)
        mujoco.mj_mulM(scene.model, data, column, unit)
        columns.append(column[: arm.n])
    assert np.array(columns) == pytest.approx(arm.mass_matrix(q), abs=1e-9)


@pytest.mark.parametrize(
    ("change", "link"),
    [
        (lambda t: without_inertial(t, "pitch"), "pitch"),
        (lambda t: t.replace('<mass value="4"', '<mass value="0"'), "beam"),
        (lambda t: t.replace('ixx="0.02"', 'ixx="0"').replace('iyy="0.02" izz="0.02"', 'iyy="0" izz="0"'), "beam"),
        (lambda t: t.replace('ixx="0.02"', 'ixx="0.1"', 2), "beam"),
        (lambda t: t.replace('ixx="0.02"', 'ixx="-0.1"', 2), "beam"),
    ],
    ids=["no inertial", "no mass", "no inertia", "triangle inequality", "negative inertia"],
)
def test_a_moving_link_that_the_engine_cannot_move_is_named(tmp_path: Path, change, link: str) -> None:
    case, arm = cell(tmp_path, change(gantry())), loaded(tmp_path, change(gantry()))
    with pytest.raises(ScenarioError, match=f"cannot move the link {link} of ") as refused:
        build(case, true_world(case), arm)
    message = str(refused.value)
    assert str(arm.urdf_path) in message
    assert "needs <inertial> with a mass above 0" in message
    assert "\n" not in message


@pytest.mark.parametrize("link", ["pitch", "roll"])
def test_that_a_link_has_no_mass_is_said_before_torques_are_said_to_hold(tmp_path: Path, link: str) -> None:
    """Also of the flange, with which the tray moves; a scenario without limits of torque says nothing of them."""
    text = without_inertial(gantry(), link)
    arm = loaded(tmp_path, text)
    told = verdict(arm, JointMotion(np.arange(2.0), *np.zeros((3, 2, arm.n)))).sentence
    assert told.startswith("Not checked: ")
    assert f"; torques that {link} needs (the URDF gives it no mass); " in told
    free = loaded(tmp_path, re.sub(r'effort="\S+"', 'effort="0"', text))
    assert "no mass" not in "".join(unchecked(free, arm_geometry(free)))
    assert "no mass" not in "".join(unchecked(loaded(tmp_path, gantry()), arm_geometry(arm)))


def test_a_joint_that_slides_is_told_in_metres(tmp_path: Path) -> None:
    """In the sentence on a start posture, by the watchdog, and where a log is compared with a plan; others in rad."""
    case, arm = cell(tmp_path, gantry()), loaded(tmp_path, gantry())
    middle = np.array([0.0, 0.0, 0.1, 0.0, 0.0, 0.0])
    for joint, unit in ((0, "m"), (4, "rad")):
        beyond = middle.copy()
        beyond[joint] = arm.limits.q_max[joint] + 0.5
        with pytest.raises(ScenarioError, match=rf"= \S+ {unit} is beyond the limits .*\] {unit}\."):
            start_posture(arm, beyond, PoseTarget(*arm.tray_pose(middle)))
        said = Watchdog(0.1).astray(arm, ArmState(beyond, 0 * beyond), middle, 0.1)
        assert said.endswith(f" {unit} off its reference at t = 0.100 s; 0.1 {unit} are allowed.")
    plan = make_plan(case)
    assert plan.joint is not None
    t = np.arange(-0.3, plan.duration + 0.5, 2e-3)
    q = plan.joint.sample(t)[0]
    q[:, 0] += 0.02 * np.exp(-((t / plan.duration - 0.5) ** 2) / 0.02)
    found = track(plan, joint_samples(t, arm.joint_names, q, None, None, "the log"))
    assert [joint.unit for joint in found.joints if joint.name in ("x", "y", "z")] == ["m", "m", "m"]
    assert [joint.unit for joint in found.joints if joint.name in ("turn", "lean", "tip")] == ["rad"] * 3
    assert re.match(r"x .*\(1\d\.\d\d mm off at most\)", found.cause)


def four_joints() -> str:
    """A SCARA: two turns about z, a slide along z, a turn about z."""
    links = [
        LINK.format(name="base", mass=10, com="0 0 0.15", size="0.15 0.15 0.3"),
        LINK.format(name="upper", mass=4, com="0.2 0 0.03", size="0.42 0.08 0.06"),
        LINK.format(name="fore", mass=3, com="0.15 0 0.03", size="0.32 0.07 0.06"),
        LINK.format(name="quill", mass=1, com="0 0 0.1", size="0.03 0.03 0.2"),
        LINK.format(name="plate", mass=0.3, com="0 0 0.01", size="0.05 0.05 0.02"),
    ]
    joints = [
        joint("shoulder", "revolute", "base", "upper", "0 0 0.32", "0 0 1", low=-2.5, high=2.5, speed=6),
        joint("elbow", "revolute", "upper", "fore", "0.4 0 0.07", "0 0 1", low=-2.4, high=2.4, speed=8),
        joint("slide", "prismatic", "fore", "quill", "0.3 0 0.07", "0 0 1", low=0, high=0.2, speed=1),
        joint("turn", "continuous", "quill", "plate", "0 0 0.2", "0 0 1", speed=15),
    ]
    return f'<robot name="scara">{"".join(links)}{"".join(joints)}</robot>'


def scara(tmp_path: Path, **motion: object) -> scenario.Scenario:
    path = tmp_path / "scara.urdf"
    path.write_text(four_joints())
    ends = {"start": {"position": [0.5, -0.3, 0.8]}, "goal": {"position": [0.5, 0.3, 0.85]}, **motion}
    arm = {"model": str(path), "flange": "plate", "limits": {"acceleration": [30.0, 30.0, 10.0, 60.0]}}
    tray = {"height": 0.04, "size": [0.12, 0.12]}
    return scenario.parse({**CELL, "name": "scara", "motion": ends, "arm": arm, "tray": tray}, "the test")


def test_four_joints_follow_what_needs_no_more(tmp_path: Path) -> None:
    """A level line, where the tray is by Pinocchio's forward kinematics and its derivatives; not one that tilts."""
    case = scara(tmp_path, duration=1.5)
    line = plan_baseline(case).reference
    made, status = follow_scenario(case, line)
    assert status.ok, status.sentence
    assert made is not None
    assert case.arm is not None
    arm, body = load_arm(case.arm, case.tray), case.payload.first
    wanted = line.sample(made.t)
    for k in range(0, len(made.t), 20):
        p, rotation = arm.object_pose(made.q[k], body.p_EB, body.R_EB)
        assert p == pytest.approx(wanted.p_SB[k], abs=1e-10)
        assert rotation == pytest.approx(wanted.R_SB[k], abs=1e-10)
    step = made.t[1] - made.t[0]
    assert made.dq == pytest.approx(np.gradient(made.q, step, axis=0, edge_order=2), abs=2e-3)
    assert made.ddq == pytest.approx(np.gradient(made.dq, step, axis=0, edge_order=2), abs=2e-2)
    tilted = scara(tmp_path, duration=1.5, goal={"position": [0.5, 0.3, 0.85], "rpy_deg": [0.0, 5.0, 0.0]})
    none, said = follow_scenario(tilted, plan_baseline(tilted).reference)
    assert none is None
    assert "4 joints do not turn and tilt a tray every way" in said.sentence


@pytest.mark.slow
def test_four_joints_carry_as_fast_as_they_go(tmp_path: Path) -> None:
    """Safe by the plan's own verdict, and in the engine."""
    plan = plan_fastest(scara(tmp_path, goal_yaw="free"))
    assert plan.ok, plan.status.sentence
    assert simulate(plan).outcome == "holds"


def test_a_mimic_joint_beside_the_chain_is_none_of_our_business(tmp_path: Path) -> None:
    finger = LINK.format(name="finger", mass=0.1, com="0 0 0", size="0.01 0.01 0.01")
    beside = finger + joint("grip", "prismatic", "yaw", "finger", "0.05 0 0", "1 0 0", more=MIMIC)
    assert loaded(tmp_path, gantry().replace("</robot>", beside + "</robot>")).n == 6


LIMITS = [
    ("joint_limits: {x: {max_velocity: 1" + "0" * 400 + "}}", ["max_velocity of x is 1000", "a finite number"]),
    ("joint_limits: {elbow: {max_velocity: 1}}", ["limits elbow, which the URDF does not have", "lean, tip, turn, x"]),
    ("joint_limits: {x: {max_velocity: -1}}", ["max_velocity of x is -1", "greater than 0"]),
    ("joint_limits: {x: {max_velocity: fast}}", ["max_velocity of x is 'fast'"]),
    ("joint_limits: {x: {max_acceleration: .nan}}", ["max_acceleration of x is nan"]),
    ("joint_limits: {x: {min_position: 1, max_position: -1}}", ["min_position of x is not below"]),
    ("joint_limits: [1, 2]", ["has no table joint_limits"]),
    ("velocity: 3", ["has no table joint_limits"]),
    ("joint_limits: {x: [", ["cannot be read"]),
    ("joint_limits: {x: {max_velocity: !python/object:os.system 1}}", ["cannot be read"]),
    (None, ["cannot be read", "no such file"]),
]


@pytest.mark.parametrize(("text", "words"), LIMITS)
def test_joint_limits_that_cannot_be(tmp_path: Path, text: str | None, words: list[str]) -> None:
    path = tmp_path / "joint_limits.yaml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(ScenarioError) as refused:
        loaded(tmp_path, gantry(), joint_limits=str(path))
    message = str(refused.value)
    assert str(path) in message
    assert all(word in message for word in words), message
    assert "\n" not in message


def test_limits_for_another_number_of_joints(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match=r"arm.limits.jerk has 7 values; gantry has 6 joints"):
        loaded(tmp_path, gantry(), limits={"jerk": [1.0] * 7})


@pytest.mark.parametrize("content", [None, "<robot", "<robot><disable_collisions link1='a' link2='b'/></robot>"])
def test_bad_srdf(tmp_path: Path, content: str | None) -> None:
    path = tmp_path / "arm.srdf"
    if content is not None:
        path.write_text(content)
    with pytest.raises(ScenarioError, match=r"^arm.srdf: .*(cannot be read|names no links of this arm)"):
        loaded(tmp_path, gantry(), srdf=str(path))


def test_package_folders_that_are_not_there(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match=r'arm.package_dirs\[1\] = ".*nowhere": there is no such folder'):
        loaded(tmp_path, gantry(), package_dirs=[str(tmp_path), str(tmp_path / "nowhere")])


MESHES = {
    "far too large": (
        "v 0 0 0\nv 1000 0 0\nv 0 1000 0\nv 0 0 100\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n",
        "1000 m large",
    ),
    "a point": ("v 0 0 0\nv 0 0 0\nv 0 0 0\nf 1 2 3\n", "cannot be read"),
    "nothing": ("", "cannot be read"),
}


@pytest.mark.parametrize("which", MESHES)
def test_meshes_of_links_that_cannot_be(tmp_path: Path, which: str) -> None:
    """The first is what a mesh in millimetres is like: a hull of everything, which would overlap in every posture."""
    content, words = MESHES[which]
    (tmp_path / "link.obj").write_text(content)
    text = gantry().replace('<box size="0.04 0.04 0.04"/>', '<mesh filename="link.obj"/>')
    with pytest.raises(ScenarioError, match=f"shape of yaw is not known .*{words}"):
        arm_geometry(loaded(tmp_path, text))


def test_a_flat_mesh_is_a_slab(tmp_path: Path) -> None:
    """A square in the plane x + y + z = 0, along which no axis lies: a millimetre thick, as large as it is."""
    u, v = np.array([1, -1, 0]) / np.sqrt(2), np.array([1, 1, -2]) / np.sqrt(6)
    corners = [0.1 * (a * u + b * v) for a, b in ((1, 1), (-1, 1), (-1, -1), (1, -1))]
    lines = [f"v {x} {y} {z}" for x, y, z in corners] + ["f 1 2 3", "f 1 3 4"]
    (tmp_path / "flat.obj").write_text("\n".join(lines))
    parts = arm_geometry(
        loaded(tmp_path, gantry().replace('<box size="0.04 0.04 0.04"/>', '<mesh filename="flat.obj"/>'))
    )
    points = np.asarray(parts.model.geometryObjects[parts.names.index("yaw")].geometry.points())
    assert np.ptp(points @ np.ones(3) / np.sqrt(3)) == pytest.approx(1e-3, rel=1e-4)  # read as 32-bit numbers
    assert (np.ptp(points @ u), np.ptp(points @ v)) == pytest.approx((0.2, 0.2), rel=1e-6)


# ---- packages --------------------------------------------------------------------------------------------------


def test_where_meshes_are_looked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In the order of the documentation: package_dirs, AMENT_PREFIX_PATH, ROS_PACKAGE_PATH, above the URDF."""
    urdf = tmp_path / "mine" / "urdf" / "arm.urdf"
    places = {
        "given": tmp_path / "given" / "arm_description" / "meshes" / "link.stl",
        "itself": tmp_path / "other" / "arm_description" / "meshes" / "link.stl",
        "stack": tmp_path / "ws" / "stack" / "arm_description" / "meshes" / "link.stl",
        "ament": tmp_path / "ament" / "share" / "arm_description" / "meshes" / "link.stl",
        "above": tmp_path / "mine" / "meshes" / "link.stl",
    }
    for place in (*places.values(), urdf):
        place.parent.mkdir(parents=True)
        place.write_text("")
    name = "package://arm_description/meshes/link.stl"
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)
    monkeypatch.delenv("ROS_PACKAGE_PATH", raising=False)
    assert find_mesh(name, urdf) == str(places["above"])
    monkeypatch.setenv("ROS_PACKAGE_PATH", f"{tmp_path / 'nowhere'}:{tmp_path / 'ws'}")
    assert find_mesh(name, urdf) == str(places["stack"])
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path / "ament"))
    assert find_mesh(name, urdf) == str(places["ament"])
    assert find_mesh(name, urdf, [tmp_path / "given"]) == str(places["given"])
    assert find_mesh(name, urdf, [tmp_path / "other" / "arm_description"]) == str(places["itself"])
    assert find_mesh("../meshes/link.stl", urdf) == str(urdf.parent / "../meshes/link.stl")
    assert find_mesh(f"file://{places['given']}", urdf) == str(places["given"])
    assert find_mesh("package://arm_description/gone.stl", urdf) == "package://arm_description/gone.stl"


def test_a_urdf_made_from_xacro_is_an_arm(tmp_path: Path) -> None:
    """As the documentation says to do it; the comment and the declaration that are left do not matter."""
    xacrodoc = pytest.importorskip("xacrodoc")
    source = tmp_path / "gantry.urdf.xacro"
    text = gantry().replace("<robot ", '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" ')
    source.write_text(text.replace('velocity="2.0"', 'velocity="${1 + 0.5}"'))
    made = tmp_path / "gantry.urdf"
    xacrodoc.XacroDoc.from_file(source).to_urdf_file(made)
    arm = load_arm(scenario.Arm(model=str(made), flange="roll"), scenario.Tray())
    assert arm.limits.velocity == pytest.approx([1.5] * 6)
    assert arm_geometry(arm).unchecked == ("links that share a joint against one another",)


@pytest.mark.slow
def test_an_arm_of_one_joint_is_told_that_it_does_not_reach(tmp_path: Path) -> None:
    """Its Jacobian has one column."""
    file = tmp_path / "one.urdf"
    links = LINK.format(name="base", mass=1, com="0 0 0", size="0.05 0.05 0.05") + LINK.format(
        name="tool", mass=1, com="0 0 0.05", size="0.05 0.05 0.05"
    )
    turn = joint("turn", "revolute", "base", "tool", "0 0 0.1", "0 0 1")
    file.write_text(f'<robot name="one">{links}{turn}</robot>')
    case = scenario.parse({**CELL, "arm": {"model": str(file), "flange": "tool", "collisions": "unchecked"}}, "one")
    with pytest.raises(UnreachableError, match="No posture within the joint limits reaches"):
        plan_fastest(case)


def test_a_file_too_large_for_a_robot_is_not_read(tmp_path, monkeypatch):
    (tmp_path / "arm.urdf").write_text("<robot name='x'>" + 1000 * "<link name='a'/>" + "</robot>")
    monkeypatch.setattr(urdf, "LARGEST", 10_000)
    with pytest.raises(ScenarioError, match=r"arm\.urdf is larger than 0 MB"):
        urdf._parse(tmp_path / "arm.urdf")
