"""A deviation that was worked out at some instants of a motion, as it is at many.

What a wrong load makes of a motion is smooth, for it has passed the loop's filter; derivatives are most of the work.
What held commands make of it jumps where the jerk does, so of that part what comes before is known beside what comes
after: with l = M^-1 dtau/dt delay the tray feels J l less than what is smooth, and J l to either side of that.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from salver.geometry import Array
from salver.models.worst_case import Drift
from salver.sensitivity.arm.terms import MotionTerms
from salver.sensitivity.arm.tracking import Deviation, JointLoop, late

Indices = npt.NDArray[np.intp]


def some_of(t: Array, jumps: Array, apart: float) -> Indices:
    """Indices of instants t (T,) at which to work a deviation out: where the jerk may jump, and of the smooth pieces
    between these so many that they are about `apart`, s, from each other, and four at least where there are four."""
    at, found = np.flatnonzero(jumps), [np.zeros(1, dtype=int)]
    for first, last in pairwise(at):
        count = min(max(3, int(np.ceil((t[last] - t[first]) / apart - 1e-9))), int(last - first))
        found.append(np.round(np.linspace(first, last, count + 1)[1:]).astype(int))
    return np.concatenate(found)


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
    """known: at instants that are some (K,) of `terms`' own (T,); of smooth pieces, in each a cubic through the four
    nearest of its own. nearest, weights: (T, 4) these, and with which weights. late: (T, n) rad/s^2,
    what a command that is late is short of."""

    known: Deviation
    terms: MotionTerms
    nearest: Indices
    weights: Array
    late: Array

    @classmethod
    def of(
        cls,
        loop: JointLoop,
        t: Array,
        terms: MotionTerms,
        rates: Array,
        jumps: Array,
        some: Indices,
        jerk_before: Array,
    ) -> Finer:
        """Along a motion at t (T,), s; rates: (3, T, n) dq, ddq, dddq. jumps: (T,) whether the jerk may jump there, as
        it may at both ends; what comes after it counts then. some: (K,) indices at which it is worked out, as `some_of`
        gives them; jerk_before: (K, n) just before those."""
        known = loop.along(t[some], terms.only(some), rates[:, some])
        nearest, weights, last = _cubic(t, some, jumps)
        after = late(known.terms, rates[:, some], loop.delay)
        before = after - loop.delay * (rates[2, some] - jerk_before)  # M^-1 times M of what jumps
        lag = np.zeros_like(terms.torque)
        for j in range(4):
            at = nearest[:, j]
            lag += weights[:, j, None] * np.where((at == last)[:, None], before[at], after[at])
        return cls(known, terms, nearest, weights, lag)

    def between(self, values: Array) -> Array:
        """(T, ...) of values (K, ...)."""
        flat = values.reshape(len(values), -1)
        each = (self.weights[:, j, None] * flat[self.nearest[:, j]] for j in range(4))
        return np.asarray(sum(each)).reshape(-1, *values.shape[1:])

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
