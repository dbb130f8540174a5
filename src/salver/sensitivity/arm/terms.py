"""Motion regressor of the tray and torque along a joint motion, with exact derivatives by (q, dq, ddq).

Analytic derivatives by Carpentier and Mansard, "Analytical derivatives of rigid body dynamics algorithms",
RSS 2018, as Pinocchio provides them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
import pinocchio as pin

from salver.geometry import GRAVITY_S, Array, hat
from salver.models.rigid_body import PAIRS
from salver.models.tray_motion import N_MOTION

_FIRST, _SECOND = np.array(PAIRS).T
_VALUES = ("p_SE", "R_SE", "twist", "spatial", "torque", "w")


def _by_moved() -> tuple[Array, Array]:
    """Linear maps: from (up, v, omega) to hat(up), hat(omega), -hat(v) (9, 27), and from omega to the derivatives of
    its products (3, 18)."""
    up, v, omega = (hat(x) for x in np.eye(9).reshape(9, 3, 3).swapaxes(0, 1))
    turning = np.zeros((3, len(PAIRS), 3))
    for k, (i, j) in enumerate(PAIRS):
        turning[i, k, j] += 1.0
        turning[j, k, i] += 1.0
    return np.concatenate([up, omega, -v], axis=2).reshape(9, 27), turning.reshape(3, -1)


_BY_MOVED, _BY_TURNING = _by_moved()


@dataclass(frozen=True)
class Derivatives:
    """Derivatives of a motion's terms; the properties of `MotionTerms` describe them."""

    twist_q: Array
    acceleration_q: Array
    acceleration_dq: Array
    jacobian: Array
    torque_z: Array


@dataclass(frozen=True, eq=False)
class MotionTerms:
    """Kinematic and dynamic terms of the tray frame E at T instants of an arm with n joints, in E.

    Values are computed at once; derivatives, which cost seven times as much, when the first is read, unless `known`.

    p_SE (T, 3), R_SE (T, 3, 3). twist (T, 6); spatial (T, 6), its spatial acceleration. torque (T, n) N m with the
    load. w (T, 12) the tray's motion regressor (`salver.models.tray_motion`).
    """

    model: Any
    frame_id: int
    q: Array
    dq: Array
    ddq: Array
    p_SE: Array
    R_SE: Array
    twist: Array
    spatial: Array
    torque: Array
    w: Array
    known: Derivatives | None = None

    @classmethod
    def deriving(cls, model: Any, frame_id: int, states: Array, t: Array, some: npt.NDArray[np.intp]) -> MotionTerms:
        """`motion_terms` at states (3, T, n) at t (T,), with derivatives computed at some instants, including both
        ends, and interpolated linearly at the others."""
        others = np.ones(states.shape[1], dtype=bool)
        others[some] = False
        (q, dq, ddq), (q_rest, dq_rest, ddq_rest) = states[:, some], states[:, others]
        few = motion_terms(model, frame_id, q, dq, ddq, deriving=True)
        rest = motion_terms(model, frame_id, q_rest, dq_rest, ddq_rest)
        found = []
        for name in _VALUES:
            first, second = getattr(few, name), getattr(rest, name)
            value = np.empty((len(others), *first.shape[1:]))
            value[some], value[others] = first, second
            found.append(value)
        after = np.clip(np.searchsorted(t[some], t), 1, len(some) - 1)
        share = ((t - t[some][after - 1]) / np.diff(t[some])[after - 1])[:, None, None]
        slopes = ((x[after - 1], x[after]) for x in vars(few.derivatives).values())
        known = Derivatives(*(x + share * (y - x) for x, y in slopes))
        return replace(cls(model, frame_id, *states, *found), known=known)

    @classmethod
    def of_tray(cls, R_SE: Array, twist: Array, spatial: Array) -> MotionTerms:
        """Terms of a tray that no arm carries. Its n = 6 coordinates are those of E itself: displacement, twist and
        spatial acceleration (T, 6), in E. Position and torque, which no load needs, are 0."""
        still = np.zeros_like(twist)
        falling = np.array(spatial)
        falling[:, :3] -= GRAVITY_S @ R_SE
        made = _of_values(None, 0, still, twist, spatial, still[:, :3], R_SE, twist, falling, still)
        none, one = (np.broadcast_to(x, (len(twist), 6, 6)) for x in (0.0, np.eye(6)))
        return replace(made, known=Derivatives(none, none, none, one, np.zeros((len(twist), 6, 18))))

    @cached_property
    def derivatives(self) -> Derivatives:
        """The derivatives, by Pinocchio at every instant unless they are known."""
        return self.known or _all_of(self.model, self.frame_id, self.q, self.dq, self.ddq)[1]

    @property
    def twist_q(self) -> Array:
        """Derivative (T, 6, n) of the twist by q."""
        return self.derivatives.twist_q

    @property
    def jacobian(self) -> Array:
        """Body Jacobian (T, 6, n): derivative of the twist by dq, and of the spatial acceleration by ddq."""
        return self.derivatives.jacobian

    @property
    def acceleration_q(self) -> Array:
        """Derivative (T, 6, n) of the spatial acceleration by q."""
        return self.derivatives.acceleration_q

    @property
    def acceleration_dq(self) -> Array:
        """Derivative (T, 6, n) of the spatial acceleration by dq."""
        return self.derivatives.acceleration_dq

    @property
    def torque_z(self) -> Array:
        """Derivative (T, n, 3 n) of the torque by (q, dq, ddq)."""
        return self.derivatives.torque_z

    @property
    def mass_matrix(self) -> Array:
        """Mass matrix (T, n, n) of the arm."""
        return self.torque_z[:, :, -self.torque.shape[1] :]

    @cached_property
    def mass_inverse(self) -> Array:
        """Inverse (T, n, n) of the mass matrix."""
        return np.asarray(np.linalg.inv(self.mass_matrix))

    @property
    def jacobian_rate(self) -> Array:
        """dJ/dt (T, 6, n), from the derivative of the quadratic J' dq by dq, minus twist_q."""
        return self.acceleration_dq - self.twist_q

    @property
    def up(self) -> Array:
        """Upward vector -g (T, 3) in E, m/s^2."""
        return -(GRAVITY_S @ self.R_SE)

    def w_at(self, squared: float, rate: float) -> Array:
        """Motion regressor (T, 12) of the tray at the squared speed factor `squared`, with the factor changing at
        `rate`, 1/s: static part, plus the dynamic part times the square, plus the twist times the rate."""
        w = squared * self.w
        w[:, :3] += (1 - squared) * self.up
        w[:, :6] += rate * self.twist
        return w

    def w_z_at(self, squared: float, rate: float) -> Array:
        """Derivative (T, 12, 3 n) of `w_at` by (q, dq, ddq)."""
        n = self.q.shape[1]
        slope = squared * self.w_z if squared else np.zeros((len(self.q), N_MOTION, 3 * n))
        slope[:, :3, :n] += (1 - squared) * (hat(self.up) @ self.jacobian[:, 3:])
        slope[:, :6, :n] += rate * self.twist_q
        slope[:, :6, n : 2 * n] += rate * self.jacobian
        return slope

    def changed(self, state: Array) -> tuple[Array, Array, Array]:
        """Change of the tray's motion by changes (T, 3 n, c) of the joints' q, dq and ddq: displacement (T, 6, c)
        and twist, in E, and motion regressor (T, 12, c)."""
        found = self._changed_z @ state
        return found[:, :6], found[:, 6:12], found[:, 12:]

    @property
    def w_z(self) -> Array:
        """Derivative (T, 12, 3 n) of w by (q, dq, ddq)."""
        return self._changed_z[:, 12:]

    @cached_property
    def _changed_z(self) -> Array:
        """Derivative (T, 24, 3 n) of displacement, twist and w by (q, dq, ddq)."""
        count, n = self.q.shape
        known = self.derivatives
        found = np.zeros((count, 12 + N_MOTION, 3 * n))
        moved, felt = found[:, :12], found[:, 12:]
        moved[:, :6, :n], moved[:, 6:, :n], moved[:, 6:, n : 2 * n] = known.jacobian, known.twist_q, known.jacobian
        felt[:, :6, :n], felt[:, :6, n : 2 * n] = known.acceleration_q, known.acceleration_dq  # of what is spatial
        felt[:, :6, 2 * n :] = known.jacobian
        # E rotates with the Jacobian's angular part, so that derivatives in E have additional terms.
        by_moved = np.concatenate([self.up, self.twist], axis=1) @ _BY_MOVED
        felt[:, :3, : 2 * n] += by_moved.reshape(count, 3, 9) @ moved[:, 3:, : 2 * n]
        felt[:, 6:, : 2 * n] = (self.twist[:, 3:] @ _BY_TURNING).reshape(count, -1, 3) @ moved[:, 9:, : 2 * n]
        return found


def motion_terms(model: Any, frame_id: int, q: Array, dq: Array, ddq: Array, deriving: bool = False) -> MotionTerms:
    """Terms of a Pinocchio model, load included, whose frame `frame_id` is E, at states (T, n).

    deriving: compute the derivatives too, which is cheaper together with the values.
    """
    if deriving:
        values, derivatives = _all_of(model, frame_id, q, dq, ddq)
        return replace(_of_values(model, frame_id, q, dq, ddq, *values), known=derivatives)
    (count, n), data, frame = q.shape, model.createData(), model.frames[frame_id]
    p, rotation = np.empty((count, 3)), np.empty((count, 3, 3))  # of the last joint, as twist and acceleration first
    twist, spatial, torque = np.empty((count, 6)), np.empty((count, 6)), np.empty((count, n))
    placement, velocity, acceleration = (x[frame.parentJoint] for x in (data.oMi, data.v, data.a_gf))
    p_now, rotation_now = placement.translation, placement.rotation  # Pinocchio overwrites these in each call
    for i, state in enumerate(zip(q, dq, ddq, strict=True)):
        torque[i] = pin.rnea(model, data, *state)
        pin.updateGlobalPlacements(model, data)
        p[i], rotation[i] = p_now, rotation_now
        twist[i], spatial[i] = velocity.vector, acceleration.vector
    to_frame = frame.placement.inverse().action  # both are of the last link, seen from its joint
    twist, felt = twist @ to_frame.T, spatial @ to_frame.T
    p_SE, R_SE = p + rotation @ frame.placement.translation, rotation @ frame.placement.rotation
    return _of_values(model, frame_id, q, dq, ddq, p_SE, R_SE, twist, felt, torque)


def _of_values(
    model: Any,
    frame_id: int,
    q: Array,
    dq: Array,
    ddq: Array,
    p_SE: Array,
    R_SE: Array,
    twist: Array,
    falling: Array,
    torque: Array,
) -> MotionTerms:
    """Terms by the twist of E and `falling` (T, 6), its spatial acceleration against free fall, both in E."""
    v, omega = twist[:, :3], twist[:, 3:]
    spatial = falling.copy()
    spatial[:, :3] += GRAVITY_S @ R_SE
    felt = falling[:, :3] + (hat(omega) @ v[:, :, None])[:, :, 0]
    w = np.concatenate([felt, spatial[:, 3:], omega[:, _FIRST] * omega[:, _SECOND]], axis=1)
    return MotionTerms(model, frame_id, q, dq, ddq, p_SE, R_SE, twist, spatial, torque, w)


def _all_of(
    model: Any, frame_id: int, q: Array, dq: Array, ddq: Array
) -> tuple[tuple[Array, Array, Array, Array, Array], Derivatives]:
    """p_SE, R_SE, twist and falling (see `_of_values`), torque, and derivatives, from one call for each instant.

    With twists of the world's origin, S_j the axis of joint j, V and A velocity and acceleration of the link before it,
    Pinocchio leaves the columns S_j, V x S_j (its rate) and A x S_j + V x (V x S_j). As each joint moves about
    one axis, the last link's twist and acceleration are sums over them, and so are the derivatives.
    """
    (count, n), data, frame = q.shape, model.createData(), model.frames[frame_id]
    moving, place = model.supports[frame.parentJoint], data.oMi[frame.parentJoint]
    p, rotation, torque = np.empty((count, 3)), np.empty((count, 3, 3)), np.empty((count, n))
    columns, torque_z = np.empty((count, 6, 3 * n)), np.empty((count, n, 3 * n))
    each = [slice(k * n, (k + 1) * n) for k in range(3)]
    J, dJ, dA, by_position, by_velocity, mass = (x[:, :, one] for x in (columns, torque_z) for one in each)
    # Pinocchio overwrites these in each call; the mass matrix is made symmetric.
    p_now, rotation_now, torque_now = place.translation, place.rotation, data.tau
    J_now, dJ_now, dA_now = data.J, data.dJ, data.dAdq
    by_position_now, by_velocity_now, mass_now = data.dtau_dq, data.dtau_dv, data.M
    derive = pin.computeRNEADerivatives
    for i, (position, velocity, acceleration) in enumerate(zip(q, dq, ddq, strict=True)):
        derive(model, data, position, velocity, acceleration)
        p[i], rotation[i], torque[i] = p_now, rotation_now, torque_now
        J[i], dJ[i], dA[i] = J_now, dJ_now, dA_now
        by_position[i], by_velocity[i], mass[i] = by_position_now, by_velocity_now, mass_now
    p_SE, R_SE = p + rotation @ frame.placement.translation, rotation @ frame.placement.rotation

    if len(moving) <= n:  # the universe and the joints that move E; others have no effect on it
        last = list(moving)
        columns.reshape(count, 6, 3, n)[..., [j for j in range(n) if j + 1 not in last]] = 0.0
    to_frame = np.zeros((count, 6, 6))  # of twists of the world's origin to those of E
    to_frame[:, :3, :3] = to_frame[:, 3:, 3:] = R_SE.swapaxes(1, 2)
    to_frame[:, :3, 3:] = (hat(p_SE) @ R_SE).swapaxes(1, 2)
    columns = to_frame @ columns
    S, twist_q, felt_q = (columns[:, :, one] for one in each)  # in E
    twist = (S @ dq[:, :, None])[:, :, 0]
    falling = (columns[:, :, : 2 * n] @ np.concatenate([ddq, dq], axis=1)[:, :, None])[:, :, 0]
    falling[:, :3] -= GRAVITY_S @ R_SE
    crossed = np.zeros((count, 6, 6))  # the twist, as it acts on others
    crossed[:, :3, :3] = crossed[:, 3:, 3:] = hat(twist[:, 3:])
    crossed[:, :3, 3:] = hat(twist[:, :3])
    carried = crossed @ columns[:, :, : 2 * n]
    derivatives = Derivatives(twist_q, felt_q - carried[:, :, n:], 2 * twist_q - carried[:, :, :n], S, torque_z)
    return (p_SE, R_SE, twist, falling, torque), derivatives
