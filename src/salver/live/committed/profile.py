"""A motion along its own path at another speed: the speed factor of a live motion, and how it changes.

q(t) = path(u(t)) with u' = factor, so q' = factor path' and q'' = factor^2 path'' + factor' path'. The factor changes
to another one as a cubic whose rate is zero at the end; so accelerations have no jump, and jerk is finite.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from salver.geometry import Array
from salver.trajectory import JointMotion

SAME = 1e-9  # s; instants nearer than this are one


@dataclass(frozen=True)
class SpeedOptions:
    """How the speed factor of a live motion is changed: by the shortest change that passes the verdict.

    Attributes:
        least: smallest factor of full speed; a slower motion takes so long that it is not verified in time.
        soonest, latest: s, the first and the last duration of the change that are tried.
        braking: s, longest duration that is tried for a stop along the path of a motion that is run slowly. Other stops
            save at most half of it, and are searched for during 0.3 to 0.9 s.
        longer: ratio of each tried duration to the one before.
        glance: s between the instants of a first, quick verdict; only motions that pass it get the full verdict.
        again: s between a failed try and the next.
    """

    least: float = 0.05
    soonest: float = 0.05
    latest: float = 4.0
    braking: float = 0.3
    longer: float = 1.3
    glance: float = 0.02
    again: float = 0.1


@dataclass(frozen=True, eq=False)
class SpeedProfile:
    """A path, and how fast it is run.

    path: the motion at full speed, in its own time u from 0 on. begins: live time, s, from which on the profile holds.
    at: u at that time. factor, rate: the speed factor at that time, and its rate, 1/s. to: the factor after `within` s.
    """

    path: JointMotion
    begins: float
    at: float = 0.0
    factor: float = 1.0
    rate: float = 0.0
    to: float = 1.0
    within: float = 1.0

    def along(self, t: Array) -> tuple[Array, Array, Array]:
        """u, u' = factor and u'' at times t (T,), s after the profile begins."""
        T = self.within
        x = np.clip(t / T, 0.0, 1.0)
        # Powers of x, from 0 on: factor(x) = (1, rate T, 3 d - 2 rate T, rate T - 2 d) with d what there is to go.
        r, d = self.rate * T, self.to - self.factor
        c = np.array([self.factor, r, 3 * d - 2 * r, r - 2 * d])
        factor = c[0] + x * (c[1] + x * (c[2] + x * c[3]))
        rate = (c[1] + x * (2 * c[2] + x * 3 * c[3])) / T
        gone = T * x * (c[0] + x * (c[1] / 2 + x * (c[2] / 3 + x * c[3] / 4)))
        later = np.maximum(t - T, 0.0)
        return self.at + gone + self.to * later, np.where(later > 0, self.to, factor), np.where(later > 0, 0.0, rate)

    @property
    def settled(self) -> float:
        """Live time, s, from which on the factor does not change."""
        return self.begins if self.factor == self.to and not self.rate else self.begins + self.within

    def then(self, live: float, to: float, within: float) -> SpeedProfile:
        """The profile that changes to another factor from live time `live`, s, on."""
        at, factor, rate = (float(x[0]) for x in self.along(np.array([live - self.begins])))
        return SpeedProfile(self.path, live, at, factor, rate, to, within)

    @property
    def over(self) -> bool:
        """Whether the path has ended before the factor reaches its new value."""
        return float(self.along(np.array([self.within]))[0][0]) >= self.path.duration

    @property
    def possible(self) -> bool:
        """Whether the factor stays between those that it goes from and to: that of a cubic whose slope at its
        beginning is at most three times the mean one (Fritsch and Carlson, SIAM J. Numer. Anal. 17(2), 1980)."""
        d = self.to - self.factor
        return self.rate * d >= 0.0 and abs(self.rate) * self.within <= 3.0 * abs(d)

    def motion(self, start: tuple[Array, Array, Array] | None = None, step: float = 0.01) -> JointMotion:
        """The motion from its beginning to rest: exact at the path's knots and, while the factor changes, every `step`
        s; between these it is quintic, as every motion is. start: q, dq, ddq (n,) of the motion that it continues,
        which was exact at other instants.
        """
        path, changing = self.path, self.within if self.settled > self.begins else 0.0
        if changing and self.over:
            changing = float(self._when(np.array([path.duration]))[0])
        t = np.linspace(0.0, changing, int(np.ceil(changing / step)) + 1)
        reached = float(self.along(np.array([changing]))[0][0])
        knots = path.t[path.t > self.at + SAME]
        within = self._when(knots[knots < reached - SAME])
        if len(within):
            apart = np.abs(t[1:-1, None] - within).min(axis=1)
            t = np.union1d(np.concatenate([t[:1], t[1:-1][apart > 0.1 * step], t[-1:]]), within)
        if self.to:
            t = np.append(t, changing + (knots[knots > reached + SAME] - reached) / self.to)
        u, factor, rate = self.along(t)
        q, dq, ddq = path.sample(np.minimum(u, path.duration))
        factor, rate = factor[:, None], rate[:, None]
        dq, ddq = factor * dq, factor**2 * ddq + rate * dq
        dq[-1] = ddq[-1] = 0.0  # but for the last digits, it is
        if start is not None:
            q[0], dq[0], ddq[0] = start
        return JointMotion(t, q, dq, ddq)

    def _when(self, u: Array) -> Array:
        """Times (K,) after the beginning at which the path's own time is u, while the factor changes."""
        t = np.linspace(0.0, self.within, 1001)
        found = np.interp(u, self.along(t)[0], t)
        for _ in range(4):  # of Newton's method
            at, factor, _ = self.along(found)
            found = np.clip(found - (at - u) / np.maximum(factor, 1e-9), 0.0, self.within)
        return found
