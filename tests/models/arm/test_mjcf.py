"""Arms from MJCF files: what MuJoCo says of them, and the same arm as a URDF."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np
import pytest
import trimesh

from salver import scenario
from salver.errors import MissingDependencyError, ScenarioError
from salver.geometry import matrix_from_rpy
from salver.models.arm.arm import ArmModel, load_arm
from salver.models.arm.arm_geometry import arm_geometry
from salver.models.arm.known_arms import KNOWN_ARMS, robot_file
from salver.models.arm.tables import Arm
from salver.models.arm.urdf import read_chain
from salver.models.described import Tray
from salver.planning.make import make_plan
from salver.planning.plan import load_plan
from salver.simulation.physics import simulate

WEIGHTLESS_TRAY = Tray(mass=0.0, inertia=(0.0, 0.0, 0.0))

SCENE = """<mujoco model="a cell">
  <include file="arm.xml"/>
  <worldbody>
    <geom name="ground" type="plane" size="0 0 0.05"/>
    <geom name="shelf" type="box" size="0.2 0.3 0.1" pos="-0.5 0.1 0.1"/>
    <body name="cube" pos="0.5 0 0.1"><freejoint/><geom type="box" size="0.02 0.02 0.02"/></body>
  </worldbody>
</mujoco>"""
ARM = """<mujoco model="arm">
  <compiler angle="degree" autolimits="true"/>
  <default>
    <default class="arm">
      <joint axis="0 1 0" range="-170 170"/>
      <geom type="capsule" density="700"/>
      <default class="look"><geom contype="0" conaffinity="0" mass="0"/></default>
      <default class="wrist"><joint range="-120 100"/></default>
    </default>
  </default>
  <worldbody>
    <body name="base" pos="0.1 0.2 0.3" euler="0 10 30" childclass="arm">
      <geom type="cylinder" size="0.08 0.05"/>
      <body name="turret" pos="0 0 0.1">
        <joint name="pan" axis="0 0 1"/>
        <geom fromto="0 0 0 0 0 0.3" size="0.06"/>
        <body name="upper" pos="0 0.1 0.3" axisangle="0 1 0 90">
          <joint name="lift" pos="0 0.02 0.03" axis="0 2 0.5"/>
          <geom fromto="0 0 0 0 0 0.4" size="0.05"/>
          <geom class="look" type="sphere" size="0.3"/>
          <body name="fore" pos="0 -0.1 0.4">
            <inertial pos="0.01 0.02 0.15" mass="2.5" fullinertia="0.03 0.02 0.025 0.001 -0.002 0.003"/>
            <joint name="elbow" pos="0.01 0 -0.02"/>
            <joint name="roll" class="wrist" pos="0 0 0.1" axis="0 0 1"/>
            <geom type="ellipsoid" size="0.05 0.06 0.15" pos="0 0 0.15"/>
            <body name="hand" pos="0 0 0.35" xyaxes="0 1 0 0 0 1">
              <joint name="reach" type="slide" axis="1 0 0" range="-0.05 0.2"/>
              <geom type="box" size="0.04 0.05 0.02"/>
              <body name="tip" pos="0.05 0 0">
                <joint name="turn" class="wrist" axis="1 0 0"/>
                <geom type="sphere" size="0.03"/>
                <site name="plate" pos="0.06 0 0.01" zaxis="1 0 0"/>
              </body>
              <body name="left" pos="0 0.02 0"><joint name="left" type="slide" range="0 0.02"/>
                <geom type="box" size="0.01 0.01 0.01"/></body>
              <body name="right" pos="0 -0.02 0"><joint name="right" type="slide" range="0 0.02" ref="0.01"/>
                <geom type="box" size="0.01 0.01 0.01"/></body>
            </body>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <equality><joint joint1="left" joint2="right"/></equality>
  <actuator>
    <position joint="pan" forcerange="-150 150" kp="1000"/>
    <motor joint="lift" gear="50" ctrllimited="true" ctrlrange="-2 2"/>
    <position joint="elbow" gear="2" forcerange="-40 60" kp="1000"/>
  </actuator>
</mujoco>"""
JOINTS = ["pan", "lift", "elbow", "roll", "reach", "turn"]


def written(folder: Path, arm: str = ARM) -> str:
    (folder / "arm.xml").write_text(arm)
    (folder / "scene.xml").write_text(SCENE)
    return str(folder / "scene.xml")


def loaded(path: str, flange: str = "plate") -> ArmModel:
    return load_arm(Arm(model=path, flange=flange), WEIGHTLESS_TRAY)


def test_the_arm_moves_and_weighs_as_in_mujoco(tmp_path: Path) -> None:
    """Poses, masses and gravity, of joints with and without an anchor, two on one body, hinges and a slide."""
    path = written(tmp_path)
    arm, model = loaded(path), mujoco.MjModel.from_xml_path(path)
    data = mujoco.MjData(model)
    assert list(arm.joint_names) == JOINTS
    places = [model.joint(name).qposadr[0] for name in JOINTS]
    dofs = [model.joint(name).dofadr[0] for name in JOINTS]
    rng = np.random.default_rng(3)
    for _ in range(5):
        q = rng.uniform(arm.limits.q_min, arm.limits.q_max)
        data.qpos[:], data.qvel[:] = model.qpos0, 0.0
        data.qpos[places] = q
        mujoco.mj_forward(model, data)
        p, R = arm.link_pose(q, "plate")
        site = data.site("plate")
        np.testing.assert_allclose(p, site.xpos, atol=1e-9)
        np.testing.assert_allclose(R, site.xmat.reshape(3, 3), atol=1e-9)
        # What hangs on the hand beside the chain is part of it, fixed at zero; the link between two joints of a body
        # has a millionth of its mass.
        full = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, full)
        np.testing.assert_allclose(arm.mass_matrix(q), full[np.ix_(dofs, dofs)], atol=1e-5)
        np.testing.assert_allclose(arm.gravity(q), data.qfrc_bias[dofs], atol=1e-4)


def test_its_ranges_and_torques_are_those_of_joints_and_actuators(tmp_path: Path) -> None:
    limits = loaded(written(tmp_path)).limits
    np.testing.assert_allclose(np.rad2deg(limits.q_min[[0, 3]]), [-170, -120])
    np.testing.assert_allclose([limits.q_min[4], limits.q_max[4]], [-0.05, 0.2])
    np.testing.assert_allclose(limits.torque, [150, 100, 80, np.inf, np.inf, np.inf])
    assert np.all(np.isinf(limits.velocity))


def test_its_shapes_are_the_geoms_that_touch(tmp_path: Path) -> None:
    """Neither the plane nor the free cube nor a sphere that only looks; the shelf of the scene does."""
    geometry = arm_geometry(loaded(written(tmp_path)), (), ())
    assert {"world", "base", "turret", "upper", "fore", "hand", "tip"} <= set(geometry.names)
    assert "cube" not in geometry.names
    assert geometry.names.count("upper") == 1
    compared = {frozenset((geometry.names[i], geometry.names[j])) for i, j in geometry.pairs}
    assert {frozenset(("world", "hand")), frozenset(("turret", "hand"))} <= compared


def test_nothing_is_printed_of_capsules(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Pinocchio's parser complains of each; they are compared all the same."""
    arm = loaded(written(tmp_path))
    assert "<capsule" in arm.urdf
    assert capfd.readouterr().err == ""


def test_a_signed_distance_has_no_known_shape(tmp_path: Path) -> None:
    """It was left out, and the verdict said nothing of it."""
    radii = '<config key="radius1" value="0.05"/><config key="radius2" value="0.02"/>'
    plugin = f'<extension><plugin plugin="mujoco.sdf.torus"><instance name="t">{radii}</instance></plugin></extension>'
    mesh = '<asset><mesh name="ring"><plugin instance="t"/></mesh></asset>'
    ring = '<geom type="sdf" mesh="ring"><plugin instance="t"/></geom>'
    changed = ARM.replace("<worldbody>", f"{plugin}{mesh}<worldbody>").replace(
        '<geom type="sphere" size="0.03"/>', ring
    )
    path = written(tmp_path, changed)
    with pytest.raises(ScenarioError, match="the shape of tip is not known \\(its geometry is a <sdf>\\)"):
        arm_geometry(loaded(path), (), ())
    arm = load_arm(Arm(model=path, flange="plate", collisions="unchecked"), WEIGHTLESS_TRAY)
    assert "whether tip hits anything (shape not known)" in arm_geometry(arm, (), ()).unchecked


def test_bodies_and_joints_without_a_name_get_one_that_nothing_has(tmp_path: Path) -> None:
    """Body 4 and joint 3 have none, and others are called what these were then called."""
    changed = ARM.replace('body name="fore"', "body").replace('name="roll" ', "").replace('"turn"', '"joint_3"')
    changed = changed.replace('name="upper"', 'name="body_4"').replace('"tip"', '"body_4_"')
    arm = loaded(written(tmp_path, changed))
    assert list(arm.joint_names) == [*JOINTS[:3], "joint_3_", "reach", "joint_3"]
    assert {"body_4", "body_4_", "body_4__"} <= set(arm_geometry(arm, (), ()).names)


def test_a_number_that_is_none_writes_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """MuJoCo's warning of it went to MUJOCO_LOG.TXT where the user was. Who hears its warnings hears them again."""
    heard: list[str] = []
    mujoco.set_mju_user_warning(heard.append)
    before = mujoco.get_mju_user_warning()
    path = written(tmp_path, ARM.replace('pos="0 0.1 0.3"', 'pos="0 nan 0.3"'))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ScenarioError, match=r'xyz of <origin> in .* is "0.03 nan 0.3"; it must be 3 finite numbers'):
        loaded(path)
    after = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(None)
    assert not list(tmp_path.glob("*.TXT"))
    assert not heard
    assert after == before


@pytest.mark.parametrize("given", ["", 'refpos="0.1 0.02 0.03"', 'refpos="0.1 0.02 0.03" refquat="0.9 0.1 0.2 0.3"'])
def test_meshes_are_where_mujoco_has_them(tmp_path: Path, given: str) -> None:
    corners = np.array([[0.3, -0.2, 0.1], [1.3, -0.2, 0.1], [0.3, 0.5, 0.1], [0.5, -0.1, 0.6]])
    faces = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]
    trimesh.Trimesh(corners, faces).export(tmp_path / "wedge.obj")
    scale = "0.1 0.1 0.1" if "refquat" in given else "0.1 -0.15 0.2"
    changed = ARM.replace(
        "<worldbody>", f'<asset><mesh name="w" file="wedge.obj" scale="{scale}" {given}/></asset><worldbody>'
    )
    shape = 'type="ellipsoid" size="0.05 0.06 0.15" pos="0 0 0.15"'
    path = written(tmp_path, changed.replace(shape, 'type="mesh" mesh="w" pos="0.01 0.02 0.1" euler="10 20 30"'))
    model, urdf = mujoco.MjModel.from_xml_path(path), ElementTree.fromstring(loaded(path).urdf)
    geom = int(np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_MESH)[0])
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, model.geom_quat[geom])
    seen = model.mesh_vert @ turn.reshape(3, 3).T + model.geom_pos[geom]
    element = next(e for e in urdf.iter("collision") if e.find("geometry/mesh") is not None)
    xyz, rpy = (np.array(element.find("origin").get(key).split(), dtype=float) for key in ("xyz", "rpy"))  # type: ignore[union-attr]
    factors = np.array(element.find("geometry/mesh").get("scale").split(), dtype=float)  # type: ignore[union-attr]
    ours = (corners * factors) @ matrix_from_rpy(rpy).T + xyz
    assert np.linalg.norm(ours[:, None] - seen, axis=2).min(axis=1).max() < 1e-7


def test_a_target_that_a_hand_drags_is_no_obstacle(tmp_path: Path) -> None:
    target = '<body name="target" mocap="true"><geom type="sphere" size="0.02"/></body>'
    path = written(tmp_path, ARM.replace("</worldbody>", f"{target}</worldbody>"))
    assert "target" not in loaded(path).urdf
    with pytest.raises(ScenarioError, match="target hangs on a free or ball joint of target, or that is a mocap body"):
        loaded(path, "target")


def test_a_file_that_is_included_may_change(tmp_path: Path) -> None:
    path = written(tmp_path)
    assert loaded(path).limits.torque[0] == 150
    written(tmp_path, ARM.replace('joint="pan" forcerange="-150 150"', 'jointinparent="pan" forcerange="-70 99"'))
    os.utime(tmp_path / "arm.xml", ns=(0, 0))
    os.utime(tmp_path / "scene.xml", ns=(0, 0))
    assert loaded(path).limits.torque[0] == 70


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('<joint name="elbow" pos="0.01 0 -0.02"/>', '<joint name="elbow" ref="20"/>', "ref of the joint elbow is 0.3"),
        (
            '<joint name="elbow" pos="0.01 0 -0.02"/>',
            '<joint name="elbow" type="ball" range="0 90"/>',
            "plate hangs on a free or ball joint of tip",
        ),
        ('<joint name="pan" axis="0 0 1"/>', '<freejoint name="pan"/>', "cannot be read"),
        ('range="-0.05 0.2"', 'limited="false"', "the joint reach slides and has no range"),
        ('joint1="left" joint2="right"', 'joint1="lift" joint2="elbow"', "holds lift, which lies between"),
        (
            '<equality><joint joint1="left" joint2="right"/>',
            '<tendon><fixed name="t"><joint joint="pan" coef="1"/><joint joint="lift" coef="1"/></fixed></tendon>'
            '<equality><tendon tendon1="t"/>',
            "holds pan, which lies between",
        ),
        (
            '<equality><joint joint1="left" joint2="right"/>',
            "<worldbody><body>" + 12 * "<site/>" + '<site name="wall"/></body></worldbody>'
            '<equality><weld site1="plate" site2="wall"/>',
            "holds plate, which lies between",
        ),
        ('type="ellipsoid" size="0.05 0.06 0.15"', 'type="mesh" mesh="none"', "cannot be read"),
        ('class="look" type="sphere"', 'class="nothing" type="sphere"', "cannot be read"),
        ('name="plate"', 'name="dish"', 'arm.flange = "plate" is no link of'),
        ('forcerange="-150 150"', 'forcerange="0 150"', "torque of the joint pan is limited to one sign"),
        ("<default>\n    <default", '<include file="none.xml"/><default>\n    <default', "cannot be read"),
        (
            "<worldbody>",
            '<asset><mesh name="w" file="w.obj" scale="1 1 2" refquat="0 1 0 1"/></asset><worldbody>'
            '<body name="w"><geom type="mesh" mesh="w"/></body>',
            "the mesh w has a refquat, and a scale that differs",
        ),
    ],
)
def test_an_arm_that_cannot_be_used_is_a_sentence(tmp_path: Path, old: str, new: str, words: str) -> None:
    assert ARM.count(old) == 1
    trimesh.creation.box((0.1, 0.2, 0.3)).export(tmp_path / "w.obj")
    changed = ARM.replace(old, new)
    if 'type="ball"' in new:
        changed = changed.replace('<joint name="roll" class="wrist" pos="0 0 0.1" axis="0 0 1"/>', "")
        changed = changed.replace('<position joint="elbow" gear="2" forcerange="-40 60" kp="1000"/>', "")
    with pytest.raises(ScenarioError, match=words) as told:
        loaded(written(tmp_path, changed))
    assert str(tmp_path) in str(told.value)
    assert "\n" not in str(told.value)


def test_without_mujoco_it_is_said_how_to_get_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(
        MissingDependencyError, match=r"An arm from an MJCF needs mujoco.*pip install 'salver\[engine\]'"
    ):
        loaded(written(tmp_path))


def as_mjcf(urdf: Path, flange: str, folder: Path) -> Path:
    """The file that MuJoCo writes of a URDF."""
    root = ElementTree.fromstring(read_chain(urdf, flange).urdf)
    for link in root.iter("link"):
        for visual in link.findall("visual"):  # in formats that it does not read
            link.remove(visual)
    spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
    spec.compiler.fusestatic, spec.strippath = False, False
    spec.compile()
    path = folder / "arm.xml"
    path.write_text(spec.to_xml())
    return path


@pytest.mark.slow
def test_the_same_arm_as_urdf_and_as_mjcf_has_the_same_plan(tmp_path: Path) -> None:
    """And the load stays in the engine."""
    known = KNOWN_ARMS["ur5"]
    case = scenario.load("ur5-bottle")
    limits = {key: value for key, value in known.limits.items() if not key.startswith("q_")}
    plans: list[Any] = []
    for model in (robot_file(known), as_mjcf(robot_file(known), known.flange, tmp_path)):
        given = case.with_changes(arm__model=str(model), arm__flange=known.flange, arm__limits=limits)
        plans.append(make_plan(given, "fastest"))
    urdf, mjcf = plans
    assert mjcf.joint is not None
    assert mjcf.ok
    assert mjcf.duration == pytest.approx(urdf.duration, abs=1e-3)
    t = np.linspace(0, urdf.duration, 50)
    p = [np.array([arm.tray_pose(q)[0] for q in plan.joint.sample(t)[0]]) for plan in plans
         for arm in [load_arm(plan.scenario.arm, plan.scenario.tray)]]  # fmt: skip
    np.testing.assert_allclose(p[0], p[1], atol=1e-3)
    mjcf.save(tmp_path / "run")
    assert simulate(load_plan(tmp_path / "run")).summary["outcome"] == "holds"
