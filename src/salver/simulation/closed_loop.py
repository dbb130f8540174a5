"""The perturbed closed loop without an engine: eqs (18), (19) in full, for many true bodies at once.

Integrated in the controller's own error coordinates (e_p, e_R, e_v, e_w), which is an exact change of
variables on SE(3): the rotation error is a rotation vector that the integrator re-centres on the reference
at every instant, so no drift off the group can occur. The reference itself then carries no integration
error, and what is integrated is the deviation: its *relative* accuracy is that of the integrator, however
small the deviation is. Finite differences of these rollouts are therefore good to many digits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from salver.control.object import Errors, Gains, acceleration, apply, command
from salver.geometry import Array, Mask, exp, right_jacobian_inverse
from salver.integration import Rate, integrate
from salver.models.rigid_body import RigidBody, spatial_inertia, wrench
from salver.sensitivity import tubes
from salver.trajectory import MotionSamples, Reference

# Longest step times the fastest rate of the error dynamics: the error is then below 1e-6 of the deviation, usually
# below 1e-7 (benchmarks/rollouts.py).
STEP_TIMES_RATE = 0.625


@dataclass(frozen=True)
class Rollout:
    """Motions of n bodies with different true parameters under the same controller and reference.

    t: (T,) s. deviation: (n, T, 12) of the true state from the reference: (dp in S, dtheta in B with
    R = R* Exp(dtheta), dv in S, domega = omega - omega* in B). cone_coefficients: (n, T, n_lambda) Lambda, N.
    Row i is one body's record, time first.
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
) -> Rollout:
    """Closed loop (18), (19) from t = 0 at the reference's initial state, for true bodies phi (n, 10).

    body: what the controller believes. grasp_map: (6, n_lambda) G F_hat. t: (T,) increasing times >= 0.
    initial_deviation: (12,) or (n, 12) start off the reference, as `Rollout.deviation`; zero by default.
    max_step: longest step, s; by default from the gains (25 ms at the paper's). Give the spacing of the knots
        of a reference that is only piecewise smooth and moves fast.
    Raises ValueError when t does not increase from a value >= 0.
    """
    phi = np.atleast_2d(np.asarray(phi_samples, dtype=float))
    t = np.atleast_1d(np.asarray(t, dtype=float))
    if t[0] < 0 or np.any(np.diff(t) <= 0):
        raise ValueError("t must increase from a value that is not negative")
    grasp_inverse = np.asarray(np.linalg.pinv(grasp_map), dtype=float)
    inverse_inertia = np.asarray(np.linalg.inv(spatial_inertia(phi)), dtype=float)
    loop = _Loop(gains, body.phi, grasp_map, grasp_inverse, phi, inverse_inertia)
    if max_step is None:
        max_step = STEP_TIMES_RATE / max(*gains.kd, *np.sqrt(gains.kp))
    wanted = reference.sample(t)
    start = _from_deviation(initial_deviation, len(phi), reference.sample(0.0))

    def rates_at(instants: Array) -> Rate:
        samples = reference.sample(instants)
        return lambda k, state: loop.rate(samples.only(slice(k, k + 1)), state)

    states = integrate(rates_at, start, 0.0, t, max_step, corners=(reference.duration,))
    deviation = np.empty((len(phi), len(t), 12))
    coefficients = np.empty((len(phi), len(t), grasp_map.shape[1]))
    for row, state in enumerate(states):
        samples = wanted.only(slice(row, row + 1))
        deviation[:, row] = _deviation(samples, state)
        coefficients[:, row] = loop.inputs(samples, *loop.errors(samples, state))
    return Rollout(t, deviation, coefficients)


@dataclass(frozen=True)
class _Loop:
    gains: Gains
    phi_nominal: Array
    grasp_map: Array
    grasp_inverse: Array
    phi: Array
    inverse_inertia: Array

    def errors(self, reference: MotionSamples, state: Array) -> tuple[Errors, Array, Array]:
        """The controller's errors of a state (n, 12) = (e_p, e_R, e_v, e_w), with R_SB and omega_B."""
        error = Errors(state[:, :3], state[:, 3:6], state[:, 6:9], state[:, 9:], exp(state[:, 3:6]))
        R_SB = reference.R_SB @ np.swapaxes(error.transport, -1, -2)
        return error, R_SB, apply(error.transport, reference.omega_B) - error.omega_B

    def inputs(self, reference: MotionSamples, error: Errors, R_SB: Array, omega_B: Array) -> Array:
        """Lambda (n, n_lambda), eq (19)."""
        a_cmd_S, alpha_cmd_B = command(self.gains, reference, error)
        return wrench(self.phi_nominal, R_SB, a_cmd_S, omega_B, alpha_cmd_B) @ self.grasp_inverse.T

    def rate(self, reference: MotionSamples, state: Array) -> Array:
        """d/dt (n, 12) of the errors: those of the reference less those of the plant, eq (18)."""
        error, R_SB, omega = self.errors(reference, state)
        wrench_B = self.inputs(reference, error, R_SB, omega) @ self.grasp_map.T
        a_S, alpha = acceleration(self.phi, R_SB, omega, wrench_B, self.inverse_inertia)
        transported = omega + error.omega_B
        e_w_rate = apply(error.transport, reference.alpha_B) - np.cross(omega, transported) - alpha
        e_R_rate = apply(right_jacobian_inverse(-error.rotation_B), error.omega_B)
        return np.concatenate([error.velocity_S, e_R_rate, reference.a_S - a_S, e_w_rate], axis=1)


def _deviation(reference: MotionSamples, state: Array) -> Array:
    """Errors (n, 12) to the deviation of the state, rows of docs/conventions.md."""
    e_p, e_R, e_v, e_w = state[:, :3], state[:, 3:6], state[:, 6:9], state[:, 9:]
    domega = apply(exp(e_R) - np.eye(3), reference.omega_B) - e_w
    return np.concatenate([-e_p, -e_R, -e_v, domega], axis=1)


def _from_deviation(deviation: npt.ArrayLike | None, n: int, reference: MotionSamples) -> Array:
    """Inverse of `_deviation`, (n, 12)."""
    if deviation is None:
        return np.zeros((n, 12))
    d = np.broadcast_to(np.asarray(deviation, dtype=float), (n, 12))
    e_w = apply(exp(-d[:, 3:6]) - np.eye(3), reference.omega_B) - d[:, 9:]
    return np.concatenate([-d[:, :3], -d[:, 3:6], -d[:, 6:9], e_w], axis=1)


ROUNDING = 1e-9  # in the unit of each quantity; leaving a tube by less is not leaving it


@dataclass(frozen=True)
class Coverage:
    """How n sampled records (n, T, c) lie in c tubes: eq (12).

    names: (c,) of the quantities. excess: (n, c) the largest |value - nominal| - radius over time, in the unit of
    the quantity; negative when the record stays inside. relative: (n, c) excess over the *largest* radius of that
    tube (with one parameter a radius passes through zero, so a ratio at an instant says nothing).
    when: (n, c) time of the excess, s. tolerance: share of the largest radius that does not count as leaving.
    """

    names: tuple[str, ...]
    excess: Array
    relative: Array
    when: Array
    tolerance: float

    @property
    def outside(self) -> Mask:
        """(n, c) whether a record left a tube."""
        return (self.excess > ROUNDING) & (self.relative > self.tolerance)

    @property
    def left(self) -> int:
        """Number of the n records that left at least one of their tubes."""
        return int(self.outside.any(axis=1).sum())

    @property
    def worst(self) -> tuple[int, int]:
        """(sample, quantity) with the largest relative excess among those outside; of all when none is."""
        score = np.where(self.outside, self.relative, -np.inf)
        if not self.outside.any():
            score = np.where(np.isfinite(self.relative), self.relative, -np.inf)
        sample, quantity = np.unravel_index(np.argmax(score), score.shape)
        return int(sample), int(quantity)

    def __str__(self) -> str:
        n, (i, j) = len(self.excess), self.worst
        if not self.left:
            return f"all {n} records stayed in their {len(self.names)} tubes"
        share = f"{100 * self.relative[i, j]:.2g} % of the largest radius"
        where = f"{self.names[j]} at t = {self.when[i, j]:.3g} s"
        return f"{self.left} of {n} records left a tube, the worst by {self.excess[i, j]:.3g} ({share}) in {where}"


def coverage(
    t: npt.ArrayLike,
    values: Array,
    nominal: Array,
    radius: Array,
    names: Sequence[str],
    tolerance: float = 1e-6,
) -> Coverage:
    """Which of the sampled records `values` (n, T, c) left the tubes nominal +- radius, each (T, c).

    For states pass `Rollout.deviation`, nominal zero; for inputs `Rollout.cone_coefficients`.
    The default tolerance is the rollouts' own accuracy.
    """
    beyond = tubes.excess(values, nominal, radius)
    at = beyond.argmax(axis=1)
    excess = np.take_along_axis(beyond, at[:, None], axis=1)[:, 0]
    peak = radius.max(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = np.where(excess == 0, 0.0, excess / peak)
    return Coverage(tuple(names), excess, relative, np.asarray(t, dtype=float)[at], tolerance)
