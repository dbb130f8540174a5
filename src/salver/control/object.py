"""The object's closed loop: plant (18) and wrench-feedback controller (19), vectorised over leading axes.

The planner, the nonlinear rollouts and the tests share this definition. On SE(3) the paper's `q* - q` and
`V* - V` are taken as transported errors, E = R^T R*: e_p = p* - p and e_v = v* - v in S, e_R = Log(E) and
e_w = E omega* - omega in B. Then the nominal error obeys e_v' = -kd e_v - kp e_p and e_w' = -kd e_w - kp e_R
exactly, along any reference. The translation is exactly linear; in the rotation, e_R' = J_l(e_R)^-1 e_w equals e_w to
first order, and exactly for a rotation about a fixed axis.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from salver.geometry import GRAVITY_S, Array, hat
from salver.models.rigid_body import inertia_matrix, spatial_inertia
from salver.trajectory import MotionSamples


@dataclass(frozen=True)
class Gains:
    """Diagonal gains of eq (19): kp = (translation, rotation) in 1/s^2, kd likewise in 1/s."""

    kp: tuple[float, float]
    kd: tuple[float, float]


@dataclass(frozen=True)
class Errors:
    """Tracking errors e_p, e_R, e_v, e_w of eq (19) on SE(3), each (..., 3).

    position_S: m. rotation_B: rad, Log(R^T R*). velocity_S: m/s. omega_B: rad/s, E omega* - omega.
    transport: (..., 3, 3) E = R^T R*, the rotation of the reference in the object's axes.
    """

    position_S: Array
    rotation_B: Array
    velocity_S: Array
    omega_B: Array
    transport: Array


def command(gains: Gains, reference: MotionSamples, error: Errors) -> tuple[Array, Array]:
    """Commanded acceleration (a_cmd_S, alpha_cmd_B), each (..., 3): the bracket of eq (19).

    In the object's axes, the reference's angular acceleration has the term -omega x (E omega*), because E turns.
    """
    (kp, kp_R), (kd, kd_R) = gains.kp, gains.kd
    a_cmd_S = reference.a_S + kd * error.velocity_S + kp * error.position_S
    transported = apply(error.transport, reference.omega_B)
    omega_B = transported - error.omega_B
    alpha_cmd_B = (
        apply(error.transport, reference.alpha_B)
        - apply(hat(omega_B), transported)
        + kd_R * error.omega_B
        + kp_R * error.rotation_B
    )
    return a_cmd_S, alpha_cmd_B


def acceleration(
    phi: npt.ArrayLike, R_SB: Array, omega_B: Array, wrench_B: Array, inverse_inertia: Array | None = None
) -> tuple[Array, Array]:
    """Accelerations a_S, alpha_B, each (..., 3), of a body with inertial parameters phi (..., 10) under a wrench at B.

    This is the plant, eq (18), with the full spatial inertia, because the true centre of mass may differ from B; the
    inverse of eq (1). inverse_inertia: (..., 6, 6), if it is known already.
    """
    phi = np.asarray(phi, dtype=float)
    if inverse_inertia is None:
        inverse_inertia = np.asarray(np.linalg.inv(spatial_inertia(phi)), dtype=float)
    omega_hat = hat(omega_B)
    bias = np.concatenate(
        [
            apply(omega_hat, apply(omega_hat, phi[..., 1:4])),
            apply(omega_hat, apply(inertia_matrix(phi[..., 4:]), omega_B)),
        ],
        axis=-1,
    )
    specific = apply(inverse_inertia, wrench_B - bias)  # (R^T (a - g), alpha)
    return apply(R_SB, specific[..., :3]) + GRAVITY_S, specific[..., 3:]


def apply(matrix: Array, vector: Array) -> Array:
    """Matrix-vector products (..., i) of stacks (..., i, j) and (..., j)."""
    return np.einsum("...ij,...j->...i", matrix, vector)
