"""The contact wrench cone: exactly the wrenches that unilateral frictional contacts can transmit.

The cone is {G F-hat Lambda : Lambda >= 0} (paper, eqs 2 to 5; Balkcom and Trinkle 2002). The paper requires
pinv(G F-hat) F >= 0, which fixes one distribution of the internal forces: sufficient, not necessary.
Here the condition is a list of half-spaces, A F <= 0, computed once for each contact geometry.

For a support polygon with one friction coefficient, the possible normal forces do not depend on the coefficient, and
the tangential part of the cone, (f_x, f_y, tau_z) in the contact plane, is proportional to it. So the facets are
computed once with coefficient 1, and the least friction for a wrench is a ratio.

Contacts on walls of a rim push horizontally (docs/physics.md, "A rim"). With them facets depend on friction in other
ways, so that they are computed for each coefficient. A facet's row is the motion along which the object gives way:
there it slides if its centre moves along the base by more than its rotation times `length`, else it tips.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from salver.geometry import Array, Mask, hat
from salver.models.contact.contact import ContactSet, cone_edges
from salver.models.shapes import hulls
from salver.models.shapes.polygons import convex_hull, half_planes

_TANGENTIAL = np.array([True, True, False, False, False, True])


@dataclass(frozen=True)
class Facets:
    """Facets of a contact wrench cone.

    rows: (n_f, 6), A F <= 0 exactly for the wrenches F (force, moment at the origin of B) in the cone. Rows have unit
    length if moments are divided by `length`, so that -max(A F) is the smallest disturbance (force in N, or moment over
    `length`) that takes F out of the cone.
    friction_limited: (n_f,) whether the facet depends on friction (beyond it the object slides) or only on the support
    polygon (beyond it the object tips or lifts); with walls, whether it slides more than it tips.
    length: m, radius of the support about its centre.
    """

    rows: Array
    friction_limited: Mask
    length: float


def cone_facets(contacts: ContactSet) -> Facets:
    """Facets of the k-edged contact wrench cone, cached by geometry."""
    length = support_length(contacts)
    if _is_planar_support(contacts):
        unit = _unit_facets(_polygon_key(contacts, length), contacts.edges, contacts.phase)
        rows = unit * np.where(_TANGENTIAL, 1 / contacts.friction[0], 1.0)
        limited = np.any(np.abs(unit[:, _TANGENTIAL]) > 1e-9, axis=1)
    else:
        scale = np.array([1, 1, 1, length, length, length])
        rays = _rays(contacts) @ _shift_to_centre(contacts).T / scale
        try:
            rows = hulls.cone_facets(rays)
        except ValueError as error:
            raise ValueError(f"the contacts can press against each other, which no cone has: {error}") from None
        limited = np.linalg.norm(rows[:, 3:5], axis=1) <= np.linalg.norm(rows[:, :2], axis=1)
    rows = rows / np.array([1, 1, 1, length, length, length]) @ _shift_to_centre(contacts)
    size = np.linalg.norm(rows * np.array([1, 1, 1, length, length, length]), axis=1)
    return Facets(rows / size[:, None], limited, length)


def _rays(contacts: ContactSet) -> Array:
    """Rays (n, 6) of the cone. Beside walls, friction of the base may push towards a wall of height h by at most
    x / h of the normal force at the distance x from it: no more than makes up for the lever of the wall's push."""
    if not contacts.on_walls:
        return contacts.grasp_map.T
    base, walls = contacts.base, contacts.walls
    rays, upright = [walls.grasp_map.T], np.array([0.0, 0.0, 1.0])
    for edge in (base.R_BC[0] @ cone_edges(base.friction[0], base.edges, base.phase)).T:
        # Points of the base, each with the share of friction there, first 0 and 1: (n, 4), then cut by each wall.
        points = np.vstack([np.column_stack([base.p_BC, np.full(base.count, share)]) for share in (0.0, 1.0)])
        for wall in np.unique(np.round(walls.R_BC[:, :, 2], 12), axis=0):
            own = walls.p_BC[walls.R_BC[:, :, 2] @ wall > 0.5]
            lever = (own[:, 2].max() - base.p_BC[0, 2]) * max(-float(wall @ edge), 0.0) / edge[2]
            points = _cut(points, np.append(wall, -lever), float((base.p_BC @ wall).min()))
        force = points[:, 3:] * edge + (1 - points[:, 3:]) * edge[2] * upright
        rays.append(np.hstack([force, np.cross(points[:, :3], force)]))
    return np.vstack(rays)


def _cut(points: Array, normal: Array, low: float) -> Array:
    """Points (n, d) whose convex hull is the part of that of others (m, d) with normal . x >= low."""
    value = points @ normal - low
    out = value < -1e-12
    inside, outside, above = points[~out], points[out], value[~out, None]
    share = (above / (above - value[out]))[:, :, None]
    crossing = inside[:, None] + share * (outside - inside[:, None])
    return np.vstack([inside, crossing.reshape(-1, points.shape[1])])


def margin(rows: Array, wrench_B: Array) -> Array:
    """Distance (T,) in N of wrenches (T, 6) from the boundary of A F <= 0; negative outside."""
    return -(wrench_B @ rows.T).max(axis=-1)


def support_length(contacts: ContactSet) -> float:
    """Largest distance of a contact point from the mean of all, m; 1 for a single point."""
    radius = float(np.linalg.norm(contacts.p_BC - contacts.p_BC.mean(axis=0), axis=1).max())
    return radius if radius > 0 else 1.0


def friction_needed(contacts: ContactSet, wrench_B: Array) -> Array:
    """Least uniform friction coefficient (T,) at which the k-edged cone contains wrenches (T, 6).

    Infinite if no friction suffices, because the wrench pulls or its centre of pressure is outside the support.
    """
    wrench_B = np.atleast_2d(wrench_B)
    if contacts.on_walls:
        return _friction_needed_beside_walls(contacts, wrench_B)
    if not _is_planar_support(contacts):
        raise ValueError("friction_needed is defined for contacts in one plane with one friction coefficient")
    length = support_length(contacts)
    unit = _unit_facets(_polygon_key(contacts, length), contacts.edges, contacts.phase)
    scaled = wrench_B @ _shift_to_centre(contacts).T / np.array([1, 1, 1, length, length, length])
    tangential = scaled[:, _TANGENTIAL] @ unit[:, _TANGENTIAL].T
    normal = -scaled[:, ~_TANGENTIAL] @ unit[:, ~_TANGENTIAL].T
    tiny = 1e-12 * np.abs(scaled).max(axis=1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(tangential > tiny, np.where(normal > tiny, tangential / normal, np.inf), 0.0)
    possible = np.all((normal >= -tiny) | (np.abs(tangential) > tiny), axis=1)
    return np.where(possible & (scaled[:, 2] > 0), ratio.max(axis=1), np.inf)


def _friction_needed_beside_walls(contacts: ContactSet, wrench_B: Array) -> Array:
    """`friction_needed` of the base, interpolated between coefficients 20 % apart: to 1 %, and up to 5 % too high where
    the object nearly tips over a wall."""
    friction = np.geomspace(1e-3, 5.0, 48)
    beyond = np.array([-margin(cone_facets(contacts.of_friction(mu)).rows, wrench_B) for mu in friction])  # (48, T)
    first, column = np.argmax(beyond <= 0, axis=0), np.arange(len(wrench_B))
    before = np.maximum(first - 1, 0)
    high, low = beyond[before, column], beyond[first, column]
    share = np.where(first > 0, high / np.where(first > 0, high - low, 1.0), 0.0)
    found = friction[before] + share * (friction[first] - friction[before])
    return np.where((beyond <= 0).any(axis=0), found, np.inf)


def zero_moment_point(contacts: ContactSet, wrench_B: Array) -> Array:
    """Zero-moment point (T, 2) in the contact plane, from the mean contact point, in the contacts' axes, m."""
    centred = np.atleast_2d(wrench_B) @ _shift_to_centre(contacts.base).T
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.stack([-centred[:, 4] / centred[:, 2], centred[:, 3] / centred[:, 2]], axis=1)


def tip_over_margin(contacts: ContactSet, wrench_B: Array) -> Array:
    """Distance (T,) of the zero-moment point to the nearest edge of the support polygon, m; with walls, distance by
    which it may move until the object tips although they push.

    Negative outside; minus infinity if the normal force does not press.
    """
    wrench_B = np.atleast_2d(wrench_B)
    pressing = wrench_B[:, :3] @ contacts.R_BC[0][:, 2] > 0
    with np.errstate(divide="ignore", invalid="ignore"):
        if contacts.on_walls:
            rows, pressed = support_rows(contacts)
            distance = -(wrench_B @ rows.T).max(axis=1) / (wrench_B @ pressed)
        else:
            normal, offset = half_planes(support_polygon(contacts))
            distance = (offset - zero_moment_point(contacts, wrench_B) @ normal.T).min(axis=1)
    return np.where(pressing, distance, -np.inf)


def support_rows(contacts: ContactSet) -> tuple[Array, Array]:
    """Rows (n, 6), m, one for each edge of the support polygon, and the row (6,) of f_z.

    (row F_B) / f_z is the distance of the zero-moment point beyond the edge. With walls the rows are those of the
    facets along which the object tips, and the distance is the one beyond a facet.
    """
    shift = _shift_to_centre(contacts.base)
    if contacts.on_walls:
        cone = cone_facets(contacts)
        rows = cone.rows[~cone.friction_limited]
        return rows / np.linalg.norm(rows[:, 3:] @ contacts.R_BC[0][:, :2], axis=1)[:, None], shift[2]
    normal, offset = half_planes(support_polygon(contacts))
    rows = normal[:, 1, None] * shift[3] - normal[:, 0, None] * shift[4] - offset[:, None] * shift[2]
    return rows, shift[2]


def support_polygon(contacts: ContactSet) -> Array:
    """Convex hull (n, 2) of the contact points, counter-clockwise, in the contacts' axes about their mean, m."""
    points = contacts.base.p_BC
    return convex_hull(((points - points.mean(axis=0)) @ contacts.R_BC[0])[:, :2])


def _is_planar_support(contacts: ContactSet) -> bool:
    """Whether three or more contact points, not on a line, lie in one plane, with one normal and one friction."""
    if contacts.count < 3 or np.ptp(contacts.friction) > 0 or np.ptp(contacts.R_BC, axis=0).max() > 1e-12:
        return False
    centred = (contacts.p_BC - contacts.p_BC.mean(axis=0)) @ contacts.R_BC[0]
    extent = np.linalg.svd(centred[:, :2], compute_uv=False)
    return bool(np.ptp(centred[:, 2]) <= 1e-9 * extent[0] and extent[1] > 1e-6 * extent[0])


def _shift_to_centre(contacts: ContactSet) -> Array:
    """Map (6, 6) from a wrench at the origin of B to the wrench at the mean contact point, in the axes of contact 0."""
    rotation = contacts.R_BC[0].T
    shift = np.zeros((6, 6))
    shift[:3, :3] = shift[3:, 3:] = rotation
    shift[3:, :3] = -rotation @ hat(contacts.p_BC.mean(axis=0))
    return shift


def _polygon_key(contacts: ContactSet, length: float) -> tuple[tuple[float, float], ...]:
    return tuple((float(x), float(y)) for x, y in support_polygon(contacts) / length)


@lru_cache(maxsize=256)
def _unit_facets(polygon: tuple[tuple[float, float], ...], edges: int, phase: float) -> Array:
    """Facets (n_f, 6) of a support polygon around the origin with friction 1, for moments about the origin."""
    tangents = cone_edges(1.0, edges, phase) * np.sqrt(2)
    rays = [(e[0], e[1], 1, y, -x, x * e[1] - y * e[0]) for x, y in polygon for e in tangents.T]
    rows = hulls.cone_facets(np.array(rays))
    rows[np.abs(rows) < 1e-13] = 0.0
    rows.setflags(write=False)
    return rows
