"""Excitation trajectories: safe motions with the most information about the load for a wrist sensor.

A motion from a posture back to it, in a given time, under all constraints of a fastest plan for the *present* ranges.
It maximises the information of `salver.learning.load.identify` about mass and centre of mass (D-optimal: Fedorov 1972;
exciting motions: Swevers et al. 1997), with unknown inertia and an unknown bias of each channel. The information is an
objective of the planner (`salver.planning.trajopt.objectives`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from salver.errors import ScenarioError, Status, UnreachableError
from salver.geometry import Array
from salver.learning.load.identify import identify
from salver.learning.load.narrowing import prior
from salver.learning.load.noise import RUNS, SensorNoise
from salver.learning.load.ranges import NAMES
from salver.learning.load.sensors import at_flange, simulated_log
from salver.learning.load.systematic import SensorBounds
from salver.learning.logs import one_load
from salver.models.interfaces import needed_at_tray
from salver.planning.fastest import (
    AtPosture,
    FastestMotion,
    FastestOptions,
    Objective,
    Point,
    QuadraticModel,
    TransportProblem,
    joint_plan,
    nearby,
    transport_problem,
)
from salver.planning.fastest.planned import solver_record
from salver.planning.plan import Plan
from salver.planning.seeds.starts import ends
from salver.planning.trajopt.constraints.constraints import ContactConstraint
from salver.planning.trajopt.curves import Curve, JointCurve
from salver.planning.trajopt.spline import RestSpline
from salver.scenario import Scenario
from salver.sensitivity.arm.terms import MotionTerms, motion_terms

METHOD = "excite"
SOUGHT = 4  # entries of phi of interest: mass and first moment


@dataclass(frozen=True, eq=False)
class Information(Objective):
    """Minus half the logarithm of the determinant of the information about mass and centre of mass.

    rows: (6, 10, 12) reading of each channel of a wrist sensor per unit of phi and of w of E. density: (6,) of white
    noise, unit^2 s. bias: (6,) standard deviation. known: (10, 10) prior information. problem: the transport problem.
    """

    problem: TransportProblem
    rows: Array
    density: Array
    bias: Array
    known: Array
    sought = "most informative"

    @classmethod
    def of(cls, problem: TransportProblem) -> Information:
        """The objective for a scenario's load with its ranges."""
        body, arm = problem.payload.first, problem.arm
        maps = np.array([at_flange(arm, needed_at_tray(body, unit)) for unit in np.eye(10)])
        sensors = SensorNoise()
        kinds = [sensors.force] * 3 + [sensors.moment] * 3
        density = np.array([RUNS * (n.white**2 * 1e-3 + 2 * sensors.colour * n.coloured**2) for n in kinds])
        bounds = SensorBounds()
        bias = np.hypot([bounds.force_bias] * 3 + [bounds.moment_bias] * 3, [np.sqrt(RUNS) * n.drift for n in kinds])
        spread = prior(problem.scenario)[1]
        return cls(problem, np.swapaxes(maps, 0, 1), density, bias, np.diag(1 / spread**2))

    def value(self, curve: Curve, at: Point) -> float:
        matrix = self._seen(curve, at)[0]
        return float(0.5 * (np.linalg.slogdet(matrix[SOUGHT:, SOUGHT:])[1] - np.linalg.slogdet(matrix)[1]))

    def model(self, curve: Curve, at: Point) -> QuadraticModel:
        matrix, centred, terms, time = self._seen(curve, at)
        gain = np.linalg.inv(matrix)
        gain[SOUGHT:, SOUGHT:] -= np.linalg.inv(matrix[SOUGHT:, SOUGHT:])
        by_w = -np.einsum("ckw,kl,tcl,t->tw", self.rows, gain, centred, time, optimize=True)
        count, n = terms.q.shape
        parts = np.zeros((count, 4, n))
        parts[:, :3] = np.einsum("tw,twz->tz", by_w, terms.w_z).reshape(count, 3, n)
        slope = curve.columns(at.coefficients, at.duration, parts, np.arange(count)).sum(axis=0)
        return QuadraticModel(slope)

    def scale(self, at: Point, value: float) -> float:
        return 1.0  # of a logarithm

    def _seen(self, curve: Curve, at: Point) -> tuple[Array, Array, MotionTerms, Array]:
        """Information (10, 10), readings per unit of phi over the noise, without bias (P, 6, 10), the terms, and the
        time (P,), s, that each point stands for."""
        assert isinstance(curve, JointCurve)
        z = curve.motion(at.coefficients, at.duration)
        terms = motion_terms(self.problem.model, self.problem.arm.tray_id, z[0], z[1], z[2])
        time = curve.grid.weights * at.duration
        read = np.einsum("ckw,tw->tck", self.rows, terms.w)
        total = np.einsum("tck,t->ck", read, time)
        shared = self.bias**2 / (self.density * (self.density + self.bias**2 * time.sum()))
        centred = read / self.density[:, None] - shared[:, None] * total
        return self.known + np.einsum("tck,tcl,t->kl", read, centred, time), centred, terms, time


def plan_excite(scenario: Scenario, duration: float, accepted: tuple[float, float] = (0.3, 30.0)) -> Plan:
    """Plan an excitation trajectory of a duration, s, from the scenario's start pose and back.

    accepted: s, least and largest duration. Raises ScenarioError for an unsuitable scenario, UnreachableError when no
    motion is found.
    """
    one_load(scenario, "an excitation trajectory")
    shortest, longest = accepted
    if not shortest <= duration <= longest:
        raise ScenarioError(f"A duration of {duration:g} s was asked for; it must be {shortest:g} to {longest:g}.")
    start = scenario.motion.start.model_dump()
    there = scenario.with_changes(
        contact__condition="exact",
        motion__goal=start,
        motion__through=[],
        motion__goal_yaw="fixed",
        motion__duration=duration,
    )
    options = FastestOptions()
    problem = transport_problem(there, level=there.motion.orientation == "fixed")
    pairs = ends(problem, np.random.default_rng(options.seed), few=1)
    if not pairs:
        raise UnreachableError(f"{scenario.name}: no posture within the joint limits reaches the start pose.")
    posture = AtPosture(pairs[0].start)
    problem = replace(problem, start=posture, goal=posture)
    spline, objective = RestSpline(5, options.spans), Information.of(problem)
    failed: list[Status] = []
    for seed in range(3):  # initial guesses, until one leads to a safe motion
        found = nearby(_wiggle(problem, spline, duration, options.seed + seed), objective, duration, options)
        plan = _planned(there, found)
        if plan.status.ok and not plan.verification.ok:  # as in `plan_problem`: after fast rotations
            exactly = tuple(ContactConstraint(rows, there.contact.margin, exactly=True) for rows in problem.contacts)
            harder = replace(found, problem=replace(problem, extra=(*problem.extra, *exactly)))
            plan = _planned(there, nearby(harder, objective, duration, options))
        if plan.ok:
            return plan
        failed.append(plan.status if not plan.status.ok else Status("unsafe", plan.verification.sentence, False))
    raise UnreachableError(f"{scenario.name}: {failed[0].sentence}")


def _planned(scenario: Scenario, found: FastestMotion) -> Plan:
    """The plan, with the ranges that `salver.learning.load.identify` would find from a log of a usual wrist sensor,
    with the nominal load."""
    record = solver_record(found, True)
    plan = joint_plan(scenario, found.problem, found.joint_motion(), found.status, record, method=METHOD)
    if not plan.status.ok:
        return plan
    loaded, empty = simulated_log(plan, scenario.payload.first.inertial, 0), simulated_log(plan, None, 1)
    ranges = identify(plan, [loaded], empty).ranges
    mass, *com = (1e3 * ranges[name].half for name in NAMES)
    sentence = (
        f"In {found.duration:.4g} s from the start pose and back a wrist sensor should tell the mass to "
        f"+-{mass:.2g} g and the centre of mass to +-{', '.join(f'{x:.2g}' for x in com)} mm."
    )
    return replace(plan, status=Status("optimal", sentence, True))


def _wiggle(problem: TransportProblem, spline: RestSpline, duration: float, seed: int) -> FastestMotion:
    """A random initial guess of about 0.1 rad with six half waves; at rest the gradient of the information is zero."""
    rng, s = np.random.default_rng(seed), np.linspace(0.0, 1.0, 201)
    assert problem.start_posture is not None
    waves = np.sin(np.pi * s[:, None] * np.arange(1, 7)) @ rng.standard_normal((6, problem.n))
    bump = (4 * s * (1 - s))[:, None] ** 2
    q = problem.start_posture + 0.1 * bump * waves / np.sqrt(6)
    status = Status("begun", "", False)
    return FastestMotion(spline, spline.fit(s, q), duration, problem, status)
