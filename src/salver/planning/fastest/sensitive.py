"""The least sensitive motion of the arm in a given duration: it minimises the integral of the squared Pi, eq (13) of
the paper, within the arm's limits, clear of obstacles, with contact kept for the whole uncertain set."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from salver.errors import ScenarioError
from salver.geometry import Array
from salver.planning.fastest.options import FastestOptions
from salver.planning.fastest.safest import plan_best, quickest_within
from salver.planning.object.cost import CostWeights, cost_residual, sensitivity_cost, tray_loop
from salver.planning.trajopt.curves import Curve, FreeCurve, Grid
from salver.planning.trajopt.found import FastestMotion
from salver.planning.trajopt.objectives import LeastSquares, Point, QuadraticModel
from salver.planning.trajopt.problem import TransportProblem
from salver.planning.trajopt.spline import RestSpline
from salver.planning.trajopt.watch import Watch
from salver.scenario import Scenario
from salver.sensitivity.arm.terms import motion_terms
from salver.sensitivity.dual import Dual, DualRotation
from salver.sensitivity.tray import BodyMotion, TrayLoop
from salver.trajectory import min_jerk_line

if TYPE_CHECKING:
    from salver.planning.plan import Plan


@dataclass(frozen=True, eq=False)
class SensitivityCost(LeastSquares):
    """The cost of the first object's closed loop, eq (13), for a fixed duration in s. steps: of the integral, at least;
    in a sixtieth of a motion its acceleration is nearly linear.
    """

    problem: TransportProblem
    spline: RestSpline
    duration: float
    unit: float
    steps: int = 60
    sought = "least sensitive"
    _last: dict[str, tuple[Array, QuadraticModel]] = field(default_factory=dict, repr=False)

    def model(self, curve: Curve, at: Point) -> QuadraticModel:
        known = self._last.get("model")
        if known is None or known[0] is not at.coefficients:
            known = self._last["model"] = at.coefficients, super().model(curve, at)
        return known[1]

    def residual(self, coefficients: Array, derivatives: bool) -> tuple[Array, Array]:
        sensitivity = self.loop.sensitivity(self.fine, self._felt(coefficients, derivatives), len(self.t))
        return cost_residual(sensitivity, self._weights, coefficients.size if derivatives else 0)

    def _felt(self, coefficients: Array, derivatives: bool) -> BodyMotion:
        """Motion regressor of the object's frame B at the instants `fine`, with derivatives by the coefficients."""
        curve = self._curve
        z = curve.motion(coefficients, self.duration)
        terms = motion_terms(self.problem.model, self.problem.arm.tray_id, z[0], z[1], z[2])
        tangents: list[Array | None] = [None] * 5
        if derivatives:
            count, n = z.shape[1:]
            displacement, twist, felt = terms.changed(np.eye(3 * n)[None])
            by_state = np.concatenate([displacement[:, 3:], twist[:, 3:], felt[:, :6], twist[:, :3]], axis=1)
            parts = np.zeros((15 * count, 4, n))
            parts[:, :3] = by_state.reshape(-1, 3, n)
            columns = curve.columns(coefficients, self.duration, parts, np.repeat(np.arange(count), 15))
            blocks = columns.reshape(count, 5, 1, 3, -1)
            tangents = [blocks[:, k] for k in range(5)]
        turned, turning, force, alpha, moving = tangents
        in_E = BodyMotion(
            DualRotation(terms.R_SE[:, None], turned),
            Dual(terms.w[:, None, :3], force),
            Dual(terms.twist[:, None, 3:], turning),
            Dual(terms.w[:, None, 3:6], alpha),
            Dual(terms.twist[:, None, :3], moving),
        )
        first = self.problem.payload.first
        return in_E.of_frame(first.p_EB, first.R_EB)

    @cached_property
    def loop(self) -> TrayLoop:
        return tray_loop(self.problem.scenario)

    @cached_property
    def t(self) -> Array:
        """Instants (T,), s, at which the cost is integrated."""
        return self.loop.instants(self.duration, self.steps)

    @cached_property
    def fine(self) -> Array:
        """Instants, s, six times closer: the errors are then accurate to 5e-8."""
        return self.loop.instants(self.duration, len(self.t) - 1, 0.06)

    @cached_property
    def _curve(self) -> FreeCurve:
        return FreeCurve(self.problem, Grid.of(self.spline, self.fine / self.duration))

    @cached_property
    def _weights(self) -> CostWeights:
        return CostWeights.of(self.problem.scenario, self.t)


def plan_least_sensitive(
    scenario: Scenario, *, options: FastestOptions | None = None, watch: Watch | None = None
) -> Plan:
    """The plan along which the closed loop is least sensitive to parameter errors, eq (13), in the scenario's duration.

    The arm's limits are met, obstacles are avoided, every contact is kept for the whole uncertain set by the exact
    condition, and the tray may tilt unless motion.orientation is "fixed". The result is the better of the local optima
    found from the slowed-down fastest motion and from the straight path between its ends.
    Raises ScenarioError without an arm, a duration or an uncertain parameter that acts on the closed loop,
    UnreachableError when no safe motion in this duration was found.
    """
    options = options or FastestOptions()
    watch = watch or Watch(options.time_limit)
    quickest, duration = quickest_within(scenario, "least sensitive", options, watch)
    problem = quickest.problem
    line = _cost_of_line(scenario)
    if line == 0.0:
        raise ScenarioError(
            f"{scenario.name}: no uncertain parameter acts on the closed loop of {problem.payload.first.name}; give "
            "its mass, centre of mass or inertia a range, or ask for the safest plan."
        )
    objective = SensitivityCost(problem, quickest.spline, duration, line)

    def cost(motion: FastestMotion) -> float:
        curve = FreeCurve(problem, Grid.of(motion.spline, np.linspace(0, 1, 2)))
        return objective.value(curve, Point(motion.coefficients, duration))

    def told(best: FastestMotion) -> tuple[str, dict[str, Any]]:
        share = cost(best)
        sentence = (
            f"The least sensitive motion found in {duration:.4g} s costs {share:.3g} times what the straight line "
        )
        return f"{sentence}does", {"cost": share * line, "line": line}

    return plan_best(quickest, duration, objective, cost, told, "least-sensitive", options=options, watch=watch)


def _cost_of_line(scenario: Scenario) -> float:
    """Cost, eq (13), of the straight min-jerk line in the same duration."""
    motion, loop = scenario.motion, tray_loop(scenario)
    assert motion.duration is not None
    ends = (np.array(motion.start.position), np.array(motion.goal.position))
    line = min_jerk_line(motion.duration, *ends, motion.start.rotation, motion.goal.rotation)
    t = loop.instants(motion.duration, SensitivityCost.steps)
    return sensitivity_cost(scenario, t, loop.along(line, t))
