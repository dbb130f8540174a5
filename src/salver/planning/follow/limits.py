"""Does a joint motion keep the arm's limits? A verdict with joint, time and by how much."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from salver.errors import Status
from salver.geometry import Array
from salver.models.arm import ArmModel, with_load
from salver.models.arm_geometry import ArmGeometry, arm_geometry
from salver.models.arm_limits import LIMITS
from salver.models.bodies import Body
from salver.planning.follow.clearance import closest
from salver.trajectory import JointMotion

WITHIN_LIMITS, LIMIT_EXCEEDED, COLLISION = "within_limits", "limit_exceeded", "collision"
_TOLERANCE = 1e-9  # relative; a motion planned up to a limit touches it


@dataclass(frozen=True)
class Peak:
    """The largest share of one kind of limit over a motion: share 1 is the limit."""

    kind: str
    share: float
    joint: str
    time: float
    value: float
    limit: float
    unit: str


def torques(arm: ArmModel, motion: JointMotion, bodies: Sequence[Body] = ()) -> Array:
    """(T, n) torque at the motion's samples, arm and tray and what is carried: N m."""
    load = with_load(arm, bodies)
    states = zip(motion.q, motion.dq, motion.ddq, strict=True)
    return np.array([load.inverse_dynamics(*state) for state in states])


def peaks(arm: ArmModel, motion: JointMotion, bodies: Sequence[Body] = ()) -> list[Peak]:
    """The largest share of each kind of the scenario's limits (`arm.planning_limits`).

    Position is measured from the middle of the range. Between samples too: the spline is looked at twice as finely.
    """
    limits = arm.planning_limits
    t = np.sort(np.concatenate([motion.t, 0.5 * (motion.t[1:] + motion.t[:-1])]))
    torque = torques(arm, motion, bodies)
    times = {"position": t, "torque": motion.t}
    derivatives = {
        "position": (*motion.sample(t), motion.jerk(t)),
        "torque": (torque, np.gradient(torque, motion.t, axis=0)),
    }
    curves = {kind.key: derivatives[kind.of][kind.order] for kind in LIMITS}
    shares = limits.shares(curves)
    found = []
    for kind in LIMITS:
        share, values = shares[kind.key], curves[kind.key]
        k, i = (int(x) for x in np.unravel_index(int(np.argmax(np.abs(share))), share.shape))
        value, time = float(values[k, i]), float(times[kind.of][k])
        bound = limits.bound(kind, i, value)
        found.append(Peak(kind.name, float(abs(share[k, i])), arm.joint_names[i], time, value, bound, kind.unit))
    return found


def verdict(
    arm: ArmModel, motion: JointMotion, bodies: Sequence[Body] = (), parts: ArmGeometry | None = None
) -> Status:
    """Status "within_limits", "limit_exceeded" or "collision"; `details` has the peak of each kind of limit.

    parts: the arm's geometry, when it is known already.
    """
    found = peaks(arm, motion, bodies)
    details: dict[str, Any] = {peak.kind.replace(" ", "_"): vars(peak) for peak in found}
    broken = sorted((peak for peak in found if not peak.share <= 1 + _TOLERANCE), key=lambda peak: -peak.share)
    sentences = [
        f"the {peak.kind} of {peak.joint} reaches {peak.value:.4g} {peak.unit} at t = {peak.time:.2f} s, "
        f"{100 * (peak.share - 1):.3g} % over its limit of {peak.limit:.4g}"
        for peak in broken
    ]
    near = closest(arm_geometry(arm, bodies) if parts is None else parts, motion)
    if near is not None and near.touches:
        details[COLLISION] = {"first": near.first, "second": near.second, "time": near.time}
        sentences.append(f"{near.first} and {near.second} touch at t = {near.time:.2f} s")
    if sentences:
        code = LIMIT_EXCEEDED if broken else COLLISION
        return Status(code, f"{arm.name} cannot follow: {'; '.join(sentences)}.", False, details)
    worst = max(found, key=lambda peak: peak.share)
    return Status(
        WITHIN_LIMITS,
        f"{arm.name} follows within its limits; nearest is the {worst.kind} of {worst.joint}, at "
        f"{100 * worst.share:.0f} % at t = {worst.time:.2f} s.",
        True,
        details,
    )
