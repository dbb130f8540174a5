"""A time that no motion between two postures can beat: what the limits of its joints take, each for itself.

From rest to rest, without acceleration at either end, a joint is soonest at the other end with the largest jerk,
acceleration and velocity in turn (Biagiotti and Melchiorri, "Trajectory Planning for Automatic Machines and Robots",
2008, section 3.4). Torque, contact and obstacles only add to that; so do other joints.
"""

from __future__ import annotations

import math

from salver.geometry import Array
from salver.models.arm_limits import JointLimits


def least_duration(limits: JointLimits, q_start: Array, q_goal: Array) -> float:
    """The least time, s, in which every joint can get from q_start to q_goal (n,), from rest to rest."""
    joints = zip(abs(q_goal - q_start), limits.velocity, limits.acceleration, limits.jerk, strict=True)
    return max(least_time(*(float(x) for x in joint)) for joint in joints)


def least_time(distance: float, velocity: float, acceleration: float, jerk: float) -> float:
    """The least time over a distance, at least 0, within limits, which may be infinite."""

    def rise(peak: float) -> float:
        """Time from rest to a velocity, without acceleration at both."""
        if math.isinf(jerk):
            return peak / acceleration
        if peak * jerk >= acceleration**2:
            return peak / acceleration + acceleration / jerk
        return 2 * math.sqrt(peak / jerk)

    if distance == 0:
        return 0.0
    if math.isfinite(velocity) and distance >= velocity * rise(velocity):
        return rise(velocity) + distance / velocity
    if math.isinf(jerk):
        peak = math.sqrt(distance * acceleration) if math.isfinite(acceleration) else math.inf
        return 2 * rise(peak) if math.isfinite(peak) else 0.0
    peak = (0.5 * distance * math.sqrt(jerk)) ** (2 / 3)
    if peak * jerk > acceleration**2:
        ramp = acceleration / jerk
        peak = 0.5 * acceleration * (math.sqrt(ramp**2 + 4 * distance / acceleration) - ramp)
    return 2 * rise(peak)
