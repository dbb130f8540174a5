"""Clearance of arm, tray and load from each other and from obstacles, for the optimiser.

Distances of convex hulls are computed by Coal (`salver.models.arm.arm_geometry`); derivatives only for the few pairs
and postures that are close.
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
    """Distances that the optimiser requires, m.

    Attributes:
        safety: required between parts, except from the floor (`Floor.clear`); doubled, narrow passages close.
        at_nodes: additional distance at the nodes of a programme, for the motion between them; doubled, fewer nodes are
            added, and motions pass further from obstacles.
        reach: a programme leaves out pairs that are further than this beyond the required distance; doubled, it has
            more rows, whose derivatives are expensive.
        near: pairs that are further apart all along a path are left out; doubled, more distances are computed.
        touching: penetration above which a path counts as colliding; doubled, more searches begin on paths through
            obstacles.
        enough_at_ends: distance beyond the required one with which an end posture needs no exception.
        kept_at_ends: share of the distance in an end posture that is required after an exception; tracking error may
            use up the rest. Doubled, motions from narrow places have less space.
        kept_if_little: the same share where the distance is hardly more than a verdict reports as a collision.
        kept_where_given: the same share for a given start posture.
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
        """Distance beyond the required one, m, up to which distances are exact."""
        return 1.5 * self.reach + self.at_nodes


CLEARANCE = ClearanceOptions()
APART = 0.5 * clearance.RESOLUTION + 2 * clearance.EXACT  # m, least distance that no verdict reports as a collision


@dataclass(frozen=True, eq=False)
class KeepOut:
    """Pairs of parts that must keep a distance. parts: geometry with these pairs. required: (pairs,) at the nodes of a
    programme, m; where it is negative, `least` holds at every instant all the same."""

    parts: ArmGeometry
    required: Array

    @classmethod
    def of(cls, parts: ArmGeometry, q: Array | None) -> KeepOut:
        """All pairs, with `safety` as the required distance; less for a pair that is closer in given postures (N, n): a
        share of that distance."""
        required = safety(parts)
        if q is not None:
            there = np.maximum(parts.clearance(q).min(axis=0), 0.0)
            required = np.minimum(required, CLEARANCE.kept_where_given * there)
        return cls(parts, required)

    def kept_by(self, ends: Array, stray: Array) -> KeepOut:
        """The pairs with a smaller required distance where end postures (N, n) are closer than required: a tenth of the
        distance there, because tracking error may use up the rest; and with what the tracking error at rest there,
        stray (N,), m, leaves of the distance, where nodes could not keep more. Exceptions for a given start posture
        stay, because motions that begin there are judged by them."""
        free = self.parts.clearance(ends)
        there = free.min(axis=0)
        share = np.where(self.required < safety(self.parts), CLEARANCE.kept_where_given, CLEARANCE.kept_at_ends)
        there = np.maximum(there, 0.0)
        kept = np.maximum(share * there, np.minimum(APART, CLEARANCE.kept_if_little * there))
        less = np.minimum(kept - CLEARANCE.at_nodes, self.required)
        left = (free - stray[:, None]).min(axis=0) - CLEARANCE.at_nodes
        enough = there >= self.required + CLEARANCE.enough_at_ends
        return KeepOut(self.parts, np.where(enough, np.clip(left, less, self.required), less))

    @property
    def least(self) -> Array:
        """Distance (pairs,), m, that holds at every instant: enough that no verdict reports a collision."""
        return np.where(self.required < 0.0, np.minimum(APART, self.required + CLEARANCE.at_nodes), self.required)

    def near(self, q: Array) -> KeepOut:
        """Only the pairs that are close in one of the postures (N, n)."""
        parts = self.parts.near(q, CLEARANCE.near)
        required = dict(zip(self.parts.pairs, self.required, strict=True))
        return KeepOut(parts, np.array([required[pair] for pair in parts.pairs]))

    def distances(self, q: Array, stray: float = 0.0) -> Array:
        """Distances (N, pairs) beyond the required ones, m; above `ClearanceOptions.exact` plus the tracking error
        `stray`, m, only lower bounds."""
        return np.asarray(self.parts.clearance(q, self.required + CLEARANCE.exact + stray) - self.required)

    def depth(self, q: Array) -> float:
        """Largest violation of a required distance in postures (N, n), m; negative where there is none."""
        return -float(self.distances(q).min())

    def gradient(self, q: Array, node: Indices, pair: Indices) -> Array:
        """Derivatives (r, n) of the distances in postures q[node] for pairs (r,)."""
        return self.parts.clearance_gradient(q, node, pair)


def safety(parts: ArmGeometry) -> Array:
    """The standard required distance (pairs,), m."""
    return np.where(parts.of_floor, Floor.clear, CLEARANCE.safety)
