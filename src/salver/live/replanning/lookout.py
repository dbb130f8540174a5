"""Whether what is commanded keeps clear of what is predicted to pass, looked at whenever either changes.

This knows nothing of planning and takes a few milliseconds. Distances of bounding spheres on a coarse grid of time say
where nothing can meet. Elsewhere exact distances are taken, each of which says for how long no other need be: neither
side goes faster than it does (conservative advancement; Mirtich, 1996).
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
    """At which instants a commanded motion is looked at.

    Attributes:
        step: s of the coarse grid, on which distances of bounding spheres are taken.
        rates: instants in each of its steps at which the joints' rates are looked at.
        finest: s between exact looks at least; half of both sides' way in that time is kept beside the distance.
    """

    step: float = 0.02
    rates: int = 5
    finest: float = 2e-3


LOOKOUT = LookoutOptions()


@dataclass(frozen=True, eq=False)
class Sighting:
    """The moving obstacles of one call of `Live.obstacles`, with a number that tells calls apart.

    news: counts the calls that told of something else than had been predicted.
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
    """An obstacle comes too near to a part at live time t, s; it is believed until then."""

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
        self._fine: Array | None = None

    @property
    def ends(self) -> float:
        return self.since + self.motion.duration

    def off_at(self, t: Array) -> Array:
        return np.interp(t, self.t, self.off)

    def just_before(self, t: float) -> tuple[float, Array]:
        """A live time, s, by less than `LOOKOUT.finest` before another one, and the posture then."""
        if self._fine is None:
            own = np.append(np.arange(0.0, self.motion.duration, LOOKOUT.finest), self.motion.duration)
            self._fine = self.motion.sample(own)[0]
        k = int((t - self.since) / LOOKOUT.finest + 1e-9)
        if k < len(self._fine) - 1:
            return self.since + k * LOOKOUT.finest, self._fine[max(k, 0)]
        return t, self._fine[-1]

    def grid_of(self, movable: Movable) -> tuple[Array, Array, Array]:
        """Live times (K,), s; the middles of the parts at these times, (K, M, 3), m; and the largest speed of each part
        between one time and the next, (K - 1, M), m/s."""
        if self._grid is None:
            duration = self.motion.duration
            own = np.append(np.arange(0.0, max(duration - LOOKOUT.finest, LOOKOUT.finest), LOOKOUT.step), duration)
            within = own[:-1, None] + np.diff(own)[:, None] * np.linspace(0.0, 1.0, LOOKOUT.rates)
            rates = np.abs(self.motion.sample(within.ravel())[1]).reshape(*within.shape, -1).max(axis=1)
            self._grid = self.since + own, movable.middles(self.motion.sample(own)[0]), rates @ movable.levers.T
        return self._grid


class Lookout:
    """Checks one arm against moving obstacles, with work space of its own; threads wait for one another."""

    def __init__(self, problem: TransportProblem) -> None:
        self._movable = None if problem.keep_out is None else Movable(problem.keep_out.parts.apart())
        self._lock = threading.Lock()
        self.looks = 0  # exact distances that were taken

    @property
    def sees(self) -> bool:
        """Whether the arm has any geometry to be looked at."""
        return self._movable is not None

    def outlook(self, path: Path, sighting: Sighting, now: float) -> Outlook:
        """The expected passage from live time `now`, s, on."""
        obstacles = [one for one in sighting.obstacles if one.until > now]
        if self._movable is None or not obstacles:
            return Outlook(sighting)
        with self._lock:
            return Outlook(sighting, self._near(self._movable, path, obstacles, now))

    def _near(self, movable: Movable, path: Path, obstacles: list[Predicted], now: float) -> tuple[Near, ...]:
        along, middles, speeds = path.grid_of(movable)
        last = max(one.until for one in obstacles)
        row = np.arange(max(int(np.searchsorted(along, now, side="right")) - 1, 0), len(along))
        t = along[row] if now < path.ends else np.array([now])
        t = np.append(t, np.arange(t[-1] + LOOKOUT.step, last, LOOKOUT.step))
        t = np.append(t[t < last], last)
        row = row[np.minimum(np.arange(len(t)), len(row) - 1)] if now < path.ends else np.full(len(t), len(along) - 1)
        middle = middles[row]
        speed = np.where((t[:-1] < path.ends)[:, None], speeds[np.minimum(row[:-1], len(speeds) - 1)], 0.0)
        off, step = path.off_at(t), np.diff(t)
        found = []
        for obstacle in obstacles:
            p, v = obstacle.at(t)
            kept = CLEARANCE.safety + obstacle.around(t) + off
            free = np.linalg.norm(middle - p[:, None], axis=2) - movable.radii - obstacle.radius - kept[:, None]
            fast = obstacle.fastest(np.linalg.norm(v, axis=1)) + obstacle.growth
            both = speed + np.maximum(fast[:-1], fast[1:])[:, None]
            way = both * step[:, None] + np.abs(np.diff(off))[:, None]
            believed = t[:-1] < obstacle.until
            doubtful = (free[:-1] + free[1:] <= way) & believed[:, None]
            if not doubtful.any():
                continue
            best: Near | None = None
            columns = np.flatnonzero(doubtful.any(axis=0))
            for part in columns[np.argsort(np.argmax(doubtful[:, columns], axis=0))]:
                until = min(obstacle.until, np.inf if best is None else best.t)
                met = self._first(movable, path, obstacle, int(part), t, np.cumsum(way[:, part]), doubtful[:, part],
                                  both[:, part], max(now, t[0]), until)  # fmt: skip
                if met is not None:
                    best = Near(obstacle.name, movable.names[int(part)], met, obstacle.until)
            if best is not None:
                found.append(best)
        return tuple(sorted(found, key=lambda one: one.t))

    def _first(
        self, movable: Movable, path: Path, obstacle: Predicted, part: int, t: Array, gone: Array, doubtful: Array,
        both: Array, begins: float, until: float,
    ) -> float | None:  # fmt: skip
        """The first live time at which a part is too near to an obstacle; None when it is at none. t: (N,) of the grid;
        of its steps, (N - 1,): gone, m that both go until the end of each; doubtful, whether it has to be looked; both,
        m/s that both go."""
        due = np.flatnonzero(doubtful)
        at = begins
        gone = np.append(0.0, gone)
        while True:
            k = int(np.searchsorted(t, at, side="right")) - 1
            later = due[due >= k]
            if not len(later):
                return None
            if later[0] > k:
                k, at = int(later[0]), float(t[later[0]])
            if at >= until:
                return None
            at, q = path.just_before(at)
            self.looks += 1
            kept = CLEARANCE.safety + obstacle.uncertainty + obstacle.growth * max(at - obstacle.t0, 0.0)
            kept += float(np.interp(at, path.t, path.off))
            free = movable.distance(q, part, obstacle, obstacle.place(at)) - kept
            if free <= 0.5 * LOOKOUT.finest * both[min(k, len(both) - 1)]:
                return at
            # As far as both go in the time that is skipped it cannot be met.
            there = np.interp(at, t, gone) + free
            if there >= gone[-1]:
                return None
            at = max(at + LOOKOUT.finest, float(np.interp(there, gone, t)))
