"""The motion regressor of a rigid frame: twelve numbers in which every contact wrench is linear.

    w = (f, alpha, omega_x^2, omega_x omega_y, omega_y^2, omega_x omega_z, omega_y omega_z, omega_z^2),

f = R^T (a - g) the specific force at the frame's origin, alpha the angular acceleration, all in the frame.
The wrench that a body at rest in the frame needs is `wrench_map(phi) @ w`: eq (1) of the paper.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from salver.geometry import GRAVITY_S, Array, hat
from salver.models.rigid_body import inertia_entries, inertia_matrix

N_MOTION = 12

# Symmetric (6, 3, 3) matrices of the six products omega_i omega_j.
_PRODUCT_MATRICES = inertia_matrix(np.eye(6))
_SPIN = _PRODUCT_MATRICES - np.trace(_PRODUCT_MATRICES, axis1=1, axis2=2)[:, None, None] * np.eye(3)


def motion_vector(R_SX: Array, a_S: Array, omega_X: Array, alpha_X: Array) -> Array:
    """Motion regressor w (..., 12) of a frame X from R_SX (..., 3, 3), a_S (..., 3) of its origin, omega and alpha in
    X."""
    force = np.einsum("...ji,...j->...i", R_SX, a_S - GRAVITY_S)
    return np.concatenate([force, alpha_X, inertia_entries(omega_X[..., :, None] * omega_X[..., None, :])], axis=-1)


def at_rest(R_SX: Array | None = None) -> Array:
    """w (12,) of a frame at rest; level by default."""
    w = np.zeros(N_MOTION)
    w[:3] = -GRAVITY_S if R_SX is None else -GRAVITY_S @ R_SX
    return w


def frame_map(p_XY: Array, R_XY: Array) -> Array:
    """Map (12, 12) from w of a frame X to w of a frame Y fixed to it."""
    matrix = np.zeros((N_MOTION, N_MOTION))
    rotation = R_XY.T
    matrix[:3, :3] = matrix[3:6, 3:6] = rotation
    matrix[:3, 3:6] = -rotation @ hat(p_XY)
    matrix[:3, 6:] = rotation @ (_SPIN @ p_XY).T
    matrix[6:, 6:] = inertia_entries(rotation @ _PRODUCT_MATRICES @ rotation.T).T
    return matrix


def wrench_map(phi: Array) -> Array:
    """Map (6, 12) from w of a frame X to the wrench at X of a body with inertial parameters phi (10,) in X: eq (1)."""
    mass, moment, inertia = phi[0], phi[1:4], inertia_matrix(phi[4:])
    matrix = np.zeros((6, N_MOTION))
    matrix[:3, :3], matrix[3:, :3] = mass * np.eye(3), hat(moment)
    matrix[:3, 3:6], matrix[3:, 3:6] = -hat(moment), inertia
    matrix[:3, 6:] = (_SPIN @ moment).T
    twisted = _PRODUCT_MATRICES @ inertia  # omega x I omega is the axial vector of (omega omega^T) I
    matrix[3, 6:] = twisted[:, 1, 2] - twisted[:, 2, 1]
    matrix[4, 6:] = twisted[:, 2, 0] - twisted[:, 0, 2]
    matrix[5, 6:] = twisted[:, 0, 1] - twisted[:, 1, 0]
    return matrix


@dataclass(frozen=True)
class Speed:
    """A speed factor of a motion, and its rate of change, 1/s."""

    factor: float = 1.0
    rate: float = 0.0

    @property
    def words(self) -> str:
        if self.factor == 0.0:
            at = " standing still"
        else:
            at = "" if self.factor == 1.0 else f" at {100 * self.factor:.3g} % of full speed"
        return f"{at}{' while the speed changes' if self.rate else ''}"


FULL_SPEED = Speed()


def corners(speeds: Literal["any", "full"], rate: float) -> tuple[Speed, ...]:
    """The speeds at which a rigid load must hold so that it holds at all speeds that a plan is for.

    speeds: "any": every constant factor s from 0 to 1, and factors that change by up to `rate`, 1/s; "full": full
    speed. The motion regressor of the tray is linear in (s^2, s'), and contact is a convex condition on it, so that it
    holds in a whole rectangle of these if it holds at the corners.
    """
    if speeds == "full":
        return (FULL_SPEED,)
    return tuple(Speed(factor, sign * rate) for factor in (1.0, 0.0) for sign in ((1.0, -1.0) if rate else (0.0,)))
