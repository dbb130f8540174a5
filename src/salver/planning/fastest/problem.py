"""The problem of the fastest safe transport: what moves, between which postures, under which conditions."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pinocchio as pin

from salver.errors import ScenarioError
from salver.geometry import Array
from salver.models.arm import ArmModel, load_arm, tray_to_object, with_load
from salver.models.arm_geometry import arm_geometry
from salver.models.arm_limits import JointLimits
from salver.models.bodies import Body
from salver.models.contact_rows import ContactRows, contact_rows
from salver.models.parameters import UncertainSet
from salver.planning.fastest.obstacles import KeepOut
from salver.planning.fastest.tracking import Tracking, tracking_of
from salver.scenario import Scenario

REACHED = 1e-10  # m, rad; of an end pose
START_TOLERANCE = 5e-3  # m, rad; a posture written with few digits is put right
LEVEL_TOLERANCE = 1e-3  # rad; what "level" means to the planner; contact is judged on the true motion


@dataclass(frozen=True)
class EndPose:
    """Where the first object must be at one end. yaw_free: any turn about its own vertical will do."""

    p_SB: Array
    R_SB: Array
    yaw_free: bool


@dataclass(frozen=True, eq=False)
class TransportProblem:
    """Everything the optimiser needs.

    arm: the arm with its tray. model: its Pinocchio model with all objects bolted on at nominal parameters.
    start_posture: (n,) or None when it is chosen. start, goal: pose of the first object.
    limits: the share of the arm's limits that may be used. max_tilt: rad from vertical; 0 means level.
    contacts: rows for each network of touching objects. uncertain: what is not known (empty for a nominal plan).
    tracking: what a wrong load does to the arm's tracking; None when no load is uncertain.
    keep_out: what must not touch: parts of the arm, tray, load, obstacles; None for nothing.
    """

    scenario: Scenario
    arm: ArmModel
    model: Any
    items: tuple[Body, ...]
    start_posture: Array | None
    start: EndPose
    goal: EndPose
    limits: JointLimits
    max_tilt: float
    contacts: tuple[ContactRows, ...]
    uncertain: UncertainSet
    tracking: Tracking | None
    keep_out: KeepOut | None

    @property
    def n(self) -> int:
        return self.arm.n

    @property
    def level(self) -> bool:
        return self.max_tilt == 0.0


def transport_problem(
    scenario: Scenario,
    *,
    level: bool | None = None,
    robust: bool = True,
    goal_yaw_free: bool | None = None,
    start_posture: Array | None = None,
    arm: ArmModel | None = None,
) -> TransportProblem:
    """The problem a scenario poses. Arguments that are given override the scenario.

    level: tray level all along (as motion.orientation says); otherwise it may tilt, up to motion.max_tilt_deg.
    robust: keep the contact for the whole uncertain set, or only for nominal parameters.
    Raises ScenarioError when the scenario has no arm, a start posture of the wrong length or of another pose, or an end
    that tilts the tray further than the motion may.
    """
    if scenario.arm is None:
        raise ScenarioError(
            f'{scenario.name}: a fastest plan needs an arm; add an [arm] table, for example model = "panda".'
        )
    arm = load_arm(scenario.arm, scenario.tray) if arm is None else arm
    payload = scenario.payload if robust else scenario.payload.nominal
    if level is None:
        level = not scenario.motion.may_turn
    tilt = scenario.motion.max_tilt_deg
    max_tilt = 0.0 if level else float(np.deg2rad(tilt)) if tilt is not None else np.inf
    for key, pose in (("start", scenario.motion.start), ("goal", scenario.motion.goal)):
        leans = float(np.arccos(np.clip(pose.rotation[2, 2], -1.0, 1.0)))
        if leans > max(max_tilt, LEVEL_TOLERANCE):
            raise ScenarioError(
                f"motion.{key} tilts the tray by {np.rad2deg(leans):.3g} deg, and the motion may tilt it by at most "
                f'{np.rad2deg(max_tilt):.3g} deg; give motion.orientation = "free" and a max_tilt_deg that allows it.'
            )
    given = scenario.arm.start_posture if start_posture is None else start_posture
    if given is not None and len(given) != arm.n:
        raise ScenarioError(f"arm.start_posture has {len(given)} values; {arm.name} has {arm.n} joints.")
    motion = scenario.motion
    yaw_free = motion.goal_yaw == "free" if goal_yaw_free is None else goal_yaw_free
    problem = TransportProblem(
        scenario=scenario,
        arm=arm,
        model=with_load(arm, payload.bodies).pin_model,
        items=payload.bodies,
        start_posture=None,
        start=EndPose(np.array(motion.start.position), motion.start.rotation, False),
        goal=EndPose(np.array(motion.goal.position), motion.goal.rotation, yaw_free),
        limits=arm.planning_limits,
        max_tilt=max_tilt,
        contacts=contact_rows(payload),
        uncertain=payload.uncertain,
        tracking=tracking_of(scenario, payload),
        keep_out=None,
    )
    if given is not None:
        problem = replace(problem, start_posture=_start_posture(problem, np.asarray(given, dtype=float)))
    parts = arm_geometry(arm, payload.bodies, scenario.obstacles)
    return replace(problem, keep_out=KeepOut.of(parts, problem.start_posture) if parts.pairs else None)


def _start_posture(problem: TransportProblem, given: Array) -> Array:
    """The given posture, moved to the start pose exactly; raises ScenarioError when it belongs to another pose."""
    error, _ = end_residual(problem, problem.start, given)
    q = reach(problem, problem.start, given)
    if q is None or np.abs(error).max() > START_TOLERANCE:
        raise ScenarioError(
            f"arm.start_posture puts the object {1e3 * np.linalg.norm(error[:3]):.1f} mm and "
            f"{np.rad2deg(np.linalg.norm(error[3:])):.2g} deg from motion.start; at most "
            f"{1e3 * START_TOLERANCE:g} mm and {np.rad2deg(START_TOLERANCE):.1g} deg are accepted: "
            "change one of them, or leave start_posture out."
        )
    return q


def end_residual(problem: TransportProblem, end: EndPose, q: Array) -> tuple[Array, Array]:
    """Pose error (6 or 5,) of the first object at q, and the Jacobian that a step dq should satisfy J dq = error."""
    body = problem.items[0]
    p_SE, R_SE = problem.arm.tray_pose(q)
    p_SB, R_SB = p_SE + R_SE @ body.p_EB, R_SE @ body.R_EB
    jacobian = tray_to_object(body.p_EB, body.R_EB) @ problem.arm.body_jacobian(q)
    turn = pin.log3(R_SB.T @ end.R_SB)
    if end.yaw_free:
        up = R_SB.T @ end.R_SB[:, 2]
        turn = np.array([-up[1], up[0], 0.0])
    rows = 5 if end.yaw_free else 6
    error = np.concatenate([end.p_SB - p_SB, turn])[:rows]
    return error, np.vstack([R_SB @ jacobian[:3], jacobian[3:]])[:rows]


def reach(problem: TransportProblem, end: EndPose, q: Array, iterations: int = 60) -> Array | None:
    """Posture nearest to q (Newton's method on the pose) that reaches an end within limits; None if it does not."""
    low, high = problem.limits.q_min + 0.01, problem.limits.q_max - 0.01
    for _ in range(iterations):
        error, jacobian = end_residual(problem, end, q)
        size = np.abs(error).max()
        if size < REACHED:
            return q
        damping = 1e-3 * min(1.0, size**2) * np.eye(len(error))
        step = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + damping, error)
        stuck = ((q <= low) & (step < 0)) | ((q >= high) & (step > 0))
        if stuck.any():  # the others do its share
            jacobian = jacobian * ~stuck
            step = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + damping, error)
        q = np.clip(q + step * min(1.0, 0.4 / max(float(np.abs(step).max()), 1e-12)), low, high)
    return q if np.abs(end_residual(problem, end, q)[0]).max() < REACHED else None
