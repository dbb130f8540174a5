"""One step of planning: a job and its answer. It knows no clock and no thread, so any process can do it.

Its motions are verified (`salver.planning.verdict.verify`); the process that sent the job decides whether they come in
time.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace

import numpy as np

from salver.errors import Status
from salver.geometry import Array
from salver.live.committed.commit import verified
from salver.live.committed.motion import Committed, resting
from salver.live.committed.profile import SpeedOptions
from salver.live.replanning.lookout import Near
from salver.live.replanning.objective import TwistWanted, Weights
from salver.live.replanning.obstacles import Movable, MovingClearance, Predicted
from salver.live.replanning.replan import Replanner, ReplanOptions, Sought
from salver.live.replanning.steer import Steering, SteeringOptions, StepControl
from salver.live.replanning.wishes import Evade, Follow, Goal, Halt, Retime, Wish
from salver.planning.fastest import Anywhere, AtPosture, TransportProblem
from salver.planning.seeds.blocked import blocked_at
from salver.planning.verdict.judged import STANDARD as EXACT

THERE = 1e-5  # rad or m by which joints may miss a goal that they are at: rounding


@dataclass(frozen=True)
class EvasionOptions:
    """How moving obstacles are evaded.

    Attributes:
        damping: of the first increment of an evasion, as in `SteeringOptions`. At the least, the verdict refuses the
            first two or three ticks: of 29 near misses and hits 18 instead of 16 hit, with 1 cm less clearance.
        speed: m/s at which the tray is to leave the path of an obstacle, as far as load and limits allow.
        window: s after each hand-over during which the tray is to move at this speed.
        passes: s in which an obstacle is assumed to pass, from the first instant at which it is too near.
        asides: m, how far aside each direction is tried before one is chosen.
        another: s, difference of the times at which an obstacle is too near, up to which it counts as the same threat
            when it is seen again; the same threat is evaded in the direction chosen before.
    """

    damping: float = 100.0
    speed: float = 1.0
    window: float = 0.3
    passes: float = 0.3
    asides: tuple[float, ...] = (0.05, 0.1, 0.15, 0.2, 0.3, 0.4)
    another: float = 0.5


@dataclass(frozen=True)
class PlannerOptions:
    """How motions are proposed: to goals and to rest, towards twists and chunks, out of the way, at another speed."""

    replan: ReplanOptions = field(default_factory=ReplanOptions)
    steering: SteeringOptions = field(default_factory=SteeringOptions)
    weights: Weights = field(default_factory=Weights)
    evasion: EvasionOptions = field(default_factory=EvasionOptions)
    speed: SpeedOptions = field(default_factory=SpeedOptions)


@dataclass(frozen=True, eq=False)
class Aside:
    """The direction (3,) in which an obstacle is evaded that is first too near at live time t, s."""

    obstacle: str
    t: float
    way: Array


@dataclass(frozen=True, eq=False)
class Job:
    """A request to the planner. wish: what is requested. base: the committed motion; begins: live time, s, at which it
    may be left. budget: time for planning, s. obstacles: predicted obstacles; threats: those to which the committed
    motion comes too near. now: live time of the job, s. factor: share of full speed on the way to goals."""

    wish: Wish
    base: Committed
    begins: float
    budget: float
    obstacles: tuple[Predicted, ...] = ()
    threats: tuple[Near, ...] = ()
    now: float = 0.0
    factor: float = 1.0


@dataclass(frozen=True, eq=False)
class Answer:
    """The planner's answer to a job. found: a verified motion that continues the base, or None. done: whether the base
    already fulfils the request."""

    found: Committed | None
    status: Status
    done: bool = False


class Planner:
    """Answers jobs about one problem."""

    def __init__(self, problem: TransportProblem, options: PlannerOptions | None = None) -> None:
        self.problem, self.options = problem, options or PlannerOptions()
        self.evasion, self.speed = self.options.evasion, self.options.speed
        self._replanner = Replanner.of(problem, self.options.replan)
        self._steering = Steering.of(problem, Sought.of(problem), self.options.steering, self.options.weights)
        self._evasive = self._steering
        self._aside: Aside | None = None
        self._movable = None if problem.keep_out is None else Movable(problem.keep_out.parts)

    def answer(self, job: Job) -> Answer:
        wish, base, begins = job.wish, job.base, job.begins
        if isinstance(wish, Evade):
            return self._evading(job)
        problem = self._among(job)
        if isinstance(wish, Retime):
            return Answer(*self._retimed(job, wish.factor, problem, self.speed.latest))
        if isinstance(wish, Follow):
            wanted = wish.wanted if job.now <= wish.until else wish.then
            steering = self._steering
            if problem is not self.problem:
                steering = replace(steering, problem=problem, sought=Sought.of(problem))
            return Answer(*steering.tick(wanted, base, begins))
        if isinstance(wish, Halt):
            if base.ends - begins < self._replanner.options.soon:
                return Answer(None, Status("optimal", "", True), True)
            stop = self._stop(job, problem)
            if job.threats and stop.found is None and not stop.done:  # to go on would not keep clear either
                stop = self._stop(job, self.problem)
            return stop
        if begins >= base.ends and self._there(wish, base):
            return Answer(None, Status("optimal", "", True), True)
        blocked = self._blocked(wish)
        if blocked is not None:
            return Answer(None, replace(blocked, code="unreachable"))
        return Answer(*replace(self._searching(problem), factor=job.factor).to(wish.end, base, begins, job.budget))

    def _searching(self, problem: TransportProblem) -> Replanner:
        return self._replanner if problem is self.problem else Replanner.of(problem, self.options.replan)

    def _stop(self, job: Job, problem: TransportProblem) -> Answer:
        """A stop that ends sooner than the committed motion."""
        base = job.base
        if base.profile is not None:  # it is run slowly
            found, status = self._retimed(job, 0.0, problem, self.speed.braking)
            if found is not None and found.ends < base.ends:
                return Answer(found, status)
        found, status = self._searching(problem).to(Anywhere(), base, job.begins, job.budget)
        if found is None and base.profile is None:  # a slow motion far from its end may brake on its own path
            found, braking = self._retimed(job, 0.0, problem, self.speed.braking)
            status = status if found is None else braking
        late = found is not None and found.ends >= base.ends  # it is at rest no later as it is
        return Answer(None if late else found, status, late)

    def _retimed(
        self, job: Job, factor: float, problem: TransportProblem, latest: float
    ) -> tuple[Committed | None, Status]:
        """The committed motion along its own path at another speed factor, which is reached within a time, s."""
        options, within, began = self.speed, self.speed.soonest, time.perf_counter()
        glance = replace(EXACT, step=options.glance, instants=1, each=1, step_with_dynamics=options.glance)
        while within <= latest and time.perf_counter() - began < job.budget:
            profile = job.base.run.then(job.begins, factor, within)
            if profile.possible and not (profile.over and factor == 0.0):
                motion = profile.motion(job.base.state(job.begins))
                finding = verified(problem, motion, job.begins, job.base, glance)
                if finding.committed is not None:
                    finding = verified(problem, motion, job.begins, job.base, profile=profile)
                if finding.committed is not None:
                    return finding.committed, Status("optimal", "", True)
                if profile.over:  # so are those that change it in more time
                    break
            within *= options.longer
        return None, Status("refused", "the load allows no other speed now", False)

    def _there(self, goal: Goal, base: Committed) -> bool:
        """Whether the committed motion ends at the goal."""
        q = base.motion.q[-1]
        posture = goal.end.nearest(self.problem.arm, self.problem.limits, q)
        return posture is not None and float(np.abs(posture - q).max()) < THERE

    def _blocked(self, goal: Goal) -> Status | None:
        """Why the arm cannot be at a goal, or the load would not stay in a requested posture; None if neither is so."""
        out = self.problem.keep_out
        blocked = None if out is None else blocked_at(out.parts, "goal", goal.end)
        if blocked is None and isinstance(goal.end, AtPosture):
            finding = verified(self.problem, resting(goal.end.q), 0.0, None)
            if finding.committed is None:
                sentence = f"the load would not be safe at rest there: {finding.sentence}"
                blocked = Status("unreachable", sentence, False)
        return blocked

    def _among(self, job: Job) -> TransportProblem:
        """The problem with the predicted obstacles, in the time of a motion from the hand-over on."""
        problem = self.problem
        obstacles = tuple(one for one in job.obstacles if one.until > job.begins)
        if not obstacles or self._movable is None:
            return problem
        passing = MovingClearance(self._movable, obstacles, job.begins)
        return replace(problem, extra=(*problem.extra, passing))

    def _evading(self, job: Job) -> Answer:
        """What is committed, bent by one tick out of the way of what comes first: many small bends that begin soon do
        more than one good motion that begins late."""
        near = next((one for one in job.threats if one.until > job.begins), None)
        if near is None:
            return Answer(None, Status("optimal", "", True), True)
        if (
            self._aside is None
            or self._aside.obstacle != near.obstacle
            or abs(self._aside.t - near.t) > self.evasion.another
        ):
            self._aside = Aside(near.obstacle, near.t, self._shortest_aside(job, near))
            control = StepControl(self.options.steering, self.evasion.damping)
            self._evasive = replace(self._steering, control=control)
        twist = np.append(self.evasion.speed * self._aside.way, np.zeros(3))
        wanted = TwistWanted(twist, np.zeros(6), job.begins, window=self.evasion.window)
        found, status = self._evasive.tick(wanted, job.base, job.begins)
        return Answer(found, status, found is None and self._evasive.given_up)

    def _shortest_aside(self, job: Job, near: Near) -> Array:
        """The direction (3,), across the path of an obstacle, up or down, in which the committed motion, displaced as a
        whole, would be clear of it soonest; displacing the obstacle the other way is equivalent."""
        assert self._movable is not None
        obstacle = next(one for one in job.obstacles if one.name == near.obstacle)
        t = near.t + self.evasion.passes * np.linspace(0.0, 1.0, 7)
        q = job.base.motion.sample(np.clip(t - job.base.begins, 0.0, job.base.motion.duration))[0]
        along = obstacle.at(t[:1])[1][0] * [1.0, 1.0, 0.0]
        along = along / np.linalg.norm(along) if along.any() else np.array([1.0, 0.0, 0.0])
        up = np.array([0.0, 0.0, 1.0])
        ways = [np.cross(along, up), np.cross(up, along), up, -up]
        middles, around = self._movable.middles(q), obstacle.around(t)
        for far in self.evasion.asides:
            there = [obstacle.at(t)[0] - far * way for way in ways]
            free = [(self._movable.distances(q, obstacle, p, middles).min(axis=1) - around).min() for p in there]
            if max(free) > 0.0:
                break
        return ways[int(np.argmax(free))]
