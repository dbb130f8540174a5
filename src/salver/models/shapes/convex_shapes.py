"""Convex shapes (Coal's) of points, and of a mesh: a few hulls of slabs across its longest direction.

The hull of a link that is not convex, such as the upper arm of a UR with a housing at both ends, fills free space, and
collides where the link does not. Hulls of slabs contain the whole mesh too, with less free space: the part of a mesh
between two planes lies in the hull of its corners there and of the intersections of its edges with the planes.
"""

from __future__ import annotations

from typing import Any

import coal
import numpy as np

from salver.geometry import Array, Indices
from salver.models.shapes.hulls import triangles

Triangles = Indices


def convex(points: Array, thinnest: float = 1e-3) -> Any:
    """Coal's convex hull of points (n, 3), m, made at least `thinnest` thick, m: Coal needs shapes with a volume."""
    axes = np.linalg.eigh(np.cov(points.T))[1]
    for axis in axes.T:
        if np.ptp(points @ axis) < thinnest:
            points = np.vstack([points - 0.5 * thinnest * axis, points + 0.5 * thinnest * axis])
    mesh = coal.BVHModelOBBRSS()
    mesh.beginModel(0, len(points))
    mesh.addVertices(points)
    mesh.endModel()
    try:
        mesh.buildConvexHull(True, "Qt")
    except RuntimeError:  # a corner with more than 255 neighbours: flat faces are cut into fans, as that of a fine drum
        return _joggled(points)
    return mesh.convex


def _joggled(points: Array) -> Any:
    """The hull from a triangulation without fans, as if the points of a flat face were off by rounding."""
    used, corners = np.unique(triangles(points, joggled=True), return_inverse=True)
    vertices, faces = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
    vertices.extend(list(points[used]))
    faces.extend([coal.Triangle(*corner) for corner in corners.reshape(-1, 3).tolist()])
    return coal.Convex(vertices, faces)


def convex_pieces(points: Array, corners: Triangles, most: int = 3, slabs: int = 8, worth: float = 0.85) -> list[Any]:
    """Convex shapes that contain a mesh of points (n, 3), m, and triangles (k, 3); its hull if pieces save little.

    most: number of pieces. slabs: number of equal slabs that are joined to them. worth: largest share of the hull's
    volume that the pieces may have together.
    """
    whole = convex(points)
    axis = np.linalg.eigh(np.cov(points.T))[1][:, -1]
    ends = points @ axis
    cut = _slabs(points, corners, axis, np.linspace(ends.min(), ends.max(), slabs + 1)[1:-1])
    if any(len(slab) < 4 for slab in cut):  # several separate bodies
        return [whole]
    cut = [np.asarray(convex(slab).points()) for slab in cut]
    united = {(i, j): convex(np.vstack(cut[i:j])) for i in range(slabs) for j in range(i + 1, slabs + 1)}
    size = {span: float(shape.computeVolume()) for span, shape in united.items()}
    # The least volume of the first j slabs in a number of pieces, and the first slab of each piece.
    best = {j: (size[0, j], [0]) for j in range(1, slabs + 1)}
    for _ in range(most - 1):
        best = {j: min([best[j]] + [(best[i][0] + size[i, j], [*best[i][1], i]) for i in range(1, j)]) for j in best}
    least, begins = best[slabs]
    if least > worth * float(whole.computeVolume()):
        return [whole]
    return [united[span] for span in zip(begins, [*begins[1:], slabs], strict=True)]


def _slabs(points: Array, corners: Triangles, axis: Array, cuts: Array) -> list[Array]:
    """For each pair of adjacent planes axis . x = cut, points whose hull contains the surface between them."""
    along = points @ axis
    edges = np.unique(np.sort(np.vstack([corners[:, k] for k in ([0, 1], [1, 2], [2, 0])]), axis=1), axis=0)
    crossed = []
    for cut in cuts:
        first, second = along[edges].T
        through = (first - cut) * (second - cut) < 0
        share = ((cut - first[through]) / (second - first)[through])[:, None]
        ends = points[edges[through]]
        crossed.append(ends[:, 0] * (1 - share) + ends[:, 1] * share)
    none = np.zeros((0, 3))
    planes, at = [-np.inf, *cuts, np.inf], [none, *crossed, none]
    between = [(planes[k] <= along) & (along <= planes[k + 1]) for k in range(len(cuts) + 1)]
    return [np.vstack([points[of], at[k], at[k + 1]]) for k, of in enumerate(between)]
