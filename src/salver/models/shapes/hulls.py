"""Facets and corners of convex hulls of points and of cones over rays, by Qhull.

Qhull triangulates facets and gives their planes to some digits. Here each plane occurs once, and planes of cones are
fitted to their rays.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from salver.geometry import Array, Indices, Mask

_WIDTH = 1e-12  # least squared width of the rays in a facet


@dataclass(frozen=True, eq=False)
class Polytope:
    """A convex hull: facets normal (m, d), unit, offset (m,) with normal . x <= offset inside; corners (k,): indices of
    the points that are corners."""

    normal: Array
    offset: Array
    corners: Indices

    def holds(self, x: Array, tolerance: float = 0.0) -> bool:
        """Whether x (d,) lies inside, up to a tolerance in the unit of the points."""
        return bool(np.all(self.normal @ x <= self.offset + tolerance))


def polytope(points: Array) -> Polytope:
    """The convex hull of points (n, d). Raises ValueError when they do not span the space."""
    centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
    size = 0.5 * float(np.ptp(points, axis=0).max())
    if not size > 0:
        raise ValueError("all points are equal, so that their hull has no facets")
    scaled = (points - centre) / size
    rows, corners = _qhull(scaled)
    length = np.linalg.norm(rows[:, :-1], axis=1)
    normal = rows[:, :-1] / length[:, None]
    return Polytope(normal, normal @ centre - size * rows[:, -1] / length, corners)


def triangles(points: Array, joggled: bool = False) -> Indices:
    """Triangles (k, 3) of the hull of points (n, 3), as indices, counter-clockwise seen from outside.

    joggled: do not triangulate flat faces as fans, in which one corner is a neighbour of all others.
    """
    from scipy.spatial import ConvexHull

    hull = ConvexHull(points, qhull_options="QJ" if joggled else None)
    a, b, c = (points[hull.simplices[:, k]] for k in range(3))
    outward = np.einsum("ij,ij->i", np.cross(b - a, c - a), hull.equations[:, :3]) > 0
    return np.where(outward[:, None], hull.simplices, hull.simplices[:, ::-1])


def cone_facets(rays: Array) -> Array:
    """Rows (m, d), unit length, of the half spaces row . x <= 0 whose intersection is the cone over rays (n, d).

    If the rays do not span the space, pairs of opposite rows exclude the missing directions. Each facet is fitted to
    the rays that lie in it, so that it is accurate to rounding. Raises ValueError if the cone contains a line.
    """
    rays = rays / np.linalg.norm(rays, axis=1)[:, None]
    _, singular, basis = np.linalg.svd(rays, full_matrices=True)
    rank = int(np.sum(singular > 1e-9 * singular[0]))
    missing, basis = basis[rank:], basis[:rank]
    rows = _qhull_cone(rays @ basis.T) @ basis
    return np.vstack([rows, missing, -missing])


def _through(rays: Array, rows: Array, active: Mask) -> tuple[Array, Array]:
    """Unit rows (m, d) fitted to the rays (n, d) that lie in each (m, n), and the squared widths of those rays."""
    outer = (rays[:, :, None] * rays[:, None, :]).reshape(len(rays), -1)
    scatter = (active.astype(float) @ outer).reshape(len(rows), rays.shape[1], rays.shape[1])
    values, vectors = np.linalg.eigh(scatter)
    fitted = vectors[:, :, 0]
    # The scatter matrix contains squares, which cost digits; a correction by the rays' residuals recovers them.
    left = (np.where(active, fitted @ rays.T, 0.0) @ rays)[:, None] @ vectors[:, :, 1:]
    fitted = fitted - (vectors[:, :, 1:] @ (left[:, 0] / np.maximum(values[:, 1:], _WIDTH))[:, :, None])[:, :, 0]
    fitted /= np.linalg.norm(fitted, axis=1)[:, None]
    return fitted * np.where(np.sum(fitted * rows, axis=1) > 0, 1.0, -1.0)[:, None], values


def _qhull(points: Array) -> tuple[Array, Indices]:
    """Rows (m, d + 1) with row . (x, 1) <= 0 in the hull of points (n, d), and the corners, by Qhull."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = ConvexHull(points)
    except QhullError as error:
        raise ValueError(f"the points have no hull: {str(error).splitlines()[0]}") from None
    return _each_once(hull.equations), hull.vertices


def _each_once(equations: Array) -> Array:
    """Unique planes; Qhull triangulates facets, so that a plane occurs once for each simplex."""
    return np.asarray(equations[np.unique(np.round(equations, 9), axis=0, return_index=True)[1]])


def _qhull_cone(rays: Array) -> Array:
    """Unit rows (m, d) of the facets of the cone over unit rays (n, d) that span the space.

    They come from the hull of the rays' intersections with a plane. Raises ValueError if the cone contains a line.
    """
    from scipy.spatial import ConvexHull, QhullError

    axis = _interior_direction(rays)
    across = np.linalg.svd(axis[None, :])[2][1:]
    points = rays @ across.T / (rays @ axis)[:, None]
    if points.shape[1] < 2:  # one ray, or all between two
        ends = [] if points.shape[1] == 0 else [[1.0, -points.max()], [-1.0, points.min()]]
        equations = np.array(ends or [[-1.0]])
    else:
        try:
            equations = ConvexHull(points).equations
        except QhullError:
            # Many coplanar generators can make Qhull's merging fail. With points jittered by about 1e-10, a facet is
            # split into pieces; each is fitted to the exact generators, and spurious ones are dropped.
            equations = ConvexHull(points, qhull_options="QJ").equations
    rows = _each_once(equations) @ np.vstack([across, axis])
    return _refit(rays, rows / np.linalg.norm(rows, axis=1)[:, None])


def _interior_direction(rays: Array, pointed: float = 1e-9) -> Array:
    """A unit vector with a positive product, at least `pointed`, with every unit ray (n, d)."""
    mean = rays.mean(axis=0)
    if np.linalg.norm(mean) > 0 and (rays @ mean).min() > 1e-2 * np.linalg.norm(mean):
        return mean / np.linalg.norm(mean)
    from scipy.optimize import linprog  # its import takes a tenth of a second and is seldom needed

    d = rays.shape[1]
    result = linprog(
        np.append(np.zeros(d), -1.0),
        A_ub=np.column_stack([-rays, np.ones(len(rays))]),
        b_ub=np.zeros(len(rays)),
        bounds=[(-1, 1)] * d + [(None, None)],
        method="highs",
    )
    if result.x is None or result.x[-1] < pointed:
        raise ValueError("the cone contains a line and has no facets")
    return result.x[:-1] / np.linalg.norm(result.x[:-1])


def _refit(rays: Array, rows: Array, near: float = 1e-7, within: float = 1e-8) -> Array:
    """Unique facets (m, d), unit rows fitted to the rays (n, d) that lie in them, in the order of those rays.

    Planes with a ray outside, or with too few rays for a facet, are dropped. near: distance up to which unit rays are
    used for the first fit of a plane; within: up to which they lie in it.
    """
    fitted, _ = _through(rays, rows, np.abs(rows @ rays.T) < near)
    # Neighbouring facets of a round cone can be so close that their rays are mixed; then the fit is not used.
    better = (fitted @ rays.T).max(axis=1) <= (rows @ rays.T).max(axis=1) + 1e-12
    rows = np.where(better[:, None], fitted, rows)
    active = np.abs(rows @ rays.T) < within
    _, values = _through(rays, rows, active)
    spanned = values[:, 1] > _WIDTH if rays.shape[1] > 1 else np.ones(len(rows), dtype=bool)
    kept = np.flatnonzero(spanned & ((rows @ rays.T).max(axis=1) <= within))
    kept = kept[np.unique(np.packbits(active[kept], axis=1), axis=0, return_index=True)[1]]
    return np.asarray(rows[kept])
