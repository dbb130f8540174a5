"""What may be asked of a live motion: a goal, a stop, a twist, a chunk. What cannot be is refused in a sentence."""

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
    """To an end, at rest there. what: it is, in words."""

    end: End
    what: str
    source: Source = OPERATOR
    id: int = 0


@dataclass(frozen=True, eq=False)
class Halt:
    """To rest, as soon as may be."""

    source: Source = OPERATOR


@dataclass(frozen=True, eq=False)
class Follow:
    """To do what is wanted as nearly as may be, and to stop when nothing is heard after live time `until`, s.

    Of a chunk that ends in a posture or pose, it is held then. ends: this, as a goal for what was not done of it by
    then; or why it can be none.
    """

    wanted: Wanted
    until: float
    then: Wanted
    ends: Goal | str | None = None
    source: Source = OPERATOR
    id: int = 0

    @property
    def streamed(self) -> bool:
        """Whether it is of velocities, of a stream of which each replaces the one before."""
        return isinstance(self.wanted, JointsWanted)

    def later(self, by: float) -> Follow:
        """The same chunk, so many s later; a twist counts from when it was said."""
        if not isinstance(self.wanted, ChunkWanted):
            return self
        wanted = replace(self.wanted, t=self.wanted.t + by)
        return replace(self, wanted=wanted, then=wanted, until=self.until + by)


@dataclass(frozen=True, eq=False)
class Evade:
    """To keep clear of what is predicted to pass: nothing, where what is committed does; else rest elsewhere."""

    source: Source = "monitor"


@dataclass(frozen=True, eq=False)
class Retime:
    """To go on along the same path at another factor of full speed."""

    factor: float
    source: Source = "monitor"


Wish = Goal | Halt | Follow | Evade | Retime


def id_of(wish: Wish | None) -> int:
    """The number of the request that it is for; 0 where it is for none."""
    return wish.id if isinstance(wish, Goal | Follow) else 0


@dataclass(frozen=True)
class RequestOptions:
    """What is accepted of a request, and how it is understood.

    Attributes:
        speed, turn, distance: m/s, rad/s and m; beyond that a number is taken to be in another unit, and refused.
        silence: s after a twist at which it counts no more. Doubled, an arm whose hand fell silent brakes 0.1 s later.
        slope_window: s of twists of late whose slope over time is believed to go on; where there are none so near, the
            last one of `slope_reach` s counts. At 0.04, a gentle hand is followed with 1.2 times the error.
        slope_least: s from the first of them to now; of less no slope is told. At 0, after 0 and 0.1 m/s within 1 ms,
            the tray went at up to 0.29 m/s.
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
    """The beginning of what was given, in quotes."""
    try:
        return repr(str(value)[:40])
    except Exception:  # a number of thousands of digits
        return f"a {type(value).__name__} that is no text"


def is_source(value: object) -> bool:
    """Whether it is one of those that may request."""
    return isinstance(value, str) and value in PRIORITY


def is_flag(value: object) -> bool:
    """Whether it is True or False, and nothing that only counts as such."""
    return isinstance(value, bool | np.bool_)


def _plain(value: Any, depth: int) -> bool:
    """Whether it is real numbers, nested at most so deep: no truth values, texts, complex or masked numbers."""
    if isinstance(value, list | tuple):
        return depth > 0 and all(_plain(one, depth - 1) for one in value)
    if isinstance(value, np.ma.MaskedArray):
        return False
    if isinstance(value, Real):
        return not isinstance(value, bool)
    return getattr(np.asarray(value), "dtype", np.dtype(object)).kind in "iuf"


def numbers(value: Any, shape: tuple[int, ...], what: str) -> Array:
    """An array of finite numbers of a shape; raises Refused where it is none."""
    try:
        array = np.array(value, dtype=float) if _plain(value, len(shape)) else None
    except Exception:  # whatever is in what was given
        array = None
    if array is None:
        raise Refused(f"{what} is no array of numbers; it must be {shape} finite numbers")
    if array.shape != shape:
        raise Refused(f"{what} has shape {array.shape}; it must be {shape}")
    if not np.all(np.isfinite(array)):
        raise Refused(f"{what} has values that are not finite")
    return array


def factor_of(value: Any, least: float) -> float:
    """A factor of full speed."""
    try:
        factor = float(numbers(value, (), "the factor"))
    except Refused:
        factor = np.nan
    if not least <= factor <= 1.0:
        raise Refused(f"factor is {shown(value)}; it must be a number from {least:g} to 1, and hold() stops")
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
        raise Refused(f"{one} rotation is none: its rows must be orthonormal and right-handed")
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
    """The latest velocities (m,) of a stream, of a kind. heard: live times, and what was followed before."""
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
    """Poses or postures at times (C,) from now on, s; at a factor of that speed."""
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


def why_not(problem: TransportProblem, goal: Goal) -> str:
    """Why nothing can come to rest there, or nothing: what stands in the way of it."""
    if problem.keep_out is None:
        return ""
    parts = problem.keep_out.parts
    if isinstance(goal.end, AtPose):
        headings = goal.end.target.headings(16)
        met = None
        for target in headings:
            met = parts.in_the_way(*target.tray_pose)
            if met is None:
                break
        if met is not None:
            return f"there the {met[0]} would be inside {met[1]}{', whichever way it faces' * (len(headings) > 1)}"
    if isinstance(goal.end, AtPosture):
        touch = parts.first_touch(goal.end.q[None])
        if touch is not None:
            return f"there {touch.first} and {touch.second} would touch"
    return ""
