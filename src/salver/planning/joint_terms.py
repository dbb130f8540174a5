"""What the tray feels along a joint motion, and the torque the joints need, with exact derivatives.

Everything the contact conditions depend on is the vector w (12) of the tray frame E, see
`salver.models.tray_motion`: specific force, angular acceleration, products of angular velocity.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from salver.geometry import GRAVITY_S, Array
from salver.models.tray_motion import N_MOTION, PRODUCTS


@dataclass(frozen=True)
class MotionTerms:
    """Values at N instants, and derivatives with respect to z = (q, dq, ddq), the last axis (3 n).

    p_SE, R_SE: (N, 3), (N, 3, 3) pose of the tray. jacobian_E: (N, 6, n) its body Jacobian.
    w: (N, 12); w_z: (N, 12, 3n). torque: (N, n), N m, with the load; torque_z: (N, n, 3n).
    mass_matrix: (N, n, n) of the arm with the load.
    """

    p_SE: Array
    R_SE: Array
    jacobian_E: Array
    w: Array
    w_z: Array
    torque: Array
    torque_z: Array
    mass_matrix: Array


def motion_terms(model: Any, frame_id: int, q: Array, dq: Array, ddq: Array) -> MotionTerms:
    """Terms of a Pinocchio model (load included) whose frame `frame_id` is E, at (N, n) states.

    Analytic derivatives by Carpentier and Mansard, "Analytical derivatives of rigid body dynamics
    algorithms", RSS 2018, as Pinocchio provides them.
    """
    count, n = q.shape
    data = model.createData()
    p_SE, R_SE = np.empty((count, 3)), np.empty((count, 3, 3))
    twist, spatial = np.empty((count, 6)), np.empty((count, 6))
    twist_z, spatial_z = np.zeros((count, 6, 3 * n)), np.empty((count, 6, 3 * n))
    torque, torque_z = np.empty((count, n)), np.empty((count, n, 3 * n))
    for i in range(count):
        pin.computeForwardKinematicsDerivatives(model, data, q[i], dq[i], ddq[i])
        v_q, a_q, a_v, a_a = pin.getFrameAccelerationDerivatives(model, data, frame_id, pin.LOCAL)
        twist_z[i, :, :n], twist_z[i, :, n : 2 * n] = v_q, a_a
        spatial_z[i, :, :n], spatial_z[i, :, n : 2 * n], spatial_z[i, :, 2 * n :] = a_q, a_v, a_a
        placement = pin.updateFramePlacement(model, data, frame_id)
        p_SE[i], R_SE[i] = placement.translation, placement.rotation
        twist[i] = pin.getFrameVelocity(model, data, frame_id, pin.LOCAL).vector
        spatial[i] = pin.getFrameAcceleration(model, data, frame_id, pin.LOCAL).vector
        pin.computeRNEADerivatives(model, data, q[i], dq[i], ddq[i])
        torque[i] = data.tau
        torque_z[i, :, :n], torque_z[i, :, n : 2 * n] = data.dtau_dq, data.dtau_dv
        torque_z[i, :, 2 * n :] = data.M
    lower = np.tril_indices(n, -1)
    mass_matrix = torque_z[:, :, 2 * n :]
    mass_matrix[:, lower[0], lower[1]] = mass_matrix[:, lower[1], lower[0]]  # Pinocchio fills the upper triangle
    w, w_z = _tray_motion(R_SE, twist, twist_z, spatial, spatial_z)
    return MotionTerms(p_SE, R_SE, spatial_z[:, :, 2 * n :], w, w_z, torque, torque_z, mass_matrix)


def _tray_motion(R_SE: Array, twist: Array, twist_z: Array, spatial: Array, spatial_z: Array) -> tuple[Array, Array]:
    """w and its derivatives from the body twist and the spatial acceleration of E, both in E."""
    n = twist_z.shape[2] // 3
    v, omega = twist[:, :3], twist[:, 3:]
    v_z, omega_z = twist_z[:, :3], twist_z[:, 3:]
    up = -np.einsum("nji,j->ni", R_SE, GRAVITY_S)
    w, w_z = np.empty((len(v), N_MOTION)), np.empty((len(v), N_MOTION, 3 * n))
    w[:, :3] = spatial[:, :3] + np.cross(omega, v) + up
    w_z[:, :3] = spatial_z[:, :3] + _cross(omega, v_z) - _cross(v, omega_z)
    w_z[:, :3, :n] += _cross(up, spatial_z[:, 3:, 2 * n :])  # R turns by J_omega dq, in E
    w[:, 3:6], w_z[:, 3:6] = spatial[:, 3:], spatial_z[:, 3:]
    for k, (i, j) in enumerate(PRODUCTS, start=6):
        w[:, k] = omega[:, i] * omega[:, j]
        w_z[:, k] = omega[:, i, None] * omega_z[:, j] + omega[:, j, None] * omega_z[:, i]
    return w, w_z


def _cross(a: Array, columns: Array) -> Array:
    """a (N, 3) cross each column of (N, 3, m)."""
    x, y, z = (a[:, i, None] for i in range(3))
    c = columns
    return np.stack([y * c[:, 2] - z * c[:, 1], z * c[:, 0] - x * c[:, 2], x * c[:, 1] - y * c[:, 0]], axis=1)
