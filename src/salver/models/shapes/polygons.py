"""Convex polygons: half-planes, insets, intersections. Vertices (n, 2) counter-clockwise."""

from __future__ import annotations

import numpy as np

from salver.geometry import Array


def half_planes(polygon: Array) -> tuple[Array, Array]:
    """Unit outward normals (n, 2) and offsets (n,) of a polygon, with normal . x <= offset inside."""
    edge = np.roll(polygon, -1, axis=0) - polygon
    normal = np.stack([edge[:, 1], -edge[:, 0]], axis=1) / np.linalg.norm(edge, axis=1)[:, None]
    return normal, np.einsum("ij,ij->i", normal, polygon)


def convex_hull(points: Array) -> Array:
    """Vertices (n, 2) of the convex hull of points (m, 2), least x first; empty if the points lie on a line.

    Vertices nearer to one another than rounding, whose edge would have any direction, are one.
    """
    from scipy.spatial import ConvexHull, QhullError

    try:
        corners = points[ConvexHull(points).vertices]
    except (QhullError, ValueError):
        return np.empty((0, 2))
    edge = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1)
    corners = corners[edge > 1e-8 * edge.max()]
    if len(corners) < 3:
        return np.empty((0, 2))
    return np.roll(corners, -np.lexsort(corners.T[::-1])[0], axis=0)


def from_half_planes(normal: Array, offset: Array) -> Array:
    """Vertices (n, 2) of a bounded region normal . x <= offset; empty if it has no area."""
    i, j = np.triu_indices(len(normal), 1)
    cross = normal[i, 0] * normal[j, 1] - normal[i, 1] * normal[j, 0]
    meet = np.abs(cross) > 1e-9
    i, j, cross = i[meet], j[meet], cross[meet]
    x = (offset[i] * normal[j, 1] - offset[j] * normal[i, 1]) / cross
    y = (normal[i, 0] * offset[j] - normal[j, 0] * offset[i]) / cross
    points = np.stack([x, y], axis=1)
    size = max(float(np.abs(offset).max()), 1e-6)
    return convex_hull(points[np.all(points @ normal.T <= offset + 1e-9 * size, axis=1)])


def intersection(first: Array, second: Array) -> Array:
    """Vertices of the intersection of two polygons, counter-clockwise; empty if it has no area."""
    if len(first) < 3 or len(second) < 3:
        return np.empty((0, 2))
    pairs = half_planes(first), half_planes(second)
    return from_half_planes(np.vstack([n for n, _ in pairs]), np.concatenate([o for _, o in pairs]))


def inset(polygon: Array, distance: float) -> Array:
    """The polygon with every edge moved inwards by a distance; empty if nothing remains."""
    if distance == 0:
        return polygon
    normal, offset = half_planes(polygon)
    return from_half_planes(normal, offset - distance)


def simplified(polygon: Array, most: int = 16) -> Array:
    """A polygon inside the given one, with at most `most` of its vertices: the number of facets of a cone on it grows
    with their square."""
    while len(polygon) > most:
        before, after = np.roll(polygon, 1, axis=0) - polygon, np.roll(polygon, -1, axis=0) - polygon
        ear = np.abs(before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0])
        polygon = np.delete(polygon, int(np.argmin(ear)), axis=0)
    return polygon


def eroded(polygon: Array, half_range: Array) -> Array:
    """The intersection of all shifts of the polygon by |dx|, |dy| <= half_range (2,)."""
    if not np.any(half_range) or len(polygon) < 3:
        return polygon
    normal, offset = half_planes(polygon)
    return from_half_planes(normal, offset - np.abs(normal) @ half_range)
