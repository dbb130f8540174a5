"""Contact interfaces between the tray and objects, and between objects that stand on each other.

Objects that touch each other form a network of interfaces. Each body's balance, written at the tray frame E,
    sum of the wrenches from below - sum of the wrenches on its top = W_body,
determines all interface wrenches if every body has one support (a tree): an interface carries everything above it. A
body on two supports (an arch) leaves six unknowns: w = share W + internal w_0 with any w_0, and the network holds if
some w_0 puts every interface wrench into its contact wrench cone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from salver.geometry import Array, hat
from salver.models.bodies import TRAY, Body
from salver.models.contact.contact import ContactSet
from salver.models.shapes.polygons import eroded, half_planes, intersection
from salver.models.tray_motion import frame_map, wrench_map
from salver.models.uncertain.parameters import Parameter, UncertainSet


@dataclass(frozen=True)
class Interface:
    """Body `upper` (index in the network) stands on body `lower`, or on the tray (None). contacts: in B of upper, with
    those on the tray's rim."""

    name: str
    upper: int
    lower: int | None
    contacts: ContactSet


@dataclass(frozen=True)
class ContactNetwork:
    """Bodies that touch each other, directly or through others, and their interfaces.

    share: (n_e, m, 6, 6) part of body j's required wrench at E that interface e transmits, at E.
    internal: (n_e, 6, n_w) self-balancing interface wrenches at E; n_w = 0 for a tree.
    """

    bodies: tuple[Body, ...]
    interfaces: tuple[Interface, ...]
    share: Array
    internal: Array


def networks(items: Sequence[Body]) -> tuple[ContactNetwork, ...]:
    """The networks of bodies, in the scenario's order; a single body on the tray is a network."""
    group = {body.name: {body.name} for body in items}
    for body in items:
        for support in body.on:
            if support != TRAY:
                merged = group[body.name] | group[support]
                for name in merged:
                    group[name] = merged
    made, seen = [], set()
    for body in items:
        if body.name not in seen:
            seen |= group[body.name]
            made.append(_network(tuple(b for b in items if b.name in group[body.name])))
    return tuple(made)


def _network(items: tuple[Body, ...]) -> ContactNetwork:
    index = {body.name: i for i, body in enumerate(items)}
    interfaces = []
    for i, body in enumerate(items):
        start = 0
        for support, count in zip(body.on, body.regions, strict=True):
            points = slice(start, start + count)
            start += count
            part = replace(
                body.contacts,
                p_BC=body.contacts.p_BC[points],
                R_BC=body.contacts.R_BC[points],
                friction=body.contacts.friction[points],
            )
            if body.walls is not None:
                part = part.joined(body.walls)
            interfaces.append(Interface(f"{body.name} on {support}", i, index.get(support), part))
    incidence = np.zeros((len(items), len(interfaces)))
    for e, interface in enumerate(interfaces):
        incidence[interface.upper, e] = 1
        if interface.lower is not None:
            incidence[interface.lower, e] = -1
    return ContactNetwork(items, tuple(interfaces), _share(items, interfaces, incidence), _internal(incidence))


def _share(items: tuple[Body, ...], interfaces: list[Interface], incidence: Array) -> Array:
    """`ContactNetwork.share` of the distribution with the least sum of squared forces at the contact points."""
    m, n_e = incidence.shape
    if m == n_e:
        return np.linalg.inv(incidence)[:, :, None, None] * np.eye(6)
    maps = [to_tray(items[f.upper].p_EB, items[f.upper].R_EB) @ f.contacts.base.grasp_matrix for f in interfaces]
    forces = np.zeros((6 * n_e, sum(g.shape[1] for g in maps)))
    column = 0
    for e, g in enumerate(maps):
        forces[6 * e : 6 * e + 6, column : column + g.shape[1]] = g
        column += g.shape[1]
    share = forces @ np.linalg.pinv(np.kron(incidence, np.eye(6)) @ forces)
    return np.swapaxes(share.reshape(n_e, 6, m, 6), 1, 2)


def _internal(incidence: Array) -> Array:
    if incidence.shape[0] == incidence.shape[1]:  # a tree
        return np.zeros((len(incidence), 6, 0))
    from scipy.linalg import null_space

    basis = null_space(incidence)
    n_e, n = basis.shape
    return np.einsum("en,ij->einj", basis, np.eye(6)).reshape(n_e, 6, 6 * n)


def to_tray(p_EB: Array, R_EB: Array) -> Array:
    """Map (6, 6) from a wrench at B, in B, to the wrench at E, in E."""
    matrix = np.zeros((6, 6))
    matrix[:3, :3] = matrix[3:, 3:] = R_EB
    matrix[3:, :3] = hat(p_EB) @ R_EB
    return matrix


def needed_at_tray(body: Body, phi: Array) -> Array:
    """Map (6, 12) from w of E to the wrench at E that a body with inertial parameters phi (10,) in its B needs."""
    return to_tray(body.p_EB, body.R_EB) @ wrench_map(phi) @ frame_map(body.p_EB, body.R_EB)


def shift_ranges(network: ContactNetwork, uncertain: UncertainSet) -> dict[str, Array]:
    """Half-ranges (2,) of position_x, position_y, m, by name of the body."""
    ranges = uncertain.ranges
    return {
        body.name: np.array([ranges.get(Parameter(body.name, "position", axis), 0.0) for axis in "xy"])
        for body in network.bodies
    }


def sure_contacts(network: ContactNetwork, tray_half: Array, uncertain: UncertainSet) -> list[ContactSet]:
    """Contact sets that are valid for all parameters: least friction, and the area common to all positions.

    tray_half: (2,) half size of the tray, m. A region that may vanish is returned unchanged; `regions_lost` names such
    interfaces.
    """
    shift, ranges = shift_ranges(network, uncertain), uncertain.ranges
    kept = []
    for interface in network.interfaces:
        upper = network.bodies[interface.upper]
        least = upper.friction - ranges.get(Parameter(upper.name, "friction"), 0.0)
        contacts, walls = interface.contacts.base.of_friction(least), interface.contacts.walls
        region = _sure_region(network, interface, tray_half, shift)
        if region is not None and len(region) >= 3:
            p_BC = np.column_stack([region, np.full(len(region), contacts.p_BC[0, 2])])
            contacts = replace(
                contacts,
                p_BC=p_BC,
                R_BC=np.tile(contacts.R_BC[0], (len(p_BC), 1, 1)),
                friction=np.full(len(p_BC), contacts.friction[0]),
            )
        kept.append(contacts.joined(walls))
    return kept


def regions_lost(network: ContactNetwork, tray_half: Array, uncertain: UncertainSet) -> list[str]:
    """Names of the interfaces whose contact region may vanish within the position uncertainty."""
    shift = shift_ranges(network, uncertain)
    regions = [(f.name, _sure_region(network, f, tray_half, shift)) for f in network.interfaces]
    return [name for name, region in regions if region is not None and len(region) < 3]


def _sure_region(
    network: ContactNetwork, interface: Interface, tray_half: Array, shift: dict[str, Array]
) -> Array | None:
    """Part (n, 2) of a contact region common to all positions, in B of the upper body; None if it is all of it."""
    upper = network.bodies[interface.upper]
    range_E = shift.get(upper.name, np.zeros(2)).copy()
    if interface.lower is None:
        surface_E = tray_half * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
    else:
        lower = network.bodies[interface.lower]
        range_E += shift.get(lower.name, np.zeros(2))
        surface_E = lower.p_EB[:2] + (lower.solid.top_polygon - lower.com_G[:2]) @ lower.R_EB[:2, :2].T
    if not np.any(range_E):
        return None
    sure_E = eroded(surface_E, range_E)
    if len(sure_E) < 3:
        return np.empty((0, 2))
    # The base moves with the upper body; the region loses area only at the edge of the surface below.
    base_B = interface.contacts.base.p_BC[:, :2]
    sure_B = (sure_E - upper.p_EB[:2]) @ upper.R_EB[:2, :2]
    normal, offset = half_planes(sure_B)
    if np.all(base_B @ normal.T <= offset + 1e-12):
        return None
    return intersection(base_B, sure_B)
