"""The closed loop's error dynamics as an exact linear filter: e'' + kd e' + kp e = D(t), at rest at t = 0.

With the transported errors of docs/conventions.md the loop of object and controller is linear and
time-invariant, so the state sensitivity is this filter's answer to the inertial regressor along the
reference: no variational differential equation is integrated. D is known at any instant, so each step
of the grid is the exact matrix exponential with Gauss quadrature of the input: sixth order.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.linalg import expm
from scipy.linalg.lapack import dtbtrs

from salver.geometry import Array

_GAUSS_POINTS = 0.5 + 0.5 * np.polynomial.legendre.leggauss(3)[0]
_GAUSS_WEIGHTS = 0.5 * np.polynomial.legendre.leggauss(3)[1]
_LARGEST_STEP = 0.35  # of the fastest rate times h: the quadrature's relative error is then below 1e-8


def fastest_rate(kp: float, kd: float) -> float:
    """Largest modulus of the poles of e'' + kd e' + kp e, 1/s."""
    return float(np.abs(np.roots([1.0, kd, kp])).max())


@dataclass(frozen=True)
class QuadratureGrid:
    """A uniform grid t (T,) and the instants between its points at which inputs are needed.

    times: (Q,) with Q = (T - 1) * per_interval; substeps of equal length, three Gauss points in each.
    weights: (Q,) such that sum(weights * f(times)) integrates f from t[0] to t[-1].
    """

    t: Array
    substeps: int

    @classmethod
    def for_gains(cls, t: Array, gains: Iterable[tuple[float, float]]) -> QuadratureGrid:
        """A grid fine enough for filters with these (kp, kd)."""
        h = t[1] - t[0]
        return cls(t, max(1, int(np.ceil(max(fastest_rate(*pair) for pair in gains) * h / _LARGEST_STEP))))

    @property
    def per_interval(self) -> int:
        return 3 * self.substeps

    @property
    def fractions(self) -> Array:
        """(per_interval,) where in an interval the instants lie, in [0, 1]."""
        return ((np.arange(self.substeps)[:, None] + _GAUSS_POINTS) / self.substeps).ravel()

    @property
    def times(self) -> Array:
        h = self.t[1] - self.t[0]
        return (self.t[:-1, None] + h * self.fractions).ravel()

    @property
    def interval_weights(self) -> Array:
        """(per_interval,) quadrature weights inside one interval, s."""
        return np.tile(_GAUSS_WEIGHTS, self.substeps) * (self.t[1] - self.t[0]) / self.substeps

    def cumulative(self, values: Array) -> tuple[Array, Array]:
        """Running integrals of values (Q, ...) from t[0]: at the grid (T, ...) and at `times` (Q, ...).

        Inside a substep the integral of the quadratic through its three Gauss points is used.
        """
        h = (self.t[1] - self.t[0]) / self.substeps
        blocks = values.reshape(-1, 3, *values.shape[1:])
        steps = h * np.einsum("g,bg...->b...", _GAUSS_WEIGHTS, blocks)
        ends = np.concatenate([np.zeros((1, *values.shape[1:])), np.cumsum(steps, axis=0)])
        inside = ends[:-1, None] + h * np.einsum("ig,bg...->bi...", _PARTIAL, blocks)
        return ends[:: self.substeps], inside.reshape(values.shape)


def _partial_weights() -> Array:
    """(3, 3): integrals from 0 to Gauss point i of the Lagrange polynomial of Gauss point g on [0, 1]."""
    vandermonde = np.vander(_GAUSS_POINTS, increasing=True)
    integrals = np.stack([_GAUSS_POINTS ** (k + 1) / (k + 1) for k in range(3)], axis=1)
    return np.asarray(np.linalg.solve(vandermonde.T, integrals.T).T, dtype=float)


_PARTIAL = _partial_weights()


@dataclass(frozen=True)
class ErrorFilter:
    """e'' + kd e' + kp e = D on a quadrature grid, from rest."""

    grid: QuadratureGrid
    kp: float
    kd: float

    def respond(self, forcing: Array) -> tuple[Array, Array]:
        """(e, e') at the grid, each (T, ...), for forcing (Q, ...) at the grid's `times`."""
        shape = (len(self.grid.t), *forcing.shape[1:])
        if forcing.size == 0:  # no parameter or no variable: LAPACK writes out of bounds for no columns
            return np.zeros(shape), np.zeros(shape)
        h = float(self.grid.t[1] - self.grid.t[0])
        step, gain = _exact_step(self.kp, self.kd, h, self.grid.substeps)
        b = gain @ forcing.reshape(len(self.grid.t) - 1, self.grid.per_interval, -1)
        # (z - A)^-1 = (z - tr A + A) / (z^2 - tr A z + det A): a recursion along time, a banded triangular system.
        trace, determinant = np.trace(step), np.linalg.det(step)
        ahead = np.concatenate([b, np.zeros((1, *b.shape[1:]))])
        behind = (step - trace * np.eye(2)) @ ahead
        ahead[1:] += behind[:-1]
        x = np.zeros_like(ahead)
        bands = np.array([[1.0], [-trace], [determinant]]) * np.ones(len(b))
        right = np.asfortranarray(ahead[:-1].reshape(len(b), -1))
        x[1:] = dtbtrs(bands, right, uplo="L", overwrite_b=True)[0].reshape(b.shape)
        return x[:, 0].reshape(shape), x[:, 1].reshape(shape)


@lru_cache(maxsize=64)
def _exact_step(kp: float, kd: float, h: float, substeps: int) -> tuple[Array, Array]:
    """A (2, 2) of one grid interval of length h, and B (2, per_interval) from the input inside it."""
    grid = QuadratureGrid(np.array([0.0, h]), substeps)
    dynamics = np.array([[0.0, 1.0], [-kp, -kd]])
    remaining = h * (1 - np.append(0.0, grid.fractions))
    transition = expm(dynamics * remaining[:, None, None])
    return transition[0], transition[1:, :, 1].T * grid.interval_weights
