"""Plans by method: the paper's optimisation, the straight line it is compared with, and the arm that follows them."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from salver.errors import ScenarioError, Status
from salver.geometry import Array, quat_wxyz_from_matrix
from salver.planning.object.problem import Problem
from salver.planning.object.solvers import Solution, solve
from salver.planning.plan import FINER, Plan
from salver.planning.plan_files import begun_at
from salver.run_directory import STEMS
from salver.scenario import Scenario
from salver.trajectory import JointMotion, min_jerk_line
from salver.wording import listed

if TYPE_CHECKING:
    from salver.planning.fastest import FastestOptions
    from salver.planning.trajopt.watch import Watch

METHODS = ("robust", "baseline", "fastest", "safest", "least-sensitive")


def plan_object(scenario: Scenario) -> Plan:
    """The robust plan of the carried object alone, eqs (13) to (17).

    Condition (16) is imposed at the scenario's nodes; if it then fails between them, at all instants of the plan's
    check.
    """
    _check_object_motion(scenario)
    if scenario.payload.dynamic and scenario.motion.may_turn:
        raise ScenarioError(
            f"{scenario.name}: the robust plan of a given duration supports {scenario.payload.dynamic[0].inside} only "
            'on a tray that keeps its orientation; plan with --fastest, or give motion.orientation = "fixed".'
        )
    began, z = time.perf_counter(), None
    for nodes in (scenario.motion.nodes, FINER * (scenario.motion.nodes - 1) + 1):
        problem = Problem(scenario, nodes)
        solution = solve(problem, z)
        z, record = solution.z, _solver_record(solution, problem, time.perf_counter() - began)
        plan = Plan(scenario, "robust", problem.reference(z), solution.status, solver=record)
        if not plan.status.ok or plan.verification.violation == 0:
            return plan
    return replace(plan, status=Status("unsafe", f"No safe plan was found: {plan.verification.sentence}", False))


def plan_baseline(scenario: Scenario) -> Plan:
    """The paper's baseline: straight min-jerk line from start to goal, in the same duration."""
    motion = scenario.motion
    _check_object_motion(scenario)
    reference = min_jerk_line(
        float(motion.duration or 0),
        np.array(motion.start.position),
        np.array(motion.goal.position),
        motion.start.rotation,
        motion.goal.rotation,
    )
    plan = Plan(
        scenario, "baseline", reference, Status("evaluated", "The straight min-jerk line, not optimised.", True)
    )
    if plan.verification.violation > 0:
        sentence = f"The straight min-jerk line is not safe: {plan.verification.sentence}"
        return replace(plan, status=Status("unsafe", sentence, False))
    return plan


def plan_nominal(scenario: Scenario, *, options: FastestOptions | None = None, watch: Watch | None = None) -> Plan:
    """The fastest motion that is safe at nominal parameters, judged over the whole uncertain set.

    With a duration in the scenario, which then is that of the plan it is compared with, the scenario's own contact
    condition judges it.
    """
    from salver.planning.fastest import plan_fastest

    plan = plan_fastest(scenario.with_changes(motion__duration=None), robust=False, options=options, watch=watch)
    if scenario.motion.duration is not None:
        plan = replace(plan, scenario=scenario)
    if not plan.status.ok or plan.verification.violation == 0:
        return plan
    found = f"The shortest motion for nominal parameters takes {plan.duration:.4f} s"
    sentence = f"{found}; over the uncertain set it is not safe: {plan.verification.sentence}"
    return replace(plan, status=Status("unsafe", sentence, False))


def with_arm(plan: Plan, q_start: Array | None = None) -> Plan:
    """The plan with the joint motion that follows it, its torques, and the verdict on the arm. Needs an arm.

    q_start: start posture (n,), rad, instead of the scenario's or the best one, so that two plans can share it.
    """
    from salver.models.arm.arm import load_arm
    from salver.planning.follow.limits import torques
    from salver.planning.follow.motion import follow_scenario

    scenario = plan.scenario
    assert scenario.arm is not None
    arm = load_arm(scenario.arm, scenario.tray)
    joint, status = follow_scenario(scenario, plan.reference, arm, q_start)
    tau = None
    if joint is not None and not arm.weightless:
        tau = torques(arm, JointMotion(plan.t, *joint.sample(plan.t)), scenario.payload.bodies)
    return replace(plan, joint=joint, arm_status=status, tau=tau)


def method_of(scenario: Scenario, arm: bool = True) -> str:
    """The planning method of a scenario: its `plan.method`, or else "safest" with a duration, "fastest" without one,
    and "robust" without an arm."""
    if scenario.plan.method is not None:
        return scenario.plan.method
    if scenario.motion.duration is None:
        return "fastest"
    return "safest" if arm and scenario.arm is not None else "robust"


def plan_pair(
    scenario: Scenario,
    method: str | None = None,
    arm: bool = True,
    beside: str = "baseline",
    *,
    options: FastestOptions | None = None,
    watch: Watch | None = None,
) -> tuple[Plan, Plan]:
    """The requested plan and the plan that it is compared with.

    scenario: the task. method: as in `make_plan`. arm: whether to plan the arm's motion. beside: "baseline", the
    straight line with the same duration and start posture; or "nominal", the fastest motion at nominal parameters.
    options, watch: options and progress of the search for the fastest, safest and least sensitive motion.

    Raises:
        ScenarioError: the comparison is unknown or cannot be made.
    """
    if beside not in STEMS[1:]:
        raise ScenarioError(f'A plan can be compared with {" or ".join(STEMS[1:])}, not with "{beside}".')
    plan = make_plan(scenario, method, arm, options=options, watch=watch)
    if beside == "nominal":
        return plan, plan_nominal(plan.scenario, options=options, watch=watch)
    given = plan.scenario.motion.duration is not None
    timed = plan.scenario if given else plan.scenario.with_changes(motion__duration=plan.duration)
    if timed.motion.start_yaw == "free":
        begin = plan.reference.sample(np.zeros(1))
        timed = begun_at(timed, begin.p_SB[0], quat_wxyz_from_matrix(begin.R_SB[0]))
    baseline = replace(plan_baseline(timed), scenario=plan.scenario)
    if arm and scenario.arm is not None:
        baseline = with_arm(baseline, None if plan.joint is None else plan.joint.q[0])
    return plan, baseline


def make_plan(
    scenario: Scenario,
    method: str | None = None,
    arm: bool = True,
    *,
    options: FastestOptions | None = None,
    watch: Watch | None = None,
) -> Plan:
    """The plan of a scenario, with the arm's motion when it has an arm.

    scenario: the task. method: "robust", "baseline", "fastest", "safest" or "least-sensitive" (the last two in the
    scenario's duration); None for `method_of`. arm: whether to plan the arm's motion. options, watch: options and
    progress of the search for the last three.

    Raises:
        ScenarioError: the scenario lacks something that the method needs.
    """
    method = method or method_of(scenario, arm)
    scenario.check_one_leg(f"the {method} plan" if method in METHODS else "this")
    quickest = method == "fastest" or (method == "robust" and scenario.motion.duration is None)
    if quickest and scenario.motion.duration is None and scenario.arm is None:
        raise ScenarioError(
            f"{scenario.name}: motion.duration is missing, and the shortest that is safe is found with an arm only; "
            'give it in seconds, or add an [arm] table, for example model = "panda".'
        )
    if quickest:
        from salver.planning.fastest import plan_fastest

        return plan_fastest(scenario.with_changes(motion__duration=None), options=options, watch=watch)
    if method == "safest":
        from salver.planning.fastest.safest import plan_safest

        return plan_safest(scenario, options=options, watch=watch)
    if method == "least-sensitive":
        from salver.planning.fastest.sensitive import plan_least_sensitive

        return plan_least_sensitive(scenario, options=options, watch=watch)
    makers = {"robust": plan_object, "baseline": plan_baseline}
    if method not in makers:
        raise ScenarioError(f'There is no planning method "{method}"; there are {listed(METHODS)}.')
    plan = makers[method](scenario)
    return with_arm(plan) if arm and scenario.arm is not None and plan.status.code != "infeasible" else plan


def _check_object_motion(scenario: Scenario) -> None:
    scenario.check_one_leg("this plan")
    if scenario.motion.duration is None:
        raise ScenarioError(
            f"{scenario.name}: motion.duration is missing; give it in seconds, or ask for the fastest plan instead."
        )
    if scenario.motion.start_yaw == "free":
        raise ScenarioError(
            f'{scenario.name}: motion.start_yaw = "free" is for motions of an arm (fastest, safest, least-sensitive); '
            'this plan, of the object alone, needs "fixed", the heading of motion.start.'
        )


def _solver_record(solution: Solution, problem: Problem, seconds: float) -> dict[str, Any]:
    return {
        "name": solution.method,
        "cost": solution.cost,
        "lower_bound": solution.lower_bound,
        "relative_gap": solution.gap,
        "programmes": solution.iterations,
        "nodes": problem.nodes,
        "seconds": seconds,
    }
