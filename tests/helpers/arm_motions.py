"""Arms from a URDF with every limit given, and motions of theirs: none, or a turn of one joint."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from salver import scenario
from salver.geometry import Array
from salver.models.arm.arm import ArmModel, load_arm
from salver.trajectory import JointMotion

ALL_LIMITS = {"velocity": 3.0, "acceleration": 5.0, "jerk": 100.0, "torque": 150.0, "torque_rate": 2000.0}

REST = np.array([0.0, -1.2, 1.5, -0.3, 1.6, 0.0])


def still(arm: ArmModel, q: Array = REST) -> JointMotion:
    return JointMotion(np.linspace(0, 1, 5), np.tile(q, (5, 1)), np.zeros((5, arm.n)), np.zeros((5, arm.n)))


def turn(q: Array, joint: int, to: float, duration: float = 1.0) -> JointMotion:
    """A min-jerk turn of one joint, in one polynomial piece."""
    ends = np.stack([q, q])
    ends[1, joint] = to
    return JointMotion(np.array([0.0, duration]), ends, np.zeros_like(ends), np.zeros_like(ends))


def make(model: str | Path, **keys) -> ArmModel:
    keys = {"flange": "tool0", "limits": ALL_LIMITS, **keys}
    return load_arm(scenario.Arm(model=str(model), **keys), scenario.Tray())
