"""The surface of a liquid as pictures show it: a plane inside its container, and the brim that it must not reach."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from salver.dynamics.liquid.liquid import Container
from salver.geometry import Array
from salver.models.bodies import Body
from salver.models.load_dynamics import Colour, Drawn

COLOURS: Mapping[str, Colour] = {"coffee": (0.36, 0.23, 0.12), "oil": (0.78, 0.64, 0.08), "water": (0.29, 0.56, 0.77)}


def wall(body: Body, corners: int = 32) -> Array:
    """Corners (n, 2) of the container's inner wall, `corners` if it is round, counter-clockwise, relative to its axis,
    m."""
    liquid = cast(Container, body.inner)
    if liquid.round:
        angle = np.linspace(0, 2 * np.pi, corners, endpoint=False)
        return np.asarray(liquid.size[0] * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    return np.asarray(liquid.half * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]))


@dataclass(frozen=True, eq=False)
class DrawnSurface(Drawn):
    """The plane in which the first two modes stand at the wall, in the frame B of the container, over time.

    body: the container. fill: the true one, m. slope (T, 2): of the surface along the container's x and y, limited such
    that the bottom stays covered. beyond: when its highest point, crests included, first exceeded the brim, s.
    """

    body: Body
    fill: float
    slope: Array
    beyond: float | None

    @classmethod
    def of_heights(cls, body: Body, fill: float, heights: Array, beyond: float | None) -> DrawnSurface:
        """The surface from heights (T, 2) at the wall along x and y over the level at rest, m
        (`SimulationRecord.surface`)."""
        modes = cast(Container, body.inner).modes(fill)
        eta = np.nan_to_num(heights)
        held = np.minimum(1.0, fill / np.maximum(modes.highest(eta), 1e-12))
        return cls(body, fill, held[:, None] * eta / modes.half, beyond)

    @property
    def liquid(self) -> Container:
        return cast(Container, self.body.inner)

    @property
    def level_B(self) -> Array:
        """Centre (3,) of the surface in B, m; waves do not move it."""
        return self.body.inner_origin_B(self.fill)

    @property
    def bottom_B(self) -> Array:
        """Corners (n, 3) of the inner bottom, m in B."""
        return self._ring(0.0)

    @property
    def edge_B(self) -> Array:
        """Corners (n, 3) of the brim, m in B."""
        return self._ring(self.liquid.brim)

    def _ring(self, height: float) -> Array:
        corners = wall(self.body)
        return np.column_stack([corners, np.zeros(len(corners))]) + self.body.inner_origin_B(height)

    def ring_B(self, k: int) -> Array:
        """Corners (n, 3) of the surface at sample k, m in B."""
        corners = wall(self.body)
        return np.column_stack([corners, corners @ self.slope[k]]) + self.level_B

    def triangles_B(self, k: int) -> Array:
        """(n_triangles, 3, 3) of the liquid at sample k, counter-clockwise from outside: its side, then its surface."""
        low, high = self.bottom_B, self.ring_B(k)
        low_next, high_next = (np.roll(ring, -1, axis=0) for ring in (low, high))
        middle = np.broadcast_to(self.level_B, high.shape)
        parts = ((low, low_next, high_next), (low, high_next, high), (middle, high, high_next))
        return np.concatenate([np.stack(part, axis=1) for part in parts])

    @property
    def colour(self) -> Colour:
        return COLOURS[self.liquid.name]

    def page(self, keep: Array) -> dict[str, Any]:
        """Corners of the bottom, centre and slope of the surface over time."""
        return {
            "bottom": np.round(self.bottom_B, 6).tolist(),
            "level": self.level_B.tolist(),
            "moves": self.slope[keep],
        }
