"""What is around in the playground beside what the scenario says: a floor, so that what falls is seen; a ball."""

from __future__ import annotations

from typing import Any

import numpy as np

from salver.models.arm import ArmModel
from salver.simulation.elements import FOOT, HULL, TRAY_GEOM
from salver.simulation.engine import mujoco

FLOOR, BALL = "playground:floor", "playground:ball"
RADIUS, MASS = 0.05, 0.1  # m, kg, of the ball
NOWHERE: dict[str, Any] = {"contype": 0, "conaffinity": 0, "mass": 0}  # geoms meet by pairs alone
FRICTION = [0.5, 0.5, 0.0, 0.0, 0.0]


def furnish(spec: Any, arm: ArmModel) -> None:
    """Add the ground on which the arm stands, for the objects to fall on; and the ball, which tray and load feel, the
    links of the arm do not."""
    z = float(arm.base_position[2])
    spec.worldbody.add_geom(
        name=FLOOR, type=mujoco.mjtGeom.mjGEOM_PLANE, size=np.array([0, 0, 0.05]), pos=[0, 0, z], **NOWHERE
    )
    ball = spec.worldbody.add_body(name=BALL, pos=[0, 0, z - 10.0])
    ball.add_freejoint(name=BALL)
    ball.mass, ball.inertia = MASS, np.full(3, 0.4 * MASS * RADIUS**2)
    ball.explicitinertial = True
    ball.add_geom(name=BALL, type=mujoco.mjtGeom.mjGEOM_SPHERE, size=np.array([RADIUS, 0, 0]), **NOWHERE)
    pairs = [(FLOOR, BALL), (TRAY_GEOM, BALL)]
    for geom in list(spec.geoms):
        pairs += [(FLOOR, geom.name)] if geom.name.startswith((HULL, FOOT)) else []
        pairs += [(BALL, geom.name)] if geom.name.startswith(HULL) else []
    for first, second in pairs:
        spec.add_pair(geomname1=first, geomname2=second, condim=3, friction=FRICTION)
