"""What a wrong load does to an arm under computed torque, and so to the tray: first order, along a joint motion.

The controller carries the nominal load: tau = M_n (ddq* + kd e' + kp e) + h_n with e = q* - q. The true load
needs another wrench at the tray, dF = W_k w for parameter k (`salver.sensitivity.arm.load`; products of two
parameters are terms of their own), and then

    e'' + kd e' + kp e = M_n^-1 J^T dF                                                            (1)

to first order: the same fixed linear filter for every joint, driven along the reference. The tray feels
dw = -(w_q e + w_dq e' + w_ddq e''). Before the motion the arm has already sagged for some time under the load.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_banded

from salver.geometry import Array
from salver.models.parameters import Parameter
from salver.models.payload import Payload
from salver.models.worst_case import Drift
from salver.scenario import Scenario
from salver.sensitivity.arm.load import load_change
from salver.sensitivity.arm.terms import MotionTerms


@dataclass(frozen=True)
class Tracking:
    """The closed loop's response to uncertain loads.

    terms: what acts on the arm, n_k: first single parameters, then products of two.
    wrench: (n_k, 6, 12), w of E to the change of the load's wrench at E for one half-range. kp, kd: joint gains, 1/s^2
    and 1/s. settled: s at rest under the load before the start. spread: factor of the ellipsoid's correlation, None
    for a box.
    """

    terms: tuple[tuple[Parameter, ...], ...]
    wrench: Array
    kp: float
    kd: float
    settled: float
    spread: Array | None

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(factors[0] for factors in self.terms if len(factors) == 1)

    def response(self, s: Array, duration: float, terms: MotionTerms) -> Response:
        """Errors along a motion at nodes s (N,) in [0, 1]."""
        force = terms.w @ self.wrench.reshape(-1, self.wrench.shape[2]).T
        push = np.swapaxes(force.reshape(len(terms.w), -1, 6) @ terms.jacobian, 1, 2)
        drive = np.asarray(np.linalg.solve(terms.mass_matrix, push))
        error, rate = _filtered(drive, np.diff(s) * duration, self.kp, self.kd, self.settled)
        return Response(self, error, rate, drive - self.kd * rate - self.kp * error, terms)

    def radius(self, change: Array) -> Array:
        """Worst case (...) of sum_k s_k change_k (..., n_k) over the parameters' unit box or ellipsoid."""
        if self.spread is None:
            return np.abs(change).sum(axis=-1)
        first = len(self.parameters)
        within = np.linalg.norm(change[..., :first] @ self.spread, axis=-1)
        return np.asarray(within + np.abs(change[..., first:]).sum(axis=-1))


@dataclass(frozen=True)
class Response:
    """error, rate, acceleration: (N, n, n_k) of e, e', e'' per half-range of each term."""

    tracking: Tracking
    error: Array
    rate: Array
    acceleration: Array
    terms: MotionTerms

    def drift(self) -> Drift:
        """What the tray feels beyond w."""
        state = np.concatenate([self.error, self.rate, self.acceleration], axis=1)
        return Drift(self.tracking.terms, -self.terms.w_z @ state)

    def torque_radius(self) -> Array:
        """(N, n) most by which the commanded torque can differ from nominal, N m."""
        t, n = self.tracking, self.error.shape[1]
        change = self.terms.mass_matrix @ (t.kp * self.error + t.kd * self.rate)
        change -= self.terms.torque_z[:, :, :n] @ self.error + self.terms.torque_z[:, :, n : 2 * n] @ self.rate
        return t.radius(change)

    def tray_radius(self) -> tuple[Array, Array]:
        """Largest error of the tray's position (N, 3), m, and of its orientation (N, 3), rad, both in E."""
        moved = self.tracking.radius(self.terms.jacobian @ self.error)
        return moved[:, :3], moved[:, 3:]


def tracking_of(scenario: Scenario, payload: Payload) -> Tracking | None:
    """The response to everything uncertain that changes the load; None without any."""
    load = load_change(payload)
    maps = load.load_p * load.half_range[:, None, None]
    acting = np.abs(maps).max(axis=(1, 2), initial=0.0) > 1e-12
    if not acting.any():
        return None
    terms = tuple(factors for factors, acts in zip(load.terms, acting, strict=True) if acts)
    spread = load.uncertain.restricted([factors[0] for factors in terms if len(factors) == 1]).spread
    kp, kd = scenario.control.kp[0], scenario.control.kd[0]
    return Tracking(terms, maps[acting], kp, kd, scenario.physics.settle_before, spread)


def _filtered(drive: Array, steps: Array, kp: float, kd: float, settled: float) -> tuple[Array, Array]:
    """e and e' of (1) at the nodes, for a drive (N, ...) that is linear between them and was constant before."""
    # Two first-order modes: e = Re-combination of z_i' = r_i z_i + drive; distinct roots unless exactly critical.
    root = np.sqrt(complex(kd * kd / 4 - kp))
    if abs(root) < 1e-6 * kd:
        root = complex(1e-6 * kd)
    roots = -0.5 * kd + np.array([root, -root])
    modes = []
    for r in roots:
        decay = np.exp(r * steps)
        hold = (decay - 1) / r
        ramp = (hold - steps) / (r * steps)
        # z_k+1 - decay_k z_k = what the drive adds in step k; all steps at once, as a bidiagonal system.
        added = np.empty((len(drive), drive[0].size), dtype=complex)
        flat = drive.reshape(len(drive), -1)
        added[0] = (np.exp(r * settled) - 1) / r * flat[0]
        added[1:] = (hold - ramp)[:, None] * flat[:-1] + ramp[:, None] * flat[1:]
        bands = np.ones((2, len(drive)), dtype=complex)
        bands[1, :-1] = -decay
        modes.append(solve_banded((1, 0), bands, added, overwrite_b=True, check_finite=False).reshape(drive.shape))
    gap = roots[0] - roots[1]
    error = ((modes[0] - modes[1]) / gap).real
    rate = ((roots[0] * modes[0] - roots[1] * modes[1]) / gap).real
    return error, rate
