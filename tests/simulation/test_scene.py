"""The scene in MuJoCo against Pinocchio, and every frame that something is read from against a hand-made answer."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from salver import scenario as scenarios
from salver.errors import ScenarioError
from salver.geometry import exp, matrix_from_quat_wxyz, matrix_from_rpy
from salver.models.arm.arm import load_arm
from salver.models.rigid_body import spatial_inertia
from salver.models.shapes.polygons import intersection
from salver.scenario import parse
from salver.simulation.scene.elements import FOOT_RADIUS, hull_name
from salver.simulation.scene.loads import ROUND_POINTS, true_world
from salver.simulation.scene.scene import build
from salver.simulation.trace import Recorder, net_contact_wrench

G = 9.81


def paper(**changes):
    return scenarios.load("panda-cube").with_changes(**changes)


def two_objects(upper=None, lower=None):
    data = scenarios.load("panda-cube").model_dump(mode="json", exclude_none=True)
    base = {"shape": {"type": "box", "size": [0.06, 0.04, 0.03]}, "mass": 0.4, "friction": 0.5, "name": "lower"}
    top = {"shape": {"type": "box", "size": [0.04, 0.04, 0.04]}, "mass": 0.1, "friction": 0.3, "name": "upper"}
    data["objects"] = [base | (lower or {}), top | {"on": "lower"} | (upper or {})]
    return parse(data, "test")


def arm_scene(changes, parameters=None):
    scenario = paper(**changes)
    arm = load_arm(scenario.arm, scenario.tray)
    scene = build(scenario, true_world(scenario, parameters), arm)
    return scene, arm, mujoco.MjData(scene.model)


@pytest.fixture(scope="module")
def moved_base():
    return arm_scene(
        {
            "arm__base_position": [0.3, -0.2, 0.1],
            "arm__base_rpy_deg": [35.0, -70.0, 40.0],
            "surroundings__floor": "none",
        }
    )


def random_states(arm, count=20):
    rng = np.random.default_rng(3)
    for _ in range(count):
        yield rng.uniform(arm.limits.q_min, arm.limits.q_max), rng.uniform(-1, 1, arm.n) * arm.limits.velocity


def set_state(scene, data, q, dq):
    data.qpos[: scene.n], data.qvel[:] = q, 0
    data.qvel[: scene.n] = dq
    mujoco.mj_forward(scene.model, data)


def test_mass_matrix_and_bias_equal_pinocchio(moved_base):
    scene, arm, data = moved_base
    full = np.zeros((scene.model.nv, scene.model.nv))
    for q, dq in random_states(arm):
        set_state(scene, data, q, dq)
        mujoco.mj_fullM(scene.model, data, full)
        np.testing.assert_allclose(full[: arm.n, : arm.n], arm.mass_matrix(q), rtol=0, atol=1e-9)
        np.testing.assert_allclose(data.qfrc_bias[: arm.n], arm.bias(q, dq), rtol=0, atol=1e-9)
        assert not np.any(data.qfrc_passive[: arm.n])  # no damping that eq (20) does not have


def test_tray_pose_jacobian_and_its_rate_equal_pinocchio(moved_base):
    scene, arm, data = moved_base
    linear, angular = np.zeros((2, 3, scene.model.nv))
    for q, dq in random_states(arm):
        set_state(scene, data, q, dq)
        p, R = scene.tray_pose(data)
        p_pin, R_pin = arm.tray_pose(q)
        np.testing.assert_allclose(p, p_pin, atol=1e-9)
        np.testing.assert_allclose(R, R_pin, atol=1e-9)
        mujoco.mj_jac(scene.model, data, linear, angular, p, scene.tray_id)
        body = np.vstack([R.T @ linear[:, : arm.n], R.T @ angular[:, : arm.n]])
        np.testing.assert_allclose(body, arm.body_jacobian(q), rtol=0, atol=1e-9)
        mujoco.mj_jacDot(scene.model, data, linear, angular, p, scene.tray_id)
        # classical acceleration of the tray's origin for ddq = 0, from the rate of the body twist
        twist, drift = arm.body_jacobian(q) @ dq, arm.drift(q, dq)
        np.testing.assert_allclose(
            R.T @ linear[:, : arm.n] @ dq, drift[:3] + np.cross(twist[3:], twist[:3]), rtol=0, atol=1e-9
        )
        np.testing.assert_allclose(R.T @ angular[:, : arm.n] @ dq, drift[3:], rtol=0, atol=1e-9)


def test_base_pose_by_hand():
    """Panda at q = 0 without its base moved: flange at x = 0.088 m, z = 0.333 + 0.316 + 0.384 - 0.107 m, z down."""
    scene, _, data = arm_scene({"arm__base_position": [1.0, 2.0, 3.0], "arm__base_rpy_deg": [0.0, 0.0, 90.0]})
    set_state(scene, data, np.zeros(7), np.zeros(7))
    p, R = scene.tray_pose(data)
    np.testing.assert_allclose(p, [1.0, 2.088, 3.0 + 0.926 - 0.05], atol=1e-9)
    np.testing.assert_allclose(R[:, 2], [0, 0, -1], atol=1e-9)


def test_arm_limits_are_those_of_the_arm_model(moved_base):
    scene, arm, _ = moved_base
    np.testing.assert_allclose(scene.model.jnt_range[: arm.n, 0], arm.limits.q_min)
    np.testing.assert_allclose(scene.model.jnt_range[: arm.n, 1], arm.limits.q_max)


def test_tilted_tray_keeps_the_arms_mass_matrix():
    """The tray's plate is mounted askew; its inertia is where the arm model has it."""
    scene, arm, data = arm_scene({}, {"tilt_x": 0.3, "tilt_y": -0.1})
    q = np.array(paper().arm.start_posture)
    set_state(scene, data, q, np.zeros(7))
    full = np.zeros((scene.model.nv, scene.model.nv))
    mujoco.mj_fullM(scene.model, data, full)
    np.testing.assert_allclose(full[: arm.n, : arm.n], arm.mass_matrix(q), atol=1e-9)
    np.testing.assert_allclose(scene.tray_pose(data)[1], arm.tray_pose(q)[1] @ exp(np.array([0.3, -0.1, 0])), atol=1e-9)


@pytest.mark.parametrize(
    ("shape", "kind", "size"),
    [
        ({"type": "box", "size": [0.1, 0.2, 0.3]}, mujoco.mjtGeom.mjGEOM_BOX, [0.05, 0.1, 0.15]),
        ({"type": "sphere", "radius": 0.1}, mujoco.mjtGeom.mjGEOM_SPHERE, [0.1]),
        ({"type": "capsule", "radius": 0.1, "length": 0.5}, mujoco.mjtGeom.mjGEOM_CAPSULE, [0.1, 0.25]),
        ({"type": "cylinder", "radius": 0.1, "height": 0.5}, mujoco.mjtGeom.mjGEOM_CYLINDER, [0.1, 0.25]),
    ],
)
def test_an_obstacle_is_in_the_engine_as_large_as_it_is_and_where_it_is(shape, kind, size):
    place = {"position": [0.6, -0.3, 0.4], "rpy_deg": [20.0, -30.0, 110.0]}
    scene, _, data = arm_scene({"obstacles": [shape | place]})
    geom = next(scene.model.geom(k) for k in range(scene.model.ngeom) if "obstacle" in scene.model.geom(k).name)
    assert geom.type == kind
    np.testing.assert_allclose(geom.size[: len(size)], size)
    mujoco.mj_forward(scene.model, data)
    np.testing.assert_allclose(data.geom(geom.id).xpos, place["position"], atol=1e-12)
    rotation = matrix_from_rpy(np.deg2rad(place["rpy_deg"]))
    np.testing.assert_allclose(data.geom(geom.id).xmat.reshape(3, 3), rotation, atol=1e-12)


def test_object_inertia_in_the_engine():
    """M of the free joint (v in S, omega in B) against mass, centre of mass and a full inertia matrix."""
    parameters = {"mass": 0.3, "com_x": 0.003, "com_y": -0.004, "com_z": 0.01, "inertia_xy": 2e-5, "inertia_yz": -3e-5}
    scenario = paper()
    scene = build(scenario, true_world(scenario, parameters))
    data = mujoco.MjData(scene.model)
    data.qpos[3:7] = [0.9, 0.1, -0.3, 0.2]
    mujoco.mj_forward(scene.model, data)
    full = np.zeros((6, 6))
    mujoco.mj_fullM(scene.model, data, full)
    R = matrix_from_quat_wxyz(data.qpos[3:7])
    body = scene.loads[0].inertial
    assert body.mass == 0.3
    assert body.com_B.tolist() == [0.003, -0.004, 0.01]
    expected = spatial_inertia(body.phi)
    expected[:3, 3:], expected[3:, :3] = R @ expected[:3, 3:], expected[3:, :3] @ R.T
    np.testing.assert_allclose(full, expected, rtol=0, atol=1e-12)


def settled(scenario, parameters=None, gravity=(0, 0, -G), steps=600):
    """A tray that is the engine's world, under a constant gravity given in E; recorded once it rests."""
    scene = build(scenario, true_world(scenario, parameters))
    scene.model.opt.gravity[:] = gravity
    data = mujoco.MjData(scene.model)
    scene.place(data)
    mujoco.mj_step(scene.model, data, nstep=steps)
    recorder = Recorder(scene, 1)
    none = np.empty(0)
    mujoco.mj_step(scene.model, data)
    recorder.take(0.0, none, none, none, data)
    return scene, recorder.trace()


def test_contact_forces_at_rest_by_hand():
    """Centre of mass at a along x over a base 2c wide: by symmetry corner x carries (m g / 4)(1 + a x / c^2)."""
    a, c, m = 0.005, 0.02, 0.25
    scene, trace = settled(paper(), {"mass": m, "com_x": a})
    corners = scene.loads[0].outline_B
    np.testing.assert_allclose(corners[:, :2], c * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]))
    forces = trace.foot_force_B[0]
    np.testing.assert_allclose(forces[:, 2], m * G / 4 * (1 + a * corners[:, 0] / c**2), rtol=1e-4)
    np.testing.assert_allclose(forces[:, :2], 0, atol=1e-4)  # the feet sink unevenly: B tilts by some 1e-5 rad
    np.testing.assert_allclose(trace.force_X[0, 0], [0, 0, m * G], atol=1e-6)
    assert trace.touches[0, 0]


def test_contact_moment_at_rest_by_hand():
    """Offset along both axes: four feet are one too many for statics, but sum and moments are m g and its lever."""
    scene, trace = settled(paper(), {"mass": 0.25, "com_x": 0.005, "com_y": -0.002})
    forces, corners = trace.foot_force_B[0], scene.loads[0].outline_B
    np.testing.assert_allclose(forces[:, 2] @ corners[:, :2], 0.25 * G * np.array([0.005, -0.002]), rtol=1e-3)
    assert np.all(forces[:, 2] > 0)


def test_contact_forces_on_a_slope_by_hand():
    """Gravity leans to +x of E by 10 degrees: friction points to -x, and the downhill feet carry more."""
    m, angle = 0.256, np.deg2rad(10)
    scene, trace = settled(paper(), gravity=(G * np.sin(angle), 0, -G * np.cos(angle)))
    np.testing.assert_allclose(trace.force_X[0, 0], m * G * np.array([-np.sin(angle), 0, np.cos(angle)]), atol=1e-5)
    normal = trace.foot_force_B[0, :, 2]
    downhill = scene.loads[0].outline_B[:, 0] > 0
    half_difference = m * G * np.sin(angle) * 0.02 / 0.04
    np.testing.assert_allclose(normal[downhill].sum() - normal[~downhill].sum(), 2 * half_difference, rtol=1e-3)


def test_contact_force_is_told_in_the_objects_axes():
    """The same slope, the object turned by 90 degrees about z: friction to -x of E is to +y of B."""
    angle = np.deg2rad(10)
    data = scenarios.load("panda-cube").model_dump(mode="json", exclude_none=True)
    data["objects"][0]["yaw_deg"] = 90.0
    _, trace = settled(parse(data, "test"), gravity=(G * np.sin(angle), 0, -G * np.cos(angle)))
    total_B = trace.foot_force_B[0].sum(axis=0)
    np.testing.assert_allclose(total_B, 0.256 * G * np.array([0, np.sin(angle), np.cos(angle)]), atol=1e-4)
    np.testing.assert_allclose(trace.force_X[0, 0], 0.256 * G * np.array([-np.sin(angle), 0, np.cos(angle)]), atol=1e-5)


def test_net_contact_wrench_under_a_stack_is_the_lower_objects_own():
    """The upper stands 1 cm off centre; what it adds from above and below cancels for the lower object."""
    scene, trace = settled(two_objects(upper={"at": [0.01, 0.0]}))
    np.testing.assert_allclose(net_contact_wrench(scene, trace)[0], [0, 0, 0.4 * G, 0, 0, 0], atol=3e-4)
    own = np.cross(scene.loads[0].outline_B, trace.foot_force_B[0, :4]).sum(axis=0)
    np.testing.assert_allclose(own, [0, -0.1 * G * 0.01, 0], atol=1e-4)  # the tray alone feels the upper's lever
    slope, yaw = np.deg2rad(10), np.deg2rad(35)
    turned = two_objects(upper={"at": [0.01, 0.0], "yaw_deg": -50.0}, lower={"yaw_deg": 35.0})
    scene, trace = settled(turned, gravity=(G * np.sin(slope), 0, -G * np.cos(slope)))
    force_B = [-np.sin(slope) * np.cos(yaw), np.sin(slope) * np.sin(yaw), np.cos(slope)]
    # Feet of a stack on a slope still give a little after 0.3 s: two ten-thousandths of the weight.
    np.testing.assert_allclose(net_contact_wrench(scene, trace)[0], 0.4 * G * np.array([*force_B, 0, 0, 0]), atol=8e-4)


def test_stack_forces_by_hand():
    """The upper of 0.1 kg rests on the lower of 0.4 kg: the tray carries both."""
    _, trace = settled(two_objects())
    np.testing.assert_allclose(trace.foot_force_B[0, 4:].sum(axis=0), [0, 0, 0.1 * G], atol=1e-6)
    np.testing.assert_allclose(trace.foot_force_B[0, :4].sum(axis=0), [0, 0, 0.5 * G], atol=1e-6)
    np.testing.assert_allclose(trace.force_X[0], [[0, 0, 0.5 * G], [0, 0, 0.1 * G]], atol=1e-6)
    assert trace.touches.all()


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("first", [0, 1, 2])
def test_what_slides_against_another_object_is_held_by_it(sign, first):
    """Three boxes in a row on a slope, two nearly without friction, 1 cm apart: they end side by side, in any order."""
    box = {"shape": {"type": "box", "size": [0.03, 0.05, 0.04]}, "mass": 0.1, "friction": 0.02}
    places = np.roll([-0.04, 0.0, 0.04], first)
    objects = [box | {"name": f"box-{k}", "at": [float(x), 0.0]} for k, x in enumerate(places)]
    lowest = int(np.argmax(sign * places))
    objects[lowest] |= {"friction": 1.0, "mass": 2.0}
    data = scenarios.load("panda-cube").model_dump(mode="json", exclude_none=True) | {"objects": objects}
    angle = np.deg2rad(15.0)
    gravity = (sign * G * np.sin(angle), 0, -G * np.cos(angle))
    _, trace = settled(parse(data, "test"), gravity=gravity)
    x = np.sort(trace.p_XB[0, :, 0])
    np.testing.assert_allclose(np.diff(x), 0.03, atol=5e-4)
    assert trace.p_XB[0, lowest, 0] == pytest.approx(sign * 0.04, abs=1e-3)


@pytest.mark.parametrize(
    "shape",
    [
        {"type": "cylinder", "radius": 0.03, "height": 0.1},
        {"type": "prism", "polygon": [[0.03, 0], [-0.02, 0.02], [-0.02, -0.02]], "height": 0.05},
    ],
)
def test_round_and_prismatic_objects_rest(shape):
    data = scenarios.load("panda-cube").model_dump(mode="json", exclude_none=True)
    data["objects"][0] |= {"shape": shape}
    data["objects"][0].pop("inertia")
    scene, trace = settled(parse(data, "test"))
    np.testing.assert_allclose(trace.force_X[0, 0], [0, 0, 0.256 * G], atol=1e-5)
    load, hull = scene.loads[0], scene.model.geom(hull_name(0))
    assert len(load.outline_B) == (ROUND_POINTS if shape["type"] == "cylinder" else 3)
    assert (hull.type == mujoco.mjtGeom.mjGEOM_CYLINDER) == (shape["type"] == "cylinder")
    assert shape["type"] == "prism" or hull.size[:2] == pytest.approx([0.03, 0.05], abs=1e-3)  # above its feet
    np.testing.assert_allclose(trace.p_XB[0, 0], load.p_EB, atol=5e-5)
    np.testing.assert_allclose(trace.R_XB[0, 0], load.R_EB, atol=1e-3)


def test_place_puts_objects_where_the_parameters_say():
    scene, arm, data = arm_scene({}, {"position_x": 0.01, "position_y": -0.02, "tilt_x": 0.02})
    q = np.array(paper().arm.start_posture)
    scene.place(data, q)
    p, R = arm.tray_pose(q)
    R = R @ exp(np.array([0.02, 0, 0]))
    np.testing.assert_allclose(data.qpos[7:10], p + R @ [0.01, -0.02, 0.02], atol=1e-9)
    np.testing.assert_allclose(matrix_from_quat_wxyz(data.qpos[10:14]), R, atol=1e-9)


@pytest.mark.parametrize("com_z", [0.0, 0.005])
def test_feet_are_at_the_base(com_z):
    """Wherever the centre of mass is, from which they are told."""
    case = paper(objects__0__com=[0.0, 0.0, com_z])
    scene = build(case, true_world(case))
    feet = scene.foot_object >= 0
    assert feet.sum() == 4
    np.testing.assert_allclose(scene.model.geom_pos[feet][:, 2], -0.02 - com_z + FOOT_RADIUS)
    np.testing.assert_array_equal(scene.foot_number[feet], range(4))


def test_a_block_across_two_others_has_feet_on_both():
    block = {"shape": {"type": "box", "size": [0.038, 0.09, 0.103]}, "mass": 0.18, "friction": 0.3}
    data = scenarios.load("panda-cube").model_dump(mode="json", exclude_none=True)
    lying = {"shape": {"type": "box", "size": [0.103, 0.09, 0.038]}, "mass": 0.18, "friction": 0.42}
    data["objects"] = [
        block | {"name": "left", "at": [-0.0325, 0]},
        block | {"name": "right", "at": [0.0325, 0]},
        lying | {"name": "top", "on": ["left", "right"]},
    ]
    scene, trace = settled(parse(data, "test"))
    top = scene.loads[2]
    assert set(top.supports) == {"left", "right"}
    # the left block reaches from x = -0.0515 (also the top's end) to -0.0135
    xs = np.unique(np.round(top.supports["left"][:, 0], 9))
    np.testing.assert_allclose(xs, [-0.0515, -0.0135])
    np.testing.assert_allclose(trace.force_X[0][:, 2], [1.5 * 0.18 * G, 1.5 * 0.18 * G, 0.18 * G], atol=1e-4)


def test_common_part_of_two_polygons_by_hand():
    square = np.array([[0.0, 0], [2, 0], [2, 2], [0, 2]])
    corner = intersection(square, square + 1)
    assert {tuple(p) for p in corner} == {(1, 1), (2, 1), (2, 2), (1, 2)}
    np.testing.assert_array_equal(intersection(square, square), square)
    assert len(intersection(square, square + 5)) == 0
    # a diamond cut by a square: eight corners
    diamond = 1.5 * np.array([[1.0, 0], [0, 1], [-1, 0], [0, -1]])
    assert len(intersection(diamond, square - 1)) == 8


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"weight": 1.0}, ['"weight"', "panda-cube", "mass"]),
        ({"mass": -1.0}, ["mass", "-1", "positive"]),
        ({"mass": float("nan")}, ["mass", "finite"]),
        ({"mass": "x"}, ["mass", "'x'", "finite"]),
        ({"friction": 0.0}, ["friction", "positive"]),
        ({"inertia_xx": 1.0}, ["inertia", "sum of the other two"]),
        ({"inertia_xx": 1e-4, "inertia_yy": 4.5e-4, "inertia_zz": 3e-4}, ["inertia", "sum of the other two"]),
        ({"inertia_xx": 0.0, "inertia_yy": 5e-12, "inertia_zz": 5e-12}, ["inertia", "at least"]),
        ({"inertia_xx": 1e-16, "inertia_yy": 1e-16, "inertia_zz": 1e-16}, ["inertia", "at least"]),
        ({"position_x": 0.5}, ["overlap", "tray"]),
    ],
)
def test_impossible_parameters_get_a_sentence(parameters, words):
    with pytest.raises(ScenarioError) as caught:
        true_world(paper(), parameters)
    for word in words:
        assert word in str(caught.value)


def test_parameters_of_several_objects_are_prefixed():
    world = true_world(two_objects(), {"upper.mass": 0.2, "lower.friction": 0.9, "tilt_y": 0.01})
    assert [load.inertial.mass for load in world.loads] == [0.4, 0.2]
    assert [load.friction for load in world.loads] == [0.9, 0.3]
    with pytest.raises(ScenarioError, match="mass"):
        true_world(two_objects(), {"mass": 0.2})


def test_of_very_many_parameters_the_first_and_the_last_are_named():
    with pytest.raises(ScenarioError) as told:
        true_world(scenarios.load("panda-four-glasses"), {"weight": 1.0})
    assert str(told.value).endswith(", ..., tilt_x, tilt_y.")
    assert str(told.value).count(", ") == 15
