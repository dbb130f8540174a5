"""Postures: joint positions that put the tray where it must be, and which of them to start from.

Inverse kinematics by damped Gauss-Newton steps on the pose error of the tray frame E (Levenberg 1944; Siciliano
et al., "Robotics", 2009, section 3.7). The free directions of a redundant arm pull towards the middle of the
joint ranges.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import pinocchio as pin

from salver.errors import ScenarioError, UnreachableError
from salver.geometry import Array, log
from salver.models.arm import ArmModel
from salver.models.arm_limits import POSITION

REACHED = 1e-11  # m and rad: the pose error below which a posture counts as exact
START_POSITION_TOLERANCE = 2e-3  # m: how far a given start posture may miss the start of the motion ...
START_ANGLE_TOLERANCE = np.deg2rad(0.5)  # rad: ... before it is refused instead of being corrected
SEEDS = 48
_LARGEST_STEP = 0.4  # rad


def pose_error(p: Array, rotation: Array, p_goal: Array, R_goal: Array) -> Array:
    """(6,) error twist in the body frame: J dq = error is a Newton step towards the goal."""
    return np.concatenate([rotation.T @ (p_goal - p), pin.log3(rotation.T @ R_goal)])


def solve_pose(
    arm: ArmModel, q: Array, p_SE: Array, R_SE: Array, iterations: int = 60, centring: float = 0.0
) -> tuple[Array, float]:
    """Joint positions (n,) that put the tray at (p_SE, R_SE), from a guess, and the pose error that is left.

    centring: share of the way to the middle of the joint ranges that the null space moves in each step.
    """
    model, data, frame = arm.pin_model, arm.data, arm.tray_id
    q, identity = np.array(q, dtype=float), np.eye(6)
    middle = _middle(arm)
    size = np.inf
    for iteration in range(iterations):
        pin.computeJointJacobians(model, data, q)
        placement = pin.updateFramePlacement(model, data, frame)
        error = pose_error(placement.translation, placement.rotation, p_SE, R_SE)
        size = float(np.abs(error).max())
        if size < REACHED:
            break
        jacobian = pin.getFrameJacobian(model, data, frame, pin.LOCAL)
        damping = min(1e-2, size) * 1e-2
        gain = np.linalg.solve(jacobian @ jacobian.T + damping * identity, np.column_stack([error, jacobian]))
        step = jacobian.T @ gain[:, 0]
        if centring and iteration < iterations // 2:
            pull = centring * (middle - q)
            step += pull - jacobian.T @ (gain[:, 1:] @ pull)
        q += step * min(1.0, _LARGEST_STEP / max(np.abs(step).max(), 1e-12))
    return q, size


def candidate_postures(arm: ArmModel, p_SE: Array, R_SE: Array, seed: int = 0, seeds: int = SEEDS) -> list[Array]:
    """Different postures within the joint limits that put the tray at a pose; from seeded random guesses.

    The first guess is the middle of the joint ranges. Same seed, same list.
    """
    rng = np.random.default_rng(seed)
    low, high = np.maximum(arm.limits.q_min, -np.pi), np.minimum(arm.limits.q_max, np.pi)
    guesses = [_middle(arm), *(low + (high - low) * rng.uniform(0.1, 0.9, arm.n) for _ in range(seeds - 1))]
    found: list[Array] = []
    for guess in guesses:
        q, size = solve_pose(arm, guess, p_SE, R_SE, centring=0.1)
        q = _unwound(arm, q)
        inside = np.all((q > arm.limits.q_min) & (q < arm.limits.q_max))
        if size < REACHED and inside and all(np.abs(q - other).max() > 0.05 for other in found):
            found.append(q)
    return found


def check_start_posture(
    arm: ArmModel, posture: Sequence[float] | npt.NDArray[np.float64], p_SE: Array, R_SE: Array
) -> Array:
    """A start posture that the user gave, corrected to put the tray exactly at (p_SE, R_SE).

    Raises ScenarioError (wrong length, beyond a joint limit) and UnreachableError (the tray is elsewhere).
    """
    q = np.array(posture, dtype=float)
    if q.shape != (arm.n,):
        raise ScenarioError(f"arm.start_posture has {q.size} values; {arm.name} has {arm.n} joints, in rad.")
    for i, name in enumerate(arm.joint_names):
        low, high = arm.limits.q_min[i], arm.limits.q_max[i]
        if not low <= q[i] <= high:
            raise ScenarioError(
                f"arm.start_posture[{i}] = {q[i]:g} rad is beyond the limits of {name}; it must be within "
                f"[{low:.4g}, {high:.4g}] rad."
            )
    p, rotation = arm.tray_pose(q)
    distance, angle = float(np.linalg.norm(p - p_SE)), float(np.linalg.norm(log(rotation.T @ R_SE)))
    remedy = "correct it, move the start, or leave it out to have one chosen"
    if distance > START_POSITION_TOLERANCE:
        raise UnreachableError(
            f"arm.start_posture puts the tray at {_point(p)} m, {1e3 * distance:.3g} mm from {_point(p_SE)} m, where "
            f"the motion starts; {remedy}."
        )
    if angle > START_ANGLE_TOLERANCE:
        yaw = _yaw(rotation.T @ R_SE)
        about = "about the tray's normal (see objects.yaw_deg)" if abs(abs(yaw) - angle) < 1e-3 else "away"
        raise UnreachableError(
            f"arm.start_posture turns the tray {np.rad2deg(angle):.3g} degrees {about} from where the motion starts; "
            f"{remedy}."
        )
    exact, size = solve_pose(arm, q, p_SE, R_SE, iterations=20)
    if size >= REACHED:
        raise UnreachableError(f"arm.start_posture is singular: its last {size:.2g} m cannot be corrected; {remedy}.")
    return exact


def _middle(arm: ArmModel) -> Array:
    return arm.limits.range(POSITION)[0]


def _unwound(arm: ArmModel, q: Array) -> Array:
    """The same posture with joints that can turn more than once as near to the middle of their range as possible."""
    turns = np.round((q - _middle(arm)) / (2 * np.pi))
    return np.where(arm.limits.q_max - arm.limits.q_min > 2 * np.pi, q - 2 * np.pi * turns, q)


def _yaw(rotation: Array) -> float:
    return float(np.arctan2(rotation[1, 0], rotation[0, 0]))


def _point(p: Array) -> str:
    return f"({p[0]:.3f}, {p[1]:.3f}, {p[2]:.3f})"
