"""The fastest safe time law along a given path: joint waypoints, or the path of a plan.

Two stages. Without limits on jerk and torque rate, and for nominal parameters, every condition is linear in
x = (du/dt)^2 and its slope, and the time-optimal law is the largest x everywhere (Bobrow, Dubowsky, Gibson 1985;
as one linear programme: Verscheure et al. 2009; as reachability: Pham and Pham, TOPP-RA, 2018). That law starts
the second: a smooth time law with all conditions of `rows`, jerk, uncertain parameters and the arm's
tracking among them.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline
from scipy.optimize import linprog
from scipy.sparse import coo_matrix

from salver.errors import ScenarioError, Status, UnreachableError
from salver.geometry import Array, interpolated, quat_wxyz_from_matrix
from salver.planning.fastest.optimum import DEGREE
from salver.planning.fastest.planned import joint_plan, judged, slow_enough
from salver.planning.fastest.speeds import at_every_speed
from salver.planning.round import MultiLegPlan
from salver.planning.trajopt.constraints.constraints import evaluate, worst_of
from salver.planning.trajopt.constraints.obstacles import KeepOut
from salver.planning.trajopt.curves import Grid, PathCurve
from salver.planning.trajopt.exchange import optimise
from salver.planning.trajopt.found import CurveOf, FastestMotion
from salver.planning.trajopt.problem import TransportProblem, transport_problem
from salver.planning.trajopt.spline import RestSpline, SplineMotion
from salver.scenario import Scenario
from salver.sensitivity.arm.terms import motion_terms
from salver.trajectory import JointMotion, smooth_step

if TYPE_CHECKING:
    from salver.planning.plan import Plan

PATH_TOLERANCE = 1e-3  # rad: by how much the path may miss a waypoint; closer waypoints count as equal


@dataclass(frozen=True, eq=False)
class SplinePath:
    """A path q(u), with u in [0, 1] proportional to the length in joint space; four times continuously differentiable.

    missed: largest distance of a waypoint from the path, rad.
    """

    spline: BSpline
    missed: float = 0.0

    def derivatives(self, u: Array, order: int) -> Array:
        """q and its derivatives by u up to an order at u (N,), as (order + 1, N, n)."""
        u = np.clip(u, 0.0, 1.0)
        return np.stack([self.spline.derivative(k)(u) if k else self.spline(u) for k in range(order + 1)])

    @classmethod
    def through(cls, q: Array) -> SplinePath:
        """The path through waypoints (K, n), K >= 2.

        If there are very many, up to 480 of them are interpolated such that the others are met within `PATH_TOLERANCE`.
        Raises ScenarioError for fewer than two different ones.
        """
        q = _apart(np.asarray(q, dtype=float))
        if len(q) < 2:
            raise ScenarioError("A path needs at least two different waypoints.")
        length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(q, axis=0), axis=1))])
        for points in (60, 120, 240, 480):  # evenly along its length: as few as will do
            if len(q) <= points:
                break
            wanted = np.linspace(0.0, length[-1], points)
            path = cls(make_interp_spline(wanted / length[-1], make_interp_spline(length, q, 3)(wanted), DEGREE))
            path = replace(path, missed=float(np.abs(path.spline(length / length[-1]) - q).max()))
            if path.missed < PATH_TOLERANCE or points == 480:
                return path
        if len(q) <= DEGREE:  # too few for the degree: fill up along straight pieces
            wanted = np.unique(np.concatenate([length, np.linspace(0.0, length[-1], DEGREE + 3)]))
            q = interpolated(length, q, wanted)
            length = wanted
        return cls(make_interp_spline(length / length[-1], q, DEGREE))

    @classmethod
    def of(cls, motion: JointMotion) -> SplinePath:
        """The path of a motion, without its timing."""
        return cls.through(motion.sample(np.linspace(0.0, motion.duration, 2001))[0])


def _apart(q: Array) -> Array:
    """Waypoints (K, n) without those within `PATH_TOLERANCE` of the one before; the first and the last are kept."""
    kept = [0]
    for k in range(1, len(q)):
        if np.abs(q[k] - q[kept[-1]]).max() >= PATH_TOLERANCE:
            kept.append(k)
    if np.abs(q[-1] - q[kept[-1]]).max() > 1e-9:
        kept = [*(kept[:-1] if len(kept) > 1 else kept), len(q) - 1]
    return q[kept]


def retime(problem: TransportProblem, path: SplinePath, *, spans: int = 20, nodes_per_span: int = 4) -> FastestMotion:
    """The fastest safe time law along a path, as a motion whose coefficients (size, 1) are those of the law u(t). The
    problem's end poses and tilt limit are ignored: the path fixes both.

    Never raises for numerical reasons: see `status`.
    """
    begun = time.perf_counter()
    problem = replace(problem, max_tilt=np.inf, keep_out=None)
    law = RestSpline(DEGREE, spans)

    def curve_of(problem: TransportProblem, grid: Grid) -> PathCurve:
        return PathCurve(problem, grid, path)

    bound = reachable_law(problem, path)
    if bound is None:
        status = Status(
            "infeasible", "No timing of this path is safe: the load does not even stay in place at rest on it.", False
        )
        return FastestMotion(law, np.zeros((law.size, 1)), np.inf, problem, status, curve_of=curve_of)
    t, u = bound
    s = np.linspace(0.0, 1.0, 401)
    start = law.fit(s, np.interp(s, t / t[-1], u)[:, None])
    start = np.maximum.accumulate(np.clip(start, 0.0, 1.0), axis=0)
    calm = _calm(problem, curve_of, law, float(t[-1])) if problem.cases else None
    begin = SplineMotion(law, start, 1.5 * float(t[-1])) if calm is None else calm  # jerk asks for more
    found = optimise(problem, curve_of, begin, nodes_per_span)
    return replace(found, wall_time=time.perf_counter() - begun, lower_bound=float(t[-1]))


def _calm(problem: TransportProblem, curve_of: CurveOf, law: RestSpline, duration: float) -> SplineMotion | None:
    """A smooth time law of at least `duration` that meets all constraints, as the start of the search; None if none of
    those tried does. A start that excites a swinging load too much would lead to one of many poor local optima."""
    s = np.linspace(0.0, 1.0, 401)
    smooth = law.fit(s, smooth_step(s)[:, None])
    curve = curve_of(problem, Grid.of(law, np.linspace(0.0, 1.0, 81)))
    for longer in duration * 1.15 ** np.arange(15):  # up to seven times as long
        motion = problem.at(curve.grid.s, curve.motion(smooth, longer), longer, curve.grid.nodes)
        if worst_of(evaluate(problem.constraints, motion))[0] <= 0:
            return SplineMotion(law, smooth, float(longer))
    return None


def plan_retimed(scenario: Scenario, waypoints: Array, *, robust: bool = True) -> Plan:
    """The plan with the fastest safe time law along joint waypoints (K, n), rad.

    scenario: with an arm; its start and goal are replaced by the ends of the path. waypoints: (K, n). robust: safe for
    the whole uncertain set; else for nominal parameters only.

    Raises:
        ScenarioError: the scenario has no arm, or the waypoints do not match its joints.
    """
    given = scenario.with_changes(arm__start_posture=None) if scenario.arm is not None else scenario
    problem = transport_problem(given, robust=robust)
    waypoints = np.asarray(waypoints, dtype=float)
    if waypoints.ndim != 2 or waypoints.shape[1] != problem.n or not np.all(np.isfinite(waypoints)):
        raise ScenarioError(
            f"The waypoints are an array of shape {waypoints.shape}; {problem.arm.name} needs rows of {problem.n} "
            "finite joint angles, in rad."
        )
    _within_limits(scenario, problem, waypoints)
    path = SplinePath.through(waypoints)
    found = retime(problem, path)
    if not np.isfinite(found.duration):
        raise UnreachableError(f"{scenario.name}: {found.status.sentence}")
    body, changes = problem.items[0], {}
    for end, u in (("start", 0.0), ("goal", 1.0)):
        p_SB, R_SB = problem.arm.object_pose(path.derivatives(np.array([u]), 0)[0, 0], body.p_EB, body.R_EB)
        changes[f"motion__{end}"] = {"position": p_SB.tolist(), "quat_wxyz": quat_wxyz_from_matrix(R_SB).tolist()}
    moved = given.with_changes(**changes, motion__duration=None)

    # The path fixes tilt and clearance: where it passes an obstacle closer than the tracking error, the arm may touch.
    out = problem.keep_out
    strayed_from = None if out is None else KeepOut(out.parts, np.zeros_like(out.required))

    def made(found: FastestMotion) -> Plan:
        record = {
            "name": "time law by sequential quadratic programming (PIQP)",
            "robust": robust,
            "seconds": found.wall_time,
            "lower_bound": found.lower_bound,
            "worst": found.worst,
            "waypoints_missed": path.missed,
        }
        plan = joint_plan(moved, problem, found.joint_motion(), found.status, record)
        return judged(plan, replace(found.problem, keep_out=strayed_from))

    def planned(found: FastestMotion) -> tuple[FastestMotion, Plan]:
        return slow_enough(found, made(found), made, robust)

    found, plan = planned(found)
    return at_every_speed(found, plan, lambda known: planned(retime(known.problem, path)))[1] if robust else plan


def plan_retimed_legs(scenario: Scenario, paths: Sequence[Array], *, robust: bool = True) -> MultiLegPlan:
    """The plan of several legs, each with the fastest safe time law along its joint waypoints (`plan_retimed`).

    Raises ScenarioError when the numbers of paths and of legs differ.
    """
    if len(paths) != len(scenario.legs):
        raise ScenarioError(f"{scenario.name} has {len(scenario.legs)} legs, and paths of {len(paths)} were given.")
    legs = []
    for leg, path in zip(scenario.each_leg, paths, strict=True):
        plan = plan_retimed(leg.with_changes(motion__through=[]), path, robust=robust)
        begin = plan.scenario.motion.start if scenario.motion.goal_yaw == "free" else leg.motion.start
        # The via poses are kept: the verdict checks whether the path still passes them.
        motion = leg.motion.model_copy(update={"start": begin})
        legs.append(replace(plan, scenario=plan.scenario.model_copy(update={"motion": motion})))
    each = ", ".join(f"{leg.duration:.4f} s" for leg in legs)
    status = Status(
        "optimal", f"Along these paths the legs take {sum(leg.duration for leg in legs):.4f} s ({each}).", True
    )
    for number, timed in enumerate(legs, 1):
        if not timed.ok:
            status = Status("infeasible", f"Leg {number}: {timed.verdict}", False)
            break
    record = {"name": legs[0].solver["name"], "seconds": sum(leg.solver["seconds"] for leg in legs), "robust": robust}
    return MultiLegPlan(scenario.with_changes(contact__condition="exact"), tuple(legs), status, record)


def _within_limits(scenario: Scenario, problem: TransportProblem, waypoints: Array) -> None:
    """Raise ScenarioError, which names waypoint and joint, if a waypoint exceeds the joint limits."""
    low, high = problem.limits.q_min, problem.limits.q_max
    beyond = np.argwhere((waypoints < low - PATH_TOLERANCE) | (waypoints > high + PATH_TOLERANCE))
    if len(beyond):
        k, joint = beyond[0]
        raise ScenarioError(
            f"{scenario.name}: waypoint {k + 1} has {problem.arm.joint_names[joint]} at {waypoints[k, joint]:.4g}; it "
            f"must be from {low[joint]:.4g} to {high[joint]:.4g} (rad; m for a prismatic joint)."
        )


def reachable_law(problem: TransportProblem, path: SplinePath, count: int = 201) -> tuple[Array, Array] | None:
    """The fastest time law under limits of velocity, acceleration, torque and nominal contact: times t (count,) and
    path positions u (count,); None when there is none.

    With x_i = (du/dt)^2 at points of the path and d2u/dt2 = (x_{i+1} - x_i) / (2 du) between them, all conditions
    are linear, and the largest sum of x is the largest x everywhere.
    """
    u = np.linspace(0.0, 1.0, count)
    middle = 0.5 * (u[1:] + u[:-1])
    q, first, second = path.derivatives(middle, 2)
    zero = np.zeros_like(q)

    def at(dq: Array, ddq: Array) -> tuple[Array, Array]:
        terms = motion_terms(problem.model, problem.arm.tray_id, q, dq, ddq)
        return terms.w, terms.torque

    # w and torque are affine in ddq and quadratic in dq: their values at rest, and the changes with x = 1 and slope 1.
    rest, torque_rest = at(zero, zero)
    by_x, torque_x = (a - b for a, b in zip(at(first, second), (rest, torque_rest), strict=True))
    by_slope, torque_slope = (a - b for a, b in zip(at(zero, first), (rest, torque_rest), strict=True))
    limits = problem.limits
    blocks = [(first, second, np.zeros_like(first), limits.acceleration)]
    blocks.append((torque_slope, torque_x, torque_rest, limits.torque))
    slope, x, constant = [], [], []
    for by_u, by_square, fixed, bound in blocks:
        finite = np.isfinite(bound)
        for sign in (1.0, -1.0):
            slope.append(sign * by_u[:, finite])
            x.append(sign * by_square[:, finite])
            constant.append(sign * fixed[:, finite] - bound[finite])
    for rows in problem.contacts:
        c = rows.nominal.T
        slope.append(by_slope @ c)
        x.append(by_x @ c)
        constant.append(rest @ c)
    a, b, c = np.hstack(slope), np.hstack(x), np.hstack(constant)
    n, m = a.shape
    du = u[1] - u[0]
    # a (x_{i+1} - x_i) / (2 du) + b (x_i + x_{i+1}) / 2 + c <= 0 at the middle of each interval.
    row = np.arange(n * m)
    left = np.repeat(np.arange(n), m)
    values = np.concatenate([(-a / (2 * du) + b / 2).ravel(), (a / (2 * du) + b / 2).ravel()])
    matrix = coo_matrix((values, (np.r_[row, row], np.r_[left, left + 1])), shape=(n * m, count)).tocsr()
    postures, first = path.derivatives(u, 1)
    speed, allowed = np.abs(first), limits.velocity_at(postures, first)[0]
    with np.errstate(divide="ignore"):
        highest = np.min(np.where(speed > 1e-12, allowed / np.maximum(speed, 1e-12), 1e6), axis=1) ** 2
    highest[0] = highest[-1] = 0.0
    result = linprog(-np.ones(count), A_ub=matrix, b_ub=-c.ravel(), bounds=np.column_stack([0 * highest, highest]))
    if result.x is None:
        return None
    rate = np.sqrt(np.maximum(result.x, 0.0))
    both = rate[1:] + rate[:-1]
    steps = np.where(both > 1e-6, 2 * du / np.maximum(both, 1e-6), 0.0)  # where the speed is zero: no bound
    return np.concatenate([[0.0], np.cumsum(steps)]), u
