"""The safest motion in a given duration: the one with the largest worst-case contact margin.

With several legs the duration is divided such that the least margin of all legs is largest: `plan_safest_legs`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from salver.errors import ScenarioError, Status, UnreachableError
from salver.geometry import Array
from salver.planning.fastest.found import FastestMotion, FastestOptions
from salver.planning.fastest.legs import plan_legs
from salver.planning.fastest.optimum import DEGREE, nearby
from salver.planning.fastest.planned import joint_plan, judged, solver_record
from salver.planning.fastest.search import fastest
from salver.planning.fastest.speeds import at_every_speed
from salver.planning.round import MultiLegPlan
from salver.planning.seeds.starts import Ends, between, straight
from salver.planning.trajopt.constraints.constraints import ContactConstraint
from salver.planning.trajopt.ends import AtPosture
from salver.planning.trajopt.objectives import LeastMargin, Objective
from salver.planning.trajopt.problem import transport_problem
from salver.planning.trajopt.spline import RestSpline
from salver.planning.trajopt.watch import Watch
from salver.scenario import Scenario

if TYPE_CHECKING:
    from salver.planning.plan import Plan


def plan_safest(
    scenario: Scenario, *, robust: bool = True, options: FastestOptions | None = None, watch: Watch | None = None
) -> Plan:
    """The plan with the largest margin of all contacts, and of the limits of load dynamics, in the scenario's duration.

    The margin is that of the worst parameters in the uncertain set, or of nominal ones unless `robust`. The arm's
    limits are met, obstacles are avoided, and the tray may tilt unless motion.orientation is "fixed". The result is the
    better of the local optima found from the slowed-down fastest motion and from the straight path between its ends.
    Raises ScenarioError without an arm or a duration, UnreachableError when no safe motion in this duration was found.
    """
    options = options or FastestOptions()
    watch = watch or Watch(options.time_limit)
    quickest, duration = quickest_within(scenario, "safest", robust, options, watch)
    problem = quickest.problem
    objective = LeastMargin()
    found = optima(objective, quickest, duration, options, watch)

    def planned(best: FastestMotion) -> tuple[FastestMotion, Plan]:
        status = best.status
        if status.ok:
            ended = " The search was ended before it was done." if watch.ended else ""
            kept = _kept(best.margin, scenario, bool(problem.cases))
            sentence = (
                f"The safest motion found in {duration:.4g} s keeps {kept}; the shortest found takes "
                f"{quickest.duration:.4f} s.{ended}"
            )
            status = Status(watch.ended or "optimal", sentence, True)
        record = {**solver_record(best, robust), "margin": best.margin, "shortest": quickest.duration}
        plan = joint_plan(scenario, problem, best.joint_motion(), status, record, method="safest")
        return best, judged(plan, best.problem)

    def again(known: FastestMotion) -> tuple[FastestMotion, Plan]:
        return planned(nearby(known, objective, duration, options, watch=watch).after(known))

    best = max(found, key=lambda motion: (motion.status.ok, motion.margin))
    best = best.after(quickest, *(motion for motion in found if motion is not best))
    return at_every_speed(*planned(best), again)[1] if robust else planned(best)[1]


def _kept(margin: float, scenario: Scenario, inner: bool) -> str:
    inside = f", and what moves inside {100 * margin:.2g} % of its room below its limits" if inner else ""
    return f"every contact {100 * (margin + scenario.contact.margin):.2g} % of the weight from its edge{inside}"


def quickest_within(
    scenario: Scenario, sought: str, robust: bool, options: FastestOptions, watch: Watch
) -> tuple[FastestMotion, float]:
    """The fastest motion, from which a search in the scenario's duration begins, and that duration, s.

    Raises ScenarioError without a duration, UnreachableError when no motion is found or it takes longer.
    """
    duration = scenario.motion.duration
    if duration is None:
        raise ScenarioError(f"{scenario.name}: motion.duration is missing; the {sought} plan is of a given one.")
    problem = transport_problem(scenario, level=scenario.motion.orientation == "fixed", robust=robust)
    quickest = fastest(problem, options, watch=watch)
    if not quickest.status.ok:
        raise UnreachableError(f"{scenario.name}: {quickest.status.sentence}")
    if quickest.duration > duration:
        raise UnreachableError(
            f"{scenario.name}: no safe motion in {duration:g} s was found; the shortest one that was found takes "
            f"{quickest.duration:.4f} s."
        )
    return quickest, duration


def optima(
    objective: Objective,
    quickest: FastestMotion,
    duration: float,
    options: FastestOptions,
    watch: Watch,
    anew: bool = True,
) -> list[FastestMotion]:
    """Local optima of an objective in a duration, s: from the slowed-down fastest motion and, with `anew`, from the
    straight path between its ends."""
    pair = Ends(quickest.coefficients[0], quickest.coefficients[-1], 0.0, True)
    begins = [None, straight(pair)] if anew else [None]
    return [
        nearby(quickest, objective, duration, options, begin=begin, watch=watch)
        for k, begin in enumerate(begins)
        if k == 0 or not watch.ended
    ]


def plan_safest_legs(
    scenario: Scenario, *, options: FastestOptions | None = None, watch: Watch | None = None
) -> MultiLegPlan:
    """The plan of several legs with the largest margin of all contacts, whose motions together take the scenario's
    duration. The postures at the stops are those of the fastest plan.

    Raises:
        ScenarioError: the scenario has no arm, no legs or no duration.
        UnreachableError: no safe motions in this duration were found.
    """
    duration = scenario.motion.duration
    if duration is None:
        raise ScenarioError(f"{scenario.name}: motion.duration is missing; the safest plan is of a given one.")
    options = options or FastestOptions()
    watch = watch or Watch(options.time_limit)
    quickest = plan_legs(scenario.with_changes(motion__duration=None), options=options, watch=watch)
    if not quickest.ok:
        raise UnreachableError(f"{scenario.name}: {quickest.status.sentence}")
    if quickest.duration > duration:
        raise UnreachableError(
            f"{scenario.name}: no safe motions in {duration:g} s were found; the shortest that were take "
            f"{quickest.duration:.4f} s."
        )
    best, seconds = _in_shares(quickest, duration, options, watch)
    legs = tuple(
        _planned(leg, motion, f"The safest motion found in {motion.duration:.4g} s.")
        for leg, motion in zip(quickest.legs, best, strict=True)
    )
    ended = " The search was ended before it was done." if watch.ended else ""
    kept = _kept(_least(best)[1], scenario, any(leg.payload.dynamic for leg in scenario.each_leg))
    sentence = (
        f"The safest motions found in {duration:.4g} s ({', '.join(f'{m.duration:.4g} s' for m in best)}) keep {kept}; "
        f"the shortest found take {quickest.duration:.4f} s.{ended}"
    )
    worst = next((motion.status for motion in best if not motion.status.ok), None)
    status = worst or Status(watch.ended or "optimal", sentence, True)
    spent = float(quickest.solver["seconds"]) + seconds
    record = {"name": quickest.solver["name"], "seconds": spent, "robust": True, "shortest": quickest.duration}
    return MultiLegPlan(scenario.with_changes(contact__condition="exact"), legs, status, record)


def _in_shares(
    quickest: MultiLegPlan, duration: float, options: FastestOptions, watch: Watch
) -> tuple[list[FastestMotion], float]:
    """The safest motions of the legs in a total duration, s, and the time, s, that the searches took.

    The duration is divided again after each search by the margins found; the division with the largest least margin
    wins.
    """
    begins = [_as_found(leg, options) for leg in quickest.legs]
    times = np.array([leg.duration for leg in quickest.legs]) * (duration / quickest.duration)
    at_rest = np.array([_margin_at_rest(begin) for begin in begins])
    best: list[FastestMotion] = []
    # The margin falls with a power of the speed: the fifth is a first guess, as the tray leans into its acceleration.
    before, power, seconds = (times, at_rest), 5.0, 0.0
    for sharing in range(3):  # with the power guessed, then estimated twice
        found = [
            max(
                optima(LeastMargin(), begin, float(time), options, watch, anew=not sharing),
                key=lambda m: (m.status.ok, m.margin),
            )
            for begin, time in zip(begins, times, strict=True)
        ]
        seconds += sum(motion.wall_time for motion in found)
        if not best or _least(found) > _least(best):
            best = found
        if watch.ended:
            break
        margins = np.array([motion.margin for motion in found])
        lacking = np.log(np.maximum(at_rest - margins, 1e-6) / np.maximum(at_rest - before[1], 1e-6))
        paces = np.log(before[0] / times)
        if np.abs(paces).max() > 1e-3:
            power = float(np.clip(lacking @ paces / (paces @ paces), 2.0, 8.0))
        before = times, margins
        begins, times = found, shared(times, at_rest, margins, power)
    return best, seconds


def shared(times: Array, at_rest: Array, margins: Array, power: float) -> Array:
    """Durations (K,), s, of the same sum with which all legs would have equal margins, if the loss of margin against
    rest grows with a power of the speed.

    times: (K,) durations, s. at_rest: (K,) margins at rest. margins: (K,) margins with these durations. power: of the
    speed.
    """
    lacking = np.maximum(at_rest - margins, 1e-6)
    low, high = float(margins.min()), float(at_rest.min())
    for _ in range(60):
        middle = 0.5 * (low + high)
        needed = times * (lacking / np.maximum(at_rest - middle, 1e-12)) ** (1 / power)
        low, high = (middle, high) if needed.sum() <= times.sum() else (low, middle)
    needed = times * (lacking / (at_rest - low)) ** (1 / power)
    return np.asarray(needed * (times.sum() / needed.sum()))


def _least(found: list[FastestMotion]) -> tuple[bool, float]:
    return all(motion.status.ok for motion in found), min(motion.margin for motion in found)


def _as_found(leg: Plan, options: FastestOptions) -> FastestMotion:
    """The optimiser's result of a planned leg, with start and end posture fixed."""
    assert leg.joint is not None
    spline, s = RestSpline(DEGREE, options.spans), np.linspace(0, 1, 401)
    q = leg.joint.sample(s * leg.duration)[0]
    problem = transport_problem(leg.scenario, passing=True)
    problem = replace(problem, start=AtPosture(q[0]), goal=AtPosture(q[-1]))
    problem = between(problem, Ends(q[0], q[-1], 0.0, True))
    return FastestMotion(problem, spline, spline.fit(s, q), leg.duration, leg.status, {}, (), 0.0, 0)


def _margin_at_rest(found: FastestMotion) -> float:
    """The contact margin at rest at the ends of a motion."""
    s, least = np.linspace(0.0, 1.0, 9), np.inf
    contacts = [constraint for constraint in found.problem.constraints if isinstance(constraint, ContactConstraint)]
    for q in found.coefficients[[0, -1]]:
        z = np.zeros((4, len(s), len(q)))
        z[0] = q
        still = found.problem.at(s, z, 1.0, imposed=False)
        largest = max(float(block.values.max()) for constraint in contacts for block in constraint.blocks(still))
        least = min(least, -largest)
    return least


def _planned(leg: Plan, found: FastestMotion, said: str) -> Plan:
    status = replace(found.status, sentence=said) if found.status.ok else found.status
    record = {**solver_record(found, True), "margin": found.margin, "shortest": leg.duration}
    plan = joint_plan(leg.scenario, found.problem, found.joint_motion(), status, record, method="safest")
    return judged(plan, found.problem)
