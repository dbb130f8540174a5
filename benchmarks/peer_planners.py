"""Planners of others, asked for the same task. `@planner(name)` adds one; `peers.py` scores them all.

A planner gets a `Task` and returns (t, q, dq, ddq): times (N,) in s from 0, joint positions, velocities, accelerations
(N, n) in rad, from rest at `task.path`'s beginning to rest at its end.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.util import find_spec
from typing import Any
from xml.etree import ElementTree

import numpy as np

from fastest import fastest_line, law_motion, line_path, optimum, topp
from salver.geometry import Array
from salver.models.arm.known_arms import KNOWN_ARMS, robot_file
from salver.planning.fastest.retiming import SplinePath
from salver.planning.plan import Plan
from salver.planning.trajopt.problem import TransportProblem, transport_problem
from salver.scenario import Scenario
from salver.sensitivity.arm.terms import motion_terms

Motion = tuple[Array, Array, Array, Array]
GRAVITY = 9.81


@dataclass(frozen=True)
class Task:
    """What is asked. problem: limits, arm, nominal contact on a level tray. path: in joint space, along the straight
    line between start and goal; planners that find their own use its ends."""

    scenario: Scenario

    @cached_property
    def problem(self) -> TransportProblem:
        return transport_problem(self.scenario, level=True, robust=False)

    @cached_property
    def path(self) -> SplinePath:
        return line_path(self.scenario)

    @cached_property
    def ends(self) -> Array:
        """(2, n) rad."""
        return self.path.derivatives(np.array([0.0, 1.0]), 0)[0]

    @property
    def friction(self) -> float:
        """The least of all nominal coefficients."""
        return min(item.friction for item in self.scenario.objects)


@dataclass(frozen=True)
class Planner:
    """name; what it knows, for the table; the package it needs, if any; how it plans."""

    name: str
    knows: str
    package: str | None
    plan: Callable[[Task], Motion | Plan]

    @property
    def missing(self) -> bool:
        return self.package is not None and find_spec(self.package) is None


PLANNERS: dict[str, Planner] = {}


def planner(name: str, knows: str, package: str | None = None) -> Callable[[Any], Any]:
    """Add a planner to the benchmark; `knows`: which conditions it plans for, in a few words."""

    def add(plan: Callable[[Task], Motion | Plan]) -> Callable[[Task], Motion | Plan]:
        PLANNERS[name] = Planner(name, knows, package, plan)
        return plan

    return add


@planner("min-jerk line", "limits, nominal contact; shortest by bisection")
def min_jerk(task: Task) -> Plan:
    return fastest_line(task.scenario, task.problem, task.path)[1]


@planner("ruckig", "limits of speed, acceleration, jerk", "ruckig")
def ruckig(task: Task) -> Motion:
    """From posture to posture, all joints at once: no path, no load."""
    import ruckig as package

    limits, (start, goal) = task.problem.limits, task.ends
    wanted = package.InputParameter(len(start))
    wanted.current_position, wanted.target_position = start.tolist(), goal.tolist()
    wanted.max_velocity, wanted.max_acceleration = limits.velocity.tolist(), limits.acceleration.tolist()
    wanted.max_jerk = limits.jerk.tolist()
    found = package.Trajectory(len(start))
    package.Ruckig(len(start)).calculate(wanted, found)
    # Its jerk is constant between these times, so that samples there lose nothing.
    ends = [np.cumsum([0.0, *profile.t]) for profile in found.profiles[0]]
    t = np.unique(np.clip(np.concatenate([np.linspace(0, found.duration, 401), *ends]), 0, found.duration).round(9))
    q, dq, ddq = (np.array(x) for x in zip(*(found.at_time(now)[:3] for now in t), strict=True))
    return t, q, dq, ddq


@planner("Drake Toppra", "limits of speed, acceleration, torque; tray's acceleration below the friction", "pydrake")
def drake(task: Task) -> Motion:
    """The friction as limits on the tray frame's acceleration: a square within the circle of mu g."""
    from pydrake.all import MultibodyPlant, Parser, PiecewisePolynomial, Toppra

    logging.getLogger("drake").setLevel(logging.ERROR)
    arm, limits = task.problem.arm, task.problem.limits
    root = ElementTree.parse(robot_file(KNOWN_ARMS[task.scenario.arm.model])).getroot()  # type: ignore[union-attr]
    for link in root.iter("link"):  # kinematics and inertia are enough
        for shape in (*link.findall("visual"), *link.findall("collision")):
            link.remove(shape)
    for joint in root.iter("joint"):
        if joint.get("name") not in arm.joint_names and joint.get("type") is not None:
            joint.set("type", "fixed")
    plant = MultibodyPlant(0.0)
    Parser(plant).AddModelsFromString(ElementTree.tostring(root, encoding="unicode"), "urdf")
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName(arm.link_names[0]))
    plant.Finalize()
    u = np.linspace(0, 1, 201)
    q = task.path.derivatives(u, 0)[0]
    path = PiecewisePolynomial.CubicWithContinuousSecondDerivatives(u, q.T)
    problem = Toppra(path, plant, u)
    problem.AddJointVelocityLimit(-limits.velocity, limits.velocity)
    problem.AddJointAccelerationLimit(-limits.acceleration, limits.acceleration)
    problem.AddJointTorqueLimit(-limits.torque, limits.torque)
    level = task.friction * GRAVITY / math.sqrt(2)
    most = np.array([1e3, 1e3, 1e3, level, level, 1e3])  # angular, then linear, in the frame's axes
    problem.AddFrameAccelerationLimit(plant.GetFrameByName(arm.link_names[-1]), -most, most)
    law = problem.SolvePathParameterization()
    t = np.linspace(law.start_time(), law.end_time(), len(u))
    s, ds, dds = (np.array([law.EvalDerivative(now, k)[0, 0] for now in t]) for k in range(3))
    q, first, second = task.path.derivatives(s, 2)
    return t - t[0], q, first * ds[:, None], second * ds[:, None] ** 2 + first * dds[:, None]


@planner("toppra", "limits of speed, acceleration, torque; nominal contact", "toppra")
def toppra(task: Task) -> Motion:
    """TOPP-RA (Pham and Pham 2018) with the rows of nominal contact as a constraint of second order."""
    u, rate = toppra_law(task.problem, task.path, 201, "intervals")
    steps = 2 * np.diff(u) / (rate[1:] + rate[:-1])
    return law_motion(task.path, np.concatenate([[0.0], np.cumsum(steps)]), u)


def toppra_law(problem: TransportProblem, path: SplinePath, count: int, scheme: str) -> tuple[Array, Array]:
    """(u, du/dt) at `count` points; du/dt is nan where toppra finds no law.

    scheme: conditions at the points ("nodes") or at both ends of every interval ("intervals", toppra's default).
    Torque and contact are one constraint: rows on the vector (w, torque), which depends on the motion as torque does.
    """
    from toppra.algorithm import TOPPRA
    from toppra.constraint import (
        DiscretizationType,
        JointAccelerationConstraint,
        JointVelocityConstraint,
        SecondOrderConstraint,
    )
    from toppra.interpolator import AbstractGeometricPath

    class Given(AbstractGeometricPath):
        """A path as toppra takes it."""

        def __call__(self, path_positions: Any, order: int = 0) -> Array:
            q: Array = path.derivatives(np.asarray(path_positions), order)[order]
            return q

        dof = int(path.spline.c.shape[1])
        path_interval = np.array([0.0, 1.0])
        waypoints = None

    logging.getLogger("toppra").setLevel(logging.ERROR)
    limits, n = problem.limits, problem.n
    kind = {"nodes": DiscretizationType.Collocation, "intervals": DiscretizationType.Interpolation}[scheme]

    def wrench_and_torque(q: Array, dq: Array, ddq: Array) -> Array:
        terms = motion_terms(problem.model, problem.arm.tray_id, q[None], dq[None], ddq[None])
        return np.concatenate([terms.w[0], terms.torque[0]])

    def both_sides(limit: Array) -> Array:
        return np.column_stack([-limit, limit])

    width = len(wrench_and_torque(*np.zeros((3, n)))) - n
    torque = np.hstack([np.zeros((n, width)), np.eye(n)])
    contact = [np.hstack([rows.nominal, np.zeros((len(rows.nominal), n))]) for rows in problem.contacts]
    matrix = np.vstack([torque, -torque, *contact])
    bound = np.concatenate([limits.torque, limits.torque, np.zeros(len(matrix) - 2 * n)])
    constraints = [
        JointVelocityConstraint(both_sides(limits.velocity)),
        JointAccelerationConstraint(both_sides(limits.acceleration), discretization_scheme=kind),
        SecondOrderConstraint(wrench_and_torque, lambda q: matrix, lambda q: bound, n, discretization_scheme=kind),
    ]
    u = np.linspace(0.0, 1.0, count)
    _, rate, _ = TOPPRA(constraints, Given(), gridpoints=u, solver_wrapper="seidel").compute_parameterization(0.0, 0.0)
    return u, np.full(count, np.nan) if rate is None else rate


@planner("salver, its own law", "limits of speed, acceleration, torque; nominal contact: as toppra")
def own_law(task: Task) -> Plan:
    return topp(task.scenario, task.problem, task.path)[1]


@planner("salver, nominal", "all limits, nominal contact")
def nominal(task: Task) -> Plan:
    return optimum(task.scenario, level=False, robust=False)[1]


@planner("salver", "all limits, contact and tracking for the whole uncertain set")
def robust(task: Task) -> Plan:
    return optimum(task.scenario, level=False, robust=True)[1]


def without_contact(problem: TransportProblem) -> TransportProblem:
    return replace(problem, contacts=())
