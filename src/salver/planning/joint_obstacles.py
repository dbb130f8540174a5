"""Clearance of arm, tray and load from one another and from obstacles, for the optimiser.

Distances between convex hulls by Coal (`salver.models.arm_geometry`). They are cheap; derivatives are taken only
for the few pairs and postures that are near.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pinocchio as pin

from salver.geometry import Array
from salver.models.arm_geometry import ArmGeometry

SAFETY = 5e-3  # m that are kept free
NEAR = 0.2  # m; pairs that are nowhere nearer along a path are left out until they are


@dataclass(frozen=True, eq=False)
class KeepOut:
    """parts: geometry with the pairs that are watched. required: (pairs,) distance to keep, m."""

    parts: ArmGeometry
    required: Array

    @classmethod
    def of(cls, parts: ArmGeometry, q_start: Array | None) -> KeepOut:
        """All pairs; one that is nearer than `SAFETY` at the start has to keep half of that distance."""
        required = np.full(len(parts.pairs), SAFETY)
        if q_start is not None:
            required = np.minimum(required, 0.5 * np.maximum(parts.clearance(q_start[None])[0], 0.0))
        return cls(parts, required)

    def near(self, q: Array) -> KeepOut:
        """Only the pairs that come near at one of the postures (N, n)."""
        parts = self.parts.near(q, NEAR)
        required = dict(zip(self.parts.pairs, self.required, strict=True))
        return KeepOut(parts, np.array([required[pair] for pair in parts.pairs]))

    def distances(self, q: Array) -> Array:
        """(N, pairs) free distance beyond what is required, m."""
        return np.asarray(self.parts.clearance(q) - self.required)

    def gradient(self, q: Array, node: npt.NDArray[np.intp], pair: npt.NDArray[np.intp]) -> Array:
        """(r, n) derivatives of the distances at postures q[node] for pairs (r,)."""
        geometry, arm = self.parts, self.parts.arm
        joints = [part.parentJoint for part in geometry.model.geometryObjects]
        rows = np.zeros((len(node), arm.n))
        for k in np.unique(node):
            pin.computeJointJacobians(arm.pin_model, arm.data, q[k])
            pin.updateGeometryPlacements(arm.pin_model, arm.data, geometry.model, geometry.data)
            for r in np.flatnonzero(node == k):
                pin.computeDistance(geometry.model, geometry.data, int(pair[r]))
                result = geometry.data.distanceResults[int(pair[r])]
                i, j = geometry.pairs[pair[r]]
                normal = np.asarray(result.normal)
                for point, joint, sign in (
                    (result.getNearestPoint1(), joints[i], -1.0),
                    (result.getNearestPoint2(), joints[j], 1.0),
                ):
                    if joint > 0:
                        jacobian = pin.getJointJacobian(arm.pin_model, arm.data, joint, pin.LOCAL_WORLD_ALIGNED)
                        moment = np.cross(point - arm.data.oMi[joint].translation, normal)
                        rows[r] += sign * (normal @ jacobian[:3] + moment @ jacobian[3:])
        return rows
