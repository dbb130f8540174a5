"""The transport problem: arm and load, the ends of the motion, and the constraints.

    minimise    T, or another objective, over joint motions q(t), 0 <= t <= T
    subject to  start(q(0)) = 0, goal(q(T)) = 0, dq = ddq = 0 at both ends           (a start may be moving)
                q, dq, ddq, dddq, tau and dtau/dt within the arm's limits
                c(p) . (w + dw(p)) + margin <= 0 for every p in the uncertain set     (contact, at every speed named)
                e_z . R_SE e_z >= cos(max_tilt),   distance(pair) >= required,   limits of load dynamics

w(q, dq, ddq) is the tray's motion regressor, dw(p) its change by the arm's deviation under a parameter error p; both
that deviation and the load dynamics' modal states follow from the motion (`evaluation`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from salver.dynamics.load_cases import VERDICT_APART, LoadCase, load_cases
from salver.dynamics.load_response import slacks
from salver.dynamics.modal_history import CaseGroups, Past
from salver.errors import ScenarioError
from salver.geometry import Array, Indices, lean
from salver.models.arm.arm import ArmModel, load_arm, with_load
from salver.models.arm.arm_geometry import arm_geometry
from salver.models.arm.arm_limits import JointLimits
from salver.models.bodies import Body
from salver.models.contact_rows import ContactRows, contact_rows
from salver.models.payload import Payload
from salver.models.tray_motion import FULL_SPEED, Speed, corners
from salver.models.uncertain.parameters import UncertainSet
from salver.planning.postures import PoseTarget
from salver.planning.postures import start_posture as corrected_posture
from salver.planning.trajopt.constraints.constraints import (
    FINEST,
    LEVEL_TOLERANCE,
    Clearance,
    Constraint,
    ContactConstraint,
    Driving,
    JointLimit,
    LevelConstraint,
    TiltConstraint,
    TorqueLimit,
    TorqueRateLimit,
    evaluate,
    worst_of,
)
from salver.planning.trajopt.constraints.load_limits import AtRest, LoadConstraint
from salver.planning.trajopt.constraints.obstacles import KeepOut
from salver.planning.trajopt.constraints.via_poses import PassPose
from salver.planning.trajopt.ends import AtPose, AtPosture, End
from salver.planning.trajopt.evaluation import MotionEvaluation
from salver.scenario import Motion, Scenario
from salver.sensitivity.arm.compliance import LoadResponses
from salver.sensitivity.arm.tracking import JointLoop, joint_loop


@dataclass(frozen=True, eq=False)
class TransportProblem:
    """A transport problem as the optimiser needs it.

    arm: the arm with its tray. model: its Pinocchio model with all objects fixed to the tray at nominal parameters.
    payload: the carried objects with their uncertainty. start, goal: ends of the motion
    (`salver.planning.trajopt.ends`). limits: the part of the arm's limits that may be used. max_tilt: of the tray from
    level, rad; 0 means level. contacts: contact rows of each network of touching objects. uncertain: the uncertain set,
    empty for a nominal plan. tracking: closed loop that determines the tracking error under parameter errors and the
    zero-order hold; None for a nominal plan and for an arm without masses. keep_out: pairs of arm, tray, load and
    obstacles that must not collide; None for no check. speeds: speed factors at which contact must hold. extra:
    additional constraints. cases: representative cases of each load's dynamics; every_case: all that a verdict checks;
    past: their initial states where the motion begins moving. through: via poses. nodes: additional nodes, as shares of
    the duration. at_rest: whether contact and load dynamics are constrained in the rest after the motion too; stops and
    live motions are planned without, in half the time, but judged with it."""

    scenario: Scenario
    arm: ArmModel
    model: Any
    payload: Payload
    start: End
    goal: End
    limits: JointLimits
    max_tilt: float
    contacts: tuple[ContactRows, ...]
    uncertain: UncertainSet
    tracking: JointLoop | None
    keep_out: KeepOut | None
    speeds: tuple[Speed, ...] = (FULL_SPEED,)
    extra: tuple[Constraint, ...] = ()
    cases: CaseGroups = ()
    every_case: CaseGroups = ()
    past: Past | None = None
    through: tuple[AtPose, ...] = ()
    nodes: tuple[float, ...] = ()
    at_rest: bool = True

    @property
    def items(self) -> tuple[Body, ...]:
        return self.payload.bodies

    @property
    def n(self) -> int:
        return self.arm.n

    @property
    def level(self) -> bool:
        return self.max_tilt == 0.0

    def roughly(self, dynamic: bool) -> TransportProblem:
        """The problem of rough optima, with obstacles without the tracking error, since many starts are tried.

        dynamic: with load dynamics, of an arm that follows exactly and without the rest after the motion; they cost
        most and mostly change the path little.
        """
        cases, exactly = self.cases if dynamic else (), dynamic or self.scenario.obstacles
        return replace(self, cases=cases, at_rest=False, tracking=None if exactly else self.tracking)

    @property
    def start_posture(self) -> Array | None:
        """Start posture (n,), or None when it is chosen."""
        return self.start.q if isinstance(self.start, AtPosture) else None

    @property
    def moving(self) -> bool:
        """Whether the motion begins moving."""
        return isinstance(self.start, AtPosture) and self.start.moving

    def check_still(self, what: str) -> None:
        """Raise ScenarioError with load dynamics, which `what` (in words) does not support."""
        for body in self.payload.dynamic:
            raise ScenarioError(
                f"{self.scenario.name}: {what} is not planned with {body.inside} unless it is known how it moves "
                "just then; salver.Live knows, and salver plan --stops."
            )

    @cached_property
    def constraints(self) -> tuple[Constraint, ...]:
        """All constraints along the motion."""
        limits = self.limits
        found: list[Constraint] = [JointLimit(limits), TorqueLimit(limits), TorqueRateLimit(limits)]
        margin = self.scenario.contact.margin
        found += [ContactConstraint(rows, margin, speed) for rows in self.contacts for speed in self.speeds]
        if np.isfinite(self.max_tilt):
            found.append(LevelConstraint() if self.level else TiltConstraint(self.max_tilt))
        if self.moving and self.past is None:
            self.check_still("a motion that begins moving")
        moving = [speed for speed in self.speeds if speed.factor]
        found += [LoadConstraint(each[0].body, speed) for each in self.cases for speed in moving]
        swinging = (c for c in found if isinstance(c, LoadConstraint | ContactConstraint) and c.speed.factor)
        found += [AtRest(constraint) for constraint in swinging] if self.cases and self.at_rest else []
        found += [PassPose(self.arm, end.target, f"pose {k} to pass") for k, end in enumerate(self.through, 1)]
        if self.keep_out is not None:
            found.append(Clearance(self.keep_out))
        if self.arm.base is not None:
            found.append(Driving(self.arm, limits))
        return (*found, *self.extra)

    def at(
        self, s: Array, z: Array, duration: float, nodes: Indices | None = None, imposed: bool = True
    ) -> MotionEvaluation:
        """Evaluation of a motion z (4, P, n) of this arm and load at points s (P,) in [0, 1] of its duration."""
        nodes = np.arange(len(s)) if nodes is None else nodes
        arm = self.model, self.arm.tray_id, self.tracking
        motion = MotionEvaluation(*arm, s, duration, z, nodes, imposed, self.moving, self.cases, self.past)
        settling = 0.0 if self.tracking is None else self.tracking.settling
        return replace(motion, resting=max(self.payload.slowest_period, settling)) if self.cases else motion


def with_missed_cases(
    problem: TransportProblem, motion: MotionEvaluation, margin: float = 0.0
) -> TransportProblem | None:
    """The problem with the cases added in which a load's dynamics come closer to their limits than a margin, a share of
    their room; None if there are none."""
    if not problem.cases:
        return None
    t, whole = motion.s[motion.nodes] * motion.duration, problem.every_case
    missing = tuple(_others(known, every) for known, every in zip(problem.cases, whole, strict=True))
    responses, found = LoadResponses.of(missing, t, motion.terms.w, motion.response, motion.past).each, []
    for known, others in zip(problem.cases, missing, strict=True):
        parts = responses.get(known[0].body.name, ())
        left = np.min([np.ones(len(others)), *(slacks(part).min(axis=1) for part in parts)], axis=0)
        found.append((*known, *(others[k] for k in np.flatnonzero(left < FINEST + margin))))
    return replace(problem, cases=tuple(found)) if found != list(problem.cases) else None


def with_failing_cases(problem: TransportProblem, motion: MotionEvaluation) -> TransportProblem | None:
    """The problem with the cases added that violate a constraint when each alone replaces the cases of its load; None
    if there are none."""
    constraints = [c for c in problem.constraints if isinstance(c, ContactConstraint | LoadConstraint | AtRest)]
    motion, found = motion.knowing(terms=motion.terms, response=motion.response), []
    for k, (known, every) in enumerate(zip(problem.cases, problem.every_case, strict=True)):

        def fails(case: LoadCase, k: int = k) -> bool:
            cases = (*problem.cases[:k], (case,), *problem.cases[k + 1 :])
            return worst_of(evaluate(constraints, replace(motion, cases=cases), margins=False))[0] > 0.0

        found.append((*known, *filter(fails, _others(known, every))))
    return replace(problem, cases=tuple(found)) if found != list(problem.cases) else None


def _others(known: tuple[LoadCase, ...], more: tuple[LoadCase, ...]) -> tuple[LoadCase, ...]:
    """The cases among `more` that are not in `known`."""
    here = {case.name for case in known}
    return tuple(case for case in more if case.name not in here)


def _tracking(scenario: Scenario, payload: Payload) -> JointLoop | None:
    """The closed loop whose tracking error a robust plan includes; friction uncertainty has no effect on it."""
    return joint_loop(scenario, payload.with_only([p for p in payload.uncertain.parameters if p.loads]))


def transport_problem(
    scenario: Scenario,
    *,
    level: bool | None = None,
    robust: bool = True,
    extra: Sequence[Constraint] = (),
    passing: bool = False,
) -> TransportProblem:
    """The transport problem of a scenario.

    level: whether the tray stays level or may tilt up to motion.max_tilt_deg; default: as motion.orientation says.
    robust: keep contact for the whole uncertain set, or only for nominal parameters. extra: additional constraints.
    passing: whether the caller supports motion.through.
    Raises ScenarioError: no arm, a start posture of wrong length or for another pose, or an end that tilts the tray
    more than the motion may.
    """
    if scenario.arm is None:
        raise ScenarioError(f'{scenario.name}: this needs an arm; add an [arm] table, for example model = "panda".')
    if not passing:
        scenario.check_one_leg("this plan")
    arm = load_arm(scenario.arm, scenario.tray)
    payload = scenario.payload if robust else scenario.payload.nominal
    if level is None:
        level = not scenario.motion.may_turn
    tilt = scenario.motion.max_tilt_deg
    max_tilt = 0.0 if level else float(np.deg2rad(tilt)) if tilt is not None else np.inf
    motion, first = scenario.motion, payload.bodies[0]
    _level_enough(motion, max_tilt)
    yaw_free = motion.goal_yaw == "free"
    at_start, free = np.array(motion.start.position), motion.start_yaw == "free"
    begin = PoseTarget(at_start, motion.start.rotation, first.p_EB, first.R_EB, free)
    end = PoseTarget(np.array(motion.goal.position), motion.goal.rotation, first.p_EB, first.R_EB, yaw_free)
    start: End = AtPose(begin)
    if scenario.arm.start_posture is not None:
        start = AtPosture(corrected_posture(arm, scenario.arm.start_posture, begin, first.name))
    parts = arm_geometry(arm, payload.bodies, scenario.around)
    cases = tuple(load_cases(body, payload.uncertain) for body in payload.dynamic)
    more = (load_cases(body, payload.uncertain, VERDICT_APART) for body in payload.dynamic)
    return TransportProblem(
        scenario=scenario,
        arm=arm,
        model=with_load(arm, payload.bodies).pin_model,
        payload=payload,
        start=start,
        goal=AtPose(end),
        limits=arm.planning_limits,
        max_tilt=max_tilt,
        contacts=contact_rows(payload),
        uncertain=payload.uncertain,
        tracking=_tracking(scenario, payload) if robust and not arm.weightless else None,
        keep_out=KeepOut.of(parts, start.q[None] if isinstance(start, AtPosture) else None) if parts.pairs else None,
        speeds=(FULL_SPEED,) if cases else corners(motion.speeds, motion.speed_rate),
        extra=tuple(extra),
        cases=cases,
        every_case=tuple((*known, *_others(known, every)) for known, every in zip(cases, more, strict=True)),
        through=tuple(
            AtPose(PoseTarget(np.array(pose.position), pose.rotation, first.p_EB, first.R_EB, yaw_free))
            for pose in scenario.motion.through
        ),
    )


def _level_enough(motion: Motion, max_tilt: float) -> None:
    """Raise ScenarioError for a pose that tilts the tray by more than max_tilt, rad."""
    on_the_way = [(f"through[{k}]", pose) for k, pose in enumerate(motion.through)]
    for key, pose in (("start", motion.start), *on_the_way, ("goal", motion.goal)):
        leans = float(lean(pose.rotation))
        if leans > max(max_tilt, np.sqrt(2) * LEVEL_TOLERANCE):  # the tolerance holds about each of two axes
            raise ScenarioError(
                f"motion.{key} tilts the tray by {np.rad2deg(leans):.3g} deg, and the motion may tilt it by at most "
                f'{np.rad2deg(max_tilt):.3g} deg; give motion.orientation = "free" and a max_tilt_deg that allows it.'
            )
