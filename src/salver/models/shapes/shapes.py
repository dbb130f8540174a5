"""Shapes of carried objects: size, support points, inertia of a uniform solid.

A shape has its own frame G: origin at the centre of its bounding height, z up, base at z = -height/2.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from salver.geometry import Array
from salver.models.rigid_body import parallel_axis
from salver.models.shapes.hulls import polytope
from salver.models.shapes.mesh_files import read_mesh_file
from salver.models.shapes.polygons import convex_hull, simplified


@dataclass(frozen=True)
class Solid:
    """A shape: hull, support points, mass properties of a uniform solid. Coordinates in G, m.

    height: along z. base_polygon: (n, 2) vertices of the convex support polygon, counter-clockwise.
    centroid_G: (3,) centre of volume. unit_inertia: (3, 3) about it, kg m^2 per kg.
    bounding_points_G: (k, 3) points whose convex hull contains the solid.
    top_polygon: (m, 2) the flat top, on which another object can stand. outline_polygon: the outline from above.
    surface: vertices (v, 3) and triangles (k, 3) of a mesh, for pictures; None if the polygons describe the shape.
    radius: of a round outline, m; None for others. volume: m^3, of a box, cylinder or cone.
    """

    height: float
    base_polygon: Array
    centroid_G: Array
    unit_inertia: Array
    bounding_points_G: Array
    top_polygon: Array
    outline_polygon: Array
    surface: tuple[Array, Array] | None = None
    radius: float | None = None
    volume: float = np.nan

    @property
    def base_z(self) -> float:
        return -0.5 * self.height

    def side(self, way: Array) -> Array:
        """Ends (1 or 2, 2) of the stretch of the outline that is farthest along a unit vector (2,) in G, m."""
        if self.radius is not None:
            return self.radius * way[None]
        along = self.outline_polygon @ way
        return self.outline_polygon[along >= along.max() - 1e-9]


def box(size: tuple[float, float, float]) -> Solid:
    """Cuboid with edges `size` along x, y, z."""
    x, y, z = size
    polygon = 0.5 * np.array([[x, y], [-x, y], [-x, -y], [x, -y]])
    inertia = np.diag([y * y + z * z, x * x + z * z, x * x + y * y]) / 12
    return Solid(z, polygon, np.zeros(3), inertia, _extrude(polygon, z), polygon, polygon, volume=x * y * z)


def cylinder(radius: float, height: float, support_points: int = 8) -> Solid:
    """Upright cylinder; its base is the inscribed regular polygon with `support_points` vertices."""
    across = (3 * radius**2 + height**2) / 12
    inertia = np.diag([across, across, 0.5 * radius**2])
    return replace(cone(radius, radius, height, support_points), unit_inertia=inertia)


def cone(radius: float, top_radius: float, height: float, support_points: int = 8) -> Solid:
    """Upright truncated cone; its base and top are the inscribed regular polygons with `support_points` vertices."""
    a, b = radius, top_radius
    angle = 2 * np.pi * np.arange(support_points) / support_points
    around = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    area = a * a + a * b + b * b  # three times the mean of r^2
    centre = height * (b * b - a * a) / (4 * area)  # over the middle
    axial = 0.3 * (a**4 + a**3 * b + a * a * b * b + a * b**3 + b**4) / area
    across = 0.5 * axial + height**2 * (a * a + 3 * a * b + 6 * b * b) / (10 * area) - (centre + 0.5 * height) ** 2
    inside = np.cos(np.pi / support_points)  # of a circle around which the polygon is drawn
    return Solid(
        height,
        a * around,
        np.array([0.0, 0.0, centre]),
        np.diag([across, across, axial]),
        _extrude(a * around / inside, height, b * around / inside),
        b * around,
        max(a, b) * around,
        radius=max(a, b),
        volume=np.pi / 3 * area * height,
    )


def prism(polygon: Array, height: float) -> Solid:
    """Upright prism over a convex polygon (n, 2), counter-clockwise, in G's xy plane.

    Area moments by Green's theorem over the edges.
    """
    p = np.asarray(polygon, dtype=float)
    q = np.roll(p, -1, axis=0)
    cross = p[:, 0] * q[:, 1] - q[:, 0] * p[:, 1]
    area = 0.5 * cross.sum()
    centre = ((p + q) * cross[:, None]).sum(axis=0) / (6 * area)
    second = np.einsum("e,eij->ij", cross, _edge_second_moment(p, q)) / area
    second -= np.outer(centre, centre)
    sxx, syy, sxy = second[0, 0], second[1, 1], second[0, 1]
    szz = height**2 / 12
    inertia = np.array([[syy + szz, -sxy, 0], [-sxy, sxx + szz, 0], [0, 0, sxx + syy]])
    return Solid(height, p, np.array([*centre, 0.0]), inertia, _extrude(p, height), p, p)


def composite(parts: list[tuple[Solid, Array, float]]) -> Solid:
    """Rigidly joined parts (solid, position of its G, mass), which may touch or overlap; their masses add up.

    The support polygon is the hull of the bases of the lowest parts, the top polygon that of the tops of the highest.
    The composite's G is at the middle of its bounding height.
    """
    low = min(position[2] - 0.5 * solid.height for solid, position, _ in parts)
    high = max(position[2] + 0.5 * solid.height for solid, position, _ in parts)
    middle = np.array([0.0, 0.0, 0.5 * (low + high)])
    tolerance = 1e-9 + 1e-6 * (high - low)
    base = [s.base_polygon + p[:2] for s, p, _ in parts if p[2] - 0.5 * s.height <= low + tolerance]
    top = [s.top_polygon + p[:2] for s, p, _ in parts if p[2] + 0.5 * s.height >= high - tolerance]
    masses = np.array([mass for *_, mass in parts])
    centres = np.array([s.centroid_G + p - middle for s, p, _ in parts])
    share = masses / masses.sum()
    centroid = share @ centres
    inertia = sum(
        w * (s.unit_inertia + parallel_axis(1.0, c - centroid))
        for w, c, (s, _, _) in zip(share, centres, parts, strict=True)
    )
    points = np.vstack([s.bounding_points_G + p - middle for s, p, _ in parts])
    return Solid(
        high - low,
        simplified(convex_hull(np.vstack(base))),
        centroid,
        np.asarray(inertia),
        points,
        simplified(convex_hull(np.vstack(top))),
        convex_hull(points[:, :2]),
    )


def mesh(file: str, scale: float = 1.0) -> Solid:
    """A closed surface mesh (STL, OBJ, PLY, ...), z up, read from `file` and scaled to metres.

    Its base is the hull of its lowest vertices (within 0.1 % of its height; at most 16 of them); its inertia is that of
    a uniform solid. G is at the middle of the bounding box. Raises ValueError, one sentence, for a file that is missing
    or unreadable, a surface that is not closed, or a base without area.
    """
    path = Path(file).expanduser()
    if not path.is_file():
        raise ValueError(f'the mesh file "{file}" does not exist; give the path of an STL, OBJ or PLY file')
    return _mesh(path.resolve(), path.stat().st_mtime_ns, file, scale)


@lru_cache(maxsize=32)
def _mesh(path: Path, modified: int, file: str, scale: float) -> Solid:
    """`mesh`, cached until the file changes, because a scenario uses its shapes several times."""
    try:
        surface = read_mesh_file(path)
    except ValueError as error:
        raise ValueError(f'the mesh file "{file}" {error}; give an STL, OBJ or PLY file of a closed surface') from None
    if not surface.is_watertight or surface.volume <= 0:
        raise ValueError(
            f'the mesh in "{file}" is not a closed surface with outward normals, so it has no volume and no inertia; '
            "close its holes"
        )
    bounds = scale * np.asarray(surface.bounds)
    vertices = scale * np.asarray(surface.vertices) - bounds.mean(axis=0)
    height = float(np.ptp(bounds[:, 2]))
    if height > 5:
        raise ValueError(f'the mesh in "{file}" is {height:g} m high; set scale (0.001 for a file in millimetres)')
    near = 1e-3 * height
    base = convex_hull(vertices[vertices[:, 2] <= -0.5 * height + near, :2])
    if len(base) < 3:
        raise ValueError(f'the mesh in "{file}" stands on a point or an edge; turn it so that a flat side is below')
    top = convex_hull(vertices[vertices[:, 2] >= 0.5 * height - near, :2])
    unit_inertia = scale**2 * np.asarray(surface.moment_inertia) / surface.volume
    return Solid(
        height,
        simplified(base),
        scale * np.asarray(surface.center_mass) - bounds.mean(axis=0),
        unit_inertia,
        vertices[polytope(vertices).corners],
        simplified(top),
        convex_hull(vertices[:, :2]),
        (vertices, np.asarray(surface.faces)),
    )


def _edge_second_moment(p: Array, q: Array) -> Array:
    """Integrals (n, 2, 2) of x x^T over the triangles (0, p, q), divided by their cross products p x q."""
    pp, qq, pq = (np.einsum("ni,nj->nij", a, b) for a, b in ((p, p), (q, q), (p, q)))
    return (2 * pp + 2 * qq + pq + np.swapaxes(pq, 1, 2)) / 24


def _extrude(polygon: Array, height: float, top: Array | None = None) -> Array:
    z = np.full((len(polygon), 1), 0.5 * height)
    return np.vstack([np.hstack([polygon if top is None else top, z]), np.hstack([polygon, -z])])
