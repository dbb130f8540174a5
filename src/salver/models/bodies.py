"""From the scenario's objects to bodies that mechanics can use, and whether they can exist at all."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from salver.geometry import Array, exp
from salver.models import shapes
from salver.models.contact import ContactSet, support_contacts
from salver.models.parameters import COM, INERTIA, UncertainSet, inertial_vector
from salver.models.polygons import inset, intersection
from salver.models.rigid_body import RigidBody, inertia_matrix

if TYPE_CHECKING:
    from salver.scenario import CarriedObject, Relative, Scenario

TRAY = "tray"


@dataclass(frozen=True)
class Body:
    """One carried object at rest on the tray.

    Its frame B has its origin at the nominal centre of mass and axes of the shape (z up).
    inertial: nominal inertial parameters in B (centre of mass at the origin).
    p_EB, R_EB: pose of B in the tray frame E. com_G: origin of B in the shape frame G.
    supports: what it stands on: names of objects, or ("tray",). contacts: with all of them, in B, in the order
    of supports; regions: how many contact points belong to each.
    """

    name: str
    solid: shapes.Solid
    inertial: RigidBody
    p_EB: Array
    R_EB: Array
    com_G: Array
    supports: tuple[str, ...]
    contacts: ContactSet
    regions: tuple[int, ...]

    @property
    def friction(self) -> float:
        return float(self.contacts.friction[0])

    @property
    def com_height(self) -> float:
        """Height of the nominal centre of mass over the base, m."""
        return float(self.com_G[2] - self.solid.base_z)

    @property
    def z_range_E(self) -> tuple[float, float]:
        """Heights of base and top over the tray, m."""
        centre = float(self.p_EB[2] - self.com_G[2])
        return centre + self.solid.base_z, centre - self.solid.base_z

    @cached_property
    def base_polygon_B(self) -> Array:
        """(n, 3) contact points in B."""
        return self.contacts.p_BC


def solid_of(shape: object) -> shapes.Solid:
    """The solid of a scenario's shape."""
    kind = shape.type  # type: ignore[attr-defined]
    if kind == "box":
        return shapes.box(shape.size)  # type: ignore[attr-defined]
    if kind == "cylinder":
        return shapes.cylinder(shape.radius, shape.height, shape.support_points)  # type: ignore[attr-defined]
    if kind == "prism":
        return shapes.prism(np.array(shape.polygon), shape.height)  # type: ignore[attr-defined]
    if kind == "composite":
        parts = [(solid_of(part.shape), np.array(part.position), part.mass) for part in shape.parts]  # type: ignore[attr-defined]
        return shapes.composite(parts)
    if kind == "mesh":
        return shapes.mesh(shape.file, shape.scale)  # type: ignore[attr-defined]
    raise ValueError(f'shape type "{kind}" is not supported')


def inertial_of(item: CarriedObject, solid: shapes.Solid) -> RigidBody:
    """Nominal inertial parameters in B, whose origin is the nominal centre of mass.

    Inertia that is not given is that of the uniform solid.
    """
    if item.inertia is None:
        inertia = item.mass * solid.unit_inertia
    elif len(item.inertia) == 3:
        inertia = np.diag(item.inertia)
    else:
        inertia = inertia_matrix(item.inertia)
    return RigidBody(item.mass, np.zeros(3), inertia)


def bodies(scenario: Scenario) -> list[Body]:
    """All carried objects of a scenario, at rest, in the scenario's order."""
    made: dict[str, Body] = {}
    top: dict[str, float] = {TRAY: 0.0}
    surface: dict[str, Array] = {}
    phase = np.deg2rad(scenario.contact.edge_phase_deg)
    for item in scenario.objects:
        solid = solid_of(item.shape)
        supports = (item.on,) if isinstance(item.on, str) else tuple(item.on)
        com_G = solid.centroid_G + np.asarray(item.com)
        base = max(top[name] for name in supports)
        R_EB = exp(np.array([0.0, 0.0, np.deg2rad(item.yaw_deg)]))
        centre_E = np.array([*item.at, base - solid.base_z])
        polygon = inset(solid.base_polygon, item.support_inset)
        regions = [_standing_on(polygon, centre_E, R_EB, surface.get(name)) for name in supports]
        corners = np.vstack(regions)
        points_B = np.column_stack([corners, np.full(len(corners), solid.base_z)]) - com_G
        contacts = support_contacts(points_B, item.friction, scenario.contact.edges, phase)
        made[item.name] = Body(
            item.name,
            solid,
            inertial_of(item, solid),
            centre_E + R_EB @ com_G,
            R_EB,
            com_G,
            supports,
            contacts,
            tuple(len(region) for region in regions),
        )
        top[item.name] = base + solid.height
        surface[item.name] = centre_E[:2] + solid.top_polygon @ R_EB[:2, :2].T
    return list(made.values())


def _standing_on(polygon: Array, centre_E: Array, R_EB: Array, surface_E: Array | None) -> Array:
    """The part (n, 2), in the shape frame, of a base polygon that rests on a surface in E (None: the whole tray)."""
    if surface_E is None:
        return polygon
    return intersection(polygon, (surface_E - centre_E[:2]) @ R_EB[:2, :2])


def uncertain_set(scenario: Scenario) -> UncertainSet:
    """All uncertain parameters of a scenario, in the order of its objects: eq (8)."""
    names: list[str] = []
    nominal: list[float] = []
    half: list[float] = []

    def add(name: str, value: float, half_range: float) -> None:
        if half_range > 0:
            names.append(name)
            nominal.append(value)
            half.append(half_range)

    several = len(scenario.objects) > 1
    for item in scenario.objects:
        prefix = f"{item.name}." if several else ""
        u = item.uncertainty
        values = inertial_vector(inertial_of(item, solid_of(item.shape)))
        if u.mass is not None:
            add(prefix + "mass", item.mass, _absolute(u.mass, item.mass))
        for name, value in zip(COM, u.com or (), strict=False):
            add(prefix + name, 0.0, value)
        if u.inertia is not None:
            for k, value in _inertia_ranges(u.inertia, values[4:]):
                add(prefix + INERTIA[k], values[4 + k], value)
        if u.friction is not None:
            add(prefix + "friction", item.friction, _absolute(u.friction, item.friction))
        for name, value in zip(("position_x", "position_y"), u.position or (), strict=False):
            add(prefix + name, 0.0, value)
    for name, value in zip(("tilt_x", "tilt_y"), scenario.uncertainty.tilt_deg or (), strict=False):
        add(name, 0.0, float(np.deg2rad(value)))
    return UncertainSet(
        tuple(names),
        np.array(nominal),
        np.array(half),
        scenario.uncertainty.set,
        _correlation(names, scenario.uncertainty.correlation),
    )


def _absolute(value: float | Relative, nominal: float) -> float:
    return value if isinstance(value, float) else value.relative * abs(nominal)


def _inertia_ranges(value: object, nominal: Array) -> list[tuple[int, float]]:
    """(index among the six entries, half-range): three values mean the diagonal."""
    diagonal = (0, 2, 5)
    if hasattr(value, "relative"):
        return [(k, value.relative * nominal[k]) for k in diagonal]
    assert isinstance(value, tuple)
    return list(zip(diagonal if len(value) == 3 else range(6), value, strict=True))


def _correlation(names: list[str], pairs: dict[str, float]) -> Array | None:
    """Correlation matrix of entries such as "mass,com_x" = 0.5; None when there is none."""
    if not pairs:
        return None
    matrix = np.eye(len(names))
    for key, value in pairs.items():
        first, _, second = (part.strip() for part in key.partition(","))
        i, j = names.index(first), names.index(second)
        matrix[i, j] = matrix[j, i] = value
    return matrix


def check(item: CarriedObject) -> None:
    """Raise ValueError when no such object can exist: one sentence, with the value."""
    solid = solid_of(item.shape)
    body = inertial_of(item, solid)
    principal = np.linalg.eigvalsh(body.inertia_com)
    if principal[0] <= 0:
        raise ValueError(
            f"inertia of {item.name} has the principal moment {principal[0]:.3g} kg m^2; all must be positive"
        )
    if principal[2] > (principal[0] + principal[1]) * (1 + 1e-9):
        raise ValueError(
            f"inertia of {item.name} has principal moments {', '.join(f'{x:.3g}' for x in principal)} kg m^2; no mass "
            "distribution has one that is larger than the sum of the other two"
        )
    com_G = solid.centroid_G + np.asarray(item.com)
    if not _inside_hull(com_G, solid.bounding_points_G):
        raise ValueError(f"com of {item.name} = {tuple(item.com)} m lies outside its shape; it must be inside")
    if len(inset(solid.base_polygon, item.support_inset)) < 3:
        raise ValueError(
            f"support_inset of {item.name} = {item.support_inset} m leaves nothing of its base to stand on"
        )


def _inside_hull(point: Array, vertices: Array) -> bool:
    from scipy.spatial import ConvexHull

    equations = ConvexHull(vertices).equations
    return bool(np.all(equations[:, :3] @ point + equations[:, 3] <= 1e-9))


def check_arrangement(scenario: Scenario) -> None:
    """Raise ValueError when the objects cannot stand as they are said to."""
    known = {TRAY}
    for item in scenario.objects:
        if item.name in known:
            raise ValueError(f'objects: the name "{item.name}" is used twice; each object needs its own')
        for support in (item.on,) if isinstance(item.on, str) else item.on:
            if support not in known:
                raise ValueError(
                    f'{item.name} stands on "{support}", which is neither "tray" nor an object listed before it'
                )
        known.add(item.name)
    items = bodies(scenario)
    _check_stacking(scenario, items)
    half = 0.5 * np.array(scenario.tray.size)
    for body in items:
        if body.supports == (TRAY,):
            corners = (body.R_EB @ body.contacts.p_BC.T).T[:, :2] + body.p_EB[:2]
            beyond = np.abs(corners) - half
            if beyond.max() > 1e-9:
                raise ValueError(
                    f"{body.name} stands {1e3 * beyond.max():.1f} mm over the edge of the tray, which is "
                    f"{scenario.tray.size[0]:g} x {scenario.tray.size[1]:g} m; move it with at, or give the tray "
                    "a larger size"
                )
    names = uncertain_set(scenario.model_copy(update={"uncertainty": _without_correlation(scenario)})).names
    for key in scenario.uncertainty.correlation:
        parts = [part.strip() for part in key.split(",")]
        if len(parts) != 2 or any(part not in names for part in parts):
            raise ValueError(
                f'uncertainty.correlation has the key "{key}"; it must name two uncertain parameters, as in '
                f'"mass,com_x"; uncertain here are {", ".join(names) or "none"}'
            )
    if scenario.uncertainty.correlation:
        if scenario.uncertainty.set == "box":
            raise ValueError('uncertainty.correlation needs set = "ellipsoid"; a box has no correlation')
        matrix = _correlation(list(names), scenario.uncertainty.correlation)
        if matrix is not None and np.linalg.eigvalsh(matrix)[0] <= 0:
            raise ValueError("uncertainty.correlation is not positive definite; no distribution has it")


def _check_stacking(scenario: Scenario, items: list[Body]) -> None:
    """Raise ValueError when an object stands beside or askew on its supports, or where another one is."""
    made = {body.name: body for body in items}
    for body in items:
        for name, count in zip(body.supports, body.regions, strict=True):
            if count < 3:
                raise ValueError(
                    f"{body.name} stands beside {name}, not on it; move it with at, from the middle of the tray"
                )
        tops = [0.0 if n == TRAY else made[n].z_range_E[1] for n in body.supports]
        if np.ptp(tops) > 1e-6:
            raise ValueError(
                f"{body.name} stands on {' and '.join(body.supports)}, whose tops differ by "
                f"{1e3 * np.ptp(tops):.1f} mm; they must be level"
            )
    outlines = [body.p_EB[:2] + (body.solid.outline_polygon - body.com_G[:2]) @ body.R_EB[:2, :2].T for body in items]
    for i, body in enumerate(items):
        for j in range(i):
            other = items[j]
            low = max(body.z_range_E[0], other.z_range_E[0])
            high = min(body.z_range_E[1], other.z_range_E[1])
            if high - low > 1e-6 and len(intersection(outlines[i], outlines[j])):
                raise ValueError(
                    f"{body.name} and {other.name} are in the same place; move one of them with at, "
                    "from the middle of the tray"
                )


def _without_correlation(scenario: Scenario) -> object:
    return scenario.uncertainty.model_copy(update={"correlation": {}})
