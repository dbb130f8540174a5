"""Load-safe stops: from instants along a plan, the shortest motions to rest that keep the load in its place.

A stop begins in the state of the plan at its instant, with the arm's deviation under a wrong load as it is there, and
ends at rest anywhere. Everything that holds of a fastest motion holds of it: the arm's limits, contact in the worst
case over the uncertain set, clearance of the arm's own parts and of obstacles, between the nodes too.

From any instant the plan is followed to one of the stored instants ahead, and its stop taken, or to its end: whichever
is at rest first. So there is always one, and it is never later than the plan itself.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from salver.errors import SalverError, ScenarioError
from salver.geometry import Array
from salver.planning.fastest.curves import FreeCurve, Grid, launch_basis
from salver.planning.fastest.ends import Anywhere, AtPosture
from salver.planning.fastest.exchange import optimise
from salver.planning.fastest.problem import TransportProblem, transport_problem
from salver.planning.fastest.search import object_motion
from salver.planning.fastest.spline import RestSpline, SplineMotion
from salver.planning.stop_library import StopLibrary
from salver.trajectory import JointMotion, SampledReference

if TYPE_CHECKING:
    from salver.planning.plan import Plan

EVERY = 0.02  # s from one instant to the next
SPLINE = RestSpline(degree=5, spans=8)  # of every stop
NODES_PER_SPAN = 3
STORED = np.union1d(np.linspace(0.0, 1.0, 41), SPLINE.breaks())  # with the breaks: what is stored is what was checked
WARM = 0.3  # damping of the first step from the stop of the next instant
STATES = 401  # instants at which the deviation along the plan is known
SMOOTH = 0.1  # weight of acceleration, in normalised time, beside posture in the first guess
Progress = Callable[[int, int], None]


def with_stops(plan: Plan, progress: Progress | None = None) -> Plan:
    """The same plan with its stops. Raises ScenarioError when it is no safe fastest plan."""
    if plan.method != "fastest" or plan.joint is None or not plan.ok:
        raise ScenarioError("Stops are planned for safe fastest plans: salver plan SCENARIO --fastest --stops.")
    return replace(plan, stops=plan_stops(transport_problem(plan.scenario), plan.joint, progress=progress))


def stopped(plan: Plan, now: float) -> Plan:
    """What becomes of a plan when a stop is asked for at `now`, s. Raises ScenarioError when it has no stops."""
    if plan.stops is None or plan.joint is None:
        raise ScenarioError("This plan has no stops; plan it with salver plan SCENARIO --fastest --stops.")
    if not 0 <= now <= plan.duration:
        raise ScenarioError(f"The stop is asked for at {now:g} s; the plan lasts from 0 to {plan.duration:.4g} s.")
    joint, problem = plan.stops.stopped(plan.joint, now), transport_problem(plan.scenario)
    reference = SampledReference(object_motion(problem, joint.t, joint.q, joint.dq, joint.ddq))
    return replace(plan, joint=joint, reference=reference, tau=None, stops=None)


def plan_stops(
    problem: TransportProblem, motion: JointMotion, every: float = EVERY, progress: Progress | None = None
) -> StopLibrary:
    """Stops along a motion that the problem's constraints allow.

    Found backwards in time: from an instant, going on to the next one and stopping as there is a stop already, and so
    a place to begin. Instants whose own stop is no sooner at rest than that are left out.
    progress: called with how many of how many instants are done.
    Raises SalverError when the motion has no stop because it begins or ends moving.
    """
    problem.check_from_rest("a stop")
    if np.abs(motion.dq[[0, -1]]).max() > 1e-6:
        raise SalverError("Stops are planned along motions from rest to rest; this one begins or ends moving.")
    end = motion.duration
    instants = np.arange(every, end - 0.5 * every, every)
    state = _states(problem, motion)
    kept: list[tuple[float, JointMotion]] = []
    ahead = JointMotion(*(np.asarray(x)[-1:] for x in (motion.t, motion.q, motion.dq, motion.ddq)))
    rest, begin = end, end  # when what is ahead is at rest, and where it leaves the plan
    for done, now in enumerate(instants[::-1]):
        guess = _going_on(motion, float(now), begin, ahead)
        at = replace(problem, start=AtPosture(*(x[0] for x in motion.sample(now))), goal=Anywhere())
        found = _shortest(state(at, float(now)), guess, rest - float(now))
        if found is not None and float(now) + found.duration < rest - 1e-4:
            kept.append((float(now), found))
            ahead, rest, begin = found, float(now) + found.duration, float(now)
        if progress:
            progress(done + 1, len(instants))
    kept.reverse()
    shape = (len(kept), len(STORED), problem.n)
    q, dq, ddq = (np.array([getattr(stop, x) for _, stop in kept]).reshape(shape) for x in ("q", "dq", "ddq"))
    duration = np.array([stop.duration for _, stop in kept])
    return StopLibrary(np.array([now for now, _ in kept]), duration, STORED, q, dq, ddq, end)


def _states(problem: TransportProblem, motion: JointMotion) -> Callable[[TransportProblem, float], TransportProblem]:
    """Gives a problem the deviation that a wrong load has brought the arm into at an instant of the motion."""
    tracking = problem.tracking
    if tracking is None:
        return lambda at, now: at
    t = np.linspace(0.0, motion.duration, STATES)
    q, dq, ddq = motion.sample(t)
    z = np.stack([q, dq, ddq, motion.jerk(t)])
    along = problem.at(t / motion.duration, z, motion.duration)
    assert along.response is not None
    deviation = along.response

    def begun(at: TransportProblem, now: float) -> TransportProblem:
        return replace(at, tracking=tracking.begun(deviation.state_at(t, now)))

    return begun


def _going_on(motion: JointMotion, now: float, begin: float, ahead: JointMotion) -> JointMotion:
    """The plan from `now` to `begin`, and what is ahead there; from time 0."""
    between = np.unique(np.concatenate([[now], motion.t[(motion.t > now) & (motion.t < begin)]]))
    first = motion.sample(between)
    t = np.concatenate([between - now, begin - now + (ahead.t - ahead.t[0])])
    return JointMotion(t, *(np.vstack([a, b]) for a, b in zip(first, (ahead.q, ahead.dq, ahead.ddq), strict=True)))


def _shortest(problem: TransportProblem, guess: JointMotion, duration: float) -> JointMotion | None:
    """The shortest motion to rest from a guess, checked between the nodes; None when none was found."""
    begin = SplineMotion(SPLINE, _fitted(problem, guess, duration), duration)
    found = optimise(problem, FreeCurve, begin, NODES_PER_SPAN, damping=WARM)
    if not found.status.ok:
        return None
    z = FreeCurve(problem, Grid.of(SPLINE, STORED)).motion(found.coefficients, found.duration)
    return JointMotion(STORED * found.duration, *z[:3])


def _fitted(problem: TransportProblem, guess: JointMotion, duration: float) -> Array:
    """(size, n) coefficients of a motion near to a guess in posture and acceleration, with its ends."""
    assert isinstance(problem.start, AtPosture)
    s = np.linspace(0.0, 1.0, 121)
    q, _, ddq = guess.sample(s * guess.duration)
    powers = np.array([duration, duration**2])[:, None, None]
    launch = launch_basis(s)[:, :, :, None] * problem.start.rates[:, None, None, :]
    basis = SPLINE.matrices(s)
    q = q - (launch[:, 0] * powers).sum(axis=0)
    ddq = ddq * duration**2 - (launch[:, 2] * powers).sum(axis=0)
    ends = np.stack([q[0], q[-1]])
    rows = np.vstack([basis[0], SMOOTH * basis[2]])
    target = np.vstack([q, SMOOTH * ddq]) - rows[:, [0, -1]] @ ends
    inner = np.linalg.lstsq(rows[:, 1:-1], target, rcond=None)[0]
    return np.vstack([ends[:1], inner, ends[1:]])
