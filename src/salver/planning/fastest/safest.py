"""The safest motion in a given time: the largest worst-case margin of all contacts, under the same constraints."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from salver.errors import ScenarioError, Status, UnreachableError
from salver.planning.fastest.objectives import LeastMargin
from salver.planning.fastest.problem import transport_problem
from salver.planning.fastest.search import FastestOptions, fastest, joint_plan, nearby, solver_record
from salver.planning.fastest.starts import Ends, straight, tray_line
from salver.planning.fastest.watch import Watch
from salver.scenario import Scenario

if TYPE_CHECKING:
    from salver.planning.plan import Plan


def plan_safest(
    scenario: Scenario, *, robust: bool = True, options: FastestOptions | None = None, watch: Watch | None = None
) -> Plan:
    """The plan that keeps the load furthest from slipping, tipping and lifting in the scenario's duration, at the worst
    parameters of the uncertain set, or at nominal ones; the arm's limits are kept and obstacles avoided, the tray may
    tilt unless motion.orientation is "fixed".

    It is the best of the local optima from the shortest motion, made slower, and from straight paths between its ends.
    Raises ScenarioError without an arm or a duration, UnreachableError when no motion was found that is as short.
    """
    duration = scenario.motion.duration
    if duration is None:
        raise ScenarioError(f"{scenario.name}: motion.duration is missing; the safest plan is of a given one.")
    options = options or FastestOptions()
    watch = watch or Watch(options.time_limit)
    problem = transport_problem(scenario, level=scenario.motion.orientation == "fixed", robust=robust)
    if problem.liquids:
        raise ScenarioError(f"{scenario.name}: the safest motion of a liquid cannot be planned; ask for the fastest.")
    quickest = fastest(problem, options, watch=watch)
    if not quickest.status.ok:
        raise UnreachableError(f"{scenario.name}: {quickest.status.sentence}")
    if quickest.duration > duration:
        raise UnreachableError(
            f"{scenario.name}: no safe motion in {duration:g} s was found; the shortest that was takes "
            f"{quickest.duration:.4f} s."
        )
    pair = Ends(quickest.coefficients[0], quickest.coefficients[-1], 0.0, True)
    begins = [None, straight(pair), tray_line(quickest.problem, pair)]
    found = [
        nearby(quickest, LeastMargin(), duration, options, begin=begin, watch=watch)
        for k, begin in enumerate(begins)
        if k == 0 or (begin is not None and not watch.ended)
    ]
    best = max(found, key=lambda motion: (motion.status.ok, motion.margin))
    status = best.status
    if status.ok:
        least = 100 * (best.margin + scenario.contact.margin)
        ended = " The search was ended before it was done." if watch.ended else ""
        sentence = (
            f"The safest motion found in {duration:.4g} s keeps every contact {least:.2g} % of the weight from its "
            f"edge; the shortest found takes {quickest.duration:.4f} s.{ended}"
        )
        status = Status(watch.ended or "optimal", sentence, True)
    spent, steps = (sum(getattr(motion, key) for motion in (quickest, *found)) for key in ("wall_time", "iterations"))
    best = replace(best, wall_time=spent, iterations=steps)
    record = {**solver_record(best, robust), "margin": best.margin, "shortest": quickest.duration}
    return joint_plan(scenario, problem, best.joint_motion(), status, record, method="safest")
