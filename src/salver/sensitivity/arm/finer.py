"""What was worked out at some instants of a motion, as it is at many.

What the tray feels and the torque it takes are smooth where the jerk does not jump; so is what a wrong load makes of
them, for it has passed the loop's filter. What held commands make of it jumps where the jerk does, so of that part what
comes before is known beside what comes after: with l = M^-1 dtau/dt delay the tray feels J l less than what is smooth,
and J l to either side of that.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from salver.geometry import Array
from salver.models.worst_case import Drift
from salver.sensitivity.arm.terms import MotionTerms
from salver.sensitivity.arm.tracking import Deviation, JointLoop

Indices = npt.NDArray[np.intp]


def some_of(t: Array, jumps: Array, apart: float, fewest: int = 3) -> Indices:
    """Indices of instants t (T,) at which to work things out: where the jerk may jump, and of the smooth pieces between
    these so many that they are about `apart`, s, from each other, with `fewest` steps in each piece that has so many.
    """
    at = np.flatnonzero(jumps)
    inside = np.diff(at)
    counts = np.minimum(np.maximum(fewest, np.ceil(np.diff(t[at]) / apart - 1e-9).astype(int)), inside)
    piece, of_piece = np.repeat(np.arange(len(counts)), counts), np.cumsum(counts)
    k = np.arange(of_piece[-1]) - (of_piece - counts)[piece] + 1
    return np.append(0, at[piece] + np.round(k * inside[piece] / counts[piece]).astype(int))


@dataclass(frozen=True, eq=False)
class Smooth:
    """How what is known at some (K,) of T instants is continued to all: in each smooth piece by a cubic through the
    four nearest of its own. nearest, weights: (T, 4) these, and with which weights; last: (T,) which one a piece ends
    at."""

    some: Indices
    nearest: Indices
    weights: Array
    last: Indices

    @classmethod
    def of(cls, t: Array, jumps: Array, apart: float, fewest: int = 3) -> Smooth:
        """At instants t (T,); jumps: (T,) whether a piece ends there, as at both ends; the others: see `some_of`."""
        return _smooth(t.tobytes(), jumps.tobytes(), apart, fewest)

    @cached_property
    def _matrix(self) -> Any:
        from scipy.sparse import csr_matrix  # a fifth of a second

        count = len(self.nearest)
        where = self.nearest.ravel(), 4 * np.arange(count + 1)
        return csr_matrix((self.weights.ravel(), *where), shape=(count, len(self.some)))

    def between(self, values: Array) -> Array:
        """(T, ...) of values (K, ...)."""
        flat = values.reshape(len(values), values[0].size)  # none where nothing is uncertain
        return np.asarray(self._matrix @ flat).reshape(len(self.nearest), *values.shape[1:])

    def jumping(self, after: Array, before: Array) -> Array:
        """(T, ...) of values that jump where a piece ends: before (K, ...) and after (K, ...) that."""
        found = np.zeros((len(self.nearest), *after.shape[1:]))
        for j in range(4):
            at = self.nearest[:, j]
            found += self.weights[:, j, None] * np.where((at == self.last)[:, None], before[at], after[at])
        return found


@lru_cache(maxsize=16)
def _smooth(t: bytes, jumps: bytes, apart: float, fewest: int) -> Smooth:
    """`Smooth.of`: ticks ask for the same ones again and again."""
    instants, jump = np.frombuffer(t), np.frombuffer(jumps, dtype=bool)
    some = some_of(instants, jump, apart, fewest)
    return Smooth(some, *_cubic(instants, some, jump))


def _cubic(t: Array, some: Indices, jumps: Array) -> tuple[Indices, Array, Indices]:
    """Which four (T, 4) of the K instants t[some] stand for each of t (T,), and Lagrange's weights; of those within its
    piece as many as there are. And (T,) which one its piece ends at."""
    at = np.flatnonzero(jumps)
    piece = np.clip(np.searchsorted(at, np.arange(len(t)), side="right") - 1, 0, len(at) - 2)
    low, high = np.searchsorted(some, at[piece]), np.searchsorted(some, at[piece + 1])
    first = np.clip(np.searchsorted(t[some], t, side="right") - 2, low, np.maximum(high - 3, low))
    nearest = np.minimum(first[:, None] + np.arange(4), high[:, None])
    known = t[some[nearest]]
    double = np.diff(nearest, axis=1, prepend=-1) == 0  # a piece of fewer than four: its last one counts once
    weights = np.ones((len(t), 4))
    for j in range(4):
        for k in range(4):
            if j != k:
                apart = np.where(double[:, k], 1.0, known[:, j] - known[:, k])
                weights[:, j] *= np.where(
                    double[:, k] | double[:, j], 1.0, (t - known[:, k]) / np.where(apart, apart, 1.0)
                )
    return nearest, np.where(double, 0.0, weights), high


@dataclass(frozen=True, eq=False)
class Finer:
    """known: at instants that are some of those of `terms`; smooth: how to come from these to all. late: (T, n)
    rad/s^2, what a command that is late is short of."""

    known: Deviation
    terms: MotionTerms
    smooth: Smooth
    late: Array

    @classmethod
    def of(
        cls, loop: JointLoop, t: Array, terms: MotionTerms, some: MotionTerms, rates: Array, jerk: Array, smooth: Smooth
    ) -> Finer:
        """Along a motion of terms at t (T,), s, of which some (K,) are known with their derivatives; rates: (3, K, n)
        dq, ddq, dddq there; of what jumps there, what comes after it; jerk: (K, n) just before."""
        known = loop.along(t[smooth.some], some, rates)
        after = known.held.late
        before = after - loop.delay * (rates[2] - jerk)  # M^-1 times M of what jumps
        return cls(known, terms, smooth, smooth.jumping(after, before))

    def between(self, values: Array) -> Array:
        """(T, ...) of values (K, ...)."""
        return self.smooth.between(values)

    def joint_radius(self, order: int) -> Array:
        """(T, n) as of a deviation, for position (0) and velocity (1)."""
        name = ("q", "dq")[order]
        return self._radius(getattr(self.known.joints, name), getattr(self.known.held, name))

    def torque_radius(self) -> Array:
        """(T, n), N m, as of a deviation."""
        return self._radius(self.known.torque, self.known.held.torque)

    def tray_radius(self) -> tuple[Array, Array]:
        """Each (T, 3), as of a deviation."""
        moved = self._radius(self.known.tray.state[:, :6], self.known.held.tray[:, :6])
        return moved[:, :3], moved[:, 3:]

    def _radius(self, terms: Array, held: Array) -> Array:
        """Of what is smooth, not of its radius, which has kinks."""
        return self.known.load.radius(self.between(terms)) + np.abs(self.between(held))

    @cached_property
    def swing(self) -> Array:
        """(T, 12) as of held commands."""
        swing = np.zeros_like(self.terms.w)
        swing[:, :6] = (self.between(self.known.terms.jacobian) @ self.late[:, :, None])[:, :, 0]
        return swing

    def felt(self) -> tuple[Array, Drift]:
        """As of a deviation with held commands."""
        known, swing = self.known, self.swing
        smooth = self.between(known.held.w + known.held.swing)
        drift = Drift(known.load.terms, self.between(known.tray.w * known.load.half_range), swing)
        return self.terms.w + smooth - swing, drift
