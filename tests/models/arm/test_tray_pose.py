"""A tray on a bracket (`tray.offset`, `height`, `rpy_deg`) against a URDF in which the bracket is a link of its own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import trimesh

from salver import scenario
from salver.errors import ScenarioError
from salver.learning.load.identify import identify
from salver.models.arm.arm import ArmModel, load_arm
from salver.models.arm.arm_geometry import arm_geometry
from salver.models.arm.known_arms import KNOWN_ARMS, robot_file
from salver.models.described import Tray
from salver.planning.make import make_plan
from salver.sensitivity.arm.terms import motion_terms
from salver.simulation.physics import simulate
from sensed_arm import SensedArm, Sensors, nominal_load

OFFSET, HEIGHT, RPY_DEG = (0.09, -0.03), -0.04, (20.0, 75.0, -35.0)
Q = np.array([0.3, -1.2, 1.1, -0.4, 0.8, 0.5])


@pytest.fixture(scope="module")
def bracket(tmp_path_factory: pytest.TempPathFactory) -> tuple[ArmModel, ArmModel]:
    """A UR5e with the tray at a pose of its flange, and one whose URDF has a link there."""
    source = robot_file(KNOWN_ARMS["ur5e"])
    root = ElementTree.parse(source).getroot()
    for mesh in root.iter("mesh"):
        mesh.set("filename", str((source.parent / mesh.get("filename", "")).resolve()))
    ElementTree.SubElement(root, "link", name="bracket")
    joint = ElementTree.SubElement(root, "joint", name="bolts", type="fixed")
    ElementTree.SubElement(joint, "parent", link="tool0")
    ElementTree.SubElement(joint, "child", link="bracket")
    xyz, rpy = (" ".join(str(x) for x in values) for values in ((*OFFSET, HEIGHT), np.deg2rad(RPY_DEG)))
    ElementTree.SubElement(joint, "origin", xyz=xyz, rpy=rpy)
    path = Path(tmp_path_factory.mktemp("bracket")) / "ur5e.urdf"
    ElementTree.ElementTree(root).write(path)
    posed = scenario.Tray(offset=OFFSET, height=HEIGHT, rpy_deg=RPY_DEG, mass=0.4, inertia=(1e-3, 2e-3, 2.5e-3))
    level = posed.model_copy(update={"offset": (0.0, 0.0), "height": 0.0, "rpy_deg": (0.0, 0.0, 0.0)})
    return (
        load_arm(scenario.Arm(model="ur5e"), posed),
        load_arm(scenario.Arm(model=str(path), flange="bracket"), level),
    )


def test_tray_moves_and_weighs_as_with_a_bracket_in_the_urdf(bracket: tuple[ArmModel, ArmModel]) -> None:
    rng = np.random.default_rng(2)
    q, dq, ddq = Q + 0.3 * rng.standard_normal((5, 6)), rng.standard_normal((5, 6)), rng.standard_normal((5, 6))
    ours, theirs = (motion_terms(arm.pin_model, arm.tray_id, q, dq, ddq) for arm in bracket)
    assert ours.w == pytest.approx(theirs.w, abs=1e-9)
    assert ours.jacobian == pytest.approx(theirs.jacobian, abs=1e-9)
    assert ours.torque == pytest.approx(theirs.torque, abs=1e-9)


def test_plate_that_may_touch_is_where_the_bracket_has_it(bracket: tuple[ArmModel, ArmModel]) -> None:
    parts = [arm_geometry(arm) for arm in bracket]
    ours, theirs = (part.model.geometryObjects[part.tray] for part in parts)
    assert ours.parentJoint == theirs.parentJoint
    assert ours.placement.homogeneous == pytest.approx(theirs.placement.homogeneous, abs=1e-9)
    assert ours.geometry.halfSide == pytest.approx(theirs.geometry.halfSide)


def carried(size: list[float], **tray: object) -> scenario.Scenario:
    """A box on the tray of a UR5e."""
    return scenario.load("panda-cube").with_changes(
        arm={"model": "ur5e"},
        objects=[{"name": "cube", "shape": {"type": "box", "size": size}, "mass": 0.2, "friction": 0.5}],
        **{f"tray__{key}": value for key, value in tray.items()},
    )


UPSIDE_DOWN = (180.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("size", "tray", "link"),
    [
        ([0.04, 0.04, 0.04], {"height": 0.0, "rpy_deg": UPSIDE_DOWN}, "wrist_3_link"),
        ([0.04, 0.04, 0.2], {"height": 0.05, "rpy_deg": UPSIDE_DOWN}, "wrist_2_link"),  # whatever wrist 3 does
        ([0.01, 0.01, 0.01], {"height": -0.025}, "wrist_3_link"),  # its surface and the link's do not meet
    ],
)
def test_a_load_inside_the_wrist_is_refused(size: list[float], tray: dict[str, object], link: str) -> None:
    with pytest.raises(ScenarioError, match=f"^cube lies inside {link} in every posture; move the tray .* tray.height"):
        make_plan(carried(size, **tray), "baseline")


@pytest.mark.parametrize("tray", [{}, {"height": 0.0, "thickness": 0.001}, {"height": 0.05, "rpy_deg": UPSIDE_DOWN}])
def test_a_load_that_stands_on_the_wrist_or_before_it_is_not_inside_it(tray: dict[str, object]) -> None:
    case = carried([0.04, 0.04, 0.04], **tray)
    assert case.arm is not None
    parts = arm_geometry(load_arm(case.arm, case.tray), case.payload.bodies)
    assert not [pair for pair in parts.left_out.get("always", []) if "cube" in pair]


def test_a_load_on_a_rimmed_tray_that_is_a_link_is_not_inside_it(tmp_path: Path) -> None:
    """The hull of such a tray is full; its mesh is not."""
    rim = [
        ((0.2, 0.2, 0.01), (0, 0, -0.005)),
        ((0.01, 0.2, 0.05), (0.095, 0, 0.02)),
        ((0.01, 0.2, 0.05), (-0.095, 0, 0.02)),
    ]
    boxes = [trimesh.creation.box(size, trimesh.transformations.translation_matrix(at)) for size, at in rim]
    trimesh.util.concatenate(boxes).export(tmp_path / "tray.stl")
    path = tmp_path / "arm.urdf"
    path.write_text(f"""<robot name="arm"><link name="base"/><link name="tray"><inertial><mass value="1"/>
      <inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/></inertial>
      <collision><geometry><mesh filename="{tmp_path}/tray.stl"/></geometry></collision></link>
      <joint name="turn" type="revolute"><parent link="base"/><child link="tray"/><origin xyz="0 0 1"/>
      <axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="9" velocity="1"/></joint></robot>""")
    case = carried([0.04, 0.04, 0.04], height=0.0, thickness=0.001)
    parts = arm_geometry(load_arm(scenario.Arm(model=str(path), flange="tray"), case.tray), case.payload.bodies)
    assert parts.names == ("tray", "tray", "cube")


def test_a_load_before_a_wrist_of_fitted_capsules_is_not_refused(tmp_path: Path) -> None:
    """The capsule fitted to the wrist of a UR5e without meshes reaches 2 cm beyond its flange: that is said instead."""
    case = carried([0.04, 0.04, 0.04])
    path = tmp_path / "arm.urdf"
    path.write_text(
        robot_file(KNOWN_ARMS["ur5e"]).read_text().replace("<mesh filename=", '<mesh filename="nowhere" old=')
    )
    described = scenario.Arm(model=str(path), flange="tool0", collisions="capsules")
    parts = arm_geometry(load_arm(described, case.tray), case.payload.bodies)
    assert any("wrist_2_link against cube (their hulls overlap in every posture)" in one for one in parts.unchecked)


@pytest.mark.slow
def test_side_mount_is_planned_holds_in_the_engine_and_weighs_its_load() -> None:
    """The flange points sideways, the tray's middle is 8 cm above its axis. The wrist's log shows the load's mass."""
    case = scenario.load("ur5-bottle").with_changes(
        arm__model="ur5e",
        tray__offset=(0.02, -0.08),
        tray__height=0.03,
        tray__rpy_deg=(90.0, 0.0, 0.0),
    )
    plan = make_plan(case, "fastest")
    assert plan.ok
    arm = load_arm(case.arm, case.tray)  # type: ignore[arg-type]
    assert abs(arm.link_pose(plan.joint.q[0], arm.flange)[1][2, 2]) < 1e-3  # type: ignore[union-attr]
    nominal = plan.scenario.payload.first.inertial.mass
    mass = 1.09 * nominal
    assert simulate(plan, parameters={"mass": mass}).summary["outcome"] == "holds"
    wide = {"mass": "40%", "com": [0.01, 0.01, 0.01]}
    plan = replace(plan, scenario=plan.scenario.with_changes(objects__0__uncertainty=wide))
    sensed = SensedArm(plan, 0, Sensors(times=0.0, links=0.0, friction_change=0.0), wrist=True, joints=False)
    values = nominal_load(plan)
    load = np.concatenate([[mass], values[1:4], values[4:] * mass / values[0]])
    log = sensed.log(load)
    upwards = arm.link_pose(log.q[0], arm.flange)[1].T @ np.array([0, 0, 9.81 * (mass + case.tray.mass)])
    assert log.wrench_F[0, :3] == pytest.approx(upwards, abs=0.6)  # type: ignore[index]
    found = identify(plan, [log], sensed.log(None))
    assert found.phi[0] == pytest.approx(mass, abs=0.01)


@pytest.mark.parametrize(
    ("enough", "too_near"),
    [({"rim": {"height": 0.3}}, {"rim": {"height": 0.2}}), ({"offset": [-0.3, 0.0]}, {"offset": [-0.2, 0.0]})],
    ids=["rim", "offset"],
)
def test_a_tray_may_have_the_inertia_of_its_farthest_parts(enough: dict, too_near: dict) -> None:
    """1 kg: 0.07 kg m^2 need 0.26 m."""
    tray = {"size": [0.02, 0.02], "thickness": 0.004, "height": 0.01, "mass": 1.0, "inertia": [0.07, 0.07, 0.07]}
    assert Tray.model_validate(tray | enough).inertia == (0.07, 0.07, 0.07)
    with pytest.raises(ValueError, match="is too large: 1 kg"):
        Tray.model_validate(tray | too_near)
