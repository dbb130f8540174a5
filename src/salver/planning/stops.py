"""Load-safe stops: from instants along a plan, the shortest motions to rest that keep the load in its place.

A stop begins in the state of the plan at its instant, with the arm's deviation under a parameter error as it is there,
and ends at rest anywhere. Everything that holds of a fastest motion holds of it: only stops that pass the verdict
(`salver.planning.verdict.verify`) are kept.

From any instant the plan is followed to one of the stored instants ahead, and its stop taken, or to its end: whichever
is at rest first. So there is always one, and it is never later than the plan itself.

A stop is followed in the joints, also that of a plan whose controller closes its loop on the object's pose.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from salver.control.object import Gains
from salver.dynamics.modal_history import Past
from salver.errors import SalverError, ScenarioError
from salver.geometry import Array, lean
from salver.models.arm.arm import load_arm
from salver.planning.fastest.retiming import SplinePath
from salver.planning.follow.forward import tray_motion
from salver.planning.seeds.starts import braking_time
from salver.planning.stop_library import SAME, StopLibrary
from salver.planning.trajopt.constraints.constraints import LEVEL_TOLERANCE
from salver.planning.trajopt.constraints.obstacles import KeepOut
from salver.planning.trajopt.curves import BrakingCurve, FreeCurve, Grid, launch_basis, united
from salver.planning.trajopt.ends import Anywhere, AtPosture
from salver.planning.trajopt.evaluation import EASING
from salver.planning.trajopt.exchange import CurveOf, optimise
from salver.planning.trajopt.problem import TransportProblem, transport_problem
from salver.planning.trajopt.spline import RestSpline, SplineMotion, min_jerk_blend
from salver.planning.verdict.judged import PLANNED, VerdictOptions
from salver.planning.verdict.verify import Verdict, verify
from salver.sensitivity.arm.compliance import LoadResponses
from salver.sensitivity.arm.task import task_law
from salver.sensitivity.arm.terms import motion_terms
from salver.sensitivity.arm.tracking import Deviation, deviation, late
from salver.trajectory import JointMotion, SampledReference

if TYPE_CHECKING:
    from salver.planning.plan import Plan

SPLINE = RestSpline(degree=5, spans=6)  # of a stop,
FINE = RestSpline(degree=5, spans=10)  # and of one that is sought from another beginning
# Samples of a stop, with the breaks: what is stored is what was checked.
STORED = united(united(np.linspace(0.0, 1.0, 41), SPLINE.breaks()), FINE.breaks())
WARM = 0.3  # damping of the first step from the stop of the next instant
LEAST = 1e-4  # s by which a stop must be sooner at rest than what there is without it
Progress = Callable[[int, int], None]
Space = Literal["object", "joint"]


def with_stops(plan: Plan, progress: Progress | None = None) -> Plan:
    """The plan with its stops. Raises ScenarioError when it is no safe plan of an arm."""
    if plan.joint is None or not plan.ok:
        raise ScenarioError("Stops are planned for safe plans of an arm; this plan is none.")
    problem = stop_problem(plan)
    on_path = plan.scenario.motion.stop == "on-path"
    stops = plan_stops(problem, plan.joint, space=plan.space, on_path=on_path, progress=progress)
    return replace(plan, stops=stops)


def stop_problem(plan: Plan) -> TransportProblem:
    """The transport problem of a plan's stops: every constraint of a fastest motion of the scenario.

    Where the plan itself tilts further, or passes things more closely, a stop may too.
    """
    assert plan.joint is not None
    q = plan.joint.sample(np.linspace(0.0, plan.joint.duration, 401))[0]
    free = plan.scenario.with_changes(arm__start_posture=None, motion__through=[])
    problem = transport_problem(free)
    tilt = max(float(lean(problem.arm.tray_pose(x)[1])) for x in q)
    if tilt > max(problem.max_tilt, LEVEL_TOLERANCE):
        problem = replace(problem, max_tilt=1.01 * tilt)  # between the instants that were looked at it may be more
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
    on_path: bool = False,
    progress: Progress | None = None,
    soon: float = 0.1,
) -> StopLibrary:
    """Stops along a motion that the problem's constraints allow.

    Found backwards in time: from an instant, going on to the next one and stopping as there is a stop already, and so
    a place to begin. Instants whose own stop is no sooner at rest than that are left out, and those at which going on
    is at rest `soon`. Where a stop is late for how slow the arm still is, as while the tray leans into the first
    acceleration, it is sought from another beginning and with more pieces, and instants are half as far apart. What
    will be no sooner at rest than going on is given up.
    every: s from one instant to the next, twice that with inner dynamics; doubled, half the stops are found in half the
    time, and the arm is at rest by up to as much later. soon: s; doubled, a slow plan has fewer stops. space: where the
    controller closes its loop along the motion. on_path: stops that never leave the motion's own path, of which only
    the timing is free; often there is none, as where a tray leans into the plan's acceleration. progress: called with
    how many of how many ms are done, from the end on. Raises SalverError when the motion has no stop because it begins
    or ends moving."""
    if np.abs(motion.dq[[0, -1]]).max() > 1e-6:
        raise SalverError("Stops are planned along motions from rest to rest; this one begins or ends moving.")
    end = motion.duration
    every = every * (2.0 if problem.cases else 1.0)  # what swings takes several beginnings each
    instants = np.arange(every, end - 0.5 * every, every)
    t, felt, strayed = along(problem, motion, space)
    past = past_of(problem, t, felt, strayed)
    radius = np.zeros((len(t), problem.n)) if strayed is None else strayed.joint_radius(0)
    path = SplinePath.timed(motion) if on_path else None
    kept: list[tuple[float, FoundStop]] = []
    ahead = JointMotion(*(np.asarray(x)[-1:] for x in (motion.t, motion.q, motion.dq, motion.ddq)))
    rest, begin = end, end  # when what is ahead is at rest, and where it leaves the plan

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
        elif path is None:
            state, beat = state_at(now), rest - now - LEAST
            found = _anew(problem, state, begun, beat) if rest - now > _late(problem, state) else None
            if found is None:
                found = stop_from(problem, state, begun, _going_on(motion, now, begin, ahead), beat=beat)
        else:
            found = brake_on(problem, path, end, now, begun, _law_ahead(now, begin, end, kept), rest - now)
        if found is not None and now + found.motion.duration < rest - LEAST:
            kept.append((now, found))
            ahead, rest, begin = found.motion, now + found.motion.duration, now
        before = left[-1] if left else 0.0
        finer = path is None and now - before > 0.9 * every  # not halved already
        if finer and rest - before > _late(problem, state_at(before)):
            left.append(0.5 * (before + now))
        if progress:
            progress(round(1e3 * (end - (left[-1] if left else 0.0))), round(1e3 * end))
    kept.reverse()
    shape = (len(kept), len(STORED), problem.n)
    q, dq, ddq = (np.array([getattr(stop.motion, x) for _, stop in kept]).reshape(shape) for x in ("q", "dq", "ddq"))
    instants = np.array([now for now, _ in kept])
    if len(kept):  # to the last digit: what is found on a path is, to what its spline leaves
        q[:, 0], dq[:, 0], ddq[:, 0] = motion.sample(instants)
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
    """motion: from its own time 0 to rest. stray: (n,) rad, the most by which each joint may be off it. law: of a stop
    on a path, where on it the samples of the motion are, from 0 to 1."""

    motion: JointMotion
    stray: Array
    law: Array | None = None


def stop_from(
    problem: TransportProblem,
    state: AtPosture,
    deviation: Array | None = None,
    guess: JointMotion | None = None,
    beat: float = np.inf,
) -> FoundStop | None:
    """The shortest motion to rest anywhere from a state of the arm; None when none was found.

    problem: what must hold on the way, for which uncertain set; its ends are not asked for.
    deviation: (2, n, n_c + 1) in which the arm is under a parameter error, of `Deviation.state_at`; at rest under it
    unless given. guess: a motion from the state to rest, to begin with: braking of every joint unless given.
    beat: s; given up where it will hardly be shorter than this.

    What is found is checked between the nodes of the programme, on a grid six times finer (the joints' own limits on
    one thirty times finer), and has to pass the verdict.
    """
    problem = _begun(problem, state, deviation)
    if guess is None:
        return _shortest(problem, FreeCurve, _braking(SPLINE, state, braking_time(problem)), beat)
    # Inner dynamics leave few ways to rest: with them a search begins at times of 1.3 and 1.15 the guess's duration
    # too.
    begins = [(1.0, WARM), (1.3, 1.0), (1.15, WARM)]
    for longer, damping in begins if problem.cases else begins[:1]:
        duration = longer * guess.duration
        begin = SplineMotion(SPLINE, _fitted(problem, guess, duration), duration)
        if (found := _shortest(problem, FreeCurve, begin, beat, damping)) is not None:
            return found
    return None


def _late(problem: TransportProblem, state: AtPosture) -> float:
    """s after which a stop from a state is late: in about 1.6 times the time in which joints alone fade it would be at
    rest if nothing stood on the tray. Smaller, more stops are sought from another beginning, each a
    search of its own."""
    return max(0.22, 0.9 * braking_time(replace(problem, start=state)))


def _anew(problem: TransportProblem, state: AtPosture, deviation: Array | None, beat: float) -> FoundStop | None:
    """A stop from a state that begins with braking, with more pieces, sooner than `beat`, s."""
    begin = _braking(FINE, state, _late(problem, state))
    return _shortest(_begun(problem, state, deviation), FreeCurve, begin, beat)


def brake_on(
    problem: TransportProblem,
    path: SplinePath,
    end: float,
    now: float,
    deviation: Array | None,
    law: tuple[Array, Array],
    duration: float,
) -> FoundStop | None:
    """The shortest stop that stays on a path, from where a motion of duration `end`, s, which gave it, is at `now`.

    deviation: as of `stop_from`. law: times from `now`, s, and where on the path, from 0 to 1, to begin with;
    duration: s, likewise. None when none was found.
    """
    begin, rate = now / end, 1.0 / end
    z = path.derivatives(np.array([begin]), 2)[:, 0] * rate ** np.arange(3.0)[:, None]
    problem = _begun(problem, AtPosture(*z), deviation)
    s = np.linspace(0.0, 1.0, 121)
    wanted = np.interp(s * law[0][-1], *law) - duration * rate * launch_basis(s)[0, 0]
    coefficients = np.clip(SPLINE.fit(s, wanted[:, None]), 0.0, 1.0)

    def curve_of(at: TransportProblem, grid: Grid) -> BrakingCurve:
        return BrakingCurve(at, grid, path, begin, rate)

    return _shortest(problem, curve_of, SplineMotion(SPLINE, coefficients, duration))


def _begun(problem: TransportProblem, state: AtPosture, deviation: Array | None) -> TransportProblem:
    """The problem of coming to rest from a state, and from a deviation."""
    tracking = problem.tracking
    if tracking is not None and deviation is not None:
        tracking = tracking.begun(deviation)
    return replace(problem, start=state, goal=Anywhere(), tracking=tracking)


def _shortest(
    problem: TransportProblem, curve_of: CurveOf, begin: SplineMotion, beat: float = np.inf, damping: float = WARM
) -> FoundStop | None:
    """The shortest motion to rest along a curve that passes the verdict; None when none was found."""
    hasty = replace(problem, at_rest=False)
    found = optimise(hasty, curve_of, begin, nodes_per_span=3, damping=damping, gain=1e-2, beat=beat)
    if not found.status.ok:
        return None
    curve = curve_of(problem, Grid.of(begin.spline, STORED))
    q, dq, ddq = curve.motion(found.coefficients, found.duration)[:3]
    dq[-1] = ddq[-1] = 0.0  # but for the last digits, it is
    motion, start = JointMotion(STORED * found.duration, q, dq, ddq), problem.start
    assert isinstance(start, AtPosture)
    verdict = verify(problem, motion, (start.q, *start.rates), stopping(found.duration))
    if not verdict.ok:
        return None
    assert verdict.judged is not None
    law = curve.law(found.coefficients, found.duration)[0, :, 0] if isinstance(curve, BrakingCurve) else None
    return FoundStop(motion, verdict.judged.stray, law)


def along(problem: TransportProblem, motion: JointMotion, space: Space) -> tuple[Array, Array, Deviation | None]:
    """Instants (T,), s, the tray's motion regressor there, (T, 12), and the deviation that a parameter error brings the
    arm into along a motion from rest, under the loop on the joints or on the object's pose; None when nothing is
    uncertain."""
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
    """Modal states of what moves inside loads along the motion; None where nothing does."""
    if not problem.cases:
        return None
    return LoadResponses.of(problem.every_case, t, felt, strayed).past(t)


def verdicts(plan: Plan) -> Iterator[tuple[float, Verdict]]:
    """The instant, s, of each stop that a plan carries, and the verdict on it: from the state that the plan has brought
    arm, load and liquids into then."""
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
    """Options of the verdict on a stop of a duration, s: it inherits what its plan has left of each margin, and makes
    up for it over the share `EASING` of its time; at its first instants the jerk is another one, so rows may lack a
    tenth of a margin more (2.7e-5 of the normal force at most, of 59 stops)."""
    return replace(PLANNED, forgiven=1.1, beginning=EASING * duration)


def _going_on(motion: JointMotion, now: float, begin: float, ahead: JointMotion) -> JointMotion:
    """The plan from `now` to `begin`, and what is ahead there; from time 0."""
    between = np.unique(np.concatenate([[now], motion.t[(motion.t > now + SAME) & (motion.t < begin - SAME)]]))
    first = motion.sample(between)
    t = np.concatenate([between - now, begin - now + (ahead.t - ahead.t[0])])
    return JointMotion(t, *(np.vstack([a, b]) for a, b in zip(first, (ahead.q, ahead.dq, ahead.ddq), strict=True)))


def _law_ahead(now: float, begin: float, end: float, kept: Sequence[tuple[float, FoundStop]]) -> tuple[Array, Array]:
    """The time law of going on to `begin` and stopping as there is a stop there: times from `now`, s, and where on the
    path of a motion of duration `end`, s."""
    t, u = np.linspace(now, begin, 21), np.linspace(now, begin, 21) / end
    if kept and kept[-1][1].law is not None:
        t, u = np.append(t, begin + kept[-1][1].motion.t[1:]), np.append(u, kept[-1][1].law[1:])
    return t - now, u


def _braking(spline: RestSpline, state: AtPosture, duration: float) -> SplineMotion:
    """Every joint's velocity fades along the smooth step 1 - 3 s^2 + 2 s^3."""
    s = np.linspace(0.0, 1.0, 121)
    q = state.q + np.outer(0.5 * duration * min_jerk_blend(s), state.rates[0])
    return SplineMotion(spline, spline.fit(s, q), duration)


def _fitted(problem: TransportProblem, guess: JointMotion, duration: float) -> Array:
    """(size, n) coefficients of a motion near to a guess in posture and acceleration, with its ends."""
    assert isinstance(problem.start, AtPosture)
    s, smooth = np.linspace(0.0, 1.0, 121), 0.1  # weight of acceleration, in normalised time, beside posture
    q, _, ddq = guess.sample(s * guess.duration)
    powers = np.array([duration, duration**2])[:, None, None]
    launch = launch_basis(s)[:, :, :, None] * problem.start.rates[:, None, None, :]
    basis = SPLINE.matrices(s)
    q = q - (launch[:, 0] * powers).sum(axis=0)
    ddq = ddq * duration**2 - (launch[:, 2] * powers).sum(axis=0)
    ends = np.stack([q[0], q[-1]])
    rows = np.vstack([basis[0], smooth * basis[2]])
    target = np.vstack([q, smooth * ddq]) - rows[:, [0, -1]] @ ends
    inner = np.linalg.lstsq(rows[:, 1:-1], target, rcond=None)[0]
    return np.vstack([ends[:1], inner, ends[1:]])
