"""From a motion of the object to a motion of the joints, and whether the arm can follow it at all.

The tray must go where the object goes: six conditions on n joints. A redundant arm has n - 6 left to choose. They
are chosen as linear functions of the joints, C q = s(t), with C as near as possible to the null spaces of the
Jacobian along the motion (an extended Jacobian: Baillieul 1985), and s(t) a polynomial at rest at both ends. So
q(t) is the root of a square system at each instant, independent of the path that led there: nothing drifts, and
velocity and acceleration are exact derivatives of it,

    [J; C] dq = [V; s'],    [J; C] ddq = [V' - J' dq; s''].

The coefficients of s(t) keep positions, speeds, accelerations and torques far from their limits, and the arm
far from singular postures.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import pinocchio as pin
from scipy.optimize import minimize

from salver.errors import ScenarioError, Status
from salver.geometry import Array, invert, log
from salver.models.arm import ArmModel, load_arm, with_load
from salver.models.bodies import Body
from salver.models.bodies import bodies as bodies_of
from salver.planning.joint_limits import verdict
from salver.planning.posture import REACHED, candidate_postures, check_start_posture, pose_error
from salver.scenario import Scenario
from salver.trajectory import JointMotion, MotionSamples, Reference

GRID_STEP = 5e-3  # s between samples of the joint motion; quintic in between
COARSE_NODES = 31  # instants at which redundancy is resolved
_BUMPS = 3  # polynomial terms of s(t) besides its step from start to end
_SOFT_MAX = 20  # exponent of the norm that stands for "the largest of all"
_SINGULAR = 0.04  # smallest singular value of the body Jacobian (m or 1 per rad) that counts as a full limit
_REFINED = 3  # how many candidate start postures are optimised at most ...
_PROMISING = 1.3  # ... those that come this near to the best one before they are


@dataclass(frozen=True)
class TrayPath:
    """What the tray must do at N instants: pose, body twist (v, omega) and its rate, of frame E."""

    t: Array
    p_SE: Array
    R_SE: Array
    twist: Array
    twist_rate: Array


@dataclass(frozen=True)
class JointPath:
    """Joints at N instants: q, dq, ddq (N, n), and the tray's body Jacobian (N, 6, n)."""

    q: Array
    dq: Array
    ddq: Array
    jacobian: Array


def tray_path(reference: Reference, p_EB: Array, R_EB: Array, t: Array) -> TrayPath:
    """The tray's motion when the object keeps its place (p_EB, R_EB) on it."""
    samples: MotionSamples = reference.sample(t).of_frame(*invert(p_EB, R_EB))
    v = np.einsum("tji,tj->ti", samples.R_SB, samples.v_S)
    a = np.einsum("tji,tj->ti", samples.R_SB, samples.a_S)
    twist = np.hstack([v, samples.omega_B])
    rate = np.hstack([a - np.cross(samples.omega_B, v), samples.alpha_B])
    return TrayPath(t, samples.p_SB, samples.R_SB, twist, rate)


def follow(
    arm: ArmModel,
    reference: Reference,
    p_EB: Array,
    R_EB: Array,
    *,
    bodies: Sequence[Body] = (),
    q_start: Sequence[float] | Array | None = None,
    seed: int = 0,
) -> tuple[JointMotion | None, Status]:
    """Joint motion along which the tray carries the object's frame B along `reference`.

    p_EB, R_EB: place of B on the tray. bodies: all that is carried; its weight counts in the torques.
    q_start: (n,) where to start; None to have it chosen (same seed, same choice).

    Returns the motion and a status: "within_limits"; "limit_exceeded", with the joint, the time and by how
    much (the motion is returned all the same); or "unreachable", with no motion. Raises ScenarioError
    or UnreachableError when `q_start` is wrong (`salver.planning.posture.check_start_posture`).
    """
    coarse = tray_path(reference, p_EB, R_EB, np.linspace(0.0, reference.duration, COARSE_NODES))
    load = with_load(arm, bodies)
    if q_start is not None:
        starts = [check_start_posture(arm, q_start, coarse.p_SE[0], coarse.R_SE[0])]
    else:
        starts = candidate_postures(arm, coarse.p_SE[0], coarse.R_SE[0], seed)
        if not starts:
            return None, _unreachable(arm, coarse, 0, None)
    marched = [(_march(arm, coarse, q), q) for q in starts]
    paths = [path for (path, reached), _ in marched if reached == len(coarse.t)]
    if not paths:
        reached = max(count for (_, count), _ in marched)
        path = next(path for (path, count), _ in marched if count == reached)
        return None, _unreachable(arm, coarse, reached, path)
    choices = [_resolve(load, coarse, path, q_start is None) for path in _most_promising(load, coarse, paths)]
    if not choices:
        return None, _singular(arm)
    best = min(choices, key=lambda choice: choice.cost)
    count = max(2 * COARSE_NODES, int(np.ceil(reference.duration / GRID_STEP)) + 1)
    fine = tray_path(reference, p_EB, R_EB, np.linspace(0.0, reference.duration, count))
    guess = _interpolated(coarse.t, best.path, fine.t)
    joints = _solve(arm, fine, guess, best.rows, best.profile(fine.t))
    if joints is None:
        return None, _singular(arm)
    motion = JointMotion(fine.t, joints.q, joints.dq, joints.ddq)
    return motion, verdict(arm, motion, bodies)


def follow_scenario(
    scenario: Scenario,
    reference: Reference,
    arm: ArmModel | None = None,
    q_start: Sequence[float] | Array | None = None,
) -> tuple[JointMotion | None, Status]:
    """`follow` for the first object of a scenario, with all its objects as load and its start posture.

    arm: the scenario's arm when it is loaded already. q_start: overrides the scenario's, so that a second
    trajectory can start from the posture chosen for the first. Raises ScenarioError when there is no arm.
    """
    if scenario.arm is None:
        raise ScenarioError(
            f"The scenario {scenario.name} has no arm; give it a table [arm] to follow a motion with one."
        )
    carried = bodies_of(scenario)
    return follow(
        load_arm(scenario.arm, scenario.tray) if arm is None else arm,
        reference,
        carried[0].p_EB,
        carried[0].R_EB,
        bodies=carried,
        q_start=scenario.arm.start_posture if q_start is None else q_start,
        seed=scenario.seed,
    )


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


def _march(arm: ArmModel, path: TrayPath, q_start: Array) -> tuple[Array, int]:
    """Postures (N, n) along the path by steps of least norm from q_start, and how many instants were reached."""
    model, data, frame = arm.pin_model, arm.data, arm.tray_id
    q = np.array(q_start, dtype=float)
    postures = np.tile(q, (len(path.t), 1))
    for k in range(1, len(path.t)):
        for _ in range(12):
            pin.computeJointJacobians(model, data, q)
            placement = pin.updateFramePlacement(model, data, frame)
            error = pose_error(placement.translation, placement.rotation, path.p_SE[k], path.R_SE[k])
            if np.abs(error).max() < REACHED:
                break
            jacobian = pin.getFrameJacobian(model, data, frame, pin.LOCAL)
            q = q + jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + 1e-9 * np.eye(6), error)
        else:
            return postures, k
        postures[k] = q
        if np.abs(q - postures[k - 1]).max() > 1.0:
            return postures, k
    return postures, len(path.t)


def _solve(arm: ArmModel, path: TrayPath, q: Array, rows: Array, profile: tuple[Array, ...]) -> JointPath | None:
    """Root of the extended system at every instant, by Newton's method from a guess (N, n), and its derivatives.

    None where there is no root near the guess.
    """
    s, ds, dds = profile
    q = q.copy()
    for _ in range(15):
        p, rotation, jacobian = _kinematics(arm, q)
        inverse = np.swapaxes(rotation, 1, 2)
        error = np.hstack([(inverse @ (path.p_SE - p)[..., None])[..., 0], log(inverse @ path.R_SE), s - q @ rows.T])
        matrix = _extended(jacobian, rows)
        size = np.abs(error).max()
        if size < REACHED:
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
    return JointPath(q, dq, ddq, jacobian)


def _solved(matrix: Array, right: Array) -> Array:
    """Solutions (N, n) of stacked square systems."""
    return np.asarray(np.linalg.solve(matrix, right[..., None])[..., 0], dtype=float)


def _interpolated(t: Array, path: JointPath, t_fine: Array) -> Array:
    return JointMotion(t, path.q, path.dq, path.ddq).sample(t_fine)[0]


# ---- redundancy ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Choice:
    """One way to use the redundancy: rows C (r, n), start s_0 (r,), coefficients (1 + bumps, r) of s(t)."""

    rows: Array
    start: Array
    coefficients: Array
    path: JointPath
    cost: float

    def profile(self, t: Array) -> tuple[Array, ...]:
        return _profile(self.start, self.coefficients, t)


@lru_cache(maxsize=8)
def _basis(count: int) -> tuple[Array, Array, Array]:
    """Values and two derivatives (N, 1 + bumps) of the terms of s(u) at N equidistant u in [0, 1].

    All are at rest at both ends: a quintic step, and u^3 (1 - u)^3 times 1, w, w^2 with w = 2 u - 1.
    """
    u = np.linspace(0.0, 1.0, count)
    step = np.polynomial.Polynomial([0, 0, 0, 10, -15, 6])
    bump = 64 * np.polynomial.Polynomial([0, 0, 0, 1]) * np.polynomial.Polynomial([1, -1]) ** 3
    terms = [step, *(bump * np.polynomial.Polynomial([-1, 2]) ** k for k in range(_BUMPS))]
    values, first, second = (np.stack([term.deriv(d)(u) if d else term(u) for term in terms], axis=1) for d in range(3))
    return values, first, second


def _profile(start: Array, coefficients: Array, t: Array) -> tuple[Array, ...]:
    """s, ds/dt, d2s/dt2 (N, r) at N equidistant instants of the whole motion."""
    duration = float(t[-1])
    values, first, second = _basis(len(t))
    return start + values @ coefficients, first @ coefficients / duration, second @ coefficients / duration**2


def _usage(arm: ArmModel, joints: JointPath) -> float:
    """How near the path comes to the limits: a smooth stand-in for the largest of all shares, 1 at a limit.

    `arm` includes what is carried.
    """
    limits = arm.planning_limits
    half = 0.5 * (limits.q_max - limits.q_min)
    torque = np.array(
        [pin.rnea(arm.pin_model, arm.data, *state) for state in zip(joints.q, joints.dq, joints.ddq, strict=True)]
    )
    smallest = np.linalg.svd(joints.jacobian, compute_uv=False)[:, -1:]
    shares = np.hstack(
        [
            (joints.q - limits.q_min - half) / half,
            joints.dq / limits.velocity,
            joints.ddq / limits.acceleration,
            torque / limits.torque,
            _SINGULAR / np.maximum(smallest, 1e-9),
        ]
    )
    largest = np.abs(shares).max()
    return float(largest * np.mean((np.abs(shares) / largest) ** _SOFT_MAX) ** (1 / _SOFT_MAX))


def _null_rows(jacobian: Array) -> Array:
    """C (n - 6, n): the directions that are nearest to the null spaces of all Jacobians (N, 6, n) of a path.

    Orthonormal, with signs that do not depend on the linear algebra underneath.
    """
    free = jacobian.shape[2] - 6
    basis = np.linalg.svd(jacobian)[2][:, 6:]
    rows = np.linalg.eigh(np.einsum("tri,trj->ij", basis, basis))[1][:, ::-1].T[:free]
    largest = np.argmax(np.abs(rows), axis=1)
    return rows * np.sign(rows[np.arange(free), largest])[:, None]


def _start(arm: ArmModel, path: TrayPath, postures: Array) -> _Choice | None:
    """The marched postures in the form C q = s(t), which they fit nearly."""
    rows = _null_rows(_kinematics(arm, postures)[2])
    s = postures @ rows.T
    coefficients = np.linalg.lstsq(_basis(len(path.t))[0], s - s[0], rcond=None)[0]
    joints = _solve(arm, path, postures, rows, _profile(s[0], coefficients, path.t))
    return None if joints is None else _Choice(rows, s[0], coefficients, joints, _usage(arm, joints))


def _most_promising(arm: ArmModel, path: TrayPath, marched: list[Array]) -> list[_Choice]:
    choices = [choice for postures in marched if (choice := _start(arm, path, postures)) is not None]
    choices.sort(key=lambda choice: choice.cost)
    return [choice for choice in choices[:_REFINED] if choice.cost < _PROMISING * choices[0].cost]


def _resolve(arm: ArmModel, path: TrayPath, start: _Choice, free_start: bool) -> _Choice:
    """Improve the coefficients of s(t), and where it starts if that is free, by BFGS on `_usage`."""
    rows = start.rows
    if len(rows) == 0:
        return start
    best = start

    def at(x: Array) -> float:
        nonlocal best
        shift, coefficients = (x[: len(rows)], x[len(rows) :]) if free_start else (0.0, x)
        s_0, coefficients = start.start + shift, coefficients.reshape(-1, len(rows))
        joints = _solve(arm, path, best.path.q, rows, _profile(s_0, coefficients, path.t))
        if joints is None:
            return 10 * best.cost
        cost = _usage(arm, joints)
        if cost < best.cost:
            best = _Choice(rows, s_0, coefficients, joints, cost)
        return cost

    x = start.coefficients.ravel()
    x = np.concatenate([np.zeros(len(rows)), x]) if free_start else x
    minimize(at, x, method="BFGS", options={"maxiter": 12, "gtol": 1e-3, "eps": 1e-4})
    return best


def _unreachable(arm: ArmModel, path: TrayPath, index: int, postures: Array | None) -> Status:
    p = path.p_SE[index]
    where = f"({p[0]:.3f}, {p[1]:.3f}, {p[2]:.3f}) m"
    when = "where the motion starts" if index == 0 else f"which it should reach at t = {path.t[index]:.2f} s"
    distance = float(np.linalg.norm(p - arm.base_position))
    return Status(
        "unreachable",
        f"{arm.name} cannot put its tray at {where}, {when}; that is {distance:.2f} m from its base: move the task or "
        "the base (arm.base_position), or choose another arm.",
        False,
        {"time": float(path.t[index]), "p_SE": p.tolist(), "distance_from_base": distance},
    )


def _singular(arm: ArmModel) -> Status:
    return Status(
        "unreachable",
        f"{arm.name} passes a singular posture on the way and cannot follow the motion there; choose another "
        "arm.start_posture or move the task.",
        False,
    )
