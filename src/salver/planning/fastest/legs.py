"""Fastest plans of several legs: each from rest to rest with its own load, one after the other.

Each leg begins in the posture in which the one before it ended, and its end posture is free. A leg alone would choose
the branch of the inverse kinematics that is nearest to it, from which a later leg may have to turn the arm over, or
cannot go on. So the branches are chosen for all legs together first (`chains`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from salver.errors import ScenarioError, Status, UnreachableError
from salver.geometry import Array, quat_wxyz_from_matrix
from salver.planning.fastest.options import FastestOptions
from salver.planning.fastest.planned import plan_problem
from salver.planning.fastest.search import possible_ends
from salver.planning.plan import Plan
from salver.planning.plan_files import begun_at
from salver.planning.round import MultiLegPlan
from salver.planning.seeds.starts import Ends, ends
from salver.planning.trajopt.ends import AtPosture
from salver.planning.trajopt.found import object_motion
from salver.planning.trajopt.problem import TransportProblem, transport_problem
from salver.planning.trajopt.watch import WHY, Watch
from salver.scenario import Scenario


def plan_legs(scenario: Scenario, *, options: FastestOptions | None = None, watch: Watch | None = None) -> MultiLegPlan:
    """The fastest plan of several legs that is safe over the whole uncertain set.

    Raises:
        ScenarioError: the scenario has no arm, no legs, or a duration.
        UnreachableError: a stop is out of reach.
    """
    if not scenario.legs:
        raise ScenarioError(f"{scenario.name} has one leg; plan it as such, or give it a list of [[legs]].")
    if scenario.motion.duration is not None:
        raise ScenarioError(
            f"{scenario.name}: motion.duration = {scenario.motion.duration:g} s with legs; leave it out: legs are "
            "planned as fast as is safe, and the plan says at which lower speeds it may be run."
        )
    options = options or FastestOptions()
    watch = watch or Watch(options.time_limit)
    problems = [transport_problem(leg, passing=True) for leg in scenario.each_leg]
    later = [replace(after, start=before.goal) for before, after in pairwise(problems)]
    for problem in (problems[0], *later):  # known at once; planning the legs before may take minutes
        _, blocked = possible_ends(problem, options, np.random.default_rng(options.seed))
        if blocked is not None:
            raise UnreachableError(f"{problem.scenario.name}: {blocked.sentence}")
    legs: list[Plan] = []
    for chain in chains(problems, np.random.default_rng(options.seed))[: options.pairs]:
        found = in_turn(problems, chain, options, watch)
        legs = min(legs or found, found, key=_merit)
        if watch.over() or all(leg.ok for leg in legs):
            break
    exact = scenario.with_changes(contact__condition="exact")
    seconds = sum(float(leg.solver["seconds"]) for leg in legs)
    record = {"name": legs[0].solver["name"], "seconds": seconds, "robust": True}
    return MultiLegPlan(exact, tuple(legs), _status(legs, watch), record)


def chains(problems: Sequence[TransportProblem], rng: np.random.Generator) -> list[list[Array]]:
    """Candidate postures (N, n) of every leg, at its start, its via poses and its end; the most promising first.

    Raises UnreachableError when no posture reaches a stop.
    """
    beam = 6  # chains that are kept from leg to leg, from each of which three goal postures are tried
    stages = [replace(problem, goal=end) for problem in problems for end in (*problem.through, problem.goal)]
    found = [(pair.cost, [pair.start, pair.goal]) for pair in ends(stages[0], rng)]
    for k, stage in enumerate(stages):
        if k:
            found = [
                (cost + pair.cost, [*postures, pair.goal])
                for cost, postures in found
                for pair in ends(replace(stage, start=AtPosture(postures[-1])), rng)[:3]
            ]
        if not found:
            raise UnreachableError(
                f"{stage.scenario.name}: no posture within the joint limits reaches "
                f"{'what it leads to from where it begins' if k else 'its start and what it leads to'}."
            )
        found = sorted(found, key=lambda chain: chain[0])[:beam]
    ends_at = np.cumsum([0, *(len(problem.through) + 1 for problem in problems)])
    return [[np.stack(postures[a : b + 1]) for a, b in pairwise(ends_at)] for _, postures in found]


def in_turn(
    problems: Sequence[TransportProblem], chain: Sequence[Array], options: FastestOptions, watch: Watch
) -> list[Plan]:
    """Plans of the legs, each from the end posture of the one before it and with a first guess between the postures of
    a chain (`chains`)."""
    legs: list[Plan] = []
    for k, (problem, postures) in enumerate(zip(problems, chain, strict=True)):
        start = postures[0]
        if legs:
            start = _end_of(legs[-1])
            problem = _from(problem, start)
        watch.begin(k, len(problems))
        pair = Ends(start, postures[-1], 0.0, True)
        legs.append(plan_problem(problem, options=options, watch=watch, pair=pair))
    return legs


def _merit(legs: Sequence[Plan]) -> tuple[int, float]:
    """Sort key of a plan of several legs; smaller is better."""
    return sum(not leg.ok for leg in legs), sum(leg.duration for leg in legs)


def _end_of(plan: Plan) -> Array:
    assert plan.joint is not None
    return plan.joint.q[-1]


def _from(problem: TransportProblem, q: Array) -> TransportProblem:
    """The problem starting in the posture (n,), and with the heading, in which the leg before it ended."""
    scenario = problem.scenario
    if scenario.motion.goal_yaw == "free":
        samples = object_motion(problem, np.zeros(1), q[None], np.zeros((1, problem.n)), np.zeros((1, problem.n)))
        scenario = begun_at(scenario, samples.p_SB[0], quat_wxyz_from_matrix(samples.R_SB[0]))
    return replace(problem, scenario=scenario, start=AtPosture(q))


def _status(legs: Sequence[Plan], watch: Watch) -> Status:
    for number, leg in enumerate(legs, 1):
        follows = leg.arm_status or leg.status
        if not leg.ok:
            worst = leg.status if not leg.status.ok else follows
            return Status(worst.code, f"Leg {number}: {worst.sentence}", False, worst.details)
    each = ", ".join(f"{leg.duration:.4f} s" for leg in legs)
    ended = f" The search was ended by {WHY[watch.ended]} before it was done." if watch.ended else ""
    sentence = f"The shortest safe motions found take {sum(leg.duration for leg in legs):.4f} s ({each}).{ended}"
    return Status(watch.ended or "optimal", sentence, True)
