"""The carried object and its controller, eqs (18) and (19), as expressions for the general engine: what the linear
filter of `salver.sensitivity.tray` is held against.

The state is the deviation from the reference in the tangent space, so that Pi has the rows of
docs/conventions.md: (dp in S, dtheta in B with R = R* Exp(dtheta), dv in S, domega = omega - omega* in B).
Nominally it stays zero. The plant is Newton's and Euler's law at the true centre of mass, which is not how
`salver.control.object` writes it.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from salver import trajectory
from salver.control.object import Gains
from salver.geometry import GRAVITY_S, Array
from salver.models.rigid_body import RigidBody
from salver.models.uncertain.parameters import INERTIAL, inertial_vector
from salver.sensitivity.engine import ClosedLoop, SampledReference, Sensitivity, sensitivity
from salver.sensitivity.symbolic import ca
from salver.trajectory import Reference


def tray_loop(body: RigidBody, grasp_map: Array, gains: Gains, names: tuple[str, ...]) -> ClosedLoop:
    """Closed loop of a body on a tray; names: the uncertain ones of `salver.models.uncertain.parameters.INERTIAL`.

    Its y_d is (R_SB by columns, a_S, omega_B, alpha_B), 18 numbers: see `sampled`.
    Raises ValueError for a name that does not act through the dynamics.
    """
    unknown = [name for name in names if name not in INERTIAL]
    if unknown:
        raise ValueError(f'"{unknown[0]}" does not act through the dynamics; accepted are {", ".join(INERTIAL)}')
    x, u, y_d = ca.SX.sym("x", 12), ca.SX.sym("u", grasp_map.shape[1]), ca.SX.sym("y_d", 18)
    p, p_nominal = ca.SX.sym("p", len(names)), ca.SX.sym("p_nominal", len(names))
    dp, dtheta, dv, domega = ca.vertsplit(x, 3)
    R_reference = ca.reshape(y_d[:9], 3, 3)
    a_reference, omega_reference, alpha_reference = ca.vertsplit(y_d[9:], 3)
    R = R_reference @ _exp(dtheta)
    omega = omega_reference + domega
    transport = _exp(-dtheta)  # E = R^T R*
    transported = transport @ omega_reference

    mass, c, inertia = _body(body, names, p)
    wrench = ca.DM(grasp_map) @ u
    force, torque = wrench[:3], wrench[3:]
    alpha = ca.inv(inertia) @ (torque - ca.cross(c, force) - ca.cross(omega, inertia @ omega))
    a_com = R @ force / mass + ca.DM(GRAVITY_S)
    a = a_com - R @ (ca.cross(alpha, c) + ca.cross(omega, ca.cross(omega, c)))
    dtheta_rate = _right_jacobian_inverse(dtheta) @ (omega - transported)
    f = ca.vertcat(dv, dtheta_rate, a - a_reference, alpha - alpha_reference)

    (kp, kp_R), (kd, kd_R) = gains.kp, gains.kd
    a_cmd = a_reference - kd * dv - kp * dp
    alpha_cmd = (
        transport @ alpha_reference - ca.cross(omega, transported) + kd_R * (transported - omega) - kp_R * dtheta
    )
    mass_n, c_n, inertia_n = _body(body, names, p_nominal)
    a_com_cmd = R.T @ (a_cmd - ca.DM(GRAVITY_S)) + ca.cross(alpha_cmd, c_n) + ca.cross(omega, ca.cross(omega, c_n))
    force_cmd = mass_n * a_com_cmd
    torque_cmd = ca.cross(c_n, force_cmd) + inertia_n @ alpha_cmd + ca.cross(omega, inertia_n @ omega)
    h = ca.DM(np.linalg.pinv(grasp_map)) @ ca.vertcat(force_cmd, torque_cmd)
    return ClosedLoop(x=x, u=u, p=p, f=f, h=h, p_nominal=p_nominal, y_d=y_d)


def sampled(reference: Reference) -> SampledReference:
    """y_d of `tray_loop` at times (K,): (K, 18)."""

    def y_d(t: Array) -> Array:
        m = reference.sample(t)
        by_columns = np.swapaxes(m.R_SB, 1, 2).reshape(-1, 9)
        return np.concatenate([by_columns, m.a_S, m.omega_B, m.alpha_B], axis=1)

    return y_d


def tray_sensitivity(
    body: RigidBody,
    grasp_map: Array,
    gains: Gains,
    names: tuple[str, ...],
    reference: Reference,
    t: npt.ArrayLike,
    tolerance: float = 1e-9,
) -> Sensitivity:
    """Pi (T, 12, n_p) and Theta (T, n_lambda, n_p) along a reference by the general engine, at increasing times t."""
    loop = tray_loop(body, grasp_map, gains, names)
    nominal = inertial_vector(body)[[INERTIAL.index(name) for name in names]]
    corners = [reference.duration]
    if isinstance(reference, trajectory.SampledReference):  # its jerk jumps at each
        corners = reference.samples.t.tolist()
    return sensitivity(loop, nominal, t, np.zeros(12), (), sampled(reference), tolerance=tolerance, corners=corners)


def _body(body: RigidBody, names: tuple[str, ...], p: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Mass, centre of mass, inertia about it, with the named ones taken from p."""
    values = [ca.SX(float(value)) for value in inertial_vector(body)]
    for k, name in enumerate(names):
        values[INERTIAL.index(name)] = p[k]
    xx, xy, yy, xz, yz, zz = values[4:]
    inertia = ca.blockcat([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return values[0], ca.vertcat(*values[1:4]), inertia


def _angle(theta: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
    """|theta|^2, whether it is too small for closed forms, and a safe |theta|: both branches stay differentiable."""
    square = ca.sumsqr(theta)
    small = square < 1e-4
    return square, small, ca.sqrt(ca.if_else(small, 1.0, square))


def _exp(theta: ca.SX) -> ca.SX:
    square, small, angle = _angle(theta)
    a = ca.if_else(small, 1 - square / 6 + square**2 / 120, ca.sin(angle) / angle)
    b = ca.if_else(small, 1 / 2 - square / 24 + square**2 / 720, 2 * (ca.sin(angle / 2) / angle) ** 2)
    skew = ca.skew(theta)
    return ca.SX.eye(3) + a * skew + b * (skew @ skew)


def _right_jacobian_inverse(theta: ca.SX) -> ca.SX:
    square, small, angle = _angle(theta)
    closed = 1 / angle**2 - (1 + ca.cos(angle)) / (2 * angle * ca.sin(angle))
    factor = ca.if_else(small, 1 / 12 + square / 720 + square**2 / 30240, closed)
    skew = ca.skew(theta)
    return ca.SX.eye(3) + 0.5 * skew + factor * (skew @ skew)
