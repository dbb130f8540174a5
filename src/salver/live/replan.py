"""A new motion while the old one runs: the shortest from the state at the hand-over to a goal, or to rest anywhere.

It is sought under slightly stricter conditions than those it is then judged by, so that what is found passes, and what
goes on from it can. What is sought is a good motion soon, not the best one late: iterations end when they gain little.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np

from salver.errors import Status
from salver.geometry import Array
from salver.live.motion import Committed
from salver.live.verify import Finding, coarse, kept, verified
from salver.planning.fastest import (
    Anywhere,
    AtPose,
    AtPosture,
    Block,
    Constraint,
    End,
    Evaluation,
    FastestMotion,
    FastestOptions,
    TransportProblem,
    fastest,
)
from salver.planning.fastest.curves import FreeCurve, Grid, launch_basis
from salver.planning.fastest.evaluation import Indices
from salver.planning.fastest.exchange import Checked, optimise
from salver.planning.fastest.spline import RestSpline, SplineMotion, min_jerk_blend
from salver.planning.fastest.starts import braking_time
from salver.planning.fastest.watch import Watch
from salver.planning.postures import candidate_postures
from salver.trajectory import JointMotion

SPLINE = RestSpline(degree=5, spans=8)
NODES_PER_SPAN = 2
GAIN = 1e-2  # relative shortening below which an iteration counts as idle
LEAST_DURATION = 0.1  # s of a first guess
OTHERS = 16  # guesses from which a goal's postures are sought when none is near


@dataclass(frozen=True, eq=False)
class Firm(Constraint):
    """A constraint under which motions are sought: what the verdict keeps of its rows is kept from the beginning on,
    also where the margins of a motion that begins moving are eased, and beyond that twice the planner's margin."""

    judged: Constraint

    def near(self, q: Array) -> Constraint:
        return Firm(coarse(self.judged).near(q))

    def blocks(self, motion: Evaluation) -> Iterator[Block]:
        for block in self.judged.blocks(motion):
            nodes, check = block.margins[0], kept(block, self.judged)
            yield block.having(values=block.values + check, margins=(2 * nodes, 0.5 * nodes))


class Sought(TransportProblem):
    """The problem that motions are sought under. The state that one begins in is given, at rest too: what it lacks of
    a planner's margins is made up for on the way."""

    @cached_property
    def constraints(self) -> tuple[Constraint, ...]:
        return tuple(Firm(constraint) for constraint in super().constraints)

    def at(self, s: Array, z: Array, duration: float, nodes: Indices | None = None, imposed: bool = True) -> Evaluation:
        return replace(super().at(s, z, duration, nodes, imposed), moving=True)

    @classmethod
    def of(cls, problem: TransportProblem) -> Sought:
        return cls(**{field.name: getattr(problem, field.name) for field in fields(problem)})


@dataclass(frozen=True, eq=False)
class Replanner:
    """problem: by which motions are judged; sought: the same, under conditions a little stricter."""

    problem: TransportProblem
    sought: TransportProblem

    @classmethod
    def of(cls, problem: TransportProblem) -> Replanner:
        return cls(problem, Sought.of(problem))

    def to(
        self, end: End, before: Committed, begins: float, time_limit: float, *, around: bool = True
    ) -> tuple[Committed | None, Status]:
        """The shortest motion found from the committed one at live time `begins` to an end. around: whether, from rest,
        there is time to look for ways around what is in the way."""
        began = time.perf_counter()
        start = AtPosture(*before.state(begins))
        at = replace(self.sought, start=start, goal=end)
        deviation = before.deviation_at(begins, self.problem)
        if at.tracking is not None and deviation is not None:
            at = replace(at, tracking=at.tracking.begun(deviation))
        guess = going_on(at, before, begins) if isinstance(end, Anywhere) else straight(at)
        if guess is None:
            return None, Status("unreachable", "no posture of the arm within its limits reaches it", False)
        found: Checked | FastestMotion = optimise(at, FreeCurve, guess, NODES_PER_SPAN, Watch(time_limit), gain=GAIN)
        finding = self._judged(at, guess.spline, found, before, begins)
        left = time_limit - (time.perf_counter() - began)
        if around and finding.committed is None and not start.moving and left > 0:
            searched = fastest(at, FastestOptions(time_limit=left))
            if searched.status.ok:
                found, finding = searched, self._judged(at, searched.spline, searched, before, begins)
        if finding.committed is None:
            return None, Status("refused", finding.sentence if found.status.ok else found.status.sentence, False)
        return finding.committed, Status("optimal", f"A motion of {finding.committed.motion.duration:.3f} s.", True)

    def _judged(
        self, at: TransportProblem, spline: RestSpline, found: Checked | FastestMotion, before: Committed, begins: float
    ) -> Finding:
        """The verdict on what was found."""
        breaks = spline.breaks()
        q, dq, ddq, _ = FreeCurve(at, Grid.of(spline, breaks)).motion(found.coefficients, found.duration)
        for rate in (dq, ddq):
            rate[-1] = 0.0  # but for the last digits, it is
        return verified(self.problem, JointMotion(breaks * found.duration, q, dq, ddq), begins, before)


def going_on(at: TransportProblem, before: Committed, begins: float) -> SplineMotion:
    """A first guess of a stop: what is committed."""
    start = at.start
    assert isinstance(start, AtPosture)
    left = max(before.ends - begins, LEAST_DURATION)
    s = np.linspace(0.0, 1.0, 121)
    q = before.motion.sample(begins - before.begins + s * left)[0]
    return SplineMotion(SPLINE, SPLINE.fit(s, q - _launched(start, s, left)), left)


def straight(at: TransportProblem) -> SplineMotion | None:
    """A first guess of the way to a goal: straight on to the nearest of its postures; None when there is none."""
    start = at.start
    assert isinstance(start, AtPosture)
    braking = braking_time(at)
    ahead = np.clip(start.q + 0.5 * braking * start.rates[0], at.limits.q_min, at.limits.q_max)
    goal = next((q for near in (ahead, start.q) if (q := at.goal.nearest(at.arm, at.limits, near)) is not None), None)
    if goal is None and isinstance(at.goal, AtPose):
        others = candidate_postures(at.arm, at.goal.target, seeds=OTHERS)
        goal = min(others, key=lambda q: float(np.abs(q - start.q).max()), default=None)
    if goal is None:
        return None
    duration = braking + 2.0 * float(np.max(np.abs(goal - start.q) / at.limits.velocity)) + LEAST_DURATION
    s = np.linspace(0, 1, 121)
    return SplineMotion(SPLINE, SPLINE.fit(s, start.q + min_jerk_blend(s)[:, None] * (goal - start.q)), duration)


def _launched(start: AtPosture, s: Array, duration: float) -> Array:
    """(len(s), n) what velocity and acceleration of a start add to the posture."""
    powers = np.array([duration, duration**2])[:, None, None]
    return np.asarray((launch_basis(s)[:, 0, :, None] * start.rates[:, None, :] * powers).sum(axis=0))
