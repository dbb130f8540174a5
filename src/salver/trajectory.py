"""Reference trajectories of the object in SE(3): paper, eqs (14), (15), (26) and footnote 1.

The position is a polynomial for each axis, the body angular velocity another, integrated on SO(3). Both are in the
Chebyshev basis of normalised time s = 2 t / T - 1, whose boundary map is well conditioned at any degree (the monomial
basis loses a digit with each degree).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from functools import cached_property, lru_cache
from math import comb
from typing import Protocol

import numpy as np
import numpy.typing as npt
from numpy.polynomial import chebyshev

from salver.display import Outlined
from salver.geometry import Array, Indices, Mask, cross, exp, hat, log, quat_wxyz_from_matrix, right_jacobian_inverse


@dataclass(frozen=True)
class MotionSamples:
    """A motion of frame B at T instants: pose, velocity, acceleration (docs/conventions.md).

    t (T,); p_SB, v_S, a_S (T, 3) in S; R_SB (T, 3, 3); omega_B, alpha_B (T, 3) in B.
    """

    t: Array
    p_SB: Array
    v_S: Array
    a_S: Array
    R_SB: Array
    omega_B: Array
    alpha_B: Array

    @property
    def quat_SB_wxyz(self) -> Array:
        return quat_wxyz_from_matrix(self.R_SB)

    def only(self, index: Indices | Mask | slice) -> MotionSamples:
        """The motion at some of the instants."""
        return MotionSamples(*(getattr(self, each.name)[index] for each in fields(self)))

    def distinct(self, apart: float = 1e-6) -> MotionSamples:
        """The samples without the second of two within `apart`, s, as a command has at each waypoint, one for each
        side: interpolation needs distinct instants."""
        return self.only(np.diff(self.t, prepend=-np.inf) > apart)

    def of_frame(self, p_BX: npt.ArrayLike, R_BX: npt.ArrayLike | None = None) -> MotionSamples:
        """The motion of a frame X that is fixed to B."""
        R_BX = np.eye(3) if R_BX is None else np.asarray(R_BX, dtype=float)
        p_BX = np.asarray(p_BX, dtype=float)
        spin = hat(self.omega_B)
        velocity_B, acceleration_B = spin @ p_BX, (hat(self.alpha_B) + spin @ spin) @ p_BX
        return MotionSamples(
            self.t,
            self.p_SB + self.R_SB @ p_BX,
            self.v_S + np.einsum("tij,tj->ti", self.R_SB, velocity_B),
            self.a_S + np.einsum("tij,tj->ti", self.R_SB, acceleration_B),
            self.R_SB @ R_BX,
            self.omega_B @ R_BX,
            self.alpha_B @ R_BX,
        )


class Reference(Protocol):
    """A motion as a function of time; at rest before its start and after its end."""

    @property
    def duration(self) -> float: ...

    def sample(self, t: npt.ArrayLike) -> MotionSamples: ...


def chebyshev_basis(s: npt.ArrayLike, degree: int, derivative: int = 0) -> Array:
    """(T, degree + 1) values of the `derivative`-th derivatives of T_0 ... T_degree at s in [-1, 1]."""
    return chebyshev_bases(s, degree, (derivative,))[0]


def chebyshev_bases(s: npt.ArrayLike, degree: int, derivatives: Iterable[int]) -> list[Array]:
    """`chebyshev_basis` of several derivatives, computed together; treat the arrays as read-only, they are cached."""
    s = np.asarray(s, dtype=float)
    return [basis.reshape(*s.shape, basis.shape[-1]) for basis in _bases(s.tobytes(), degree, tuple(derivatives))]


@lru_cache(maxsize=64)
def _bases(points: bytes, degree: int, derivatives: tuple[int, ...]) -> list[Array]:
    """`chebyshev_bases`, cached, because a planner needs the same ones in every iteration."""
    values = chebyshev.chebvander(np.frombuffer(points), degree)
    bases = [values @ _differentiation(degree, derivative) for derivative in derivatives]
    for basis in bases:
        basis.setflags(write=False)
    return bases


@lru_cache(maxsize=256)
def _differentiation(degree: int, derivative: int) -> Array:
    """Coefficients (degree + 1, degree + 1) of the derivatives of T_0 ... T_degree, one column each."""
    matrix = np.zeros((degree + 1, degree + 1))
    coefficients = chebyshev.chebder(np.eye(degree + 1), derivative)
    matrix[: len(coefficients)] = coefficients
    return matrix


def boundary_map(degree: int, orders: tuple[int, ...] = (0, 1, 2)) -> Array:
    """M (2 len(orders), degree + 1) of eq (26) for one axis: takes coefficients to derivatives at s = -1, then s = 1.

    orders: the derivatives, with respect to normalised time.
    """
    ends = np.array([-1.0, 1.0])
    rows = [chebyshev_basis(ends, degree, k) for k in orders]
    return np.concatenate([np.stack([row[0] for row in rows]), np.stack([row[1] for row in rows])])


@dataclass(frozen=True)
class BoundarySolution:
    """All solutions of M a = d: a = particular + null_space z. The minimum-norm one has z = 0."""

    particular: Array
    null_space: Array


def boundary_solution(degree: int, values: npt.ArrayLike, orders: tuple[int, ...] = (0, 1, 2)) -> BoundarySolution:
    """Solve eq (26) for one or more axes: values (2 len(orders), n_axes) with respect to normalised time."""
    matrix, scale, inverse, null_space = _boundary_inverse(degree, orders)
    values = np.asarray(values, dtype=float)
    particular = inverse @ (scale * values)
    particular += inverse @ (scale * (values - matrix @ particular))
    return BoundarySolution(particular, null_space.copy())


@lru_cache(maxsize=64)
def _boundary_inverse(degree: int, orders: tuple[int, ...]) -> tuple[Array, Array, Array, Array]:
    """M of eq (26), the scale of its rows, the pseudoinverse of the scaled M, and its null space."""
    matrix = boundary_map(degree, orders)
    # Rows of derivatives are up to degree^4 larger than those of values; scaled, all are met equally accurately.
    scale = 1 / np.linalg.norm(matrix, axis=1)[:, None]
    left, sizes, v = np.linalg.svd(scale * matrix)
    rank = len(sizes)
    return matrix, scale, v[:rank].T @ (left.T / sizes[:, None]), v[rank:].T


# Gauss-Legendre points and the sixth-order Magnus step (Blanes, Casas, Oteo, Ros, 2009, section 5).
_GAUSS = 0.5 + np.array([-np.sqrt(15) / 10, 0.0, np.sqrt(15) / 10])


def magnus_increment(omega_at_gauss: Array, h: npt.ArrayLike) -> Array:
    """Rotation vectors (..., 3) of steps of R' = R hat(omega) with length h, error O(h^7).

    omega_at_gauss: (..., 3 points, 3) at the three Gauss points of each step.
    """
    h = np.asarray(h, dtype=float)[..., None]
    w1, w2, w3 = (omega_at_gauss[..., i, :] for i in range(3))
    a1, a2, a3 = h * w2, np.sqrt(15) / 3 * h * (w3 - w1), 10 / 3 * h * (w3 - 2 * w2 + w1)
    # For R' = R Omega the commutator has the opposite sign of Y' = Omega Y: [a, b] -> -(a x b).
    c1 = -cross(a1, a2)
    c2 = cross(a1, 2 * a3 + c1) / 60
    return a1 + a3 / 12 - cross(-20 * a1 - a3 + c1, a2 + c2) / 240


def accumulate(R_0: Array, increments: Array) -> Array:
    """Rotations (T + 1, 3, 3) R_0, R_0 Exp(i_0), R_0 Exp(i_0) Exp(i_1), ... from increments (T, 3)."""
    steps = exp(increments)
    rotations = np.empty((len(increments) + 1, 3, 3))
    rotations[0] = current = R_0
    for k, step in enumerate(steps):
        current = current @ step
        rotations[k + 1] = current
    return rotations


ROTATION_STEPS = 128  # Magnus steps of a motion; error below 1e-13 rad for turns up to pi at degree 12


@dataclass(frozen=True)
class PolynomialReference:
    """Position and body angular velocity as Chebyshev series in s = 2 t / T - 1.

    position: (n + 1, 3) m. angular_velocity: (m + 1, 3) rad/s, or None for a fixed orientation.
    """

    duration: float
    R_start: Array
    position: Array
    angular_velocity: Array | None = None

    def sample(self, t: npt.ArrayLike) -> MotionSamples:
        t = np.atleast_1d(np.asarray(t, dtype=float))
        s = np.clip(2 * t / self.duration - 1, -1, 1)
        moving = ((t >= 0) & (t <= self.duration))[:, None]
        rate, degree = 2 / self.duration, len(self.position) - 1
        bases = chebyshev_bases(s, degree, range(3))
        p, v, a = (rate**k * (basis @ self.position) for k, basis in enumerate(bases))
        if self.angular_velocity is None:
            zero = np.zeros_like(p)
            return MotionSamples(t, p, v * moving, a * moving, np.tile(self.R_start, (len(t), 1, 1)), zero, zero)
        m = len(self.angular_velocity) - 1
        bases = chebyshev_bases(s, m, range(2))
        omega, alpha = (rate**k * (basis @ self.angular_velocity) for k, basis in enumerate(bases))
        return MotionSamples(t, p, v * moving, a * moving, self._rotation(s), omega * moving, alpha * moving)

    @cached_property
    def _knots(self) -> tuple[Array, Array]:
        """Rotations at ROTATION_STEPS + 1 equidistant s in [-1, 1]."""
        assert self.angular_velocity is not None
        s = np.linspace(-1, 1, ROTATION_STEPS + 1)
        return s, accumulate(self.R_start, self._increments(s[:-1], s[1:]))

    def _increments(self, s_from: Array, s_to: Array) -> Array:
        assert self.angular_velocity is not None
        points = s_from[:, None] + (s_to - s_from)[:, None] * _GAUSS
        omega = chebyshev_basis(points.ravel(), len(self.angular_velocity) - 1) @ self.angular_velocity
        return magnus_increment(omega.reshape(len(s_from), 3, 3), 0.5 * self.duration * (s_to - s_from))

    def _rotation(self, s: Array) -> Array:
        knots, rotations = self._knots
        below = np.clip(np.searchsorted(knots, s, side="right") - 1, 0, ROTATION_STEPS - 1)
        return rotations[below] @ exp(self._increments(knots[below], s))


def position_boundary(duration: float, p_start: npt.ArrayLike, p_goal: npt.ArrayLike) -> Array:
    """d (6, 3) of eq (26) for a motion from rest to rest, rows as in `boundary_map`."""
    zero = np.zeros(3)
    return np.stack([np.asarray(p_start, float), zero, zero, np.asarray(p_goal, float), zero, zero])


def geodesic_angular_velocity(duration: float, R_start: Array, R_goal: Array) -> Array | None:
    """Chebyshev coefficients (5, 3) of the min-jerk turn about one fixed axis; None if the orientations are equal.

    The quartic 30 u^2 (1 - u)^2 of u = t / T is the derivative of the min-jerk quintic; about a fixed axis
    the angular velocity integrates in closed form, so the goal orientation is met exactly.
    """
    turn = log(R_start.T @ R_goal)
    if np.linalg.norm(turn) < 1e-12:
        return None
    profile = np.array([3 / 8, 0, -4 / 8, 0, 1 / 8]) * 1.875  # (1 - s^2)^2 * 30 / 16 in Chebyshev terms
    return np.outer(profile, turn / duration)


def min_jerk_line(duration: float, p_start: Array, p_goal: Array, R_start: Array, R_goal: Array) -> PolynomialReference:
    """The straight min-jerk line with a min-jerk turn about one axis: the paper's baseline."""
    position = boundary_solution(5, position_boundary(duration, p_start, p_goal)).particular
    return PolynomialReference(duration, R_start, position, geodesic_angular_velocity(duration, R_start, R_goal))


def smooth_step(u: Array, order: int = 0) -> Array:
    """The min-jerk step 10 u^3 - 15 u^4 + 6 u^5 (Flash and Hogan 1985), constant outside [0, 1], or its first or second
    derivative."""
    u = np.clip(u, 0.0, 1.0)
    if order == 0:
        return np.asarray(u**3 * (10 - 15 * u + 6 * u**2))
    return np.asarray(30 * u**2 * (1 - u) ** 2 if order == 1 else 60 * u * (1 - u) * (1 - 2 * u))


@dataclass(frozen=True)
class SampledReference:
    """A piecewise quintic motion through given samples: twice continuously differentiable, exact at the samples."""

    samples: MotionSamples

    @property
    def duration(self) -> float:
        return float(self.samples.t[-1])

    @cached_property
    def _position(self) -> Quintics:
        m = self.samples
        return Quintics.through(m.t, np.stack([m.p_SB, m.v_S, m.a_S]))

    @cached_property
    def _rotation(self) -> Quintics:
        """Rotation vectors from each interval's first sample: (value, rate, acceleration) at both ends."""
        m = self.samples
        theta = log(np.swapaxes(m.R_SB[:-1], 1, 2) @ m.R_SB[1:])
        inverse = right_jacobian_inverse(theta)
        rate = np.einsum("tij,tj->ti", inverse, m.omega_B[1:])
        # alpha = J_r theta'' + J_r' theta'
        bend = np.einsum("tij,tj->ti", inverse, m.alpha_B[1:] - _turning(theta, rate))
        zero = np.zeros_like(theta)
        first, last = np.stack([zero, m.omega_B[:-1], m.alpha_B[:-1]]), np.stack([theta, rate, bend])
        return Quintics(m.t, _quintic_bernstein(first, last, np.diff(m.t)))

    def sample(self, t: npt.ArrayLike) -> MotionSamples:
        m = self.samples
        t = np.atleast_1d(np.asarray(t, dtype=float))
        moving = ((t >= m.t[0]) & (t <= m.t[-1]))[:, None]
        tc = np.clip(t, m.t[0], m.t[-1])
        p, v, a = (self._position.at(tc, k) for k in range(3))
        k = np.clip(np.searchsorted(m.t, tc, side="right") - 1, 0, len(m.t) - 2)
        theta, rate, bend = (self._rotation.at(tc, j) for j in range(3))
        jacobian = np.linalg.inv(right_jacobian_inverse(theta))
        omega = np.einsum("tij,tj->ti", jacobian, rate)
        alpha = np.einsum("tij,tj->ti", jacobian, bend) + _turning(theta, rate)
        return MotionSamples(t, p, v * moving, a * moving, m.R_SB[k] @ exp(theta), omega * moving, alpha * moving)


def _turning(theta: Array, rate: Array) -> Array:
    """(T, 3) J_r' theta' at rotation vectors and their rates (T, 3), by a central difference along theta'."""
    step = 1e-5
    ahead, behind = (np.linalg.inv(right_jacobian_inverse(theta + sign * step * rate)) for sign in (1, -1))
    return np.asarray(np.einsum("tij,tj->ti", (ahead - behind) / (2 * step), rate))


@dataclass(frozen=True, eq=False)
class Quintics:
    """A piecewise quintic polynomial: breaks t (n + 1,), Bernstein coefficients (6, n, d) of the pieces.

    A break belongs to the piece after it. (SciPy's `BPoly` would take a quarter of a second to import.)
    """

    t: Array
    coefficients: Array

    @classmethod
    def through(cls, t: Array, states: Array) -> Quintics:
        """The polynomial with states (3, T, d) at breaks t (T,): value, first and second derivative."""
        return cls(t, _quintic_bernstein(states[:, :-1], states[:, 1:], np.diff(t)))

    def at(self, t: Array, order: int = 0) -> Array:
        """The value, or a derivative, (T, d) at instants (T,) between the first and the last break."""
        return self.several(t, (order,))[0]

    def several(self, t: Array, orders: Sequence[int]) -> list[Array]:
        """Several derivatives, each as from `at`."""
        piece = np.minimum(np.maximum(np.searchsorted(self.t, t, side="right") - 1, 0), len(self.t) - 2)
        before = self.t[piece]
        u = ((t - before) / (self.t[piece + 1] - before))[:, None]
        k = np.arange(len(self.coefficients))
        rising, falling = u**k, (1 - u) ** k[::-1]
        found = []
        for order in orders:
            control = self._by_piece[order]
            weights = _binomial(control.shape[1]) * rising[:, : control.shape[1]] * falling[:, order:]
            found.append((weights[:, None] @ control[piece])[:, 0])
        return found

    @property
    def hulls(self) -> list[Array]:
        """Bernstein coefficients of the value and its first three derivatives, (6, n, d) to (3, n, d).

        In each piece the values lie between the least and the largest (convex hull property; Farin, "Curves and
        Surfaces", section 5.2).
        """
        found, h = [self.coefficients], np.diff(self.t)[:, None]
        for degree in (5, 4, 3):
            found.append((found[-1][1:] - found[-1][:-1]) * (degree / h))
        return found

    @cached_property
    def _by_piece(self) -> list[Array]:
        """`hulls`, piece by piece: (n, ., d)."""
        return [np.ascontiguousarray(np.swapaxes(hull, 0, 1)) for hull in self.hulls]


@lru_cache(maxsize=8)
def _binomial(count: int) -> Array:
    return np.array([float(comb(count - 1, k)) for k in range(count)])


def ways(t: Array, states: Array) -> Array:
    """Upper bounds (T - 1, n) of the distance that each joint travels, back and forth, in each interval of t (T,).

    The motion is one quintic in each interval, with states (3, T, n) q, dq, ddq at t; see `JointMotion.travel`.
    """
    return np.asarray(np.abs(np.diff(Quintics.through(t, states).coefficients, axis=0)).sum(axis=0))


def extremes(hull: Array) -> Array:
    """Least and largest values (2, ...) on [0, 1] of quadratics or cubics with Bernstein coefficients (3 or 4, ...)."""
    if len(hull) == 3:
        a, b, c = hull
        with np.errstate(divide="ignore", invalid="ignore"):
            u = np.clip(np.nan_to_num((a - b) / (a - 2.0 * b + c), nan=0.0), 0.0, 1.0)
        inside = (1 - u) * ((1 - u) * a + 2.0 * u * b) + u * u * c
        return np.array([np.minimum(np.minimum(a, c), inside), np.maximum(np.maximum(a, c), inside)])
    a, b, c = np.diff(hull, axis=0)  # coefficients of the derivative
    bend, turn = a - 2.0 * b + c, np.sqrt(np.maximum(b * b - a * c, 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        # Both roots of bend u^2 + 2 (b - a) u + a, without cancellation.
        most = a - b + np.where(a > b, turn, -turn)
        roots = np.nan_to_num(np.stack([most / bend, a / most]), nan=0.0)
    u = np.clip(roots, 0.0, 1.0)
    v = 1.0 - u
    p, q, r, s = hull
    inside = v * v * (v * p + 3.0 * u * q) + u * u * (3.0 * v * r + u * s)
    return np.array([np.minimum(np.minimum(p, s), inside.min(0)), np.maximum(np.maximum(p, s), inside.max(0))])


def _quintic_bernstein(first: Array, last: Array, h: Array) -> Array:
    """Bernstein coefficients (6, n, d) of quintics with value, first and second derivative (3, n, d) at both ends."""
    h = h[:, None]
    (p0, v0, a0), (p1, v1, a1) = first, last
    found = np.empty((6, *p0.shape))
    found[0], found[5] = p0, p1
    found[1], found[4] = p0 + h * v0 / 5, p1 - h * v1 / 5
    found[2], found[3] = p0 + 2 * h * v0 / 5 + h**2 * a0 / 20, p1 - 2 * h * v1 / 5 + h**2 * a1 / 20
    return found


@dataclass(frozen=True, repr=False)
class JointMotion(Outlined):
    """A joint motion through samples t (T,), q, dq, ddq (T, n), piecewise quintic: s, rad (m for prismatic joints)."""

    t: Array
    q: Array
    dq: Array
    ddq: Array

    @property
    def duration(self) -> float:
        return float(self.t[-1])

    @cached_property
    def _spline(self) -> Quintics:
        return Quintics.through(self.t, np.stack([self.q, self.dq, self.ddq]))

    def sample(self, t: npt.ArrayLike) -> tuple[Array, Array, Array]:
        """q, dq, ddq, each (T, n), at instants t; at rest before the start and after the end."""
        t = np.atleast_1d(np.asarray(t, dtype=float))
        moving = ((t >= self.t[0]) & (t <= self.t[-1]))[:, None]
        tc = np.clip(t, self.t[0], self.t[-1])
        q, dq, ddq = self._spline.several(tc, range(3))
        return q, dq * moving, ddq * moving

    def evenly(self, counts: Indices) -> tuple[Array, Array]:
        """Instants t (P,) and z (4, P, n), q and its first three derivatives there.

        counts: (T - 1,) number of equal steps of each piece. The jerk at a knot is that just after it.
        """
        piece, first = np.repeat(np.arange(len(counts)), counts), np.repeat(np.cumsum(counts) - counts, counts)
        step = (np.diff(self.t) / counts)[piece]
        t = np.append(self.t[piece] + (np.arange(len(piece)) - first) * step, self.t[-1])
        return t, np.stack(self._spline.several(t, range(4)))

    def resampled(self, longest: float) -> JointMotion:
        """The same motion, with more samples where its steps are longer than `longest`, s."""
        counts = np.maximum(1, np.ceil(np.diff(self.t) / longest - 1e-9)).astype(np.intp)
        if counts.max() == 1:
            return self
        t, z = self.evenly(counts)
        return JointMotion(t, *z[:3])

    @cached_property
    def jerk_before(self) -> Array:
        """Jerk (T, n) just before each sample; for the first, just after it."""
        bend = 60.0 * np.diff(self._spline.coefficients, 3, axis=0) / np.diff(self.t)[:, None] ** 3
        return np.concatenate([bend[0, :1], bend[2]])

    def jerk(self, t: npt.ArrayLike) -> Array:
        """Jerk (T, n) at instants t (T,)."""
        tc = np.clip(np.atleast_1d(np.asarray(t, dtype=float)), self.t[0], self.t[-1])
        return self._spline.at(tc, 3)

    def travel(self, t: Array) -> Array:
        """Tight upper bound (T, n) of the distance that each joint has travelled, back and forth, at instants t (T,).

        Between instants a and b no joint moves by more than travel(b) - travel(a), because the control polygon of a
        Bernstein polynomial is at least as long (variation diminishing; Farin, "Curves and Surfaces", section 6.3).
        """
        grid = np.union1d(self.t, np.clip(t, self.t[0], self.t[-1]))
        # q, dq and ddq are continuous at a knot, so that the piece from which they come does not matter.
        steps = ways(grid, np.stack(self._spline.several(grid, range(3))))
        gone = np.vstack([np.zeros(steps.shape[1]), np.cumsum(steps, axis=0)])
        return gone[np.searchsorted(grid, np.clip(t, self.t[0], self.t[-1]))]
