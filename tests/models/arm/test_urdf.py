"""What files arms may be made of: packages, meshes, xacro; what is not an arm gets a sentence."""

from __future__ import annotations

import re
from pathlib import Path

import mujoco
import numpy as np
import pytest

from odd_arms import LINK, cell, gantry, joint, loaded
from salver import scenario
from salver.cli.checks.simulate import sentences
from salver.errors import ScenarioError
from salver.models.arm import urdf
from salver.models.arm.arm import ArmModel, load_arm, with_stand_ins
from salver.models.arm.arm_geometry import arm_geometry
from salver.models.arm.urdf import find_mesh
from salver.planning.follow.limits import unchecked, verdict
from salver.planning.make import make_plan
from salver.scenario import Scenario
from salver.scenario.warnings import warnings_of
from salver.simulation.physics import Experiment
from salver.simulation.scene.loads import true_world
from salver.simulation.scene.scene import build
from salver.trajectory import JointMotion


def test_a_name_without_end_is_not_quoted_in_full(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match="the name of <joint>") as error:
        loaded(tmp_path, gantry().replace('name="lean"', f'name="{"x" * 9999}"'))
    assert len(str(error.value)) < 400


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
        (lambda t: t.replace('<axis xyz="0 1 0"', '<axis xyz="0 0 0"', 1), ["xyz of <axis> in y", "a direction"]),
        (
            lambda t: gantry(turn="revolute").replace(
                '"0 0 1"/><limit lower="-2.0"', '"0 0 1"/><limit lower="-170"', 1
            ),
            ['lower of <limit> in turn is "-170"', "in rad, at most 62.8", "(-170 deg would be -2.967)"],
        ),
        (
            lambda t: t.replace('ixx="0.02"', 'ixx="2e7"').replace('iyy="0.02" izz="0.02"', 'iyy="2e7" izz="2e7"'),
            ["what the joint x moves, 4 kg", "2.24e+03 m from its centre", "kg m^2"],
        ),
        (lambda t: gantry(more='<safety_controller soft_lower_limit="low"/>'), ["soft_lower_limit", 'turn is "low"']),
    ],
    ids=[
        *("mimic", "two parents", "ring", "xacro", "planar", "text", "nan", "negative", "comma", "two numbers"),
        *("no axis", "degrees", "g mm^2", "soft"),
    ],
)
def test_what_is_no_arm_gets_one_sentence(tmp_path: Path, change, words: list[str]) -> None:
    with pytest.raises(ScenarioError) as refused:
        loaded(tmp_path, change(gantry()))
    message = str(refused.value)
    assert all(word in message for word in words), message
    assert "\n" not in message
    assert message.endswith(".")


def test_a_limit_that_stands_for_none_is_not_taken_for_degrees(tmp_path: Path) -> None:
    """As models of mobile bases have them: of a Fetch 999999."""
    text = gantry(turn="revolute").replace('upper="2.0"', 'upper="999999"')
    assert loaded(tmp_path, text).limits.q_max[3] == 999999.0


def test_soft_limits_stand_for_the_limits_that_they_are_within(tmp_path: Path) -> None:
    """As a robot's safety controller takes them: within the limits. Both 0 is what a URDF means that gives neither."""

    def limits(low: str, high: str, turn: str = "revolute") -> tuple[float, float]:
        soft = f'<safety_controller k_velocity="1" soft_lower_limit="{low}" soft_upper_limit="{high}"/>'
        arm = loaded(tmp_path, gantry(turn=turn, more=soft))
        return float(arm.limits.q_min[3]), float(arm.limits.q_max[3])

    assert limits("-0.2", "0.3") == (-0.2, 0.3)
    assert limits("-2.5", "1.5") == (-2.0, 1.5)
    assert limits("0", "0") == (-2.0, 2.0)
    assert limits("-0.2", "0.3", "continuous") == pytest.approx((-2 * np.pi, 2 * np.pi))


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
    assert_same_masses(case, arm, with_stand_ins(arm))


def assert_same_masses(case: Scenario, arm: ArmModel, known: ArmModel) -> None:
    scene = build(case, true_world(case), arm)
    data, q = mujoco.MjData(scene.model), np.linspace(-0.2, 0.3, arm.n)
    data.qpos[: arm.n] = q
    mujoco.mj_forward(scene.model, data)
    columns = []
    for unit in np.eye(scene.model.nv)[: arm.n]:
        column = np.zeros(scene.model.nv)
        mujoco.mj_mulM(scene.model, data, column, unit)
        columns.append(column[: arm.n])
    assert np.array(columns) == pytest.approx(known.mass_matrix(q), abs=1e-9)


@pytest.mark.parametrize(
    ("change", "link"),
    [
        (lambda t: t.replace('ixx="0.02"', 'ixx="0"').replace('iyy="0.02" izz="0.02"', 'iyy="0" izz="0"'), "beam"),
        (lambda t: t.replace('ixx="0.02"', 'ixx="0.1"', 2), "beam"),
        (lambda t: t.replace('ixx="0.02"', 'ixx="-0.1"', 2), "beam"),
    ],
    ids=["no inertia", "triangle inequality", "negative inertia"],
)
def test_a_moving_link_that_the_engine_cannot_move_is_named(tmp_path: Path, change, link: str) -> None:
    case, arm = cell(tmp_path, change(gantry())), loaded(tmp_path, change(gantry()))
    with pytest.raises(ScenarioError, match=f"cannot move the link {link} of ") as refused:
        build(case, true_world(case), arm)
    message = str(refused.value)
    assert str(arm.urdf_path) in message
    assert "needs <inertial> with a mass above 0" in message
    assert "\n" not in message


def without_masses(text: str) -> str:
    return re.sub("<inertial>.*?</inertial>", "", text, flags=re.DOTALL)


@pytest.mark.parametrize(
    "change",
    [lambda t: without_inertial(t, "pitch"), lambda t: t.replace('<mass value="4"', '<mass value="0"'), without_masses],
    ids=["one link without <inertial>", "one of 0 kg", "no link with a mass"],
)
def test_the_controller_knows_what_the_engine_moves_in_place_of_links_without_mass(tmp_path: Path, change) -> None:
    case, arm = cell(tmp_path, change(gantry())), loaded(tmp_path, change(gantry()))
    assert_same_masses(case, arm, with_stand_ins(arm))


def test_an_arm_without_masses_follows_in_the_engine_as_under_position_control(tmp_path: Path) -> None:
    """The tray is off its reference by a tenth of a millimetre, as that of the arm with masses is."""
    run = Experiment(make_plan(cell(tmp_path, without_masses(gantry())))).run()
    assert run.outcome == "holds"
    assert run.summary["tray_e_p_peak"] < 2e-4
    assert run.summary["stand_ins"] == ["beam", "post", "head", "yaw", "pitch", "roll"]
    told = "The URDF gives beam, post, head, yaw, pitch and roll no mass: each has 10 kg in the physics engine, and the"
    assert any(sentence.startswith(told) for sentence in sentences(run))


@pytest.mark.parametrize("link", ["pitch", "roll"])
def test_that_a_link_has_no_mass_is_said_before_torques_are_said_to_hold(tmp_path: Path, link: str) -> None:
    """Also of the flange, with which the tray moves; whatever torques the joints have, none is called kept."""
    arm = loaded(tmp_path, without_inertial(gantry(), link))
    told = verdict(arm, JointMotion(np.arange(2.0), *np.zeros((3, 2, arm.n)))).sentence
    assert told.startswith("Not checked: anything around the arm; joint torques, and how far the arm strays")
    assert f" gives {link} no mass: it is planned as one that follows exactly, under position control); " in told
    assert "torque of all joints" not in told
    assert np.isinf(arm.limits.torque).all()
    assert not any("torque" in told for told in warnings_of(cell(tmp_path, without_inertial(gantry(), link))))
    assert "no mass" not in "".join(unchecked(loaded(tmp_path, gantry()), arm_geometry(arm)))


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


def test_a_file_too_large_for_a_robot_is_not_read(tmp_path, monkeypatch):
    (tmp_path / "arm.urdf").write_text("<robot name='x'>" + 1000 * "<link name='a'/>" + "</robot>")
    monkeypatch.setattr(urdf, "LARGEST", 10_000)
    with pytest.raises(ScenarioError, match=r"arm\.urdf is larger than 0 MB"):
        urdf._parse(tmp_path / "arm.urdf", "a")
