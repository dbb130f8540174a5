"""The optimisation problem of the paper, eqs (13) to (17), with derivatives.

The variables z parametrise all rest-to-rest references of the position, with coefficients a = particular + null_space z
(eq 26). The orientation turns from the start's to the goal's about one axis; motions of the whole arm also choose how
the tray tilts on the way (`salver.planning.fastest`).

    minimise    integral of |S Pi(t)|^2 dt                       (13)   (and a trace of jerk)
    subject to  c(t) - r(t) >= margin on a grid of instants      (16)

c - r is the slack of the contact conditions (`salver.planning.object.conditions`). Cost residuals are affine in z and
slacks are concave, so that the problem is convex, with the exceptions of `Problem.is_affine`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from salver.geometry import Array, log
from salver.linear_filter import QuadratureGrid
from salver.planning.object.conditions import Rows, conditions_along
from salver.planning.object.cost import CostWeights, cost_instants, cost_residual, tray_loop
from salver.scenario import Scenario
from salver.sensitivity.tray import BodyMotion, TrayLoop
from salver.trajectory import (
    BoundarySolution,
    MotionSamples,
    PolynomialReference,
    boundary_solution,
    chebyshev_basis,
    position_boundary,
)

MISSED = 1e-7  # N (or the row's own unit) by which a solution may violate a constraint
_SMOOTH = 1e-9  # share of the jerk in the cost


@dataclass(frozen=True)
class Linearisation:
    """Cost and constraints linearised at z.

    residual (n_r,), with cost = |residual|^2, and its Jacobian (n_r, n_z). rows: the contact conditions at T instants.
    """

    residual: Array
    residual_jacobian: Array
    rows: tuple[Rows, ...]


@dataclass(frozen=True)
class Problem:
    """The planning problem of a scenario. Constraints are imposed at the instants of `grid`, at least `nodes` of
    them."""

    scenario: Scenario
    nodes: int

    @property
    def margin(self) -> float:
        """The least slack allowed: the scenario's margin, or the numerical tolerance if that is larger."""
        return max(self.scenario.contact.margin, MISSED)

    @cached_property
    def duration(self) -> float:
        assert self.scenario.motion.duration is not None
        return self.scenario.motion.duration

    @cached_property
    def loop(self) -> TrayLoop:
        """The closed loop of the first object."""
        return tray_loop(self.scenario)

    @cached_property
    def grid(self) -> QuadratureGrid:
        """The nodes, with as many instants between them as the integral of the cost needs."""
        return self.loop.grid(cost_instants(self.loop, self.duration, self.nodes - 1))

    @property
    def is_affine(self) -> bool:
        """Whether cost residuals and constraints are affine in z, so that one convex programme solves the problem.

        Two effects are products of functions of z: vertical acceleration changes the stiffness of a swinging load, and
        an uncertain centre of mass rotates the object in the closed loop, and with it the force on it.
        """
        payload = self.scenario.payload
        turned = any(parameter.kind == "com" for parameter in payload.uncertain.parameters)
        return not payload.dynamic and not (turned and self.scenario.contact.condition == "paper")

    @cached_property
    def _position(self) -> BoundarySolution:
        motion = self.scenario.motion
        values = position_boundary(self.duration, np.array(motion.start.position), np.array(motion.goal.position))
        return boundary_solution(motion.degree, values)

    @property
    def size(self) -> int:
        """Number of variables n_z, axis by axis."""
        return 3 * self._position.null_space.shape[1]

    def reference(self, z: Array) -> PolynomialReference:
        """The reference of variables z (n_z,); z = 0 is the paper's initial guess, the minimum-norm a = M^+ d."""
        position = self._position.particular + self._position.null_space @ z.reshape(3, -1).T
        start, goal = self.scenario.motion.start.rotation, self.scenario.motion.goal.rotation
        return PolynomialReference(self.duration, start, position, log(start.T @ goal))

    @cached_property
    def weights(self) -> CostWeights:
        return CostWeights.of(self.scenario, self.grid.t)

    @cached_property
    def smoothness(self) -> tuple[Array, Array]:
        """Residual (n_j,) at z = 0 of the squared jerk, and its Jacobian.

        A small share of it decides between references of equal cost. If no uncertain parameter acts on the closed loop
        (only friction, for example), it is the whole cost.
        """
        weights = np.sqrt(self.weights.times)[:, None]
        (jerk,) = self._derivatives(self.grid.t, 3)
        basis = (2 / self.duration) ** 3 * chebyshev_basis(2 * self.grid.t / self.duration - 1, self._degree, 3)
        residual = (weights * (basis @ self._position.particular)).ravel()
        jacobian = (weights[:, :, None] * jerk).reshape(residual.size, self.size)
        size = float(residual @ residual)
        weight = np.sqrt(self._smoothness_share / size) if size > 0 else 0.0
        return weight * residual, weight * jacobian

    @property
    def _degree(self) -> int:
        return self.scenario.motion.degree

    @property
    def _smoothness_share(self) -> float:
        """Cost of the jerk at z = 0: a small share of the cost of settled errors, or 1 if no errors can arise."""
        zero = np.zeros((1, 3))
        still = MotionSamples(np.zeros(1), zero, zero, zero, np.eye(3)[None], zero, zero)
        forcing = self.loop.forcing(BodyMotion.of(still))
        pairs = zip(forcing, self.weights.rows[:2], self.loop.gains.kp, strict=True)
        settled = sum(float(np.sum((scale * part.value / kp) ** 2)) for part, scale, kp in pairs)
        return _SMOOTH * self.duration * settled if settled > 0 else 1.0

    def _derivatives(self, t: Array, *orders: int) -> list[Array]:
        """Derivatives (T, 3, n_z) by z of time derivatives of the position at t (T,)."""
        s, rate = 2 * t / self.duration - 1, 2 / self.duration
        bases = [rate**k * chebyshev_basis(s, self._degree, k) @ self._position.null_space for k in orders]
        # Each axis has its own block of columns.
        return [np.einsum("ij,tm->tijm", np.eye(3), basis).reshape(len(t), 3, self.size) for basis in bases]

    @cached_property
    def _velocity_acceleration(self) -> tuple[list[Array], list[Array]]:
        return self._derivatives(self.grid.t, 1, 2), self._derivatives(self.grid.times, 1, 2)

    def linearise(self, z: Array) -> Linearisation:
        """Cost residuals, constraints and their derivatives at z."""
        reference, (on_grid, between) = self.reference(z), self._velocity_acceleration
        motion = BodyMotion.of(reference.sample(self.grid.t), *on_grid)
        sensitivity = self.loop.sensitivity(
            self.grid, motion, BodyMotion.of(reference.sample(self.grid.times), *between)
        )
        residual, jacobian = cost_residual(sensitivity, self.weights, self.size)
        smooth, smooth_jacobian = self.smoothness
        residual = np.concatenate([residual, smooth + smooth_jacobian @ z])
        jacobian = np.concatenate([jacobian, smooth_jacobian])
        rows = conditions_along(self.scenario, self.grid.t, motion, lambda: sensitivity, self.size)
        return Linearisation(residual, jacobian, rows)
