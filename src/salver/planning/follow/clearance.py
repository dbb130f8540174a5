"""Does anything touch anything along a joint motion? Between its samples too.

How fast two parts can approach each other is bounded: every joint between them turns points of one against the other,
and those are no farther from its axis than the chain is long. Where the distances at both ends of an interval are too
small for that speed it is halved, until it is sure either way.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from salver.geometry import Array
from salver.models.arm_geometry import ArmGeometry
from salver.trajectory import JointMotion

RESOLUTION = 1e-4  # m; parts that are nearer, or that may have been between two looks, are said to touch
EXACT = 1e-5  # m; distances are not known better


@dataclass(frozen=True)
class Approach:
    """The first touch of two parts, or else where two of them are nearest. distance: m, at time, s."""

    touches: bool
    first: str
    second: str
    time: float
    distance: float


def closest(parts: ArmGeometry, motion: JointMotion) -> Approach | None:
    """The first touch along a motion, or the nearest approach; None when there are no parts that could touch."""
    if not parts.pairs:
        return None
    t, distance = motion.t, parts.clearance(motion.q)
    reach = _reach(parts)
    # |dq| within an interval is at most the largest coefficient of its Bernstein form.
    speed = np.abs(motion.rate_coefficients).max(axis=0) @ reach.T
    sure = 0.5 * (distance[:-1] + distance[1:] - speed * np.diff(t)[:, None])
    doubtful = np.flatnonzero((sure <= EXACT).any(axis=1))
    for k in doubtful:
        touch = _within(parts, motion, (t[k], t[k + 1]), (distance[k], distance[k + 1]), speed[k])
        if touch is not None:
            return touch
    k, pair = np.unravel_index(int(np.argmin(distance)), distance.shape)
    return _approach(parts, False, int(pair), float(t[k]), float(distance[k, pair]))


def _within(
    parts: ArmGeometry, motion: JointMotion, t: tuple[float, float], distance: tuple[Array, Array], speed: Array
) -> Approach | None:
    """The first touch within an interval with known distances (pairs,) at its ends."""
    if distance[0].min() <= EXACT:
        return _approach(parts, True, int(np.argmin(distance[0])), t[0], float(distance[0].min()))
    travel = speed * (t[1] - t[0])
    sure = 0.5 * (distance[0] + distance[1] - travel)
    if sure.min() > EXACT:
        return None
    worst = int(np.argmin(sure))
    if travel[worst] < RESOLUTION:
        return _approach(parts, True, worst, t[1], float(min(distance[0][worst], distance[1][worst])))
    middle = 0.5 * (t[0] + t[1])
    between = parts.clearance(motion.sample(middle)[0])[0]
    first = _within(parts, motion, (t[0], middle), (distance[0], between), speed)
    return first or _within(parts, motion, (middle, t[1]), (between, distance[1]), speed)


def _approach(parts: ArmGeometry, touches: bool, pair: int, time: float, distance: float) -> Approach:
    i, j = parts.pairs[pair]
    return Approach(touches, parts.names[i], parts.names[j], float(time), distance)


def _reach(parts: ArmGeometry) -> Array:
    """(pairs, n): m per unit of a joint (rad, or m of a slider) by which it can bring two parts nearer, at most."""
    model = parts.arm.pin_model
    reach = np.zeros((len(parts.pairs), model.nv))
    for row, pair in enumerate(parts.pairs):
        lines = [_ancestors(model, parts.model.geometryObjects[i].parentJoint) for i in pair]
        for i, own, other in zip(pair, lines, reversed(lines), strict=True):
            length = _radius(parts.model.geometryObjects[i])
            for joint in own:  # from the part towards the base
                slides = model.joints[joint].shortname().startswith("JointModelP")
                column = model.joints[joint].idx_v
                if slides:
                    low, high = (limit[column] for limit in (model.lowerPositionLimit, model.upperPositionLimit))
                    length += max(abs(low), abs(high))
                if joint not in other:
                    reach[row, column] += 1.0 if slides else length
                length += float(np.linalg.norm(model.jointPlacements[joint].translation))
    return reach


def _ancestors(model: Any, joint: int) -> list[int]:
    """The joints that move a part, from its own to the base."""
    found = []
    while joint > 0:
        found.append(joint)
        joint = model.parents[joint]
    return found


def _radius(part: Any) -> float:
    """Of a ball around the part's joint that holds the part, m."""
    box = part.geometry.aabb_local
    corners = np.array([np.where(pick, box.max_, box.min_) for pick in np.ndindex(2, 2, 2)])
    return float(np.linalg.norm(part.placement.translation + corners @ part.placement.rotation.T, axis=1).max())
