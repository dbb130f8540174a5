"""What keeps the carried objects in place, as linear functions of their wrenches that must stay positive.

paper: Lambda = pinv(G F-hat) wrench >= 0 with the tube of the closed loop's input sensitivity (eq 16). It asks
for one particular distribution of the contact forces, and is sufficient.
exact: the wrench that the motion needs lies in the contact wrench cone, A wrench <= 0, for the least friction.
It is linear in the inertial parameters, so its spread over their set is not first order but exact: a body that
follows its tray needs Y(t) phi, whatever its phi.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from salver.geometry import Array
from salver.models.bodies import Body, bodies, uncertain_set
from salver.models.parameters import UncertainSet, phi_jacobian
from salver.models.wrench_cone import facets
from salver.scenario import Scenario
from salver.sensitivity.dual import Dual
from salver.sensitivity.tray import BodyMotion, TraySensitivity


@dataclass(frozen=True)
class Rows:
    """Functions map @ wrench of one body that must stay above the margin: at T instants, with derivatives.

    map (n_c, 6). wrench (T, 6) and wrench_jacobian (T, 6, n_z): nominal. spread (T, 6, n_p) and
    spread_jacobian (T, 6, n_p, n_z): sensitivity of the wrench times the factor of the uncertain set.
    """

    body: str
    map: Array
    wrench: Array
    wrench_jacobian: Array
    spread: Array
    spread_jacobian: Array
    box: bool

    def slack(self, step: Array | None = None) -> tuple[Array, Array]:
        """Value minus tube radius (T, n_c), and the spread (T, n_c, n_p), after a step (n_z,) of the linear model."""
        wrench, spread = self.wrench, self.spread
        if step is not None:
            wrench, spread = wrench + self.wrench_jacobian @ step, spread + self.spread_jacobian @ step
        sides = self.map @ spread
        radius = np.abs(sides).sum(axis=-1) if self.box else np.linalg.norm(sides, axis=-1)
        return wrench @ self.map.T - radius, sides

    def cuts(self, instant: Array, row: Array, sides: Array) -> tuple[Array, Array]:
        """Half spaces c0 + c d >= 0 that contain all steps d with positive slack at some (instant, row).

        The slack is concave in d; these are its tangents where the spread is `sides` (m, n_p). Returns c0 (m,),
        c (m, n_z).
        """
        if self.box:
            dual = np.sign(sides)
        else:
            dual = sides / np.maximum(np.linalg.norm(sides, axis=-1, keepdims=True), 1e-300)
        maps = self.map[row]
        weights = maps[:, :, None] * dual[:, None, :]
        offset = np.einsum("mi,mi->m", maps, self.wrench[instant])
        offset -= np.einsum("mip,mip->m", weights, self.spread[instant])
        slope = np.einsum("mi,miz->mz", maps, self.wrench_jacobian[instant])
        slope -= np.einsum("mip,mipz->mz", weights, self.spread_jacobian[instant])
        return offset, slope


@dataclass(frozen=True)
class Contact:
    """The condition of one body: its rows, where it is relative to B, and how it depends on the parameters."""

    body: Body
    map: Array
    p_BX: Array
    R_BX: Array
    phi_jacobian: Array
    follows: bool  # whether the spread is that of a body that follows its tray, or the closed loop's


def contacts_for(scenario: Scenario) -> list[Contact]:
    """The condition of every carried object, in the scenario's order."""
    carried, uncertain = bodies(scenario), uncertain_set(scenario)
    first, paper = carried[0], scenario.contact.condition == "paper"
    several = len(carried) > 1
    out = []
    for body in carried:
        prefix = f"{body.name}." if several else ""
        own = tuple(n.removeprefix(prefix) if n.startswith(prefix) else "" for n in uncertain.names)
        if paper:
            rows = np.linalg.pinv(body.contacts.grasp_map)
        else:
            least = body.friction - _half_range(uncertain, prefix + "friction")
            rows = -facets(replace(body.contacts, friction=np.full(body.contacts.count, least)))
        p_BX = first.R_EB.T @ (body.p_EB - first.p_EB)
        jacobian = phi_jacobian(body.inertial, own)
        out.append(Contact(body, rows, p_BX, first.R_EB.T @ body.R_EB, jacobian, not paper or body is not first))
    return out


def _half_range(uncertain: UncertainSet, name: str) -> float:
    return float(uncertain.half_range[uncertain.names.index(name)]) if name in uncertain.names else 0.0


def rows_of(contact: Contact, uncertain: UncertainSet, motion: BodyMotion, loop: TraySensitivity, n_z: int) -> Rows:
    """The condition of a body along a motion of B (with derivatives by z, or without)."""
    own_motion = motion.of_frame(contact.p_BX, contact.R_BX)
    wrench, wrench_jacobian = _stacked(*own_motion.wrench(contact.body.inertial.phi[:, None]), n_z)
    if contact.follows:
        change = _follower(contact, uncertain, own_motion)
    else:
        change = loop.df, loop.dtau
    spread, spread_jacobian = _stacked(*change, n_z)
    factor = uncertain.factor
    return Rows(
        contact.body.name,
        contact.map,
        wrench[:, 0],
        wrench_jacobian[:, 0],
        np.einsum("tpi,pq->tiq", spread, factor),
        np.einsum("tpiz,pq->tiqz", spread_jacobian, factor, optimize=True),
        uncertain.kind == "box",
    )


def _follower(contact: Contact, uncertain: UncertainSet, motion: BodyMotion) -> tuple[Dual, Dual]:
    """d wrench / d p of a body that follows its tray: inertial parameters, place on the tray, tilt of the tray."""
    df, dtau = motion.wrench(contact.phi_jacobian)
    body, n_p = contact.body.inertial, uncertain.size
    place, tilt = np.zeros((1, n_p, 3)), np.zeros((1, n_p, 3))
    for j, name in enumerate(uncertain.names):
        owner, _, parameter = name.rpartition(".")
        if owner in ("", contact.body.name) and parameter.startswith("position_"):
            place[0, j] = contact.body.R_EB.T @ np.eye(3)["xy".index(parameter[-1])]
        elif parameter.startswith("tilt_"):
            tilt[0, j] = contact.body.R_EB.T @ np.eye(3)["xy".index(parameter[-1])]
    if place.any():
        shift = Dual(place)
        df += (motion.alpha.cross(shift) + motion.omega.cross(motion.omega.cross(shift))).scaled(body.mass)
    if tilt.any():
        df += motion.force.cross(Dual(tilt)).scaled(body.mass)
    return df, dtau


def _stacked(force: Dual, torque: Dual, n_z: int) -> tuple[Array, Array]:
    """Wrench (T, P, 6) and its tangent (T, P, 6, n_z)."""
    value = np.concatenate([force.value, np.broadcast_to(torque.value, force.value.shape)], axis=-1)
    tangent = np.zeros((*value.shape, n_z))
    if force.tangent is not None:
        tangent[..., :3, :] = force.tangent
    if torque.tangent is not None:
        tangent[..., 3:, :] = torque.tangent
    return value, tangent
