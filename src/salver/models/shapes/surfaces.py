"""Triangles of Coal's convex shapes, so that pictures show the shapes of the collision checks."""

from __future__ import annotations

from typing import Any

import numpy as np

from salver.geometry import Array, Indices

Surface = tuple[Array, Indices]


def surface(shape: Any, placement: Any, sides: int = 24) -> Surface:
    """Vertices (n, 3), m, and triangles (k, 3), counter-clockwise from outside, of a shape placed by a pin.SE3.

    sides: number of sides of round shapes.
    """
    vertices, faces = _own(shape, sides)
    return vertices @ placement.rotation.T + placement.translation, faces


def _own(shape: Any, sides: int) -> Surface:
    from trimesh import creation
    from trimesh.convex import convex_hull

    kind = type(shape).__name__
    if kind == "Box":
        mesh = creation.box(2 * np.asarray(shape.halfSide))
    elif kind == "Sphere":
        mesh = creation.icosphere(subdivisions=2, radius=shape.radius)
    elif kind == "Capsule":
        mesh = creation.capsule(height=2 * shape.halfLength, radius=shape.radius, count=(sides // 2, sides))
        mesh.apply_translation(-mesh.bounds.mean(axis=0))
    elif kind == "Cylinder":
        mesh = creation.cylinder(radius=shape.radius, height=2 * shape.halfLength, sections=sides)
    else:
        mesh = convex_hull(np.asarray(shape.points()))
    return np.asarray(mesh.vertices, dtype=float), np.asarray(mesh.faces)
