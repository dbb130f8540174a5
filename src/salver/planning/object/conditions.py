"""What keeps the carried objects in place, as functions of the motion that must stay above a margin.

paper: Lambda = pinv(G F-hat) wrench >= 0 with the tube of the closed loop's input sensitivity (eq 16), in N. It
asks for one particular distribution of the contact forces, and is sufficient. What the paper's loop does not know
counts too: the least friction, the contact area that every placement keeps, and, to first order as for an object
that follows its tray, place and tilt.
exact: the wrench that the motion needs lies in the contact wrench cone of every interface, in the worst case over
the uncertain set (`salver.models.contact_rows`), as a share of the normal force at rest. A body that follows its
tray needs Y(t) phi whatever its phi, so this worst case is not first order.

Both are a linear value minus a norm of linear terms, concave: at fixed orientation, concave in the plan's variables.
Liquids add to the exact one what `salver.planning.object.liquid_rows` says.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from salver.errors import ScenarioError
from salver.geometry import Array, Indices, exp, invert
from salver.models.bodies import TRAY, Body
from salver.models.contact_rows import ContactRows, contact_rows
from salver.models.interfaces import sure_contacts
from salver.models.parameters import Parameter, support
from salver.models.payload import Payload
from salver.models.tray_motion import FULL_SPEED, N_MOTION, PRODUCTS, Speed, corners, frame_map, wrench_map
from salver.models.worst_case import UncertainRows
from salver.planning.object.liquid_rows import BrimRows, SloshingRows, Wet
from salver.scenario import Scenario
from salver.sensitivity.dual import Dual, joined
from salver.sensitivity.slosh_rows import Sloshed
from salver.sensitivity.spills import Liquids, Spill
from salver.sensitivity.tray import BodyMotion, TraySensitivity
from salver.sensitivity.wave_cases import SloshingCase, cases

Known = dict[str, tuple[SloshingCase, ...]]  # cases of each liquid, by its body
UNITS = {"paper": "N", "exact": "of the weight"}
TILT = "tilt limit"
LIQUID = "liquid in "  # and whose it is
_PLACE_STEP = 1e-4  # m or rad, of a central difference of what is nearly linear


class Rows(Protocol):
    """Slack functions along a motion at T instants: they must stay above the margin. owner: (n,) whose each is."""

    @property
    def owner(self) -> tuple[str, ...]: ...

    def slack(self, step: Array | None = None) -> tuple[Array, Array]:
        """Slack (T, n) and the terms of its spread (T, n, k), after a step (n_z,) of the linear model."""
        ...

    def least(self) -> Array:
        """The slack (T, n) alone, for many instants: without all terms in memory at once."""
        ...

    def cuts(self, instant: Indices, row: Indices, terms: Array) -> tuple[Array, Array]:
        """Half spaces c0 + c d >= 0 that contain all steps d with positive slack at (instant, row), each (m,).

        The slack is concave in d; these are its tangents where the spread's terms are (m, k). Returns c0 (m,),
        c (m, n_z).
        """
        ...


Loop = Callable[[], TraySensitivity]
Condition = Callable[[BodyMotion, Loop, int, Liquids | None], Rows]
"""Rows along a motion of B, its closed loop's sensitivity, for those that ask for it, and its liquids, with derivatives
by n_z variables (or none)."""


def conditions_for(scenario: Scenario) -> list[Condition]:
    """The contact conditions of everything that a scenario carries, and its limit on tilt.

    Raises ScenarioError when the paper's condition is asked for objects that stand on each other.
    """
    limit = scenario.motion.max_tilt_deg
    tilt = [] if limit is None else [_tilt(float(np.deg2rad(limit)))]
    payload = scenario.payload
    known = {body.name: cases(body, payload.uncertain) for body in payload.liquids}
    brims = [_brim(body, payload.first, known) for body in payload.liquids]
    return [*_contact_conditions(scenario, known), *brims, *tilt]


def unit_of(scenario: Scenario, owner: str) -> str:
    """Unit of the slack of one row."""
    if owner.startswith(LIQUID):
        return "of the room"
    return "rad" if owner == TILT else UNITS[scenario.contact.condition]


def apart(owner: str) -> bool:
    """Whether a row is of no contact, and so in a unit of its own."""
    return owner == TILT or owner.startswith(LIQUID)


def _contact_conditions(scenario: Scenario, known: Known) -> list[Condition]:
    payload = scenario.payload
    first = payload.first
    payload.check_places()
    if scenario.contact.condition == "exact":
        motion = scenario.motion
        # How a liquid sloshes at other speeds is looked at along whole motions, not by rows of instants.
        speeds = (FULL_SPEED,) if payload.liquids else corners(motion.speeds, motion.speed_rate)
        return [_exact(rows, first, known, speed) for rows in contact_rows(payload) for speed in speeds]
    if payload.liquids:
        raise ScenarioError(
            f'{scenario.name}: contact.condition = "paper" knows no liquids, and there is one in '
            f'{payload.liquids[0].name}; use "exact".'
        )
    for body in payload.bodies:
        if body.supports != (TRAY,):
            raise ScenarioError(
                f'{scenario.name}: contact.condition = "paper" knows objects on the tray only, and {body.name} stands '
                f'on {" and ".join(body.supports)}; use "exact".'
            )
    return [_paper(payload, body) for body in payload.bodies]


# The paper's condition ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class WrenchRows:
    """map @ wrench of one body. map (n, 6); wrench (T, 6), wrench_jacobian (T, 6, n_z).

    spread (T, 6, n_p) and spread_jacobian (T, 6, n_p, n_z): sensitivity of the wrench times the set's factor.
    """

    owner: tuple[str, ...]
    map: Array
    wrench: Array
    wrench_jacobian: Array
    spread: Array
    spread_jacobian: Array
    box: bool

    def slack(self, step: Array | None = None) -> tuple[Array, Array]:
        wrench, spread = self.wrench, self.spread
        if step is not None:
            wrench, spread = _moved(wrench, self.wrench_jacobian, step), _moved(spread, self.spread_jacobian, step)
        terms = self.map @ spread
        return wrench @ self.map.T - support(terms, None if self.box else np.eye(terms.shape[-1])), terms

    def least(self) -> Array:
        return self.slack()[0]

    def cuts(self, instant: Indices, row: Indices, terms: Array) -> tuple[Array, Array]:
        maps, dual = self.map[row], np.sign(terms) if self.box else _unit(terms)
        weights = maps[:, :, None] * dual[:, None, :]
        offset = np.einsum("mi,mi->m", maps, self.wrench[instant])
        offset -= np.einsum("mip,mip->m", weights, self.spread[instant])
        slope = np.einsum("mi,miz->mz", maps, self.wrench_jacobian[instant])
        slope -= np.einsum("mip,mipz->mz", weights, self.spread_jacobian[instant])
        return offset, slope


def _paper(payload: Payload, body: Body) -> Condition:
    """Lambda of one body: the closed loop's tube for the first, that of a body that follows its tray for others."""
    first, uncertain = payload.first, payload.uncertain
    jacobian = body.phi_jacobian(uncertain.parameters)
    (network,) = (one for one in payload.networks if one.bodies[0] is body)  # nothing else touches it
    contacts = sure_contacts(network, payload.tray_half, uncertain)[0]
    distribution: Array = np.linalg.pinv(contacts.grasp_map).astype(float)
    p_BX, R_BX = first.R_EB.T @ (body.p_EB - first.p_EB), first.R_EB.T @ body.R_EB
    placed = _place_map(body, uncertain.parameters, first)

    def rows(motion: BodyMotion, loop: Loop, n_z: int, liquids: Liquids | None) -> WrenchRows:
        assert liquids is None
        own_motion = motion if body is first else motion.of_frame(p_BX, R_BX)
        wrench, wrench_jacobian = _stacked(*own_motion.wrench(body.inertial.phi[:, None]), n_z)
        change = (loop().df, loop().dtau) if body is first else own_motion.wrench(jacobian)
        spread, spread_jacobian = _stacked(*change, n_z)
        if np.any(placed):
            w, w_jacobian = motion_vector(motion, n_z)
            spread = spread + np.einsum("pik,tk->tpi", placed, w)
            spread_jacobian = spread_jacobian + np.einsum("pik,tkz->tpiz", placed, w_jacobian)
        factor = uncertain.factor.T
        by_z = (factor @ spread_jacobian.reshape(*spread.shape[:2], 6 * n_z)).reshape(*spread.shape, n_z)
        return WrenchRows(
            (body.name,) * len(distribution),
            distribution,
            wrench[:, 0],
            wrench_jacobian[:, 0],
            np.swapaxes(factor @ spread, 1, 2),
            np.ascontiguousarray(np.swapaxes(by_z, 1, 2)),
            uncertain.kind == "box",
        )

    return rows


def _place_map(body: Body, parameters: tuple[Parameter, ...], first: Body) -> Array:
    """(n_p, 6, 12) change of a body's wrench with its place and the tray's tilt, of w of the first object's B."""
    maps = np.zeros((len(parameters), 6, N_MOTION))
    for k, parameter in enumerate(parameters):
        if not parameter.places or parameter.owner not in ("", body.name):
            continue
        tilt, ends = parameter.kind == "tilt", []
        for sign in (1.0, -1.0):
            step = sign * _PLACE_STEP * np.eye(3)["xy".index(parameter.axis)]
            place = exp(step) @ body.p_EB if tilt else body.p_EB + step
            turned = exp(step) @ body.R_EB if tilt else body.R_EB
            ends.append(frame_map(place, turned))
        change = wrench_map(body.inertial.phi) @ (ends[0] - ends[1]) / (2 * _PLACE_STEP)
        maps[k] = change @ frame_map(*invert(first.p_EB, first.R_EB))
    return maps


# The exact condition -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class MotionRows:
    """The worst case of contact rows (with the sign of a slack) at what B feels, w (T, 12). sloshed: (T, n) that
    liquids add."""

    owner: tuple[str, ...]
    rows: UncertainRows
    w: Array
    w_jacobian: Array
    sloshed: Array | float = 0.0

    def slack(self, step: Array | None = None) -> tuple[Array, Array]:
        w = self.w if step is None else _moved(self.w, self.w_jacobian, step)
        seen = np.broadcast_to(w[:, None], (len(w), len(self.rows.nominal), N_MOTION))
        return -self.rows.worst(w), np.concatenate([self.rows.terms(w), seen], axis=2)

    def least(self) -> Array:
        return -self.rows.worst(self.w) - self.sloshed

    def cuts(self, instant: Indices, row: Indices, terms: Array) -> tuple[Array, Array]:
        rows = -self.rows.slope(terms[:, -N_MOTION:], row)
        return np.einsum("mi,mi->m", rows, self.w[instant]), np.einsum("mi,miz->mz", rows, self.w_jacobian[instant])


def _exact(rows: ContactRows, first: Body, known: Known, speed: Speed) -> Condition:
    owner = tuple(rows.network.interfaces[int(e)].name + speed.words for e in rows.interface)
    of_B = rows.seen_from(first.p_EB, first.R_EB)

    def along(motion: BodyMotion, loop: Loop, n_z: int, liquids: Liquids | None) -> Rows:
        del loop  # a body that follows its tray needs the same wrench whatever the controller does
        if liquids is not None and n_z:
            return SloshingRows(owner, rows, _wet(known, liquids, motion, n_z, first))
        sloshed = 0.0 if liquids is None else Sloshed.of(rows, liquids.worst).values
        return MotionRows(owner, of_B, *motion_vector(motion, n_z, speed), sloshed)

    return along


def motion_vector(motion: BodyMotion, n_z: int, speed: Speed = FULL_SPEED) -> tuple[Array, Array]:
    """w (T, 12) of B (`salver.models.tray_motion.motion_vector`) at a speed, with its derivative (T, 12, n_z)."""
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
        first, second = (list(index) for index in zip(*PRODUCTS, strict=True))
        turned = np.broadcast_to(omega.value[:, 0], shape)
        w[:, 6:] = turned[:, first] * turned[:, second]
        if omega.tangent is not None:
            turn = omega.tangent[:, 0]
            tangent[:, 6:] = turned[:, first, None] * turn[:, second] + turned[:, second, None] * turn[:, first]
    return w, tangent


# The brim ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class RoomLeft:
    """Share of the room that a liquid leaves (T,), at its worst case, what it does after the motion at the end."""

    owner: tuple[str, ...]
    left: Array

    def slack(self, step: Array | None = None) -> tuple[Array, Array]:
        return self.left[:, None], np.zeros((len(self.left), 1, 0))

    def least(self) -> Array:
        return self.slack()[0]

    def cuts(self, instant: Indices, row: Indices, terms: Array) -> tuple[Array, Array]:
        raise NotImplementedError


def _brim(body: Body, first: Body, known: Known) -> Condition:
    def along(motion: BodyMotion, loop: Loop, n_z: int, liquids: Liquids | None) -> Rows:
        assert liquids is not None
        if n_z:
            only = {body.name: known[body.name]}
            return BrimRows(LIQUID + body.name, body.name, _wet(only, liquids, motion, n_z, first))
        return RoomLeft((LIQUID + body.name,), Spill.of(body.name, liquids.worst[body.name]).slack)

    return along


def _wet(known: Known, liquids: Liquids, motion: BodyMotion, n_z: int, first: Body) -> Wet:
    w, w_jacobian = motion_vector(motion, n_z)
    to_E = frame_map(*invert(first.p_EB, first.R_EB))
    return Wet(known, liquids.t, w @ to_E.T, to_E @ w_jacobian)


# The limit on tilt -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class TiltRows:
    """(cos tilt - cos limit) / sin limit (T,): the angle that is left, rad, to first order near the limit."""

    owner: tuple[str, ...]
    left: Array
    left_jacobian: Array

    def slack(self, step: Array | None = None) -> tuple[Array, Array]:
        left = self.left if step is None else self.left + self.left_jacobian @ step
        return left[:, None], np.zeros((len(left), 1, 0))

    def least(self) -> Array:
        return self.slack()[0]

    def cuts(self, instant: Indices, row: Indices, terms: Array) -> tuple[Array, Array]:
        return self.left[instant], self.left_jacobian[instant]


def _tilt(limit: float) -> Condition:
    def along(motion: BodyMotion, loop: Loop, n_z: int, liquids: Liquids | None) -> TiltRows:
        upright = motion.rotation.matrix[:, 0, 2, :]  # e_z of S, in B
        left = (upright[:, 2] - np.cos(limit)) / np.sin(limit)
        jacobian = np.zeros((len(left), n_z))
        if motion.rotation.tangent is not None:
            # d(e_z . R e_z) = e_z . R (dtheta x e_z) = dtheta . (e_z x R^T e_z)
            lever = np.cross([0.0, 0.0, 1.0], upright) / np.sin(limit)
            jacobian = np.einsum("ti,tiz->tz", lever, motion.rotation.tangent[:, 0])
        instants = len(motion.force.value)  # one rotation stands for all of a motion that does not turn
        return TiltRows(
            (TILT,), np.broadcast_to(left, instants), np.broadcast_to(jacobian, (instants, jacobian.shape[1]))
        )

    return along


def _moved(value: Array, jacobian: Array, step: Array) -> Array:
    """value (...) after a step (n_z,), with its jacobian (..., n_z)."""
    return value + (jacobian.reshape(value.size, len(step)) @ step).reshape(value.shape)


def _unit(terms: Array) -> Array:
    return terms / np.maximum(np.linalg.norm(terms, axis=-1, keepdims=True), 1e-300)


def _stacked(force: Dual, torque: Dual, n_z: int) -> tuple[Array, Array]:
    """Wrench (T, P, 6) and its tangent (T, P, 6, n_z)."""
    value = joined(force, torque)
    tangent = np.zeros((*value.shape, n_z))
    if force.tangent is not None:
        tangent[..., :3, :] = force.tangent
    if torque.tangent is not None:
        tangent[..., 3:, :] = torque.tangent
    return value, tangent
