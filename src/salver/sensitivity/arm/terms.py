"""What the tray feels along a joint motion and the torque it takes, with exact derivatives by (q, dq, ddq).

Analytic derivatives by Carpentier and Mansard, "Analytical derivatives of rigid body dynamics algorithms",
RSS 2018, as Pinocchio provides them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from salver.geometry import GRAVITY_S, Array, hat
from salver.models.tray_motion import N_MOTION, PRODUCTS

_FIRST, _SECOND = ([pair[k] for pair in PRODUCTS] for k in (0, 1))


@dataclass(frozen=True)
class MotionTerms:
    """At T instants of an arm with n joints; E is the tray's frame, everything of it in E.

    p_SE (T, 3), R_SE (T, 3, 3). twist (T, 6), and twist_q (T, 6, n) its derivative. jacobian (T, 6, n): of twist by
    dq, and of the spatial acceleration by ddq. acceleration_q, acceleration_dq (T, 6, n): derivatives of the spatial
    acceleration. torque (T, n) N m with the load, torque_z (T, n, 3 n). mass_matrix (T, n, n).
    w (T, 12) what the tray feels (`salver.models.tray_motion`), w_z (T, 12, 3 n).
    """

    p_SE: Array
    R_SE: Array
    twist: Array
    twist_q: Array
    jacobian: Array
    acceleration_q: Array
    acceleration_dq: Array
    torque: Array
    torque_z: Array
    w: Array
    w_z: Array

    @property
    def mass_matrix(self) -> Array:
        return self.torque_z[:, :, -self.torque.shape[1] :]

    @property
    def jacobian_rate(self) -> Array:
        """dJ/dt (T, 6, n): J' dq is quadratic in dq, and J' what its derivative leaves beyond twist_q."""
        return self.acceleration_dq - self.twist_q

    @property
    def up(self) -> Array:
        """(T, 3) -g in E."""
        return -np.einsum("tji,j->ti", self.R_SE, GRAVITY_S)


def motion_terms(model: Any, frame_id: int, q: Array, dq: Array, ddq: Array) -> MotionTerms:
    """Terms of a Pinocchio model, load included, whose frame `frame_id` is E, at states (T, n)."""
    count, n = q.shape
    data = model.createData()
    p_SE, R_SE = np.empty((count, 3)), np.empty((count, 3, 3))
    twist, spatial = np.empty((count, 6)), np.empty((count, 6))
    parts = np.empty((4, count, 6, n))
    torque, torque_z = np.empty((count, n)), np.empty((count, n, 3 * n))
    for i in range(count):
        pin.computeForwardKinematicsDerivatives(model, data, q[i], dq[i], ddq[i])
        # Velocity by q; acceleration by q, dq and ddq. The last is the Jacobian.
        parts[:, i] = pin.getFrameAccelerationDerivatives(model, data, frame_id, pin.LOCAL)
        placement = pin.updateFramePlacement(model, data, frame_id)
        p_SE[i], R_SE[i] = placement.translation, placement.rotation
        twist[i] = pin.getFrameVelocity(model, data, frame_id, pin.LOCAL).vector
        spatial[i] = pin.getFrameAcceleration(model, data, frame_id, pin.LOCAL).vector
        pin.computeRNEADerivatives(model, data, q[i], dq[i], ddq[i])
        torque[i] = data.tau
        torque_z[i, :, :n], torque_z[i, :, n : 2 * n] = data.dtau_dq, data.dtau_dv
        torque_z[i, :, 2 * n :] = data.M
    mass_matrix = torque_z[:, :, 2 * n :]
    upper = np.triu(mass_matrix)  # Pinocchio fills this half
    mass_matrix[:] = upper + np.swapaxes(np.triu(upper, 1), 1, 2)
    w, w_z = _felt(R_SE, twist, spatial, parts)
    return MotionTerms(p_SE, R_SE, twist, parts[0], parts[3], parts[1], parts[2], torque, torque_z, w, w_z)


def _felt(R_SE: Array, twist: Array, spatial: Array, parts: Array) -> tuple[Array, Array]:
    """w and its derivatives from the body twist and the spatial acceleration of E."""
    twist_q, acceleration_q, acceleration_dq, jacobian = parts
    count, _, n = jacobian.shape
    v, omega = twist[:, :3], twist[:, 3:]
    up = -np.einsum("tji,j->ti", R_SE, GRAVITY_S)
    w = np.concatenate(
        [spatial[:, :3] + np.cross(omega, v) + up, spatial[:, 3:], omega[:, _FIRST] * omega[:, _SECOND]], axis=1
    )
    zero = np.zeros_like(jacobian)
    twist_z = np.concatenate([twist_q, jacobian, zero], axis=2)
    w_z = np.empty((count, N_MOTION, 3 * n))
    w_z[:, :6] = np.concatenate([acceleration_q, acceleration_dq, jacobian], axis=2)
    w_z[:, :3] += hat(omega) @ twist_z[:, :3] - hat(v) @ twist_z[:, 3:]
    w_z[:, :3, :n] += hat(up) @ jacobian[:, 3:]  # E turns by the Jacobian's rotation
    omega_z = twist_z[:, 3:]
    w_z[:, 6:] = omega[:, _FIRST, None] * omega_z[:, _SECOND] + omega[:, _SECOND, None] * omega_z[:, _FIRST]
    return w, w_z
