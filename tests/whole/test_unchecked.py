"""Nothing unchecked passes in silence: each check is blinded in turn, by taking away what it needs."""

from __future__ import annotations

import json
from pathlib import Path
from shutil import copyfile
from xml.etree import ElementTree

import numpy as np
import pytest

from arm_motions import ALL_LIMITS, make, still
from salver import scenario
from salver.errors import ScenarioError, Status
from salver.geometry import Array
from salver.models.arm.arm import load_arm
from salver.models.arm.arm_geometry import ArmGeometry, arm_geometry
from salver.models.arm.arm_limits import LIMITS
from salver.models.arm.known_arms import KNOWN_ARMS, robot_file
from salver.models.arm.link_shapes import link_shapes
from salver.models.uncertain.parameters import unshaken
from salver.planning.fastest import transport_problem
from salver.planning.follow.limits import verdict
from salver.planning.make import make_plan
from salver.planning.plan import Plan
from salver.planning.round import MultiLegPlan
from salver.planning.seeds.starts import ends
from salver.reports.pages import words
from salver.reports.pages.meshes import link_meshes
from salver.reports.pages.replay import replay_scene
from salver.reports.run import read_run
from salver.trajectory import min_jerk_line

UR5 = robot_file(KNOWN_ARMS["ur5"])


def urdf_without(tmp_path: Path, change) -> Path:
    """A copy of the UR5's URDF, changed, its meshes by absolute paths."""
    root = ElementTree.fromstring(load_arm(scenario.Arm(model="ur5"), scenario.Tray()).urdf)
    change(root)
    path = tmp_path / "arm.urdf"
    path.write_text(ElementTree.tostring(root, encoding="unicode"))
    return path


# ---- limits ---------------------------------------------------------------------------------------------------


def test_with_all_limits_only_neighbours_are_left() -> None:
    status = verdict(make("ur5"), still(make("ur5")))
    assert status.details["unchecked"] == ["anything around the arm", "links that share a joint against one another"]
    assert status.sentence.startswith(
        "Not checked: anything around the arm; links that share a joint against one another. ur5 follows"
    )
    assert ("shoulder_link", "upper_arm_link") in status.details["pairs_left_out"]["neighbours"]


@pytest.mark.parametrize("blind", [kind for kind in LIMITS if kind.key != "position"], ids=lambda kind: kind.key)
def test_a_limit_that_nobody_gave_is_told(tmp_path: Path, blind) -> None:
    def forget(root: ElementTree.Element) -> None:
        for limit in root.iter("limit"):
            limit.set({"velocity": "velocity", "torque": "effort"}.get(blind.key, "none"), "0")

    limits = {key: value for key, value in ALL_LIMITS.items() if key != blind.key}
    arm = make(urdf_without(tmp_path, forget), limits=limits)
    status = verdict(arm, still(arm))
    assert status.ok
    assert status.details["unchecked"][1] == f"{blind.name} of all joints (nobody gave a limit)"
    assert status.sentence.startswith(f"Not checked: anything around the arm; {blind.name} of all joints")
    assert status.details["limit_sources"][blind.key] == (None,) * 6


def test_limits_of_one_joint_are_told_by_its_name(tmp_path: Path) -> None:
    moveit = "joint_limits: {elbow_joint: {max_acceleration: 4.0}, wrist_1_joint: {max_acceleration: 5, max_jerk: 60}}"
    file = tmp_path / "joint_limits.yaml"
    file.write_text(moveit)
    arm = make(UR5, limits={"torque_rate": 1e3}, joint_limits=str(file))
    told = verdict(arm, still(arm)).details["unchecked"]
    assert told[1:3] == [
        "acceleration of shoulder_pan_joint, shoulder_lift_joint, wrist_2_joint and wrist_3_joint "
        "(nobody gave a limit)",
        "jerk of shoulder_pan_joint, shoulder_lift_joint, elbow_joint, wrist_2_joint and wrist_3_joint "
        "(nobody gave a limit)",
    ]
    assert arm.limits.acceleration[2:4] == pytest.approx([4.0, 5.0])
    assert arm.limit_sources["acceleration"][2] == "joint_limits.yaml"
    assert arm.limit_sources["velocity"][0] == "the URDF"
    assert arm.limit_sources["torque_rate"][0] == "arm.limits"


def test_moveit_limits_override_the_urdf_and_are_overridden_by_the_scenario(tmp_path: Path) -> None:
    file = tmp_path / "joint_limits.yaml"
    file.write_text(
        "default_velocity_scaling_factor: 0.1\n"
        "joint_limits:\n"
        "  elbow_joint:\n"
        "    {has_position_limits: true, min_position: !degrees -90, max_position: !degrees 90.0, max_velocity: 1,"
        " has_acceleration_limits: false, max_acceleration: 5.0, max_effort: 100}\n"
    )
    arm = make(UR5, limits={"velocity": [1, 2, 3, 4, 5, 6]}, joint_limits=str(file))
    assert (arm.limits.q_min[2], arm.limits.q_max[2]) == pytest.approx((-np.pi / 2, np.pi / 2))
    assert arm.limits.velocity == pytest.approx([1, 2, 3, 4, 5, 6])
    assert np.isinf(arm.limits.acceleration).all()  # the file says that this one does not count
    assert arm.limits.torque == pytest.approx([150, 150, 100, 28, 28, 28])


def test_an_arm_without_masses_is_planned_as_one_that_follows_exactly(tmp_path: Path) -> None:
    """As the URDFs of FANUC, ABB and KUKA; of seven joints, as then no mass matrix has an inverse."""
    case = scenario.load("panda-cube")
    assert case.arm is not None
    root = ElementTree.fromstring(load_arm(case.arm, case.tray).urdf)
    for link in root.iter("link"):
        for inertial in link.findall("inertial"):
            link.remove(inertial)
    path = tmp_path / "massless.urdf"
    path.write_text(ElementTree.tostring(root, encoding="unicode"))
    plan = make_plan(case.with_changes(arm__model=str(path), arm__flange="panda_link8"), "fastest")
    assert plan.ok, plan.verdict
    first = "joint torques, and how far the arm strays from its motion (the URDF gives no masses: "
    assert plan.unchecked[1].startswith(first)
    assert plan.arm_status is not None
    assert plan.arm_status.sentence.startswith(f"Not checked: anything around the arm but the floor; {first}")
    assert plan.tau is None
    assert plan.chain is None
    assert plan.margins.exact_worst.min() >= 0.0  # for every mass of the set


# ---- shapes of links ------------------------------------------------------------------------------------------


LINKS = ["base_link", "shoulder_link", "upper_arm_link", "forearm_link", "wrist_1_link", "wrist_2_link", "wrist_3_link"]


def blinded(tmp_path: Path, link: str, how: str) -> Path:
    """The UR5 with the geometry of one link missing, broken, or not given at all."""

    def change(root: ElementTree.Element) -> None:
        element = next(item for item in root.iter("link") if item.get("name") == link)
        if how == "none":
            for tag in ("visual", "collision"):
                for child in element.findall(tag):
                    element.remove(child)
        for mesh in element.iter("mesh"):
            broken = tmp_path / "broken.stl"
            broken.write_bytes(b"solid nothing\n")
            mesh.set("filename", str(broken) if how == "broken" else "package://nowhere/mesh.stl")

    return urdf_without(tmp_path, change)


@pytest.mark.slow
@pytest.mark.parametrize("link", LINKS)
@pytest.mark.parametrize("how", ["missing", "broken", "none"])
def test_a_link_of_unknown_shape_is_refused_or_told(tmp_path: Path, link: str, how: str) -> None:
    path = blinded(tmp_path, link, how)
    with pytest.raises(ScenarioError) as refused:
        arm_geometry(make(path))
    message = str(refused.value)
    for word in (link, "arm.package_dirs", 'arm.collisions = "capsules"', '"unchecked"', "AMENT_PREFIX_PATH"):
        assert word in message, message
    assert "\n" not in message

    left_out = make(path, collisions="unchecked")
    status = verdict(left_out, still(left_out))
    assert status.sentence.startswith(
        f"Not checked: anything around the arm; whether {link} hits anything (shape not known)"
    )
    fitted = make(path, collisions="capsules")
    status = verdict(fitted, still(fitted))
    assert status.sentence.startswith(f"Not checked: anything around the arm; the true shape of {link} (capsules")
    assert link in arm_geometry(fitted).names


@pytest.mark.parametrize(
    ("moment", "radius"), [("true", 0.03), ("none", 0.04006), ("dummy", 0.04006), ("tiny", 0.02099)]
)
def test_fitted_capsules_by_hand(moment: str, radius: float) -> None:
    """A rod of 1.6 kg along y, its joint at 0, the next one at 0.4 m, its centre of mass half-way.

    True: a cylinder of radius 0.03 m, I_y = m r^2 / 2. A moment that is none, too large or too small to be true leaves
    what the mass says, pi r^2 l + 4/3 pi r^3 = m / density: with light shells 1.6 / 700 = 2.286e-3 m^3, with solid
    aluminium 1.6 / 2700 = 5.93e-4 m^3.
    """
    along = {"true": 1.6 * 0.03**2 / 2, "dummy": 1.0, "tiny": 1e-9, "none": 0.0}[moment]
    entries = f'<inertia ixx="1" iyy="{along}" izz="1" ixy="0" ixz="0" iyz="0"/>' if moment != "none" else ""
    urdf = f"""<robot name="rod"><link name="rod">
      <inertial><mass value="1.6"/><origin xyz="0 0.2 0"/>{entries}</inertial>
      <visual><geometry><mesh filename="nowhere.stl"/></geometry></visual></link><link name="next"/>
      <joint name="j" type="revolute"><parent link="rod"/><child link="next"/><origin xyz="0 0.4 0"/></joint></robot>"""
    known = link_shapes(urdf, capsules=True)
    assert known.fitted == ("rod",)
    for item, middle in zip(known.shapes, (0.1, 0.3), strict=True):
        assert (item.shape.radius, 2 * item.shape.halfLength) == pytest.approx((radius, 0.2), abs=2e-5)
        assert np.abs(item.placement.rotation[:, 2]) == pytest.approx([0, 1, 0], abs=1e-12)
        assert item.placement.translation == pytest.approx([0, middle, 0], abs=1e-12)


def test_a_geometry_of_no_size_is_none() -> None:
    """What can be seen stands for the link then; a body of which nothing can be seen is named, a frame is not."""
    link = """<link name="{}"><inertial><mass value="{}"/></inertial><collision><geometry>{}</geometry></collision>
      <visual><geometry>{}</geometry></visual></link>"""
    nothing, thin, ball = '<box size="0.0 0 0."/>', '<box size="0.1 0 0"/>', '<sphere radius="0.2"/>'
    parts = [("torso", 1, nothing, ball), ("head", 1, nothing, nothing), ("hand", 1, thin, ball)]
    links = "".join(link.format(*part) for part in [*parts, ("frame", 0.001, nothing, nothing)])
    known = link_shapes(f"<robot name='r'>{links}</robot>")
    assert [(item.link, item.shape.radius) for item in known.shapes] == [("torso", 0.2)]
    assert known.missing == {"head": "the URDF gives it no geometry", "hand": "the size of its box is not positive"}


def test_capsules_stand_near_the_true_hulls(tmp_path: Path) -> None:
    """Fitted to the UR5's inertia they tell of the same collisions most of the time; of where, they are an estimate."""
    copyfile(UR5, tmp_path / "alone.urdf")
    (tmp_path / "alone.urdf").write_text(UR5.read_text().replace("package://example-robot-data", "package://gone"))
    with pytest.raises(ScenarioError, match="nor those of 6 more links"):
        arm_geometry(make(tmp_path / "alone.urdf"))
    around = [scenario.Obstacle(type="box", size=(2, 0.1, 2), position=(0, 0.45, 0.5))]
    guess = arm_geometry(make(tmp_path / "alone.urdf", collisions="capsules"), [], around)
    true = arm_geometry(make("ur5"), [], around)

    def hits(parts: ArmGeometry, q: Array) -> bool:
        distances = parts.clearance(q[None])[0]
        return any(d <= 0 and parts.names[j] == "obstacle" for d, (_, j) in zip(distances, parts.pairs, strict=True))

    postures = np.random.default_rng(0).uniform(-np.pi, np.pi, (200, 6))
    agree = [hits(guess, q) == hits(true, q) for q in postures]
    assert np.mean(agree) > 0.9


def test_a_wall_through_the_arm_is_not_passed_in_silence(tmp_path: Path) -> None:
    """The URDF alone, its meshes nowhere: no yes through a wall around the arm's base."""
    alone = tmp_path / "my_arm.urdf"
    alone.write_text(UR5.read_text().replace("package://example-robot-data", "package://gone"))
    wall = {"type": "box", "name": "wall", "size": (0.5, 0.5, 0.4), "position": (0, 0, 0.2)}
    for collisions, answer in (("meshes", None), ("capsules", False)):
        arm = make(alone, collisions=collisions)
        if answer is None:
            with pytest.raises(ScenarioError, match="shape of base_link is not known"):
                arm_geometry(arm, [], [scenario.Obstacle(**wall)])
        else:
            assert verdict(arm, still(arm), parts=arm_geometry(arm, [], [scenario.Obstacle(**wall)])).ok is answer


def test_a_mesh_through_the_arm_is_not_passed_in_silence(tmp_path: Path) -> None:
    """The same wall as a mesh; a mesh that is not there, and one of which nothing is left, are refused."""
    import trimesh

    arm = make("ur5")
    trimesh.creation.box((0.5, 0.5, 0.4)).export(tmp_path / "wall.stl")
    wall = scenario.Obstacle(type="mesh", name="wall", file=str(tmp_path / "wall.stl"), position=(0, 0, 0.2))
    status = verdict(arm, still(arm), parts=arm_geometry(arm, [], [wall]))
    assert not status.ok
    assert "wall" in status.sentence
    aside = wall.model_copy(update={"position": (0, 0, -2.0)})
    assert verdict(arm, still(arm), parts=arm_geometry(arm, [], [aside])).ok
    (tmp_path / "wall.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    for name in ("gone.stl", "wall.obj"):
        with pytest.raises(ScenarioError, match="The obstacle wall"):
            arm_geometry(arm, [], [wall.model_copy(update={"file": str(tmp_path / name)})])


# ---- several legs, liquids ------------------------------------------------------------------------------------


def test_on_each_leg_what_is_then_carried_is_compared_with_the_obstacles() -> None:
    """A lamp that hangs into the place of the glass that is taken off at the end of the first leg: it is in the way
    there, and no longer when the second leg begins."""
    case = scenario.load("waiters-round")
    one, two = case.each_leg[:2]
    names = [{item.name for item in leg.objects} for leg in (one, two)]
    (taken,) = names[0] - names[1]
    problem = transport_problem(one, passing=True)
    q = ends(problem, np.random.default_rng(0), few=1)[0].goal
    body = next(body for body in problem.items if body.name == taken)
    place, _ = problem.arm.object_pose(q, body.p_EB, body.R_EB)
    lamp = {"type": "sphere", "name": "lamp", "radius": 0.01, "position": tuple(place + np.array([0, 0, 0.05]))}
    touches = [
        transport_problem(leg.with_changes(obstacles=[lamp]), passing=True).keep_out.parts.first_touch(q[None])
        for leg in (one, two)
    ]
    assert touches[0] is not None
    assert {touches[0].first, touches[0].second} == {taken, "lamp"}
    assert touches[1] is None


def test_a_round_says_first_what_any_of_its_legs_says() -> None:
    """What nobody looked at at the stops, what no model knows of a liquid, and what a leg's arm was not checked for."""
    case = scenario.load("panda-coffee")
    motion = case.motion
    line = min_jerk_line(1.0, motion.start.position, motion.goal.position, motion.start.rotation, motion.goal.rotation)
    told = Status("follows", "ur5 follows.", True, {"unchecked": ["jerk of all joints (nobody gave a limit)"]})
    liquid = Plan(case, "fastest", line, Status("optimal", "", True))
    arm = Plan(scenario.load("panda-cube"), "fastest", line, Status("optimal", "", True), arm_status=told)
    unmodelled = case.payload.unmodelled
    assert len(unmodelled) == 1
    assert liquid.unchecked[:1] == unmodelled
    assert arm.unchecked == ("jerk of all joints (nobody gave a limit)", *arm.unshaken)
    both = MultiLegPlan(case, (liquid, arm), Status("optimal", "", True)).unchecked
    assert both[0].startswith("what happens at the stops")
    assert set(both[1:]) == {*liquid.unchecked, *arm.unchecked}


# ---- pairs ----------------------------------------------------------------------------------------------------


FOLDED = np.array([0.0, -1.2, 2.9, 0.0, 1.57, 0.0])  # the wrist beside the upper arm


def test_an_srdf_leaves_pairs_out_and_that_is_told(tmp_path: Path) -> None:
    arm = make("ur5")
    parts = arm_geometry(arm)
    q = next(
        q
        for q in np.random.default_rng(1).uniform(-np.pi, np.pi, (500, 6))
        if (touch := parts.first_touch(q[None])) and {touch.first, touch.second} == {"shoulder_link", "forearm_link"}
    )
    srdf = tmp_path / "arm.srdf"
    srdf.write_text(
        '<robot name="ur5"><disable_collisions link1="forearm_link" link2="shoulder_link" reason="Never"/>'
        '<disable_collisions link1="gripper" link2="forearm_link" reason="Never"/></robot>'
    )
    blind = make("ur5", srdf=str(srdf))
    told = verdict(blind, still(blind))
    assert told.details["pairs_left_out"]["srdf"] == [("shoulder_link", "forearm_link")]
    assert "1 pairs of links that the SRDF disables" in told.sentence
    assert not verdict(arm, still(arm, q)).ok
    pairs = {(parts.names[i], parts.names[j]) for i, j in parts.pairs}
    kept = arm_geometry(blind)
    assert {(kept.names[i], kept.names[j]) for i, j in kept.pairs} == pairs - {("shoulder_link", "forearm_link")}


BALLS = """<robot name="balls">
  <link name="a"><collision><geometry><sphere radius="0.2"/></geometry></collision></link>
  <link name="b"><collision><geometry><sphere radius="0.01"/></geometry></collision></link>
  <link name="c"><collision><geometry><sphere radius="0.2"/></geometry></collision></link>
  <link name="d"><collision><geometry><sphere radius="0.01"/></geometry></collision></link>
  {joints}</robot>"""

JOINT = """<joint name="{a}{b}" type="revolute"><parent link="{a}"/><child link="{b}"/><origin xyz="{x} 0 0"/>
  <axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint>"""


def test_hulls_that_always_overlap_are_left_out_by_name(tmp_path: Path) -> None:
    """Balls of 0.2 m about a and c, which are never farther apart than 0.2 m."""
    joints = "".join(JOINT.format(a=a, b=b, x=x) for a, b, x in (("a", "b", 0.1), ("b", "c", 0.1), ("c", "d", 0.9)))
    path = tmp_path / "balls.urdf"
    path.write_text(BALLS.format(joints=joints))
    arm = load_arm(scenario.Arm(model=str(path), flange="d"), scenario.Tray(height=0.5))
    parts = arm_geometry(arm)
    assert parts.left_out["always"] == [("a", "c")]
    assert "a against c (their hulls overlap in every posture)" in parts.unchecked
    assert verdict(arm, still(arm, np.zeros(3)), parts=parts).sentence.count("a against c") == 1


def test_a_pair_that_is_said_not_to_be_compared_is_not(tmp_path: Path) -> None:
    """c has a knob too, that a's ball touches in some postures only. These links are drawn so, and are not compared at
    all; of the tray, which lies in the ball of c, the knob still is."""
    knob = '<collision><origin xyz="0.3 0 0"/><geometry><sphere radius="0.05"/></geometry></collision></link>'
    joints = "".join(JOINT.format(a=a, b=b, x=x) for a, b, x in (("a", "b", 0.1), ("b", "c", 0.1), ("c", "d", 0.01)))
    text = BALLS.format(joints=joints)
    second = text.index("</link>", text.index('name="c"'))
    path = tmp_path / "balls.urdf"
    path.write_text(text[:second] + knob + text[second + len("</link>") :])
    parts = arm_geometry(load_arm(scenario.Arm(model=str(path), flange="d"), scenario.Tray(height=0.15)))
    blind = {pair for pairs in parts.left_out.values() for pair in pairs}
    compared = {(parts.names[i], parts.names[j]) for i, j in parts.pairs}
    assert ("a", "c") in blind - compared
    assert blind & compared == {("c", "tray")}
    assert "a against tray, a part of c against tray (their hulls overlap in every posture)" in parts.unchecked[0]


# ---- said first, wherever a plan speaks -----------------------------------------------------------------------


@pytest.mark.slow
def test_a_plan_says_first_what_was_not_checked(tmp_path: Path) -> None:
    """In plan.json, in words and on the page; without the arm it says that arm and obstacles were not looked at."""
    cube = scenario.load("panda-cube").with_changes(
        obstacles=[{"type": "sphere", "name": "lamp", "radius": 0.05, "position": (0.5, 0.0, 1.2)}]
    )
    with_arm = make_plan(cube)
    with_arm.save(tmp_path)
    told, shake = "links that share a joint against one another", unshaken()
    assert json.loads((tmp_path / "plan.json").read_text())["unchecked"] == [told, shake]
    run = read_run(tmp_path)
    assert words.verdict(run).detail == f"Not checked: {told}; {shake}."
    assert words.asked(run).count("clear of the lamp") == 1
    scene = replay_scene(run, load_arm(cube.arm, cube.tray))  # type: ignore[arg-type]
    assert [mesh["name"] for mesh in scene["obstacles"]] == ["lamp"]
    alone = make_plan(cube, arm=False)
    assert alone.unchecked == (
        "whether the arm can follow (planned without it)",
        "whether anything hits an obstacle (planned without an arm)",
        shake,
    )
    assert make_plan(cube.with_changes(arm=None)).unchecked == (
        "whether anything hits an obstacle (planned without an arm)",
        shake,
    )
    bare = cube.with_changes(arm=None, obstacles=None)
    assert make_plan(bare).unchecked == (shake,)
    still = bare.with_changes(contact__condition="exact", uncertainty__shake={"frequency": 20.0})
    assert make_plan(still).unchecked == ()


@pytest.mark.slow
def test_links_without_visual_meshes_are_drawn_as_they_are_checked(tmp_path: Path) -> None:
    """The arm whose meshes are nowhere stands on the page as its capsules, where the true links are."""
    alone = tmp_path / "my_arm.urdf"
    alone.write_text(UR5.read_text().replace("package://example-robot-data", "package://gone"))
    drawn = {m.name: m for m in link_meshes(make(alone, collisions="capsules"))}
    assert set(drawn) >= {"upper_arm_link", "forearm_link", "wrist_3_link"}
    true = [m for m in link_meshes(make("ur5")) if m.name == "forearm_link"]
    middle = np.mean([m.vertices.mean(axis=0) for m in true], axis=0)
    assert np.linalg.norm(drawn["forearm_link"].vertices.mean(axis=0) - middle) < 0.12
    moved = make("ur5", base_position=(1.0, 2.0, 0.3))
    base = next(m for m in link_meshes(moved) if m.name == "base_link")
    assert base.joint == 0
    assert base.vertices.mean(axis=0) == pytest.approx([1.0, 2.0, 0.34], abs=0.05)
