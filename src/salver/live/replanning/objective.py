"""The objective of a live motion: residuals of a twist, of timed poses or postures, and of a level tray, with
weights."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from salver.geometry import Array, Indices, exp, hat, interpolated, log
from salver.models.arm.arm import ArmModel
from salver.planning.trajopt.evaluation import MotionEvaluation


@dataclass(frozen=True)
class Weights:
    """Weights of squared residuals, integrated over time.

    Attributes:
        velocity, angular_velocity: weights of a twist, (m/s)^-2 and (rad/s)^-2.
        joint_velocity: weight of requested joint velocities, (rad/s)^-2 or (m/s)^-2.
        position, rotation: weights of a requested pose at a time, m^-2 and rad^-2.
        joints: weight of a requested posture at a time, rad^-2.
        level, upright: weights of the sine of the tray's lean, where it must be level and where it may lean. Without
            them the tray came to rest leaning by up to 4.3 deg after hostile twists, instead of 1.6 deg.
        jerk: weight of the joints' jerk, (rad/s^3)^-2. Without it a gentle twist is followed with 1.5 times the jerk.
    """

    velocity: float = 100.0
    angular_velocity: float = 20.0
    joint_velocity: float = 20.0
    position: float = 400.0
    rotation: float = 100.0
    joints: float = 200.0
    level: float = 2000.0
    upright: float = 2.0
    jerk: float = 2e-8


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals at points of the grid: value (r,), derivatives parts (r, 4, n) by q and its rates, point (r,),
    weight (r,)."""

    value: Array
    parts: Array
    point: Indices
    weight: Array


class Wanted(Protocol):
    """A request that is followed as nearly as safety allows."""

    def residuals(self, motion: MotionEvaluation, t: Array, dt: Array, weights: Weights) -> Residuals:
        """The residuals of a motion; t: (N,) live times of the nodes, s; dt: (N,) s, weight of each node in an integral
        over time."""
        ...


@dataclass(frozen=True, eq=False)
class JointsWanted:
    """Joint velocities (m,), m = n, at live time t0, changing at slope (m,) for a while."""

    rates: Array
    slope: Array
    t0: float
    window: float = 0.2  # s from the hand-over in which it is followed
    ahead: float = 0.12  # s for which the slope is believed

    def at(self, t: Array) -> Array:
        """The requested velocities (N, m) at live times."""
        return np.asarray(self.rates + np.clip(t - self.t0, 0.0, self.ahead)[:, None] * self.slope)

    def granted(self, arm: ArmModel, q: Array, dq: Array, t: float, weights: Weights) -> float:
        """Share, 0 to 1, of the velocities requested at live time t, s, that the arm has at q, dq (n,): their
        projection on the requested ones, weighted as residuals are."""
        wanted, weight = self.at(np.array([t]))[0], self._weight(weights)
        asked = float(weight @ wanted**2)
        return 1.0 if asked == 0.0 else float(np.clip((weight * wanted) @ self._of(arm, q, dq) / asked, 0.0, 1.0))

    def _weight(self, weights: Weights) -> Array:
        """(m,) weights of the requested velocities."""
        return np.full(len(self.rates), weights.joint_velocity)

    def _of(self, arm: ArmModel, q: Array, dq: Array) -> Array:
        """(m,) the velocities of an arm that are requested."""
        return dq

    def residuals(self, motion: MotionEvaluation, t: Array, dt: Array, weights: Weights) -> Residuals:
        within = np.flatnonzero(t <= t[0] + self.window)
        weight = np.outer(dt[within], self._weight(weights)).ravel()
        return self._against(motion, within, self.at(t[within]), weight)

    def _against(self, motion: MotionEvaluation, nodes: Indices, wanted: Array, weight: Array) -> Residuals:
        """Residuals of the velocities at nodes (N,) against requested ones (N, m)."""
        return _joints(motion.at_nodes[1, nodes] - wanted, 1, motion.nodes[nodes], weight)


class TwistWanted(JointsWanted):
    """The tray's velocity and angular velocity in S, m = 6."""

    def _against(self, motion: MotionEvaluation, nodes: Indices, wanted: Array, weight: Array) -> Residuals:
        terms, n = motion.terms, motion.n
        R = terms.R_SE[nodes]
        both = np.zeros((len(nodes), 6, 6))
        both[:, :3, :3] = both[:, 3:, 3:] = R
        twist_S = np.einsum("kij,kj->ki", both, terms.twist[nodes])
        parts = np.zeros((len(nodes), 6, 4, n))
        # d(R v) = R (dv + dtheta x v), dtheta = J_omega dq.
        turned = np.concatenate([hat(terms.twist[nodes, :3]), hat(terms.twist[nodes, 3:])], axis=1)
        parts[:, :, 0] = both @ (terms.twist_q[nodes] - turned @ terms.jacobian[nodes, 3:])
        parts[:, :, 1] = both @ terms.jacobian[nodes]
        point = np.repeat(motion.nodes[nodes], 6)
        return Residuals((twist_S - wanted).ravel(), parts.reshape(-1, 4, n), point, weight)

    def _weight(self, weights: Weights) -> Array:
        return np.repeat([weights.velocity, weights.angular_velocity], 3)

    def _of(self, arm: ArmModel, q: Array, dq: Array) -> Array:
        return arm.tray_velocity(q, dq)


@dataclass(frozen=True, eq=False)
class ChunkWanted:
    """A timed motion of the tray or of the joints: samples at live times t (C,), increasing.

    p_SE (C, 3), m, and R_SE (C, 3, 3), or q (C, n), rad. Between samples the motion is linear, and turns about a fixed
    axis; the last sample is held.
    """

    t: Array
    p_SE: Array | None
    R_SE: Array | None
    q: Array | None

    def residuals(self, motion: MotionEvaluation, t: Array, dt: Array, weights: Weights) -> Residuals:
        if self.q is not None:
            wanted = interpolated(self.t, self.q, t)
            value = motion.at_nodes[0] - wanted
            return _joints(value, 0, motion.nodes, np.repeat(weights.joints * dt, motion.n))
        assert self.p_SE is not None
        assert self.R_SE is not None
        p = interpolated(self.t, self.p_SE, t)
        k = np.interp(t, self.t, np.arange(len(self.t)))
        first = k.astype(np.intp)
        R, after = self.R_SE[first], self.R_SE[np.minimum(first + 1, len(self.t) - 1)]
        turned = R @ exp((k - first)[:, None] * log(np.swapaxes(R, 1, 2) @ after))
        each = np.repeat([weights.position, weights.rotation], 3)
        return _pose(motion, p, turned, np.outer(dt, each).ravel())


def _pose(motion: MotionEvaluation, p_SE: Array, R_SE: Array, weight: Array) -> Residuals:
    """Pose of the tray against (p_SE, R_SE)."""
    terms, n, count = motion.terms, motion.n, len(motion.nodes)
    value = np.concatenate([terms.p_SE - p_SE, log(np.swapaxes(R_SE, 1, 2) @ terms.R_SE)], axis=1)
    parts = np.zeros((count, 6, 4, n))
    parts[:, :3, 0], parts[:, 3:, 0] = terms.R_SE @ terms.jacobian[:, :3], terms.jacobian[:, 3:]
    return Residuals(value.ravel(), parts.reshape(-1, 4, n), np.repeat(motion.nodes, 6), weight)


def _joints(value: Array, order: int, nodes: Indices, weight: Array) -> Residuals:
    """Residuals (N, n) of postures, or of their derivatives of an order, at nodes (N,), relative to the request."""
    count, n = value.shape
    parts = np.zeros((count, n, 4, n))
    parts[:, range(n), order, range(n)] = 1.0
    return Residuals(value.ravel(), parts.reshape(-1, 4, n), np.repeat(nodes, n), weight)


def level(motion: MotionEvaluation, weight: Array) -> Residuals:
    """The tray upright."""
    terms, count, n = motion.terms, len(motion.nodes), motion.n
    up = terms.R_SE[:, 2, :]
    turning = np.cross(up[:, :, None], terms.jacobian[:, 3:], axisa=1, axisb=1, axisc=1)
    parts = np.zeros((count, 2, 4, n))
    parts[:, :, 0] = turning[:, :2]
    return Residuals(up[:, :2].ravel(), parts.reshape(-1, 4, n), np.repeat(motion.nodes, 2), np.repeat(weight, 2))
