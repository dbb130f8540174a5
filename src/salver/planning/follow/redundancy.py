"""Joint motions for a given motion of the tray, and the choice of the redundant degrees of freedom.

The tray's pose gives six conditions on n joints; a redundant arm has n - 6 degrees of freedom left. They are fixed by
linear functions of the joints, C q = s(t), with C as near as possible to the null spaces of the Jacobian along the
motion (an extended Jacobian: Baillieul 1985), and s(t) a polynomial at rest at both ends. So q(t) is the root of a
square system at each instant, whatever path led there: it does not drift, and velocity and acceleration are its exact
derivatives,

    [J; C] dq = [V; s'],    [J; C] ddq = [V' - J' dq; s''].

The coefficients of s(t) keep positions, speeds, accelerations and torques far from their limits, and the arm
far from singular postures.

An arm with fewer than six joints has no such freedom and can follow some motions only: the systems are then solved by
least squares, and accepted if the residual vanishes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import pinocchio as pin

from salver.geometry import Array, invert, log
from salver.models.arm.arm import ArmModel
from salver.models.arm.arm_geometry import ArmGeometry
from salver.models.arm.arm_limits import LIMITS
from salver.planning.follow.descent import descend
from salver.planning.postures import REACHED
from salver.trajectory import MotionSamples, Reference


@dataclass(frozen=True)
class TrayPath:
    """Motion of the tray's frame E at N instants: pose, body twist (v, omega) and its derivative."""

    t: Array
    p_SE: Array
    R_SE: Array
    twist: Array
    twist_rate: Array


@dataclass(frozen=True)
class FollowedPath:
    """Joints at N instants: q, dq, ddq (N, n), and the tray's body Jacobian (N, 6, n)."""

    q: Array
    dq: Array
    ddq: Array
    jacobian: Array


def tray_path(reference: Reference, p_EB: Array, R_EB: Array, t: Array) -> TrayPath:
    """The tray's motion at t (N,) when the object stays at (p_EB, R_EB) on it and follows `reference`."""
    samples: MotionSamples = reference.sample(t).of_frame(*invert(p_EB, R_EB))
    v = np.einsum("tji,tj->ti", samples.R_SB, samples.v_S)
    a = np.einsum("tji,tj->ti", samples.R_SB, samples.a_S)
    twist = np.hstack([v, samples.omega_B])
    rate = np.hstack([a - np.cross(samples.omega_B, v), samples.alpha_B])
    return TrayPath(t, samples.p_SB, samples.R_SB, twist, rate)


# ---- kinematics along a path -----------------------------------------------------------------------------------


def _kinematics(arm: ArmModel, q: Array) -> tuple[Array, Array, Array]:
    """Tray positions (N, 3), rotations (N, 3, 3) and body Jacobians (N, 6, n) at postures (N, n)."""
    model, data, frame = arm.pin_model, arm.data, arm.tray_id
    p, rotation, jacobian = np.empty((len(q), 3)), np.empty((len(q), 3, 3)), np.empty((len(q), 6, arm.n))
    for k, posture in enumerate(q):
        pin.computeJointJacobians(model, data, posture)
        placement = pin.updateFramePlacement(model, data, frame)
        p[k], rotation[k] = placement.translation, placement.rotation
        jacobian[k] = pin.getFrameJacobian(model, data, frame, pin.LOCAL)
    return p, rotation, jacobian


def _extended(jacobian: Array, rows: Array) -> Array:
    """[J; C] (N, n, n)."""
    return np.concatenate([jacobian, np.broadcast_to(rows, (len(jacobian), *rows.shape))], axis=1)


def solve_path(
    arm: ArmModel, path: TrayPath, q: Array, rows: Array, profile: tuple[Array, ...], tolerance: float = REACHED
) -> FollowedPath | None:
    """Root of the extended system at every instant, by Newton's method from a guess q (N, n), and its derivatives.

    tolerance: m and rad. None when no root was found near the guess.
    """
    s, ds, dds = profile
    q = q.copy()
    for _ in range(15):
        p, rotation, jacobian = _kinematics(arm, q)
        inverse = np.swapaxes(rotation, 1, 2)
        error = np.hstack([(inverse @ (path.p_SE - p)[..., None])[..., 0], log(inverse @ path.R_SE), s - q @ rows.T])
        matrix = _extended(jacobian, rows)
        size = np.abs(error).max()
        if size < tolerance:
            break
        try:
            step = _solved(matrix, error)
        except np.linalg.LinAlgError:
            return None
        if not np.abs(step).max() < 1.0:  # also catches NaN
            return None
        q += step
    else:
        return None
    dq = _solved(matrix, np.hstack([path.twist, ds]))
    drift = np.array([arm.drift(a, b) for a, b in zip(q, dq, strict=True)])
    ddq = _solved(matrix, np.hstack([path.twist_rate - drift, dds]))
    return FollowedPath(q, dq, ddq, jacobian)


def _solved(matrix: Array, right: Array) -> Array:
    """Solutions (N, n) of stacked systems; by least squares where there are more conditions than joints."""
    if matrix.shape[1] > matrix.shape[2]:
        return np.asarray((np.linalg.pinv(matrix) @ right[..., None])[..., 0], dtype=float)
    return np.asarray(np.linalg.solve(matrix, right[..., None])[..., 0], dtype=float)


# ---- redundancy ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Choice:
    """A choice of the redundant joint motion: rows C (r, n), start s_0 (r,), coefficients (4, r) of s(t)."""

    rows: Array
    start: Array
    coefficients: Array
    path: FollowedPath
    cost: float

    def profile(self, t: Array) -> tuple[Array, ...]:
        return _profile(self.start, self.coefficients, t)


@lru_cache(maxsize=8)
def _basis(count: int) -> tuple[Array, Array, Array]:
    """Values and two derivatives (N, 4) of the terms of s(u) at N equidistant u in [0, 1].

    All are at rest at both ends: a quintic step, and u^3 (1 - u)^3 times 1, w, w^2 with w = 2 u - 1.
    """
    u = np.linspace(0.0, 1.0, count)
    step = np.polynomial.Polynomial([0, 0, 0, 10, -15, 6])
    bump = 64 * np.polynomial.Polynomial([0, 0, 0, 1]) * np.polynomial.Polynomial([1, -1]) ** 3
    terms = [step, *(bump * np.polynomial.Polynomial([-1, 2]) ** k for k in range(3))]
    values, first, second = (np.stack([term.deriv(d)(u) if d else term(u) for term in terms], axis=1) for d in range(3))
    return values, first, second


def _profile(start: Array, coefficients: Array, t: Array) -> tuple[Array, ...]:
    """s, ds/dt, d2s/dt2 (N, r) at N equidistant instants of the whole motion."""
    duration = float(t[-1])
    values, first, second = _basis(len(t))
    return start + values @ coefficients, first @ coefficients / duration, second @ coefficients / duration**2


@dataclass(frozen=True, eq=False)
class Usage:
    """How much of the limits a path uses: a smooth approximation of the largest share, which is 1 at a limit.

    arm: with the carried bodies. sharpness: exponent of the norm that approximates the maximum. clear: distance of two
    parts, m, from which on they count; contact is share 1. singular: smallest singular value of the body Jacobian (m or
    1 per rad) that counts as share 1. Larger values of the last two keep more distance, with less speed.
    """

    arm: ArmModel
    parts: ArmGeometry
    joints: FollowedPath
    sharpness: float = 20
    clear: float = 0.04
    singular: float = 0.04

    @cached_property
    def _torque(self) -> Array:
        model, data, joints = self.arm.pin_model, self.arm.data, self.joints
        return np.array([pin.rnea(model, data, *state) for state in zip(joints.q, joints.dq, joints.ddq, strict=True)])

    @cached_property
    def _singular_values(self) -> tuple[Array, Array, Array]:
        """Smallest singular value of each body Jacobian (N,), with its left (N, 6) and right (N, n) vector."""
        left, values, right = np.linalg.svd(self.joints.jacobian, full_matrices=False)
        return np.maximum(values[:, -1], 1e-9), left[:, :, -1], right[:, -1]

    @cached_property
    def _shares(self) -> dict[str, Array]:
        joints = self.joints
        curves = {"position": joints.q, "velocity": joints.dq, "acceleration": joints.ddq, "torque": self._torque}
        return {
            **self.arm.planning_limits.shares(curves),
            "singular": self.singular / self._singular_values[0][:, None],
            "clearance": np.maximum(0.0, 1 - self.parts.clearance(joints.q, self.clear) / self.clear),
        }

    @cached_property
    def cost(self) -> float:
        shares = np.abs(np.hstack(list(self._shares.values())))
        largest = shares.max()
        return float(largest * np.mean((shares / largest) ** self.sharpness) ** (1 / self.sharpness))

    def gradient(self, rows: Array) -> tuple[Array, Array, Array]:
        """Derivatives of the cost by s, s', s'' (N, r) at each instant, with the adjoint of [J; C] dq = [V; s'] and of
        the systems for q and ddq."""
        arm, joints, cost = self.arm, self.joints, self.cost
        count = sum(shares.size for shares in self._shares.values())
        by = {
            key: np.sign(shares) * (np.abs(shares) / cost) ** (self.sharpness - 1) / count
            for key, shares in self._shares.items()
        }
        by_value = {kind.key: by[kind.key] / arm.planning_limits.range(kind)[1] for kind in LIMITS if kind.key in by}
        limit, limit_by_q = arm.planning_limits.velocity_at(joints.q, joints.dq)
        by_value["velocity"] = by["velocity"] / limit
        by_q, by_dq, by_ddq = (by_value[key].copy() for key in ("position", "velocity", "acceleration"))
        by_q -= by_value["velocity"] * self._shares["velocity"] * limit_by_q
        model, data, frame = arm.pin_model, arm.data, arm.tray_id
        smallest, left, right = self._singular_values
        velocity_by_q, masses = np.empty_like(joints.jacobian), np.empty((len(joints.q), arm.n, arm.n))
        acceleration_by_q, acceleration_by_dq = np.empty_like(joints.jacobian), np.empty_like(joints.jacobian)
        for k, (q, dq, ddq) in enumerate(zip(joints.q, joints.dq, joints.ddq, strict=True)):
            torque_by_q, torque_by_dq, mass = pin.computeRNEADerivatives(model, data, q, dq, ddq)
            by_q[k] += by_value["torque"][k] @ torque_by_q
            by_dq[k] += by_value["torque"][k] @ torque_by_dq
            masses[k] = mass
            # (dJ/dq) v for the singular direction v is the derivative by q of the tray's velocity at dq = v.
            pin.computeForwardKinematicsDerivatives(model, data, q, right[k], ddq)
            turned = pin.getFrameVelocityDerivatives(model, data, frame, pin.LOCAL)[0]
            by_q[k] -= by["singular"][k, 0] * self.singular / smallest[k] ** 2 * left[k] @ turned
            pin.computeForwardKinematicsDerivatives(model, data, q, dq, ddq)
            velocity_by_q[k], acceleration_by_q[k], acceleration_by_dq[k], _ = pin.getFrameAccelerationDerivatives(
                model, data, frame, pin.LOCAL
            )
        torque, mirrored = by_value["torque"][:, :, None], np.swapaxes(np.triu(masses, 1), 1, 2)
        by_ddq += (np.triu(masses) @ torque + mirrored @ torque)[:, :, 0]  # Pinocchio fills the upper half
        node, pair = np.nonzero(by["clearance"])
        distance_by_q = self.parts.clearance_gradient(joints.q, node, pair)
        np.subtract.at(by_q, node, by["clearance"][node, pair, None] / self.clear * distance_by_q)
        transposed = np.swapaxes(_extended(joints.jacobian, rows), 1, 2)
        multiplier = _solved(transposed, by_ddq)
        by_q -= np.einsum("ti,tij->tj", multiplier[:, :6], acceleration_by_q)
        by_dq -= np.einsum("ti,tij->tj", multiplier[:, :6], acceleration_by_dq)
        by_dds, multiplier = multiplier[:, 6:], _solved(transposed, by_dq)
        by_q -= np.einsum("ti,tij->tj", multiplier[:, :6], velocity_by_q)
        return _solved(transposed, by_q)[:, 6:], multiplier[:, 6:], by_dds


def _null_rows(jacobian: Array) -> Array:
    """C (n - 6, n), orthonormal: the directions closest to the null spaces of all Jacobians (N, 6, n) of a path.

    Signs do not depend on the linear algebra library. No rows for up to six joints.
    """
    free = max(0, jacobian.shape[2] - 6)
    basis = np.linalg.svd(jacobian)[2][:, 6:]
    rows = np.linalg.eigh(np.einsum("tri,trj->ij", basis, basis))[1][:, ::-1].T[:free]
    largest = np.argmax(np.abs(rows), axis=1)
    return rows * np.sign(rows[np.arange(free), largest])[:, None]


def first_choice(arm: ArmModel, parts: ArmGeometry, path: TrayPath, postures: Array) -> Choice | None:
    """The choice C q = s(t) that fits postures (N, n) of a path best; None if the arm cannot follow with it."""
    rows = _null_rows(_kinematics(arm, postures)[2])
    s = postures @ rows.T
    coefficients = np.linalg.lstsq(_basis(len(path.t))[0], s - s[0], rcond=None)[0]
    joints = solve_path(arm, path, postures, rows, _profile(s[0], coefficients, path.t))
    return None if joints is None else Choice(rows, s[0], coefficients, joints, Usage(arm, parts, joints).cost)


def improved(arm: ArmModel, parts: ArmGeometry, path: TrayPath, start: Choice, free_start: bool) -> Choice:
    """The choice with improved coefficients of s(t), and start s_0 if that is free, by BFGS on `Usage`."""
    rows = start.rows
    free = len(rows)
    if free == 0:
        return start
    best = start
    parts = parts.near(start.path.q, 0.2)  # m: parts further apart than this cannot matter in a few steps
    duration = float(path.t[-1])
    values, first, second = _basis(len(path.t))

    def at(x: Array) -> tuple[float, Array]:
        nonlocal best
        s_0, coefficients = start.start + x[:free], x[free:].reshape(-1, free)
        profile = _profile(s_0, coefficients, path.t)
        joints = solve_path(arm, path, best.path.q, rows, profile, tolerance=1e-6)
        if joints is None:
            return 10 * best.cost, np.zeros(len(x))
        usage = Usage(arm, parts, joints)
        if usage.cost < best.cost:
            best = Choice(rows, s_0, coefficients, joints, usage.cost)
        by_s, by_ds, by_dds = usage.gradient(rows)
        by_coefficients = values.T @ by_s + first.T @ by_ds / duration + second.T @ by_dds / duration**2
        return usage.cost, np.concatenate([by_s.sum(axis=0) * free_start, by_coefficients.ravel()])

    x = np.concatenate([np.zeros(free), start.coefficients.ravel()])
    descend(at, x, steps=12, flat=1e-3)
    return best
