"""The arm model against hand-computed answers, finite differences and the laws of mechanics."""

import numpy as np
import pytest

from salver import scenario
from salver.errors import ScenarioError
from salver.geometry import GRAVITY_S, exp, log, vee
from salver.models.arm.arm import load_arm
from salver.models.arm.arm_geometry import arm_geometry
from salver.models.arm.known_arms import KNOWN_ARMS
from salver.models.contact.contact import support_contacts
from sampled_sets import object_jacobian

ARMS = sorted(KNOWN_ARMS)


def make(name="panda", tray=None, **keys):
    return load_arm(scenario.Arm(model=name, **keys), tray or scenario.Tray())


def random_state(arm, rng):
    low, high = np.maximum(arm.limits.q_min, -np.pi), np.minimum(arm.limits.q_max, np.pi)
    return rng.uniform(low, high), rng.normal(size=arm.n)


@pytest.fixture(params=ARMS)
def arm(request):
    return make(request.param, base_position=(0.1, -0.2, 0.3), base_rpy_deg=(0, 0, 30))


# ---- kinematics by hand ---------------------------------------------------------------------------------------


def test_panda_at_zero_by_hand():
    """Straight up: 0.333 + 0.316 + 0.384 m, then 0.088 m forward and 0.107 m down to the flange, z down."""
    p, rotation = make().tray_pose(np.zeros(7))
    assert p == pytest.approx([0.088, 0, 0.333 + 0.316 + 0.384 - 0.107 - 0.05], abs=1e-12)
    assert rotation == pytest.approx(np.diag([1.0, -1.0, -1.0]), abs=1e-12)


def test_panda_bent_at_the_elbow_by_hand():
    """q4 = -90 degrees: the forearm, (-0.0825, 0.384) from the elbow, turns forward to (0.384, 0.0825) in x, z;
    q6 = 90 degrees makes the flange point down again. q1 = 90 degrees turns all of it to the left."""
    q = np.array([np.pi / 2, 0, 0, -np.pi / 2, 0, np.pi / 2, 0])
    p, rotation = make().tray_pose(q)
    forward = 0.0825 + 0.384 + 0.088
    assert p == pytest.approx([0, forward, 0.333 + 0.316 + 0.0825 - 0.107 - 0.05], abs=1e-12)
    assert rotation[:, 2] == pytest.approx([0, 0, -1], abs=1e-12)


def test_ur10_stretched_out_by_hand():
    """All links along x, 0.612 + 0.5723 m; the tool points along y: 0.0922 m to the flange, 0.05 m to the tray."""
    p, rotation = make("ur10").tray_pose(np.zeros(6))
    assert p == pytest.approx([1.1843, 0.220941 - 0.1719 + 0.1149 + 0.0922 + 0.05, 0.1273 - 0.1157], abs=1e-6)
    assert rotation[:, 2] == pytest.approx([0, 1, 0], abs=1e-9)


def test_paper_start_posture_puts_the_cube_where_the_paper_says():
    cube = scenario.load("panda-cube")
    arm = load_arm(cube.arm, cube.tray)
    p, rotation = arm.object_pose(np.array(cube.arm.start_posture), np.array([0, 0, 0.02]), np.eye(3))
    assert p == pytest.approx(cube.motion.start.position, abs=2e-6)
    assert np.linalg.norm(log(rotation)) < 1e-5


def test_base_pose_moves_everything():
    q = np.array([0.3, -0.4, 0.5, -1.2, 0.7, 1.5, -0.2])
    p0, R0 = make().tray_pose(q)
    p, rotation = make(base_position=(1, 2, 3), base_rpy_deg=(0, 0, 90)).tray_pose(q)
    assert p == pytest.approx([1 - p0[1], 2 + p0[0], 3 + p0[2]], abs=1e-12)
    assert rotation == pytest.approx(exp(np.array([0, 0, np.pi / 2])) @ R0, abs=1e-12)


def test_an_arm_on_a_wall_and_one_that_hangs():
    """Out of a wall along x, turned by 90 degrees about y, the arm's z is the room's x and its x points down; from a
    ceiling, rolled by 180 degrees about x, its y and z are reversed."""
    q = np.array([0.3, -0.4, 0.5, -1.2, 0.7, 1.5, -0.2])
    (x, y, z), R0 = make().tray_pose(q)
    p, rotation = make(base_position=(1, 2, 3), base_rpy_deg=(0, 90, 0)).tray_pose(q)
    assert p == pytest.approx([1 + z, 2 + y, 3 - x], abs=1e-12)
    assert rotation == pytest.approx(np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]]) @ R0, abs=1e-12)
    p, rotation = make(base_position=(1, 2, 3), base_rpy_deg=(180, 0, 0)).tray_pose(q)
    assert p == pytest.approx([1 + x, 2 - y, 3 - z], abs=1e-12)
    assert rotation == pytest.approx(np.diag([1, -1, -1]) @ R0, abs=1e-12)


# ---- derivatives ----------------------------------------------------------------------------------------------


def central(f, x, direction, h=1e-6):
    return (f(x + h * direction) - f(x - h * direction)) / (2 * h)


def test_body_jacobian_is_the_derivative_of_the_pose(arm):
    rng = np.random.default_rng(1)
    for _ in range(5):
        q, dq = random_state(arm, rng)
        _, rotation = arm.tray_pose(q)
        v_S = central(lambda x: arm.tray_pose(x)[0], q, dq)
        omega = vee(rotation.T @ central(lambda x: arm.tray_pose(x)[1], q, dq))
        assert arm.body_jacobian(q) @ dq == pytest.approx([*(rotation.T @ v_S), *omega], abs=1e-8)


def test_drift_is_the_rate_of_the_jacobian_along_the_motion(arm):
    rng = np.random.default_rng(2)
    for _ in range(5):
        q, dq = random_state(arm, rng)
        assert arm.drift(q, dq) == pytest.approx(central(arm.body_jacobian, q, dq) @ dq, abs=1e-7)


def test_acceleration_of_the_tray_from_its_path(arm):
    """p'' = R (V'_lin + omega x v) with V' = J ddq + dJ dq, against second differences of the path."""
    rng = np.random.default_rng(3)
    q, dq = random_state(arm, rng)
    ddq = rng.normal(size=arm.n)
    h = 1e-4
    path = [arm.tray_pose(q + t * dq + 0.5 * t**2 * ddq)[0] for t in (-h, 0.0, h)]
    measured = (path[0] - 2 * path[1] + path[2]) / h**2
    jacobian = arm.body_jacobian(q)
    rate, (v, omega) = jacobian @ ddq + arm.drift(q, dq), np.split(jacobian @ dq, 2)
    assert arm.tray_pose(q)[1] @ (rate[:3] + np.cross(omega, v)) == pytest.approx(measured, abs=1e-5)


# ---- contacts: eqs (21) and (24) ------------------------------------------------------------------------------


def placement():
    return np.array([0.03, -0.02, 0.06]), exp(np.array([0.0, 0.0, 0.4]))


def test_fundamental_grasp_constraint(arm):
    rng = np.random.default_rng(4)
    contacts = support_contacts([[0.02, 0.02, -0.06], [-0.02, 0.02, -0.06], [0, -0.03, -0.06]], 0.4)
    p_EB, R_EB = placement()
    for _ in range(3):
        q, dq = random_state(arm, rng)
        twist = object_jacobian(arm, q, p_EB, R_EB) @ dq
        velocities = contacts.grasp_matrix.T @ twist
        _, R_SB = arm.object_pose(q, p_EB, R_EB)
        for i, p_BC in enumerate(contacts.p_BC):
            point = central(lambda x, p=p_BC: arm.object_pose(x, p_EB + R_EB @ p, R_EB)[0], q, dq)
            assert velocities[3 * i : 3 * i + 3] == pytest.approx(R_SB.T @ point, abs=1e-8)


def test_contact_weight_loads_the_joints_like_a_heavier_tray():
    """J_c^T F_c of a resting cube equals the gravity torque that its mass adds to the model."""
    q = np.array(scenario.load("panda-cube").arm.start_posture)
    arm = make()
    mass, height = 0.256, 0.02
    contacts = support_contacts(0.02 * np.array([[1, 1, -1], [-1, 1, -1], [-1, -1, -1], [1, -1, -1]]), 0.5)
    p_EB = np.array([0, 0, height])
    _, R_SB = arm.object_pose(q, p_EB, np.eye(3))
    weight_B = np.array([*(-R_SB.T @ (mass * GRAVITY_S)), 0, 0, 0])
    forces = np.linalg.pinv(contacts.grasp_matrix) @ weight_B
    assert forces.reshape(4, 3)[:, 2] == pytest.approx(mass * 9.81 / 4, rel=1e-4)
    jacobian = object_jacobian(arm, q, p_EB, np.eye(3))
    load = (contacts.grasp_matrix.T @ jacobian).T @ forces
    assert load == pytest.approx(-jacobian[:3].T @ R_SB.T @ (mass * GRAVITY_S), abs=1e-12)


# ---- dynamics -------------------------------------------------------------------------------------------------


def test_mass_matrix_and_bias_belong_together(arm):
    """What the joints are given as power is what their energy gains: the work of C dq - half of dM/dt dq is none."""
    rng = np.random.default_rng(5)
    q, dq = random_state(arm, rng)
    mass, coriolis = arm.mass_matrix(q), arm.bias(q, dq) - arm.gravity(q)
    assert mass == pytest.approx(mass.T, abs=0)
    assert np.linalg.eigvalsh(mass)[0] > 0
    assert dq @ coriolis == pytest.approx(0.5 * dq @ central(arm.mass_matrix, q, dq) @ dq, abs=1e-6)
    ddq = rng.normal(size=arm.n)
    assert arm.inverse_dynamics(q, dq, ddq) == pytest.approx(mass @ ddq + arm.bias(q, dq), abs=1e-9)


def test_tray_adds_its_weight_and_the_hand_is_gone():
    q = np.array([0.3, -0.4, 0.5, -1.2, 0.7, 1.5, -0.2])
    tray = scenario.Tray(mass=0.7, inertia=(1e-3, 2e-3, 2.5e-3), height=0.06, thickness=0.02)
    loaded, bare = make(tray=tray), make(tray=scenario.Tray(mass=0.0, inertia=(0, 0, 0), height=0.06))
    at_com = np.array([0, 0, -0.01])
    jacobian = object_jacobian(bare, q, at_com, np.eye(3))
    _, rotation = bare.tray_pose(q)
    weight = -jacobian[:3].T @ rotation.T @ (0.7 * GRAVITY_S)
    assert loaded.gravity(q) - bare.gravity(q) == pytest.approx(weight, abs=1e-12)
    spatial = np.diag([0.7, 0.7, 0.7, 1e-3, 2e-3, 2.5e-3])
    assert loaded.mass_matrix(q) - bare.mass_matrix(q) == pytest.approx(jacobian.T @ spatial @ jacobian, abs=1e-12)
    assert bare.link_names[-1] == "panda_link8"
    assert not any("hand" in frame.name or "finger" in frame.name for frame in bare.pin_model.frames)


# ---- other URDFs ----------------------------------------------------------------------------------------------


PENDULUM = """<robot name="pendulum">
  <link name="base"/>
  <link name="rod"><inertial><mass value="2"/><origin xyz="0 0 -0.5"/>
    <inertia ixx="0.1" iyy="0.1" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="plate"/><link name="gripper"/><link name="flag"/>
  <joint name="swing" type="continuous"><parent link="base"/><child link="rod"/><axis xyz="1 0 0"/></joint>
  <joint name="end" type="fixed"><parent link="rod"/><child link="plate"/><origin xyz="0 0 -1"/></joint>
  <joint name="grip" type="prismatic"><parent link="plate"/><child link="gripper"/><axis xyz="1 0 0"/>
    <limit lower="0" upper="1" effort="1" velocity="1"/></joint>
  <joint name="wave" type="revolute"><parent link="base"/><child link="flag"/><axis xyz="1 0 0"/>
    <limit lower="0" upper="1" effort="1" velocity="1"/></joint>
</robot>"""


def test_any_urdf_with_its_gripper_left_off_and_side_joints_fixed(tmp_path):
    path = tmp_path / "pendulum.urdf"
    path.write_text(PENDULUM)
    arm = make(str(path), scenario.Tray(mass=0, height=0.0, inertia=(0, 0, 0)), flange="plate")
    assert arm.joint_names == ("swing",)
    assert arm.link_names == ("base", "rod", "plate")
    assert arm.gravity(np.array([0.3])) == pytest.approx(2 * 9.81 * 0.5 * np.sin(0.3))
    for unknown in (arm.limits.velocity, arm.limits.torque, arm.limits.jerk):
        assert np.isinf(unknown).all()
    assert [arm.limits.q_min[0], arm.limits.q_max[0]] == pytest.approx([-2 * np.pi, 2 * np.pi])
    assert arm.tray_pose(np.array([np.pi / 2]))[0] == pytest.approx([0, 1, 0], abs=1e-12)


def test_clearance_gradient_by_differences():
    """All but a few of the pairs: where faces meet faces the nearest points jump, and with them the derivative."""
    cube = scenario.load("panda-cube")
    around = [
        scenario.Obstacle(type="sphere", radius=0.1, position=(0.6, 0, 0.4)),
        scenario.Obstacle(type="capsule", radius=0.05, length=0.3, position=(0.4, 0.2, 0.4)),
    ]
    arm = load_arm(cube.arm, cube.tray)
    parts = arm_geometry(arm, cube.payload.bodies, around)
    q = np.random.default_rng(0).uniform(np.maximum(arm.limits.q_min, -2), np.minimum(arm.limits.q_max, 2), (10, 7))
    distances = parts.clearance(q)
    node, pair = (index.ravel() for index in np.indices(distances.shape))
    gradient = parts.clearance_gradient(q, node, pair).reshape(*distances.shape, arm.n)
    measured = np.stack([central(parts.clearance, q, e[None], 1e-5) for e in np.eye(7)], axis=-1)
    wrong = np.abs(gradient - measured).max(axis=-1)
    assert np.quantile(wrong, 0.95) < 1e-8
    assert wrong.max() < 0.1
    overlapping = distances < -1e-3
    assert overlapping.any()
    assert wrong[overlapping].max() < 1e-6


@pytest.mark.parametrize(
    ("text", "keys", "words"),
    [
        (None, {"model": "pandaa"}, ["pandaa", "panda, ur10,", "xarm7"]),
        (None, {"model": "nowhere.urdf", "flange": "x"}, ["nowhere.urdf", "no such file"]),
        ("<robot", {"flange": "plate"}, ["cannot be read", "XML"]),
        ("<world/>", {"flange": "plate"}, ["no robot", "<world>"]),
        (PENDULUM, {}, ["arm.flange is missing"]),
        (PENDULUM, {"flange": "plat"}, ["plat", "base, flag, gripper, plate, rod"]),
        (PENDULUM, {"flange": "base"}, ["0 degrees of freedom"]),
        (PENDULUM.replace('type="fixed"', 'type="floating"'), {"flange": "plate"}, ["7 degrees of freedom"]),
        (PENDULUM.replace('type="fixed"', 'type="strange"'), {"flange": "plate"}, ["cannot be used"]),
        (PENDULUM.replace('lower="0"', 'lower="2.5"'), {"flange": "gripper"}, ["grip", "goes from 2.5 to 1;"]),
        (PENDULUM.replace('lower="0" upper="1"', ""), {"flange": "gripper"}, ["grip", "goes from 0 to 0;"]),
    ],
)
def test_mistakes_are_one_sentence(tmp_path, text, keys, words):
    if text is not None:
        path = tmp_path / "robot.urdf"
        path.write_text(text)
        keys = {"model": str(path), **keys}
    with pytest.raises(ScenarioError) as error:
        load_arm(scenario.Arm(**keys), scenario.Tray())
    message = str(error.value)
    assert all(word in message for word in words), message
    assert message.endswith(".")
    assert "\n" not in message
