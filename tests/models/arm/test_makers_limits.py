"""Limits of known arms against a second source, of a URDF, and as shares."""

from dataclasses import fields

import numpy as np
import pytest

from salver import scenario
from salver.models.arm.arm import load_arm
from salver.models.arm.arm_limits import LIMITS, POSITION, JointLimits
from salver.models.arm.known_arms import KNOWN_ARMS


def make(name="panda", tray=None, **keys):
    return load_arm(scenario.Arm(model=name, **keys), tray or scenario.Tray())


FREE = np.inf  # what a maker does not publish


def published(**fields):
    """The limits of an arm; those of which nothing is said are not published."""
    return {"jerk": FREE, "torque_rate": FREE} | fields


def of_universal_robots(velocity_deg, torque):
    turns = np.deg2rad([360, 360, 180, 360, 360, 360])
    return published(q_min=-turns, q_max=turns, velocity=np.deg2rad(velocity_deg), acceleration=5, torque=torque)


def of_ufactory(q_min, q_max, torque):
    return published(q_min=q_min, q_max=q_max, velocity=np.pi, acceleration=20, torque=torque)


TURN = 2 * np.pi

# Each number again, from another place than the one that `salver.models.arm.known_arms` names; one number is that of
# all joints.
MAKERS = {
    # The crate franka_rust 0.1.15, src/franka/franka_emika.rs; positions, speeds and torques also in panda.urdf of
    # example-robot-data. Torque rate: libfranka 0.9, include/franka/rate_limiting.h.
    "panda": {
        "q_min": [-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973],
        "q_max": [2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973],
        "velocity": [2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61],
        "acceleration": [15, 7.5, 10, 12.5, 15, 20, 20],
        "jerk": [7500, 3750, 5000, 6250, 7500, 10000, 10000],
        "torque": [87, 87, 87, 87, 12, 12, 12],
        "torque_rate": 1000,
    },
    # The crate franka_rust 0.1.14, src/franka/franka_fr3.rs; mujoco_menagerie, franka_fr3/fr3.xml.
    "fr3": {
        "q_min": [-2.7437, -1.7837, -2.9007, -3.0421, -2.8065, 0.5445, -3.0159],
        "q_max": [2.7437, 1.7837, 2.9007, -0.1518, 2.8065, 4.5169, 3.0159],
        "velocity": [2.62, 2.62, 2.62, 2.62, 5.26, 4.18, 5.26],
        "acceleration": 10,
        "jerk": 5000,
        "torque": [87, 87, 87, 87, 12, 12, 12],
        "torque_rate": 1000,
    },
    # Universal_Robots_ROS2_Description, config/NAME/joint_limits.yaml, in degrees there.
    "ur3": of_universal_robots([180, 180, 180, 360, 360, 360], [56, 56, 28, 12, 12, 12]),
    "ur5": of_universal_robots(180, [150, 150, 150, 28, 28, 28]),
    "ur10": of_universal_robots([120, 120, 180, 180, 180, 180], [330, 330, 150, 56, 56, 56]),
    # mujoco_menagerie: universal_robots_ur5e/ur5e.xml and universal_robots_ur10e/ur10e.xml (positions and torques; its
    # wrists of the UR10e have 56 N m, the maker's own description 54). Speeds: the maker's pages of technical data. The
    # last joint of the UR3e turns for ever.
    "ur3e": of_universal_robots([180, 180, 180, 360, 360, 360], [54, 54, 28, 9, 9, 9]),
    "ur5e": of_universal_robots(180, [150, 150, 150, 28, 28, 28]),
    "ur10e": of_universal_robots([120, 120, 180, 180, 180, 180], [330, 330, 150, 54, 54, 54]),
    # ros2_kortex: speeds from kinova_gen3_7dof_robotiq_2f_85_moveit_config/config/joint_limits.yaml; accelerations from
    # gen3_move_it_config/config/7dof/hard_joint_limits.yaml, which has 95 % of them. Joints 1, 3, 5, 7 turn for ever.
    "gen3": published(
        q_min=[-TURN, -2.24, -TURN, -2.57, -TURN, -2.09, -TURN],
        q_max=[TURN, 2.24, TURN, 2.57, TURN, 2.09, TURN],
        velocity=[1.3963] * 4 + [1.2218] * 3,
        acceleration=np.array([4.94] * 4 + [9.5] * 3) / 0.95,
        torque=[39] * 4 + [9] * 3,
    ),
    # Positions: xarm_ros2, xarm_description/urdf/xarm6 and lite6, in rad there, to five digits; of the xArm 7
    # xarm_description/config/xarm7/joint_limits.yaml, in degrees there. Speeds: UFACTORY, product pages, 180 degrees/s.
    # Torques: xarm_ros2, xarm_description/urdf/NAME/NAME.urdf.xacro.
    "xarm6": of_ufactory(
        [-TURN, -2.059488, -3.92699, -TURN, -1.69297, -TURN],
        [TURN, 2.0944, 0.19198, TURN, np.pi, TURN],
        [50, 50, 32, 32, 32, 20],
    ),
    "lite6": of_ufactory(
        [-TURN, -2.61799, -0.061087, -TURN, -2.1642, -TURN],
        [TURN, 2.61799, 5.235988, TURN, 2.1642, TURN],
        [50, 50, 32, 32, 32, 20],
    ),
    "xarm7": of_ufactory(
        np.deg2rad([-360, -118, -360, -11, -360, -97, -360]),
        np.deg2rad([360, 120, 360, 225, 360, 180, 360]),
        [50, 50, 30, 30, 30, 20, 20],
    ),
}


@pytest.mark.parametrize("name", sorted(KNOWN_ARMS))
def test_limits_of_known_arms_are_the_makers(name):
    limits = make(name).limits
    for field, expected in MAKERS[name].items():
        found = getattr(limits, field)
        assert found == pytest.approx(np.broadcast_to(expected, found.shape), rel=1e-5, abs=2e-5), field
    assert set(MAKERS[name]) == {field.name for field in fields(JointLimits) if not field.kw_only}
    assert KNOWN_ARMS[name].source


def test_each_share_of_the_limits_is_taken_of_its_own_kind():
    shares = {"velocity": 0.9, "acceleration": 0.8, "jerk": 0.7, "torque": 0.6}
    assert make().planning_limits.torque_rate == pytest.approx(0.95 * make().limits.torque_rate)
    arm = make(**{f"{key}_scale": value for key, value in shares.items()})
    for key, share in shares.items():
        assert getattr(arm.planning_limits, key) == pytest.approx(share * getattr(arm.limits, key), rel=1e-12)
    for key in ("q_min", "q_max"):
        assert np.array_equal(getattr(arm.planning_limits, key), getattr(arm.limits, key))


def test_shares_of_limits_by_hand():
    """A joint from -1 to 3 rad has its middle at 1; what is not published uses no share."""
    free = np.array([np.inf])
    limits = JointLimits(np.array([-1.0]), np.array([3.0]), np.array([2.0]), free, free, np.array([50.0]), free)
    curves = {kind.key: np.array([[2.0], [-1.0]]) for kind in LIMITS}
    shares = limits.shares(curves)
    assert list(shares) == ["position", "velocity", "acceleration", "jerk", "torque", "torque_rate"]
    assert shares["position"].ravel().tolist() == [0.5, -1.0]
    assert shares["velocity"].ravel().tolist() == [1.0, -0.5]
    assert shares["torque"].ravel().tolist() == [0.04, -0.02]
    assert not any(np.any(shares[key]) for key in ("acceleration", "jerk", "torque_rate"))
    assert [limits.bound(POSITION, 0, value) for value in (2.0, 0.0)] == [3.0, -1.0]
    assert JointLimits(-free, free, *[free] * 5).shares(curves)["position"].ravel().tolist() == [0.0, 0.0]


MASS = '<inertial><mass value="1"/><inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/></inertial>'
LIMITED = f"""<robot name="lever"><link name="base"/><link name="rod">{MASS}</link><link name="tip">{MASS}</link>
  <joint name="swing" type="revolute"><parent link="base"/><child link="rod"/><axis xyz="1 0 0"/>
    <limit lower="-0.5" upper="2.5" effort="{{effort}}" velocity="{{velocity}}"/></joint>
  <joint name="slide" type="prismatic"><parent link="rod"/><child link="tip"/><axis xyz="0 0 1"/>
    <limit lower="0.1" upper="0.9" effort="70" velocity="0.4"/></joint>
</robot>"""


@pytest.mark.parametrize(("effort", "velocity", "torque", "speed"), [(0, 0, np.inf, np.inf), (35, 1.5, 35.0, 1.5)])
def test_limits_of_a_urdf_are_its_own_and_zero_says_nothing(tmp_path, effort, velocity, torque, speed):
    """Exporters write effort="0" and velocity="0" where they know nothing: not a motor that cannot hold its link."""
    path = tmp_path / "lever.urdf"
    path.write_text(LIMITED.format(effort=effort, velocity=velocity))
    limits = make(str(path), flange="tip").limits
    assert limits.torque.tolist() == [torque, 70.0]
    assert limits.velocity.tolist() == [speed, 0.4]
    assert limits.q_min.tolist() == [-0.5, 0.1]
    assert limits.q_max.tolist() == [2.5, 0.9]
    for unknown in (limits.acceleration, limits.jerk, limits.torque_rate):
        assert np.isinf(unknown).all()


def test_published_limits_are_not_those_of_another_flange():
    """With another link as the flange the chain may have other joints: then the URDF's own limits count."""
    shorter = make(flange="panda_link5").limits
    assert shorter.torque.shape == (5,)
    assert np.isinf(shorter.jerk).all()
