"""What moves around the arm: where it is predicted to be, and rows that keep arm, tray and load clear of it in time.

A prediction is believed for a while, with an uncertainty that grows. A motion is clear when, at each of its instants
and then at rest for as long as the prediction lasts, no part of the arm that can move is nearer than is required.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import coal
import numpy as np
import numpy.typing as npt
import pinocchio as pin

from salver.errors import Status
from salver.geometry import Array, Indices
from salver.live import wishes
from salver.models.arm_geometry import ArmGeometry
from salver.planning.fastest import Block, Constraint, Evaluation, padded
from salver.planning.fastest.constraints import PER_METRE, strayed
from salver.planning.fastest.obstacles import SAFETY

FAR = 0.15  # m from which on distances are those of bounding spheres: no larger than the true ones
AT_NODES = 5e-3  # m more that a programme keeps at its nodes
REST_STEP = 5e-3  # s between looks at the arm at rest
MOST_SPEED, MOST_SIZE = 50.0, 10.0  # m/s, m: what is beyond is in another unit
LONGEST_PREDICTION = 10.0  # s


@dataclass(frozen=True, eq=False)
class Moving:
    """Something that moves, as it is seen now; S is the world.

    type: "sphere" (radius, m), "capsule" (radius; length of its axis, m, along z) or "box" (size (3,), m). rotation:
    (3, 3), kept while it moves. position (3,), m; velocity, m/s, and acceleration, m/s^2 (of a thrown ball (0, 0,
    -9.81)), from now on. samples: in place of these, times (K,), s from now, and positions (K, 3); linear between them,
    held after the last. uncertainty: m by which it may be elsewhere now; growth: m/s by which that grows. lasts: s for
    which all this is believed; what is not seen again by then counts as gone.
    """

    name: str
    type: Literal["sphere", "capsule", "box"]
    position: npt.ArrayLike = (0.0, 0.0, 0.0)
    velocity: npt.ArrayLike = (0.0, 0.0, 0.0)
    acceleration: npt.ArrayLike = (0.0, 0.0, 0.0)
    radius: float = 0.0
    length: float = 0.0
    size: npt.ArrayLike = (0.0, 0.0, 0.0)
    rotation: npt.ArrayLike = field(default_factory=lambda: np.eye(3))
    samples: tuple[npt.ArrayLike, npt.ArrayLike] | None = None
    uncertainty: float = 0.01
    growth: float = 0.1
    lasts: float = 1.5


def predicted(seen: Moving, now: float) -> Predicted | Status:
    """What is predicted at live time `now`, s, or why nothing can be."""

    def refused(what: str) -> Status:
        return Status("refused", f"{what} of the obstacle {seen.name}", False)

    def numbers(value: Any, shape: tuple[int, ...], most: float) -> Array | None:
        array = wishes.numbers(value, shape, "")
        return None if isinstance(array, Status) or np.abs(array).max(initial=0.0) > most else array

    ends = {
        "position": (seen.position, (3,), 1e3),
        "velocity": (seen.velocity, (3,), MOST_SPEED),
        "acceleration": (seen.acceleration, (3,), 1e3),
        "radius": (seen.radius, (), MOST_SIZE),
        "length": (seen.length, (), MOST_SIZE),
        "size": (seen.size, (3,), MOST_SIZE),
        "rotation": (seen.rotation, (3, 3), 2.0),
        "uncertainty": (seen.uncertainty, (), MOST_SIZE),
        "growth": (seen.growth, (), MOST_SPEED),
        "lasts": (seen.lasts, (), LONGEST_PREDICTION),
    }
    found: dict[str, Array] = {}
    for name, (value, shape, most) in ends.items():
        array = numbers(value, shape, most)
        if array is None:
            of = f"{shape} finite numbers" if shape else "a finite number"
            return refused(f"{name} must be {of}, at most {most:g}: the {name}")
        found[name] = array
    for name in ("radius", "length", "size", "uncertainty", "growth", "lasts"):
        if np.any(found[name] < 0):
            return refused(f"{name} must not be negative: the {name}")
    solid: Any
    if seen.type == "box" and np.all(found["size"] > 0):
        solid = coal.Box(*found["size"])
    elif seen.type == "sphere" and found["radius"] > 0:
        solid = coal.Sphere(float(found["radius"]))
    elif seen.type == "capsule" and found["radius"] > 0:
        solid = coal.Capsule(float(found["radius"]), float(found["length"]))
    else:
        return refused("type must be sphere or capsule with a radius, or box with a size, above 0: the type")
    R = found["rotation"]
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-6 or np.linalg.det(R) < 0:
        return refused("rotation must be orthonormal and right-handed: the rotation")
    powers = np.stack([found["position"], found["velocity"], 0.5 * found["acceleration"]])
    samples = None
    given: Any = seen.samples
    if given is not None:
        several = isinstance(given, tuple) and len(given) == 2 and isinstance(given[0], Sequence | np.ndarray)
        if not several or not getattr(given[0], "ndim", 1):
            return refused("samples must be times and positions: the samples")
        count = len(given[0])
        t, p = numbers(given[0], (count,), 1e3), numbers(given[1], (count, 3), 1e3)
        if t is None or p is None or not count or np.any(np.diff(t) <= 0):
            return refused("samples must be increasing times and as many positions, finite numbers: the samples")
        fastest = float((np.linalg.norm(np.diff(p, axis=0), axis=1) / np.diff(t)).max(initial=0.0))
        if fastest > MOST_SPEED:
            return refused(
                f"samples must not move at more than {MOST_SPEED:g} m/s (they do at {fastest:.3g}): the samples"
            )
        samples = (now + t, p)
    solid.computeLocalAABB()
    sure, grows, lasts = (float(found[name]) for name in ("uncertainty", "growth", "lasts"))
    return Predicted(seen.name, solid, R, now, powers, samples, sure, grows, now + lasts)


@dataclass(frozen=True, eq=False)
class Predicted:
    """Where something is at live times: powers (3, 3) of the time since t0, or samples. Believed until `until`, s."""

    name: str
    shape: Any
    R: Array
    t0: float
    powers: Array
    samples: tuple[Array, Array] | None
    uncertainty: float
    growth: float
    until: float

    def __reduce__(self) -> Any:  # Coal's shapes do not travel as parts of others
        shape = self.shape
        kind = type(shape).__name__
        size = {"Sphere": lambda: (shape.radius,), "Capsule": lambda: (shape.radius, 2 * shape.halfLength)}
        made = (kind, size[kind]() if kind in size else tuple(2 * shape.halfSide))
        rest = (self.R, self.t0, self.powers, self.samples, self.uncertainty, self.growth, self.until)
        return _restored, (self.name, made, rest)

    def at(self, t: Array) -> tuple[Array, Array]:
        """(N, 3) positions and velocities at live times (N,)."""
        if self.samples is None:
            u = (t - self.t0)[:, None]
            p, v, a = self.powers
            return p + u * v + u**2 * a, v + 2 * u * a
        times, positions = self.samples
        where = np.stack([np.interp(t, times, column) for column in positions.T], axis=1)
        if len(times) == 1:
            return where, np.zeros_like(where)
        k = np.clip(np.searchsorted(times, t, side="right") - 1, 0, len(times) - 2)
        slope = (np.diff(positions, axis=0) / np.diff(times)[:, None])[k]
        slope[(t < times[0]) | (t > times[-1])] = 0.0
        return where, slope

    def around(self, t: Array) -> Array:
        """(N,) m by which it may be elsewhere at live times."""
        return self.uncertainty + self.growth * np.maximum(t - self.t0, 0.0)


def _restored(name: str, made: tuple[str, tuple[float, ...]], rest: tuple[Any, ...]) -> Predicted:
    shape = {"Sphere": coal.Sphere, "Capsule": coal.Capsule, "Box": coal.Box}[made[0]](*made[1])
    shape.computeLocalAABB()
    return Predicted(name, shape, *rest)


@dataclass(frozen=True, eq=False)
class Passing(Constraint):
    """Rows of a motion whose time 0 is live time `begins`, s: clear of what is predicted to pass.

    parts: of the arm; its base, which cannot move out of the way, is left out.
    """

    parts: ArmGeometry
    obstacles: tuple[Predicted, ...]
    begins: float

    @cached_property
    def _movable(self) -> Indices:
        joints = [part.parentJoint for part in self.parts.model.geometryObjects]
        mine = len(self.parts.names) - self.parts.obstacles
        return np.array([k for k in range(mine) if joints[k] > 1], dtype=np.intp)

    @cached_property
    def _bounds(self) -> tuple[Array, Array]:
        """Of each movable part: centre of a bounding sphere in its own frame, and its radius."""
        shapes = [self.parts.model.geometryObjects[int(k)].geometry for k in self._movable]
        return np.array([s.aabb_center for s in shapes]), np.array([float(s.aabb_radius) for s in shapes])

    @cached_property
    def _levers(self) -> Array:
        """(M, n) at most how far a part moves when a joint moves by 1."""
        arm, model = self.parts.arm, self.parts.arm.pin_model
        (centres, radii), links = self._bounds, [np.linalg.norm(x.translation) for x in model.jointPlacements]
        levers = np.zeros((len(radii), arm.n))
        for row, k in enumerate(self._movable):
            part = self.parts.model.geometryObjects[int(k)]
            length = float(np.linalg.norm(part.placement.act(centres[row]))) + radii[row]
            for joint in reversed(list(model.supports[part.parentJoint])[1:]):
                levers[row, joint - 1] = 1.0 if arm.linear[joint - 1] else length
                length += float(links[joint])
        return levers

    def blocks(self, motion: Evaluation) -> Iterator[Block]:
        q, dq = motion.at_nodes[:2]
        t = motion.s[motion.nodes] * motion.duration
        stray = np.zeros(len(t))
        if motion.response is not None:
            stray = strayed(*motion.tray_radius())
        steps = np.pad(np.diff(t), 1)
        longest = 0.5 * np.maximum(steps[:-1], steps[1:])  # half of the time to the next look
        rest = np.arange(t[-1], max(t[-1], max(x.until for x in self.obstacles) - self.begins) + REST_STEP, REST_STEP)
        for obstacle in self.obstacles:
            p, v = obstacle.at(self.begins + t)
            speed = np.linalg.norm(v, axis=1) + obstacle.growth
            free = self.distances(q, obstacle, p) - (SAFETY + obstacle.around(self.begins + t) + stray)[:, None]
            if not motion.imposed:  # what both may go until the next look
                free -= longest[:, None] * (speed[:, None] + np.abs(dq) @ self._levers.T)
            free[self.begins + t > obstacle.until] = FAR

            def gradient(i: Indices, f: Indices, obstacle: Predicted = obstacle, p: Array = p) -> Array:
                return padded(-PER_METRE * self._slopes(q, p, obstacle, i, f)[0], motion.n)

            def by_duration(obstacle: Predicted = obstacle, p: Array = p, v: Array = v, free: Array = free) -> Array:
                out = np.zeros_like(free)
                i, f = np.nonzero(free < 0.5 * FAR)
                normal = self._slopes(q, p, obstacle, i, f)[1]
                out[i, f] = -PER_METRE * t[i] * (np.einsum("ri,ri->r", normal, v[i]) - obstacle.growth)
                return out

            name, margins = f"clearance of {obstacle.name}", (PER_METRE * AT_NODES, 0.0)
            yield Block(
                name,
                -PER_METRE * free,
                gradient,
                motion.nodes,
                margins,
                scales=False,
                by_duration=by_duration() if motion.imposed else None,
                reach=PER_METRE * 0.5 * FAR,
                most=2,
                kinked=True,
                inherits=False,
            )
            # At rest, until nothing is known any more.
            late, _ = obstacle.at(self.begins + rest)
            faster = np.linalg.norm(obstacle.at(self.begins + rest)[1], axis=1) + obstacle.growth
            kept = SAFETY + obstacle.around(self.begins + rest) + stray[-1] + 0.5 * REST_STEP * faster
            there = self.distances(np.repeat(q[-1:], len(rest), axis=0), obstacle, late) - kept[:, None]
            there[self.begins + rest > obstacle.until] = FAR
            worst = np.argmin(there, axis=0)

            def at_rest(
                i: Indices, f: Indices, obstacle: Predicted = obstacle, late: Array = late, k: Indices = worst
            ) -> Array:
                postures = np.repeat(q[-1:], len(late), axis=0)
                return padded(-PER_METRE * self._slopes(postures, late, obstacle, k[f], f)[0], motion.n)

            yield Block(
                f"rest clear of {obstacle.name}",
                -PER_METRE * there[worst, np.arange(there.shape[1])][None],
                at_rest,
                motion.nodes[-1:],
                margins,
                scales=False,
                reach=PER_METRE * 0.5 * FAR,
                most=2,
                kinked=True,
                inherits=False,
            )

    def distances(self, q: Array, obstacle: Predicted, p: Array) -> Array:
        """(N, M) of the movable parts at postures (N, n) from an obstacle at p (N, 3), m; beyond `FAR` no larger than
        the true ones."""
        (centres, radii), shape = self._bounds, obstacle.shape
        away = float(np.linalg.norm(shape.aabb_center)) + float(shape.aabb_radius)
        out = np.empty((len(q), len(radii)))
        request, result = coal.DistanceRequest(), coal.DistanceResult()
        for k, there in enumerate(p):
            if k == 0 or np.any(q[k] != q[k - 1]):
                placed = self._placed(q[k])
                middle = np.array([x.act(c) for x, c in zip(placed, centres, strict=True)])
            out[k] = np.linalg.norm(middle - there, axis=1) - radii - away
            for row in np.flatnonzero(out[k] < FAR):
                out[k, row] = self._distance(placed[row], int(row), obstacle, there, request, result)
        return out

    def _placed(self, q: Array) -> list[Any]:
        parts = self.parts
        pin.updateGeometryPlacements(parts.arm.pin_model, parts.arm.data, parts.model, parts.data, q)
        return [pin.SE3(parts.data.oMg[int(k)]) for k in self._movable]

    def _distance(self, placed: Any, row: int, obstacle: Predicted, p: Array, request: Any, result: Any) -> float:
        result.clear()
        part = self.parts.model.geometryObjects[int(self._movable[row])].geometry
        here, there = coal.Transform3s(placed.rotation, placed.translation), coal.Transform3s(obstacle.R, p)
        return float(coal.distance(part, here, obstacle.shape, there, request, result))

    def _slopes(self, q: Array, p: Array, obstacle: Predicted, node: Indices, part: Indices) -> tuple[Array, Array]:
        """(r, n) derivatives of distances by the joints, and the normals (r, 3) towards the obstacle."""
        arm, model = self.parts.arm, self.parts.arm.pin_model
        slopes, normals = np.zeros((len(node), arm.n)), np.zeros((len(node), 3))
        request, result = coal.DistanceRequest(), coal.DistanceResult()
        for k in np.unique(node):
            pin.computeJointJacobians(model, arm.data, q[k])
            placed = self._placed(q[k])
            for r in np.flatnonzero(node == k):
                row = int(part[r])
                self._distance(placed[row], row, obstacle, p[k], request, result)
                normal, at = result.normal, result.getNearestPoint1()
                joint = self.parts.model.geometryObjects[int(self._movable[row])].parentJoint
                moved = pin.getJointJacobian(model, arm.data, joint, pin.LOCAL_WORLD_ALIGNED)
                lever = at - arm.data.oMi[joint].translation
                slopes[r] = -(normal @ moved[:3] + np.cross(lever, normal) @ moved[3:])
                normals[r] = normal
        return slopes, normals


def nearest(parts: ArmGeometry, obstacles: Sequence[Predicted], q: Array, t: Array) -> tuple[float, float, str]:
    """How near a motion through postures (N, n) at live times (N,) comes to what is predicted, beyond its uncertainty:
    m, when, and to which."""
    found = (np.inf, 0.0, "")
    for obstacle in obstacles:
        believed = t <= obstacle.until
        if not believed.any():
            continue
        passing = Passing(parts, (obstacle,), 0.0)
        free = passing.distances(q[believed], obstacle, obstacle.at(t[believed])[0]).min(axis=1)
        free = free - obstacle.around(t[believed])
        k = int(np.argmin(free))
        found = min(found, (float(free[k]), float(t[believed][k]), obstacle.name))
    return found
