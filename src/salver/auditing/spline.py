"""Least-squares quintic splines through samples, with a bandwidth that varies over time.

Two differentiations turn a micrometre of noise at 1 kHz into metres per second squared; therefore a spline with fewer
knots than samples is differentiated. Knots every 1/(2 f) s pass frequencies below f, the *bandwidth*. At the ends a
spline has data on one side only, and its second derivative is a hundred times less certain.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg import solveh_banded

from salver.geometry import Array

DEGREE = 5
_END = 2  # knots left out at each end, as in the "not-a-knot" condition, to prevent oscillation there


@dataclass(frozen=True)
class Fit:
    """A fitted spline with values (d,)."""

    spline: BSpline

    def __call__(self, t: Array) -> tuple[Array, Array, Array]:
        """Value, first and second derivative (N, d) at times t (N,)."""
        value, rate, bend = (np.asarray(self.spline(t, nu)) for nu in range(3))
        return value, rate, bend

    def spacing(self, t: Array) -> Array:
        """Distance between knots (N,) at times t, s: the least of the interval at each time and its neighbours."""
        knots = self.spline.t[DEGREE:-DEGREE]
        k = np.clip(np.searchsorted(knots, t, side="right") - 1, 0, len(knots) - 2)
        wide = np.diff(knots)
        return np.asarray(np.minimum.reduce([wide[np.clip(k + j, 0, len(wide) - 1)] for j in (-1, 0, 1)]))

    def acceleration_error(self, t: Array, step: Array | float) -> Array:
        """Standard deviation (N,) of the second derivative for unit noise in samples every `step` s; at the ends as if
        no knots were left out, because noise may hide an acceleration there."""
        knots, h = self.spline.t[DEGREE:-DEGREE], self.spacing(t)
        factor = np.interp(np.minimum(t - knots[0], knots[-1] - t) / h, *_end_error())
        return np.asarray(factor * np.sqrt(step / h) / h**2)


def fit(t: Array, y: Array, bandwidth: Array) -> Fit:
    """Fit samples y (N, d) at increasing t (N,). bandwidth: (N,) Hz."""
    knots = knots_for(t, bandwidth)
    design = BSpline.design_matrix(t, knots, DEGREE)
    normal = (design.T @ design).tocsr()
    banded = np.zeros((DEGREE + 1, normal.shape[0]))
    for k in range(min(DEGREE + 1, normal.shape[0])):
        banded[DEGREE - k, k:] = normal.diagonal(k)
    banded[DEGREE] += 1e-13 * banded[DEGREE].max()  # keeps it solvable with few samples at a knot
    middle = y.mean(axis=0)
    coefficients = solveh_banded(banded, design.T @ (y - middle))
    # One step of iterative refinement removes the effect of the ridge.
    coefficients += solveh_banded(banded, design.T @ (y - middle - design @ coefficients))
    return Fit(BSpline(knots, coefficients + middle, DEGREE))


def knots_for(t: Array, bandwidth: Array) -> Array:
    """Clamped knots, 2 f of them a second, with at least one sample between neighbours."""
    passed = np.concatenate([[0.0], np.cumsum((bandwidth[1:] + bandwidth[:-1]) * np.diff(t))])
    intervals = max(1, int(np.ceil(passed[-1] - 1e-9)))
    inner = np.interp(np.arange(1, intervals) * (passed[-1] / intervals), passed, t)
    place = np.searchsorted(t, inner)
    own = np.diff(place, prepend=0, append=len(t))
    if len(inner) and own.min() == 0:
        inner = inner[own[:-1] > 0]
    inner = inner[_END:-_END]
    most = len(t) - DEGREE - 1
    if len(inner) > most:
        inner = inner[np.linspace(0, len(inner) - 1, max(most, 0)).astype(int)]
    return np.concatenate([np.full(DEGREE + 1, t[0]), inner, np.full(DEGREE + 1, t[-1])])


@cache
def _end_error() -> tuple[Array, Array]:
    """Distances from an end, in knot spacings h, and the standard deviation of the second derivative there for unit
    noise, in units of sqrt(step / h) / h^2; from a long uniform spline."""
    intervals, each = 24, 12
    knots = np.pad(np.arange(intervals + 1.0), DEGREE, mode="edge")
    t = (np.arange(intervals * each) + 0.5) / each
    design = BSpline.design_matrix(t, knots, DEGREE).toarray()
    at = np.linspace(0.0, 8.0, 161)
    bend = np.asarray(BSpline(knots, np.eye(design.shape[1]), DEGREE)(at, 2))
    spread = np.sqrt(np.einsum("ij,jk,ik->i", bend, np.linalg.inv(design.T @ design), bend) * each)
    return at, spread
