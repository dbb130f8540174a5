"""A mass that hangs in a body on a light rod and can swing in all directions: a clapper, a lamp on a cord.

Its mode is exact to first order (`salver.models.load_dynamics`). Its displacement is limited by the room in the body.
The mode overestimates large displacements: 2 sin(theta / 2) L for a free swing with angle theta, tan(theta) L for a
static one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from salver.dynamics.load_limits import LoadLimit, of_end
from salver.dynamics.load_response import LoadResponse
from salver.dynamics.motion_gradients import Unknowns, at_node
from salver.geometry import GRAVITY, Array, Indices
from salver.models.load_dynamics import Colour, Drawn, LoadDynamics, Modes
from salver.models.rigid_body import RigidBody

ROOM = "the room there is"  # group of its limits, in words
CORNERS = np.array(
    [
        [a * np.eye(3)[0], b * np.eye(3)[1], c * np.eye(3)[2]][:: a * b * c]
        for a in (1, -1)
        for b in (1, -1)
        for c in (1, -1)
    ]
)


class PendulumResponse(LoadResponse):
    """Swings of K pendulums along a motion."""

    def limits(self) -> list[LoadLimit]:
        """Limits of the pendulum's swing: within its room, during the motion and after it."""
        room = self.modes.cases.room
        left = (np.linalg.norm(self._end, axis=1) + self._hangs + self.more_left)[:, None]
        return [
            self.weight_limit,
            LoadLimit("swing", self.modes.height + self.higher, room, self._by, ROOM),
            LoadLimit("swing left", left, room, of_end(self._left_by), ROOM),
        ]

    def _by(self, case: Indices, node: Indices, unknowns: Unknowns) -> Array:
        r = self.modes.r[case, node]
        return at_node(
            unknowns, self.planned, case, node, r / np.maximum(np.linalg.norm(r, axis=-1, keepdims=True), self.least)
        )

    @property
    def _hangs(self) -> Array:
        """Static displacement (K,) after the motion, on a tilted tray, m."""
        return np.linalg.norm(self.modes.slope[:, -1], axis=1) * [case.value for case in self.modes.cases.each]

    @property
    def _end(self) -> Array:
        """Displacement from equilibrium at the end along both axes, and velocities divided by the frequency, (K, 4),
        m."""
        return np.concatenate(self.modes.ending, axis=2)[:, 0]

    def _left_by(self, case: Indices, unknowns: Unknowns) -> Array:
        """Derivatives (m, c) of the length of `_end`."""
        end = self._end[case]
        way = (end / np.maximum(np.linalg.norm(end, axis=1, keepdims=True), self.least))[:, None]
        return self.ending_by(case, unknowns, way[..., :2], way[..., 2:])


@dataclass(frozen=True)
class Pendulum(LoadDynamics):
    """A pendulum in a body. mass: kg. length: of the rod, m. pivot: height over the body's base, m. widest: largest
    angle from the body's axis, rad. damping: least and largest damping ratio."""

    mass: float
    length: float
    pivot: float
    widest: float
    damping: tuple[float, float]
    quantity: ClassVar[str] = "length"
    noun: ClassVar[str] = "pendulum"

    @property
    def response(self) -> type[PendulumResponse]:
        return PendulumResponse

    def modes(self, value: float) -> Modes:
        frozen = RigidBody(self.mass, np.array([0.0, 0.0, -value]), np.zeros((3, 3)))
        omega, mass, height = (np.full((1, 2), x) for x in (np.sqrt(GRAVITY / value), self.mass, -value))
        return Modes(omega, mass, height, frozen, round=True, following=np.inf)

    def origin(self, base: float, value: float) -> float:
        return base + self.pivot

    def room(self, value: float) -> float:
        return value * float(np.sin(self.widest))

    def seen(self, value: float, incline: Array, slope: Array, turning: Array) -> Array:
        """Displacement (T, 3) along x, along y, and its magnitude, m."""
        place = value * incline[:, 0] / np.sqrt(1 + (incline[:, 0] ** 2).sum(axis=1, keepdims=True))
        return np.column_stack([place, np.linalg.norm(place, axis=1)])

    def drawn(self, body: Any, value: float, seen: Array, beyond: float | None) -> Drawn:
        drop = np.sqrt(np.maximum(value**2 - (seen**2).sum(axis=1, keepdims=True), 0.0))
        return Bob(body.inner_origin_B(value) + np.hstack([seen, -drop]), 0.1 * value, self.room(value), beyond)


@dataclass(frozen=True, eq=False)
class Bob(Drawn):
    """A sphere of a radius at places (T, 3) in B, m, and the ring of radius `room` within which it must stay, m."""

    places: Array
    radius: float
    room: float
    beyond: float | None

    @property
    def colour(self) -> Colour:
        return (0.25, 0.25, 0.28)

    @property
    def edge_B(self) -> Array:
        angle = np.linspace(0, 2 * np.pi, 32, endpoint=False)
        ring = self.room * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
        return ring + self.places[:, 2].max() * np.eye(3)[2]

    def triangles_B(self, k: int) -> Array:
        return self.radius * CORNERS + self.places[k]

    def page(self, keep: Array) -> dict[str, Any]:
        return {"triangles": (self.radius * CORNERS).tolist(), "moves": self.places[keep]}
