"""Lower bounds on the duration of a motion between two postures: from each joint's own limits, and from friction.

From rest to rest, with zero acceleration at both ends, a joint is fastest when it moves with its largest jerk,
acceleration and velocity in turn (Biagiotti and Melchiorri, "Trajectory Planning for Automatic Machines and Robots",
2008, section 3.4). Torque, contact, obstacles and the other joints can only add to that.

A load that neither slides nor lifts is carried by a force within the friction cone about the tray's normal, so within
psi = atan(mu) + theta of the vertical if the tray tilts by at most theta. With u = g + z'' >= 0, the vertical force per
mass, |x''| <= k u, k = tan(psi), holds for the centre of mass. At rest at both ends the integrals of x'' and z'' over T
are zero, so that of u is g T, and the distance is
    d = int (T - t) x'' dt = int (T/2 - t) x'' dt <= k T/2 int u dt = k g T^2 / 2.
Accelerations are not limited: tossing tray and load up and sideways and catching them comes close to this bound.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from salver.geometry import GRAVITY_S, Array
from salver.models.arm.arm import ArmModel
from salver.models.arm.arm_limits import JointLimits
from salver.models.payload import Payload
from salver.models.uncertain.parameters import Parameter


def least_duration(limits: JointLimits, q_start: Array, q_goal: Array) -> float:
    """The least time, s, in which every joint can move from q_start to q_goal (n,), from rest to rest."""
    joints = zip(abs(q_goal - q_start), limits.velocity, limits.acceleration, limits.jerk, strict=True)
    return max(least_time(*(float(x) for x in joint)) for joint in joints)


def least_by_friction(arm: ArmModel, payload: Payload, max_tilt: float, q_start: Array, q_goal: Array) -> float:
    """The least time, s, in which friction can carry the load from q_start to q_goal (n,), from rest to rest, with a
    tilt of at most `max_tilt`, rad. 0 where no bound is known, as with load dynamics."""
    least = 0.0
    for friction, centre in _stacks(payload):
        cone = math.atan(friction) + max_tilt
        if cone < 0.5 * math.pi:
            p_0, p_1 = (p + R @ centre for p, R in (arm.tray_pose(q) for q in (q_start, q_goal)))
            distance = float(np.hypot(*(p_1 - p_0)[:2]))
            least = max(least, math.sqrt(2 * distance / (math.tan(cone) * -GRAVITY_S[2])))
    return least


def _stacks(payload: Payload) -> Iterator[tuple[float, Array]]:
    """For each stack that touches nothing else, not the rim either: its largest certain friction coefficient, and its
    centre of mass (3,) in E, m."""
    ranges = payload.uncertain.ranges
    for network in payload.networks:
        if any(body.inner is not None or body.walls is not None for body in network.bodies):
            continue
        on_tray = [network.bodies[face.upper] for face in network.interfaces if face.lower is None]
        friction = max(body.friction - ranges.get(Parameter(body.name, "friction"), 0.0) for body in on_tray)
        masses = [body.inertial.mass for body in network.bodies]
        yield friction, np.average([body.p_EB for body in network.bodies], axis=0, weights=masses)


def least_time(distance: float, velocity: float, acceleration: float, jerk: float) -> float:
    """The least time, s, from rest to rest over a distance >= 0 within limits, which may be infinite."""

    def rise(peak: float) -> float:
        """Time from rest to a velocity, with zero acceleration at both ends."""
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
