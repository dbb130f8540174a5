"""What is around in the playground beside what the scenario says: a floor, so that what falls is seen to lie."""

from __future__ import annotations

from typing import Any

import numpy as np

from salver.models.arm import ArmModel
from salver.simulation.engine import mujoco
from salver.simulation.scene import FOOT, HULL

FLOOR = "playground:floor"
NOWHERE: dict[str, Any] = {"contype": 0, "conaffinity": 0, "mass": 0}  # geoms meet by pairs alone
FRICTION = [0.5, 0.5, 0.0, 0.0, 0.0]


def with_floor(spec: Any, arm: ArmModel) -> None:
    """Add the ground on which the arm stands, for the objects to fall on."""
    z = float(arm.base_position[2])
    spec.worldbody.add_geom(
        name=FLOOR, type=mujoco.mjtGeom.mjGEOM_PLANE, size=np.array([0, 0, 0.05]), pos=[0, 0, z], **NOWHERE
    )
    for geom in list(spec.geoms):
        if geom.name.startswith((HULL, FOOT)):
            spec.add_pair(geomname1=FLOOR, geomname2=geom.name, condim=3, friction=FRICTION)
