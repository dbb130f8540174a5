"""The nonlinear closed loop, eqs (18) and (19), without the physics engine, for many true bodies at once.

The state is integrated in the controller's error coordinates (e_p, e_R, e_v, e_w), an exact change of variables on
SE(3): the rotation error is a rotation vector about the reference, so that no drift off the group can occur. Only the
deviation from the reference is integrated, with the *relative* accuracy of the integrator however small it is. Finite
differences of these rollouts are therefore good to many digits.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from scipy.interpolate import make_interp_spline

from salver.control.object import Errors, Gains, acceleration, apply, command
from salver.geometry import Array, exp, interpolated, right_jacobian_inverse
from salver.integration import integrate
from salver.models.rigid_body import RigidBody, spatial_inertia
from salver.models.tray_motion import motion_vector, wrench_map
from salver.sensitivity import tubes
from salver.trajectory import MotionSamples, Reference

if TYPE_CHECKING:
    from salver.planning.plan import Plan


@dataclass(frozen=True)
class Rollout:
    """Motions of n bodies with different true parameters under the same controller and reference.

    t: (T,) s. deviation: (n, T, 12) of the true state from the reference: (dp in S, dtheta in B with
    R = R* Exp(dtheta), dv in S, domega = omega - omega* in B). cone_coefficients: (n, T, n_lambda) Lambda, N.
    """

    t: Array
    deviation: Array
    cone_coefficients: Array


def rollout(
    reference: Reference,
    body: RigidBody,
    grasp_map: Array,
    gains: Gains,
    phi_samples: npt.ArrayLike,
    t: npt.ArrayLike,
    initial_deviation: npt.ArrayLike | None = None,
    max_step: float | None = None,
    step_times_rate: float = 0.625,
) -> Rollout:
    """Simulate the closed loop (18), (19) from t = 0 for n true bodies.

    The motion of a body that diverges is NaN from then on.

    Args:
        body: the nominal body, which the controller uses.
        grasp_map: (6, n_lambda) G F_hat.
        phi_samples: (n, 10) inertial parameters of the true bodies.
        t: (T,) increasing times >= 0, s.
        initial_deviation: (12,) or (n, 12) from the reference at t = 0, as `Rollout.deviation`; default zero.
        max_step: longest step, s; default from the gains (25 ms at the paper's). For a fast reference that is only
            piecewise smooth, give the spacing of its knots.
        step_times_rate: that default times the fastest rate of the error dynamics, with an error below 1e-6 of the
            deviation, usually below 1e-7 (benchmarks/rollouts.py).

    Raises:
        ValueError: t does not increase from a value >= 0.
    """
    phi = np.atleast_2d(np.asarray(phi_samples, dtype=float))
    t = np.atleast_1d(np.asarray(t, dtype=float))
    if t[0] < 0 or np.any(np.diff(t) <= 0):
        raise ValueError("t must increase, and begin at 0 or later")
    to_inputs = (np.linalg.pinv(grasp_map) @ wrench_map(body.phi)).T
    inverse_inertia = np.asarray(np.linalg.inv(spatial_inertia(phi)), dtype=float)
    loop = _Loop(gains, grasp_map, to_inputs, phi, inverse_inertia)
    if max_step is None:
        max_step = step_times_rate / max(*gains.kd, *np.sqrt(gains.kp))
    wanted = reference.sample(t)
    start = _from_deviation(initial_deviation, len(phi), reference.sample(0.0))

    def rate(now: float, state: Array) -> Array:
        return loop.rate(reference.sample(now), state)

    states = integrate(rate, start, 0.0, t, max_step, corners=(reference.duration,))
    if len(phi) > 1 and np.isnan(states).any():  # one that diverges ends all that are integrated with it
        begins = np.broadcast_to(0.0 if initial_deviation is None else initial_deviation, (len(phi), 12))
        halves = (slice(None, len(phi) // 2), slice(len(phi) // 2, None))
        parts = [rollout(reference, body, grasp_map, gains, phi[k], t, begins[k], max_step) for k in halves]
        both = (np.concatenate(x) for x in zip(*((p.deviation, p.cone_coefficients) for p in parts), strict=True))
        return Rollout(t, *both)
    deviation = np.empty((len(phi), len(t), 12))
    coefficients = np.empty((len(phi), len(t), grasp_map.shape[1]))
    for row, state in enumerate(states):
        samples = wanted.only(slice(row, row + 1))
        deviation[:, row] = _deviation(samples, state)
        coefficients[:, row] = loop.inputs(samples, *loop.errors(samples, state))
    return Rollout(t, deviation, coefficients)


@dataclass(frozen=True)
class _Loop:
    """to_inputs: (12, n_lambda) from the commanded motion regressor of B to the cone coefficients."""

    gains: Gains
    grasp_map: Array
    to_inputs: Array
    phi: Array
    inverse_inertia: Array

    def errors(self, reference: MotionSamples, state: Array) -> tuple[Errors, Array, Array]:
        """The controller's errors of a state (n, 12) = (e_p, e_R, e_v, e_w), with R_SB and omega_B."""
        error = Errors(state[:, :3], state[:, 3:6], state[:, 6:9], state[:, 9:], exp(state[:, 3:6]))
        R_SB = reference.R_SB @ np.swapaxes(error.transport, -1, -2)
        return error, R_SB, apply(error.transport, reference.omega_B) - error.omega_B

    def inputs(self, reference: MotionSamples, error: Errors, R_SB: Array, omega_B: Array) -> Array:
        """Cone coefficients Lambda (n, n_lambda), N: eq (19)."""
        a_cmd_S, alpha_cmd_B = command(self.gains, reference, error)
        return motion_vector(R_SB, a_cmd_S, omega_B, alpha_cmd_B) @ self.to_inputs

    def rate(self, reference: MotionSamples, state: Array) -> Array:
        """Time derivative (n, 12) of the errors: that of the reference minus that of the plant, eq (18)."""
        error, R_SB, omega = self.errors(reference, state)
        wrench_B = self.inputs(reference, error, R_SB, omega) @ self.grasp_map.T
        a_S, alpha = acceleration(self.phi, R_SB, omega, wrench_B, self.inverse_inertia)
        transported = omega + error.omega_B
        e_w_rate = apply(error.transport, reference.alpha_B) - np.cross(omega, transported) - alpha
        e_R_rate = apply(right_jacobian_inverse(-error.rotation_B), error.omega_B)
        return np.concatenate([error.velocity_S, e_R_rate, reference.a_S - a_S, e_w_rate], axis=1)


def _deviation(reference: MotionSamples, state: Array) -> Array:
    """The deviation (n, 12) of the state from its errors (n, 12), rows as in docs/conventions.md."""
    e_p, e_R, e_v, e_w = state[:, :3], state[:, 3:6], state[:, 6:9], state[:, 9:]
    domega = apply(exp(e_R) - np.eye(3), reference.omega_B) - e_w
    return np.concatenate([-e_p, -e_R, -e_v, domega], axis=1)


def _from_deviation(deviation: npt.ArrayLike | None, n: int, reference: MotionSamples) -> Array:
    """Errors (n, 12) from the deviation: the inverse of `_deviation`."""
    if deviation is None:
        return np.zeros((n, 12))
    d = np.broadcast_to(np.asarray(deviation, dtype=float), (n, 12))
    e_w = apply(exp(-d[:, 3:6]) - np.eye(3), reference.omega_B) - d[:, 9:]
    return np.concatenate([-d[:, :3], -d[:, 3:6], -d[:, 6:9], e_w], axis=1)


def tube_scalars(plan: Plan, t: Array, coefficients: Array) -> dict[str, float | None]:
    """Least cone coefficient of a run, and the excess of its coefficients over the plan's tube (negative: inside).

    coefficients: (T, n_lambda) at t (T,); only those during the motion count. tube_excess: largest
    |Lambda - nominal| - radius, N. tube_excess_relative: as a share of the largest radius. tube_excess_settled: that
    share from 8 / kd on, when the controller's transient has decayed to 2 %. Before, run and tube are not comparable:
    the tube of eq (19) starts with zero width, because the controller starts with the nominal wrench, whereas an object
    on a real tray presses with its true weight from the start.
    """
    if coefficients is None or not len(plan.cone_radius):
        return {}
    within = (t >= 0) & (t <= plan.t[-1])
    t, coefficients = t[within], coefficients[within]
    if len(t) == 0 or not np.all(np.isfinite(coefficients)):
        return {}
    nominal = make_interp_spline(plan.t, plan.cone_coefficients, k=3)(t)
    radius = interpolated(plan.t, plan.cone_radius, t)
    excess = tubes.excess(coefficients, nominal, radius)
    when = int(np.argmax(excess.max(axis=1)))
    largest = float(plan.cone_radius.max())
    return {
        "cone_least": float(coefficients.min()),
        "tube_excess": float(excess.max()),
        "tube_excess_relative": _largest(excess, largest),
        "tube_excess_settled": _largest(excess[t >= 8 / min(plan.scenario.control.kd)], largest),
        "tube_excess_time": float(t[when]),
    }


def _largest(excess: Array, radius: float) -> float | None:
    return float(excess.max() / radius) if radius > 0 and excess.size else None
