"""The optimisation problem of the paper, eqs (13) to (17), with derivatives.

The variables z parametrise all rest-to-rest references, with coefficients a = particular + null_space z (eq 26), for
position and for body angular velocity. The goal orientation is a nonlinear equality in z.

    minimise    integral of |S Pi(t)|^2 dt                       (13)   (and a trace of jerk)
    subject to  c(t) - r(t) >= margin on a grid of instants      (16)

c - r is the slack of the contact conditions (`salver.planning.object.conditions`). With fixed orientation, and
unless the paper's condition meets an uncertain centre of mass, cost residuals and constraints are affine in z:
the problem is convex.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from salver.geometry import Array, hat, log, right_jacobian_inverse
from salver.models.bodies import Body
from salver.models.uncertain.parameters import UncertainSet
from salver.planning.object.conditions import Rows, conditions_along
from salver.planning.object.cost import CostWeights, base_radius, cost_residual, tray_loop
from salver.scenario import Scenario
from salver.sensitivity.tray import BodyMotion, TrayLoop
from salver.trajectory import (
    MotionSamples,
    PolynomialReference,
    boundary_solution,
    chebyshev_basis,
    geodesic_angular_velocity,
    position_boundary,
)

MISSED = 1e-7  # N (or the row's own unit) by which a solution may violate a constraint


@dataclass(frozen=True)
class Linearisation:
    """Cost and constraints linearised at z.

    residual (n_r,), with cost = |residual|^2. rows: the contact conditions at T instants. goal (m,) and goal_jacobian
    (m, n_z): the error of the goal orientation; empty when the orientation is fixed.
    """

    residual: Array
    residual_jacobian: Array
    rows: tuple[Rows, ...]
    goal: Array
    goal_jacobian: Array


@dataclass(frozen=True)
class Problem:
    """The planning problem of a scenario. Constraints are imposed at the instants `t`, at least `nodes` of them.

    smooth: share of the jerk in the cost; it only decides between references of equal cost.
    """

    scenario: Scenario
    nodes: int
    smooth: float = 1e-9

    @property
    def margin(self) -> float:
        """The least slack allowed: the scenario's margin, or the numerical tolerance if that is larger."""
        return max(self.scenario.contact.margin, MISSED)

    @cached_property
    def duration(self) -> float:
        assert self.scenario.motion.duration is not None
        return self.scenario.motion.duration

    @cached_property
    def body(self) -> Body:
        """The object whose closed loop is planned: the first."""
        return self.scenario.payload.first

    @cached_property
    def uncertain(self) -> UncertainSet:
        return self.scenario.payload.uncertain

    @cached_property
    def loop(self) -> TrayLoop:
        return tray_loop(self.scenario)

    @cached_property
    def t(self) -> Array:
        """Instants (T,), s: the nodes, with as many between them as the errors need; the relative error of the cost's
        integral is then about 1e-4."""
        return self.loop.instants(self.duration, self.nodes - 1)

    @cached_property
    def fine(self) -> Array:
        """Instants, s, six times closer than `t`: the errors are then accurate to 5e-8."""
        return self.loop.instants(self.duration, len(self.t) - 1, 0.06)

    @cached_property
    def rotates(self) -> bool:
        return self.scenario.motion.may_turn or self._turn > 1e-12

    @cached_property
    def _turn(self) -> float:
        start, goal = self.scenario.motion.start.rotation, self.scenario.motion.goal.rotation
        return 0.0 if np.array_equal(start, goal) else float(np.linalg.norm(log(start.T @ goal)))

    @property
    def is_affine(self) -> bool:
        """Whether cost residuals and constraints are affine in z, so that one convex programme solves the problem.

        Two effects are products of functions of z: vertical acceleration changes the stiffness of a swinging load, and
        an uncertain centre of mass rotates the object in the closed loop, and with it the force on it.
        """
        turned = any(parameter.kind == "com" for parameter in self.uncertain.parameters)
        return (
            not self.rotates
            and not self.scenario.payload.dynamic
            and not (turned and self.scenario.contact.condition == "paper")
        )

    # Variables -------------------------------------------------------------------------------------------

    @cached_property
    def _position(self) -> tuple[Array, Array]:
        """Particular solution (n + 1, 3) and null space (n + 1, n - 5) of eq (26) for position."""
        motion = self.scenario.motion
        values = position_boundary(self.duration, np.array(motion.start.position), np.array(motion.goal.position))
        solution = boundary_solution(motion.degree, values)
        return solution.particular, solution.null_space

    @cached_property
    def _spin(self) -> tuple[Array, Array]:
        """The same for body angular velocity (degree n - 1): zero with zero derivative at both ends."""
        motion = self.scenario.motion
        degree = motion.degree - 1
        null_space = boundary_solution(degree, np.zeros((4, 3)), (0, 1)).null_space
        particular = np.zeros((degree + 1, 3))
        turn = geodesic_angular_velocity(self.duration, motion.start.rotation, motion.goal.rotation)
        if turn is not None:
            particular[: len(turn)] = turn
        return particular, null_space

    @property
    def size(self) -> int:
        """Number of variables n_z: first of position, axis by axis, then of angular velocity, axis by axis."""
        return self.n_position + (3 * self._spin[1].shape[1] if self.rotates else 0)

    @property
    def n_position(self) -> int:
        return 3 * self._position[1].shape[1]

    def reference(self, z: Array) -> PolynomialReference:
        """The reference of variables z (n_z,); z = 0 is the paper's initial guess, the minimum-norm a = M^+ d."""
        particular, null_space = self._position
        position = particular + null_space @ z[: self.n_position].reshape(3, -1).T
        angular_velocity = None
        if self.rotates:
            particular, null_space = self._spin
            angular_velocity = particular + null_space @ z[self.n_position :].reshape(3, -1).T
        return PolynomialReference(self.duration, self.scenario.motion.start.rotation, position, angular_velocity)

    # Cost ------------------------------------------------------------------------------------------------

    @cached_property
    def weights(self) -> CostWeights:
        return CostWeights.of(self.scenario, self.t)

    @cached_property
    def smoothness(self) -> tuple[Array, Array]:
        """Residual (n_j,) at z = 0 of the squared jerk (and second derivative of omega), and its Jacobian.

        A small share of it decides between references of equal cost. If no uncertain parameter acts on the closed loop
        (only friction, for example), it is the whole cost.
        """
        s, rate = 2 * self.t / self.duration - 1, 2 / self.duration
        weights = np.sqrt(self.weights.times)[:, None, None]
        parts = [(self._position, 3, 1.0)]
        if self.rotates:
            parts.append((self._spin, 2, base_radius(self.body)))
        residual, jacobian, offset = [], [], 0
        for (particular, null_space), order, scale in parts:
            basis = scale * rate**order * chebyshev_basis(s, len(particular) - 1, order)
            residual.append((weights[..., 0] * (basis @ particular)).ravel())
            spread = self._blocks(basis @ null_space, offset)
            jacobian.append((weights * spread).reshape(residual[-1].size, self.size))
            offset += 3 * null_space.shape[1]
        jerk = float(np.sum(np.square(np.concatenate(residual))))
        weight = np.sqrt(self._smoothness_share / jerk) if jerk > 0 else 0.0
        return weight * np.concatenate(residual), weight * np.concatenate(jacobian)

    @property
    def _smoothness_share(self) -> float:
        """Cost of the jerk at z = 0: a small share of the cost of settled errors, or 1 if no errors can arise."""
        push = np.full((1, 3), 1 / self.duration**2) if self.rotates else np.zeros((1, 3))
        zero = np.zeros((1, 3))
        still = MotionSamples(np.zeros(1), zero, zero, zero, np.eye(3)[None], zero, push)
        forcing = self.loop.forcing(BodyMotion.of(still))
        pairs = zip(forcing, self.weights.rows[:2], self.loop.gains.kp, strict=True)
        settled = sum(float(np.sum((scale * part.value / kp) ** 2)) for part, scale, kp in pairs)
        return self.smooth * self.duration * settled if settled > 0 else 1.0

    def _blocks(self, basis: Array, offset: int) -> Array:
        """Expand a basis (T, m) of one axis to (T, 3, n_z): each axis has its own block of columns, from `offset`
        on."""
        own = np.einsum("ij,tm->tijm", np.eye(3), basis).reshape(len(basis), 3, -1)
        return np.pad(own, ((0, 0), (0, 0), (offset, self.size - offset - own.shape[2])))

    # Derivatives -----------------------------------------------------------------------------------------

    @cached_property
    def bases(self) -> tuple[Array, ...]:
        """Derivatives (T, 3, n_z) by z of v_S and a_S, and where the orientation is free, of omega_B and alpha_B, at
        `fine`."""
        s, rate = 2 * self.fine / self.duration - 1, 2 / self.duration
        null_position = self._position[1]

        v, a = (
            self._blocks(rate**k * chebyshev_basis(s, len(null_position) - 1, k) @ null_position, 0) for k in (1, 2)
        )
        if not self.rotates:
            return v, a
        null_spin = self._spin[1]
        spin = [rate**k * chebyshev_basis(s, len(null_spin) - 1, k) @ null_spin for k in range(2)]
        return v, a, *(self._blocks(basis, self.n_position) for basis in spin)

    def linearise(self, z: Array) -> Linearisation:
        """Cost residuals, constraints and their derivatives at z."""
        samples, (v, a, *spin), theta = self.reference(z).sample(self.fine), self.bases, None
        if spin:  # dtheta' = domega - omega x dtheta, so R dtheta is the running integral of R domega
            R_SB, h = samples.R_SB, self.fine[1]
            f, rate = R_SB @ spin[0], R_SB @ (hat(samples.omega_B) @ spin[0] + spin[1])
            steps = h / 2 * (f[1:] + f[:-1]) + h**2 / 12 * (rate[:-1] - rate[1:])  # of cubics between instants
            theta = np.swapaxes(R_SB, 1, 2) @ np.cumsum(np.concatenate([0 * f[:1], steps]), axis=0)
        sensitivity = self.loop.sensitivity(self.fine, BodyMotion.of(samples, v, a, theta, *spin), len(self.t))
        residual, jacobian = cost_residual(sensitivity, self.weights, self.size)
        smooth, smooth_jacobian = self.smoothness
        residual = np.concatenate([residual, smooth + smooth_jacobian @ z])
        jacobian = np.concatenate([jacobian, smooth_jacobian])
        rows = conditions_along(self.scenario, self.t, sensitivity.motion, lambda: sensitivity, self.size)
        goal, goal_jacobian = np.zeros(0), np.zeros((0, self.size))
        if theta is not None:
            goal, goal_jacobian = self._goal(samples.R_SB[-1], theta[-1])
        return Linearisation(residual, jacobian, rows, goal, goal_jacobian)

    def _goal(self, R_end: Array, theta_end: Array) -> tuple[Array, Array]:
        """Error of the goal orientation, (3,), or of the vertical, (2,), with free yaw; and its derivative by z."""
        turn = self.scenario.motion.goal.rotation.T @ R_end
        if self.scenario.motion.goal_yaw == "fixed":
            return log(turn), right_jacobian_inverse(log(turn)) @ theta_end
        return turn[:2, 2], -(turn @ hat([0.0, 0.0, 1.0]) @ theta_end)[:2]
