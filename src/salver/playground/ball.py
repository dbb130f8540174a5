"""A ball that is thrown at the load: its flight, what it would hit, and its reports to the live motion.

The engine has no such body: the ball flies through whatever it meets, and the page says so.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from salver.geometry import GRAVITY_S, Array
from salver.live import Moving
from salver.live.replanning.obstacles import Movable, predicted
from salver.models.arm.arm import ArmModel
from salver.models.arm.arm_geometry import arm_geometry
from salver.models.payload import Payload


@dataclass(frozen=True)
class Throw:
    """A ball, and how it is thrown and seen.

    radius: m. flight: s from the throw to the tray. away: distance of the throw from the tray, m. aside: least and
    largest angle, rad, between the throw and the direction in which the arm reaches, so that the ball flies on past the
    arm. over: s after which the ball is removed. measured_every, seen_every: s between computations of its distance,
    and between its reports.
    """

    radius: float = 0.05
    flight: float = 1.2
    away: float = 1.8
    aside: tuple[float, float] = (1.1, 1.9)
    over: float = 2.0
    measured_every: float = 0.01
    seen_every: float = 0.1


class Ball:
    """The ball of one scene; away until it is thrown."""

    def __init__(self, arm: ArmModel, payload: Payload, throw: Throw) -> None:
        self._throw, self.radius = throw, throw.radius
        self._movable, self._base = Movable(arm_geometry(arm, payload.bodies)), arm.base_position
        self._rng = np.random.default_rng(0)
        self._begin = self._speed = np.zeros(3)  # m, m/s, when it was thrown
        self._since: float | None = None
        self._measured = self._seen = -np.inf
        self.passed, self._hit = np.inf, ""  # m, the least distance from arm, tray and load; what it hit first

    def throw(self, t: float, p_SE: Array) -> None:
        """Throw the ball at the load, from the side."""
        how = self._throw
        out = p_SE[:2] - self._base[:2]
        bearing = np.arctan2(out[1], out[0]) + self._rng.choice([-1.0, 1.0]) * self._rng.uniform(*how.aside)
        target = p_SE + np.array([0.0, 0.0, 0.08])
        self._begin = target + np.array([how.away * np.cos(bearing), how.away * np.sin(bearing), 0.2])
        self._speed = (target - self._begin) / how.flight - 0.5 * how.flight * GRAVITY_S
        self._since, self._measured, self._seen = t, -np.inf, -np.inf
        self.passed, self._hit = np.inf, ""

    @property
    def flies(self) -> bool:
        return self._since is not None

    @property
    def sentence(self) -> str:
        """Its least distance, or what it hit, while it flies."""
        if not self.flies or not np.isfinite(self.passed):
            return ""
        if self._hit:
            return f"The ball has hit the {self._hit}, and flies through."
        return f"The ball has come to {1e3 * self.passed:.0f} mm."

    def at(self, t: float) -> tuple[Array, Array]:
        """Position (3,), m, and velocity (3,), m/s, in S."""
        s = t - (self._since or 0.0)
        return self._begin + s * self._speed + 0.5 * s**2 * GRAVITY_S, self._speed + s * GRAVITY_S

    def step(self, t: float, q: Array) -> list[Moving] | None:
        """Advance by a period, with the arm at q (n,), rad. Returns the new report of the ball; None without one."""
        how = self._throw
        if self._since is None:
            return None
        if t - self._since > how.over:
            self._since = None
            return []
        p, v = self.at(t)
        if t - self._measured >= how.measured_every:
            self._measured = t
            self._measure(p, q)
        if t - self._seen < how.seen_every:
            return None
        self._seen = t
        if p[2] < self._base[2] + 2 * how.radius:
            return []  # it is at the floor
        return [Moving("ball", "sphere", p, v, GRAVITY_S, radius=how.radius, uncertainty=0.01, growth=0.05, seen=t)]

    def _measure(self, p: Array, q: Array) -> None:
        """Note how near it is."""
        here = predicted(Moving("ball", "sphere", p, radius=self.radius), 0.0)
        distances = self._movable.distances(q[None], here, p[None])[0]
        self.passed = min(self.passed, float(distances.min()))
        if distances.min() <= 0.0:
            self._hit = self._hit or self._movable.names[int(np.argmin(distances))]
