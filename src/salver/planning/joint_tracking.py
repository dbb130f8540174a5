"""What a wrong load does to an arm under computed torque, and so to the tray: first order, along a joint motion.

The controller carries the nominal load: tau = M_n (ddq* + kd e' + kp e) + h_n with e = q* - q. The true load
needs another wrench at the tray, dF = W_k w for parameter k (method: `salver.models.tray_motion`), and then

    e'' + kd e' + kp e = M_n^-1 J^T dF                                                            (1)

to first order: the same fixed linear filter for every joint, driven along the reference. The tray feels
dw = -(w_q e + w_dq e' + w_ddq e''). Before the motion the arm has already sagged for some time under the load.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_banded

from salver.geometry import Array
from salver.models.bodies import Body
from salver.models.interfaces import to_tray
from salver.models.parameters import INERTIAL, UncertainSet, inertial_vector, phi_of
from salver.models.tray_motion import frame_map, wrench_map
from salver.scenario import Scenario
from salver.sensitivity.arm_terms import MotionTerms


@dataclass(frozen=True)
class Tracking:
    """The closed loop's response to uncertain inertial parameters.

    names: the n_k parameters that act on the arm. wrench: (n_k, 6, 12), w of E to the change of the load's wrench
    at E for one half-range. kp, kd: joint gains, 1/s^2 and 1/s. settled: s at rest under the load before the start.
    spread: (n_k, n_k) factor of the ellipsoid's correlation, None for a box.
    """

    names: tuple[str, ...]
    wrench: Array
    kp: float
    kd: float
    settled: float
    spread: Array | None

    def response(self, s: Array, duration: float, terms: MotionTerms) -> Response:
        """Errors along a motion at nodes s (N,) in [0, 1]."""
        force = np.einsum("kij,nj->nik", self.wrench, terms.w)
        push = np.einsum("nji,njk->nik", terms.jacobian, force)
        drive = np.linalg.solve(terms.mass_matrix, push)
        error, rate = _filtered(drive, np.diff(s) * duration, self.kp, self.kd, self.settled)
        return Response(self, error, rate, drive - self.kd * rate - self.kp * error, terms)


@dataclass(frozen=True)
class Response:
    """error, rate, acceleration: (N, n, n_k) of e, e', e'' per half-range of each parameter."""

    tracking: Tracking
    error: Array
    rate: Array
    acceleration: Array
    terms: MotionTerms

    def motion_change(self) -> Array:
        """dw (N, 12, n_k)."""
        state = np.concatenate([self.error, self.rate, self.acceleration], axis=1)
        return -self.terms.w_z @ state

    def torque_radius(self) -> Array:
        """(N, n) most by which the commanded torque can differ from nominal, N m."""
        t, n = self.tracking, self.error.shape[1]
        change = self.terms.mass_matrix @ (t.kp * self.error + t.kd * self.rate)
        change -= self.terms.torque_z[:, :, :n] @ self.error + self.terms.torque_z[:, :, n : 2 * n] @ self.rate
        return radius(change, t.spread)

    def tray_radius(self) -> tuple[Array, Array]:
        """Largest error of the tray's position (N, 3), m, and of its orientation (N, 3), rad, both in E."""
        moved = radius(self.terms.jacobian @ self.error, self.tracking.spread)
        return moved[:, :3], moved[:, 3:]


def radius(change: Array, spread: Array | None) -> Array:
    """Worst case over the unit box or ellipsoid of sum_k s_k change_k, the last axis."""
    if spread is None:
        return np.abs(change).sum(axis=-1)
    return np.asarray(np.linalg.norm(change @ spread, axis=-1))


def tracking_of(items: list[Body], uncertain: UncertainSet, scenario: Scenario) -> Tracking | None:
    """The response to the scenario's uncertain masses, centres of mass, inertias and positions; None without any."""
    prefix = {item.name: f"{item.name}." if len(items) > 1 else "" for item in items}
    half = dict(zip(uncertain.names, uncertain.half_range, strict=True))
    names, maps = [], []
    for item in items:
        for name in (*INERTIAL, "position_x", "position_y"):
            full = prefix[item.name] + name
            if full in half:
                names.append(full)
                maps.append(0.5 * (_load(item, name, half[full]) - _load(item, name, -half[full])))
    if not names:
        return None
    spread = None
    if uncertain.kind == "ellipsoid":
        correlation = uncertain.restricted(tuple(names)).correlation
        spread = np.eye(len(names)) if correlation is None else np.asarray(np.linalg.cholesky(correlation))
    kp, kd = scenario.control.kp[0], scenario.control.kd[0]
    return Tracking(tuple(names), np.array(maps), kp, kd, scenario.physics.settle_before, spread)


def _load(item: Body, name: str, change: float) -> Array:
    """(6, 12) w of E to the wrench at E of an object one of whose parameters differs from nominal."""
    values, place = inertial_vector(item.inertial), item.p_EB.copy()
    if name in INERTIAL:
        values[INERTIAL.index(name)] += change
    else:
        place["xy".index(name[-1])] += change
    return np.asarray(to_tray(place, item.R_EB) @ wrench_map(phi_of(values)) @ frame_map(place, item.R_EB))


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
