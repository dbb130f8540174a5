"""What the tray feels along a joint motion and the torque it takes, with exact derivatives by (q, dq, ddq).

Analytic derivatives by Carpentier and Mansard, "Analytical derivatives of rigid body dynamics algorithms",
RSS 2018, as Pinocchio provides them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt
import pinocchio as pin

from salver.geometry import GRAVITY_S, Array, hat
from salver.models.tray_motion import N_MOTION, PRODUCTS

_FIRST, _SECOND = ([pair[k] for pair in PRODUCTS] for k in (0, 1))
_VALUES = ("q", "dq", "ddq", "p_SE", "R_SE", "twist", "spatial", "torque", "w")


@dataclass(frozen=True)
class Derivatives:
    """Derivatives of a motion's terms; what they are is said at the properties of `MotionTerms`."""

    twist_q: Array
    acceleration_q: Array
    acceleration_dq: Array
    jacobian: Array
    torque_z: Array


@dataclass(frozen=True, eq=False)
class MotionTerms:
    """At T instants of an arm with n joints; E is the tray's frame, everything of it in E.

    Values are there from the beginning; derivatives, which cost seven times as much, from when the first is read.

    p_SE (T, 3), R_SE (T, 3, 3). twist (T, 6); spatial (T, 6), its spatial acceleration. torque (T, n) N m with the
    load. w (T, 12) what the tray feels (`salver.models.tray_motion`).
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

    def continued(self, each: Callable[[Sequence[Array]], list[Array]], derivatives: bool = False) -> MotionTerms:
        """At more instants, by what continues several that are known at these, (T, ...), to all; with derivatives, if
        these are known too."""
        values = [getattr(self, name) for name in _VALUES]
        found = each([*values, *vars(self.derivatives).values()] if derivatives else values)
        terms = MotionTerms(self.model, self.frame_id, *found[: len(values)])
        if derivatives:
            terms.__dict__["derivatives"] = Derivatives(*found[len(values) :])
        return terms

    def deriving(self, some: npt.NDArray[np.intp], each: Callable[[Sequence[Array]], list[Array]]) -> MotionTerms:
        """The same, with derivatives that are worked out at some of the instants and continued to all."""
        few = self.only(some).derivatives
        self.__dict__["derivatives"] = Derivatives(*each([*vars(few).values()]))
        return self

    def only(self, some: npt.NDArray[np.intp]) -> MotionTerms:
        """At some of the instants."""
        values = {name: getattr(self, name)[some] for name in _VALUES}
        return replace(self, **values)

    @cached_property
    def derivatives(self) -> Derivatives:
        """By Pinocchio, at every instant."""
        return _all_of(self.model, self.frame_id, self.q, self.dq, self.ddq)[1]

    @property
    def twist_q(self) -> Array:
        """(T, 6, n) derivative of the twist by q."""
        return self.derivatives.twist_q

    @property
    def jacobian(self) -> Array:
        """(T, 6, n) derivative of the twist by dq, and of the spatial acceleration by ddq."""
        return self.derivatives.jacobian

    @property
    def acceleration_q(self) -> Array:
        """(T, 6, n) derivative of the spatial acceleration by q."""
        return self.derivatives.acceleration_q

    @property
    def acceleration_dq(self) -> Array:
        """(T, 6, n) derivative of the spatial acceleration by dq."""
        return self.derivatives.acceleration_dq

    @property
    def torque_z(self) -> Array:
        """(T, n, 3 n) derivative of the torque by (q, dq, ddq)."""
        return self.derivatives.torque_z

    @property
    def mass_matrix(self) -> Array:
        """(T, n, n)."""
        return self.torque_z[:, :, -self.torque.shape[1] :]

    @cached_property
    def mass_inverse(self) -> Array:
        """(T, n, n)."""
        return np.asarray(np.linalg.inv(self.mass_matrix))

    @property
    def jacobian_rate(self) -> Array:
        """dJ/dt (T, 6, n): J' dq is quadratic in dq, and J' what its derivative leaves beyond twist_q."""
        return self.acceleration_dq - self.twist_q

    @property
    def up(self) -> Array:
        """(T, 3) -g in E."""
        return -np.einsum("tji,j->ti", self.R_SE, GRAVITY_S)

    def changed(self, state: Array) -> tuple[Array, Array, Array]:
        """What changes (T, 3 n, c) of the joints' q, dq and ddq make of the tray's motion: its displacement (T, 6, c)
        and twist, in E, and what it feels (T, 12, c), which is `w_z` times them."""
        found = self._changed_z @ state
        return found[:, :6], found[:, 6:12], found[:, 12:]

    @property
    def w_z(self) -> Array:
        """(T, 12, 3 n) derivative of w by (q, dq, ddq)."""
        return self._changed_z[:, 12:]

    @cached_property
    def _changed_z(self) -> Array:
        """(T, 24, 3 n) derivative of displacement, twist and w by (q, dq, ddq)."""
        count, n = self.q.shape
        found = np.zeros((count, 12 + N_MOTION, 3 * n))
        moved, felt = found[:, :12], found[:, 12:]
        moved[:, :6, :n], moved[:, 6:, :n], moved[:, 6:, n : 2 * n] = self.jacobian, self.twist_q, self.jacobian
        omega, each = self.twist[:, 3:], np.arange(len(PRODUCTS))
        by_moved = np.zeros((count, N_MOTION, 12))
        by_moved[:, :3, 3:6] = hat(self.up)  # E turns by the Jacobian's rotation
        by_moved[:, :3, 6:9], by_moved[:, :3, 9:] = hat(omega), -hat(self.twist[:, :3])
        by_moved[:, 6 + each, 9 + np.array(_SECOND)] += omega[:, _FIRST]
        by_moved[:, 6 + each, 9 + np.array(_FIRST)] += omega[:, _SECOND]
        felt[:, :, : 2 * n] = by_moved @ moved[:, :, : 2 * n]  # neither moves with ddq
        felt[:, :6, :n] += self.acceleration_q
        felt[:, :6, n : 2 * n] += self.acceleration_dq
        felt[:, :6, 2 * n :] += self.jacobian
        return found


def motion_terms(model: Any, frame_id: int, q: Array, dq: Array, ddq: Array, deriving: bool = False) -> MotionTerms:
    """Terms of a Pinocchio model, load included, whose frame `frame_id` is E, at states (T, n).

    deriving: derivatives will be read; found with the values they cost less.
    """
    if deriving:
        values, derivatives = _all_of(model, frame_id, q, dq, ddq)
        terms = _of_values(model, frame_id, q, dq, ddq, *values)
        terms.__dict__["derivatives"] = derivatives
        return terms
    (count, n), data, frame = q.shape, model.createData(), model.frames[frame_id]
    p, rotation = np.empty((count, 3)), np.empty((count, 3, 3))  # of the last joint, as twist and acceleration first
    twist, spatial, torque = np.empty((count, 6)), np.empty((count, 6)), np.empty((count, n))
    placement, velocity, acceleration = (x[frame.parentJoint] for x in (data.oMi, data.v, data.a_gf))
    p_now, rotation_now = placement.translation, placement.rotation  # what each call fills anew
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
    last, place = list(model.supports[frame.parentJoint])[1:], data.oMi[frame.parentJoint]
    p, rotation, torque = np.empty((count, 3)), np.empty((count, 3, 3)), np.empty((count, n))
    columns, torque_z = np.empty((count, 3, 6, n)), np.empty((count, 3, n, n))
    now = [place.translation, place.rotation, data.tau, data.J, data.dJ, data.dAdq, data.dtau_dq, data.dtau_dv, data.M]
    p_now, rotation_now, torque_now, *by_joint = now  # what each call fills anew
    for i, state in enumerate(zip(q, dq, ddq, strict=True)):
        pin.computeRNEADerivatives(model, data, *state)
        p[i], rotation[i], torque[i] = p_now, rotation_now, torque_now
        columns[i, 0], columns[i, 1], columns[i, 2], torque_z[i, 0], torque_z[i, 1], torque_z[i, 2] = by_joint
    row, column = _lower(n)
    torque_z[:, 2, row, column] = torque_z[:, 2, column, row]  # Pinocchio fills the upper half
    p_SE, R_SE = p + rotation @ frame.placement.translation, rotation @ frame.placement.rotation

    if len(last) < n:
        columns[..., [j for j in range(n) if j + 1 not in last]] = 0.0
    columns[:, :, :3] += hat(p_SE)[:, None].swapaxes(-1, -2) @ columns[:, :, 3:]  # now of twists of E,
    columns = (R_SE.swapaxes(-1, -2)[:, None, None] @ columns.reshape(count, 3, 2, 3, n)).reshape(columns.shape)
    S, twist_q, felt_q = columns.swapaxes(0, 1)  # in E
    rates = np.stack([dq, ddq], axis=2)
    (twist, pushed), carried = (S @ rates).transpose(2, 0, 1), (twist_q @ dq[:, :, None])[:, :, 0]
    falling = pushed + carried
    falling[:, :3] -= GRAVITY_S @ R_SE
    turning = hat(twist.reshape(count, 2, 3))
    crossed = np.zeros((count, 6, 6))  # the twist, as it acts on others
    crossed[:, :3, :3] = crossed[:, 3:, 3:] = turning[:, 1]
    crossed[:, :3, 3:] = turning[:, 0]
    by_q = felt_q - crossed @ twist_q
    by_dq = 2 * twist_q - crossed @ S
    derivatives = Derivatives(twist_q, by_q, by_dq, S, np.swapaxes(torque_z, 1, 2).reshape(count, n, 3 * n))
    return (p_SE, R_SE, twist, falling, torque), derivatives


@lru_cache(maxsize=16)
def _lower(n: int) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Row and column of what is below the diagonal of (n, n)."""
    return np.tril_indices(n, -1)
