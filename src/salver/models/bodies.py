"""Objects as rigid bodies at rest on a tray, with checks that they can exist and stand there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from salver.geometry import Array, exp
from salver.models.contact.contact import ContactSet, support_contacts
from salver.models.described import SIDES, Tray
from salver.models.load_dynamics import LoadDynamics
from salver.models.rigid_body import RigidBody
from salver.models.shapes import shapes
from salver.models.shapes.hulls import polytope
from salver.models.shapes.polygons import inset, intersection
from salver.models.uncertain.parameters import Parameter, inertial_vector, phi_jacobian, phi_of

TRAY = "tray"


@dataclass(frozen=True)
class LooseObject:
    """An object before it is put on the tray.

    inertial: nominal inertial parameters in B. com: (3,) nominal centre of mass from the solid's centroid, m. on: its
    supports, names of objects or ("tray",). at: (2,) position of the shape's centre from the tray's centre, m. yaw:
    rad. support_inset: m, distance of the supporting area's edge from the edge of the base. any_contents: whether the
    mass distribution inside the solid is unknown. against: names of `SIDES` of the tray's rim that it is pushed
    against. inner: its liquid or pendulum, included in `inertial` and `com`.
    empty: inertial parameters without it, in B.
    """

    name: str
    solid: shapes.Solid
    inertial: RigidBody
    com: Array
    friction: float
    on: tuple[str, ...]
    at: tuple[float, float]
    yaw: float = 0.0
    support_inset: float = 0.0
    any_contents: bool = False
    inner: LoadDynamics | None = None
    empty: RigidBody | None = None
    against: tuple[str, ...] = ()

    @property
    def pushed(self) -> tuple[bool, bool]:
        """Whether the body is pushed against the rim along x and along y of the tray, where its place is then exact."""
        return any("x" in side for side in self.against), any("y" in side for side in self.against)

    @property
    def own(self) -> RigidBody:
        """The body whose mass, centre of mass and inertia are given, in B: without its liquid or pendulum."""
        return self.inertial if self.empty is None else self.empty

    @property
    def com_G(self) -> Array:
        """Origin (3,) of B in the shape frame G, m."""
        return self.solid.centroid_G + self.com


@dataclass(frozen=True, kw_only=True)
class Body(LooseObject):
    """One carried object at rest on the tray.

    Its frame B has its origin at the nominal centre of mass and the axes of the shape (z up).
    p_EB, R_EB: pose of B in the tray frame E. contacts: with all supports (`on`), in B, in their order. regions: number
    of contact points with each support. walls: contacts with the tray's rim, in B; None away from it.
    """

    p_EB: Array
    R_EB: Array
    contacts: ContactSet
    regions: tuple[int, ...]
    walls: ContactSet | None = None

    @property
    def points_B(self) -> Array:
        """Points (k, 3) in B whose convex hull contains the solid, m."""
        return self.solid.bounding_points_G - self.com_G

    def inner_origin_B(self, value: float) -> Array:
        """Origin O (3,) in B, m, of its liquid or pendulum, at a fill height or pendulum length, m."""
        assert self.inner is not None
        return np.array([0.0, 0.0, self.inner.origin(self.solid.base_z, value)]) - self.com_G

    @property
    def z_range_E(self) -> tuple[float, float]:
        """Heights of base and top above the tray, m."""
        centre = float(self.p_EB[2] - self.com_G[2])
        return centre + self.solid.base_z, centre - self.solid.base_z

    @cached_property
    def base_polygon_B(self) -> Array:
        """Contact points (n, 3) in B, m."""
        return self.contacts.p_BC

    def phi(self, inertial: Array, value: Array | float | None = None) -> Array:
        """Exact inertial parameters (..., 10) in B, with its liquid or pendulum at rest.

        inertial: (..., 10) values of `INERTIAL`. value: (...) fill height or pendulum length, m.
        """
        phi = phi_of(inertial)
        if self.inner is None:
            return phi
        value = np.broadcast_to(self.inner.value if value is None else value, phi.shape[:-1])
        held = {h: self._inner_phi(h) for h in np.unique(value).tolist()}
        return phi + np.array([held[h] for h in value.ravel().tolist()]).reshape(phi.shape)

    def _inner_phi(self, value: float) -> Array:
        assert self.inner is not None
        frozen = self.inner.modes(value).frozen
        return RigidBody(frozen.mass, frozen.com_B + self.inner_origin_B(value), frozen.inertia_com).phi

    @property
    def inside(self) -> str:
        """Its liquid or pendulum in words: "the liquid in cup"."""
        assert self.inner is not None
        return f"the {self.inner.noun} in {self.name}"

    @property
    def inner_parameter(self) -> Parameter | None:
        """The uncertain parameter fill or length of its liquid or pendulum; None without one."""
        return None if self.inner is None else Parameter(self.name, self.inner.quantity)

    def inner_value(self, deviation: Mapping[Parameter, float]) -> float | None:
        """Fill height or pendulum length, m, at a deviation from nominal; None without a liquid or pendulum."""
        if self.inner is None:
            return None
        return self.inner.value + deviation.get(Parameter(self.name, self.inner.quantity), 0.0)

    def phi_at(self, deviation: Mapping[Parameter, float]) -> Array:
        """Exact inertial parameters (10,) in B at a deviation of the uncertain parameters from nominal."""
        inertial = inertial_vector(self.own)
        for parameter, value in deviation.items():
            if parameter.owner == self.name and parameter.entry is not None:
                inertial[parameter.entry] += value
        return self.phi(inertial, self.inner_value(deviation))

    def phi_jacobian(self, parameters: Sequence[Parameter]) -> Array:
        """d phi / d p (10, n_p) at nominal; zero for parameters of other objects and those that do not change phi."""
        if self.inner is None:
            return phi_jacobian(self.inertial, self.name, parameters)
        step = 1e-3  # relative; phi is quadratic in mass and length, and cubic in the fill
        moved = [(self.phi_at({p: step}) - self.phi_at({p: -step})) / (2 * step) for p in parameters]
        return np.array(moved).reshape(len(parameters), 10).T

    def place_at(self, deviation: Mapping[Parameter, float]) -> Array:
        """Origin (3,) of B in E, m, at a deviation of the uncertain parameters, without the tilt of the tray."""
        shift = [deviation.get(Parameter(self.name, "position", axis), 0.0) for axis in "xy"]
        return self.p_EB + np.array([*shift, 0.0])


def bodies(
    objects: Sequence[LooseObject], edges: int = 4, phase: float = 0.0, tray: Tray | None = None
) -> tuple[Body, ...]:
    """All objects at rest, in their order. edges, phase: number of edges of the friction cones, first angle in rad.
    tray: with the rim against which some are set.

    Raises ValueError when an object is listed before its support, or is set against a rim that the tray lacks.
    """
    made: dict[str, Body] = {}
    top: dict[str, float] = {TRAY: 0.0}
    surface: dict[str, Array] = {}
    for item in objects:
        if item.name in top:
            raise ValueError(f'objects: the name "{item.name}" is used twice; each object needs its own')
        for support in item.on:
            if support not in top:
                raise ValueError(
                    f'{item.name} stands on "{support}", which is neither "tray" nor an object listed before it'
                )
        solid = item.solid
        base = max(top[name] for name in item.on)
        R_EB = exp(np.array([0.0, 0.0, item.yaw]))
        centre_E = np.array([*item.at, base - solid.base_z])
        walls = _walls(item, centre_E, R_EB, tray) if item.against else None
        polygon = inset(solid.base_polygon, item.support_inset)
        regions = [_standing_on(polygon, centre_E, R_EB, surface.get(name)) for name in item.on]
        corners = np.vstack(regions)
        points_B = np.column_stack([corners, np.full(len(corners), solid.base_z)]) - item.com_G
        contacts = support_contacts(points_B, item.friction, edges, phase)
        made[item.name] = Body(
            **vars(item),
            p_EB=centre_E + R_EB @ item.com_G,
            R_EB=R_EB,
            contacts=contacts,
            regions=tuple(len(region) for region in regions),
            walls=walls,
        )
        top[item.name] = base + solid.height
        surface[item.name] = centre_E[:2] + solid.top_polygon @ R_EB[:2, :2].T
    return tuple(made.values())


def _walls(item: LooseObject, centre_E: Array, R_EB: Array, tray: Tray | None) -> ContactSet:
    """Move the centre (3,) of an object until its outline touches the rim, and return the contacts there, without
    friction: at the ends of a side that touches, at the surface and at the top of the rim or of the object; of one that
    touches along one line, at the surface alone."""
    if tray is None or tray.rim is None:
        raise ValueError(f"{item.name} is set against the rim of the tray, which has none; give tray.rim a height")
    points, frames = [], []
    for name in item.against:
        axis, out_E = "xy".index(name[1]), np.array([*SIDES[name], 0.0])
        out_G = R_EB.T @ out_E
        side = item.solid.side(out_G[:2])
        centre_E[axis] = out_E[axis] * (0.5 * tray.size[axis] - side[0] @ out_G[:2])
        heights = (0.0, min(tray.rim.height, item.solid.height)) if len(side) > 1 else (0.0,)
        points += [[*corner, item.solid.base_z + z] for z in heights for corner in side.tolist()]
        up = np.array([0.0, 0.0, 1.0])
        frames += len(heights) * len(side) * [np.column_stack([np.cross(up, -out_G), up, -out_G])]
    return ContactSet(np.array(points) - item.com_G, np.array(frames), np.zeros(len(points)))


def _standing_on(polygon: Array, centre_E: Array, R_EB: Array, surface_E: Array | None) -> Array:
    """The part (n, 2), in the shape frame G, of a base polygon that rests on a surface in E (None: the whole tray)."""
    if surface_E is None:
        return polygon
    return intersection(polygon, (surface_E - centre_E[:2]) @ R_EB[:2, :2])


def check(item: LooseObject) -> None:
    """Raise ValueError, one sentence with the value, if such an object cannot exist."""
    principal = np.linalg.eigvalsh(item.inertial.inertia_com)
    if principal[0] <= 0:
        raise ValueError(
            f"inertia of {item.name} has the principal moment {principal[0]:.3g} kg m^2; all must be positive"
        )
    if principal[2] > (principal[0] + principal[1]) * (1 + 1e-9):
        raise ValueError(
            f"inertia of {item.name} has principal moments {', '.join(f'{x:.3g}' for x in principal)} kg m^2; no mass "
            "distribution has one that is larger than the sum of the other two"
        )
    if not polytope(item.solid.bounding_points_G).holds(item.com_G, 1e-9):
        raise ValueError(f"com of {item.name} = {tuple(item.com.tolist())} m lies outside its shape; it must be inside")
    if len(inset(item.solid.base_polygon, item.support_inset)) < 3:
        raise ValueError(
            f"support_inset of {item.name} = {item.support_inset} m leaves nothing of its base to stand on"
        )


def check_standing(items: Sequence[Body], tray_half: Array) -> None:
    """Raise ValueError if bodies on a tray of half size (2,), m, are tilted, off their supports, or intersect."""
    made = {body.name: body for body in items}
    for body in items:
        for name, count in zip(body.on, body.regions, strict=True):
            if count < 3:
                raise ValueError(
                    f"{body.name} stands beside {name}, not on it; move it with at, from the middle of the tray"
                )
        tops = [0.0 if n == TRAY else made[n].z_range_E[1] for n in body.on]
        if np.ptp(tops) > 1e-6:
            raise ValueError(
                f"{body.name} stands on {' and '.join(body.on)}, whose tops differ by "
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
    for body in items:
        if body.on == (TRAY,):
            corners = (body.R_EB @ body.contacts.p_BC.T).T[:, :2] + body.p_EB[:2]
            beyond = np.abs(corners) - tray_half
            if beyond.max() > 1e-9:
                raise ValueError(
                    f"{body.name} stands {1e3 * beyond.max():.1f} mm over the edge of the tray, which is "
                    f"{2 * tray_half[0]:g} x {2 * tray_half[1]:g} m; move it with at, or give the tray a larger size"
                )


def check_rim(items: Sequence[Body], tray_half: Array, height: float, half_range: Mapping[str, Array]) -> None:
    """Raise ValueError if a body may intersect a rim of some height, m, around a tray of half size (2,), m.

    half_range: name of a body to the half-ranges (2,) of its position, m.
    """
    for body in items:
        if body.z_range_E[0] >= height:
            continue
        for name, out in SIDES.items():
            way = np.array(out) @ body.R_EB[:2, :2]
            reach = np.array(out) @ body.p_EB[:2] + float((body.solid.side(way)[0] - body.com_G[:2]) @ way)
            beyond = reach + abs(np.array(out)) @ half_range[body.name] - abs(np.array(out)) @ tray_half
            if beyond > 1e-9:
                raise ValueError(
                    f"{body.name} may stand {1e3 * beyond:.1f} mm inside the rim at {name}, within its "
                    f'uncertainty.position; move it with at, or set it against the rim with against = "{name}"'
                )
