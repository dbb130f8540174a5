"""Fastest plans of several legs: each from rest to rest with its own load, joined in postures that are chosen."""

from __future__ import annotations

from typing import Any

import numpy as np

from salver.errors import ScenarioError, Status
from salver.geometry import quat_wxyz_from_matrix
from salver.planning.fastest.problem import transport_problem
from salver.planning.fastest.search import FastestOptions, plan_problem
from salver.planning.fastest.watch import WHY, Watch
from salver.planning.plan import Plan, begun_at
from salver.planning.round import Round, worst_of
from salver.scenario import Scenario


def plan_legs(scenario: Scenario, *, options: FastestOptions | None = None, watch: Watch | None = None) -> Round:
    """The fastest plan of a task of several legs that is safe over the whole uncertain set.

    Raises ScenarioError without an arm, legs, or with a duration, UnreachableError when a stop is out of reach.
    """
    if not scenario.legs:
        raise ScenarioError(f"{scenario.name} has one leg; plan it as such, or give it a list of [[legs]].")
    if scenario.motion.duration is not None:
        raise ScenarioError(
            f"{scenario.name}: motion.duration = {scenario.motion.duration:g} s with legs: what of it each leg takes "
            "is not planned yet; leave it out, for the fastest plan."
        )
    options = options or FastestOptions()
    watch = watch or Watch(options.time_limit)
    legs: list[Plan] = []
    for k, leg in enumerate(scenario.each_leg):
        posture: Any = None
        if legs:
            joint = legs[-1].joint
            assert joint is not None
            posture = joint.q[-1]
            if leg.motion.goal_yaw == "free":
                leg = _from_where(legs[-1], leg)
        problem = transport_problem(leg, start_posture=posture)
        part = watch.part(k / len(scenario.legs), 1 / len(scenario.legs))
        legs.append(plan_problem(problem, options=options, watch=part))
    exact = scenario.with_changes(contact__condition="exact")
    seconds = sum(float(leg.solver["seconds"]) for leg in legs)
    record = {"name": legs[0].solver["name"], "seconds": seconds, "robust": True}
    return Round(exact, tuple(legs), _status(legs, watch), record)


def _status(legs: list[Plan], watch: Watch) -> Status:
    worst = worst_of([leg.status for leg in legs])
    if not worst.ok:
        number = next(k for k, leg in enumerate(legs, 1) if leg.status is worst)
        return Status(worst.code, f"Leg {number}: {worst.sentence}", False, worst.details)
    each = ", ".join(f"{leg.duration:.4f} s" for leg in legs)
    ended = f" The search was ended by {WHY[watch.ended]} before it was done." if watch.ended else ""
    sentence = f"The shortest safe motions found take {sum(leg.duration for leg in legs):.4f} s ({each}).{ended}"
    return Status(watch.ended or "optimal", sentence, True)


def _from_where(before: Plan, leg: Scenario) -> Scenario:
    """The leg from the pose in which the one before it ends."""
    end = before.reference.sample(np.array([before.duration]))
    return begun_at(leg, end.p_SB[0], quat_wxyz_from_matrix(end.R_SB[0]))
