"""Collision-free paths around obstacles, by RRT-Connect.

Two trees, from the start and from the goal postures, grow in steps towards random postures and then towards each other
(RRT-Connect: Kuffner and LaValle, ICRA 2000). Each posture is projected to one within the tilt limit of the tray
(Berenson, Srinivasa, Ferguson, Kuffner, ICRA 2009). Effort is limited by the number of postures checked, not
by time, so the same random generator gives the same path on any computer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import pinocchio as pin

from salver.geometry import Array
from salver.models.arm.arm_geometry import ArmGeometry
from salver.planning.trajopt.problem import TransportProblem


@dataclass(eq=False)
class FreeSpace:
    """Free postures: without collision, within the joint limits and with a tilt of the tray of at most `lean`, rad.

    parts: geometry with the distances to keep, set for this space. looks: number of postures that may still be checked.
    corrections: Newton steps at most, of projecting a posture to the tilt limit. step: rad, or m for a prismatic joint,
    from one posture to the next; doubled, thin obstacles are passed through. level: rad, tilt up to which a tray counts
    as level.
    """

    problem: TransportProblem
    parts: ArmGeometry | None
    lean: float
    looks: int
    corrections: int = 6
    step: float = 0.1
    level: float = 5e-4

    @classmethod
    def between(cls, problem: TransportProblem, ends: Array, looks: int) -> FreeSpace:
        """The free space for paths between end postures (N, n), rad."""
        up = [problem.arm.tray_pose(q)[1][2, 2] for q in ends]
        lean = cls.level + max(0.0, *(float(np.arccos(np.clip(x, -1.0, 1.0))) for x in up))
        if problem.keep_out is None:
            return cls(problem, None, lean, looks)
        parts, required = problem.keep_out.parts, problem.keep_out.required
        least = parts.clearance(ends).min(axis=0)
        room = 0.01  # m: distance beyond the required one that a path keeps if its ends do
        kept = np.where(required < least, np.maximum(0.9 * least, required), 0.9 * least)  # at the ends, too
        apart = np.minimum(required + room, kept)
        parts = parts.only(range(len(parts.pairs)))
        for request, distance in zip(parts.data.collisionRequests, apart, strict=True):
            request.security_margin = float(distance)
        return cls(problem, parts, lean, looks)

    def nearest(self, q: Array) -> Array | None:
        """q (n,), projected to the tilt limit if necessary; None when the result is not free."""
        self.looks -= 1
        limits = self.problem.limits
        upright = self._upright(q)
        if upright is None or np.any(upright < limits.q_min) or np.any(upright > limits.q_max):
            return None
        parts = self.parts
        if parts is not None and pin.computeCollisions(
            parts.arm.pin_model, parts.arm.data, parts.model, parts.data, upright, True
        ):
            return None
        return upright

    def _upright(self, q: Array) -> Array | None:
        arm = self.problem.arm
        model, data = arm.pin_model, arm.data
        for _ in range(self.corrections):
            pin.computeJointJacobians(model, data, q)
            rotation = pin.updateFramePlacement(model, data, arm.tray_id).rotation
            if rotation[2, 2] >= np.cos(self.lean):
                return q
            turning = pin.getFrameJacobian(model, data, arm.tray_id, pin.LOCAL)[3:]
            up = rotation[2]  # the vertical, in E; a turn w of the tray changes it by up x w
            slope = np.array([[0.0, -up[2], up[1]], [up[2], 0.0, -up[0]]]) @ turning
            (a, b), (_, d) = slope @ slope.T
            a, d = a + 1e-6, d + 1e-6  # damped where the arm is singular
            q = q - np.array([d * up[0] - b * up[1], a * up[1] - b * up[0]]) / (a * d - b * b) @ slope
        return None

    def towards(self, q: Array, target: Array) -> list[Array]:
        """Free postures in steps from q (not included) towards a target, which is the last one if it was reached."""
        found: list[Array] = []
        away = float(np.linalg.norm(target - q))
        while away > 1e-9 and self.looks > 0:
            new = self.nearest(q + (target - q) * min(1.0, self.step / away))
            if new is None or np.linalg.norm(new - q) > 3 * self.step:
                break
            left = float(np.linalg.norm(target - new))
            if left > away - 0.2 * min(self.step, away):
                break
            found.append(new)
            q, away = new, left
        return found


@dataclass(eq=False)
class _Tree:
    """A search tree. nodes: (N, n), in an array with space for more. parents: index of each node's parent, -1 at a
    root."""

    nodes: Array
    parents: list[int] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.parents = [-1] * len(self.nodes)

    def nearest(self, q: Array) -> int:
        return int(np.argmin(np.square(self.nodes[: len(self.parents)] - q).sum(axis=1)))

    def grow(self, space: FreeSpace, target: Array) -> int:
        """Grow from the nearest node towards a target; returns the index of the last node."""
        at = self.nearest(target)
        for q in space.towards(self.nodes[at], target):
            count = len(self.parents)
            if count == len(self.nodes):
                self.nodes = np.concatenate([self.nodes, np.empty_like(self.nodes)])
            self.nodes[count] = q
            self.parents.append(at)
            at = count
        return at

    def way(self, node: int) -> list[Array]:
        """The path from a root to a node."""
        found = []
        while node >= 0:
            found.append(self.nodes[node])
            node = self.parents[node]
        return found[::-1]


def way_around(
    problem: TransportProblem, starts: Sequence[Array], goals: Sequence[Array], rng: np.random.Generator, looks: int
) -> Array | None:
    """A collision-free path (N, n) from one of the starts to one of the goals, (n,) each; None when none was found.

    looks: number of postures checked, at most.
    """
    ends = np.array([*starts, *goals])
    space = FreeSpace.between(problem, ends, looks)
    starts = [q for q in starts if space.nearest(q) is not None]
    goals = [q for q in goals if space.nearest(q) is not None]
    if not starts or not goals:
        return None
    limits = problem.limits
    wide_low, wide_high = np.maximum(limits.q_min, ends.min(0) - np.pi), np.minimum(limits.q_max, ends.max(0) + np.pi)
    # Samples are mostly within 1 rad of the range between the ends; three in ten are within half a turn.
    near_low, near_high = np.maximum(wide_low, ends.min(0) - 1.0), np.minimum(wide_high, ends.max(0) + 1.0)
    trees = [_Tree(np.array(starts)), _Tree(np.array(goals))]
    meeting: tuple[int, int] | None = None
    turn = 0
    target = goals[int(rng.integers(len(goals)))]  # the first target is a goal
    while space.looks > 0 and meeting is None:
        one, other = trees[turn], trees[1 - turn]
        at = one.grow(space, target)
        met = other.grow(space, one.nodes[at])
        if np.linalg.norm(other.nodes[met] - one.nodes[at]) < 1e-9:
            meeting = (at, met) if turn == 0 else (met, at)
        turn = 1 - turn
        wide = rng.random() < 0.3
        low, high = (wide_low, wide_high) if wide else (near_low, near_high)
        target = rng.uniform(low, high)
    if meeting is None:
        return None
    return np.array(trees[0].way(meeting[0]) + trees[1].way(meeting[1])[-2::-1])
