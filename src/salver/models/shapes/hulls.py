"""Convex hulls of points and cones over rays: facets and corners by Qhull, the one place that asks for them.

Qhull triangulates facets and knows their planes to some digits. Here each plane comes once, put through the points or
rays that lie in it. The hull of polygons: `salver.models.shapes.polygons.convex_hull`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from salver.geometry import Array, Indices, Mask

_IN_PLANE = 1e-8  # a ray this close to a facet's plane (both of unit size) lies in it
_NEAR_PLANE = 1e-7  # and through all that are so near the plane is first put
_WIDTH = 1e-12  # square of the width of rays that lie in less than a plane
_POINTED = 1e-9  # cosine that the direction inside the polar cone has to every ray of a cone without a line


@dataclass(frozen=True, eq=False)
class Polytope:
    """normal (m, d), unit, offset (m,): normal . x <= offset inside; each facet once. corners (k,): which points."""

    normal: Array
    offset: Array
    corners: Indices

    def holds(self, x: Array, tolerance: float = 0.0) -> bool:
        """Whether x (d,) lies inside, or beyond no facet by more than a tolerance in the unit of the points."""
        return bool(np.all(self.normal @ x <= self.offset + tolerance))


def polytope(points: Array) -> Polytope:
    """The convex hull of points (n, d) that span the space. Raises ValueError where they do not."""
    centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
    size = 0.5 * float(np.ptp(points, axis=0).max())
    if not size > 0:
        raise ValueError("all points are one: it has no facets")
    scaled = (points - centre) / size
    rows, corners = _qhull(scaled)
    length = np.linalg.norm(rows[:, :-1], axis=1)
    normal = rows[:, :-1] / length[:, None]
    return Polytope(normal, normal @ centre - size * rows[:, -1] / length, corners)


def triangles(points: Array, joggled: bool = False) -> Indices:
    """(k, 3) which points (n, 3) make the triangles of their hull, each counter-clockwise seen from outside.

    joggled: a flat face is not cut into a fan, which gives one of its corners all the others for neighbours.
    """
    from scipy.spatial import ConvexHull

    hull = ConvexHull(points, qhull_options="QJ" if joggled else None)
    a, b, c = (points[hull.simplices[:, k]] for k in range(3))
    outward = np.einsum("ij,ij->i", np.cross(b - a, c - a), hull.equations[:, :3]) > 0
    return np.where(outward[:, None], hull.simplices, hull.simplices[:, ::-1])


def cone_facets(rays: Array) -> Array:
    """Rows (m, d), unit length, of the half spaces row . x <= 0 whose intersection is the cone over rays (n, d).

    If the rays do not span the space, the missing directions enter as pairs of opposite rows. Each facet is put through
    the rays that lie in it, so it is good to rounding. Raises ValueError if the cone contains a line.
    """
    rays = rays / np.linalg.norm(rays, axis=1)[:, None]
    _, singular, basis = np.linalg.svd(rays, full_matrices=True)
    rank = int(np.sum(singular > 1e-9 * singular[0]))
    missing, basis = basis[rank:], basis[:rank]
    rows = _qhull_cone(rays @ basis.T) @ basis
    return np.vstack([rows, missing, -missing])


def _through(rays: Array, rows: Array, active: Mask) -> tuple[Array, Array]:
    """Unit rows (m, d) put through the rays (n, d) that lie in each (m, n); and the squares of those rays' widths."""
    outer = (rays[:, :, None] * rays[:, None, :]).reshape(len(rays), -1)
    scatter = (active.astype(float) @ outer).reshape(len(rows), rays.shape[1], rays.shape[1])
    values, vectors = np.linalg.eigh(scatter)
    fitted = vectors[:, :, 0]
    # The scatter has squares of widths; what is left of the rays' products brings the digits back that they cost.
    left = (np.where(active, fitted @ rays.T, 0.0) @ rays)[:, None] @ vectors[:, :, 1:]
    fitted = fitted - (vectors[:, :, 1:] @ (left[:, 0] / np.maximum(values[:, 1:], _WIDTH))[:, :, None])[:, :, 0]
    fitted /= np.linalg.norm(fitted, axis=1)[:, None]
    return fitted * np.where(np.sum(fitted * rows, axis=1) > 0, 1.0, -1.0)[:, None], values


def _qhull(points: Array) -> tuple[Array, Indices]:
    """Rows (m, d + 1) with row . (x, 1) <= 0 in the hull of points (n, d), and its corners, by Qhull."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = ConvexHull(points)
    except QhullError as error:
        raise ValueError(f"the points have no hull: {str(error).splitlines()[0]}") from None
    return _each_once(hull.equations), hull.vertices


def _each_once(equations: Array) -> Array:
    """Qhull triangulates facets: the same plane comes once for each simplex."""
    return np.asarray(equations[np.unique(np.round(equations, 9), axis=0, return_index=True)[1]])


def _qhull_cone(rays: Array) -> Array:
    """Unit rows (m, d) of the facets of the cone over unit rays (n, d) that span the space, by the hull of the points
    in which a plane cuts them. Raises ValueError if the cone contains a line."""
    from scipy.spatial import ConvexHull, QhullError

    axis = _interior_direction(rays)
    across = np.linalg.svd(axis[None, :])[2][1:]
    points = rays @ across.T / (rays @ axis)[:, None]
    if points.shape[1] < 2:  # a ray, or all between two
        ends = [] if points.shape[1] == 0 else [[1.0, -points.max()], [-1.0, points.min()]]
        equations = np.array(ends or [[-1.0]])
    else:
        try:
            equations = ConvexHull(points).equations
        except QhullError:
            # Many generators in one plane can defeat Qhull's merging. With the points jittered (by about 1e-10) a
            # facet comes in splinters; each is fitted again to the exact generators, false ones are then dropped.
            equations = ConvexHull(points, qhull_options="QJ").equations
    rows = _each_once(equations) @ np.vstack([across, axis])
    return _refit(rays, rows / np.linalg.norm(rows, axis=1)[:, None])


def _interior_direction(rays: Array) -> Array:
    """Unit vector with a positive product with every ray (n, d)."""
    mean = rays.mean(axis=0)
    if np.linalg.norm(mean) > 0 and (rays @ mean).min() > 1e-2 * np.linalg.norm(mean):
        return mean / np.linalg.norm(mean)
    from scipy.optimize import linprog  # a tenth of a second, and seldom needed

    d = rays.shape[1]
    result = linprog(
        np.append(np.zeros(d), -1.0),
        A_ub=np.column_stack([-rays, np.ones(len(rays))]),
        b_ub=np.zeros(len(rays)),
        bounds=[(-1, 1)] * d + [(None, None)],
        method="highs",
    )
    if result.x is None or result.x[-1] < _POINTED:
        raise ValueError("the cone contains a line and has no facets")
    return result.x[:-1] / np.linalg.norm(result.x[:-1])


def _refit(rays: Array, rows: Array) -> Array:
    """Facets (m, d), unit rows, each once, in the order of the rays (n, d) that they are put through.

    Planes that a ray is beyond, or that too few rays lie in to be a facet, are dropped.
    """
    fitted, _ = _through(rays, rows, np.abs(rows @ rays.T) < _NEAR_PLANE)
    # Neighbouring facets of a round cone can be so close that their rays were mixed: then it is not an improvement.
    better = (fitted @ rays.T).max(axis=1) <= (rows @ rays.T).max(axis=1) + 1e-12
    rows = np.where(better[:, None], fitted, rows)
    active = np.abs(rows @ rays.T) < _IN_PLANE
    _, values = _through(rays, rows, active)
    spanned = values[:, 1] > _WIDTH if rays.shape[1] > 1 else np.ones(len(rows), dtype=bool)
    kept = np.flatnonzero(spanned & ((rows @ rays.T).max(axis=1) <= _IN_PLANE))
    kept = kept[np.unique(np.packbits(active[kept], axis=1), axis=0, return_index=True)[1]]
    return np.asarray(rows[kept])
