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
        corners = self.liquid.inside.outline(height)
        return np.column_stack([corners, np.zeros(len(corners))]) + self.body.inner_origin_B(height)

    def centre_B(self, k: int) -> Array:
        """Where the surface meets the axis at sample k, (3,), m in B: between walls that lean out, a tilted plane holds
        the same volume if it is lower there."""
        radius = float(self.liquid.inside.half(self.fill)[0])
        steep = float(self.slope[k] @ self.slope[k]) * radius * self.widening
        return self.level_B - [0.0, 0.0, steep * radius / (1 + np.sqrt(1 - steep * radius * self.widening))]

    def ring_B(self, k: int) -> Array:
        """Corners (n, 3) of the surface at sample k, m in B: where the plane meets the wall."""
        corners, low = self.liquid.inside.outline(self.fill), self.centre_B(k) - self.level_B
        plane = corners @ self.slope[k]
        rise = (plane + low[2]) / (1 - plane * self.widening)
        return np.column_stack([corners * (1 + rise[:, None] * self.widening), rise]) + self.level_B

    @property
    def widening(self) -> float:
        """Increase of the wall's radius per height, as a share of its radius at the level, 1/m."""
        inside = self.liquid.inside
        return inside.slope / float(inside.half(self.fill)[0])

    def triangles_B(self, k: int) -> Array:
        """(n_triangles, 3, 3) of the liquid at sample k, counter-clockwise from outside: its side, then its surface."""
        low, high = self.bottom_B, self.ring_B(k)
        low_next, high_next = (np.roll(ring, -1, axis=0) for ring in (low, high))
        middle = np.broadcast_to(self.centre_B(k), high.shape)
        parts = ((low, low_next, high_next), (low, high_next, high), (middle, high, high_next))
        return np.concatenate([np.stack(part, axis=1) for part in parts])

    @property
    def colour(self) -> Colour:
        return COLOURS[self.liquid.name]

    def page(self, keep: Array) -> dict[str, Any]:
        """Corners of the bottom, centre and slope of the surface over time; the wall's width at the level, as a
        multiple of that at the bottom, and its increase (`widening`)."""
        inside = self.liquid.inside
        return {
            "bottom": np.round(self.bottom_B, 6).tolist(),
            "wall": [float(inside.half(self.fill)[0] / inside.half(0.0)[0]), self.widening],
            "level": self.level_B.tolist(),
            "moves": self.slope[keep],
        }
