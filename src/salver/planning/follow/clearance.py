"""Collisions and least distances along a whole motion, not only at sampled instants.

Distances are computed at some instants. Between two of them the distance of a pair is at least half of (the sum of the
two distances minus the length of the path that the parts can move relative to each other): conservative advancement,
Mirtich, "Impulse-based Dynamic Simulation", 1996. Where this bound is too small, the interval is halved.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from salver.geometry import Array, Indices
from salver.models.arm.arm_geometry import ArmGeometry
from salver.trajectory import JointMotion

RESOLUTION = 1e-4  # m: parts that may have come nearer than this count as touching
EXACT = 1e-5  # m: accuracy of Coal's distances


@dataclass(frozen=True)
class NearestPair:
    """Two parts, an instant (s), and their distance then (m): 0 or less when they overlap."""

    first: str
    second: str
    time: float
    distance: float


@dataclass(frozen=True)
class Sweep:
    """Result of the check of a motion.

    touch: the first instant found at which two parts touch, or None. nearest: the closest approach of any two parts.
    obstacle: the closest approach of a moving part to an obstacle. None where no pair was compared.
    """

    touch: NearestPair | None
    nearest: NearestPair | None
    obstacle: NearestPair | None


def sweep(parts: ArmGeometry, motion: JointMotion) -> Sweep:
    """Check all pairs of `parts` along a motion; least distances are accurate to 1 mm."""
    if not parts.pairs:
        return Sweep(None, None, None)
    reach = parts.levers(motion.q)
    around = np.array([j >= len(parts.names) - parts.obstacles for _, j in parts.pairs])
    t = np.linspace(0.0, motion.duration, 33)
    distance = parts.clearance(motion.sample(t)[0])
    least, when = distance.min(axis=0), t[np.argmin(distance, axis=0)]
    touch = _first_touch(t, distance, np.arange(len(least)))

    watched, pairs = parts, np.arange(len(least))
    begin, end, first, last = t[:-1], t[1:], distance[:-1], distance[1:]
    while len(begin):
        gone = (motion.travel(end) - motion.travel(begin)) @ reach[pairs].T
        left = 0.5 * (first + last - gone)
        settled = gone <= RESOLUTION
        touch = _earlier(touch, _first_touch(end, np.where(settled, left, np.inf), pairs))
        enough = np.zeros(len(pairs))  # bounds above this need no finer interval
        if touch is None:
            nearest_obstacle = least[around].min(initial=np.inf)
            enough = np.where(around[pairs], max(nearest_obstacle, least.min()), least.min()) - 1e-3
        open_ = (left <= np.maximum(enough, EXACT)) & ~settled
        if touch is not None:
            open_ &= (begin < touch[0])[:, None]
        rows, columns = open_.any(axis=1), open_.any(axis=0)
        begin, end, pairs = begin[rows], end[rows], pairs[columns]
        first, last = first[rows][:, columns], last[rows][:, columns]
        if not len(begin):
            break
        watched = parts.only(pairs)
        t = 0.5 * (begin + end)
        distance = watched.clearance(motion.sample(t)[0])
        nearer = distance.min(axis=0) < least[pairs]
        when[pairs[nearer]] = t[np.argmin(distance, axis=0)][nearer]
        least[pairs] = np.minimum(least[pairs], distance.min(axis=0))
        touch = _earlier(touch, _first_touch(t, distance, pairs))
        begin, end = np.concatenate([begin, t]), np.concatenate([t, end])
        first, last = np.vstack([first, distance]), np.vstack([distance, last])

    def near(pair: int, time: float, distance: float) -> NearestPair:
        i, j = parts.pairs[pair]
        return NearestPair(parts.names[i], parts.names[j], float(time), float(distance))

    def nearest(among: Indices) -> NearestPair | None:
        if not len(among):
            return None
        pair = int(among[np.argmin(least[among])])
        return near(pair, when[pair], least[pair])

    touching = None if touch is None else near(touch[1], touch[0], min(least[touch[1]], 0.0))
    return Sweep(touching, nearest(np.arange(len(least))), nearest(np.flatnonzero(around)))


def _first_touch(t: Array, distance: Array, pairs: Indices) -> tuple[float, int] | None:
    """The earliest instant, s, at which a pair touches, and its index. distance: (T, len(pairs)) at times t (T,)."""
    touching = distance <= EXACT
    if not touching.any():
        return None
    k = int(np.argmin(np.where(touching.any(axis=1), t, np.inf)))
    return float(t[k]), int(pairs[np.argmin(distance[k])])


def _earlier(known: tuple[float, int] | None, found: tuple[float, int] | None) -> tuple[float, int] | None:
    return known if found is None or (known is not None and known[0] <= found[0]) else found
