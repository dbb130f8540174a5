"""Clearance of arm, tray and load from one another and from obstacles, for the optimiser.

Distances between convex hulls by Coal (`salver.models.arm.arm_geometry`). They are cheap; derivatives are taken only
for the few pairs and postures that are near.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from salver.geometry import Array, Indices
from salver.models.arm.arm_geometry import ArmGeometry
from salver.models.described import Floor
from salver.planning.follow import clearance

SAFETY = 5e-3  # m that are kept free, but for the floor's own
AT_NODES = 1e-3  # m more at the nodes of a programme, for what may happen between them
REACH = 5e-3  # m; pairs that are further apart than this and what they must be are left out of a programme
EXACT = 1.5 * REACH + AT_NODES  # m up to which distances are exact: what comes to within reach from there came far
ENOUGH_AT_ENDS = 1.5e-3  # m beyond what is required, at which an end posture needs no exception
KEPT_AT_ENDS = 0.1  # share of the distance at an end that does need one
APART = 0.5 * clearance.RESOLUTION + 2 * clearance.EXACT  # m beyond which no verdict takes parts for touching,
OF_LITTLE = 0.9  # share of what there is at an end that is kept where that is hardly more
KEPT_WHERE_GIVEN = 0.5  # and of that in a posture that was given, where the arm stands
NEAR = 0.05  # m; pairs that are nowhere nearer along a path are left out until they are
TOUCHES = 5e-3  # m; where something is touched by more than this


@dataclass(frozen=True, eq=False)
class KeepOut:
    """parts: geometry with the pairs that are watched. required: (pairs,) distance to keep, m; where it is below zero,
    `least` is kept all the same."""

    parts: ArmGeometry
    required: Array

    @classmethod
    def of(cls, parts: ArmGeometry, q: Array | None) -> KeepOut:
        """All pairs; one that is nearer than `safety` at some of the postures (N, n) that are given has to keep a share
        of that distance."""
        required = safety(parts)
        if q is not None:
            required = np.minimum(required, KEPT_WHERE_GIVEN * np.maximum(parts.clearance(q).min(axis=0), 0.0))
        return cls(parts, required)

    def kept_by(self, ends: Array) -> KeepOut:
        """The pairs with less distance to keep for those that are too near in given end postures (N, n): a tenth of
        what there is, less what the nodes of a programme keep beside it, because the arm may deviate into the rest.
        What a given posture keeps is kept: by that motions are judged that begin there."""
        there = self.parts.clearance(ends).min(axis=0)
        share = np.where(self.required < safety(self.parts), KEPT_WHERE_GIVEN, KEPT_AT_ENDS)
        there = np.maximum(there, 0.0)
        kept = np.maximum(share * there, np.minimum(APART, OF_LITTLE * there))
        less = np.minimum(kept - AT_NODES, self.required)
        return KeepOut(self.parts, np.where(there < self.required + ENOUGH_AT_ENDS, less, self.required))

    @property
    def least(self) -> Array:
        """(pairs,) m that is kept at every instant: so much that no verdict takes parts for touching."""
        return np.where(self.required < 0.0, np.minimum(APART, self.required + AT_NODES), self.required)

    def near(self, q: Array) -> KeepOut:
        """Only the pairs that come near at one of the postures (N, n)."""
        parts = self.parts.near(q, NEAR)
        required = dict(zip(self.parts.pairs, self.required, strict=True))
        return KeepOut(parts, np.array([required[pair] for pair in parts.pairs]))

    def distances(self, q: Array, stray: float = 0.0) -> Array:
        """(N, pairs) free distance beyond what is required, m; where it is more than `EXACT` and what the arm may
        stray, m, no more than it is."""
        return np.asarray(self.parts.clearance(q, self.required + EXACT + stray) - self.required)

    def depth(self, q: Array) -> float:
        """Deepest penetration of the arm at postures (N, n), m; negative where it is clear."""
        return -float(self.distances(q).min())

    def gradient(self, q: Array, node: Indices, pair: Indices) -> Array:
        """(r, n) derivatives of the distances at postures q[node] for pairs (r,)."""
        return self.parts.clearance_gradient(q, node, pair)


def safety(parts: ArmGeometry) -> Array:
    """(pairs,) m that are kept free."""
    return np.where(parts.of_floor, Floor.clear, SAFETY)
