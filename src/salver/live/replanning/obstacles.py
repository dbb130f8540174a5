"""Moving obstacles: their prediction, and constraints that keep arm, tray and load clear of them in time.

A prediction is believed for a while, with an uncertainty that grows. A motion is clear when, at each of its instants
and then at rest for as long as the prediction lasts, no part of the arm that can move is nearer than is required.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any, Literal

import coal
import numpy as np
import numpy.typing as npt
import pinocchio as pin

from salver.geometry import Array, Indices, interpolated
from salver.live.replanning import wishes
from salver.live.replanning.wishes import Refused
from salver.models.arm.arm_geometry import ArmGeometry
from salver.planning.fastest import Block, Constraint, MotionEvaluation, padded
from salver.planning.trajopt.constraints.constraints import PER_METRE, mm_of_distance, strayed
from salver.planning.trajopt.constraints.obstacles import CLEARANCE


@dataclass(frozen=True)
class ObstacleOptions:
    """Limits of a moving obstacle that is accepted.

    Attributes:
        speed, size: m/s and m; beyond that a number is taken to be in another unit, and refused.
        lasts: s, the longest prediction.
        ahead: s by which its time stamp `seen` may be ahead of the loop's clock.
    """

    speed: float = 50.0
    size: float = 10.0
    lasts: float = 10.0
    ahead: float = 0.05


STANDARD = ObstacleOptions()
SAME = 1e-9  # m: rounding


@dataclass(frozen=True, eq=False)
class Moving:
    """A moving obstacle as it is seen now; S is the world.

    type: "sphere" (radius, m), "capsule" (radius; length of its axis, m, along z) or "box" (size (3,), m). rotation:
    (3, 3), kept while it moves. seen: time of the observation on the clock of `Live.command`, s; default: the time of
    the report. position (3,): m in S at that time; velocity, m/s, and acceleration, m/s^2, from that time on (a thrown
    ball has (0, 0, -9.81)). samples: in place of these, times (K,), s after `seen`, and positions (K, 3), m in S;
    linear between them, held after the last. uncertainty: m, error of the position at `seen`; growth: m/s by which it
    grows. lasts: s for which the prediction holds; an obstacle that is not seen again by then counts as gone.
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
    seen: float | None = None


def predicted(seen: Moving, now: float, clock: float | None = None, options: ObstacleOptions = STANDARD) -> Predicted:
    """Predictions at live time `now`, s, when the loop's clock is at `clock`, s. Raises Refused for an impossible
    obstacle."""

    def refused(key: str, must: str) -> Refused:
        return Refused(f"{key} of the obstacle {seen.name} must {must}")

    def numbers(key: str, value: Any, shape: tuple[int, ...], most: float, must: str) -> Array:
        with contextlib.suppress(Refused):
            array = wishes.numbers(value, shape, "")
            if np.abs(array).max(initial=0.0) <= most:
                return array
        raise refused(key, must)

    found: dict[str, Array] = {}
    for names, shape, most in (
        (("position", "acceleration"), (3,), 1e3),
        (("velocity",), (3,), options.speed),
        (("rotation",), (3, 3), 2.0),
        (("size",), (3,), options.size),
        (("radius", "length", "uncertainty"), (), options.size),
        (("growth",), (), options.speed),
        (("lasts",), (), options.lasts),
    ):
        for name in names:
            of = f"{' x '.join(map(str, shape))} finite numbers" if shape else "a finite number"
            found[name] = numbers(name, getattr(seen, name), shape, most, f"be {of}, at most {most:g}")
            if (not shape or name == "size") and np.any(found[name] < 0):
                raise refused(name, "not be negative")
    radius, size = float(found["radius"]), tuple(map(float, found["size"]))
    kind = seen.type if isinstance(seen.type, str) else ""
    if kind == "box" and min(size) > 0:
        solid: tuple[Any, ...] = (kind, *size)
    elif kind in ("sphere", "capsule") and radius > 0:
        solid = (kind, radius, *([float(found["length"])] if kind == "capsule" else []))
    else:
        raise refused("type", "be sphere or capsule with a radius above 0, or box with a size above 0")
    R = found["rotation"]
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-6 or np.linalg.det(R) < 0:
        raise refused("rotation", "be orthonormal and right-handed")
    powers = np.stack([found["position"], found["velocity"], 0.5 * found["acceleration"]])
    late = 0.0  # s, since when it was seen
    if seen.seen is not None:
        when = numbers("seen", seen.seen, (), np.inf, "be a time on the clock of the loop, s")
        ahead = float(when) - (now if clock is None else clock)
        if ahead > options.ahead:
            raise refused("seen", f"not be later than the loop's clock (it is by {ahead:.3g} s)")
        late = max(-ahead, 0.0)
    samples = None
    given: Any = seen.samples
    if given is not None:
        several = isinstance(given, tuple) and len(given) == 2 and isinstance(given[0], Sequence | np.ndarray)
        if not several or not getattr(given[0], "ndim", 1):
            raise refused("samples", "be times and positions")
        must = "be increasing times and as many positions, finite numbers"
        count = len(given[0])
        t, p = (numbers("samples", x, of, 1e3, must) for x, of in zip(given, ((count,), (count, 3)), strict=True))
        if not count or np.any(np.diff(t) <= 0):
            raise refused("samples", must)
        fastest = float((np.linalg.norm(np.diff(p, axis=0), axis=1) / np.diff(t)).max(initial=0.0))
        if fastest > options.speed:
            raise refused("samples", f"not move at more than {options.speed:g} m/s (they do at {fastest:.3g})")
        samples = (now - late + t, p)
    sure, grows, lasts = (float(found[name]) for name in ("uncertainty", "growth", "lasts"))
    now -= late
    return Predicted(seen.name, solid, R, now, powers, samples, sure, grows, now + lasts)


@dataclass(frozen=True, eq=False)
class Predicted:
    """Predicted position at live times: powers (3, 3) of the time since t0, or samples. The prediction holds until live
    time `until`, s.
    solid: kind and sizes, m, of its shape."""

    name: str
    solid: tuple[Any, ...]
    R: Array
    t0: float
    powers: Array
    samples: tuple[Array, Array] | None
    uncertainty: float
    growth: float
    until: float

    @property
    def shape(self) -> Any:
        """The obstacle as a shape of Coal."""
        return _shape(*self.solid)

    def at(self, t: Array) -> tuple[Array, Array]:
        """Predicted positions (N, 3), m in S, and velocities (N, 3), m/s, at live times (N,), s."""
        if self.samples is None:
            u = (t - self.t0)[:, None]
            p, v, a = self.powers
            return p + u * v + u**2 * a, v + 2 * u * a
        times, positions = self.samples
        where = interpolated(times, positions, t)
        if len(times) == 1:
            return where, np.zeros_like(where)
        k = np.clip(np.searchsorted(times, t, side="right") - 1, 0, len(times) - 2)
        slope = (np.diff(positions, axis=0) / np.diff(times)[:, None])[k]
        slope[(t < times[0]) | (t > times[-1])] = 0.0
        return where, slope

    def around(self, t: Array) -> Array:
        """Uncertainty (N,) of the predicted position at live times, m."""
        return self.uncertainty + self.growth * np.maximum(t - self.t0, 0.0)

    def standing(self) -> Predicted:
        """The prediction of an obstacle that stands still for ever. Raises Refused if it moves."""
        if self.samples is not None or self.powers[1:].any():
            raise Refused(f"the obstacle {self.name} must stand still, without velocity, acceleration and samples")
        return replace(self, growth=0.0, until=np.inf)

    @property
    def settles(self) -> float:
        """Live time, s, from which on the prediction is constant."""
        return self.until if np.isfinite(self.until) else self.t0

    @cached_property
    def radius(self) -> float:
        """Radius, m, of a sphere around its position that contains it."""
        return float(np.linalg.norm(self.shape.aabb_center)) + float(self.shape.aabb_radius)

    def fastest(self, speeds: Array) -> Array:
        """Upper bound (N,) of its speed, m/s, at the instants of the prediction and between them."""
        if self.samples is None:
            return speeds
        times, positions = self.samples
        most = np.linalg.norm(np.diff(positions, axis=0), axis=1) / np.diff(times)
        return np.full_like(speeds, most.max(initial=0.0))

    def foresaw(self, seen: Predicted, now: float) -> bool:
        """Whether an obstacle that is seen now, at a live time in s, lies within this prediction for as long as both
        hold."""
        if self.solid != seen.solid or not np.array_equal(self.R, seen.R) or self.until < now:
            return False
        t = np.linspace(now, max(now, self.settles), 8)
        away = np.linalg.norm(self.at(t)[0] - seen.at(t)[0], axis=1)
        return bool(np.all(away <= self.around(t)) and seen.uncertainty <= self.around(t[:1])[0] + SAME)


@lru_cache(maxsize=256)
def _shape(kind: str, *size: float) -> Any:
    """Coal's shapes do not travel to other processes."""
    shape = {"sphere": coal.Sphere, "capsule": coal.Capsule, "box": coal.Box}[kind](*size)
    shape.computeLocalAABB()
    return shape


class Movable:
    """The parts of an arm that can move out of the way: all but its base. Not for use by several threads at once."""

    far = 0.15  # m from which on distances are those of bounding spheres, no larger than the true ones

    def __init__(self, parts: ArmGeometry) -> None:
        arm, model = parts.arm, parts.arm.pin_model
        self.arm, self._parts = arm, parts
        mine = len(parts.names) - parts.obstacles
        self.index = [k for k in range(mine) if parts.model.geometryObjects[k].parentJoint > 1]
        self.names = [parts.names[k] for k in self.index]
        self._geometry = [parts.model.geometryObjects[k] for k in self.index]
        shapes = [one.geometry for one in self._geometry]
        self._centres = [x.aabb_center for x in shapes]  # of bounding spheres, in each part's own frame
        self.radii = np.array([float(x.aabb_radius) for x in shapes])
        # (M, n) at most how far a part moves when a joint moves by 1.
        self.levers = np.zeros((len(shapes), arm.n))
        links = [np.linalg.norm(x.translation) for x in model.jointPlacements]
        for row, part in enumerate(self._geometry):
            length = float(np.linalg.norm(part.placement.act(self._centres[row]))) + self.radii[row]
            for joint in reversed(list(model.supports[part.parentJoint])[1:]):
                self.levers[row, joint - 1] = 1.0 if arm.linear[joint - 1] else length
                length += float(links[joint])
        self._request, self.result = coal.DistanceRequest(), coal.DistanceResult()

    def _place(self, q: Array) -> Any:
        parts = self._parts
        pin.updateGeometryPlacements(self.arm.pin_model, self.arm.data, parts.model, parts.data, q)
        return parts.data.oMg

    def middles(self, q: Array) -> Array:
        """(N, M, 3) centres of bounding spheres at postures (N, n)."""
        out = np.empty((len(q), len(self.index), 3))
        for k, posture in enumerate(q):
            placed = self._place(posture)
            out[k] = [placed[i].act(c) for i, c in zip(self.index, self._centres, strict=True)]
        return out

    def distance(self, q: Array, row: int, obstacle: Predicted, p: Array) -> float:
        """Distance of one part at a posture (n,) from an obstacle at p (3,), m; exact."""
        return self._between(self._place(q)[self.index[row]], row, obstacle, p)

    def _between(self, placed: Any, row: int, obstacle: Predicted, p: Array) -> float:
        self.result.clear()
        here, there = coal.Transform3s(placed.rotation, placed.translation), coal.Transform3s(obstacle.R, p)
        part = self._geometry[row].geometry
        return float(coal.distance(part, here, obstacle.shape, there, self._request, self.result))

    def distances(self, q: Array, obstacle: Predicted, p: Array, middles: Array | None = None) -> Array:
        """Distances (N, M) of all parts at postures (N, n) from an obstacle at p (N, 3), m; beyond `far` no larger than
        the true ones. q may be one posture for all. middles: centres of the parts at these postures, if known."""
        middles = self.middles(q) if middles is None else middles
        out = np.linalg.norm(middles - p[:, None], axis=2) - self.radii - obstacle.radius
        last, placed = -1, None
        known: dict[int, float] = {}
        for k, row in np.argwhere(out < self.far).tolist():
            at = min(k, len(q) - 1)
            if placed is None or at != last or np.any(p[k] != p[k - 1]):
                known = {}
            if placed is None or at != last:
                last, placed = at, self._place(q[at])
            if row not in known:
                known[row] = self._between(placed[self.index[row]], row, obstacle, p[k])
            out[k, row] = known[row]
        return out

    def slopes(self, q: Array, p: Array, obstacle: Predicted, node: Indices, part: Indices) -> tuple[Array, Array]:
        """(r, n) derivatives of distances by the joints, and the normals (r, 3) towards the obstacle, of parts (r,) at
        postures q[node], node (r,), when it is at p (r, 3)."""
        arm, model = self.arm, self.arm.pin_model
        slopes, normals = np.zeros((len(node), arm.n)), np.zeros((len(node), 3))
        for k in np.unique(node):
            pin.computeJointJacobians(model, arm.data, q[k])
            placed = self._place(q[k])
            for r in np.flatnonzero(node == k):
                row = int(part[r])
                self._between(placed[self.index[row]], row, obstacle, p[r])
                normal, at = self.result.normal, self.result.getNearestPoint1()
                joint = self._geometry[row].parentJoint
                moved = pin.getJointJacobian(model, arm.data, joint, pin.LOCAL_WORLD_ALIGNED)
                lever = at - arm.data.oMi[joint].translation
                slopes[r] = -(normal @ moved[:3] + np.cross(lever, normal) @ moved[3:])
                normals[r] = normal
        return slopes, normals


@dataclass(frozen=True, eq=False)
class MovingClearance(Constraint):
    """Clearance constraints between a motion, whose time 0 is live time `begins`, s, and predicted obstacles.

    at_nodes: m, additional distance at the nodes of a programme, for the motion between them. rest_step: s between
    checks of the arm at rest; the path length of both sides in that time is added to the distance.
    """

    movable: Movable
    obstacles: tuple[Predicted, ...]
    begins: float
    at_nodes: float = 5e-3
    rest_step: float = 5e-3

    def blocks(self, motion: MotionEvaluation) -> Iterator[Block]:
        nodes = motion.nodes
        if not motion.imposed:  # until it rests: the rest is looked at by itself
            moving = np.flatnonzero((motion.at_nodes[0] != motion.at_nodes[0, -1]).any(axis=1))
            nodes = nodes[: moving.max(initial=-1) + 2]
        q, dq = motion.z[:2, nodes]
        own = motion.s[nodes] * motion.duration
        stray, at_rest_stray = np.zeros(len(own)), 0.0
        if motion.response is not None:
            whole = strayed(*motion.tray_radius())
            stray, at_rest_stray = whole[: len(own)], float(whole[len(own) - 1 :].max())
        steps = np.pad(np.diff(own), 1)
        longest = 0.5 * np.maximum(steps[:-1], steps[1:])  # half of the time to the next look
        movable, middles, t = self.movable, self.movable.middles(q), self.begins + own
        rest = np.arange(t[-1], max(t[-1], *(x.settles for x in self.obstacles)) + self.rest_step, self.rest_step)
        for obstacle in self.obstacles:
            p, v = obstacle.at(t)
            speed = np.linalg.norm(v, axis=1) + obstacle.growth
            free = movable.distances(q, obstacle, p, middles)
            free -= (CLEARANCE.safety + obstacle.around(t) + stray)[:, None]
            if not motion.imposed:  # what both may go until the next look
                free -= longest[:, None] * (speed[:, None] + np.abs(dq) @ movable.levers.T)
            free[t > obstacle.until] = movable.far
            by_duration = None
            if motion.imposed:
                by_duration = np.zeros_like(free)
                i, f = np.nonzero(free < 0.5 * movable.far)
                normal = movable.slopes(q, p[i], obstacle, i, f)[1]
                rate = np.einsum("ri,ri->r", normal, v[i]) - obstacle.growth
                by_duration[i, f] = -PER_METRE * own[i] * rate
            yield self._block(motion, obstacle, "", free, nodes, p, np.indices(free.shape)[0], by_duration)
            # At rest, until nothing is known any more.
            late, v_late = obstacle.at(rest)
            faster = np.linalg.norm(v_late, axis=1) + obstacle.growth
            kept = CLEARANCE.safety + obstacle.around(rest) + at_rest_stray + 0.5 * self.rest_step * faster
            there = movable.distances(q[-1:], obstacle, late, middles[-1:]) - kept[:, None]
            there[rest > obstacle.until] = movable.far
            worst = np.argmin(there, axis=0)[None]
            least = np.take_along_axis(there, worst, axis=0)
            yield self._block(motion, obstacle, " at rest", least, nodes[-1:], late, worst)

    def _block(
        self, motion: MotionEvaluation, obstacle: Predicted, when: str, free: Array, nodes: Indices, p: Array,
        which: Indices, by_duration: Array | None = None,
    ) -> Block:  # fmt: skip
        """Rows of distances free (K, M), m, of each part at nodes (K,). which: (K, M), at which of the obstacle's
        places p (P, 3), m."""
        movable = self.movable

        def gradient(i: Indices, f: Indices) -> Array:
            slopes = movable.slopes(motion.z[0, nodes], p[which[i, f]], obstacle, i, f)[0]
            return padded(-PER_METRE * slopes, motion.n)

        return Block(
            f"clearance of {obstacle.name}{when}", -PER_METRE * free, gradient, nodes,
            (PER_METRE * self.at_nodes, 0.0), scales=False, by_duration=by_duration,
            reach=PER_METRE * 0.5 * movable.far, most=2, kinked=True, inherits=False, in_words=mm_of_distance,
        )  # fmt: skip
