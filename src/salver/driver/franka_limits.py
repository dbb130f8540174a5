"""Limits of the Franka Research 3, the arm that libfranka 0.10 and later (and so pylibfranka) drives.

Its joints turn as the Panda's do, within tighter limits: a plan made for the Panda is checked against these before
the arm moves. Source: Franka Robotics, "Limits for Franka Research 3" in the robot and interface specifications;
the same numbers in libfranka, include/franka/rate_limiting.h.
"""

from __future__ import annotations

import numpy as np

from salver.geometry import Array
from salver.models.arm_limits import JointLimits

FR3 = JointLimits(
    q_min=np.array([-2.7437, -1.7837, -2.9007, -3.0421, -2.8065, 0.5445, -3.0159]),
    q_max=np.array([2.7437, 1.7837, 2.9007, -0.1518, 2.8065, 4.5169, 3.0159]),
    velocity=np.array([2.62, 2.62, 2.62, 2.62, 5.26, 4.18, 5.26]),
    acceleration=np.full(7, 10.0),
    jerk=np.full(7, 5000.0),
    torque=np.array([87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0]),
    torque_rate=np.full(7, 1000.0),
)

_OFFSET = np.array([0.30, 0.20, 0.20, 0.30, 0.35, 0.35, 0.35])
_SLOPE = np.array([12.0, 5.17, 7.00, 8.00, 34.0, 11.0, 34.0])
_UPPER_END = np.array([2.75010, 1.79180, 2.90650, -0.1458, 2.81010, 4.52050, 3.01960])
_LOWER_END = np.array([-2.750100, -1.791800, -2.906500, -3.048100, -2.810100, 0.54092, -3.019600])


def velocity_range(q: Array) -> tuple[Array, Array]:
    """Least and largest joint velocity (..., 7) that the arm allows at joint positions (..., 7): towards an end of its
    range a joint must go slower, as it can still brake before it."""

    def towards(distance: Array) -> Array:
        return np.clip(np.sqrt(np.maximum(_SLOPE * distance, 0.0)) - _OFFSET, 0.0, FR3.velocity)

    return -towards(q - _LOWER_END), towards(_UPPER_END - q)
