"""Whether a joint motion keeps the arm's limits; the verdict names the joint, the time and the excess."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from salver.errors import Status
from salver.geometry import Array
from salver.models.arm.arm import DRIVEN, ArmModel, with_load
from salver.models.arm.arm_geometry import ArmGeometry, arm_geometry
from salver.models.arm.arm_limits import LIMITS, STANDING, LimitKind
from salver.models.bodies import Body
from salver.models.described import Floor, Wall
from salver.planning.follow.clearance import sweep
from salver.sensitivity.arm.terms import motion_terms
from salver.trajectory import JointMotion
from salver.wording import listed

WITHIN_LIMITS, LIMIT_EXCEEDED, COLLISION = "within_limits", "limit_exceeded", "collision"
BETWEEN = 5e-3  # of a limit: a motion that keeps it at the planner's instants exceeds it by less between them


@dataclass(frozen=True)
class Peak:
    """The peak of a motion relative to one kind of limit: a share of 1 is the limit."""

    kind: str
    share: float
    joint: str
    time: float
    value: float
    limit: float
    unit: str


def torques(arm: ArmModel, motion: JointMotion, bodies: Sequence[Body] = ()) -> Array:
    """Joint torques (T, n), N m, at the motion's samples, for arm, tray and the bodies carried."""
    load = with_load(arm, bodies)
    return motion_terms(load.pin_model, load.tray_id, motion.q, motion.dq, motion.ddq).torque


def peaks(arm: ArmModel, motion: JointMotion, bodies: Sequence[Body] = (), instants: Array | None = None) -> list[Peak]:
    """The peak relative to each kind of the scenario's limits (`arm.planning_limits`).

    Position is measured from the middle of the range. instants: (T,) s, increasing, at which the motion is checked, and
    half way between them; by default at its samples, and at 200 at least. All derivatives are those of the motion: of
    one resampled in steps far below 1 ms the jerk is mostly rounding.
    """
    limits, instants = arm.planning_limits, _instants(motion) if instants is None else instants
    t = _with_middles(instants)
    torque = torques(arm, JointMotion(instants, *motion.sample(instants)), bodies)
    times = {"position": t, "torque": instants}
    derivatives = {
        "position": (*motion.sample(t), motion.jerk(t)),
        "torque": (torque, np.gradient(torque, instants, axis=0)),
    }
    curves = {kind.key: derivatives[kind.of][kind.order] for kind in LIMITS}
    shares = limits.shares(curves)
    found = []
    for kind in LIMITS:
        share, values = shares[kind.key], curves[kind.key]
        k, i = (int(x) for x in np.unravel_index(int(np.argmax(np.abs(share))), share.shape))
        value, time = float(values[k, i]), float(times[kind.of][k])
        bound = limits.bound(kind, i, value)
        if kind.key == "velocity" and limits.velocity_by_position is not None:
            bound = float(limits.velocity_at(curves["position"], curves["velocity"])[0][k, i])
        unit = kind.unit_of(arm.linear[i])
        found.append(Peak(kind.name, float(abs(share[k, i])), arm.joint_names[i], time, value, bound, unit))
    return found


def _instants(motion: JointMotion) -> Array:
    return motion.resampled(float(np.ptp(motion.t)) / 200).t


def _with_middles(t: Array) -> Array:
    return np.sort(np.concatenate([t, 0.5 * (t[1:] + t[:-1])]))


def blocked_end(parts: ArmGeometry, ends: Mapping[str, tuple[Array, Array]], whatever: str = "") -> Status | None:
    """Why the tray cannot be at an end of the motion, whatever the arm's posture; None if it can.

    ends: from the end's name to the tray's pose (p_SE, R_SE). whatever: words on other headings that were tried.
    """
    for name, (p_SE, R_SE) in ends.items():
        found = parts.in_the_way(p_SE, R_SE)
        if found is not None:
            place = f"inside the obstacle {found[1]}{whatever}; move one of them"
            if found[1] == Wall.name:
                place = f"outside the keep-in box{whatever}; move one of them"
            if found[1] == Floor.name:
                place = f"in the floor{whatever}; move the {name} up, or say where the floor is: surroundings.floor = "
                place += 'a height in m, or "none" for an arm that hangs'
            sentence = f"At the {name} the {found[0]} is {place}."
            return Status(COLLISION, sentence, False, {COLLISION: {"first": found[0], "second": found[1]}})
    return None


def unchecked(arm: ArmModel, parts: ArmGeometry) -> list[str]:
    """What the arm's verdict does not cover, in words: surroundings without obstacles, missing limits, unknown masses,
    and shapes and pairs that were left out."""
    nobody: dict[str, list[str]] = {}
    for kind in LIMITS:
        if arm.weightless and kind.of == "torque":
            continue
        joints = [name for name, source in zip(arm.joint_names, arm.limit_sources[kind.key], strict=True) if not source]
        if joints:
            nobody.setdefault("all joints" if len(joints) == arm.n else listed(joints), []).append(kind.name)
    stand = dict.fromkeys(parts.names[len(parts.names) - parts.obstacles :])
    but = f" but {listed(f'the {name}' for name in stand)}" if stand else ""
    nothing = [] if set(stand) - {Floor.name, Wall.name} else [f"anything around the arm{but}"]
    limits = [f"{listed(kinds)} of {joints} (nobody gave a limit)" for joints, kinds in nobody.items()]
    masses = []
    if arm.weightless:
        whose = "" if len(arm.weightless) == arm.n else f"{listed(arm.weightless)} "
        masses.append(
            f"joint torques, and how far the arm strays from its motion (the URDF gives {whose}no "
            f"mass{'' if whose else 'es'}: it is planned as one that follows exactly, under position control)"
        )
    return [*nothing, *masses, *limits, *parts.unchecked]


def verdict(
    arm: ArmModel,
    motion: JointMotion,
    bodies: Sequence[Body] = (),
    parts: ArmGeometry | None = None,
    between: float = 0.0,
    instants: Array | None = None,
) -> Status:
    """The verdict on the arm's limits: "within_limits", which first names what was not checked, "limit_exceeded" or
    "collision".

    arm: the arm. motion: of its joints. bodies: carried bodies, whose weight and shape count. parts: the arm's
    geometry, if it is known already. between: share by which the scenario's part of a limit may be exceeded (never the
    manufacturer's limit), for checks at other instants than the planner's (`BETWEEN`). instants: (T,) s, at which
    limits are checked (`peaks`).

    Returns:
        Status, whose `details` have the peak of each kind of limit by its key; "unchecked" (`unchecked`);
        "limit_sources": who gave each limit, per joint; "pairs_left_out": links that were not compared, by reason;
        "clearance": the closest two parts; "obstacle_clearance": the part closest to an obstacle; "collision": the
        parts that touch.
    """
    parts = arm_geometry(arm, bodies) if parts is None else parts
    instants = _instants(motion) if instants is None else instants
    found = peaks(arm, motion, bodies, instants)
    details: dict[str, Any] = {peak.kind.replace(" ", "_"): vars(peak) for peak in found}
    blind = unchecked(arm, parts)
    details |= {"unchecked": blind, "limit_sources": arm.limit_sources, "pairs_left_out": parts.left_out}
    rooms = {kind.name: _room(arm, kind, between) for kind in LIMITS}
    broken = sorted(
        (p for p in found if not p.share <= rooms[p.kind][arm.joint_names.index(p.joint)] + 1e-9),
        key=lambda peak: -peak.share,
    )
    sentences = [
        f"the {peak.kind} of {peak.joint} reaches {peak.value:.4g} {peak.unit} at t = {peak.time:.2f} s, {_over(peak)}"
        for peak in broken
    ]
    driven = _driven(arm, motion, between, _with_middles(instants))
    sentences += driven
    swept = sweep(parts, motion)
    for key, near in (("clearance", swept.nearest), ("obstacle_clearance", swept.obstacle), (COLLISION, swept.touch)):
        if near is not None:
            details[key] = vars(near)
    if swept.touch is not None:
        touch = swept.touch
        sentences.append(f"{touch.first} and {touch.second} touch at t = {touch.time:.2f} s")
    if sentences:
        code = LIMIT_EXCEEDED if broken or driven else COLLISION
        return Status(code, f"{arm.name} cannot follow: {'; '.join(sentences)}.", False, details)
    first = f"Not checked: {'; '.join(blind)}. " if blind else ""
    worst = max(found, key=lambda peak: peak.share)
    nearest = f"nearest is the {worst.kind} of {worst.joint}, at {100 * worst.share:.0f} % at t = {worst.time:.2f} s"
    if swept.obstacle is not None:
        near = swept.obstacle
        nearest += f"; {near.first} passes {near.second} at {1e3 * near.distance:.0f} mm at t = {near.time:.2f} s"
    return Status(WITHIN_LIMITS, f"{first}{arm.name} follows within its limits; {nearest}.", True, details)


def _driven(arm: ArmModel, motion: JointMotion, between: float, t: Array) -> list[str]:
    """Where a base drives faster, along or across its heading, than it may, in words."""
    if arm.base is None:
        return []
    found = []
    speed = np.abs(arm.base_velocity(*motion.sample(t)[:2])[0])
    part, whole = (arm.base_limits(limits) for limits in (arm.planning_limits, arm.limits))
    for way, v, most, own in zip(DRIVEN, speed.T, part, whole, strict=True):
        k = int(np.argmax(v))
        if v[k] > min(most * (1 + between), own) + 1e-9:
            found.append(
                f"the base moves {way} its heading at {v[k]:.4g} m/s at t = {t[k]:.2f} s, above {most:.4g} m/s"
            )
    return found


def _over(peak: Peak) -> str:
    if peak.limit == STANDING:
        return "where it must not move towards that end of its range"
    return f"{100 * (peak.share - 1):.3g} % over its limit of {peak.limit:.4g}"


def _room(arm: ArmModel, kind: LimitKind, between: float) -> Array:
    """The share (n,) of each limit of a kind that a motion may use."""
    part, whole = arm.planning_limits.range(kind)[1], arm.limits.range(kind)[1]
    with np.errstate(invalid="ignore"):  # where nobody gave a limit
        return np.fmin(1.0 + between, np.fmax(whole / part, 1.0))
