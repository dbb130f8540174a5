"""The contact conditions (eq 16) as slacks along a motion, which must stay above a margin.

"paper": Lambda = pinv(G F-hat) wrench >= 0 with the tube of the closed loop's input sensitivity (eqs 11, 12), in N. It
requires one particular distribution of the contact forces, so it is sufficient. Uncertainties that the paper does not
treat count too: the least friction, the contact area common to all placements, and, to first order, placement and
tilt, as for an object that follows its tray.
"exact": the wrench that the motion needs lies in the contact wrench cone of every interface, in the worst case over the
uncertain set (`salver.models.contact_rows`); slacks are shares of the normal force at rest. A body that follows its
tray needs Y(t) phi for every phi, so this worst case is not a first-order one. Load dynamics add to it, and have limits
of their own.

All slacks are concave in the tray's motion regressor, so with fixed orientation in the plan's variables (except for
the effect of vertical acceleration on swinging loads): tangents bound them from above.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from salver.dynamics.load_response import LoadResponse, slacks
from salver.dynamics.load_rows import LoadRows
from salver.dynamics.motion_gradients import Unknowns
from salver.dynamics.payload_response import PayloadResponse
from salver.errors import ScenarioError
from salver.geometry import Array, Indices, invert
from salver.models.bodies import TRAY, Body
from salver.models.contact_rows import ContactRows, contact_rows
from salver.models.interfaces import sure_contacts
from salver.models.payload import Payload
from salver.models.rigid_body import PAIRS
from salver.models.tray_motion import FULL_SPEED, N_MOTION, Speed, corners, frame_map
from salver.models.uncertain.parameters import support
from salver.scenario import Scenario
from salver.sensitivity.arm.load import wrench_of
from salver.sensitivity.dual import Dual, joined
from salver.sensitivity.tray import BodyMotion, TraySensitivity

UNITS = {"paper": "N", "exact": "of the weight"}
TILT = "tilt limit"


class Rows(Protocol):
    """The n slacks of one condition at T instants. owner: (n,) object or interface of each."""

    @property
    def owner(self) -> tuple[str, ...]: ...

    def slack(self, step: Array | None = None) -> Array:
        """(T, n) slacks after a step (n_z,) of the linear model."""
        ...

    def tangents(self, step: Array, instant: Indices, row: Indices) -> tuple[Array, Array]:
        """Tangents c0 (m,) + c (m, n_z) d to the slacks of rows at instants, each (m,), where d is the step."""
        ...


def conditions_along(
    scenario: Scenario, t: Array, motion: BodyMotion, sensitivity: Callable[[], TraySensitivity], n_z: int = 0
) -> tuple[Rows, ...]:
    """The contact conditions of all objects of a scenario, and its tilt limit, along a motion.

    scenario: the task. t: (T,) instants, s. motion: of the first object's frame B at t, with derivatives by n_z
    variables. sensitivity: returns that of the first object's closed loop. n_z: number of variables.

    Raises:
        ScenarioError: contact.condition = "paper" with load dynamics, objects on each other or a shaking tray.
    """
    payload, largest = scenario.payload, scenario.motion.max_tilt_deg
    payload.check_places()
    tilt = () if largest is None else (TiltRows.along(motion, len(t), float(np.deg2rad(largest)), n_z),)
    if scenario.contact.condition == "paper":
        _check_known_to_paper(scenario)
        return (*(_paper(payload, body, motion, sensitivity, n_z) for body in payload.bodies), *tilt)
    # Load dynamics at other speed factors are checked along whole motions, not by rows of instants.
    speeds = (FULL_SPEED,) if payload.dynamic else corners(scenario.motion.speeds, scenario.motion.speed_rate)
    felt = {speed: FeltMotion(payload, t, *felt_at(motion, payload.first, n_z, speed)) for speed in speeds}
    contacts = (MotionRows.of(rows, felt[speed], speed) for rows in contact_rows(payload) for speed in speeds)
    return (*contacts, *(LoadLimitRows(body, felt[FULL_SPEED]) for body in payload.dynamic), *tilt)


def unit_of(scenario: Scenario, owner: str) -> str:
    """Unit of the slack of a row with this owner."""
    if of_load(owner):
        return "of the room"
    return "rad" if owner == TILT else UNITS[scenario.contact.condition]


def of_load(owner: str) -> bool:
    """Whether the owner of a row is a load's inner dynamics ("liquid in cup"); names of bodies have no spaces."""
    return " in " in owner


def apart(owner: str) -> bool:
    """Whether a row is no contact condition and so has another unit."""
    return owner == TILT or of_load(owner)


# The paper's condition ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class WrenchRows:
    """Slacks map @ wrench of one body, minus the tube (eq 12).

    map (n, 6); wrench (T, 6), wrench_jacobian (T, 6, n_z). spread (T, 6, n_p), spread_jacobian (T, 6, n_p, n_z): the
    wrench's sensitivity times the factor of the uncertain set.
    """

    owner: tuple[str, ...]
    map: Array
    wrench: Array
    wrench_jacobian: Array
    spread: Array
    spread_jacobian: Array
    box: bool

    def slack(self, step: Array | None = None) -> Array:
        wrench, spread = self.wrench, self.spread
        if step is not None:
            wrench, spread = wrench + self.wrench_jacobian @ step, spread + self.spread_jacobian @ step
        return wrench @ self.map.T - support(self.map @ spread, None if self.box else np.eye(spread.shape[-1]))

    def tangents(self, step: Array, instant: Indices, row: Indices) -> tuple[Array, Array]:
        maps, spread, by_step = self.map[row], self.spread[instant], self.spread_jacobian[instant]
        terms = np.einsum("mi,mip->mp", maps, spread + by_step @ step)
        size = np.linalg.norm(terms, axis=-1, keepdims=True)
        weights = maps[:, :, None] * (np.sign(terms) if self.box else terms / np.maximum(size, 1e-300))[:, None, :]
        offset = np.einsum("mi,mi->m", maps, self.wrench[instant]) - np.einsum("mip,mip->m", weights, spread)
        slope = np.einsum("mi,miz->mz", maps, self.wrench_jacobian[instant])
        return offset, slope - np.einsum("mip,mipz->mz", weights, by_step)


def _check_known_to_paper(scenario: Scenario) -> None:
    payload, unsupported = scenario.payload, f'{scenario.name}: contact.condition = "paper" does not support'
    if payload.uncertain.shake is not None:
        raise ScenarioError(f'{unsupported} a shaking tray (uncertainty.shake); use "exact".')
    if payload.dynamic:
        raise ScenarioError(f'{unsupported} {payload.dynamic[0].inside}; use "exact".')
    for body in payload.bodies:
        if body.on != (TRAY,):
            below = " and ".join(body.on)
            raise ScenarioError(f'{unsupported} objects on each other ({body.name} stands on {below}); use "exact".')


def _paper(
    payload: Payload, body: Body, motion: BodyMotion, sensitivity: Callable[[], TraySensitivity], n_z: int
) -> WrenchRows:
    """Lambda of one body: with the closed loop's tube for the first, and that of a body fixed to its tray for
    others."""
    first, uncertain = payload.first, payload.uncertain
    (network,) = (one for one in payload.networks if one.bodies[0] is body)  # nothing else touches it
    contacts = sure_contacts(network, payload.tray_half, uncertain)[0].base
    distribution: Array = np.linalg.pinv(contacts.grasp_map).astype(float)
    w, w_jacobian = felt_at(motion, first, n_z)
    own, by_parameter = wrench_of(body, uncertain)
    if body is first:  # its inertial parameters act through the closed loop
        by_parameter = by_parameter * np.array([p.places for p in uncertain.parameters])[:, None, None]
    spread, spread_jacobian = (np.einsum("pik,tk...->tpi...", by_parameter, x) for x in (w, w_jacobian))
    if body is first:
        value, tangent = _stacked(sensitivity().df, sensitivity().dtau, n_z)
        spread, spread_jacobian = spread + value, spread_jacobian + tangent
    factor = uncertain.factor.T
    by_z = (factor @ spread_jacobian.reshape(*spread.shape[:2], 6 * n_z)).reshape(*spread.shape, n_z)
    return WrenchRows(
        (body.name,) * len(distribution),
        distribution,
        w @ own.T,
        own @ w_jacobian,
        np.swapaxes(factor @ spread, 1, 2),
        np.ascontiguousarray(np.swapaxes(by_z, 1, 2)),
        uncertain.kind == "box",
    )


def _stacked(force: Dual, torque: Dual, n_z: int) -> tuple[Array, Array]:
    """Wrench (T, P, 6) and its tangent (T, P, 6, n_z)."""
    value = joined(force, torque)
    tangent = np.zeros((*value.shape, n_z))
    if force.tangent is not None:
        tangent[..., :3, :] = force.tangent
    if torque.tangent is not None:
        tangent[..., 3:, :] = torque.tangent
    return value, tangent


# The exact condition -----------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class FeltMotion:
    """The tray's motion regressor w (T, 12) at t (T,), its derivative (T, 12, n_z), and the load dynamics' response."""

    payload: Payload
    t: Array
    w: Array
    w_jacobian: Array
    _loads: dict[bytes, Mapping[str, tuple[LoadResponse, ...]]] = field(default_factory=dict, repr=False)

    def after(self, step: Array | None) -> Array:
        """(T, 12) w after a step (n_z,) of the linear model."""
        return self.w if step is None else self.w + self.w_jacobian @ step

    def loads(self, step: Array | None) -> Mapping[str, tuple[LoadResponse, ...]]:
        """Responses of all load dynamics after a step; cached for the latest step."""
        key = b"" if step is None else step.tobytes()
        if key not in self._loads:
            self._loads.clear()
            self._loads[key] = PayloadResponse(self.payload, self.t, self.after(step)).worst
        return self._loads[key]


@dataclass(frozen=True)
class MotionRows:
    """Slacks of contact rows in the worst case, with what load dynamics add."""

    owner: tuple[str, ...]
    rows: ContactRows
    felt: FeltMotion

    @classmethod
    def of(cls, rows: ContactRows, felt: FeltMotion, speed: Speed) -> MotionRows:
        return cls(tuple(rows.network.interfaces[int(e)].name + speed.words for e in rows.interface), rows, felt)

    def slack(self, step: Array | None = None) -> Array:
        slack = -self.rows.worst(self.felt.after(step))
        return slack - LoadRows.of(self.rows, self.felt.loads(step)).values if self.felt.payload.dynamic else slack

    def tangents(self, step: Array, instant: Indices, row: Indices) -> tuple[Array, Array]:
        w, by_step = self.felt.after(step)[instant], self.felt.w_jacobian
        own = -self.rows.slope(w, row)
        value = np.einsum("mi,mi->m", own, w) - self.rows.shaken[row]
        slope = np.einsum("mi,miz->mz", own, by_step[instant])
        if self.felt.payload.dynamic:
            added = LoadRows.of(self.rows, self.felt.loads(step))
            value = value - added.values[instant, row]
            slope = slope - added.history(instant, row, Unknowns(by_step))
        return value - slope @ step, slope


@dataclass(frozen=True)
class LoadLimitRows:
    """Slacks of one body's load dynamics: the least share left of all its limits, `LoadResponse.limits`, in any case;
    at the last instant also of limits after the motion."""

    body: Body
    felt: FeltMotion

    @property
    def owner(self) -> tuple[str, ...]:
        return (self.body.inside.removeprefix("the "),)

    def slack(self, step: Array | None = None) -> Array:
        (part,) = self.felt.loads(step)[self.body.name]
        return slacks(part).min(axis=0)[:, None]

    def tangents(self, step: Array, instant: Indices, row: Indices) -> tuple[Array, Array]:
        (part,) = self.felt.loads(step)[self.body.name]
        found, unknowns = part.limits(), Unknowns(self.felt.w_jacobian)
        left = np.stack([limit.left(len(self.felt.t))[:, instant] for limit in found])  # (kinds, K, m)
        kind, case = np.unravel_index(left.reshape(-1, len(instant)).argmin(axis=0), left.shape[:2])
        slope = np.empty((len(instant), len(step)))
        for k, limit in enumerate(found):
            mine = np.flatnonzero(kind == k)
            if len(mine):
                slope[mine] = -limit.by(case[mine], instant[mine], unknowns) / limit.most[case[mine], None]
        return left[kind, case, np.arange(len(instant))] - slope @ step, slope


def felt_at(motion: BodyMotion, first: Body, n_z: int, speed: Speed = FULL_SPEED) -> tuple[Array, Array]:
    """Motion regressor w (T, 12) of the tray (`salver.models.tray_motion`) at a speed factor, and its derivative
    (T, 12, n_z)."""
    shape = motion.force.value[:, 0].shape
    force, alpha, omega = (motion.force, motion.alpha, motion.omega) if speed.factor else (motion.weight, None, None)
    parts = [(0, force, 1.0), (3, alpha, 1.0)]
    if speed.rate:
        parts += [(0, motion.velocity, speed.rate), (3, motion.omega, speed.rate)]
    w, tangent = np.zeros((shape[0], N_MOTION)), np.zeros((shape[0], N_MOTION, n_z))
    for at, part, scale in parts:
        if part is None:
            continue
        w[:, at : at + 3] += scale * part.value[:, 0]
        if part.tangent is not None:
            tangent[:, at : at + 3] += scale * part.tangent[:, 0]
    if omega is not None:
        one, other = (list(index) for index in zip(*PAIRS, strict=True))
        turned = np.broadcast_to(omega.value[:, 0], shape)
        w[:, 6:] = turned[:, one] * turned[:, other]
        if omega.tangent is not None:
            turn = omega.tangent[:, 0]
            tangent[:, 6:] = turned[:, one, None] * turn[:, other] + turned[:, other, None] * turn[:, one]
    to_E = frame_map(*invert(first.p_EB, first.R_EB))
    return w @ to_E.T, to_E @ tangent


# The limit on tilt -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class TiltRows:
    """Slacks (T,) of the tilt limit, (cos tilt - cos limit) / sin limit: near the limit the angle that is left, rad."""

    owner: tuple[str, ...]
    left: Array
    left_jacobian: Array

    @classmethod
    def along(cls, motion: BodyMotion, instants: int, limit: float, n_z: int) -> TiltRows:
        upright = motion.rotation.matrix[:, 0, 2, :]  # e_z of S, in B
        left = (upright[:, 2] - np.cos(limit)) / np.sin(limit)
        jacobian = np.zeros((len(left), n_z))
        if motion.rotation.tangent is not None:
            # d(e_z . R e_z) = e_z . R (dtheta x e_z) = dtheta . (e_z x R^T e_z)
            lever = np.cross([0.0, 0.0, 1.0], upright) / np.sin(limit)
            jacobian = np.einsum("ti,tiz->tz", lever, motion.rotation.tangent[:, 0])
        # A motion that does not rotate has a single rotation.
        return cls((TILT,), np.broadcast_to(left, instants), np.broadcast_to(jacobian, (instants, n_z)))

    def slack(self, step: Array | None = None) -> Array:
        return (self.left if step is None else self.left + self.left_jacobian @ step)[:, None]

    def tangents(self, step: Array, instant: Indices, row: Indices) -> tuple[Array, Array]:
        return self.left[instant], self.left_jacobian[instant]
