"""A new motion while the old one runs: the shortest from the state at the hand-over to a goal, or to rest anywhere.

The search uses slightly stricter constraints than the verdict, so that its result passes and can be continued. A good
motion soon is worth more than the best one late: iterations end when they gain little.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import ClassVar, Self

import numpy as np

from salver.errors import Status
from salver.geometry import GRAVITY_S, Array, Indices
from salver.live.committed.commit import Finding, verified
from salver.live.committed.motion import Committed
from salver.live.committed.profile import SpeedProfile
from salver.models.arm.arm_limits import JointLimits
from salver.models.tray_motion import Speed
from salver.planning.fastest import (
    Anywhere,
    AtPose,
    AtPosture,
    Block,
    Constraint,
    End,
    FastestMotion,
    FastestOptions,
    MotionEvaluation,
    TransportProblem,
    fastest,
)
from salver.planning.postures import candidate_postures
from salver.planning.seeds.starts import braking_time
from salver.planning.trajopt.bound import least_time
from salver.planning.trajopt.constraints.constraints import ContactConstraint
from salver.planning.trajopt.curves import FreeCurve, Grid, launched
from salver.planning.trajopt.exchange import ExchangeOptions, optimise, programme_of
from salver.planning.trajopt.spline import RestSpline, SplineMotion
from salver.planning.trajopt.sqp import SqpOptions, SqpSolution, minimise
from salver.planning.trajopt.watch import Watch
from salver.planning.verdict.judged import STANDARD
from salver.trajectory import JointMotion, smooth_step

SPLINE = RestSpline(degree=5, spans=8)


@dataclass(frozen=True)
class ReplanOptions:
    """Options of the search for a whole motion, and of its correction when it violates a constraint slightly.

    Attributes:
        nodes_per_span: nodes in each span of the spline.
        few_nodes: nodes in each span of a second attempt, which adds nodes where constraints are violated.
        gain: relative shortening below which an iteration counts as idle.
        stretches: how often at most a motion is made longer, while each time its violation falls below half.
        stretched: largest relative lengthening each time.
        amply: ratio of the lengthening to the one that would suffice from rest: a motion that begins at speed does not
            become slower as a whole.
        a_little: relative lengthening beyond that; another check would take more time than this costs.
        least_duration: s, least duration of an initial guess.
        likely: ratio of the duration of an initial guess to the least time that every joint, and friction, allow.
        slowly: factor by which the initial guess of a second attempt is longer.
        others: guesses from which a goal's postures are sought when none is near.
        soon: s; a motion that is at rest within this time is not shortened, because the search takes as long.
    """

    nodes_per_span: int = 6
    few_nodes: int = 2
    gain: float = 1e-2
    stretches: int = 4
    stretched: float = 0.02
    amply: float = 2.0
    a_little: float = 6e-4
    least_duration: float = 0.1
    likely: float = 1.1
    slowly: float = 1.4
    others: int = 16
    soon: float = 0.1


@dataclass(frozen=True, eq=False)
class Firm(Constraint):
    """A tightened constraint for the search. It keeps the verdict's margins from the beginning on, also where the
    verdict eases them for a motion that begins at speed, and in addition `times` the planner's margin (twice the margin
    for distances, because every millimetre counts)."""

    judged: Constraint
    times: float = 2.0
    distances: ClassVar[float] = 2.0

    def near(self, q: Array) -> Constraint:
        judged = self.judged
        coarse = replace(judged, coarsely=True) if isinstance(judged, ContactConstraint) else judged
        return Firm(coarse.near(q), self.times)

    def blocks(self, motion: MotionEvaluation) -> Iterator[Block]:
        for block in self.judged.blocks(motion):
            nodes, check = block.margins[0], STANDARD.margin(block, self.judged)
            if isinstance(self.judged, ContactConstraint):
                nodes -= check - STANDARD.contact  # what the scenario asks for is kept once
            times = self.distances if block.kinked else self.times
            yield block.having(values=block.values + check, margins=(times * nodes, 0.5 * nodes))


class Sought(TransportProblem):
    """The tightened problem for changes of the committed motion. The initial state is given, also at rest; margins of
    the planner that are missing there are recovered on the way."""

    times: ClassVar[float] = 2.0  # as in `Firm`

    @cached_property
    def constraints(self) -> tuple[Firm, ...]:
        return tuple(Firm(constraint, self.times) for constraint in super().constraints)

    def at(
        self, s: Array, z: Array, duration: float, nodes: Indices | None = None, imposed: bool = True
    ) -> MotionEvaluation:
        return replace(super().at(s, z, duration, nodes, imposed), moving=True)

    @classmethod
    def of(cls, problem: TransportProblem) -> Self:
        return cls(**{x.name: getattr(problem, x.name) for x in fields(problem)} | {"at_rest": False})


class Firmer(Sought):
    """The tightened problem for whole motions: their nodes are further apart, so constraint values rise more between
    them."""

    times: ClassVar[float] = 5.0


@dataclass(frozen=True, eq=False)
class Replanner:
    """Searches for whole motions. problem: the constraints of the verdict; sought: the same problem, slightly
    tightened."""

    problem: TransportProblem
    sought: TransportProblem
    options: ReplanOptions = field(default_factory=ReplanOptions)
    factor: float = 1.0  # of full speed, at which what is found is run, and judged

    @classmethod
    def of(cls, problem: TransportProblem, options: ReplanOptions = ReplanOptions()) -> Replanner:
        return cls(problem, Firmer.of(problem), options)

    def to(self, end: End, before: Committed, begins: float, time_limit: float) -> tuple[Committed | None, Status]:
        """The shortest motion found from the committed one at live time `begins`, s, to an end; from rest, also around
        obstacles."""
        began, slow = time.perf_counter(), self.factor
        q, dq, ddq = before.state(begins)
        start = AtPosture(q, dq / slow, ddq / slow**2)  # as a motion at full speed has to begin, to go on from it
        # A solid load that stays at full speed and at rest stays at every speed between; what moves inside has its own
        # time.
        sought = replace(self.sought, speeds=(Speed(slow),)) if self.sought.cases and slow < 1.0 else self.sought
        at = before.left(begins, replace(sought, start=start, goal=end))
        options = self.options
        guess = going_on(at, before, begins, options) if isinstance(end, Anywhere) else straight(at, options)
        if guess is None:
            return None, Status("unreachable", "no posture of the arm within its limits reaches it", False)
        found, finding = self._shortest(at, guess, before, begins, Watch(time_limit))
        left = time_limit - (time.perf_counter() - began)
        if finding.committed is None and not start.moving and left > 0:
            searched = fastest(at, FastestOptions(time_limit=left))
            if searched.status.ok:
                found, finding = searched, self._stretched(at, searched, before, begins)
        if finding.committed is None:
            return None, Status("refused", finding.sentence if found.status.ok else found.status.sentence, False)
        return finding.committed, Status("optimal", f"A motion of {finding.committed.motion.duration:.3f} s.", True)

    def _shortest(
        self, at: TransportProblem, guess: SplineMotion, before: Committed, begins: float, watch: Watch
    ) -> tuple[FastestMotion | SqpSolution, Finding]:
        """The shortest motion from a guess, and the verdict on it.

        What is broken between the nodes is mostly little, and kept by a motion that takes as much longer; only where
        that does not help are nodes added. Among what moves, it seldom does.
        """
        damping, how = 1.0, ExchangeOptions()
        if not at.cases and not at.extra:
            programme = programme_of(at, FreeCurve, guess, guess.spline.nodes(self.options.nodes_per_span))
            begun = programme.begin(guess.coefficients, guess.duration)
            solution = minimise(programme, begun, SqpOptions(watch=watch, gain=self.options.gain))
            best = solution.iterate
            motion = SplineMotion(guess.spline, best.coefficients, best.duration)
            finding = self._stretched(at, motion, before, begins)
            if finding.committed is not None:
                return solution, finding
            if best.violation > how.hopeless_at_nodes:  # from another beginning, perhaps
                guess = replace(guess, duration=self.options.slowly * guess.duration)
            else:
                guess, damping = SplineMotion(guess.spline, best.coefficients, best.duration), how.repair
        hasty = replace(at, at_rest=False)
        found = optimise(
            hasty, FreeCurve, guess, self.options.few_nodes, watch, damping=damping, gain=self.options.gain
        )
        return found, self._stretched(at, found, before, begins)

    def _stretched(self, at: TransportProblem, motion: SplineMotion, before: Committed, begins: float) -> Finding:
        """The verdict on a motion, or on one that takes a little longer, if a longer duration removes its violation."""
        finding = self._judged(at, motion, before, begins)
        for _ in range(self.options.stretches):
            if finding.committed is not None or finding.slower > self.options.stretched:
                break
            motion = replace(
                motion, duration=motion.duration * (1.0 + self.options.amply * finding.slower + self.options.a_little)
            )
            excess, finding = finding.excess, self._judged(at, motion, before, begins)
            if finding.excess > 0.5 * excess:
                break
        return finding

    def _judged(self, at: TransportProblem, found: SplineMotion, before: Committed, begins: float) -> Finding:
        """The verdict on the motion that was found."""
        breaks = found.spline.breaks()
        q, dq, ddq, _ = FreeCurve(at, Grid.of(found.spline, breaks)).motion(found.coefficients, found.duration)
        for rate in (dq, ddq):
            rate[-1] = 0.0  # but for the last digits, it is
        motion, profile = JointMotion(breaks * found.duration, q, dq, ddq), None
        if self.factor < 1.0:
            profile = SpeedProfile(motion, begins, 0.0, self.factor, 0.0, self.factor)
            motion = profile.motion()
        return verified(self.problem, motion, begins, before, thoroughly=True, profile=profile)


def going_on(at: TransportProblem, before: Committed, begins: float, options: ReplanOptions) -> SplineMotion:
    """An initial guess of a stop: the committed motion."""
    start = at.start
    assert isinstance(start, AtPosture)
    left = max(before.ends - begins, options.least_duration)
    s = np.linspace(0.0, 1.0, 121)
    q = before.motion.sample(begins - before.begins + s * left)[0]
    return SplineMotion(SPLINE, SPLINE.fit(s, q - launched(start, s, left)), left)


def straight(at: TransportProblem, options: ReplanOptions) -> SplineMotion | None:
    """An initial guess of the motion to a goal: straight to the nearest of its postures; None if it has none."""
    start = at.start
    assert isinstance(start, AtPosture)
    braking = braking_time(at)
    ahead = np.clip(start.q + 0.5 * braking * start.rates[0], at.limits.q_min, at.limits.q_max)
    goal = next((q for near in (ahead, start.q) if (q := at.goal.nearest(at.arm, at.limits, near)) is not None), None)
    if goal is None and isinstance(at.goal, AtPose):
        others = candidate_postures(at.arm, at.goal.target, seeds=options.others)
        goal = min(others, key=lambda q: float(np.abs(q - start.q).max()), default=None)
    if goal is None:
        return None
    duration = max(
        options.least_duration, options.likely * max(_by_joints(at.limits, start, goal), _by_friction(at, start, goal))
    )
    s = np.linspace(0, 1, 121)
    return SplineMotion(SPLINE, SPLINE.fit(s, start.q + smooth_step(s)[:, None] * (goal - start.q)), duration)


def _by_joints(limits: JointLimits, start: AtPosture, goal: Array) -> float:
    """About the least time, s, in which every joint can be at rest at the goal (n,): braked, and then from rest to rest
    by its limits."""
    velocity, acceleration = start.rates[0], limits.acceleration
    braked = start.q + 0.5 * velocity * np.abs(velocity) / acceleration
    joints = zip(np.abs(goal - braked), limits.velocity, acceleration, limits.jerk, strict=True)
    moving = np.array([least_time(*map(float, joint)) for joint in joints])
    return float(np.max(np.abs(velocity) / acceleration + moving))


def _by_friction(at: TransportProblem, start: AtPosture, goal: Array) -> float:
    """Estimate of the least time, s, to bring a load that friction holds on a level tray to rest at the goal (n,):
    braking first, then a motion from rest to rest."""
    most = min(body.friction for body in at.items) * -GRAVITY_S[2]
    p_SE, R_SE = at.arm.tray_pose(start.q)
    v_S = R_SE @ (at.arm.body_jacobian(start.q) @ start.rates[0])[:3]
    speed = float(np.linalg.norm(v_S))
    left = at.arm.tray_pose(goal)[0] - p_SE - 0.5 * speed / most * v_S
    return speed / most + 2.0 * float(np.sqrt(np.linalg.norm(left) / most))
