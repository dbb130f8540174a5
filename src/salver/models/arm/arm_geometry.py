"""Geometry of the arm: shapes of links, tray and load, and their collisions with each other and with obstacles.

All shapes are convex (`salver.models.arm.link_shapes`) and compared by Coal. A hull contains its link, so a posture
without collision is safe, except for the parts that `ArmGeometry.unchecked` names.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence, Set
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import coal
import numpy as np
import pinocchio as pin

from salver.errors import ScenarioError
from salver.geometry import Array, Indices, Mask, cross
from salver.models.arm.arm import ArmModel
from salver.models.arm.link_pairs import Links, Pair, add, bulky, comparable, placed, postures_of
from salver.models.arm.link_shapes import LinkShapes, link_shapes
from salver.models.bodies import Body
from salver.models.described import Floor, Obstacle, Wall
from salver.models.shapes.obstacle_shapes import obstacle_shapes
from salver.wording import listed

TRAY = "tray"


class UnknownShapeError(ScenarioError):
    """The shape of a link is not known, and the scenario does not say what to do about it."""


@dataclass(frozen=True)
class Touch:
    """Two parts that touch: their names, and the index of the first posture at which they do."""

    first: str
    second: str
    index: int


@dataclass(frozen=True, eq=False)
class ArmGeometry:
    """Hulls of the arm, its tray and its load, and obstacles. Not for use by several threads at once.

    names: of the parts: links of the URDF, "tray", carried objects, obstacles. pairs: (index, index) into names, of the
    parts that are compared. tray: index of the tray; carried objects follow. obstacles: number of obstacles, the last
    parts. unchecked: what is not checked, in words: links without geometry, pairs that are left out. left_out: pairs of
    names that could touch and are not compared, by reason.
    """

    arm: ArmModel
    model: Any
    data: Any
    names: tuple[str, ...]
    pairs: tuple[Pair, ...]
    tray: int
    obstacles: int
    unchecked: tuple[str, ...]
    left_out: dict[str, list[tuple[str, str]]]

    def apart(self) -> ArmGeometry:
        """A copy with work space of its own, for another thread."""
        arm = replace(self.arm, data=self.arm.pin_model.createData())
        return replace(self, arm=arm, data=self.model.createData())

    def first_touch(self, q: Array) -> Touch | None:
        """The first of postures (N, n) at which two parts touch, or None."""
        for k, posture in enumerate(q):
            if pin.computeCollisions(self.arm.pin_model, self.arm.data, self.model, self.data, posture, True):
                for result, (i, j) in zip(self.data.collisionResults, self.pairs, strict=True):
                    if result.isCollision():
                        return Touch(self.names[i], self.names[j], k)
        return None

    def clearance(self, q: Array, within: float | Array = np.inf) -> Array:
        """Distances (N, pairs) in postures (N, n), m; negative where parts overlap.

        within: above this distance, m, of all or of each pair, lower bounds are enough. They are derived from the last
        call with the same number of postures: a pair is computed again only if the joints moved far enough to bring it
        within that distance.
        """
        low = np.full((len(q), len(self.pairs)), -np.inf)
        if not np.isfinite(within).all():
            self._measure(q, low, within)
            return low
        if len(q) in self._last:
            before, there = self._last.pop(len(q))
            low = there - np.abs(q - before) @ self.levers(q).T
        self._measure(q, low, within)
        self._remember(q, low)
        return low

    def _remember(self, q: Array, low: Array, paths: int = 4) -> None:
        """Cache distances (N, pairs) in postures (N, n) of so many paths, each with another number of postures."""
        self._last[len(q)] = q.copy(), low.copy()
        if len(self._last) > paths:
            del self._last[next(iter(self._last))]

    def _measure(self, q: Array, low: Array, within: float | Array) -> None:
        """Replace values in `low` (N, pairs) that are below `within` by exact distances in postures (N, n)."""
        arm, data, place, results = self.arm.pin_model, self.arm.data, (self.model, self.data), self._results
        postures, pairs = np.nonzero(low < within)
        found, last = [], -1
        for k, pair in zip(postures.tolist(), pairs.tolist(), strict=True):
            if k != last:
                pin.updateGeometryPlacements(arm, data, *place, q[k])
                last = k
            pin.computeDistance(*place, pair)
            found.append(results[pair].min_distance)
        low[postures, pairs] = found

    @cached_property
    def _results(self) -> list[Any]:
        """Views of the work space of each pair's comparison, cached because making them takes longer than comparing."""
        return list(self.data.distanceResults)

    @cached_property
    def _last(self) -> dict[int, tuple[Array, Array]]:
        """Cache by number N: the last postures (N, n), and known distances (N, pairs)."""
        return {}

    def levers(self, q: Array) -> Array:
        """Bounds (pairs, n) on the relative motion of a pair per rad, or m, of a joint, in postures (N, n).

        For a revolute joint: the length from its origin along the links to the farthest point of the part that it
        moves.
        """
        if not any(self.arm.linear):
            return self._levers
        return self._levers_with(np.abs(q).max(axis=0) * np.array(self.arm.linear))

    @cached_property
    def _levers(self) -> Array:
        return self._levers_with(np.zeros(self.arm.n))

    def _levers_with(self, stroke: Array) -> Array:
        """`levers`, with prismatic joints displaced by at most `stroke` (n,), m."""
        model, linear = self.arm.pin_model, self.arm.linear
        links = np.array([np.linalg.norm(placement.translation) for placement in model.jointPlacements])
        links[1:] += stroke  # joints have one coordinate each
        radius = []
        for part in self.model.geometryObjects:
            centre, half = part.geometry.aabb_center, float(part.geometry.aabb_radius)
            # Parts in the world are not moved by joints; a floor is infinite.
            radius.append(half + float(np.linalg.norm(part.placement.act(centre))) if part.parentJoint else 0.0)
        levers = np.zeros((len(self.pairs), self.arm.n))
        for row, pair in enumerate(self.pairs):
            chains = [list(model.supports[self.model.geometryObjects[k].parentJoint])[1:] for k in pair]
            for part, chain, other in zip(pair, chains, reversed(chains), strict=True):
                length = radius[part]
                for joint in reversed([j for j in chain if j not in other]):
                    levers[row, joint - 1] = 1.0 if linear[joint - 1] else length
                    length += links[joint]
        return levers

    def clearance_gradient(self, q: Array, node: Indices, pair: Indices) -> Array:
        """Derivatives (r, n) of `clearance` by the joints in postures q[node] (q: (N, n)) for pairs (r,).

        From the velocities of the two nearest points along the normal between them; where these points jump (parallel
        faces) it is one of the one-sided derivatives.
        """
        model, data, results = self.arm.pin_model, self.arm.data, self._results
        normal, points = np.empty((len(node), 1, 3)), np.empty((len(node), 2, 3))
        velocity = np.empty(
            (len(node), 6, self.arm.n)
        )  # by each joint: of the point at the world's origin, and angular velocity
        last = -1
        for r, (k, one) in enumerate(zip(node.tolist(), pair.tolist(), strict=True)):
            if k != last:
                pin.computeJointJacobians(model, data, q[k])
                pin.updateGeometryPlacements(model, data, self.model, self.data)
                last, columns = k, data.J
            pin.computeDistance(self.model, self.data, one)
            result = results[one]
            normal[r], velocity[r] = result.normal, columns
            points[r, 0], points[r, 1] = result.getNearestPoint1(), result.getNearestPoint2()
        along = normal @ velocity[:, :3] + cross(points, normal) @ velocity[:, 3:]  # (r, 2, n)
        along *= self._carried[pair]
        return np.asarray(along[:, 1] - along[:, 0])

    @cached_property
    def of_floor(self) -> Mask:
        """Mask (pairs,) of pairs with the floor."""
        return self._of(Floor.name)

    def _of(self, name: str) -> Mask:
        """Mask (pairs,) of pairs with half-spaces of a name."""
        shapes = [part.geometry for part in self.model.geometryObjects]
        walls = [isinstance(shape, coal.Halfspace) and self.names[k] == name for k, shape in enumerate(shapes)]
        return np.array([walls[j] for _, j in self.pairs], dtype=bool)

    @cached_property
    def _carried(self) -> Array:
        """(pairs, 2, n) 1 where a joint carries the first, and the second, part of a pair, else 0."""
        carried = np.zeros((len(self.pairs), 2, self.arm.n))
        for row, pair in zip(carried, self.pairs, strict=True):
            for side, part in zip(row, pair, strict=True):
                joints = list(self.arm.pin_model.supports[self.model.geometryObjects[part].parentJoint])[1:]
                side[np.array(joints, dtype=int) - 1] = 1.0
        return carried

    def near(self, q: Array, distance: float) -> ArmGeometry:
        """The geometry with only the pairs that are within a distance, m, in one of the postures (N, n)."""
        low = self.clearance(q, distance)
        pairs = np.flatnonzero(low.min(axis=0) < distance)
        found = self.only(pairs)  # a new copy: Coal's starting point depends on earlier queries of a shape
        found._remember(q, low[:, pairs])
        return found

    def only(self, pairs: Iterable[int]) -> ArmGeometry:
        """The geometry with some of the pairs, by their indices."""
        chosen = list(pairs)
        found = _with_pairs(self, tuple(self.pairs[k] for k in chosen))
        # Cached, because every motion that is checked needs it.
        vars(found).update(_levers=self._levers[chosen], _carried=self._carried[chosen])
        return found

    def in_the_way(self, p_SE: Array, R_SE: Array) -> tuple[str, str] | None:
        """Overlaps of tray or load with obstacles when the tray is at a pose, whatever the arm's posture."""
        frame, placed = self.arm.pin_model.frames[self.arm.tray_id], self.model.geometryObjects
        joint = pin.SE3(R_SE, p_SE) * frame.placement.inverse()
        around = len(self.names) - self.obstacles
        for i in range(self.tray, around):
            here = joint * placed[i].placement
            for j in range(around, len(self.names)):
                there, request = placed[j].placement, coal.CollisionRequest()
                poses = [coal.Transform3s(place.rotation, place.translation) for place in (here, there)]
                result = coal.CollisionResult()
                if coal.collide(placed[i].geometry, poses[0], placed[j].geometry, poses[1], request, result):
                    return self.names[i], self.names[j]
        return None


def arm_geometry(arm: ArmModel, bodies: Sequence[Body] = (), obstacles: Sequence[Obstacle | Wall] = ()) -> ArmGeometry:
    """Shapes of an arm's links, its tray, the boxes around its load, and obstacles.

    All pairs that move relative to each other are compared by their hulls, or by a few convex pieces of strongly
    nonconvex links whose hulls touch too often (`salver.models.arm.link_pairs`). Exceptions: links that share a joint,
    pairs that the arm's SRDF disables, links with any shapes that overlap in every posture, and links that stand on the
    floor.

    Raises UnknownShapeError when the geometry of a link is not known and `arm.collisions` does not say what to do about
    it; ScenarioError when the load lies inside a link of known shape in every posture, or when an obstacle's mesh
    cannot be used.
    """
    known = link_shapes(arm.urdf, capsules=arm.collisions == "capsules")
    if known.missing and arm.collisions != "unchecked":
        raise UnknownShapeError(_refusal(arm, known.missing))
    parts, names = placed(arm, known)
    links = len(names)
    low, high = tuple(arm.limits.q_min.tolist()), tuple(arm.limits.q_max.tolist())
    clumsy = bulky(Links(known, low, high, frozenset(arm.disabled_pairs), arm))
    pieces: dict[int, list[int]] = {}
    for k in sorted({k for pair in clumsy for k in pair}):
        shapes, hull = known.shapes[k].pieces, parts.geometryObjects[k]
        pieces[k] = [k] if len(shapes) == 1 else [len(names) + number for number in range(len(shapes))]
        for shape in shapes if len(shapes) > 1 else ():
            add(parts, names, names[k], hull.parentJoint, hull.placement, shape)
    in_pieces = {(i, j): list(itertools.product(pieces[i], pieces[j])) for i, j in clumsy}
    tray = len(names)

    frame = arm.pin_model.frames[arm.tray_id]
    middle = pin.SE3(np.eye(3), 2 * arm.tray_com_E + [0.0, 0.0, 0.5 * arm.tray_size[2]])  # its base is at 2 com
    add(parts, names, TRAY, frame.parentJoint, frame.placement * middle, coal.Box(*arm.tray_size))
    for body in bodies:
        points = body.solid.bounding_points_G - body.com_G
        low, high = points.min(axis=0), points.max(axis=0)
        placement = frame.placement * pin.SE3(body.R_EB, body.p_EB + body.R_EB @ (0.5 * (low + high)))
        add(parts, names, body.name, frame.parentJoint, placement, coal.Box(*(high - low)))
    fixed = len(names)
    for obstacle in obstacles:
        for shape, placement in obstacle_shapes(obstacle):
            add(parts, names, obstacle.name, 0, placement, shape)

    whole = [*range(links), *range(tray, len(names))]
    pairs, left_out = comparable(arm, parts, names, whole, links, fixed)
    pairs = [part for pair in pairs for part in in_pieces.get(pair, [pair])]
    compared = ArmGeometry(arm, parts, None, tuple(names), (), tray, len(names) - fixed, (), {})
    overlap = _always(_with_pairs(compared, tuple(pair for pair in pairs if pair[1] < fixed)))
    # If one pair of shapes of two links always overlaps, the links are modelled as overlapping: none is compared.
    linked = {(names[i], names[j]) for i, j in overlap if j < tray}
    left_out["always"] = [
        (i, j) for i, j in pairs if (i, j) in overlap or (j < tray and (names[i], names[j]) in linked)
    ]
    # Links on the same joint as the load do not move relative to it. Fitted capsules may reach beyond their links.
    same = [(i, j) for i, j in itertools.product(range(links), range(tray + 1, fixed)) if _fixed_in(known, parts, i, j)]
    inside = [(i, j) for i, j in [*left_out["always"], *same] if j > tray and names[i] not in known.fitted]
    for link, load in inside:
        raise ScenarioError(
            f"{names[load]} lies inside {names[link]} in every posture; move the tray away from it by tray.height, "
            "tray.offset or tray.rpy_deg, or the load on it by `at`."
        )
    links_walls = _with_pairs(compared, tuple(pair for pair in pairs if pair[0] < tray))
    left_out["floor"], left_out["sunk"] = _on_floor(links_walls)
    gone = {pair for key in ("always", "floor", "sunk") for pair in left_out[key]} | {*_along_walls(links_walls)}
    pairs = [pair for pair in pairs if pair not in gone]
    named = {
        key: list(dict.fromkeys((names[i], names[j]) for i, j in found)) for key, found in left_out.items() if found
    }
    told = _unchecked(known.missing, known.fitted, named, {(names[i], names[j]) for i, j in pairs})
    return replace(_with_pairs(compared, tuple(pairs)), unchecked=told, left_out=named)


def _always(parts: ArmGeometry) -> list[Pair]:
    """Pairs of the arm's own parts that overlap in every posture."""
    for q in postures_of(parts.arm):
        if not parts.pairs:
            break
        overlap = parts.clearance(q[None])[0] <= 0
        if not overlap.all():
            parts = _with_pairs(parts, tuple(pair for pair, yes in zip(parts.pairs, overlap, strict=True) if yes))
    return list(parts.pairs)


def _fixed_in(known: LinkShapes, parts: Any, link: int, load: int, touching: float = 1e-3) -> bool:
    """Whether a load penetrates a link on the same joint by more than `touching`, m, as a load on that link may: its
    mesh, not the hull, which would fill a tray with a rim that is a link of the URDF."""
    one, other = (parts.geometryObjects[k] for k in (link, load))
    if one.parentJoint != other.parentJoint:
        return False
    half = np.maximum(np.asarray(other.geometry.halfSide) - touching, 0.5 * touching)
    shape, place = known.shapes[link], one.placement.actInv(other.placement)
    there = coal.Transform3s(place.rotation, place.translation)
    box, request, result = coal.Box(*(2 * half)), coal.CollisionRequest(), coal.CollisionResult()
    return bool(coal.collide(shape.itself, coal.Transform3s(), box, there, request, result)) or shape.holds(
        place.translation
    )


def _on_floor(parts: ArmGeometry, same: float = 1e-6) -> tuple[list[Pair], list[Pair]]:
    """Pairs of the floor and a link whose distance is the same in every posture (up to `same`, m), as for rotation
    about the vertical, or always below the required distance."""
    parts = parts.only(np.flatnonzero(parts.of_floor))
    distance = parts.clearance(postures_of(parts.arm))
    still, sunk = np.ptp(distance, axis=0) <= same, distance.max(axis=0, initial=-np.inf) < Floor.clear
    found = [[pair for pair, yes in zip(parts.pairs, which, strict=True) if yes] for which in (still, sunk & ~still)]
    return found[0], found[1]


def _along_walls(parts: ArmGeometry, same: float = 1e-6) -> list[Pair]:
    """Pairs of a face of the keep-in box and a link inside it whose distance is the same in every posture (up to
    `same`, m), as of a base that drives over a box's bottom.

    Raises ScenarioError when a link is outside the box in every posture.
    """
    parts = parts.only(np.flatnonzero(parts._of(Wall.name)))
    distance = parts.clearance(postures_of(parts.arm))
    nearest, still = distance.max(axis=0, initial=-np.inf), np.ptp(distance, axis=0) <= same
    for (link, _), is_outside in zip(parts.pairs, nearest <= np.where(still, -same, 0.0), strict=True):
        if is_outside:
            raise ScenarioError(
                f"{parts.names[link]} is outside the keep-in box in every posture; surroundings.keep_in must hold all "
                "links that move."
            )
    return [pair for pair, yes in zip(parts.pairs, still, strict=True) if yes]


def _refusal(arm: ArmModel, missing: dict[str, str]) -> str:
    link, reason = next(iter(missing.items()))
    more = f", nor those of {len(missing) - 1} more links ({', '.join(list(missing)[1:])})" if len(missing) > 1 else ""
    return (
        f"{arm.name}: the shape of {link} is not known ({reason}){more}, so it cannot be told whether the arm hits "
        "something; name the folders of the packages that hold the meshes in arm.package_dirs (or AMENT_PREFIX_PATH, "
        'ROS_PACKAGE_PATH), or give arm.collisions = "capsules" to fit capsules to the inertia of such links, or '
        '"unchecked" to plan without looking at them.'
    )


def _unchecked(
    missing: dict[str, str],
    fitted: Sequence[str],
    left_out: dict[str, list[tuple[str, str]]],
    compared: Set[tuple[str, str]],
) -> tuple[str, ...]:
    """left_out, compared: pairs of names; some shapes of a pair may be compared and others not."""
    told = []
    if missing:
        told.append(f"whether {listed(missing)} {'hits' if len(missing) == 1 else 'hit'} anything (shape not known)")
    if fitted:
        told.append(f"the true shape of {listed(fitted)} (capsules fitted to the inertia stand for it)")
    if "always" in left_out:
        pairs = ", ".join(
            f"{'a part of ' * (pair in compared)}{pair[0]} against {pair[1]}" for pair in left_out["always"]
        )
        told.append(f"{pairs} (their hulls overlap in every posture)")
    if "sunk" in left_out:
        names = listed([link for link, _ in left_out["sunk"]])
        told.append(f"{names} against the floor (nearer to it than {1e3 * Floor.clear:.0f} mm in every posture)")
    if "srdf" in left_out:
        told.append(f"{len(left_out['srdf'])} pairs of links that the SRDF disables")
    if "neighbours" in left_out:
        told.append("links that share a joint against one another")
    return tuple(told)


def _with_pairs(parts: ArmGeometry, pairs: tuple[Pair, ...]) -> ArmGeometry:
    model = parts.model.copy()
    model.removeAllCollisionPairs()
    for i, j in pairs:
        model.addCollisionPair(pin.CollisionPair(i, j))
    return replace(parts, model=model, data=model.createData(), pairs=pairs)
