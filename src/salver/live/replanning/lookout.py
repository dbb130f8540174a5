"""Whether the commanded motion keeps clear of predicted obstacles, checked whenever either changes.

This knows nothing of planning and takes a few milliseconds. Distances of bounding spheres on a coarse grid of time show
where no collision is possible. Elsewhere spans of time are halved: a span is free of collisions if the sum of the exact
distances at its ends exceeds the path length of both sides in it.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from salver.geometry import Array
from salver.live.replanning.obstacles import Movable, Predicted
from salver.planning.fastest import TransportProblem
from salver.planning.trajopt.constraints.obstacles import CLEARANCE
from salver.trajectory import JointMotion


@dataclass(frozen=True)
class LookoutOptions:
    """The instants at which a commanded motion is checked against obstacles.

    Attributes:
        step: s, step of the coarse grid on which distances of bounding spheres are computed.
        rates: instants in each of its steps at which the joints' rates are evaluated.
        finest: s, span that is not halved further: a collision that is possible in it counts as one.
    """

    step: float = 0.02
    rates: int = 5
    finest: float = 2e-3


@dataclass(frozen=True, eq=False)
class Sighting:
    """The moving obstacles of one call of `Live.obstacles`, with a number that tells calls apart.

    news: number of calls whose obstacles differed from the prediction.
    """

    obstacles: tuple[Predicted, ...] = ()
    news: int = 0

    def then(self, found: Sequence[Predicted], now: float) -> Sighting:
        """Predicted obstacles at live time `now`, s."""
        before = {one.name: one for one in self.obstacles if one.until >= now}
        same = len(found) == len(before) and all(
            one.name in before and before[one.name].foresaw(one, now) for one in found
        )
        return Sighting(tuple(found), self.news + (not same))


@dataclass(frozen=True)
class Near:
    """An obstacle comes too near to a part of the arm at live time t, s; the prediction holds until then."""

    obstacle: str
    part: str
    t: float
    until: float


@dataclass(frozen=True, eq=False)
class Outlook:
    """Clearance of a commanded path from moving obstacles.

    near: the first time of each obstacle, in order of time; empty when it keeps clear.
    """

    sighting: Sighting
    near: tuple[Near, ...] = ()

    @property
    def clear(self) -> bool:
        return not self.near

    def sentence(self, now: float) -> str:
        """The expected passage from live time `now`, s, on, in words; empty if there is none, or it is over."""
        left = [one for one in self.near if now <= one.until]
        if not left:
            return ""
        first = left[0]
        return f"{first.obstacle} comes too near to the {first.part} at {first.t:.2f} s."


class Path:
    """A commanded motion to be checked: from live time `since` on, with the uncertainty off (K,), m, of objects on
    the tray at live times t (K,)."""

    def __init__(self, motion: JointMotion, since: float, t: Array, off: Array) -> None:
        self.motion, self.since, self.t, self.off = motion, since, t, off
        # Made when they are first needed.
        self._grid: tuple[Array, Array, Array] | None = None
        self._postures: Array | None = None

    @property
    def ends(self) -> float:
        return self.since + self.motion.duration

    def off_at(self, t: Array) -> Array:
        return np.interp(t, self.t, self.off)

    def posture(self, t: float, step: float) -> Array:
        """Posture (n,) at a live time, s; linear between postures that are `step` s apart."""
        if self._postures is None:
            own = np.linspace(0.0, self.motion.duration, int(np.ceil(self.motion.duration / step)) + 1)
            self._postures = self.motion.sample(own)[0]
        last = len(self._postures) - 1
        x = min(max((t - self.since) / self.motion.duration, 0.0), 1.0) * last
        k = min(int(x), last - 1)
        return self._postures[k] + (x - k) * (self._postures[k + 1] - self._postures[k])

    def grid_of(self, movable: Movable, options: LookoutOptions) -> tuple[Array, Array, Array]:
        """Live times (K,), s; the middles of the parts at these times, (K, M, 3), m; and the largest speed of each part
        between one time and the next, (K - 1, M), m/s."""
        if self._grid is None:
            duration = self.motion.duration
            own = np.append(np.arange(0.0, max(duration - options.finest, options.finest), options.step), duration)
            within = own[:-1, None] + np.diff(own)[:, None] * np.linspace(0.0, 1.0, options.rates)
            rates = np.abs(self.motion.sample(within.ravel())[1]).reshape(*within.shape, -1).max(axis=1)
            self._grid = self.since + own, movable.middles(self.motion.sample(own)[0]), rates @ movable.levers.T
        return self._grid


class Lookout:
    """Checks one arm against moving obstacles, with work space of its own; threads wait for one another."""

    def __init__(self, problem: TransportProblem, options: LookoutOptions | None = None) -> None:
        self._options = options or LookoutOptions()
        self._movable = None if problem.keep_out is None else Movable(problem.keep_out.parts.apart())
        self._lock = threading.Lock()

    @property
    def sees(self) -> bool:
        """Whether the arm has any geometry to be checked."""
        return self._movable is not None

    def outlook(self, path: Path, sighting: Sighting, now: float) -> Outlook:
        """The expected passage from live time `now`, s, on."""
        obstacles = [one for one in sighting.obstacles if one.until > now]
        if self._movable is None or not obstacles:
            return Outlook(sighting)
        with self._lock:
            return Outlook(sighting, self._near(self._movable, path, obstacles, now))

    def _near(self, movable: Movable, path: Path, obstacles: list[Predicted], now: float) -> tuple[Near, ...]:
        step = self._options.step
        along, middles, speeds = path.grid_of(movable, self._options)
        row = np.arange(max(int(np.searchsorted(along, now, side="right")) - 1, 0), len(along))
        t = along[row] if now < path.ends else np.array([now])
        last = max(one.until if np.isfinite(one.until) else float(t[-1]) + step for one in obstacles)
        t = np.append(t, np.arange(t[-1] + step, last, step))
        t = np.append(t[t < last], last)
        row = row[np.minimum(np.arange(len(t)), len(row) - 1)] if now < path.ends else np.full(len(t), len(along) - 1)
        middle = middles[row]
        speed = np.where((t[:-1] < path.ends)[:, None], speeds[np.minimum(row[:-1], len(speeds) - 1)], 0.0)
        off, steps = path.off_at(t), np.diff(t)
        found = []
        for obstacle in obstacles:
            p, v = obstacle.at(t)
            kept = CLEARANCE.safety + obstacle.around(t) + off
            free = np.linalg.norm(middle - p[:, None], axis=2) - movable.radii - obstacle.radius - kept[:, None]
            fast = obstacle.fastest(np.linalg.norm(v, axis=1)) + obstacle.growth
            both = speed + np.maximum(fast[:-1], fast[1:])[:, None]
            way = both * steps[:, None] + np.abs(np.diff(off))[:, None]
            doubtful = (free[:-1] + free[1:] <= way) & (t[:-1] < obstacle.until)[:, None]
            gone = np.cumsum(np.vstack([np.zeros(len(movable.names)), way]), axis=0)
            until, best = obstacle.until, None
            columns = np.flatnonzero(doubtful.any(axis=0))
            for part in columns[np.argsort(np.argmax(doubtful[:, columns], axis=0))]:
                k = np.flatnonzero(doubtful[:, part])[[0, -1]]
                begins, ends = max(now, float(t[k[0]])), min(float(t[k[1] + 1]), until)
                meets = self._first(movable, path, obstacle, int(part), begins, ends, t, gone[:, part])
                if meets is not None:
                    until, best = meets, Near(obstacle.name, movable.names[int(part)], meets, obstacle.until)
            if best is not None:
                found.append(best)
        return tuple(sorted(found, key=lambda one: one.t))

    def _first(
        self, movable: Movable, path: Path, obstacle: Predicted, part: int, begins: float, ends: float, t: Array,
        gone: Array,
    ) -> float | None:  # fmt: skip
        """The first live time between two at which a part may be too near to an obstacle; None when it is at none.
        gone: (N,) m, the way that both go until live times t (N,)."""

        def free(at: float) -> float:
            t = np.array([at])
            kept = CLEARANCE.safety + obstacle.around(t)[0] + path.off_at(t)[0]
            q, p = path.posture(at, self._options.finest), obstacle.at(t)[0][0]
            return movable.distance(q, part, obstacle, p) - float(kept)

        def between(a: float, free_a: float, b: float, free_b: float) -> float | None:
            if free_a + free_b > float(np.interp(b, t, gone) - np.interp(a, t, gone)):
                return None
            if free_a <= 0.0 or b - a <= self._options.finest:
                return a
            middle = 0.5 * (a + b)
            free_m = free(middle)
            found = between(a, free_a, middle, free_m)
            return between(middle, free_m, b, free_b) if found is None else found

        return None if ends <= begins else between(begins, free(begins), ends, free(ends))
