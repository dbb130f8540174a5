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

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from salver.dynamics.modal_history import CaseGroups
from salver.geometry import Array, Indices, hat, log, right_jacobian_inverse
from salver.models.bodies import Body
from salver.models.uncertain.parameters import UncertainSet
from salver.planning.object.conditions import (
    cases_of,
    constraints_of,
    size_of,
    slack_along,
    tray_evaluation,
    tray_parts,
)
from salver.planning.object.cost import CostWeights, base_radius, cost_residual, tray_loop
from salver.planning.trajopt.constraints.constraints import Block, Constraint, evaluate
from salver.planning.trajopt.curves import Curve
from salver.planning.trajopt.evaluation import MotionEvaluation
from salver.planning.trajopt.objectives import LeastSquares, Point
from salver.planning.trajopt.programme import Programme
from salver.scenario import Scenario
from salver.sensitivity.tray import BodyMotion, TrayLoop, TraySensitivity
from salver.trajectory import (
    MotionSamples,
    PolynomialReference,
    boundary_solution,
    chebyshev_basis,
    geodesic_angular_velocity,
    position_boundary,
)

MISSED = 1e-7  # N (or the row's own unit) by which a solution may violate a constraint


@dataclass(frozen=True, eq=False)
class Problem(Curve):
    """The planning problem of a scenario. Constraints are imposed at the instants `t`, at least `nodes` of them.

    smooth: share of the jerk in the cost; it only decides between references of equal cost. As a curve of the
    optimiser it has the coefficients z (n_z, 1).
    """

    scenario: Scenario
    nodes: int
    smooth: float = 1e-9
    width = 1

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

    # The curve -------------------------------------------------------------------------------------------

    def at(self, z: Array) -> Candidate:
        """The reference of z (n_z,) with its cost and constraints; the latest are kept."""
        return self._latest(np.asarray(z, dtype=float).tobytes())

    @cached_property
    def _latest(self) -> Callable[[bytes], Candidate]:
        return lru_cache(maxsize=6)(lambda z: Candidate(self, np.frombuffer(z)))

    @cached_property
    def constraints(self) -> tuple[Constraint, ...]:
        return constraints_of(self.scenario)

    @cached_property
    def cases(self) -> CaseGroups:
        """All cases of load dynamics."""
        return cases_of(self.scenario.payload)

    def evaluated(self, coefficients: Array, duration: float) -> MotionEvaluation:
        return self.at(coefficients[:, 0]).motion

    def metric(self, duration: float, damping: float) -> Array:
        twists = duration * np.concatenate(self.bases[::2])  # of the size of the change in pose
        return np.asarray(damping / len(self.fine) * np.tensordot(twists, twists, axes=((0, 1), (0, 1))))

    def columns(self, coefficients: Array, duration: float, parts: Array, point: Indices) -> Array:
        state = parts[:, :3].reshape(len(parts), 1, -1)
        return np.asarray((state @ self.at(coefficients[:, 0]).tray_tangents[point])[:, 0])

    def equalities(self, coefficients: Array) -> tuple[Array, Array]:
        here = self.at(coefficients[:, 0])
        return here.goal_jacobian, -here.goal

    def repaired(self, coefficients: Array) -> Array:
        """After least-norm Newton steps until the goal orientation is met to rounding."""
        here = self.at(coefficients[:, 0])
        for _ in range(5):
            if np.abs(here.goal).max(initial=0.0) < 1e-13:
                break
            here = Candidate(self, here.z - np.linalg.pinv(here.goal_jacobian) @ here.goal)
        return here.z[:, None]

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


@dataclass(frozen=True, eq=False)
class Candidate:
    """The reference of variables z (n_z,), with the cost residuals (n_r,), whose squares add up to the cost, and the
    error of the goal orientation, (3,), or of the vertical, (2,), with free yaw, (0,) when it is fixed."""

    problem: Problem
    z: Array

    @cached_property
    def samples(self) -> MotionSamples:
        return self.problem.reference(self.z).sample(self.problem.fine)

    @cached_property
    def turned(self) -> Array | None:
        """Derivative (T, 3, n_z) of the rotation, in B: dtheta' = domega - omega x dtheta, so R dtheta is the running
        integral of R domega."""
        _, _, *spin = self.problem.bases
        if not spin:
            return None
        R_SB, h = self.samples.R_SB, self.problem.fine[1]
        f, rate = R_SB @ spin[0], R_SB @ (hat(self.samples.omega_B) @ spin[0] + spin[1])
        steps = h / 2 * (f[1:] + f[:-1]) + h**2 / 12 * (rate[:-1] - rate[1:])  # of cubics between instants
        return np.asarray(np.swapaxes(R_SB, 1, 2) @ np.cumsum(np.concatenate([0 * f[:1], steps]), axis=0))

    def closed_loop(self, derivatives: bool) -> TraySensitivity:
        """Pi and Theta at the instants `t`, with their derivatives by z or without."""
        return self._linear if derivatives else self._plain

    @cached_property
    def _plain(self) -> TraySensitivity:
        problem = self.problem
        if problem.is_affine:
            return self._linear.after(self.z)
        return problem.loop.sensitivity(problem.fine, BodyMotion.of(self.samples), len(problem.t))

    @cached_property
    def _linear(self) -> TraySensitivity:
        problem, (v, a, *spin) = self.problem, self.problem.bases
        if problem.is_affine and self.z.any():  # derivatives are the same everywhere
            return problem.at(np.zeros(problem.size))._linear
        motion = BodyMotion.of(self.samples, v, a, self.turned, *spin)
        return problem.loop.sensitivity(problem.fine, motion, len(problem.t))

    @cached_property
    def residual(self) -> Array:
        smooth, smooth_jacobian = self.problem.smoothness
        residual = cost_residual(self._plain, self.problem.weights)[0]
        return np.concatenate([residual, smooth + smooth_jacobian @ self.z])

    @cached_property
    def residual_jacobian(self) -> Array:
        """(n_r, n_z)."""
        jacobian = cost_residual(self._linear, self.problem.weights, self.problem.size)[1]
        return np.concatenate([jacobian, self.problem.smoothness[1]])

    @property
    def cost(self) -> float:
        return float(self.residual @ self.residual)

    @cached_property
    def motion(self) -> MotionEvaluation:
        """The tray's motion, as constraints read it."""
        problem, motion = self.problem, self._plain.motion
        return tray_evaluation(problem.scenario.payload, problem.t, motion, problem.cases, self.closed_loop)

    @cached_property
    def tray_tangents(self) -> Array:
        """Derivatives (T, 18, n_z) of displacement (of which only the rotation counts), twist and spatial acceleration
        of the tray."""
        payload, motion = self.problem.scenario.payload, self.closed_loop(True).motion
        v, omega, a, alpha = (part.tangent for part in tray_parts(payload, motion))
        turn = motion.rotation.tangent
        found = np.zeros((len(self.problem.t), 18, self.problem.size))
        for k, tangent in enumerate((None, None if turn is None else payload.first.R_EB @ turn, v, omega, a, alpha)):
            if tangent is not None:
                found[:, 3 * k : 3 * k + 3] = tangent[:, 0]
        return found

    @cached_property
    def slack(self) -> tuple[Array, tuple[str, ...]]:
        """Slacks (T, n_c) of all rows, and the owner of each."""
        return slack_along(self.problem.constraints, self.motion)

    @property
    def violation(self) -> float:
        """Of the worst row, with the margin."""
        return max(0.0, self.problem.margin - float(self.slack[0].min()))

    @property
    def goal(self) -> Array:
        if not self.problem.rotates:
            return np.zeros(0)
        turn = self._beyond_goal
        return log(turn) if self.problem.scenario.motion.goal_yaw == "fixed" else turn[:2, 2]

    @cached_property
    def goal_jacobian(self) -> Array:
        """(m, n_z)."""
        if self.turned is None:
            return np.zeros((0, self.problem.size))
        turn, theta_end = self._beyond_goal, self.turned[-1]
        if self.problem.scenario.motion.goal_yaw == "fixed":
            return right_jacobian_inverse(log(turn)) @ theta_end
        return -(turn @ hat([0.0, 0.0, 1.0]) @ theta_end)[:2]

    @property
    def _beyond_goal(self) -> Array:
        """Rotation (3, 3) from the goal to the end."""
        return np.asarray(self.problem.scenario.motion.goal.rotation.T @ self.samples.R_SB[-1])


@dataclass(frozen=True, eq=False)
class SensitivityIntegral(LeastSquares):
    """The cost of a problem."""

    problem: Problem
    unit: float
    sought = "least sensitive"

    def residual(self, coefficients: Array, derivatives: bool) -> tuple[Array, Array]:
        here = self.problem.at(coefficients[:, 0])
        return here.residual, here.residual_jacobian if derivatives else np.zeros((len(here.residual), 0))


@dataclass(frozen=True, eq=False)
class ObjectProgramme(Programme):
    """The nonlinear programme of a problem, with the scenario's margin instead of those of rows, and `spare` more."""

    margin: float = 0.0
    spare: float = 0.0

    @classmethod
    def of(cls, problem: Problem, unit: float = 1.0, spare: float = 0.0) -> ObjectProgramme:
        """With the cost in units of `unit`."""
        objective = SensitivityIntegral(problem, unit)
        return cls(problem, problem.constraints, objective, problem.margin, spare, accuracy=0.02 * spare)

    def blocks(self, motion: MotionEvaluation, point: Point) -> tuple[Block, ...]:
        rows: Sequence[Block] = evaluate(self.constraints, motion, margins=False)
        return tuple(block.having(values=block.values + self.spare + self.margin / size_of(block.of)) for block in rows)
