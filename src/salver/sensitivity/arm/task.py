"""Deviations under the loop on the object's pose (paper, eqs 22 and 25): first that of the tray, then of the joints.

The missing part of the commanded acceleration, m(t) = M^-1 J_E^T dF, has two parts. One drives the linear error
dynamics of the object,

    e_p'' + kd e_p' + kp e_p = R (J_b m)_v,        e_R'' + kd e_R' + kp e_R = (J_b m)_omega,

the other moves only the joints, in the null space of J, and drives the posture task: with P the projector on the null
space and x the deviation of q, P (x'' + kd x' + kp x) = -P m. It does not move the tray.
"""

from __future__ import annotations

import numpy as np

from salver.control.arm import POSTURE_GAINS
from salver.control.object import Gains
from salver.geometry import Array, hat
from salver.linear_filter import LinearFilter, settled
from salver.models.bodies import Body
from salver.models.rigid_body import PAIRS
from salver.models.tray_motion import frame_map
from salver.sensitivity.arm.terms import MotionTerms
from salver.sensitivity.arm.tracking import JointDeviation, Law, TrayDeviation

_FIRST, _SECOND = ([pair[k] for pair in PAIRS] for k in (0, 1))


def tray_of_task(
    t: Array, terms: MotionTerms, missing: Array, first: Body, gains: Gains, settle: float, before: Array
) -> TrayDeviation:
    """Deviation of the tray under the loop on the pose of the first object. missing: m (T, n, n_c).

    settle: s at rest before the start. before: (n_c,) 1 for terms that act during that rest too, else 0.
    """
    p, turn = first.p_EB, first.R_EB
    R_SB = terms.R_SE @ turn
    omega_E, alpha_E, force_E = terms.twist[:, 3:], terms.w[:, 3:6], terms.w[:, :3]
    lost = terms.jacobian @ missing
    linear = R_SB @ (turn.T @ (lost[:, :3] - hat(p) @ lost[:, 3:]))
    angular = turn.T @ lost[:, 3:]
    (kp, kp_R), (kd, kd_R) = gains.kp, gains.kd
    e_p, e_v, e_a = _answer(t, kp, kd, linear, settle, before)
    e_R, e_w, e_alpha = _answer(t, kp_R, kd_R, angular, settle, before)
    omega, alpha, force = omega_E @ turn, alpha_E @ turn, _force_at(force_E, omega_E, alpha_E, p) @ turn
    theta = -e_R
    d_omega = -e_w + hat(omega) @ theta
    d_alpha = -e_alpha - hat(omega) @ e_w + hat(alpha) @ theta
    d_force = hat(force) @ theta - np.swapaxes(R_SB, 1, 2) @ e_a
    products = omega[:, _FIRST, None] * d_omega[:, _SECOND] + omega[:, _SECOND, None] * d_omega[:, _FIRST]
    w = np.linalg.inv(frame_map(p, turn)) @ np.concatenate([d_force, d_alpha, products], axis=1)
    # From B to E, both fixed to the tray.
    theta_E, d_omega_E = turn @ theta, turn @ d_omega
    lever, spin = hat(p), hat(np.cross(omega_E, p))
    dp = -e_p + terms.R_SE @ (lever @ theta_E)
    dv = -e_v + terms.R_SE @ (spin @ theta_E + lever @ d_omega_E)
    return TrayDeviation(np.concatenate([dp, theta_E, dv, d_omega_E], axis=1), w)


def _answer(t: Array, kp: float, kd: float, drive: Array, settle: float, before: Array) -> tuple[Array, Array, Array]:
    """Error and its two derivatives (T, 3, n_c) of the loop's error dynamics; the drive is cubic between instants."""
    response = LinearFilter.on_nodes(t, kp, kd, 3)
    e, rate = response.respond(drive, settled(kp, kd, settle, drive[0] * before))
    return e, rate, response.acceleration(drive, e, rate)


def _force_at(force: Array, omega: Array, alpha: Array, p: Array) -> Array:
    """Specific force (T, 3) at a point p (3,) fixed to the frame."""
    return np.asarray(force + np.cross(alpha, p) + np.cross(omega, np.cross(omega, p)))


def joints_of_task(
    t: Array,
    terms: MotionTerms,
    tray: TrayDeviation,
    missing: Array,
    posture: tuple[float, float],
    settle: float,
    before: Array,
) -> JointDeviation:
    """Deviation of the joints from that of the tray and the posture task in the null space; t evenly spaced.

    posture: (kp, kd) of the task in the null space. settle, before: as in `tray_of_task`.
    """
    kp, kd = posture
    jacobian = terms.jacobian
    inverse = np.linalg.pinv(jacobian)
    shift, rate, acceleration = _in_tray_frame(terms, tray)
    n = jacobian.shape[2]
    null = np.eye(n) - inverse @ jacobian
    turning = inverse @ terms.jacobian_rate @ null
    null_rate = -turning - np.swapaxes(turning, 1, 2)
    least = inverse @ shift
    speed = inverse @ (rate - terms.twist_q @ least)
    lost = null @ missing
    # d/dt of (P x, P x'): a small linear system along time, in which the tray's deviation is an input.
    dynamics = np.block(
        [
            [null_rate, np.broadcast_to(np.eye(n), null.shape)],
            [-null_rate @ inverse @ terms.twist_q - kp * np.eye(n), null_rate - kd * np.eye(n)],
        ]
    )
    forcing = np.concatenate([null_rate @ least, null_rate @ speed - lost], axis=1)
    at_start = -settled(kp, kd, settle, lost[0] * before)
    inner = _integrate(t, dynamics, forcing, at_start.reshape(2 * n, -1))
    q = least + null @ inner[:, :n]
    dq = inverse @ (rate - terms.twist_q @ q) + null @ inner[:, n:]
    ddq = inverse @ (acceleration - terms.acceleration_q @ q - terms.acceleration_dq @ dq)
    ddq -= null @ (missing + kd * dq + kp * q)
    return JointDeviation(np.concatenate([q, dq, ddq], axis=1), missing)


def _in_tray_frame(terms: MotionTerms, tray: TrayDeviation) -> tuple[Array, Array, Array]:
    """Displacement of E, and deviations of its body twist and spatial acceleration, in E, each (T, 6, n_c)."""
    inverse = np.swapaxes(terms.R_SE, 1, 2)
    v, omega = hat(terms.twist[:, :3]), hat(terms.twist[:, 3:])
    theta, d_omega = tray.state[:, 3:6], tray.state[:, 9:]
    d_v = inverse @ tray.state[:, 6:9] + v @ theta
    linear = tray.w[:, :3] - hat(terms.up) @ theta + v @ d_omega - omega @ d_v
    shift = np.concatenate([inverse @ tray.state[:, :3], theta], axis=1)
    return shift, np.concatenate([d_v, d_omega], axis=1), np.concatenate([linear, tray.w[:, 3:6]], axis=1)


def _integrate(t: Array, matrix: Array, forcing: Array, start: Array) -> Array:
    """Solve x' = A x + b, x (T, m, n_c), A (T, m, m), b (T, m, n_c), on an even grid by the Runge-Kutta method of order
    4.

    The steps of all intervals are computed at once, as matrices on (x, 1); values between nodes are cubic.
    """
    h = t[1] - t[0]
    m = matrix.shape[1]
    whole = np.zeros((len(t), m + forcing.shape[2], m + forcing.shape[2]))
    whole[:, :m, :m], whole[:, :m, m:] = matrix, forcing
    begin, end, middle = whole[:-1], whole[1:], _between(whole)
    one = np.eye(whole.shape[1])
    k2 = middle @ (one + 0.5 * h * begin)
    k3 = middle @ (one + 0.5 * h * k2)
    k4 = end @ (one + h * k3)
    step = (one + h / 6 * (begin + 2 * k2 + 2 * k3 + k4))[:, :m]
    x = np.empty((len(t), *start.shape))
    x[0] = start
    for k in range(len(t) - 1):
        x[k + 1] = step[k, :, :m] @ x[k] + step[k, :, m:]
    return x


def _between(values: Array) -> Array:
    """Values (T - 1, ...) half way between evenly spaced nodes with values (T, ...), by cubics through four nodes."""
    middle = np.empty_like(values[1:])
    middle[1:-1] = (9 * (values[1:-2] + values[2:-1]) - values[:-3] - values[3:]) / 16
    middle[0] = (5 * values[0] + 15 * values[1] - 5 * values[2] + values[3]) / 16
    middle[-1] = (5 * values[-1] + 15 * values[-2] - 5 * values[-3] + values[-4]) / 16
    return middle


def task_law(t: Array, terms: MotionTerms, first: Body, gains: Gains, settle: float) -> Law:
    """The law of the loop on the pose of the first object, with the posture task in the null space; t evenly spaced."""

    def law(missing: Array, before: Array, start: Array | None = None) -> tuple[JointDeviation, TrayDeviation]:
        assert start is None, "motions under this loop begin at rest"
        tray = tray_of_task(t, terms, missing, first, gains, settle, before)
        return joints_of_task(t, terms, tray, missing, POSTURE_GAINS, settle, before), tray

    return law
