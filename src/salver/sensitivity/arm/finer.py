"""What was worked out at some instants of a motion, as it is at many.

What the tray feels and the torque it takes are smooth where the jerk does not jump; so is what a wrong load makes of
them, for it has passed the loop's filter. What held commands make of it jumps where the jerk does, so of that part what
comes before is known beside what comes after: with l = M^-1 dtau/dt delay the tray feels J l less than what is smooth,
and J l to either side of that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import accumulate
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt

from salver.geometry import Array, Indices
from salver.models.worst_case import Drift
from salver.sensitivity.arm.terms import MotionTerms
from salver.sensitivity.arm.tracking import Deviation, JointLoop

SETTLES, RESTS = 8.0, 21  # of the loop's time constants, that are looked at of a rest, and at how many instants


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
    def of(cls, t: Array, jumps: npt.NDArray[np.bool_], apart: float, fewest: int = 3) -> Smooth:
        """At instants t (T,); jumps: (T,) whether a piece ends there, as at both ends; the others: see `some_of`."""
        return _smooth(t.tobytes(), jumps.tobytes(), apart, fewest)

    @classmethod
    def onto(cls, known: Array, jumps: npt.NDArray[np.bool_], t: Array) -> Smooth:
        """From instants known (K,) to others, t (T,), none of them outside; jumps: (K,) whether a piece ends there."""
        return _smooth_onto(known.tobytes(), jumps.tobytes(), t.tobytes())

    @cached_property
    def _matrix(self) -> Any:
        return self._sparse(self.nearest, len(self.some))

    def _sparse(self, columns: Indices, width: int) -> Any:
        """(T, width) with the weights in columns (T, 4)."""
        from scipy.sparse import csr_matrix  # a fifth of a second

        count = len(columns)
        return csr_matrix((self.weights.ravel(), columns.ravel(), 4 * np.arange(count + 1)), shape=(count, width))

    def between(self, values: Array) -> Array:
        """(T, ...) of values (K, ...)."""
        flat = values.reshape(len(values), values[0].size)  # none where nothing is uncertain
        return np.asarray(self._matrix @ flat).reshape(len(self.nearest), *values.shape[1:])

    def each(self, several: Sequence[Array]) -> list[Array]:
        """`between` of several, all at once."""
        sizes = [prod(values.shape[1:]) for values in several]
        flat = np.concatenate([x.reshape(len(x), size) for x, size in zip(several, sizes, strict=True)], axis=1)
        found, ends = self.between(flat), accumulate(sizes)
        parts = (found[:, end - size : end] for size, end in zip(sizes, ends, strict=True))
        return [x.reshape(len(x), *values.shape[1:]) for x, values in zip(parts, several, strict=True)]

    def jumping(self, after: Array, before: Array) -> Array:
        """(T, n) of values that jump where a piece ends: before (K, n) and after (K, n) that."""
        return np.asarray(self._either @ np.concatenate([after, before]))

    @cached_property
    def _either(self) -> Any:
        """As `_matrix`, of what comes after instants and then of what comes before them: a piece ends with this."""
        count = len(self.some)
        ending = self.nearest == self.last[:, None]
        return self._sparse(np.where(ending, self.nearest + count, self.nearest), 2 * count)


@lru_cache(maxsize=16)
def _smooth(t: bytes, jumps: bytes, apart: float, fewest: int) -> Smooth:
    """`Smooth.of`: ticks ask for the same ones again and again."""
    instants, jump = np.frombuffer(t), np.frombuffer(jumps, dtype=bool)
    some = some_of(instants, jump, apart, fewest)
    return Smooth(some, *_cubic(instants[some], jump[some], instants))


@lru_cache(maxsize=16)
def _smooth_onto(known: bytes, jumps: bytes, t: bytes) -> Smooth:
    instants = np.frombuffer(known)
    nearest, weights, last = _cubic(instants, np.frombuffer(jumps, dtype=bool), np.frombuffer(t))
    return Smooth(np.arange(len(instants)), nearest, weights, last)


def _cubic(instants: Array, jumps: Array, t: Array) -> tuple[Indices, Array, Indices]:
    """Which four (T, 4) of K instants stand for each of t (T,), and Lagrange's weights; of those within its piece as
    many as there are. And (T,) which one its piece ends at. jumps: (K,) whether a piece ends there."""
    at = np.flatnonzero(jumps)
    piece = np.clip(np.searchsorted(instants[at], t, side="right") - 1, 0, len(at) - 2)
    low, high = at[piece], at[piece + 1]
    first = np.clip(np.searchsorted(instants, t, side="right") - 2, low, np.maximum(high - 3, low))
    nearest = np.minimum(first[:, None] + np.arange(4), high[:, None])
    known = instants[nearest]
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
class _Continued:
    """Of a deviation, at all T instants: strayed (T, 3 n + 6, n_c), joints' q, dq, torque and the tray's displacement,
    for each term, and held (T, 3 n + 6), what held commands make of them; w, held_w, what the tray feels of either; and
    the tray's Jacobian."""

    strayed: Array
    held: Array
    w: Array
    held_w: Array
    jacobian: Array


@dataclass(frozen=True, eq=False)
class Finer:
    """known: at instants that are some of those of `terms`; smooth: how to come from these to all. late: (T, n)
    rad/s^2, what a command that is late is short of; before: (K, n) the same just before each instant that is known.
    loop: what it is of."""

    loop: JointLoop
    known: Deviation
    terms: MotionTerms
    smooth: Smooth
    late: Array
    before: Array

    @classmethod
    def of(
        cls, loop: JointLoop, t: Array, terms: MotionTerms, some: MotionTerms, rates: Array, jerk: Array, smooth: Smooth
    ) -> Finer:
        """Along a motion of terms at t (T,), s, of which some (K,) are known with their derivatives; rates: (3, K, n)
        dq, ddq, dddq there; of what jumps there, what comes after it; jerk: (K, n) just before."""
        known = loop.along(t[smooth.some], some, rates, before=jerk)
        after = known.held.late
        before = after - loop.delay * (rates[2] - jerk)  # M^-1 times M of what jumps
        return cls(loop, known, terms, smooth, smooth.jumping(after, before), before)

    @cached_property
    def midway(self) -> Deviation:
        """At the instants that are known, with what is between before and after where the jerk jumps: for a filter that
        takes what it is driven by for smooth, a step falls half before its instant and half after it."""
        held, jump = self.known.held, self.known.held.late - self.before
        w = held.w.copy()
        w[:, :6] += 0.5 * (self.known.terms.jacobian @ jump[:, :, None])[:, :, 0]
        return replace(self.known, held=replace(held, w=w))

    @cached_property
    def _continued(self) -> _Continued:
        """Of what is smooth, not of its radius, which has kinks."""
        known, held = self.known, self.known.held
        moving = known.joints.state[:, : 2 * held.q.shape[1]]
        strayed = np.concatenate([moving, known.torque, known.tray.state[:, :6]], axis=1)
        by_held = np.concatenate([held.q, held.dq, held.torque, held.tray[:, :6]], axis=1)
        felt, by_held_felt = known.tray.w * known.load.half_range, held.w + held.swing
        return _Continued(*self.smooth.each([strayed, by_held, felt, by_held_felt, known.terms.jacobian]))

    def along(self, terms: MotionTerms) -> Finer:
        """The same along a motion like it, with its terms."""
        other = replace(self, terms=terms)
        vars(other).update(_continued=self._continued, _radii=self._radii)
        return other

    @cached_property
    def _radii(self) -> list[Array]:
        """Of q, dq, torque, and of the tray's displacement."""
        found, n = self._continued, self.terms.q.shape[1]
        both = self.known.load.radius(found.strayed) + np.abs(found.held)
        return np.split(both, [n, 2 * n, 3 * n], axis=1)

    @cached_property
    def resting(self) -> tuple[Array, Array]:
        """Each (3,), the largest `tray_radius` while the arm rests at the end, where it has yet to settle."""
        known, t = self.known, np.linspace(0.0, SETTLES / np.sqrt(self.loop.kp), RESTS)
        states = np.zeros((3, RESTS, *known.terms.q.shape[1:]))
        states[0] = known.terms.q[-1]
        terms = known.terms.continued(states, lambda x: [np.repeat(y[-1:], RESTS, axis=0) for y in x], derivatives=True)
        last = float(len(known.terms.q) - 1)
        begun = self.loop.begun(known.state_at(np.arange(last + 1), last))
        found = begun.along(t, terms, np.zeros((3, RESTS, states.shape[2])))
        position, turn = found.tray_radius()
        return position.max(axis=0), turn.max(axis=0)

    def joint_radius(self, order: int) -> Array:
        """(T, n) as of a deviation, for position (0) and velocity (1)."""
        return self._radii[order]

    def torque_radius(self) -> Array:
        """(T, n), N m, as of a deviation."""
        return self._radii[2]

    def tray_radius(self) -> tuple[Array, Array]:
        """Each (T, 3), as of a deviation."""
        moved = self._radii[3]
        return moved[:, :3], moved[:, 3:]

    def onto(self, terms: MotionTerms, smooth: Smooth, moving: Array) -> Finer:
        """At other instants, with terms (T,) there; smooth: how to come to them from those that are known. moving: (T,)
        whether the motion has not ended yet."""
        late = smooth.jumping(self.known.held.late, self.before)
        return replace(self, terms=terms, smooth=smooth, late=late * moving[:, None])

    @cached_property
    def swing(self) -> Array:
        """(T, 12) as of held commands."""
        swing = np.zeros_like(self.terms.w)
        swing[:, :6] = (self._continued.jacobian @ self.late[:, :, None])[:, :, 0]
        return swing

    def felt(self) -> tuple[Array, Drift]:
        """As of a deviation with held commands."""
        found, swing = self._continued, self.swing
        return self.terms.w + found.held_w - swing, Drift(self.known.load.terms, found.w, swing)
