"""Where the arm is: hulls of its links, the tray, what stands on it; whether they touch one another or an obstacle.

Hulls of the URDF's collision meshes, by Coal. A hull is larger than the link, so a posture that is found free is
free; links that share a joint always touch and are not compared.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import coal
import numpy as np
import pinocchio as pin

from salver.geometry import Array, matrix_from_rpy
from salver.models.arm import ArmModel
from salver.models.bodies import Body

if TYPE_CHECKING:
    from salver import scenario

TRAY = "tray"


@dataclass(frozen=True)
class Touch:
    """Two parts that touch: their names, and the index of the first posture at which they do."""

    first: str
    second: str
    index: int


@dataclass(frozen=True, eq=False)
class ArmGeometry:
    """The arm's hulls, its tray and its load. Not for use by several threads at once.

    names: of the parts: links of the URDF, "tray", carried objects, obstacles.
    pairs: (index, index) into names; those that can touch.
    """

    arm: ArmModel
    model: Any
    data: Any
    names: tuple[str, ...]
    pairs: tuple[tuple[int, int], ...]

    def first_touch(self, q: Array) -> Touch | None:
        """The first of postures (N, n) at which two parts touch, or None."""
        for k, posture in enumerate(q):
            if pin.computeCollisions(self.arm.pin_model, self.arm.data, self.model, self.data, posture, True):
                for result, (i, j) in zip(self.data.collisionResults, self.pairs, strict=True):
                    if result.isCollision():
                        return Touch(self.names[i], self.names[j], k)
        return None

    def clearance(self, q: Array) -> Array:
        """(N, pairs) distance of each pair at postures (N, n), m; negative where they overlap."""
        distances = np.empty((len(q), len(self.pairs)))
        results = list(self.data.distanceResults)  # views of what each call fills; making them takes longer than it
        for k, posture in enumerate(q):
            pin.computeDistances(self.arm.pin_model, self.arm.data, self.model, self.data, posture)
            distances[k] = [result.min_distance for result in results]
        return distances

    def clearance_gradient(self, q: Array) -> tuple[Array, Array]:
        """`clearance` (N, pairs) and its derivative by the joints (N, pairs, n).

        By the velocities of the two nearest points along the normal between them; where those jump (a face
        meets a face) it is one of the one-sided derivatives.
        """
        model, data = self.arm.pin_model, self.arm.data
        distances = self.clearance(q)
        gradient = np.zeros((*distances.shape, self.arm.n))
        joints = [part.parentJoint for part in self.model.geometryObjects]
        for k, posture in enumerate(q):
            pin.computeJointJacobians(model, data, posture)
            pin.updateGeometryPlacements(model, data, self.model, self.data)
            pin.computeDistances(self.model, self.data)
            jacobians = {j: pin.getJointJacobian(model, data, j, pin.LOCAL_WORLD_ALIGNED) for j in set(joints) if j > 0}
            for row, ((i, j), result) in enumerate(zip(self.pairs, self.data.distanceResults, strict=True)):
                ends = (result.getNearestPoint1(), joints[i], -1.0), (result.getNearestPoint2(), joints[j], 1.0)
                for point, joint, sign in ends:
                    if joint > 0:
                        arm_S = point - data.oMi[joint].translation
                        wrench = np.concatenate([result.normal, np.cross(arm_S, result.normal)])
                        gradient[k, row] += sign * wrench @ jacobians[joint]
        return distances, gradient

    def near(self, q: Array, distance: float) -> ArmGeometry:
        """The same parts with only those pairs that come within a distance (m) at one of the postures (N, n)."""
        close = self.clearance(q).min(axis=0) < distance
        return _with_pairs(self, tuple(pair for pair, keep in zip(self.pairs, close, strict=True) if keep))

    def lowest(self, q: Array) -> float:
        """Height over the base (m, the URDF's root) of the lowest point of links beyond the second joint."""
        low = np.inf
        beyond = [k for k, part in enumerate(self.model.geometryObjects) if part.parentJoint >= 2]
        for posture in q:
            pin.updateGeometryPlacements(self.arm.pin_model, self.arm.data, self.model, self.data, posture)
            for k in beyond:
                placement = self.data.oMg[k]
                box = self.model.geometryObjects[k].geometry.aabb_local
                centre, half = 0.5 * (box.min_ + box.max_), 0.5 * (box.max_ - box.min_)
                axis = placement.rotation[2]
                low = min(low, placement.translation[2] + axis @ centre - np.abs(axis) @ half)
        return float(low - self.arm.base_position[2])


@lru_cache(maxsize=1)
def _loader() -> Any:
    """Meshes stay in memory: every plan of a session asks for the same ones."""
    return coal.CachedMeshLoader()


def arm_geometry(
    arm: ArmModel, bodies: Sequence[Body] = (), obstacles: Sequence[scenario.Obstacle] = ()
) -> ArmGeometry:
    """Hulls of an arm's links, its tray, the boxes around what it carries, and what stands around it in the world.

    A link that has no mesh is left out; so are all when a mesh cannot be read.
    """
    model = arm.pin_model
    try:
        parts = pin.buildGeomFromUrdfString(model, arm.urdf, pin.GeometryType.COLLISION, mesh_loader=_loader())
    except (ValueError, RuntimeError):
        parts = pin.GeometryModel()
    for part in parts.geometryObjects:
        if isinstance(part.geometry, coal.BVHModelBase):
            part.geometry.buildConvexHull(True, "Qt")
            part.geometry = part.geometry.convex
    links = [model.frames[part.parentFrame].name for part in parts.geometryObjects]

    frame = model.frames[arm.tray_id]
    thickness = 2 * float(arm.p_FE[2] - arm.tray_com_F[2])
    _add_box(parts, TRAY, frame, np.array([0, 0, -0.5 * thickness]), np.eye(3), np.array([*arm.tray_size, thickness]))
    for body in bodies:
        points = body.solid.bounding_points_G - body.com_G
        low, high = points.min(axis=0), points.max(axis=0)
        centre = body.p_EB + body.R_EB @ (0.5 * (low + high))
        _add_box(parts, body.name, frame, centre, body.R_EB, high - low)
    for obstacle in obstacles:
        placement = pin.SE3(matrix_from_rpy(np.deg2rad(obstacle.rpy_deg)), np.array(obstacle.position))
        parts.addGeometryObject(pin.GeometryObject(obstacle.name, 0, placement, _obstacle_shape(obstacle)))
    for part in parts.geometryObjects:
        part.geometry.computeLocalAABB()

    fixed = len(parts.geometryObjects) - len(obstacles)
    joints = [part.parentJoint for part in parts.geometryObjects]
    pairs = [
        (i, j)
        for j, second in enumerate(joints)
        for i, first in enumerate(joints[:j])
        if first != second and (j >= fixed or (first != model.parents[second] and second != model.parents[first]))
    ]
    names = (*links, TRAY, *(body.name for body in bodies), *(obstacle.name for obstacle in obstacles))
    return _with_pairs(ArmGeometry(arm, parts, None, names, ()), tuple(pairs))


def _with_pairs(parts: ArmGeometry, pairs: tuple[tuple[int, int], ...]) -> ArmGeometry:
    model = parts.model.copy()
    model.removeAllCollisionPairs()
    for i, j in pairs:
        model.addCollisionPair(pin.CollisionPair(i, j))
    return replace(parts, model=model, data=model.createData(), pairs=pairs)


def _obstacle_shape(obstacle: scenario.Obstacle) -> Any:
    if obstacle.type == "box":
        return coal.Box(*(obstacle.size or (0.0, 0.0, 0.0)))
    if obstacle.type == "sphere":
        return coal.Sphere(obstacle.radius or 0.0)
    return coal.Capsule(obstacle.radius or 0.0, obstacle.length or 0.0)


def _add_box(parts: Any, name: str, frame: Any, centre: Array, rotation: Array, size: Array) -> None:
    placement = frame.placement * pin.SE3(rotation, centre)
    parts.addGeometryObject(pin.GeometryObject(name, frame.parentJoint, placement, coal.Box(*size)))
