"""Load-safe stops: the shortest motions from instants along a plan to rest that keep the load in place.

A stop begins in the plan's state at its instant, with the tracking error that the arm has then under a parameter error,
and ends at rest in any posture. It satisfies all constraints of a fastest motion: only stops that pass the verdict
(`salver.planning.verdict.verify`) are stored.

After a stop request the plan is followed up to one of the stored instants ahead, whose stop is then taken, or to its
end, whichever is at rest first. So a stop always exists, and is never later than the end of the plan.

Stops are followed in joint space, also when the plan's controller closes its loop on the object's pose.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from salver.control.object import Gains
from salver.dynamics.modal_history import Past
from salver.errors import SalverError, ScenarioError
from salver.geometry import Array, lean
from salver.models.arm.arm import load_arm
from salver.planning.follow.forward import tray_motion
from salver.planning.seeds.starts import braking_time
from salver.planning.stop_library import SAME, StopLibrary
from salver.planning.trajopt.constraints.constraints import LEVEL_TOLERANCE
from salver.planning.trajopt.constraints.obstacles import KeepOut
from salver.planning.trajopt.curves import FreeCurve, Grid, united
from salver.planning.trajopt.ends import Anywhere, AtPosture
from salver.planning.trajopt.evaluation import EASING
from salver.planning.trajopt.exchange import optimise
from salver.planning.trajopt.problem import TransportProblem, transport_problem
from salver.planning.trajopt.spline import RestSpline, SplineMotion
from salver.planning.verdict.judged import PLANNED, VerdictOptions
from salver.planning.verdict.verify import Verdict, verify
from salver.sensitivity.arm.compliance import LoadResponses
from salver.sensitivity.arm.task import task_law
from salver.sensitivity.arm.terms import motion_terms
from salver.sensitivity.arm.tracking import Deviation, deviation, late
from salver.trajectory import JointMotion, SampledReference, smooth_step

if TYPE_CHECKING:
    from salver.planning.plan import Plan

SPLINE = RestSpline(degree=5, spans=6)  # of a stop
FINE = RestSpline(degree=5, spans=10)  # of a stop that is searched for again from braking
# Samples of a stop include the spline's breaks, so that the stored motion is the one that was checked.
STORED = united(united(np.linspace(0.0, 1.0, 41), SPLINE.breaks()), FINE.breaks())
WARM = 0.3  # damping of the first step from the stop of the next instant
LEAST = 1e-4  # s by which a stop must be earlier at rest than the course without it
Progress = Callable[[int, int], None]
Space = Literal["object", "joint"]


def with_stops(plan: Plan, progress: Progress | None = None) -> Plan:
    """The plan with its stops. Raises ScenarioError when it is not a safe plan of an arm."""
    if plan.joint is None or not plan.ok:
        raise ScenarioError("Stops are planned for safe plans of an arm; this plan is unsafe or has no arm.")
    stops = plan_stops(stop_problem(plan), plan.joint, space=plan.space, progress=progress)
    return replace(plan, stops=stops)


def stop_problem(plan: Plan) -> TransportProblem:
    """The transport problem of a plan's stops: every constraint of a fastest motion of the scenario.

    Where the plan itself tilts further, or passes obstacles more closely, its stops may too.
    """
    assert plan.joint is not None
    q = plan.joint.sample(np.linspace(0.0, plan.joint.duration, 401))[0]
    free = plan.scenario.with_changes(arm__start_posture=None, motion__through=[])
    problem = transport_problem(free)
    tilt = max(float(lean(problem.arm.tray_pose(x)[1])) for x in q)
    if tilt > max(problem.max_tilt, LEVEL_TOLERANCE):
        problem = replace(problem, max_tilt=1.01 * tilt)  # it may be larger between the instants checked
    if problem.keep_out is not None:
        problem = replace(problem, keep_out=KeepOut.of(problem.keep_out.parts, q))
    return problem


def stopped(plan: Plan, now: float) -> Plan:
    """The plan after a stop request at `now`, s. Raises ScenarioError when it has no stops."""
    if plan.stops is None or plan.joint is None:
        raise ScenarioError("This plan has no stops; plan it with salver plan SCENARIO --stops.")
    if not 0 < now <= plan.duration:
        raise ScenarioError(
            f"The stop is asked for at {now:g} s; it must be after 0 and not after {plan.duration:.4g} s, the end."
        )
    assert plan.scenario.arm is not None
    joint, first = plan.stops.stopped(plan.joint, now), plan.scenario.payload.first
    tray = tray_motion(load_arm(plan.scenario.arm, plan.scenario.tray), joint)
    reference = SampledReference(tray.of_frame(first.p_EB, first.R_EB))
    return replace(plan, joint=joint, reference=reference, tau=None, stops=None)


def plan_stops(
    problem: TransportProblem,
    motion: JointMotion,
    every: float = 0.02,
    space: Space = "joint",
    progress: Progress | None = None,
    soon: float = 0.1,
) -> StopLibrary:
    """Stops along a motion that satisfy the problem's constraints.

    They are found backwards in time: the initial guess of a stop is to go on to the next instant and to stop as there.
    An instant is skipped if its own stop is not earlier at rest than that, or if going on is at rest within `soon`.
    Where a stop is late although the arm is slow, as while the tray tilts into the first acceleration, it is searched
    for again from braking, with more spline pieces, and the instants are half as far apart.

    Args:
        problem: with the constraints of a stop.
        motion: from rest to rest.
        every: time between instants, s; twice that with load dynamics. Larger values take less computing time and lead
            to later rest.
        space: in which the controller closes its loop along the motion.
        progress: called with the ms done and the total, counted from the end of the motion.
        soon: s; larger values give a slow plan fewer stops.

    Raises:
        SalverError: the motion does not begin and end at rest.
    """
    if np.abs(motion.dq[[0, -1]]).max() > 1e-6:
        raise SalverError("Stops are planned along motions from rest to rest; this one begins or ends moving.")
    end = motion.duration
    every = every * (2.0 if problem.cases else 1.0)  # with load dynamics each takes several searches
    instants = np.arange(every, end - 0.5 * every, every)
    t, felt, strayed = along(problem, motion, space)
    past = past_of(problem, t, felt, strayed)
    radius = np.zeros((len(t), problem.n)) if strayed is None else strayed.joint_radius(0)
    kept: list[tuple[float, FoundStop]] = []
    ahead = JointMotion(*(np.asarray(x)[-1:] for x in (motion.t, motion.q, motion.dq, motion.ddq)))
    rest, begin = end, end  # when the stop ahead is at rest, and when it leaves the plan

    def state_at(now: float) -> AtPosture:
        return AtPosture(*(x[0] for x in motion.sample(now)))

    left = [float(now) for now in instants]
    while left:
        now = left.pop()
        begun = None if strayed is None else strayed.state_at(t, now)
        if past is not None:
            problem = replace(problem, past=replace(past, now=now))
        if rest - now < soon:
            found = None
        else:
            state, beat = state_at(now), rest - now - LEAST
            found = _anew(problem, state, begun, beat) if rest - now > _late(problem, state) else None
            if found is None:
                found = stop_from(problem, state, begun, _going_on(motion, now, begin, ahead), beat=beat)
        if found is not None and now + found.motion.duration < rest - LEAST:
            kept.append((now, found))
            ahead, rest, begin = found.motion, now + found.motion.duration, now
        before = left[-1] if left else 0.0
        finer = now - before > 0.9 * every  # not halved already
        if finer and rest - before > _late(problem, state_at(before)):
            left.append(0.5 * (before + now))
        if progress:
            progress(round(1e3 * (end - (left[-1] if left else 0.0))), round(1e3 * end))
    kept.reverse()
    shape = (len(kept), len(STORED), problem.n)
    q, dq, ddq = (np.array([getattr(stop.motion, x) for _, stop in kept]).reshape(shape) for x in ("q", "dq", "ddq"))
    instants = np.array([now for now, _ in kept])
    stray = [np.maximum(stop.stray, radius[t <= now].max(axis=0)) for now, stop in kept]
    return StopLibrary(
        instants,
        np.array([stop.motion.duration for _, stop in kept]),
        STORED,
        q,
        dq,
        ddq,
        np.array([*stray, radius.max(axis=0)]),
        end,
    )


@dataclass(frozen=True, eq=False)
class FoundStop:
    """A stop. motion: from its own time 0 to rest. stray: (n,) largest deviation of each joint, rad."""

    motion: JointMotion
    stray: Array


def stop_from(
    problem: TransportProblem,
    state: AtPosture,
    deviation: Array | None = None,
    guess: JointMotion | None = None,
    beat: float = np.inf,
) -> FoundStop | None:
    """The shortest motion from a state of the arm to rest in any posture; None when none was found.

    The motion is checked between the nodes of the programme, on a grid six times finer (joint limits: thirty times
    finer), and must pass the verdict.

    problem: with the constraints and the uncertain set; its ends are ignored. state: posture, velocity and
    acceleration. deviation: (2, n, n_c + 1) of the arm under a parameter error, of `Deviation.state_at`; at rest unless
    given. guess: initial motion from the state to rest; braking of every joint unless given. beat: s; the search ends
    early when a shorter duration is unlikely.
    """
    problem = _begun(problem, state, deviation)
    if guess is None:
        return _shortest(problem, _braking(SPLINE, state, braking_time(problem)), beat)
    # With load dynamics few motions to rest exist: the search then also begins with 1.3 and 1.15 times the duration.
    begins = [(1.0, WARM), (1.3, 1.0), (1.15, WARM)]
    for longer, damping in begins if problem.cases else begins[:1]:
        duration = longer * guess.duration
        begin = SplineMotion(SPLINE, _fitted(problem, guess, duration), duration)
        if (found := _shortest(problem, begin, beat, damping)) is not None:
            return found
    return None


def _late(problem: TransportProblem, state: AtPosture) -> float:
    """Duration, s, above which a stop from a state counts as late and is searched for again: about 1.6 times that of
    braking the joints with an empty tray."""
    return max(0.22, 0.9 * braking_time(replace(problem, start=state)))


def _anew(problem: TransportProblem, state: AtPosture, deviation: Array | None, beat: float) -> FoundStop | None:
    """A stop from a state, searched for from braking and with more spline pieces, shorter than `beat`, s."""
    begin = _braking(FINE, state, _late(problem, state))
    return _shortest(_begun(problem, state, deviation), begin, beat)


def _begun(problem: TransportProblem, state: AtPosture, deviation: Array | None) -> TransportProblem:
    """The problem of stopping from a state and a deviation."""
    tracking = problem.tracking
    if tracking is not None and deviation is not None:
        tracking = tracking.begun(deviation)
    return replace(problem, start=state, goal=Anywhere(), tracking=tracking)


def _shortest(
    problem: TransportProblem, begin: SplineMotion, beat: float = np.inf, damping: float = WARM
) -> FoundStop | None:
    """The shortest motion to rest that passes the verdict; None when none was found."""
    hasty = replace(problem, at_rest=False)
    found = optimise(hasty, FreeCurve, begin, nodes_per_span=3, damping=damping, gain=1e-2, beat=beat)
    if not found.status.ok:
        return None
    curve = FreeCurve(problem, Grid.of(begin.spline, STORED))
    q, dq, ddq = curve.motion(found.coefficients, found.duration)[:3]
    dq[-1] = ddq[-1] = 0.0  # it is, up to rounding
    motion, start = JointMotion(STORED * found.duration, q, dq, ddq), problem.start
    assert isinstance(start, AtPosture)
    verdict = verify(problem, motion, (start.q, *start.rates), stopping(found.duration))
    if not verdict.ok:
        return None
    assert verdict.judged is not None
    return FoundStop(motion, verdict.judged.stray)


def along(problem: TransportProblem, motion: JointMotion, space: Space) -> tuple[Array, Array, Deviation | None]:
    """Instants (T,), s, the tray's motion regressor there (T, 12), and the arm's deviation under parameter errors along
    a motion from rest, with the loop closed on the joints or on the object's pose; None when nothing is uncertain."""
    t = np.linspace(0.0, motion.duration, max(401, int(np.ceil(motion.duration / 4e-3)) + 1))
    tracking = problem.tracking
    q, dq, ddq = motion.sample(t)
    terms = motion_terms(problem.model, problem.arm.tray_id, q, dq, ddq)
    if tracking is None:
        return t, terms.w, None
    rates = np.stack([dq, ddq, motion.jerk(t)])
    if space == "joint":
        return t, terms.w, tracking.along(t, terms, rates)
    control = problem.scenario.control
    law = task_law(t, terms, problem.items[0], Gains(control.kp, control.kd), tracking.settle)
    return t, terms.w, deviation(tracking.load, terms, late(terms, rates, tracking.delay), law)


def past_of(problem: TransportProblem, t: Array, felt: Array, strayed: Deviation | None) -> Past | None:
    """Modal states of the load dynamics along the motion; None without load dynamics."""
    if not problem.cases:
        return None
    return LoadResponses.of(problem.every_case, t, felt, strayed).past(t)


def verdicts(plan: Plan) -> Iterator[tuple[float, Verdict]]:
    """The instant, s, of each stop of a plan, and the verdict on it, from the state of arm, load and liquids then."""
    assert plan.joint is not None
    assert plan.stops is not None
    problem = stop_problem(plan)
    t, felt, strayed = along(problem, plan.joint, plan.space)
    past = past_of(problem, t, felt, strayed)
    for k, now in enumerate(plan.stops.t.tolist()):
        q, dq, ddq = (x[0] for x in plan.joint.sample(now))
        if past is not None:
            problem = replace(problem, past=replace(past, now=now))
        begun = _begun(problem, AtPosture(q, dq, ddq), None if strayed is None else strayed.state_at(t, now))
        motion = plan.stops.motion(k)
        yield now, verify(begun, motion, (q, dq, ddq), stopping(motion.duration))


def stopping(duration: float) -> VerdictOptions:
    """Options of the verdict on a stop of a duration, s.

    A stop begins with the margins that its plan has then, and recovers them over the share `EASING` of its duration. At
    its first instants the jerk differs, so a tenth of each margin may be missing (measured on 59 stops: at most 2.7e-5
    of the normal force).
    """
    return replace(PLANNED, forgiven=1.1, beginning=EASING * duration)


def _going_on(motion: JointMotion, now: float, begin: float, ahead: JointMotion) -> JointMotion:
    """The plan from `now` to `begin`, followed by the motion `ahead`; from time 0."""
    between = np.unique(np.concatenate([[now], motion.t[(motion.t > now + SAME) & (motion.t < begin - SAME)]]))
    first = motion.sample(between)
    t = np.concatenate([between - now, begin - now + (ahead.t - ahead.t[0])])
    return JointMotion(t, *(np.vstack([a, b]) for a, b in zip(first, (ahead.q, ahead.dq, ahead.ddq), strict=True)))


def _braking(spline: RestSpline, state: AtPosture, duration: float) -> SplineMotion:
    """Braking: the velocity of every joint decreases along the smooth step 1 - 3 s^2 + 2 s^3."""
    s = np.linspace(0.0, 1.0, 121)
    q = state.q + np.outer(0.5 * duration * smooth_step(s), state.rates[0])
    return SplineMotion(spline, spline.fit(s, q), duration)


def _fitted(problem: TransportProblem, guess: JointMotion, duration: float) -> Array:
    """Coefficients (size, n) of the motion closest to a guess in posture and acceleration, with the same ends."""
    s, smooth = np.linspace(0.0, 1.0, 121), 0.1  # weight of acceleration, in normalised time, beside posture
    curve, (q, _, ddq) = FreeCurve(problem, Grid.of(SPLINE, s)), guess.sample(s * guess.duration)
    begun, basis = curve.motion(np.zeros((SPLINE.size, problem.n)), duration), curve.grid.basis
    q, ddq = q - begun[0], (ddq - begun[2]) * duration**2
    ends = np.stack([q[0], q[-1]])
    rows = np.vstack([basis[0], smooth * basis[2]])
    target = np.vstack([q, smooth * ddq]) - rows[:, [0, -1]] @ ends
    inner = np.linalg.lstsq(rows[:, 1:-1], target, rcond=None)[0]
    return np.vstack([ends[:1], inner, ends[1:]])
