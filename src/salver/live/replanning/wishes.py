"""Requests to a live motion: a goal, a stop, a twist, a chunk. An impossible request is refused in a sentence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from numbers import Real
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from salver.errors import Status
from salver.geometry import Array, lean
from salver.live.replanning.objective import ChunkWanted, JointsWanted, Wanted
from salver.planning.fastest import AtPose, AtPosture, End, TransportProblem
from salver.planning.postures import PoseTarget
from salver.planning.trajopt.constraints.constraints import LEVEL_TOLERANCE

Pose = npt.ArrayLike | tuple[npt.ArrayLike, npt.ArrayLike]
Source = Literal["policy", "operator", "monitor"]
Frame = Literal["world", "tray"]
OPERATOR: Source = "operator"
# Priority of who requests: what a higher one requested is carried out first, and a stop of it only it may lift; the
# operator lifts those of the monitor, which is this package itself and whoever watches the arm.
PRIORITY: dict[str, int] = {"policy": 0, "operator": 1, "monitor": 1}
ACCEPTED = Status("accepted", "Accepted.", True)


@dataclass(frozen=True, eq=False)
class Goal:
    """A request to come to rest at an end of a motion. what: the end in words."""

    end: End
    what: str
    source: Source = OPERATOR
    id: int = 0


@dataclass(frozen=True, eq=False)
class Halt:
    """A request to come to rest as soon as possible."""

    source: Source = OPERATOR


@dataclass(frozen=True, eq=False)
class Follow:
    """A request to follow a stream or a chunk as closely as possible, and to stop when none comes after live time
    `until`, s.

    The last posture or pose of a chunk is held after that. ends: that posture or pose as a goal, in case it is not
    reached by then; or why it cannot be a goal.
    """

    wanted: Wanted
    until: float
    then: Wanted
    ends: Goal | str | None = None
    source: Source = OPERATOR
    id: int = 0

    def later(self, by: float) -> Follow:
        """The request with its chunk delayed by a time, s; a twist counts from when it was made."""
        if not isinstance(self.wanted, ChunkWanted):
            return self
        wanted = replace(self.wanted, t=self.wanted.t + by)
        return replace(self, wanted=wanted, then=wanted, until=self.until + by)


@dataclass(frozen=True, eq=False)
class Evade:
    """A request to keep clear of predicted obstacles."""


@dataclass(frozen=True, eq=False)
class Retime:
    """A request to continue along the same path at another share of full speed."""

    factor: float


UserWish = Goal | Halt | Follow
Wish = UserWish | Evade | Retime


def id_of(wish: Wish | None) -> int:
    """The number of the user's request that this one serves; 0 if it serves none."""
    return wish.id if isinstance(wish, Goal | Follow) else 0


@dataclass(frozen=True)
class RequestOptions:
    """Which requests are accepted, and how they are understood.

    Attributes:
        speed, turn, distance: m/s, rad/s and m; beyond that a number is taken to be in another unit, and refused.
        silence: s after which a twist expires. Doubled, an arm whose operator falls silent brakes 0.1 s later.
        slope_window: s of recent twists whose slope over time is extrapolated; if there are none in it, the last one
            within `slope_reach` s counts. At 0.04, a gentle stream is followed with 1.2 times the error.
        slope_least: s from the first of these twists to now, below which no slope is computed. At 0, after twists of 0
            and 0.1 m/s within 1 ms, the tray moved at up to 0.29 m/s.
    """

    speed: float = 5.0
    turn: float = 20.0
    distance: float = 100.0
    silence: float = 0.1
    slope_window: float = 0.025
    slope_reach: float = 0.06
    slope_least: float = 4e-3


STANDARD_REQUESTS = RequestOptions()
ORTHONORMAL = 1e-6  # by which a rotation may fail to be one: rounding


class Refused(Exception):
    """A request that cannot be carried out; its text says why."""

    @property
    def status(self) -> Status:
        return Status("refused", str(self), False)


def shown(value: object) -> str:
    """The beginning of a value's text, in quotes, for a message."""
    try:
        return repr(str(value)[:40])
    except Exception:  # a number of thousands of digits
        return f"a value of type {type(value).__name__} that is no text"


def is_source(value: object) -> bool:
    """Whether a value is one of the sources of requests."""
    return isinstance(value, str) and value in PRIORITY


def known(source: Source) -> Source:
    """A source of requests. Raises Refused for anything else."""
    if not is_source(source):
        raise Refused(f"source is {shown(source)}; it must be one of {', '.join(PRIORITY)}")
    return source


def is_flag(value: object) -> bool:
    """Whether a value is True or False itself, and not only truthy."""
    return isinstance(value, bool | np.bool_)


def _plain(value: Any, depth: int) -> bool:
    """Whether a value consists of real numbers, nested up to a depth, without truth values, texts, complex or masked
    numbers."""
    if isinstance(value, list | tuple):
        return depth > 0 and all(_plain(one, depth - 1) for one in value)
    if isinstance(value, np.ma.MaskedArray):
        return False
    if isinstance(value, Real):
        return not isinstance(value, bool)
    return getattr(np.asarray(value), "dtype", np.dtype(object)).kind in "iuf"


def numbers(value: Any, shape: tuple[int, ...], what: str) -> Array:
    """An array of finite numbers with this shape; raises Refused for other values."""
    try:
        array = np.array(value, dtype=float) if _plain(value, len(shape)) else None
    except Exception:  # whatever is in what was given
        array = None
    if array is None:
        raise Refused(f"{what} is not an array of numbers; it must be {shape} finite numbers")
    if array.shape != shape:
        raise Refused(f"{what} has shape {array.shape}; it must be {shape}")
    if not np.all(np.isfinite(array)):
        raise Refused(f"{what} has values that are not finite")
    return array


def factor_of(value: Any, least: float) -> float:
    """A share of full speed from a user's value; raises Refused for an impossible one."""
    try:
        factor = float(numbers(value, (), "the factor"))
    except Refused:
        factor = np.nan
    if not least <= factor <= 1.0:
        raise Refused(f"factor is {shown(value)}; it must be a number from {least:g} to 1; call hold() to stop")
    return factor


def posture_goal(problem: TransportProblem, q: npt.ArrayLike) -> Goal:
    """A posture (n,), rad, at rest."""
    posture = numbers(q, (problem.n,), "the posture")
    limits, names = problem.limits, problem.arm.joint_names
    for value, low, high, name in zip(posture, limits.q_min, limits.q_max, names, strict=True):
        if not low <= value <= high:
            raise Refused(f"{name} would be at {value:.4g}; it must be within [{low:.4g}, {high:.4g}]")
    return Goal(AtPosture(posture), "a posture")


def _poses(
    value: Any, each: tuple[int, ...], problem: TransportProblem, options: RequestOptions
) -> tuple[Array, Array, bool]:
    """p_SB (*each, 3), R_SB (*each, 3, 3) of the first object, with the tray level unless rotations are given; and
    whether they are."""
    turned = isinstance(value, tuple) and len(value) == 2 and not np.isscalar(value[0])
    p = numbers(value[0] if turned else value, (*each, 3), "positions" if each else "the position")
    R = np.tile(problem.items[0].R_EB, (*each, 1, 1))
    if turned:
        R = numbers(value[1], (*each, 3, 3), "rotations" if each else "the rotation")
    one, far = "a" if each else "the", float(np.abs(p).max())
    if far > options.distance:
        raise Refused(f"{one} position is {far:.3g} m away in S; it must be at most {options.distance:g} m, in S")
    if np.abs(R @ np.swapaxes(R, -1, -2) - np.eye(3)).max() > ORTHONORMAL or (np.linalg.det(R) < 0).any():
        raise Refused(f"{one} rotation is not a rotation matrix: its rows must be orthonormal and right-handed")
    return p, R, turned


def pose_goal(problem: TransportProblem, pose: Pose, options: RequestOptions = STANDARD_REQUESTS) -> Goal:
    """The first object's frame B at p_SB (3,), m, upright with any heading; or at (p_SB, R_SB) with R_SB (3, 3)."""
    p, rotation, turned = _poses(pose, (), problem, options)
    first = problem.items[0]
    leans, most = float(lean(rotation @ first.R_EB.T)), max(problem.max_tilt, LEVEL_TOLERANCE)
    if leans > most:
        raise Refused(
            f"the goal leans the tray by {np.rad2deg(leans):.3g} deg; it may lean by {np.rad2deg(most):.3g} deg"
        )
    target = PoseTarget(p, rotation, first.p_EB, first.R_EB, yaw_free=not turned)
    return Goal(AtPose(target), f"({p[0]:.3f}, {p[1]:.3f}, {p[2]:.3f}) m")


def twist_of(
    v: npt.ArrayLike, omega: npt.ArrayLike, R: Array | None, options: RequestOptions = STANDARD_REQUESTS
) -> Array:
    """The tray's twist (6,) in S of v (3,), m/s, and omega (3,), rad/s, in a frame that is turned by R; None: in S."""
    twist = []
    for value, most, what, unit in ((v, options.speed, "v", "m/s"), (omega, options.turn, "omega", "rad/s")):
        found = numbers(value, (3,), what)
        if np.linalg.norm(found) > most:
            raise Refused(f"{what} is {np.linalg.norm(found):.3g}; it must be at most {most:g} {unit}")
        twist.append(found if R is None else R @ found)
    return np.concatenate(twist)


def rates_of(problem: TransportProblem, dq: npt.ArrayLike, options: RequestOptions = STANDARD_REQUESTS) -> Array:
    """Joint velocities (n,), rad/s or m/s."""
    found, arm = numbers(dq, (problem.n,), "dq"), problem.arm
    most = np.where(arm.linear, options.speed, options.turn)
    for j in np.flatnonzero(np.abs(found) > most)[:1]:
        raise Refused(f"dq of {arm.joint_names[j]} is {found[j]:.3g}; it must be at most {most[j]:g} {arm.unit(j)}/s")
    return found


def stream_wish(
    heard: Sequence[tuple[float, Array]], latest: Array, now: float, kind: type[JointsWanted],
    options: RequestOptions = STANDARD_REQUESTS,
) -> Follow:  # fmt: skip
    """The request that follows the latest velocities (m,) of a stream. heard: live times and velocities of the stream
    so far."""
    before = [(t - now, old) for t, old in heard if now - options.slope_reach <= t < now]
    recent = [x for x in before if -x[0] <= options.slope_window + 1e-9] or before[-1:]
    slope = still = np.zeros_like(latest)
    if recent and -recent[0][0] >= options.slope_least:  # the least squares' one
        t, past = (np.array(x) for x in zip(*recent, (0.0, latest), strict=True))
        away = t - t.mean()
        slope = away @ past / (away @ away)
    return Follow(kind(latest, slope, now), now + options.silence, kind(still, still, now))


def chunk_wish(
    problem: TransportProblem, times: npt.ArrayLike, poses: Any, joints: npt.ArrayLike | None, now: float,
    factor: float = 1.0, options: RequestOptions = STANDARD_REQUESTS,
) -> Follow:  # fmt: skip
    """The request for poses or postures at times (C,) from now on, s, at a share of that speed."""
    if (poses is None) == (joints is None):
        raise Refused("a chunk is of poses or of joints, one of them")
    try:
        count = len(times)  # type: ignore[arg-type]
    except TypeError:
        count = 0
    t = numbers(times, (count,), "times")
    if not count or t[0] < 0 or np.any(np.diff(t) <= 0):
        raise Refused("times must be one or more, at least 0, and each later than the one before")
    t = now + t / factor
    if joints is not None:
        q = numbers(joints, (count, problem.n), "joints")
        outside = np.argwhere((q < problem.limits.q_min) | (q > problem.limits.q_max))
        for row, j in outside[:1]:
            raise Refused(
                f"{problem.arm.joint_names[j]} would be at {q[row, j]:.4g} in posture {row}, beyond its limits"
            )
        wanted, goal = ChunkWanted(t, None, None, q), partial(posture_goal, problem, q[-1])
    else:
        p, R, _ = _poses(poses, (count,), problem, options)
        first = problem.items[0]
        R_SE = R @ first.R_EB.T
        wanted = ChunkWanted(t, p - R_SE @ first.p_EB, R_SE, None)
        goal = partial(pose_goal, problem, (p[-1], R[-1]), options)
    try:
        ends: Goal | str = goal()
    except Refused as reason:
        ends = str(reason)
    return Follow(wanted, float(t[-1]), wanted, ends)
