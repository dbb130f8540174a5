"""The fastest plan of a scenario: the motion, its verdict, and the constraints that prevent a shorter one."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from salver.errors import Status, UnreachableError
from salver.models.arm.arm_limits import LIMITS
from salver.planning.fastest.options import FastestOptions
from salver.planning.fastest.search import fastest
from salver.planning.fastest.speeds import at_every_speed
from salver.planning.follow.limits import LIMIT_EXCEEDED
from salver.planning.seeds.starts import Ends
from salver.planning.trajopt.bound import least_by_friction, least_duration
from salver.planning.trajopt.constraints.constraints import LEVEL_TOLERANCE, ContactConstraint
from salver.planning.trajopt.exchange import SHORTEST, reached
from salver.planning.trajopt.found import FastestMotion, object_motion
from salver.planning.trajopt.problem import TransportProblem, transport_problem, with_failing_cases
from salver.planning.trajopt.watch import Watch
from salver.planning.verdict.judged import PLANNED
from salver.planning.verdict.verify import verify
from salver.scenario import Scenario
from salver.trajectory import JointMotion, SampledReference
from salver.wording import listed

if TYPE_CHECKING:
    from salver.planning.plan import Plan

_AT_SPEED = re.compile(r"( at [\d.]+ % of full speed| standing still)?( while the speed changes)?$")


def plan_fastest(
    scenario: Scenario, *, robust: bool = True, options: FastestOptions | None = None, watch: Watch | None = None
) -> Plan:
    """The fastest plan of a scenario with an arm, under the exact contact condition, whatever the scenario's.

    scenario: with an arm. robust: safe for the whole uncertain set, including the arm's tracking error; else for
    nominal parameters only. options: of the search. watch: may end the search early, with the best motion so far.

    Returns:
        The plan; its status says so if no safe one was found.

    Raises:
        ScenarioError: the scenario has no arm.
    """
    return plan_problem(transport_problem(scenario, robust=robust), robust=robust, options=options, watch=watch)


def plan_problem(
    problem: TransportProblem,
    *,
    robust: bool = True,
    options: FastestOptions | None = None,
    watch: Watch | None = None,
    pair: Ends | None = None,
) -> Plan:
    """The plan of a problem, as `plan_fastest` makes it; pair: end postures between which the search begins."""
    found, plan = _found(problem, robust, options, watch, pair=pair)
    if not robust:
        return plan
    return at_every_speed(found, plan, lambda known: _found(known.problem, robust, options, watch, known))[1]


def _found(
    problem: TransportProblem,
    robust: bool,
    options: FastestOptions | None,
    watch: Watch | None,
    near: FastestMotion | None = None,
    pair: Ends | None = None,
) -> tuple[FastestMotion, Plan]:
    """The motion found and its plan. Limits of load dynamics are met at the speed factors that the problem lists."""
    scenario = problem.scenario
    found = fastest(problem, options, near, watch, pair)
    if not np.isfinite(found.duration):
        raise UnreachableError(f"{scenario.name}: {found.status.sentence}")
    plan = _planned(scenario, found, robust)
    for _ in range(4):  # each round adds what the plan's checks find violated; few motions need one
        sterner = _sterner(found, plan, robust) if found.status.ok else None
        if sterner is None:
            break
        again = fastest(sterner, options, near=found, watch=watch)
        if not again.status.ok:
            break
        found = again.after(found)
        plan = _planned(scenario, found, robust)

    def made(motion: FastestMotion) -> Plan:
        return _planned(scenario, motion, robust)

    found, plan = slow_enough(found, plan, made, robust)
    if found.status.ok and not plan.status.ok and (tight := tightened(found)) is not None:
        again = fastest(tight, options, near=found, watch=watch)
        if again.status.ok:
            again = replace(again.after(found), problem=replace(again.problem, limits=problem.limits))
            found, plan = slow_enough(again, made(again), made, robust)
    if robust and plan.status.ok and not plan.verification.ok:
        said = f"The motion found in {plan.duration:.4f} s fails the check of its plan: {plan.verification.sentence}"
        plan = replace(plan, status=Status("unsafe", said, False))
    return found, plan


def _sterner(found: FastestMotion, plan: Plan, robust: bool) -> TransportProblem | None:
    """A stricter problem for a motion that fails the checks of its plan: with load cases that it violates and that were
    not imposed, or else with nodes where it violates a constraint; or with contact for an arm that follows exactly, if
    the plan's own check fails. None if none of these applies."""
    problem = found.problem
    if not plan.status.ok:
        verdict = verify(problem, found.joint_motion(), None, PLANNED, thoroughly=True)
        assert verdict.judged is not None
        assert verdict.margins is not None
        along = verdict.judged.along
        motion = problem.at(along.s, along.z, along.duration, imposed=False)
        more = with_failing_cases(problem, motion.knowing(terms=along.terms, response=along.response))
        violated = np.convolve(verdict.margins.row > 0.0, np.ones(3), "same") > 0
        shares = verdict.judged.t[violated] / found.duration  # the instants may go on, after its end
        nodes = dict.fromkeys((*problem.nodes, *shares[shares < 1.0].tolist()))
        if more is None and len(nodes) == len(problem.nodes):  # all of these are imposed already
            return None
        return more or replace(problem, nodes=tuple(nodes))
    if (
        not robust
        or plan.verification.violation <= 0
        or any(isinstance(constraint, ContactConstraint) and constraint.exactly for constraint in problem.constraints)
    ):
        return None
    # The rows allow for the arm's tracking error; in quick turns the motion itself may violate the exact condition.
    exactly = tuple(ContactConstraint(rows, plan.scenario.contact.margin, exactly=True) for rows in problem.contacts)
    return replace(problem, extra=(*problem.extra, *exactly))


def tightened(found: FastestMotion, most: float = 0.01) -> TransportProblem | None:
    """The problem with the joint limit that a motion exceeds lowered by twice the excess, if that is at most a share
    `most` of the limit. Slowed down instead, a motion may exceed limits of load dynamics, since a liquid then peaks
    elsewhere. None if the motion exceeds no joint limit, or by more."""
    verdict = verify(found.problem, found.joint_motion(), None, PLANNED)
    exceeded = next((kind.key for kind in LIMITS[1:] if verdict.what.startswith(f"{kind.name} of ")), None)
    if exceeded is None or verdict.excess > most:
        return None
    return replace(found.problem, limits=found.problem.limits.scaled({exceeded: 1.0 - 2.0 * verdict.excess}))


def slow_enough(
    found: FastestMotion,
    plan: Plan,
    planned: Callable[[FastestMotion], Plan],
    robust: bool,
    shares: Sequence[float] = (1e-4, 1e-3, 4e-3, 1.6e-2),
) -> tuple[FastestMotion, Plan]:
    """The motion and its plan, slowed down by the smallest of these shares of its duration at which it passes the
    plan's check, which tests more instants than the optimiser. If no share is enough, both are unchanged."""
    if found.status.ok and not _passes(plan, robust):
        for share in shares:
            duration = found.duration * (1 + share)
            status = reached(SHORTEST.sought, duration) if found.status.code == "optimal" else found.status
            slower = replace(found, duration=duration, status=status)
            if _passes(made := planned(slower), robust):
                return slower, made
    return found, plan


def _passes(plan: Plan, robust: bool) -> bool:
    """Whether a plan's check finds no violation that a slower motion could remove."""
    keeps = plan.arm_status is None or plan.arm_status.code != LIMIT_EXCEEDED
    return keeps and plan.status.ok and (not robust or plan.verification.ok)


def _planned(scenario: Scenario, found: FastestMotion, robust: bool) -> Plan:
    """The plan of a motion, whose status names the constraints that prevent a shorter one."""
    problem, ends = found.problem, (found.coefficients[0], found.coefficients[-1])
    by_joints = least_duration(problem.limits, *ends)
    tilt = max(problem.max_tilt, np.sqrt(2) * LEVEL_TOLERANCE)  # about each of two axes
    by_friction = 0.0 if problem.moving else least_by_friction(problem.arm, problem.payload, tilt, *ends)
    bound, status = max(by_joints, by_friction), found.status
    if status.ok:
        what = "friction alone takes" if by_friction > by_joints else "the joints' limits alone take"
        status = replace(status, sentence=f"{status.sentence} {_held_by(found, bound, what)}".strip())
    record = {**solver_record(found, robust), "bound": bound}
    return judged(joint_plan(scenario, found.problem, found.joint_motion(), status, record), problem)


def judged(plan: Plan, problem: TransportProblem) -> Plan:
    """The plan, with status "unsafe" if its motion fails the verdict (`salver.planning.verdict.verify`)."""
    if not plan.status.ok:
        return plan
    assert plan.joint is not None
    found = verify(problem, plan.joint, None, PLANNED)
    if found.ok:
        return plan
    said = f"The motion found in {plan.duration:.4f} s fails its check: {found.sentence}."
    return replace(plan, status=Status("unsafe", said, False))


def _held_by(found: FastestMotion, bound: float, what: str) -> str:
    """Sentence on the constraints that prevent a shorter motion and on a lower bound of the duration, set by `what`."""
    held = f"What hinders a shorter one: {listed(each_kind(found.binding))}. " if found.binding else ""
    if bound == 0.0:  # nobody gave a limit that bounds it
        return held.strip()
    above = 100 * (found.duration / bound - 1)
    return (
        f"{held}Between its two end postures {what} {bound:.4f} s: it is at most {above:.1f} % "
        "above the shortest between these."
    )


def each_kind(names: tuple[str, ...]) -> list[str]:
    """Names of constraints without the speed factors at which they bind, each once."""
    kinds: dict[str, bool] = {}
    for name in names:
        kind = _AT_SPEED.sub("", name)
        kinds[kind] = kinds.get(kind, False) or kind != name
    return [f"{kind} (at other speeds too)" if slower else kind for kind, slower in kinds.items()]


def solver_record(found: FastestMotion, robust: bool) -> dict[str, Any]:
    """How a plan was found, as plan.json stores it."""
    return {
        "name": "sequential quadratic programming (PIQP)",
        "robust": robust,
        "seconds": found.wall_time,
        "iterations": found.iterations,
        "spans": found.spline.spans,
        "worst": found.worst,
        "binding": found.binding,
        **tracking_record(found),
    }


def joint_plan(
    scenario: Scenario,
    problem: TransportProblem,
    joint: JointMotion,
    status: Status,
    record: Mapping[str, Any],
    method: str = "fastest",
) -> Plan:
    """The plan of a joint motion, under the exact contact condition and with the verdict on the arm."""
    from salver.planning.follow.limits import torques, verdict
    from salver.planning.plan import Plan

    exact = scenario
    if scenario.contact.condition != "exact":
        exact = scenario.with_changes(contact__condition="exact")
    # Dense enough that quintics of the tray's motion know its acceleration to 1e-3 m/s^2.
    close = joint.resampled(0.02)
    reference = SampledReference(object_motion(problem, close.t, close.q, close.dq, close.ddq))
    parts = None if problem.keep_out is None else problem.keep_out.parts
    plan = Plan(exact, method, reference, status, joint, verdict(problem.arm, joint, problem.items, parts))
    if not problem.arm.weightless:
        tau = torques(problem.arm, JointMotion(plan.t, *joint.sample(plan.t)), problem.items)
        plan = replace(plan, tau=tau)
    return replace(plan, solver=record)


def tracking_record(found: FastestMotion) -> dict[str, float]:
    """Largest tracking error under the uncertain load and its inner dynamics: of the tray's position (m) and
    orientation (rad)."""
    problem = found.problem
    if problem.tracking is None:
        return {}
    s = np.linspace(0, 1, 101)
    z = np.stack(found.sample(s * found.duration))
    position, turn = problem.at(s, z, found.duration, imposed=False).tray_radius()
    return {"tray_position_radius": float(position.max()), "tray_orientation_radius": float(turn.max())}
