"""Initial guesses of the search for the fastest motion: postures at both ends, and paths between them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import chain

import numpy as np

from salver.geometry import GRAVITY_S, Array, interpolated
from salver.models.arm.arm import ArmModel
from salver.models.arm.arm_limits import POSITION
from salver.planning.postures import INSIDE
from salver.planning.seeds.around import way_around
from salver.planning.trajopt.bound import least_duration, least_time
from salver.planning.trajopt.constraints.constraints import strayed
from salver.planning.trajopt.constraints.obstacles import APART as APART_FROM_TOUCHING
from salver.planning.trajopt.constraints.obstacles import CLEARANCE
from salver.planning.trajopt.ends import AtPosture, End
from salver.planning.trajopt.problem import TransportProblem
from salver.planning.trajopt.spline import RestSpline, SplineMotion
from salver.trajectory import smooth_step

APART = 0.3  # rad between pairs of ends that count as different


@dataclass(frozen=True)
class EndOptions:
    """Options of the search for end postures.

    Attributes:
        attempts: random guesses for pairs of end postures, in `batches`, of which no more than necessary are tried.
        batches: number of batches of attempts.
        again: random guesses for each end when more postures are needed.
        enough: number of different collision-free postures with which that search ends.
        others: further goal postures that are searched for when the start posture is given.
        roundabout: further goal postures are searched for when the joints take longer than this multiple of the time
            that friction needs.
        at_limits: cost, s, of a posture at a joint limit.
        too_near: cost, s/m, of being closer than 3 cm to an obstacle.
        slides, slide: steps, and rad per step, of moving an end posture out of a collision.
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
    """Postures (n,) at the start and at the goal. cost: estimated duration of a motion between them, s, plus penalties
    near joint limits and obstacles. free: whether both are collision-free, with the tracking error at rest."""

    start: Array
    goal: Array
    cost: float
    free: bool


@dataclass(frozen=True, eq=False)
class Start:
    """An initial path through postures (N, n), from rest to rest. name: its kind, in words."""

    name: str
    postures: Array

    @cached_property
    def _length(self) -> Array:
        steps = np.linalg.norm(np.diff(self.postures, axis=0), axis=1)
        along = np.append(0.0, np.cumsum(steps))
        return np.asarray(along / along[-1] if along[-1] > 0 else np.linspace(0, 1, len(along)))

    def path(self, s: Array) -> Array:
        """Postures (len(s), n) at s in [0, 1]."""
        u = smooth_step(s)
        return interpolated(self._length, self.postures, u)

    @cached_property
    def sampled(self) -> Array:
        """31 postures evenly along it, at which it is checked."""
        return self.path(np.linspace(0, 1, 31))

    def least(self, problem: TransportProblem) -> float:
        """Estimated duration of a motion along it, s: the larger of what joint limits and what friction allow."""
        far = np.abs(np.diff(self.postures, axis=0)).sum(axis=0)
        p_SE = np.array([problem.arm.tray_pose(q)[0] for q in self.sampled])
        way = float(np.linalg.norm(np.diff(p_SE, axis=0), axis=1).sum())
        return float(np.hypot(least_duration(problem.limits, np.zeros_like(far), far), _by_contact(problem, way)))

    def motion(self, problem: TransportProblem, spline: RestSpline) -> SplineMotion:
        """The motion along it, with a long duration."""
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
    """Pairs of end postures, the most promising first; pairs with a collision only if there are no others.

    With a given start posture, the goal posture nearest to it comes first, without any randomness; others follow if it
    has a collision or is far. Otherwise pairs of nearby postures away from joint limits are returned. If none of them
    is free, or with `more`, both ends are also searched for independently, which takes longer. few: pairs that are
    enough.
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
            if few is not None and len(found.pairs) >= few and fine(problem, found.pairs[0], options):
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
    if given is None or not all(fine(problem, pair, options) for pair in pairs[:1]):
        pairs.sort(key=lambda pair: pair.cost)
    return [pair for pair in pairs if pair.free] or pairs


def fine(problem: TransportProblem, pair: Ends, options: EndOptions = USUAL) -> bool:
    """Whether both postures are collision-free and the joints do not take far longer between them than friction
    requires; if they do, another goal posture is probably nearer."""
    way = float(np.linalg.norm(np.subtract(*(problem.arm.tray_pose(q)[0] for q in (pair.start, pair.goal)))))
    return pair.free and pair.cost < options.roundabout * _by_contact(problem, way)


def guess(problem: TransportProblem, rng: np.random.Generator, attempt: int) -> Array:
    """The middle of the joint ranges for attempt 0, then random postures around it."""
    centre, half = problem.limits.range(POSITION)
    half = np.where(np.isfinite(half), half, np.pi)
    return np.asarray(centre + (0.7 * half * rng.uniform(-1, 1, problem.n) if attempt else 0.0))


def _sought(
    problem: TransportProblem, rng: np.random.Generator, first: int, options: EndOptions
) -> list[tuple[float, Array, Array]]:
    """Costs (s) and pairs of end postures, goal near start, cheapest first; of those in which the arm stands and moves
    alike only the cheapest."""
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
            goal = _nearer(problem, start, goal)
            found.append((_cost(problem, start, goal, options), start, goal))
    found.sort(key=lambda pair: pair[0])
    shapes = [np.stack([_shape(problem, q) for q in pair[1:]]) for pair in found]
    kept: list[int] = []
    for k, (cost, _, _) in enumerate(found):
        # Alike: by 3 % of the cost, and by 3 cm where the joints are.
        alike = (cost < 1.03 * found[j][0] and np.abs(shapes[k] - shapes[j]).max() < 0.03 for j in kept)
        if not any(alike):
            kept.append(k)
    return [found[k] for k in kept]


def _shape(problem: TransportProblem, q: Array) -> Array:
    """(joints + 1, 3) where the joints are, and which way the tray points at 0.1 m from its middle, m: a posture of
    which a shoulder or a wrist is flipped over has the same."""
    arm = problem.arm
    heading = arm.tray_pose(q)[1][:, 0]
    return np.array([*(placement.translation for placement in arm.data.oMi.tolist()[1:]), 0.1 * heading])


def _cost(problem: TransportProblem, start: Array, goal: Array, options: EndOptions) -> float:
    """Estimated duration of a motion between two postures, s, with a penalty near joint limits."""
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
        """Add pairs by cost, moved out of collisions where possible, until `few` free ones cost no more than the next.
        Returns whether any was new."""
        problem, before = self.problem, len(self.pairs)
        for cost, start, goal in sought:
            if few is not None and sum(pair.free and pair.cost <= cost for pair in self.pairs) >= few:
                break
            free = slid_free(problem, problem.start, start, self.options)
            self.add(free, goal if free is start else problem.goal.nearest(problem.arm, problem.limits, free))
        return len(self.pairs) > before

    def add(self, start: Array, goal: Array | None) -> None:
        """Add a pair, its goal moved out of collisions where possible, unless a similar pair is known."""
        problem = self.problem
        goal = None if goal is None else slid_free(problem, problem.goal, goal, self.options)
        if goal is None:
            return
        goal = _nearer(problem, start, goal)
        if problem.start_posture is None:
            start, goal = _unwound(problem, start, goal)
        others = (_apart(problem, goal, e.goal) + _apart(problem, start, e.start) for e in self.pairs)
        if min(others, default=np.inf) <= APART:
            return
        cost, free = _cost(problem, start, goal, self.options), True
        if problem.keep_out is not None:
            distance = problem.keep_out.parts.clearance(np.stack([start, goal]))
            left = (room(problem, q) for q in ([goal] if problem.start_posture is not None else [start, goal]))
            free = min(float(distance.min()), *left) > APART_FROM_TOUCHING
            near = float((distance - problem.keep_out.required).min())
            cost += self.options.too_near * max(0.0, 0.03 - near)
        self.pairs.append(Ends(start, goal, cost, free))


def _free_postures(
    problem: TransportProblem, end: End, known: list[Array], rng: np.random.Generator, options: EndOptions = USUAL
) -> list[Array]:
    """Different collision-free postures at an end, known ones first; at most `options.enough`."""
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


def slid_free(problem: TransportProblem, end: End, q: Array, options: EndOptions = USUAL) -> Array:
    """The posture moved out of collisions within the freedom that the end leaves; with a collision left when that
    failed."""
    keep_out, arm = problem.keep_out, problem.arm
    if keep_out is None:
        return q
    free, vain = -np.inf, 0
    for _ in range(options.slides):
        distance = keep_out.distances(q[None])[0] - CLEARANCE.enough_at_ends
        vain = 0 if distance.min() > free else vain + 1
        free = max(free, float(distance.min()))
        if free >= 0 or vain >= 4:  # steps in a row without progress
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
    """Postures at an end: the one nearest to the middle of the joint ranges, the same moved out of collisions, then
    other collision-free ones."""
    middle = end.nearest(problem.arm, problem.limits, problem.limits.range(POSITION)[0])
    known = [] if middle is None else [middle, slid_free(problem, end, middle)]
    yield from known
    yield from _free_postures(problem, end, known[1:], rng)


def _nearer(problem: TransportProblem, start: Array, goal: Array) -> Array:
    """The goal posture shifted by whole turns towards the start posture, where the joint limits allow that."""
    limits = problem.limits
    turns = np.where(problem.arm.linear, 0.0, np.round((goal - start) / (2 * np.pi)))
    shifted = goal - 2 * np.pi * turns
    inside = (shifted >= limits.q_min + INSIDE) & (shifted <= limits.q_max - INSIDE)
    return np.where(inside, shifted, goal)


def _unwound(problem: TransportProblem, start: Array, goal: Array) -> tuple[Array, Array]:
    """The two postures shifted by whole turns towards the middle of the joint ranges, so that joints and cables are not
    wound up."""
    middle = problem.limits.range(POSITION)[0]
    turns = np.where(problem.arm.linear, 0.0, np.round((0.5 * (start + goal) - middle) / (2 * np.pi)))
    return start - 2 * np.pi * turns, goal - 2 * np.pi * turns


def _apart(problem: TransportProblem, q: Array, other: Array) -> float:
    """Largest joint difference of two postures, rad, modulo whole turns."""
    turns = np.where(problem.arm.linear, 0.0, np.round((q - other) / (2 * np.pi)))
    return float(np.abs(q - other - 2 * np.pi * turns).max())


def between(problem: TransportProblem, pair: Ends) -> TransportProblem:
    """The problem with required distances that both end postures satisfy."""
    if problem.keep_out is None:
        return problem
    postures = (pair.start, pair.goal)
    stray = np.array([_stray_at_rest(problem, q) for q in postures])
    return replace(problem, keep_out=problem.keep_out.kept_by(np.stack(postures), stray))


def room(problem: TransportProblem, q: Array) -> float:
    """Least distance of two parts in a posture (n,), m, less what the tracking error at rest takes of a short one."""
    assert problem.keep_out is not None
    distance = float(problem.keep_out.parts.clearance(q[None]).min())
    return distance - _stray_at_rest(problem, q) if 0.0 < distance < CLEARANCE.safety else distance


def _stray_at_rest(problem: TransportProblem, q: Array) -> float:
    """Largest distance, m, by which the arm strays from a posture (n,) at rest, under the uncertain load."""
    if problem.tracking is None:
        return 0.0
    z = np.zeros((4, 5, problem.n))  # a filter of cubics needs five instants
    z[0] = q
    still = replace(problem, cases=()).at(np.linspace(0.0, 1.0, 5), z, 1.0, imposed=False)
    return float(strayed(*still.tray_radius()).max())


def straight(pair: Ends, arm: ArmModel | None = None) -> Start:
    """The straight path in joint space; on a differential base (of `arm`) it turns on the spot, drives, and turns."""
    postures = np.stack([pair.start, pair.goal])
    if arm is not None and arm.base is not None and arm.base.kind == "differential":
        x, y, _ = (pair.goal - pair.start)[:3]
        postures = postures.repeat(2, axis=0)
        heading = np.arctan2(y, x)  # forwards, or backwards if that is nearer
        postures[1:3, 2] = heading + np.pi * np.round((0.5 * (pair.start[2] + pair.goal[2]) - heading) / np.pi)
    return Start("straight path of the joints", postures)


def around(problem: TransportProblem, pairs: list[Ends], rng: np.random.Generator) -> Start | None:
    """A collision-free path from a start to a goal of the pairs; None when none was found."""
    starts, goals = (
        _different(problem, postures) for postures in zip(*((p.start, p.goal) for p in pairs), strict=True)
    )
    way = way_around(problem, starts, goals, rng, looks=6000)  # postures; half a second if there is no path
    return None if way is None else Start("way around", way)


def _different(problem: TransportProblem, postures: Iterable[Array]) -> list[Array]:
    """The postures (n,) without near duplicates."""
    found: list[Array] = []
    for q in postures:
        if all(_apart(problem, q, other) > APART for other in found):
            found.append(q)
    return found


def open_to(problem: TransportProblem, start: Start) -> bool:
    """Whether a slow motion along a path is (nearly) possible: no collision, and no tilt at which the load slides."""
    ups = [problem.arm.tray_pose(q)[1][2, 2] for q in start.sampled]
    stays = np.arccos(np.clip(min(ups), -1, 1)) < np.arctan(_friction(problem))
    return bool(stays) and touches(problem, start) < CLEARANCE.touching


def _by_contact(problem: TransportProblem, way: float) -> float:
    """Estimated time, s, that friction allows for a level path of the tray of this length, m."""
    return least_time(way, np.inf, _friction(problem) * -GRAVITY_S[2], np.inf)


def _friction(problem: TransportProblem) -> float:
    return min(body.friction for body in problem.items)


def touches(problem: TransportProblem, start: Start) -> float:
    """Largest violation of the required distances along a path, m; 0 without one."""
    if problem.keep_out is None:
        return 0.0
    return max(0.0, problem.keep_out.depth(start.sampled))


def braking_time(problem: TransportProblem) -> float:
    """Twice the time, s, in which the initial velocity could be braked if the load did not limit it."""
    start = problem.start
    assert isinstance(start, AtPosture)
    speed = np.abs(start.rates[0])
    limits = problem.limits
    by_limits = np.where(np.isfinite(limits.acceleration), limits.acceleration, 10.0)
    return float(np.clip(4.0 * np.max(speed / by_limits), 0.1, 10.0))


def _comfortable_duration(problem: TransportProblem, speed: Array) -> float:
    """A duration, s, at which joint velocities are far below their limits; `speed` (n,) is the largest |dq/ds|."""
    return float(np.clip(2.5 * np.max(speed / problem.limits.velocity), 1.0, 60.0))
