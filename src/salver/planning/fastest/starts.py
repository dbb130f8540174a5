"""Where the search for the fastest motion begins: postures at both ends, and paths from one to the other."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain

import numpy as np

from salver.geometry import Array
from salver.models.arm_limits import POSITION
from salver.planning.fastest.around import way_around
from salver.planning.fastest.ends import AtPose, AtPosture, End
from salver.planning.fastest.obstacles import ENOUGH_AT_ENDS
from salver.planning.fastest.problem import TransportProblem
from salver.planning.fastest.spline import RestSpline, SplineMotion, min_jerk_blend
from salver.planning.postures import postures_along

ATTEMPTS = 40  # random postures from which the ends are sought,
MORE_ATTEMPTS = 100  # and from which each of them is when more are wanted,
ENOUGH = 6  # until there are so many different ones in which nothing touches
OTHERS = 6  # goal postures that are sought from a start posture that is given
SLIDES, SLIDE = 12, 0.15  # steps, rad, by which an end posture that touches something is slid free
APART = 0.3  # rad between pairs of ends that count as different
ALONG = 31  # postures by which a path is looked at
LOOKS = 6000  # postures that are looked at for one way around
BEND = 0.25  # rad; standard deviation of what a bent path strays


@dataclass(frozen=True, eq=False)
class Ends:
    """Postures (n,) at the start and at the goal. cost: s, about; what a motion between them may take, dearer near
    joint limits and where something is near. free: whether nothing touches in either."""

    start: Array
    goal: Array
    cost: float
    free: bool


@dataclass(frozen=True, eq=False)
class Start:
    """An initial path: postures (N, n), gone through from rest to rest. name: of what it is."""

    name: str
    postures: Array

    @cached_property
    def _length(self) -> Array:
        steps = np.linalg.norm(np.diff(self.postures, axis=0), axis=1)
        along = np.append(0.0, np.cumsum(steps))
        return np.asarray(along / along[-1] if along[-1] > 0 else np.linspace(0, 1, len(along)))

    def path(self, s: Array) -> Array:
        """(len(s), n) postures at s in [0, 1]."""
        u = min_jerk_blend(s)
        return np.stack([np.interp(u, self._length, joint) for joint in self.postures.T], axis=1)

    def motion(self, problem: TransportProblem, spline: RestSpline) -> SplineMotion:
        """Along it, in a comfortable time."""
        s = np.linspace(0, 1, 201)
        q = self.path(s)
        if problem.moving:
            duration = braking_time(problem) + float(np.max(np.abs(q[-1] - q[0]) / problem.limits.velocity))
        else:
            duration = _comfortable_duration(problem, np.abs(np.gradient(q, s, axis=0)).max(axis=0))
        return SplineMotion(spline, spline.fit(s, q), duration)


def ends(problem: TransportProblem, rng: np.random.Generator, more: bool = False, few: int | None = None) -> list[Ends]:
    """Pairs of end postures, the most promising first; without any that touch something, unless there are no others.

    With the start posture given: its goal posture is the one nearest to it, then others. With none given: nearby
    postures that are clear of joint limits and of one another's parts. Where none of them is free, or more are wanted,
    both ends are sought independently of one another too, which takes longer.
    few: with the start posture given, so many are enough; then nothing random decides of the first.
    """
    found: list[Ends] = []
    limits, n, given = problem.limits, problem.n, problem.start_posture
    centre, half = limits.range(POSITION)
    half = np.where(np.isfinite(half), half, np.pi)
    coasting = np.zeros(n)  # a moving start goes on for a while
    if isinstance(problem.start, AtPosture) and problem.start.moving:
        coasting = 0.5 * problem.start.rates[0] * braking_time(problem)

    def add(start: Array, goal: Array | None) -> None:
        goal = None if goal is None else _slid_free(problem, problem.goal, goal)
        if goal is None:
            return
        others = (_apart(problem, goal, e.goal) + _apart(problem, start, e.start) for e in found)
        if min(others, default=np.inf) <= APART:
            return
        both = np.stack([start, goal])
        cost = float(np.max(np.abs(goal - start) / limits.velocity))
        cost += float(np.max(np.abs((both - centre) / half)) ** 8)
        free = True
        if problem.keep_out is not None:
            distance = problem.keep_out.parts.clearance(both)
            free = bool(distance.min() > 0.0)
            cost += 20 * max(0.0, 0.03 - float((distance - problem.keep_out.required).min()))
        found.append(Ends(start, goal, cost, free))

    for attempt in range(ATTEMPTS if given is None else OTHERS):
        guess = centre + (0.7 * half * rng.uniform(-1, 1, n) if attempt else 0.0)
        if given is None:
            start = problem.start.nearest(problem.arm, limits, guess)
            if start is not None:
                start = _slid_free(problem, problem.start, start)
                add(start, problem.goal.nearest(problem.arm, limits, start))
        else:
            spread = attempt / OTHERS
            add(given, problem.goal.nearest(problem.arm, limits, (1 - spread) * (given + coasting) + spread * guess))
            if few is not None and len(found) >= few and found[0].free:
                break
    if more or not any(pair.free for pair in found):
        starts = _free_postures(problem, problem.start, [e.start for e in found], rng) if given is None else [given]
        for goal in _free_postures(problem, problem.goal, [e.goal for e in found], rng):
            for start in starts:
                add(start, goal)
    if given is None or not all(pair.free for pair in found[:1]):
        found.sort(key=lambda pair: pair.cost)
    return [pair for pair in found if pair.free] or found


def _free_postures(problem: TransportProblem, end: End, known: list[Array], rng: np.random.Generator) -> list[Array]:
    """Different postures at an end in which nothing touches, those that are known first; as many as are enough."""
    limits = problem.limits
    low, high = np.maximum(limits.q_min, -np.pi), np.minimum(limits.q_max, np.pi)
    found: list[Array] = []
    candidates = chain(known, (end.nearest(problem.arm, limits, rng.uniform(low, high)) for _ in range(MORE_ATTEMPTS)))
    for q in candidates:
        if q is None or min((_apart(problem, q, other) for other in found), default=np.inf) <= APART:
            continue
        if problem.keep_out is None or problem.keep_out.parts.first_touch(q[None]) is None:
            found.append(q)
        if len(found) >= ENOUGH:
            break
    return found


def _slid_free(problem: TransportProblem, end: End, q: Array) -> Array:
    """A posture in which nothing touches, slid to from one at an end by the freedom that the end leaves; as far as it
    came, when it did not come free."""
    keep_out, arm = problem.keep_out, problem.arm
    if keep_out is None:
        return q
    for _ in range(SLIDES):
        distance = keep_out.distances(q[None])[0] - ENOUGH_AT_ENDS
        if distance.min() >= 0:
            break
        near = np.flatnonzero(distance < 0)
        away = -distance[near] @ keep_out.gradient(q[None], np.zeros_like(near), near)
        jacobian = end.residual(arm, q)[1]
        away -= np.linalg.pinv(jacobian, rcond=1e-3) @ (jacobian @ away)
        size = float(np.abs(away).max())
        if size < 1e-6:
            break
        slid = end.nearest(arm, problem.limits, q + SLIDE * away / size, 20)
        if slid is None:
            break
        q = slid
    return q


def _apart(problem: TransportProblem, q: Array, other: Array) -> float:
    """Largest difference of a joint; whole turns are none, as the arm stands and moves the same."""
    turns = np.where(problem.arm.linear, 0.0, np.round((q - other) / (2 * np.pi)))
    return float(np.abs(q - other - 2 * np.pi * turns).max())


def between(problem: TransportProblem, pair: Ends) -> TransportProblem:
    """The problem with distances to keep that both of its end postures keep."""
    if problem.keep_out is None:
        return problem
    return replace(problem, keep_out=problem.keep_out.kept_by(np.stack([pair.start, pair.goal])))


def straight(pair: Ends) -> Start:
    """Straight in joint space."""
    return Start("straight", np.stack([pair.start, pair.goal]))


def bent(pair: Ends, rng: np.random.Generator) -> Start:
    """A random bend beside the straight path."""
    u = np.linspace(0, 1, ALONG)[:, None]
    bell = (4 * u * (1 - u)) ** 3 * rng.normal(0.0, BEND, len(pair.start))
    return Start("bent", pair.start + u * (pair.goal - pair.start) + bell)


def tray_line(problem: TransportProblem, pair: Ends) -> Start | None:
    """The tray straight from pose to pose, as plans of a given duration carry it; None where the arm cannot."""
    arm, limits = problem.arm, problem.limits
    if not isinstance(problem.goal, AtPose):
        return None
    (p_0, R_0), (p_1, _) = arm.tray_pose(pair.start), arm.tray_pose(pair.goal)
    u = np.linspace(0, 1, ALONG)[:, None]
    postures, reached = postures_along(arm, p_0 + u * (p_1 - p_0), np.tile(R_0, (ALONG, 1, 1)), pair.start)
    last = problem.goal.nearest(arm, limits, postures[-1])
    if reached < ALONG or last is None or np.any(postures < limits.q_min) or np.any(postures > limits.q_max):
        return None
    if np.abs(last - postures[-1]).max() > APART:
        return None
    postures[-1] = last
    return Start("tray line", postures)


def around(problem: TransportProblem, pairs: list[Ends], rng: np.random.Generator) -> Start | None:
    """A way that touches nothing, between the ends of one of the pairs; None when none was found."""
    way = way_around(problem, [p.start for p in pairs], [p.goal for p in pairs], rng, LOOKS)
    return None if way is None else Start("way around", way)


def touches(problem: TransportProblem, start: Start) -> float:
    """How deep in something a path is at its worst, m: 0 where nothing comes nearer than required."""
    if problem.keep_out is None:
        return 0.0
    return max(0.0, -float(problem.keep_out.distances(start.path(np.linspace(0, 1, ALONG))).min()))


def braking_time(problem: TransportProblem) -> float:
    """Twice the time in which the start's velocity could be braked if nothing slid, s."""
    start = problem.start
    assert isinstance(start, AtPosture)
    speed = np.abs(start.rates[0])
    limits = problem.limits
    by_limits = np.where(np.isfinite(limits.acceleration), limits.acceleration, 10.0)
    return float(np.clip(4.0 * np.max(speed / by_limits), 0.1, 10.0))


def _comfortable_duration(problem: TransportProblem, speed: Array) -> float:
    """A duration at which joint velocity is far from binding, s; `speed` (n,) is |dq/ds| at its largest."""
    return float(np.clip(2.5 * np.max(speed / problem.limits.velocity), 1.0, 60.0))
