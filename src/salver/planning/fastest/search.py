"""The fastest motion that stays safe: shortest duration within the arm's limits, contact kept for all parameters.

The decision variables are the coefficients of rest-to-rest joint splines and the duration, so the arm can run
every candidate. `constraints` says what must hold, `sqp` finds the optimum; here are the starts, the
refinement from few spline pieces to many, and the check between the nodes.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from salver.errors import Status, UnreachableError
from salver.geometry import Array
from salver.models.arm_limits import POSITION
from salver.planning.fastest.curves import FreeCurve, Grid
from salver.planning.fastest.ends import AtPose, AtPosture
from salver.planning.fastest.exchange import SHORTEST, optimise, rough
from salver.planning.fastest.objectives import Objective
from salver.planning.fastest.problem import TransportProblem, transport_problem
from salver.planning.fastest.spline import RestSpline, SplineMotion, min_jerk_blend
from salver.planning.fastest.sqp import Iterate, Solution
from salver.planning.follow.forward import tray_motion
from salver.planning.follow.limits import blocked_end
from salver.scenario import Scenario
from salver.sensitivity.arm.terms import motion_terms
from salver.trajectory import JointMotion, MotionSamples, SampledReference

if TYPE_CHECKING:
    from salver.planning.plan import Plan

DEGREE = 5
REFINED = 0.5  # damping of the first step after pieces have been added,
TURNED = 0.3  # after the last joint has been turned by a right angle,
NEAR = 0.1  # and from the optimum of a similar problem
ATTEMPTS = 40  # random postures from which the ends are sought
POSTURES = 4  # start postures that are tried when none is given
OTHERS = 6  # further goal postures that are tried when the likely ones fail
BENDS = 3  # detours that are tried after them


@dataclass(frozen=True)
class FastestOptions:
    """spans: number of polynomial pieces. nodes_per_span: where conditions are imposed.
    starts: local optima refined, of which the best is taken. time_limit: s. seed: of the random starts.
    """

    spans: int = 20
    nodes_per_span: int = 2
    starts: int = 1
    time_limit: float = 30.0
    seed: int = 0


@dataclass(frozen=True)
class FastestMotion:
    """Result. spline, coefficients (size, n), duration: the motion. worst: largest row of each block on the fine
    grid (<= 0: kept). wall_time: s. iterations: of all rounds and starts.
    """

    problem: TransportProblem
    spline: RestSpline
    coefficients: Array
    duration: float
    status: Status
    worst: dict[str, float]
    wall_time: float
    iterations: int

    def sample(self, t: Array) -> tuple[Array, Array, Array, Array]:
        """q, dq, ddq, dddq (T, n) at times t, clamped to rest outside [0, duration]."""
        s = np.clip(np.asarray(t, dtype=float) / self.duration, 0.0, 1.0)
        curve = FreeCurve(self.problem, Grid.of(self.spline, s))
        q, *rates = curve.motion(self.coefficients, self.duration)
        inside = ((t >= 0) & (t <= self.duration))[:, None]
        dq, ddq, dddq = (np.where(inside, rate, 0.0) for rate in rates)
        return q, dq, ddq, dddq

    def joint_motion(self) -> JointMotion:
        """The same motion as samples; exact between them too, as the breaks of the spline are among them."""
        t = self.duration * np.union1d(np.linspace(0, 1, 401), self.spline.breaks())
        q, dq, ddq, _ = self.sample(t)
        return JointMotion(t, q, dq, ddq)

    def reference(self) -> SampledReference:
        """The motion of the first object's frame B."""
        joint = self.joint_motion()
        return SampledReference(object_motion(self.problem, joint.t, joint.q, joint.dq, joint.ddq))


def object_motion(problem: TransportProblem, t: Array, q: Array, dq: Array, ddq: Array) -> MotionSamples:
    """Motion of the first object's frame B at joint states (T, n)."""
    tray = tray_motion(problem.arm, JointMotion(t, q, dq, ddq))
    return tray.of_frame(problem.items[0].p_EB, problem.items[0].R_EB)


def plan_fastest(scenario: Scenario, *, robust: bool = True, options: FastestOptions | None = None) -> Plan:
    """The fastest plan of a scenario with an arm. Its contact condition is the exact one, whatever the scenario's.

    robust: safe for the whole uncertain set (with the arm's tracking), or for nominal parameters only.
    Raises ScenarioError when the scenario has no arm; a plan that could not be found has a status that says so.
    """
    problem = transport_problem(scenario, robust=robust)
    found = fastest(problem, options)
    if not np.isfinite(found.duration):
        raise UnreachableError(f"{scenario.name}: {found.status.sentence}")
    record = {
        "name": "sequential quadratic programming (PIQP)",
        "robust": robust,
        "seconds": found.wall_time,
        "iterations": found.iterations,
        "spans": found.spline.spans,
        "worst": found.worst,
        **tracking_record(found),
    }
    return joint_plan(scenario, problem, found.joint_motion(), found.status, record)


def joint_plan(
    scenario: Scenario, problem: TransportProblem, joint: JointMotion, status: Status, record: Mapping[str, Any]
) -> Plan:
    """A motion of the joints as a plan under the exact contact condition, judged by the arm's own verdict."""
    from salver.planning.follow.limits import torques, verdict
    from salver.planning.plan import Plan

    exact = scenario.with_changes(contact__condition="exact")
    reference = SampledReference(object_motion(problem, joint.t, joint.q, joint.dq, joint.ddq))
    parts = None if problem.keep_out is None else problem.keep_out.parts
    plan = Plan(exact, "fastest", reference, status, joint, verdict(problem.arm, joint, problem.items, parts))
    tau = torques(problem.arm, JointMotion(plan.t, *joint.sample(plan.t)), problem.items)
    return replace(plan, tau=tau, solver=record)


def tracking_record(found: FastestMotion) -> dict[str, float]:
    """Peak of what the arm may stray under the uncertain load: the tray's position (m) and orientation (rad)."""
    problem = found.problem
    if problem.tracking is None:
        return {}
    t = np.linspace(0, 1, 201) * found.duration
    q, *rates = found.sample(t)
    terms = motion_terms(problem.model, problem.arm.tray_id, q, rates[0], rates[1])
    position, turn = problem.tracking.along(t, terms, np.stack(rates)).tray_radius()
    return {"tray_position_radius": float(position.max()), "tray_orientation_radius": float(turn.max())}


def fastest(
    problem: TransportProblem, options: FastestOptions | None = None, near: FastestMotion | None = None
) -> FastestMotion:
    """Shortest safe motion of a problem (see `transport_problem`). Never raises for numerical reasons: see `status`.

    near: a motion of a similar problem, tried first.
    """
    options = options or FastestOptions()
    begun = time.perf_counter()
    if near is not None:
        begin = SplineMotion(near.spline, near.coefficients, near.duration)
        found = _optimum(problem, options, begin, options.time_limit, NEAR)
        if found.status.ok:
            return found
    blocked = _blocked(problem)
    guesses = [] if blocked is not None else _guesses(problem, options)

    def left() -> float:
        return max(options.time_limit - (time.perf_counter() - begun), 0.05)

    # The best of the first few rough optima is refined; when none is feasible, the next that is; at last the others.
    screened = 1 if problem.start_posture is not None else POSTURES
    roughs = [_rough(problem, options, guess, left()) for guess in guesses[:screened]]
    further, iterations, refined = guesses[screened:], 0, 0
    best: FastestMotion | None = None
    while roughs or further:
        roughs.sort(key=_merit)
        if further and not (roughs and roughs[0].status.ok) and left() > 0.05:
            roughs.append(_rough(problem, options, further.pop(0), left()))
            continue
        start = roughs.pop(0)
        if refined == 0 and isinstance(problem.goal, AtPose) and problem.goal.target.yaw_free:
            start, *roughs = sorted([start, *_turned(problem, options, start, left()), *roughs], key=_merit)
        found = _optimum(problem, options, _with_all_pieces(options, start.iterate), left(), REFINED)
        iterations, refined = iterations + start.iterations + found.iterations, refined + 1
        if best is None or (found.status.ok, -found.duration) > (best.status.ok, -best.duration):
            best = found
        if (best.status.ok and refined >= options.starts) or left() <= 0.05:
            break
    iterations += sum(found.iterations for found in roughs)
    wall = time.perf_counter() - begun
    if best is None:
        spline = RestSpline(DEGREE, options.spans)
        unreached = "No posture within the joint limits reaches the start or the goal pose."
        status = blocked or Status("unreachable", unreached, False)
        return FastestMotion(problem, spline, np.zeros((spline.size, problem.n)), np.inf, status, {}, wall, 0)
    return replace(best, wall_time=wall, iterations=iterations)


def nearby(
    found: FastestMotion, objective: Objective, duration: float, options: FastestOptions | None = None
) -> FastestMotion:
    """The motion with the least objective at a duration (s), near one that was found; under the same constraints."""
    options = options or FastestOptions()
    start = SplineMotion(found.spline, found.coefficients, duration)
    return _optimum(found.problem, options, start, options.time_limit, NEAR, objective)


def _blocked(problem: TransportProblem) -> Status | None:
    """Why no motion can begin or end as it should, or None."""
    if problem.keep_out is None:
        return None
    ends = {"start": problem.start, "goal": problem.goal}
    poses = {name: end.target for name, end in ends.items() if isinstance(end, AtPose) and not end.target.yaw_free}
    stuck = blocked_end(problem.keep_out.parts, {name: target.tray_pose for name, target in poses.items()})
    if stuck is not None or problem.start_posture is None:
        return stuck
    touch = problem.keep_out.parts.first_touch(problem.start_posture[None])
    if touch is None:
        return None
    return Status("collision", f"In the start posture {touch.first} and {touch.second} touch.", False)


@dataclass(frozen=True)
class _Guess:
    """An initial path: min-jerk between two postures plus a bell along `bend`, (n,) each."""

    q_start: Array
    q_goal: Array
    bend: Array

    def path(self, s: Array) -> Array:
        """(len(s), n) postures at s in [0, 1]."""
        line = self.q_start + min_jerk_blend(s)[:, None] * (self.q_goal - self.q_start)
        return np.asarray(line + (64 * (s * (1 - s)) ** 3)[:, None] * self.bend)


def _guesses(problem: TransportProblem, options: FastestOptions) -> list[_Guess]:
    """Initial paths, most promising first.

    With the start posture given: to the goal posture nearest to it, then to others, then bent. With none given:
    between nearby postures that are clear of joint limits and of the arm's own parts.
    """
    rng = np.random.default_rng(options.seed)
    limits, n = problem.limits, problem.n
    centre, half = limits.range(POSITION)
    half = np.where(np.isfinite(half), half, np.pi)
    given = problem.start_posture
    coasting = np.zeros(n)  # a moving start goes on for a while
    if isinstance(problem.start, AtPosture) and problem.start.moving:
        coasting = 0.5 * problem.start.rates[0] * braking_time(problem)
    found: list[tuple[float, _Guess]] = []

    def apart(difference: Array) -> float:
        """Largest difference of a joint; whole turns are none, as the arm stands and moves the same."""
        turns = np.where(problem.arm.linear, 0.0, np.round(difference / (2 * np.pi)))
        return float(np.abs(difference - 2 * np.pi * turns).max())

    def add(q_start: Array, near: Array) -> None:
        q_goal = problem.goal.nearest(problem.arm, limits, near)
        if q_goal is None:
            return
        others = (apart(q_goal - g.q_goal) + apart(q_start - g.q_start) for _, g in found)
        if min(others, default=np.inf) > 0.3:
            ends = np.stack([q_start, q_goal])
            cost = float(np.max(np.abs(q_goal - q_start) / limits.velocity))
            cost += float(np.max(np.abs((ends - centre) / half)) ** 8)
            if problem.keep_out is not None:
                cost += 20 * max(0.0, 0.03 - float(problem.keep_out.distances(ends).min()))
            found.append((cost, _Guess(q_start, q_goal, np.zeros(n))))

    for attempt in range(ATTEMPTS):
        guess = centre + (0.7 * half * rng.uniform(-1, 1, n) if attempt else 0.0)
        if given is None:
            q_start = problem.start.nearest(problem.arm, limits, guess)
            if q_start is not None:
                add(q_start, q_start)
        elif attempt < OTHERS:
            spread = attempt / OTHERS
            add(given, (1 - spread) * (given + coasting) + spread * guess)
    if given is None:
        found.sort(key=lambda item: item[0])
    straight = [guess for _, guess in found]
    bent = [replace(guess, bend=rng.normal(0.0, 0.25, n)) for guess in straight[:1] for _ in range(BENDS)]
    return [*straight, *bent] if given is not None else [*straight[:POSTURES], *bent]


def straight_start(problem: TransportProblem, spline: RestSpline) -> SplineMotion:
    """Where the search begins: the most promising straight line in joint space, at a comfortable duration.

    Raises UnreachableError when no posture reaches an end.
    """
    guesses = _guesses(problem, FastestOptions())
    if not guesses:
        raise UnreachableError("No posture within the joint limits reaches the start or the goal pose.")
    return _begun(problem, guesses[0], spline)


def _begun(problem: TransportProblem, guess: _Guess, spline: RestSpline) -> SplineMotion:
    s = np.linspace(0, 1, 201)
    q = guess.path(s)
    if problem.moving:
        duration = braking_time(problem) + float(np.max(np.abs(q[-1] - q[0]) / problem.limits.velocity))
    else:
        duration = _comfortable_duration(problem, np.abs(np.gradient(q, s, axis=0)).max(axis=0))
    return SplineMotion(spline, spline.fit(s, q), duration)


def _rough(problem: TransportProblem, options: FastestOptions, guess: _Guess, time_limit: float) -> Solution:
    """A first optimum with few spline pieces, from a comfortable duration."""
    return rough(problem, FreeCurve, _begun(problem, guess, _few(options)), options.nodes_per_span, time_limit)


def _turned(
    problem: TransportProblem, options: FastestOptions, found: Solution, time_limit: float
) -> Iterator[Solution]:
    """The same motion ending a quarter turn of the last joint away, optimised again: a local optimum does not turn."""
    few = _few(options)
    ramp = min_jerk_blend(np.linspace(0, 1, few.size))
    for turn in (0.5 * np.pi, -0.5 * np.pi):
        coefficients = found.iterate.coefficients.copy()
        coefficients[:, -1] += turn * ramp
        if problem.limits.q_min[-1] < coefficients[-1, -1] < problem.limits.q_max[-1]:
            start = SplineMotion(few, coefficients, found.iterate.duration)
            yield rough(problem, FreeCurve, start, options.nodes_per_span, time_limit, damping=TURNED)


def _merit(found: Solution) -> tuple[bool, float]:
    return not found.status.ok, found.iterate.duration


def _few(options: FastestOptions) -> RestSpline:
    return RestSpline(DEGREE, max(4, options.spans // 3))


def _with_all_pieces(options: FastestOptions, found: Iterate) -> SplineMotion:
    spline, s = RestSpline(DEGREE, options.spans), np.linspace(0, 1, 201)
    return SplineMotion(spline, spline.fit(s, _few(options).matrices(s)[0] @ found.coefficients), found.duration)


def _optimum(
    problem: TransportProblem,
    options: FastestOptions,
    start: SplineMotion,
    time_limit: float,
    damping: float,
    objective: Objective = SHORTEST,
) -> FastestMotion:
    """The optimum from a start that is near it, checked between the nodes."""
    begun = time.perf_counter()
    found = optimise(problem, FreeCurve, start, options.nodes_per_span, time_limit, damping, objective)
    wall = time.perf_counter() - begun
    return FastestMotion(
        problem, start.spline, found.coefficients, found.duration, found.status, found.worst, wall, found.iterations
    )


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
