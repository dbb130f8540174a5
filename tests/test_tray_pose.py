"""A tray on a bracket (`tray.offset`, `height`, `rpy_deg`) against a URDF in which the bracket is a link of its own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from salver import scenario
from salver.learning.load.identify import identify
from salver.learning.load.sensors import SensedArm, Sensors, nominal_load
from salver.models.arm.arm import ArmModel, load_arm
from salver.models.arm.arm_geometry import arm_geometry
from salver.models.arm.known_arms import KNOWN_ARMS, robot_file
from salver.planning.make import make_plan
from salver.sensitivity.arm.terms import motion_terms
from salver.simulation.physics import simulate

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


def test_side_mount_is_planned_holds_in_the_engine_and_weighs_its_load() -> None:
    """The flange points sideways, the tray's middle is 8 cm from its axis. A log of the wrist shows the load's mass."""
    case = scenario.load("ur5-bottle").with_changes(
        arm__model="ur5e",
        tray__offset=(0.02, 0.08),
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
