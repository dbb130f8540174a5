"""The best motion in a given duration, by any objective; and the safest one, with the largest worst-case margin."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from salver.errors import ScenarioError, Status, UnreachableError
from salver.planning.fastest.optimum import nearby
from salver.planning.fastest.options import FastestOptions
from salver.planning.fastest.planned import joint_plan, judged, solver_record
from salver.planning.fastest.search import fastest
from salver.planning.fastest.speeds import at_every_speed
from salver.planning.seeds.starts import Ends, straight
from salver.planning.trajopt.found import FastestMotion
from salver.planning.trajopt.objectives import LeastMargin, Objective
from salver.planning.trajopt.problem import transport_problem
from salver.planning.trajopt.watch import Watch
from salver.scenario import Scenario

if TYPE_CHECKING:
    from salver.planning.plan import Plan


def plan_safest(scenario: Scenario, *, options: FastestOptions | None = None, watch: Watch | None = None) -> Plan:
    """The plan with the largest margin of all contacts, and of the limits of load dynamics, in the scenario's duration.

    The margin is that of the worst parameters in the uncertain set. The arm's limits are met, obstacles are avoided,
    and the tray may tilt unless motion.orientation is "fixed".
    Raises ScenarioError without an arm or a duration, UnreachableError when no safe motion in this duration was found.
    """
    options = options or FastestOptions()
    watch = watch or Watch(options.time_limit)
    quickest, duration = quickest_within(scenario, "safest", options, watch)

    def told(best: FastestMotion) -> tuple[str, dict[str, Any]]:
        kept = f"every contact {100 * (best.margin + scenario.contact.margin):.2g} % of the weight from its edge"
        inside = f", and what moves inside {100 * best.margin:.2g} % of its room below its limits"
        kept += inside if quickest.problem.cases else ""
        return f"The safest motion found in {duration:.4g} s keeps {kept}", {"margin": best.margin}

    return plan_best(
        quickest, duration, LeastMargin(), lambda motion: -motion.margin, told, "safest", options=options, watch=watch
    )


def quickest_within(
    scenario: Scenario, sought: str, options: FastestOptions, watch: Watch
) -> tuple[FastestMotion, float]:
    """The fastest motion, from which a search in the scenario's duration begins, and that duration, s.

    Raises ScenarioError without a duration, UnreachableError when no motion is found or it takes longer.
    """
    duration = scenario.motion.duration
    if duration is None:
        raise ScenarioError(f"{scenario.name}: motion.duration is missing; the {sought} plan needs one.")
    quickest = fastest(transport_problem(scenario, level=scenario.motion.orientation == "fixed"), options, watch=watch)
    if not quickest.status.ok:
        raise UnreachableError(f"{scenario.name}: {quickest.status.sentence}")
    if quickest.duration > duration:
        raise UnreachableError(
            f"{scenario.name}: no safe motion in {duration:g} s was found; the shortest one that was found takes "
            f"{quickest.duration:.4f} s."
        )
    return quickest, duration


def plan_best(
    quickest: FastestMotion,
    duration: float,
    objective: Objective,
    cost: Callable[[FastestMotion], float],
    told: Callable[[FastestMotion], tuple[str, dict[str, Any]]],
    method: str,
    *,
    options: FastestOptions,
    watch: Watch,
) -> Plan:
    """The plan of the best local optimum of an objective in a duration, s.

    Args:
        quickest: the fastest motion (`quickest_within`).
        duration: s.
        objective: what the optima minimise.
        cost: cost of an optimum; the optimum with the least one is taken.
        told: returns the first half of the plan's sentence, and entries of its record.
        method: method of the plan, as it is recorded.
        options: options of the search.
        watch: may end the search early, with the best motion so far.
    """
    scenario = quickest.problem.scenario

    def planned(best: FastestMotion) -> tuple[FastestMotion, Plan]:
        (sentence, more), status = told(best), best.status
        if status.ok:
            ended = " The search was ended before it was done." if watch.ended else ""
            sentence = f"{sentence}; the shortest found takes {quickest.duration:.4f} s.{ended}"
            status = Status(watch.ended or "optimal", sentence, True)
        record = {**solver_record(best, True), **more, "shortest": quickest.duration}
        plan = joint_plan(scenario, quickest.problem, best.joint_motion(), status, record, method=method)
        return best, judged(plan, best.problem)

    def again(known: FastestMotion) -> tuple[FastestMotion, Plan]:
        return planned(nearby(known, objective, duration, options, watch=watch).after(known))

    found = optima(objective, quickest, duration, options, watch)
    best = min(found, key=lambda motion: (not motion.status.ok, cost(motion)))
    best = best.after(quickest, *(motion for motion in found if motion is not best))
    return at_every_speed(*planned(best), again)[1]


def optima(
    objective: Objective, quickest: FastestMotion, duration: float, options: FastestOptions, watch: Watch
) -> list[FastestMotion]:
    """Local optima of an objective in a duration, s: from the slowed-down fastest motion and from the straight path
    between its ends."""
    line = straight(Ends(quickest.coefficients[0], quickest.coefficients[-1], 0.0, True))
    found = [nearby(quickest, objective, duration, options, watch=watch)]
    if not watch.ended:
        found.append(nearby(quickest, objective, duration, options, begin=line, watch=watch))
    return found
