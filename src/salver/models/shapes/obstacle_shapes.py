"""Convex shapes of the obstacles in the world."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import coal
import numpy as np
import pinocchio as pin

from salver.errors import ScenarioError
from salver.geometry import Array, matrix_from_rpy
from salver.models.described import Obstacle, Wall
from salver.models.shapes.convex_shapes import convex
from salver.models.shapes.mesh_files import read_mesh_file


def obstacle_shapes(obstacle: Obstacle | Wall) -> list[tuple[Any, Any]]:
    """Coal's shapes of an obstacle with their placements in S (pin.SE3); several for a mesh of several pieces.

    Raises ScenarioError when its mesh cannot be used.
    """
    if isinstance(obstacle, Wall):
        return [(coal.Halfspace(np.array(obstacle.inwards), 0.0), pin.SE3(np.eye(3), np.array(obstacle.point)))]
    placement = pin.SE3(matrix_from_rpy(np.deg2rad(obstacle.rpy_deg)), np.array(obstacle.position))
    if obstacle.type == "mesh":
        return [(convex(points), placement) for points in mesh_pieces(obstacle)]
    if obstacle.type == "box":
        return [(coal.Box(*(obstacle.size or ())), placement)]
    if obstacle.type == "sphere":
        return [(coal.Sphere(obstacle.radius or 0.0), placement)]
    kind = coal.Capsule if obstacle.type == "capsule" else coal.Cylinder
    return [(kind(obstacle.radius or 0.0, obstacle.length or obstacle.height or 0.0), placement)]


def mesh_pieces(obstacle: Obstacle) -> list[Array]:
    """Corners (n, 3) of the convex hull of each separate piece of an obstacle's mesh, in the obstacle's frame, m."""
    try:
        return [obstacle.scale * points for points in _pieces(obstacle.file or "")]
    except ValueError as error:
        raise ScenarioError(f"The obstacle {obstacle.name}: its file {obstacle.file} {error}.") from None


@lru_cache(maxsize=64)
def _pieces(file: str, most: int = 64) -> tuple[Array, ...]:
    """Corners of each separate piece of a mesh file. Raises ValueError for more than `most` pieces."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    mesh = read_mesh_file(file)
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    points = np.asarray(mesh.vertices, dtype=float)
    if len(points) < 4:
        raise ValueError(f"has {len(points)} corners; at least 4 are needed")
    edges = np.asarray(mesh.edges)
    graph = coo_matrix((np.ones(len(edges)), edges.T), shape=(len(points), len(points)))
    labels = connected_components(graph, directed=False)[1]
    pieces = [points[labels == label] for label in np.unique(labels[edges])]
    if len(pieces) > most:
        raise ValueError(f"has {len(pieces)} separate pieces; at most {most} are accepted: split it into several files")
    return tuple(pieces)
