"""Drawings in space by matplotlib."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from salver.geometry import Array
from salver.models.shapes.obstacle_shapes import obstacle_shapes
from salver.models.shapes.surfaces import Surface, surface
from salver.scenario import Obstacle

OBSTACLE_COLOUR = "#a5816b"


def draw_obstacles(axes: Any, obstacles: Iterable[Obstacle]) -> None:
    """Draw obstacles in 3-D axes, transparent and clipped to the limits of the axes."""
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection  # type: ignore[import-untyped]

    low, high = np.array([getattr(axes, f"get_{name}lim")() for name in "xyz"]).T
    for vertices, faces in within(obstacles, low, high):
        drawn = Poly3DCollection(vertices[faces], facecolor=OBSTACLE_COLOUR, edgecolor="none", alpha=0.25)
        axes.add_collection3d(drawn)


def within(obstacles: Iterable[Obstacle], low: Array, high: Array) -> list[Surface]:
    """Surfaces of obstacles, clamped to the box from low (3,) to high (3,); obstacles outside of it are left out."""
    pieces = [surface(shape, placement) for obstacle in obstacles for shape, placement in obstacle_shapes(obstacle)]
    return [
        (np.clip(vertices, low, high), faces)
        for vertices, faces in pieces
        if np.all(vertices.max(axis=0) > low) and np.all(vertices.min(axis=0) < high)
    ]
