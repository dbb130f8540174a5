"""The limits of an arm: which kinds there are, and their values for known arms, as the makers publish them.

A URDF holds position, velocity and torque limits at best. What a motion may ask for also includes
acceleration, jerk and the rate of torque; those numbers come from the makers' documents cited here. A limit
that no maker publishes is infinite: it is not checked.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from salver.geometry import Array


@dataclass(frozen=True)
class LimitKind:
    """One kind of limit. All that plans, checks or reports limits goes by `LIMITS`, the table of them.

    key: its name in code, in files, and as a field of `JointLimits`. of, order: it bounds the time derivative of
    this order of the joint positions or of the joint torques. unit: of its values. share: what a plan may use of
    it unless the scenario says otherwise; feedback needs the rest.
    """

    key: str
    of: Literal["position", "torque"]
    order: int
    unit: str
    share: float

    @property
    def name(self) -> str:
        """In words."""
        return self.key.replace("_", " ")


LIMITS = (
    LimitKind("position", "position", 0, "rad", 1.0),
    LimitKind("velocity", "position", 1, "rad/s", 0.98),
    LimitKind("acceleration", "position", 2, "rad/s^2", 0.95),
    LimitKind("jerk", "position", 3, "rad/s^3", 0.95),
    LimitKind("torque", "torque", 0, "N m", 1.0),
    LimitKind("torque_rate", "torque", 1, "N m/s", 0.95),
)


POSITION = LIMITS[0]
# By key; positions are not scaled.
PLANNING_SHARES = {kind.key: kind.share for kind in LIMITS if kind.key != "position"}


@dataclass(frozen=True)
class JointLimits:
    """Limits of n joints, each (n,), in the units of `LIMITS`; infinite when unknown. Positions are from q_min to
    q_max, the others from -limit to limit.
    """

    q_min: Array
    q_max: Array
    velocity: Array
    acceleration: Array
    jerk: Array
    torque: Array
    torque_rate: Array

    def range(self, kind: LimitKind) -> tuple[Array, Array]:
        """Middle and half-width (n,) of what is allowed; the middle is 0 where the half-width is infinite."""
        if kind.key != "position":
            half = getattr(self, kind.key)
            return np.zeros_like(half), half
        half = 0.5 * (self.q_max - self.q_min)
        with np.errstate(invalid="ignore"):  # from -infinity to infinity
            middle = 0.5 * (self.q_max + self.q_min)
        return np.where(np.isfinite(half), middle, 0.0), half

    def bound(self, kind: LimitKind, joint: int, value: float) -> float:
        """The limit that a joint's value is on the side of; for all but positions, its magnitude."""
        if kind.key != "position":
            return float(getattr(self, kind.key)[joint])
        above = value > 0.5 * (self.q_min[joint] + self.q_max[joint])
        return float(self.q_max[joint] if above else self.q_min[joint])

    def shares(self, curves: Mapping[str, Array]) -> dict[str, Array]:
        """Shares (..., n) used of each kind of limit, by key, for values (..., n) of some: 1 and -1 are the limits."""
        found = {}
        for kind in LIMITS:
            if kind.key in curves:
                middle, half = self.range(kind)
                found[kind.key] = (curves[kind.key] - middle) / half
        return found

    def scaled(self, shares: Mapping[str, float]) -> JointLimits:
        """These shares, by key, of the limits; the whole of the others."""
        return replace(self, **{key: share * getattr(self, key) for key, share in shares.items()})


@dataclass(frozen=True)
class KnownArm:
    """An arm that can be asked for by name.

    urdf: path below example-robot-data's folder of robots. flange: frame that carries the tray, z outwards.
    limits: name of a `JointLimits` field -> n numbers; what is missing is taken from the URDF.
    source: where the numbers are published.
    """

    urdf: str
    flange: str
    limits: dict[str, list[float]]
    source: str


KNOWN_ARMS: dict[str, KnownArm] = {
    "panda": KnownArm(
        urdf="panda_description/urdf/panda.urdf",
        flange="panda_link8",
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
    "ur10": KnownArm(
        urdf="ur_description/urdf/ur10_robot.urdf",
        flange="tool0",
        limits={
            "velocity": [2.0943951, 2.0943951, 3.14159265, 3.14159265, 3.14159265, 3.14159265],
            "acceleration": [5.0] * 6,
            "torque": [330.0, 330.0, 150.0, 56.0, 56.0, 56.0],
        },
        source="Universal Robots, UR10/CB3 User Manual, version 3.13 (speeds: 120 and 180 degrees/s) and the article "
        "'Max. joint torques'. No joint acceleration is published, the maker says that only torque limits it; "
        "5 rad/s^2 is the conservative figure of the maker's own driver: Universal_Robots_ROS2_Driver, "
        "ur_moveit_config/config/joint_limits.yaml. Jerk and torque rate are not published",
    ),
    "xarm7": KnownArm(
        urdf="xarm_description/urdf/xarm7.urdf",
        flange="link_eef",
        limits={
            "q_min": [-6.283185, -2.059488, -6.283185, -0.191986, -6.283185, -1.692969, -6.283185],
            "q_max": [6.283185, 2.094395, 6.283185, 3.926990, 6.283185, 3.141593, 6.283185],
            "velocity": [3.14159265] * 7,
            "acceleration": [20.0] * 7,
            "torque": [50.0, 50.0, 30.0, 30.0, 30.0, 20.0, 20.0],
        },
        source="UFACTORY, xArm user manual, technical specifications (180 degrees/s); xArm-Python-SDK, "
        "xarm/core/config/x_config.py (positions) and xarm/x3/base.py (20 rad/s^2); xarm_ros, "
        "xarm_description/urdf/xarm7/xarm7.urdf.xacro (torques). Jerk and torque rate are not published",
    ),
}
