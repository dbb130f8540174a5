"""What may be asked of a live motion: a goal, a stop. Each says in a sentence why it cannot be, before it is tried."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from salver.errors import Status
from salver.geometry import Array
from salver.planning.fastest import AtPose, AtPosture, End, TransportProblem
from salver.planning.fastest.constraints import LEVEL_TOLERANCE
from salver.planning.postures import PoseTarget

ORTHONORMAL = 1e-6  # by which a rotation may fail to be one
Pose = npt.ArrayLike | tuple[npt.ArrayLike, npt.ArrayLike]
ACCEPTED = Status("accepted", "Accepted.", True)


@dataclass(frozen=True, eq=False)
class Goal:
    """To an end, at rest there. what: it is, in words."""

    end: End
    what: str


@dataclass(frozen=True, eq=False)
class Halt:
    """To rest, as soon as may be."""


Wish = Goal | Halt


def refused(sentence: str) -> Status:
    return Status("refused", sentence, False)


def numbers(value: Any, shape: tuple[int, ...], what: str) -> Array | Status:
    """An array of finite numbers of a shape, or why it is none."""
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError):
        return refused(f"{what} is no array of numbers; it must be {shape} finite numbers")
    if array.shape != shape:
        return refused(f"{what} has shape {array.shape}; it must be {shape}")
    if not np.all(np.isfinite(array)):
        return refused(f"{what} has values that are not finite")
    return array


def posture_goal(problem: TransportProblem, q: npt.ArrayLike) -> Goal | Status:
    """A posture (n,), rad, at rest."""
    posture = numbers(q, (problem.n,), "the posture")
    if isinstance(posture, Status):
        return posture
    limits, names = problem.limits, problem.arm.joint_names
    for value, low, high, name in zip(posture, limits.q_min, limits.q_max, names, strict=True):
        if not low <= value <= high:
            return refused(f"{name} would be at {value:.4g}; it must be within [{low:.4g}, {high:.4g}]")
    return Goal(AtPosture(posture), "a posture")


def pose_goal(problem: TransportProblem, pose: Pose) -> Goal | Status:
    """The first object's frame B at p_SB (3,), m, upright with any heading; or at (p_SB, R_SB) with R_SB (3, 3)."""
    whole = isinstance(pose, tuple) and len(pose) == 2
    p = numbers(pose[0] if whole else pose, (3,), "the position")  # type: ignore[index]
    rotation = numbers(pose[1], (3, 3), "the rotation") if whole else np.eye(3)  # type: ignore[index]
    for found in (p, rotation):
        if isinstance(found, Status):
            return found
    assert not isinstance(p, Status)
    assert not isinstance(rotation, Status)
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > ORTHONORMAL or np.linalg.det(rotation) < 0:
        return refused("the rotation is none: its rows must be orthonormal and right-handed")
    first = problem.items[0]
    if not whole:
        rotation = first.R_EB  # the tray level
    leans = float(np.arccos(np.clip((rotation @ first.R_EB.T)[2, 2], -1.0, 1.0)))
    most = max(problem.max_tilt, LEVEL_TOLERANCE)
    if leans > most:
        return refused(
            f"the goal leans the tray by {np.rad2deg(leans):.3g} deg; it may lean by {np.rad2deg(most):.3g} deg"
        )
    target = PoseTarget(p, rotation, first.p_EB, first.R_EB, yaw_free=not whole)
    return Goal(AtPose(target), f"({p[0]:.3f}, {p[1]:.3f}, {p[2]:.3f}) m")


def why_not(problem: TransportProblem, goal: Goal) -> str:
    """Why nothing can come to rest there, or nothing: what stands in the way of it."""
    if problem.keep_out is None:
        return ""
    parts = problem.keep_out.parts
    if isinstance(goal.end, AtPose) and not goal.end.target.yaw_free:
        met = parts.in_the_way(*goal.end.target.tray_pose)
        if met is not None:
            return f"there the {met[0]} would be inside {met[1]}"
    if isinstance(goal.end, AtPosture):
        touch = parts.first_touch(goal.end.q[None])
        if touch is not None:
            return f"there {touch.first} and {touch.second} would touch"
    return ""
