"""Shapes of carried objects: size, where they touch what they stand on, inertia when they are uniform.

A shape has its own frame G: origin at the centre of its bounding height, z up, base at z = -height/2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from salver.geometry import Array


@dataclass(frozen=True)
class Solid:
    """What the rest of salver needs to know of a shape.

    height: m along z. base_polygon: (n, 2) vertices, counter-clockwise, of the convex support polygon
    in G, m. centroid_G: (3,) centre of volume. unit_inertia: (3, 3) about it, kg m^2 per kg.
    bounding_points_G: (k, 3) points whose convex hull contains the solid (for "is the centre of mass inside").
    """

    height: float
    base_polygon: Array
    centroid_G: Array
    unit_inertia: Array
    bounding_points_G: Array

    @property
    def base_z(self) -> float:
        return -0.5 * self.height


def box(size: tuple[float, float, float]) -> Solid:
    """Cuboid with edges `size` along x, y, z."""
    x, y, z = size
    polygon = 0.5 * np.array([[x, y], [-x, y], [-x, -y], [x, -y]])
    inertia = np.diag([y * y + z * z, x * x + z * z, x * x + y * y]) / 12
    return Solid(z, polygon, np.zeros(3), inertia, _extrude(polygon, z))


def cylinder(radius: float, height: float, support_points: int = 8) -> Solid:
    """Upright cylinder; its round base is inscribed by a regular polygon of `support_points` vertices."""
    angle = 2 * np.pi * np.arange(support_points) / support_points
    polygon = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    across = (3 * radius**2 + height**2) / 12
    inertia = np.diag([across, across, 0.5 * radius**2])
    outer = polygon / np.cos(np.pi / support_points)  # circumscribed: contains the disc
    return Solid(height, polygon, np.zeros(3), inertia, _extrude(outer, height))


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
    return Solid(height, p, np.array([*centre, 0.0]), inertia, _extrude(p, height))


def _edge_second_moment(p: Array, q: Array) -> Array:
    """(n, 2, 2): integral of x x^T over the triangle (0, p, q), divided by its cross product p x q."""
    pp, qq, pq = (np.einsum("ni,nj->nij", a, b) for a, b in ((p, p), (q, q), (p, q)))
    return (2 * pp + 2 * qq + pq + np.swapaxes(pq, 1, 2)) / 24


def _extrude(polygon: Array, height: float) -> Array:
    z = np.full((len(polygon), 1), 0.5 * height)
    return np.vstack([np.hstack([polygon, z]), np.hstack([polygon, -z])])
