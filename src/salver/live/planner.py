"""One step of planning: what is asked and what was found. It knows no clock and no thread, so it may be made anywhere.

What it gives was verified (`salver.live.verify`); whoever asked decides whether it still comes in time.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from salver.errors import Status
from salver.geometry import Array
from salver.live.motion import SHORTEST, Committed, between, resting
from salver.live.obstacles import Movable, MovingClearance, Predicted, nearest
from salver.live.replan import Replanner, Sought
from salver.live.steer import Steering
from salver.live.verify import verified
from salver.live.wishes import Evade, Follow, Goal, Halt, Wish, why_not
from salver.planning.fastest import Anywhere, AtPose, AtPosture, End, TransportProblem
from salver.planning.postures import PoseTarget
from salver.trajectory import JointMotion

ASIDE, ASIDE_STEP = (0.15, 0.25, 0.4), 0.02  # m to which the load is put aside; s between looks at what passes it
TURNED = (0.25, 0.5, 0.8, 1.2, 1.8)  # rad about the first joint
BESIDE = 0.03  # m that are free there
TRIED = 3
THERE = 1e-5  # rad or m by which joints may miss a goal that they are at
SOON = 0.1  # s: whoever is at rest by then need not look for a shorter way to it, which takes as long


@dataclass(frozen=True, eq=False)
class Job:
    """wish: what for. base: what is committed; begins: live time, s, at which it may be left. budget: s. obstacles:
    what is predicted to pass; threats: which of it what is committed does not keep clear of. now: live time, s, when it
    was asked."""

    wish: Wish
    base: Committed
    begins: float
    budget: float
    obstacles: tuple[Predicted, ...] = ()
    threats: tuple[str, ...] = ()
    now: float = 0.0


@dataclass(frozen=True, eq=False)
class Answer:
    """found: a verified motion that goes on from the base, or None. done: the base fulfils the wish as well. touched:
    when nothing was found that keeps clear of what passes: what is to be expected, in words."""

    found: Committed | None
    status: Status
    done: bool = False
    touched: str = ""


class Planner:
    """Answers jobs about one problem."""

    def __init__(self, problem: TransportProblem) -> None:
        self.problem = problem
        self._replanner = Replanner.of(problem)
        self._steering = Steering.of(problem, Sought.of(problem))
        self._movable = None if problem.keep_out is None else Movable(problem.keep_out.parts)

    def answer(self, job: Job) -> Answer:
        wish, base, begins = job.wish, job.base, job.begins
        problem = self._among(job)
        replanner = self._replanner if problem is self.problem else Replanner.of(problem)
        if isinstance(wish, Evade):
            return self._evading(job, problem, replanner)
        if isinstance(wish, Follow):
            wanted = wish.wanted if job.now <= wish.until else wish.then
            steering = self._steering
            if problem is not self.problem:
                steering = replace(steering, problem=problem, sought=Sought.of(problem))
            return Answer(*steering.tick(wanted, base, begins))
        if isinstance(wish, Halt):
            if base.ends - begins < SOON:
                return Answer(None, Status("optimal", "", True), True)
            found, status = replanner.to(Anywhere(), base, begins, job.budget)
            late = found is not None and found.ends >= base.ends  # it is at rest no later as it is
            return Answer(None if late else found, status, late)
        if begins >= base.ends and self._there(wish, base):
            return Answer(None, Status("optimal", "", True), True)
        blocked = why_not(self.problem, wish) or self._unsafe(wish)
        if blocked:
            return Answer(None, Status("unreachable", blocked, False))
        return Answer(*replanner.to(wish.end, base, begins, job.budget))

    def _there(self, goal: Goal, base: Committed) -> bool:
        """Whether what is committed ends at the goal."""
        q = base.motion.q[-1]
        posture = goal.end.nearest(self.problem.arm, self.problem.limits, q)
        return posture is not None and float(np.abs(posture - q).max()) < THERE

    def _unsafe(self, goal: Goal) -> str:
        """Why the load would not stay in a posture that is asked for, or nothing."""
        if not isinstance(goal.end, AtPosture):
            return ""
        finding = verified(self.problem, resting(goal.end.q), 0.0, None)
        return f"the load would not be safe at rest there: {finding.sentence}" if finding.committed is None else ""

    def _among(self, job: Job) -> TransportProblem:
        """The problem with what is predicted to pass, in the time of a motion from the hand-over on."""
        problem = self.problem
        obstacles = tuple(one for one in job.obstacles if one.until > job.begins)
        if not obstacles or self._movable is None:
            return problem
        passing = MovingClearance(self._movable, obstacles, job.begins)
        return replace(problem, extra=(*problem.extra, passing))

    def _evading(self, job: Job, problem: TransportProblem, replanner: Replanner) -> Answer:
        """The shortest motion found to a rest that keeps clear; else a stop or what is committed, whichever goes
        further from what passes, for the load is kept by both."""
        if problem is self.problem or not job.threats:
            return Answer(None, Status("optimal", "", True), True)
        base, begins, ends = job.base, job.begins, time.perf_counter() + job.budget
        own = begins - base.begins
        left = between(base.motion, own, max(base.motion.duration, own + SHORTEST))
        status = Status("refused", "there was no time to look for a way out", False)
        for end in self._ways_out(job):
            if (budget := ends - time.perf_counter()) <= 0:
                break
            found, status = replanner.to(end, base, begins, budget, around=False)
            if found is not None:
                return Answer(found, status)
        stop = None
        if (budget := ends - time.perf_counter()) > 0 and base.ends - begins > SOON:
            stop, _ = self._replanner.to(Anywhere(), base, begins, budget, around=False)
        motions = {"goes on": left} | ({} if stop is None else {"stops": stop.motion})
        comes = {how: self._nearest(job, motion) for how, motion in motions.items()}
        best = max(comes, key=lambda how: comes[how][0])
        distance, when, name = comes[best]
        near = f"{name} would come to within {1e3 * max(distance, 0.0):.0f} mm at {when:.2f} s"
        touched = f"Nothing was found that keeps clear of {name}: it {best}, and {near}."
        return Answer(stop if best == "stops" else None, status, best != "stops", touched)

    def _ways_out(self, job: Job) -> Iterator[End]:
        """Postures beside the way of what passes, in which the arm may rest, the nearest first; then, on the way, any
        rest."""
        yield from self._asides(job)[:TRIED]
        if job.base.ends > job.begins:
            yield Anywhere()

    def _asides(self, job: Job) -> list[End]:
        """Postures beside the way of what threatens, in which the arm may rest; the nearest first: the load put aside,
        or the whole arm turned about its first joint, if that leaves the tray level. Of each way the nearest that is
        clear."""
        problem, first = self.problem, self.problem.items[0]
        assert self._movable is not None
        q, limits = job.base.state(job.begins)[0], problem.limits
        p_SB = problem.arm.object_pose(q, first.p_EB, first.R_EB)[0]
        threats = [one for one in job.obstacles if one.name in job.threats]
        until = np.arange(job.begins, max((x.until for x in threats), default=0.0), ASIDE_STEP)
        ways = [np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, -1.0])]
        for obstacle in threats:
            v = obstacle.at(until)[1].mean(axis=0) if len(until) else np.zeros(3)
            across = np.cross(v, [0.0, 0.0, 1.0])
            ways += [sign * x / np.linalg.norm(x) for x in (across, v * [1, 1, 0]) if x.any() for sign in (1.0, -1.0)]

        def put(way: Array, far: float) -> Array | None:
            target = PoseTarget(p_SB + far * way, first.R_EB, first.p_EB, first.R_EB, yaw_free=True)
            return AtPose(target).nearest(problem.arm, limits, q)

        def turned(sign: float, angle: float) -> Array | None:
            posture = q + sign * angle * np.eye(problem.n)[0]
            tilt = problem.arm.tray_pose(posture)[1][2, 2] - problem.arm.tray_pose(q)[1][2, 2]
            inside = limits.q_min[0] <= posture[0] <= limits.q_max[0]
            return posture if inside and abs(tilt) < THERE else None

        found: list[tuple[float, End]] = []
        each = [(put(way, far) for far in ASIDE) for way in ways]
        each += [(turned(sign, angle) for angle in TURNED) for sign in (1.0, -1.0)]
        for postures in each:
            for posture in postures:
                if posture is not None and nearest(self._movable, threats, posture[None], until)[0] > BESIDE:
                    found.append((float(np.abs(posture - q).max()), AtPosture(posture)))
                    break
        return [end for _, end in sorted(found, key=lambda pair: pair[0])]

    def _nearest(self, job: Job, motion: JointMotion) -> tuple[float, float, str]:
        assert self._movable is not None
        threats = [one for one in job.obstacles if one.name in job.threats]
        until = max((x.until for x in threats), default=0.0) - job.begins
        t = np.linspace(0.0, max(until, motion.duration), 200)
        q = motion.sample(np.minimum(t, motion.duration))[0]
        return nearest(self._movable, threats, q, job.begins + t)
