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


@dataclass(frozen=True)
class ClearanceOptions:
    """Distances that the optimiser keeps, m, and what it looks at.

    Attributes:
        safety: kept free of every pair of parts but the floor's (`Floor.clear`); doubled, narrow passages close.
        at_nodes: kept beside that at the nodes of a programme, for what may happen between them; doubled, fewer nodes
            are added, and motions pass further from what they go around.
        reach: pairs that are further apart than this and what they must be are left out of a programme; doubled, it has
            more rows, of the kind whose derivatives cost most.
        near: pairs that are nowhere nearer along a path are left out until they are; doubled, more distances are taken.
        touching: depth in something from which on a path cannot be gone along; doubled, more searches begin through
            what is in the way.
        enough_at_ends: beyond what is required, at which an end posture needs no exception; doubled, more ends do.
        kept_at_ends: share of the distance at an end that does need one, that is kept; the arm may deviate into the
            rest. Doubled, motions from narrow places have less room.
        kept_if_little: share of it that is kept where that is hardly more than a verdict takes for touching.
        kept_where_given: the same share of a posture that was given, where the arm stands.
    """

    safety: float = 5e-3
    at_nodes: float = 1e-3
    reach: float = 5e-3
    near: float = 0.05
    touching: float = 5e-3
    enough_at_ends: float = 1.5e-3
    kept_at_ends: float = 0.1
    kept_if_little: float = 0.9
    kept_where_given: float = 0.5

    @property
    def exact(self) -> float:
        """m up to which distances are exact: what comes to within reach from there came far."""
        return 1.5 * self.reach + self.at_nodes


CLEARANCE = ClearanceOptions()
APART = 0.5 * clearance.RESOLUTION + 2 * clearance.EXACT  # m beyond which no verdict takes parts for touching


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
            there = np.maximum(parts.clearance(q).min(axis=0), 0.0)
            required = np.minimum(required, CLEARANCE.kept_where_given * there)
        return cls(parts, required)

    def kept_by(self, ends: Array) -> KeepOut:
        """The pairs with less distance to keep for those that are too near in given end postures (N, n): a tenth of
        what there is, less what the nodes of a programme keep beside it, because the arm may deviate into the rest.
        What a given posture keeps is kept: by that motions are judged that begin there."""
        there = self.parts.clearance(ends).min(axis=0)
        share = np.where(self.required < safety(self.parts), CLEARANCE.kept_where_given, CLEARANCE.kept_at_ends)
        there = np.maximum(there, 0.0)
        kept = np.maximum(share * there, np.minimum(APART, CLEARANCE.kept_if_little * there))
        less = np.minimum(kept - CLEARANCE.at_nodes, self.required)
        return KeepOut(self.parts, np.where(there < self.required + CLEARANCE.enough_at_ends, less, self.required))

    @property
    def least(self) -> Array:
        """(pairs,) m that is kept at every instant: so much that no verdict takes parts for touching."""
        return np.where(self.required < 0.0, np.minimum(APART, self.required + CLEARANCE.at_nodes), self.required)

    def near(self, q: Array) -> KeepOut:
        """Only the pairs that come near at one of the postures (N, n)."""
        parts = self.parts.near(q, CLEARANCE.near)
        required = dict(zip(self.parts.pairs, self.required, strict=True))
        return KeepOut(parts, np.array([required[pair] for pair in parts.pairs]))

    def distances(self, q: Array, stray: float = 0.0) -> Array:
        """(N, pairs) free distance beyond what is required, m; where it is more than `ClearanceOptions.exact` and what
        the arm may stray, m, no more than it is."""
        return np.asarray(self.parts.clearance(q, self.required + CLEARANCE.exact + stray) - self.required)

    def depth(self, q: Array) -> float:
        """Deepest penetration of the arm at postures (N, n), m; negative where it is clear."""
        return -float(self.distances(q).min())

    def gradient(self, q: Array, node: Indices, pair: Indices) -> Array:
        """(r, n) derivatives of the distances at postures q[node] for pairs (r,)."""
        return self.parts.clearance_gradient(q, node, pair)


def safety(parts: ArmGeometry) -> Array:
    """(pairs,) m that are kept free."""
    return np.where(parts.of_floor, Floor.clear, CLEARANCE.safety)
