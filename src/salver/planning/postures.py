"""Inverse kinematics of the arm: postures in which the tray, or an object on it, has a given pose.

`posture_at` takes damped Gauss-Newton steps on the pose error of a frame fixed to the tray (Levenberg 1944; Siciliano
et al., "Robotics", 2009, section 3.7), optionally with clamped joint limits, null-space motion towards the middle of
the joint ranges, or free heading. `postures_along` follows a path of poses by continuation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt
import pinocchio as pin
from scipy.linalg.lapack import dgesv

from salver.errors import ScenarioError
from salver.geometry import Array, exp
from salver.models.arm.arm import ArmModel, tray_to_object
from salver.models.arm.arm_limits import POSITION, JointLimits

REACHED = 1e-11  # m and rad: the pose error below which a posture counts as exact
# Largest error of a given start posture that is corrected instead of refused: that of seven joints rounded to two
# decimals of a radian.
START_DISTANCE = 5e-3  # m
START_ANGLE = np.deg2rad(0.5)  # rad
INSIDE = 0.01  # rad; distance of clamped joints from their limits, so that a motion can begin and end there


@dataclass(frozen=True, eq=False)
class PoseTarget:
    """Target pose (p_SB, R_SB) of a frame B fixed to the tray at (p_EB, R_EB), m.

    yaw_free: any heading, a rotation about B's own z axis, is allowed.
    """

    p_SB: Array
    R_SB: Array
    p_EB: Array = field(default_factory=lambda: np.zeros(3))
    R_EB: Array = field(default_factory=lambda: np.eye(3))
    yaw_free: bool = False

    @cached_property
    def _to_frame(self) -> Array:
        """Map (6, 6) from twists of E to twists of B."""
        return tray_to_object(self.p_EB, self.R_EB)

    @property
    def tray_pose(self) -> tuple[Array, Array]:
        """(p_SE, R_SE) of the tray when B is there."""
        R_SE = self.R_SB @ self.R_EB.T
        return self.p_SB - R_SE @ self.p_EB, R_SE

    def headings(self, count: int) -> list[PoseTarget]:
        """The target with `count` evenly spaced headings; only itself if its heading is given."""
        if not self.yaw_free:
            return [self]
        turns = exp(np.linspace(0.0, 2 * np.pi, count, endpoint=False)[:, None] * np.array([0.0, 0.0, 1.0]))
        return [replace(self, R_SB=self.R_SB @ turn, yaw_free=False) for turn in turns]

    def residual(self, arm: ArmModel, q: Array) -> tuple[Array, Array]:
        """Pose error (6,) at q, (5,) with free yaw: position in S, m, and rotation in B, rad; and its Jacobian J: a
        step dq should satisfy J dq = error."""
        model, data = arm.pin_model, arm.data
        pin.computeJointJacobians(model, data, q)
        placement = pin.updateFramePlacement(model, data, arm.tray_id)
        jacobian = self._to_frame @ pin.getFrameJacobian(model, data, arm.tray_id, pin.LOCAL).reshape(6, arm.n)
        R_SE = placement.rotation
        R_SB = R_SE @ self.R_EB
        error = np.empty(6)
        error[:3] = self.p_SB - placement.translation - R_SE @ self.p_EB
        if self.yaw_free:
            up = R_SB.T @ self.R_SB[:, 2]
            error[3:] = -up[1], up[0], 0.0
        else:
            error[3:] = pin.log3(R_SB.T @ self.R_SB)
        jacobian[:3] = R_SB @ jacobian[:3]
        rows = 5 if self.yaw_free else 6
        return error[:rows], jacobian[:rows]


def posture_at(
    arm: ArmModel,
    target: PoseTarget,
    q: Array,
    *,
    limits: JointLimits | None = None,
    centring: float = 0.0,
    centred: int = 30,
    longest: float = 0.4,
    iterations: int = 60,
) -> tuple[Array, float]:
    """The posture (n,) near a guess q (n,) that meets the target, and the remaining pose error (m, rad).

    arm: the arm. target: the pose. q: the guess, rad. limits: joints are clamped to these limits; None for no limits.
    centring: share of the way to the middle of the joint ranges by which the null-space motion of each of the first
    `centred` steps goes. longest: rad, of a joint's step; doubled, distant postures are reached sooner or missed.
    iterations: at most.
    """
    q = np.array(q, dtype=float)
    middle = arm.limits.range(POSITION)[0] if centring else q
    low, high = (limits.q_min + INSIDE, limits.q_max - INSIDE) if limits is not None else (-np.inf, np.inf)
    error, jacobian = target.residual(arm, q)
    diagonal = slice(None, None, len(error) + 1)
    for iteration in range(iterations):
        size = float(abs(error).max())
        if size < REACHED:
            return q, size

        def least(jacobian: Array, wanted: Array, damping: float = 1e-2 * min(1e-2, size)) -> Array:
            """The least-norm step with which the pose changes as wanted."""
            normal = jacobian @ jacobian.T
            normal.ravel()[diagonal] += damping
            return np.asarray(jacobian.T @ dgesv(normal, wanted)[2])  # NumPy's solver is slow

        step = least(jacobian, error)
        if limits is not None and ((at_low := q <= low) | (at_high := q >= high)).any():
            stuck = (at_low & (step < 0)) | (at_high & (step > 0))
            if stuck.any():
                jacobian = jacobian * ~stuck
                step = least(jacobian, error)
        if centring and iteration < centred:
            pull = centring * (middle - q)
            step += pull - least(jacobian, jacobian @ pull)
        q = q + step * min(1.0, longest / max(float(abs(step).max()), 1e-12))
        if limits is not None:
            q = np.minimum(np.maximum(q, low), high)
        error, jacobian = target.residual(arm, q)
    return q, float(np.abs(error).max())


def postures_along(arm: ArmModel, p_SE: Array, R_SE: Array, q: Array, jump: float = 1.0) -> tuple[Array, int]:
    """Postures (N, n) along a path of tray poses by continuation from q (n,), and the number of poses reached: until
    neighbours differ by more than `jump`, rad, in another branch of the inverse kinematics."""
    postures = np.tile(q, (len(p_SE), 1))
    for k in range(1, len(p_SE)):
        postures[k], size = posture_at(arm, PoseTarget(p_SE[k], R_SE[k]), postures[k - 1], iterations=12)
        if size >= REACHED or np.abs(postures[k] - postures[k - 1]).max() > jump:
            return postures, k
    return postures, len(p_SE)


def candidate_postures(arm: ArmModel, target: PoseTarget, seed: int = 0, seeds: int = 48) -> list[Array]:
    """Different postures within the joint limits that meet a target: from the middle of the joint ranges and from
    random guesses, which the seed determines."""
    rng = np.random.default_rng(seed)
    low, high = np.maximum(arm.limits.q_min, -np.pi), np.minimum(arm.limits.q_max, np.pi)
    middle = arm.limits.range(POSITION)[0]
    guesses = [middle, *(low + (high - low) * rng.uniform(0.1, 0.9, arm.n) for _ in range(seeds - 1))]
    found: list[Array] = []
    for guess in guesses:
        q, size = posture_at(arm, target, guess, centring=0.1)
        # A joint with a range of several turns gets the angle closest to the middle of its range.
        turns = np.round((q - middle) / (2 * np.pi))
        q = np.where(arm.limits.q_max - arm.limits.q_min > 2 * np.pi, q - 2 * np.pi * turns, q)
        inside = np.all((q > arm.limits.q_min) & (q < arm.limits.q_max))
        if size < REACHED and inside and all(np.abs(q - other).max() > 0.05 for other in found):
            found.append(q)
    return found


def start_posture(
    arm: ArmModel, given: Sequence[float] | npt.NDArray[np.float64], target: PoseTarget, what: str = "the tray"
) -> Array:
    """A start posture given by the user, corrected such that `what` (in words) meets the target exactly.

    Raises ScenarioError: wrong length, beyond a joint limit, an error above `START_DISTANCE` or `START_ANGLE`, or
    singular.
    """
    q = np.array(given, dtype=float)
    if q.shape != (arm.n,):
        raise ScenarioError(f"arm.start_posture has {q.size} values; {arm.name} has {arm.n} joints, in rad.")
    for i, name in enumerate(arm.joint_names):
        low, high = arm.limits.q_min[i], arm.limits.q_max[i]
        if not low <= q[i] <= high:
            raise ScenarioError(
                f"arm.start_posture[{i}] = {q[i]:g} {arm.unit(i)} is beyond the limits of {name}; it must be "
                f"within [{low:.4g}, {high:.4g}] {arm.unit(i)}."
            )
    error, _ = target.residual(arm, q)
    distance, angle = float(np.linalg.norm(error[:3])), float(np.linalg.norm(error[3:]))
    if distance > START_DISTANCE or angle > START_ANGLE:
        x, y, z = target.p_SB
        yaw = not target.yaw_free and abs(abs(error[5]) - angle) < 1e-3
        hint = ", about the vertical (see objects.yaw_deg)" if yaw and angle > START_ANGLE else ""
        raise ScenarioError(
            f"arm.start_posture puts {what} {1e3 * distance:.3g} mm and {np.rad2deg(angle):.3g} deg{hint} from "
            f"({x:.3f}, {y:.3f}, {z:.3f}) m, where the motion starts; at most {1e3 * START_DISTANCE:g} mm and "
            f"{np.rad2deg(START_ANGLE):.2g} deg are corrected: change one of them, or leave start_posture out to have "
            "one chosen."
        )
    exact, size = posture_at(arm, target, q, iterations=20)
    if size >= REACHED:
        raise ScenarioError(
            f"arm.start_posture is singular: its last {size:.2g} m cannot be corrected; change it, or leave it out to "
            "have one chosen."
        )
    return exact
