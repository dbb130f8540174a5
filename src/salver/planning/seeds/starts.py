"""Initial guesses of the search for the fastest motion: postures at both ends, and paths between them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import chain

import numpy as np

from salver.geometry import GRAVITY_S, Array, interpolated
from salver.models.arm.arm_limits import POSITION
from salver.planning.seeds.around import way_around
from salver.planning.trajopt.bound import least_duration, least_time
from salver.planning.trajopt.constraints.obstacles import APART as APART_FROM_TOUCHING
from salver.planning.trajopt.constraints.obstacles import CLEARANCE
from salver.planning.trajopt.ends import AtPosture, End
from salver.planning.trajopt.problem import TransportProblem
from salver.planning.trajopt.spline import RestSpline, SplineMotion, min_jerk_blend

APART = 0.3  # rad between pairs of ends that count as different,
ALONG = 31  # postures by which a path is looked at


@dataclass(frozen=True)
class EndOptions:
    """Options of the search for end postures.

    attempts: random postures from which both are, in so many `batches`, no more than are needed. again: from which each
    of them is when more are wanted, until so many as are `enough` are different and touch nothing. others: goal
    postures that are sought from a start posture that is given. Doubled, each takes twice the time where postures that
    touch nothing are rare, and finds more of them.
    roundabout: times what friction takes on the way: a goal posture to which the joints take longer is followed by
    others. at_limits: s that a posture at the limit of a joint counts for. too_near: s/m, that it counts for to be
    nearer than 3 cm to something. Doubled, searches begin further from what limits them, with longer ways.
    slides, slide: steps, and rad of each, by which an end posture that touches something is slid free.
    """

    attempts: int = 120
    batches: int = 3
    again: int = 100
    enough: int = 6
    others: int = 6
    roundabout: float = 1.5
    at_limits: float = 0.1
    too_near: float = 3.0
    slides: int = 12
    slide: float = 0.15


USUAL = EndOptions()


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
        return interpolated(self._length, self.postures, u)

    def least(self, problem: TransportProblem) -> float:
        """About how long a motion along it takes, s: what the joints take to go as far, and friction lets the tray."""
        far = np.abs(np.diff(self.postures, axis=0)).sum(axis=0)
        p_SE = np.array([problem.arm.tray_pose(q)[0] for q in self.path(np.linspace(0, 1, ALONG))])
        way = float(np.linalg.norm(np.diff(p_SE, axis=0), axis=1).sum())
        return float(np.hypot(least_duration(problem.limits, np.zeros_like(far), far), _by_contact(problem, way)))

    def motion(self, problem: TransportProblem, spline: RestSpline) -> SplineMotion:
        """Along it, in a comfortable time."""
        s = np.linspace(0, 1, 201)
        q = self.path(s)
        if problem.moving:
            duration = braking_time(problem) + float(np.max(np.abs(q[-1] - q[0]) / problem.limits.velocity))
        else:
            duration = _comfortable_duration(problem, np.abs(np.gradient(q, s, axis=0)).max(axis=0))
        return SplineMotion(spline, spline.fit(s, q), duration)


def ends(
    problem: TransportProblem,
    rng: np.random.Generator,
    more: bool = False,
    few: int | None = None,
    options: EndOptions = USUAL,
) -> list[Ends]:
    """Pairs of end postures, the most promising first; without any that touch something, unless there are no others.

    With the start posture given: its goal posture is the one nearest to it, then others, unless that one touches
    something or is far. With none given: nearby
    postures that are clear of joint limits and of one another's parts. Where none of them is free, or more are wanted,
    both ends are sought independently of one another too, which takes longer.
    few: so many are enough. With the start posture given nothing random decides of the first.
    """
    given = problem.start_posture
    found = _Found(problem, options)
    if given is None:
        for attempt in range(0, options.attempts, options.attempts // options.batches):
            new = found.nearby(_sought(problem, rng, attempt, options), few)
            if not new or few is None or sum(pair.free for pair in found.pairs) >= few:
                break
    else:
        coasting = np.zeros(problem.n)  # a moving start goes on for a while
        if isinstance(problem.start, AtPosture) and problem.start.moving:
            coasting = 0.5 * problem.start.rates[0] * braking_time(problem)
        for attempt in range(options.others):
            random, spread = guess(problem, rng, attempt), attempt / options.others
            found.add(
                given,
                problem.goal.nearest(problem.arm, problem.limits, (1 - spread) * (given + coasting) + spread * random),
            )
            if few is not None and len(found.pairs) >= few and _fine(problem, found.pairs[0], options):
                break
    pairs = found.pairs
    if more or not any(pair.free for pair in pairs):
        if given is None:
            starts = _free_postures(problem, problem.start, [e.start for e in pairs], rng, options)
        else:
            starts = [given]
        for goal in _free_postures(problem, problem.goal, [e.goal for e in pairs], rng, options):
            for start in starts:
                found.add(start, goal)
    if given is None or not all(_fine(problem, pair, options) for pair in pairs[:1]):
        pairs.sort(key=lambda pair: pair.cost)
    return [pair for pair in pairs if pair.free] or pairs


def _fine(problem: TransportProblem, pair: Ends, options: EndOptions) -> bool:
    """Whether nothing touches in either of two postures, and the joints do not take far longer from one to the other
    than friction takes: then they go a roundabout way, and another goal posture is nearer."""
    way = float(np.linalg.norm(np.subtract(*(problem.arm.tray_pose(q)[0] for q in (pair.start, pair.goal)))))
    return pair.free and pair.cost < options.roundabout * _by_contact(problem, way)


def guess(problem: TransportProblem, rng: np.random.Generator, attempt: int) -> Array:
    """The middle of the joints' ranges, then random postures around it."""
    centre, half = problem.limits.range(POSITION)
    half = np.where(np.isfinite(half), half, np.pi)
    return np.asarray(centre + (0.7 * half * rng.uniform(-1, 1, problem.n) if attempt else 0.0))


def _sought(
    problem: TransportProblem, rng: np.random.Generator, first: int, options: EndOptions
) -> list[tuple[float, Array, Array]]:
    """Costs and pairs of postures, the goal's near the start's, the cheapest first."""
    arm, limits = problem.arm, problem.limits
    found: list[tuple[float, Array, Array]] = []
    starts: list[Array] = []
    for attempt in range(first, first + options.attempts // options.batches):
        start = problem.start.nearest(arm, limits, guess(problem, rng, attempt), 25)  # of 97 %, by then
        if start is None or any(np.abs(start - other).max() < 1e-6 for other in starts):
            continue
        starts.append(start)
        goal = problem.goal.nearest(arm, limits, start)
        if goal is not None:
            found.append((_cost(problem, start, goal, options), start, goal))
    return sorted(found, key=lambda pair: pair[0])


def _cost(problem: TransportProblem, start: Array, goal: Array, options: EndOptions) -> float:
    """About how long a motion between two postures takes, s; dearer near joint limits."""
    limits = problem.limits
    centre, half = limits.range(POSITION)
    half = np.where(np.isfinite(half), half, np.pi)
    near = float(np.max(np.abs((np.stack([start, goal]) - centre) / half)) ** 8)
    return least_duration(limits, start, goal) + options.at_limits * near


@dataclass(eq=False)
class _Found:
    """Pairs that were found so far."""

    problem: TransportProblem
    options: EndOptions
    pairs: list[Ends] = field(default_factory=list)

    def nearby(self, sought: list[tuple[float, Array, Array]], few: int | None) -> bool:
        """Add those of the pairs that can be slid free, until `few` are that nothing that follows is cheaper than.
        Whether one is new."""
        problem, before = self.problem, len(self.pairs)
        for cost, start, goal in sought:
            if few is not None and sum(pair.free and pair.cost <= cost for pair in self.pairs) >= few:
                break
            free = _slid_free(problem, problem.start, start, self.options)
            self.add(free, goal if free is start else problem.goal.nearest(problem.arm, problem.limits, free))
        return len(self.pairs) > before

    def add(self, start: Array, goal: Array | None) -> None:
        """A pair, its goal slid free where it can be, unless one that hardly differs is there."""
        problem = self.problem
        goal = None if goal is None else _slid_free(problem, problem.goal, goal, self.options)
        if goal is None:
            return
        if problem.start_posture is None:
            start, goal = _unwound(problem, start, goal)
        others = (_apart(problem, goal, e.goal) + _apart(problem, start, e.start) for e in self.pairs)
        if min(others, default=np.inf) <= APART:
            return
        cost, free = _cost(problem, start, goal, self.options), True
        if problem.keep_out is not None:
            distance = problem.keep_out.parts.clearance(np.stack([start, goal]))
            free = bool(distance.min() > APART_FROM_TOUCHING)
            near = float((distance - problem.keep_out.required).min())
            cost += self.options.too_near * max(0.0, 0.03 - near)
        self.pairs.append(Ends(start, goal, cost, free))


def _free_postures(
    problem: TransportProblem, end: End, known: list[Array], rng: np.random.Generator, options: EndOptions = USUAL
) -> list[Array]:
    """Different postures at an end in which nothing touches, those that are known first; as many as are enough."""
    limits = problem.limits
    low, high = np.maximum(limits.q_min, -np.pi), np.minimum(limits.q_max, np.pi)
    found: list[Array] = []
    candidates = chain(known, (end.nearest(problem.arm, limits, rng.uniform(low, high)) for _ in range(options.again)))
    for q in candidates:
        if q is None or min((_apart(problem, q, other) for other in found), default=np.inf) <= APART:
            continue
        if problem.keep_out is None or problem.keep_out.parts.first_touch(q[None]) is None:
            found.append(q)
        if len(found) >= options.enough:
            break
    return found


def _slid_free(problem: TransportProblem, end: End, q: Array, options: EndOptions = USUAL) -> Array:
    """A posture in which nothing touches, slid to from one at an end by the freedom that the end leaves; as far as it
    came, when it did not come free."""
    keep_out, arm = problem.keep_out, problem.arm
    if keep_out is None:
        return q
    free, vain = -np.inf, 0
    for _ in range(options.slides):
        distance = keep_out.distances(q[None])[0] - CLEARANCE.enough_at_ends
        vain = 0 if distance.min() > free else vain + 1
        free = max(free, float(distance.min()))
        if free >= 0 or vain >= 4:  # slides in turn that came no further
            break
        near = np.flatnonzero(distance < 0)
        away = -distance[near] @ keep_out.gradient(q[None], np.zeros_like(near), near)
        jacobian = end.residual(arm, q)[1]
        away -= np.linalg.pinv(jacobian, rcond=1e-3) @ (jacobian @ away)
        size = float(np.abs(away).max())
        if size < 1e-6:
            break
        slid = end.nearest(arm, problem.limits, q + options.slide * away / size, 20)
        if slid is None:
            break
        q = slid
    return q


def standing_at(problem: TransportProblem, end: End, rng: np.random.Generator) -> Iterator[Array]:
    """Postures at an end: the one that is nearest to the middle of the joints' ranges, that slid free of what it comes
    too near to, and then others in which nothing touches."""
    middle = end.nearest(problem.arm, problem.limits, problem.limits.range(POSITION)[0])
    known = [] if middle is None else [middle, _slid_free(problem, end, middle)]
    yield from known
    yield from _free_postures(problem, end, known[1:], rng)


def _unwound(problem: TransportProblem, start: Array, goal: Array) -> tuple[Array, Array]:
    """The same two postures by whole turns as near to the middle of the joints' ranges as they can be: nobody wants an
    arm that begins a turn away, and cables less."""
    middle = problem.limits.range(POSITION)[0]
    turns = np.where(problem.arm.linear, 0.0, np.round((0.5 * (start + goal) - middle) / (2 * np.pi)))
    return start - 2 * np.pi * turns, goal - 2 * np.pi * turns


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
    return Start("straight path of the joints", np.stack([pair.start, pair.goal]))


def around(problem: TransportProblem, pairs: list[Ends], rng: np.random.Generator) -> Start | None:
    """A way that touches nothing, from a start to a goal of the pairs; None when none was found."""
    starts, goals = (
        _different(problem, postures) for postures in zip(*((p.start, p.goal) for p in pairs), strict=True)
    )
    way = way_around(problem, starts, goals, rng, looks=6000)  # postures; half a second, where there is no way
    return None if way is None else Start("way around", way)


def _different(problem: TransportProblem, postures: Iterable[Array]) -> list[Array]:
    """Those of postures (n,) that differ."""
    found: list[Array] = []
    for q in postures:
        if all(_apart(problem, q, other) > APART for other in found):
            found.append(q)
    return found


def open_to(problem: TransportProblem, start: Start) -> bool:
    """Whether a path can be gone along slowly, or nearly so: nothing touches, and no tray leans so far that its load
    slides."""
    ups = [problem.arm.tray_pose(q)[1][2, 2] for q in start.path(np.linspace(0, 1, ALONG))]
    stays = np.arccos(np.clip(min(ups), -1, 1)) < np.arctan(_friction(problem))
    return bool(stays) and touches(problem, start) < CLEARANCE.touching


def _by_contact(problem: TransportProblem, way: float) -> float:
    """Rough time, s, that friction needs for a level path of the tray, m."""
    return least_time(way, np.inf, _friction(problem) * -GRAVITY_S[2], np.inf)


def _friction(problem: TransportProblem) -> float:
    return min(body.friction for body in problem.items)


def touches(problem: TransportProblem, start: Start) -> float:
    """Deepest penetration of a path, m: 0 where nothing comes nearer than required."""
    if problem.keep_out is None:
        return 0.0
    return max(0.0, problem.keep_out.depth(start.path(np.linspace(0, 1, ALONG))))


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
