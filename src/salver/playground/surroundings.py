"""What is around in the playground beside what the scenario says: a ball."""

from __future__ import annotations

from typing import Any

import numpy as np

from salver.models.arm import ArmModel
from salver.simulation.elements import FLOOR, HULL, TRAY_GEOM
from salver.simulation.engine import mujoco

BALL = "playground:ball"
RADIUS, MASS = 0.05, 0.1  # m, kg, of the ball
NOWHERE: dict[str, Any] = {"contype": 0, "conaffinity": 0, "mass": 0}  # geoms meet by pairs alone
FRICTION = [0.5, 0.5, 0.0, 0.0, 0.0]


def furnish(spec: Any, arm: ArmModel) -> None:
    """Add the ball, which the floor, tray and load feel, the links of the arm do not."""
    z = float(arm.base_position[2])
    ball = spec.worldbody.add_body(name=BALL, pos=[0, 0, z - 10.0])
    ball.add_freejoint(name=BALL)
    ball.mass, ball.inertia = MASS, np.full(3, 0.4 * MASS * RADIUS**2)
    ball.explicitinertial = True
    ball.add_geom(name=BALL, type=mujoco.mjtGeom.mjGEOM_SPHERE, size=np.array([RADIUS, 0, 0]), **NOWHERE)
    for geom in list(spec.geoms):
        if geom.name.startswith((FLOOR, TRAY_GEOM, HULL)):
            spec.add_pair(geomname1=BALL, geomname2=geom.name, condim=3, friction=FRICTION)
