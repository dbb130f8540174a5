"""The limits of an arm: which kinds there are, and where their values come from.

A URDF holds position, velocity and torque limits at best. What a motion may ask for also includes
acceleration, jerk and the rate of torque; those come from the maker of a known arm, from a `joint_limits.yaml` as
MoveIt reads it, or from the scenario. A limit that nobody gave is infinite: it is not checked, and whoever judges a
motion has to say so.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from salver.errors import ScenarioError, reason
from salver.geometry import Array


@dataclass(frozen=True)
class LimitKind:
    """One kind of limit. All that plans, checks or reports limits goes by `LIMITS`, the table of them.

    key: its name in code, in files, and as a field of `JointLimits`. of, order: it bounds the time derivative of
    this order of the joint positions or of the joint torques. unit: of its values, for a joint that turns.
    share: what a plan may use of
    it unless the scenario says otherwise; feedback needs the rest.
    """

    key: str
    of: Literal["position", "torque"]
    order: int
    unit: str
    share: float

    @property
    def name(self) -> str:
        """The kind of limit in words."""
        return self.key.replace("_", " ")

    def unit_of(self, linear: bool) -> str:
        """The unit for a joint that turns, or for one that slides."""
        return self.unit.replace("rad", "m").replace("N m", "N") if linear else self.unit


LIMITS = (
    LimitKind("position", "position", 0, "rad", 1.0),
    LimitKind("velocity", "position", 1, "rad/s", 0.98),
    LimitKind("acceleration", "position", 2, "rad/s^2", 0.95),
    LimitKind("jerk", "position", 3, "rad/s^3", 0.95),
    LimitKind("torque", "torque", 0, "N m", 1.0),
    LimitKind("torque_rate", "torque", 1, "N m/s", 0.95),
)


POSITION = LIMITS[0]
STANDING = 1e-9  # rad/s: a limit of velocity that is 0 counts as this, of which a joint at rest uses no share
# By key; positions are not scaled.
PLANNING_SHARES = {kind.key: kind.share for kind in LIMITS if kind.key != "position"}


@dataclass(frozen=True)
class VelocityByPosition:
    """A velocity limit that falls towards the ends of a joint's range, so that the joint can still brake before them:
    braking at slope / 2 from its velocity plus the offset it stops at the end.

    lower, upper: (n,) the ends, rad or m. slope: (n,) above 0, rad/s^2. offset: (n,) above 0, rad/s.
    """

    lower: Array
    upper: Array
    slope: Array
    offset: Array

    def towards_ends(self, q: Array, stray: Array | float = 0.0) -> tuple[Array, Array]:
        """Largest velocities at joint positions q (..., n) that may be off by stray, and their derivatives by the
        distance to the end: (..., 2 n) each, n towards the upper ends, then n towards the lower ones, rad/s.

        sqrt(slope distance) - offset. Where that is negative the tangent continues it, so that it is smooth and
        concave: where the makers' formula allows no motion towards the end, this asks for one away from it.
        """
        distance = np.concatenate([self.upper - q - stray, q - self.lower - stray], axis=-1)
        slope, offset = np.tile(self.slope, 2), np.tile(self.offset, 2)
        nearest = offset**2 / slope
        root = np.sqrt(slope * np.maximum(distance, nearest))
        by_distance = 0.5 * slope / root
        return root - offset + by_distance * np.minimum(distance - nearest, 0.0), by_distance

    def after(self, others: int, away: float = 1e6) -> VelocityByPosition:
        """The limit with so many joints in front that have none: their ends are so far, rad or m, that they never get
        there."""
        ends = {"lower": -away, "upper": away, "slope": 1.0, "offset": 1.0}
        return VelocityByPosition(**{key: np.append(np.full(others, x), getattr(self, key)) for key, x in ends.items()})

    def scaled(self, share: float) -> VelocityByPosition:
        """A share of the velocities."""
        return replace(self, slope=share**2 * self.slope, offset=share * self.offset)


@dataclass(frozen=True)
class JointLimits:
    """Limits of n joints, each (n,), in the units of `LIMITS`; infinite when unknown. Positions are from q_min to
    q_max, the others from -limit to limit. velocity_by_position: what velocities are limited by as well, or None.
    """

    q_min: Array
    q_max: Array
    velocity: Array
    acceleration: Array
    jerk: Array
    torque: Array
    torque_rate: Array
    velocity_by_position: VelocityByPosition | None = field(default=None, kw_only=True)

    def range(self, kind: LimitKind) -> tuple[Array, Array]:
        """Middle and half-width (n,) of what is allowed; the middle is 0 where the half-width is infinite."""
        if kind.key != "position":
            half = getattr(self, kind.key)
            return np.zeros_like(half), half
        half = 0.5 * (self.q_max - self.q_min)
        with np.errstate(invalid="ignore"):  # from -infinity to infinity
            middle = 0.5 * (self.q_max + self.q_min)
        return np.where(np.isfinite(half), middle, 0.0), half

    def bound(self, kind: LimitKind, joint: int, value: float) -> float:
        """The limit that a joint's value is on the side of; for all but positions, its magnitude."""
        if kind.key != "position":
            return float(getattr(self, kind.key)[joint])
        above = value > 0.5 * (self.q_min[joint] + self.q_max[joint])
        return float(self.q_max[joint] if above else self.q_min[joint])

    @property
    def finite_velocity(self) -> Array:
        """Velocities (n,), rad/s, by which velocities are scaled: the limits, 1 for a joint without one."""
        return np.where(np.isfinite(self.velocity), self.velocity, 1.0)

    def velocity_at(self, q: Array, dq: Array) -> tuple[Array, Array]:
        """Magnitude (..., n) of the velocity limit at positions q (..., n), on the side of velocities dq (..., n), and
        its derivative by q. It is at least `STANDING`, rad/s."""
        if self.velocity_by_position is None:
            return np.broadcast_to(self.velocity, q.shape), np.zeros(q.shape)
        limits, by_distance = (np.split(x, 2, axis=-1) for x in self.velocity_by_position.towards_ends(q))
        limit = np.where(dq > 0, limits[0], limits[1])
        by_q = np.where(dq > 0, -by_distance[0], by_distance[1])
        free = (limit > STANDING) & (limit < self.velocity)
        return np.clip(limit, STANDING, self.velocity), np.where(free, by_q, 0.0)

    def shares(self, curves: Mapping[str, Array]) -> dict[str, Array]:
        """Shares (..., n) of each kind of limit, by key, for values (..., n) of some kinds: 1 and -1 are the limits. If
        the values include positions, velocity limits are those at these positions."""
        found = {}
        for kind in LIMITS:
            if kind.key in curves:
                middle, half = self.range(kind)
                if kind.key == "velocity" and "position" in curves:
                    half = self.velocity_at(curves["position"], curves["velocity"])[0]
                found[kind.key] = (curves[kind.key] - middle) / half
        return found

    def scaled(self, shares: Mapping[str, float]) -> JointLimits:
        """The limits scaled by shares, by key; limits without a share are unchanged."""
        by_position = self.velocity_by_position
        if by_position is not None:
            by_position = by_position.scaled(shares.get("velocity", 1.0))
        scaled = {key: share * getattr(self, key) for key, share in shares.items()}
        return replace(self, velocity_by_position=by_position, **scaled)


def joint_limits(
    n: int, given: Sequence[tuple[str, Mapping[str, Any]]]
) -> tuple[JointLimits, dict[str, tuple[str | None, ...]]]:
    """Limits of n joints from several sources, of which later ones override earlier ones, and the source of each.

    given: (source in words, name of a `JointLimits` field -> n numbers, NaN where the source says nothing).
    Returns the limits, and for each kind of limit the source for each joint, None where nobody gave one.
    """
    low = {"q_min": -np.inf, "q_max": np.inf} | dict.fromkeys(PLANNING_SHARES, np.inf)
    values = {name: np.full(n, none) for name, none in low.items()}
    sources: dict[str, list[str | None]] = {name: [None] * n for name in values}
    for source, numbers in given:
        for name, row in numbers.items():
            for j, value in enumerate(row):
                if not np.isnan(value):
                    values[name][j], sources[name][j] = value, source if np.isfinite(value) else None
    sources["position"] = sources.pop("q_min")
    del sources["q_max"]
    return JointLimits(*values.values()), {kind.key: tuple(sources[kind.key]) for kind in LIMITS}


# MoveIt's words for what `JointLimits` calls otherwise.
_MOVEIT = {"velocity": "velocity", "acceleration": "acceleration", "jerk": "jerk", "effort": "torque"}


def read_joint_limits(path: Path, names: Sequence[str], known: Collection[str]) -> dict[str, Array]:
    """Limits of the joints `names` from a `joint_limits.yaml` as MoveIt reads it; NaN where it gives none.

    known: all joints of the robot, a gripper's among them; the file may speak of those too. A limit counts when its
    `has_...` is not false. MoveIt's default scaling factors are of its requests, no limits, and are not read.
    Raises ScenarioError.
    """
    table = _read_yaml(path)
    joints = table.get("joint_limits") if isinstance(table, dict) else None
    if not isinstance(joints, dict) or not all(isinstance(entry, dict) for entry in joints.values()):
        raise ScenarioError(f"{path} has no table joint_limits with a table for each joint, as MoveIt writes it.")
    unknown = [str(name) for name in joints if name not in known]
    if unknown:
        raise ScenarioError(
            f"{path} limits {', '.join(unknown)}, which the URDF does not have; its joints are "
            f"{', '.join(sorted(known))}."
        )
    found = {name: np.full(len(names), np.nan) for name in ("q_min", "q_max", *_MOVEIT.values())}
    for j, joint in enumerate(names):
        entry = joints.get(joint, {})
        for word, name in _MOVEIT.items():
            if entry.get(f"has_{word}_limits", True) and f"max_{word}" in entry:
                found[name][j] = _number(path, joint, f"max_{word}", entry, positive=True)
        if entry.get("has_position_limits", True) and {"min_position", "max_position"} <= entry.keys():
            found["q_min"][j] = _number(path, joint, "min_position", entry)
            found["q_max"][j] = _number(path, joint, "max_position", entry)
            if found["q_min"][j] >= found["q_max"][j]:
                raise ScenarioError(f"{path}: min_position of {joint} is not below its max_position.")
    return found


def _read_yaml(path: Path) -> Any:
    from ruamel.yaml import YAML
    from ruamel.yaml.constructor import SafeConstructor
    from ruamel.yaml.error import YAMLError

    class WithAngles(SafeConstructor):
        """`!degrees 180` and `!radians 3.14`, as files for xacro have them."""

    WithAngles.add_constructor("!degrees", lambda self, node: float(np.deg2rad(float(self.construct_scalar(node)))))
    WithAngles.add_constructor("!radians", lambda self, node: float(self.construct_scalar(node)))
    yaml = YAML(typ="safe", pure=True)
    yaml.Constructor = WithAngles
    try:
        return yaml.load(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, YAMLError, RecursionError) as error:
        said = reason(error).strip().splitlines()[0]
        raise ScenarioError(f"{path} cannot be read ({said}); joint limits are a .yaml file.") from None


def _number(path: Path, joint: str, key: str, entry: Mapping[str, Any], positive: bool = False) -> float:
    value = entry[key]
    wanted = "a finite number greater than 0" if positive else "a finite number"
    fits = isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e12
    if not fits or (positive and value <= 0):
        raise ScenarioError(f"{path}: {key} of {joint} is {value!r}; it must be {wanted}.")
    return float(value)
