"""Parametrisations of a joint motion: a free spline in joint space, or a time law along a given path."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from typing import Protocol

import numpy as np
import numpy.typing as npt

from salver.geometry import Array, Indices
from salver.models.arm.arm import ArmModel
from salver.planning.trajopt.ends import AtPosture, End
from salver.planning.trajopt.evaluation import MotionEvaluation
from salver.planning.trajopt.problem import TransportProblem
from salver.planning.trajopt.spline import DERIVATIVES, RestSpline
from salver.trajectory import smooth_step

ORDERS = np.arange(float(DERIVATIVES))[:, None, None]  # of the rows of z


def united(points: npt.ArrayLike, more: npt.ArrayLike, same: float = 1e-9) -> Array:
    """The sorted union of two sets of points; of points within `same`, which differ by rounding, only one is kept."""
    both = np.union1d(points, more)
    return both[np.append(True, np.diff(both) > same)]


@dataclass(frozen=True)
class Grid:
    """Points s (P,) in [0, 1], the spline basis there (4, P, size), and the indices (N,) of the points that are
    nodes."""

    s: Array
    basis: Array
    nodes: Indices

    @classmethod
    def of(cls, spline: RestSpline, nodes: Array, finer: int = 1) -> Grid:
        """The grid of nodes (N,) with finer - 1 points between neighbours."""
        last = finer * (len(nodes) - 1)
        s = np.interp(np.arange(last + 1) / finer, np.arange(len(nodes)), nodes)
        return cls(s, spline.matrices(s), finer * np.arange(len(nodes)))

    @property
    def weights(self) -> Array:
        """Weights (P,) of a mean over time by the trapezoidal rule; their sum is 1."""
        steps = np.diff(self.s)
        return 0.5 * (np.append(steps, 0.0) + np.append(0.0, steps))

    def motion(self, coefficients: Array, duration: float) -> Array:
        """The spline's value and its first three time derivatives, (4, P, m)."""
        z = self.basis @ coefficients
        return np.asarray(z / duration**ORDERS)

    def chained(self, parts: Array, point: Indices, duration: float) -> Array:
        """Chain rule: derivatives by the coefficients (r, size m) from those by the value and its time derivatives,
        parts (r, 4, m)."""
        basis = self.basis[:, point].transpose(1, 2, 0) * duration ** -np.arange(4.0)
        return np.matmul(basis, parts).reshape(len(point), -1)


class Curve(ABC):
    """A parametrisation as the optimiser uses it; coefficients are (size, m)."""

    @property
    @abstractmethod
    def width(self) -> int:
        """m, the number of curves."""

    @abstractmethod
    def evaluated(self, coefficients: Array, duration: float) -> MotionEvaluation:
        """The motion at the points of the grid, as constraints read it."""

    @abstractmethod
    def metric(self, duration: float, damping: float) -> Array:
        """Quadratic form (size, size) that measures steps of one curve, times the damping: the mean square of the
        change in posture, and less of those in acceleration and jerk."""

    def by_duration(self, coefficients: Array, duration: float, z: Array) -> Array:
        """Derivative (4, P, n) of z by log T with fixed coefficients."""
        return np.asarray(-ORDERS * z)

    @abstractmethod
    def columns(self, coefficients: Array, duration: float, parts: Array, point: Indices) -> Array:
        """Derivatives (r, size m) by the coefficients from those by z at points, parts (r, 4, n)."""

    def fixed(self) -> tuple[int, int]:
        """Numbers of unknowns, of size m, that are fixed at the beginning and at the end."""
        return 0, 0

    def equalities(self, coefficients: Array) -> tuple[Array, Array]:
        """A (k, size m), b (k,): a step d must satisfy A d = b."""
        return np.zeros((0, coefficients.size)), np.zeros(0)

    def inequalities(self, coefficients: Array) -> tuple[Array, Array]:
        """A (k, size m), b (k,): a step d must satisfy A d <= b."""
        return np.zeros((0, coefficients.size)), np.zeros(0)

    @abstractmethod
    def repaired(self, coefficients: Array) -> Array | None:
        """Coefficients after a step, corrected to satisfy the equalities exactly; None when that failed."""


@dataclass(frozen=True, eq=False)
class JointCurve(Curve):
    """A parametrisation of joint motions."""

    problem: TransportProblem
    grid: Grid

    @abstractmethod
    def motion(self, coefficients: Array, duration: float) -> Array:
        """q, dq, ddq, dddq at the points of the grid, z (4, P, n)."""

    def evaluated(self, coefficients: Array, duration: float) -> MotionEvaluation:
        z = self.motion(coefficients, duration)
        return self.problem.at(self.grid.s, z, duration, self.grid.nodes)

    def metric(self, duration: float, damping: float) -> Array:
        # Equal weight: 1 rad/s^2 of acceleration and 0.055 rad of posture; 1000 rad/s^3 of jerk and 0.03 rad.
        weights = damping * np.array([1.0, 3e-3, 1e-9]) / duration ** np.array([0.0, 4.0, 6.0])
        return np.tensordot(weights, self._squares, axes=1)

    @cached_property
    def _squares(self) -> Array:
        """Quadratic forms (3, size, size): mean squares of the change in posture, acceleration and jerk, for T = 1."""
        basis = self.grid.basis[[0, 2, 3]]
        return np.asarray(np.swapaxes(basis, 1, 2) @ basis / basis.shape[1])


@dataclass(frozen=True, eq=False)
class FreeCurve(JointCurve):
    """Joint splines between the problem's ends, with control postures as coefficients (size, n), the ends included.

    For a moving start the quintic Hermite functions of its velocity and acceleration are added.
    """

    @property
    def width(self) -> int:
        return self.problem.n

    def motion(self, coefficients: Array, duration: float) -> Array:
        z = self.grid.motion(coefficients, duration)
        return z if self._launch is None else z + self._launched(duration).sum(axis=0)

    def by_duration(self, coefficients: Array, duration: float, z: Array) -> Array:
        if self._launch is None:
            return np.asarray(-ORDERS * z)
        # Of order k: T^-k for the spline, T^(1 - k) and T^(2 - k) for the two functions of the start.
        launched = self._launched(duration)
        return np.asarray(-ORDERS * z + launched[0] + 2 * launched[1])

    def columns(self, coefficients: Array, duration: float, parts: Array, point: Indices) -> Array:
        return self.grid.chained(parts, point, duration)

    def fixed(self) -> tuple[int, int]:
        n = self.problem.n
        return n * self.problem.start.given, n * self.problem.goal.given

    def equalities(self, coefficients: Array) -> tuple[Array, Array]:
        return end_equalities(self.problem.arm, [(self.problem.start, 0), (self.problem.goal, -1)], coefficients)

    def repaired(self, coefficients: Array) -> Array | None:
        arm, limits = self.problem.arm, self.problem.limits
        start = self.problem.start.nearest(arm, limits, coefficients[0], 20)
        goal = self.problem.goal.nearest(arm, limits, coefficients[-1], 20)
        if goal is None or start is None:
            return None
        return with_ends(coefficients, start, goal)

    @cached_property
    def _launch(self) -> Array | None:
        """(2, 4, P, n) contributions of the start's velocity and acceleration to z for T = 1; None at rest."""
        start = self.problem.start
        if not isinstance(start, AtPosture) or not start.moving:
            return None
        return launch_basis(self.grid.s)[:, :, :, None] * start.rates[:, None, None, :]

    def _launched(self, duration: float) -> Array:
        assert self._launch is not None
        return np.asarray(self._launch * duration ** (np.arange(1.0, 3.0)[:, None, None, None] - ORDERS))


def end_equalities(arm: ArmModel, ends: Sequence[tuple[End, int]], coefficients: Array) -> tuple[Array, Array]:
    """`Curve.equalities` of ends, each given with the index of its posture in the coefficients (size, n)."""
    size, n = coefficients.shape
    blocks, targets = [], []
    for end, row in ends:
        error, jacobian = end.residual(arm, coefficients[row])
        block = np.zeros((len(error), size, n))
        block[:, row] = jacobian
        blocks.append(block.reshape(len(error), size * n))
        targets.append(error)
    return np.vstack(blocks), np.concatenate(targets)


def with_ends(coefficients: Array, start: Array, goal: Array) -> Array:
    """Coefficients (size, n) with other ends (n,). The whole motion is shifted smoothly with them: moving an end alone
    would cause a jolt."""
    share = _ramp(len(coefficients))
    moved = coefficients + (1 - share) * (start - coefficients[0]) + share * (goal - coefficients[-1])
    moved[0], moved[-1] = start, goal
    return np.asarray(moved)


@lru_cache(maxsize=16)
def _ramp(count: int) -> Array:
    """A smooth step (count, 1) from 0 to 1."""
    return smooth_step(np.linspace(0, 1, count))[:, None]


def launch_basis(s: Array) -> Array:
    """The two quintics in s with slope 1, and with second derivative 1, at s = 0 and all other end values 0, and their
    first three derivatives, (2, 4, P)."""
    return np.array([[p(s) for p in each] for each in _launches()])


def launched(start: AtPosture, s: Array, duration: float) -> Array:
    """Contribution (len(s), n) of a start's velocity and acceleration to the posture, rad."""
    powers = np.array([duration, duration**2])[:, None, None]
    return np.asarray((launch_basis(s)[:, 0, :, None] * start.rates[:, None, :] * powers).sum(axis=0))


@cache
def _launches() -> list[list[np.polynomial.Polynomial]]:
    """The quintics of `launch_basis`, and their derivatives."""
    velocity = np.polynomial.Polynomial([0, 1, 0, -6, 8, -3])
    acceleration = np.polynomial.Polynomial([0, 0, 0.5, -1.5, 1.5, -0.5])
    return [[p.deriv(k) if k else p for k in range(DERIVATIVES)] for p in (velocity, acceleration)]


class JointPath(Protocol):
    """A path q(u), u in [0, 1]."""

    def derivatives(self, u: Array, order: int) -> Array:
        """q and its derivatives by u up to an order, (order + 1, N, n)."""
        ...


@dataclass(frozen=True, eq=False)
class PathCurve(JointCurve):
    """A monotonic time law u(t) along a given path, from 0 to 1; coefficients (size, 1).

    The control values are kept in order, which makes the spline monotonic (variation diminishing property).
    """

    path: JointPath
    width = 1

    def motion(self, coefficients: Array, duration: float) -> Array:
        u, u1, u2, u3 = self.grid.motion(coefficients, duration)
        p0, p1, p2, p3 = self.path.derivatives(u[:, 0], 3)
        return np.stack([p0, p1 * u1, p2 * u1**2 + p1 * u2, p3 * u1**3 + 3 * p2 * u1 * u2 + p1 * u3])

    def columns(self, coefficients: Array, duration: float, parts: Array, point: Indices) -> Array:
        by_law = self._by_law(self.grid.motion(coefficients, duration)[:, point])
        law = np.einsum("rkn,jkrn->rj", parts, by_law)
        return self.grid.chained(law[:, :, None], point, duration)

    def fixed(self) -> tuple[int, int]:
        return 1, 1

    def inequalities(self, coefficients: Array) -> tuple[Array, Array]:
        backwards = np.eye(coefficients.size)[:-1] - np.eye(coefficients.size)[1:]
        return backwards, -backwards @ coefficients[:, 0]

    def repaired(self, coefficients: Array) -> Array | None:
        return np.maximum.accumulate(np.clip(coefficients, 0.0, 1.0), axis=0)

    def _by_law(self, law: Array) -> Array:
        """Derivatives (4, 4, R, n) of z by u and its three time derivatives (first axis)."""
        u, u1, u2, u3 = law
        _, p1, p2, p3, p4 = self.path.derivatives(u[:, 0], 4)
        zero = np.zeros_like(p1)
        rows = (
            (p1, p2 * u1, p3 * u1**2 + p2 * u2, p4 * u1**3 + 3 * p3 * u1 * u2 + p2 * u3),
            (zero, p1, 2 * p2 * u1, 3 * p3 * u1**2 + 3 * p2 * u2),
            (zero, zero, p1, 3 * p2 * u1),
            (zero, zero, zero, p1),
        )
        return np.stack([np.stack(row) for row in rows])
