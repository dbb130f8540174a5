"""Selection of the pairs of parts to compare, and of links that need convex pieces instead of hulls."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
import pinocchio as pin

from salver.geometry import Array, Mask
from salver.models.arm.arm import ArmModel
from salver.models.arm.link_shapes import LinkShapes

Pair = tuple[int, int]


def placed(arm: ArmModel, known: LinkShapes) -> tuple[Any, list[str]]:
    """Pinocchio's geometry of the links alone, and their names."""
    parts, names = pin.GeometryModel(), list[str]()
    for item in known.shapes:
        frame = arm.pin_model.frames[arm.pin_model.getFrameId(item.link, pin.FrameType.BODY)]
        add(parts, names, item.link, frame.parentJoint, frame.placement * item.placement, item.shape)
    return parts, names


def add(parts: Any, names: list[str], name: str, joint: int, placement: Any, shape: Any) -> None:
    shape.computeLocalAABB()
    parts.addGeometryObject(pin.GeometryObject(f"{len(names)}:{name}", joint, placement, shape))
    names.append(name)


def comparable(
    arm: ArmModel, parts: Any, names: Sequence[str], whole: Sequence[int], links: int, fixed: int
) -> tuple[list[Pair], dict[str, list[Pair]]]:
    """Pairs of the given parts (indices) that move relative to each other and of which one is a link (below `links`),
    the tray or a carried object (below `fixed`); and the pairs that are left out, by reason."""
    model, joints = arm.pin_model, [part.parentJoint for part in parts.geometryObjects]
    pairs: list[Pair] = []
    left_out: dict[str, list[Pair]] = {"neighbours": [], "srdf": [], "always": []}
    for j in whole:
        for i in (i for i in whole if i < min(j, fixed)):
            if joints[i] == joints[j]:
                continue
            neighbours = joints[i] == model.parents[joints[j]] or joints[j] == model.parents[joints[i]]
            if j < links and neighbours:
                left_out["neighbours"].append((i, j))
            elif j < links and (min(names[i], names[j]), max(names[i], names[j])) in arm.disabled_pairs:
                left_out["srdf"].append((i, j))
            else:
                pairs.append((i, j))
    return pairs, left_out


@dataclass(frozen=True)
class Links:
    """Cache key of an arm's links: shapes, joint limits, pairs that its SRDF disables."""

    known: LinkShapes
    low: tuple[float, ...]
    high: tuple[float, ...]
    disabled: frozenset[tuple[str, str]]
    arm: ArmModel = field(compare=False)


@lru_cache(maxsize=32)
def bulky(links: Links, share: float = 0.05, looks: int = 16) -> tuple[Pair, ...]:
    """Pairs of links (indices of their shapes) whose hulls overlap in many postures in which pieces of them do not.

    share: of all postures, from which on pieces replace the hulls. looks: number of postures in which meshes are
    compared first.
    """
    arm, shapes = links.arm, links.known.shapes
    parts, names = placed(arm, links.known)
    pairs = comparable(arm, parts, names, range(len(names)), len(names), len(names))[0]
    pairs = [(i, j) for i, j in pairs if shapes[i].mesh or shapes[j].mesh]
    postures = postures_of(arm)
    often = share * len(postures)
    found = []
    for pair, overlap in zip(pairs, _overlaps(arm, parts, pairs, postures).T, strict=True):
        there = postures[overlap]
        if len(there) < often:
            continue
        hulls = [parts.geometryObjects[k] for k in pair]
        # Meshes are compared in some of these postures first: they show whether pieces, which are expensive, can help.
        some = there[:: -(-len(there) // looks)]
        if _apart(arm, hulls, [(shapes[k].itself,) for k in pair], some) * len(there) < often * len(some):
            continue
        if _apart(arm, hulls, [shapes[k].pieces for k in pair], there) >= often:
            found.append(pair)
    return tuple(found)


def _apart(arm: ArmModel, hulls: Sequence[Any], shapes: Sequence[Sequence[Any]], postures: Array) -> int:
    """Number of postures (N, n) in which no shape that replaces one hull overlaps a shape that replaces the other."""
    two, of = pin.GeometryModel(), list[Any]()
    for hull, some in zip(hulls, shapes, strict=True):
        place = hull.parentJoint, hull.placement
        parts = [pin.GeometryObject(f"{len(of)}:{k}", *place, shape) for k, shape in enumerate(some)]
        of.append([two.addGeometryObject(part) for part in parts])
    return int(np.sum(~_overlaps(arm, two, list(itertools.product(*of)), postures).any(axis=1)))


def _overlaps(arm: ArmModel, parts: Any, pairs: Sequence[Pair], postures: Array) -> Mask:
    """Mask (N, pairs) of the pairs that overlap in postures (N, n)."""
    some = parts.copy()
    some.removeAllCollisionPairs()
    for i, j in pairs:
        some.addCollisionPair(pin.CollisionPair(i, j))
    own, data, found = arm.pin_model.createData(), some.createData(), np.zeros((len(postures), len(pairs)), dtype=bool)
    for k, q in enumerate(postures):
        pin.computeCollisions(arm.pin_model, own, some, data, q, False)
        found[k] = [result.isCollision() for result in data.collisionResults]
    return found


def postures_of(arm: ArmModel, count: int = 200) -> Array:
    """Random postures (N, n) of an arm within its limits, in which parts are compared."""
    low, high = np.maximum(arm.limits.q_min, -np.pi), np.minimum(arm.limits.q_max, np.pi)
    return np.random.default_rng(0).uniform(low, high, (count, arm.n))
