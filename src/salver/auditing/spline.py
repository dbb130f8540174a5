"""Least-squares quintic splines through samples, with as many knots as the motion needs where it needs them.

Two differentiations turn a micrometre of noise at 1 kHz into metres per second squared, so what is differentiated is a
spline with fewer knots than samples. Knots every 1/(2 f) let through what is slower than f, the *bandwidth*, which may
differ from instant to instant.

At the ends a spline has data on one side only, and its second derivative there is a hundred times less certain.
Many motions start and end at rest: where the samples do not speak against it, rest (no velocity, no acceleration) is
what the end is given.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from scipy import sparse
from scipy.interpolate import BSpline
from scipy.linalg import solveh_banded

from salver.geometry import Array

DEGREE = 5
_RIDGE = 1e-13  # of the largest entry: keeps the equations solvable where a knot has hardly any sample

_END = 2  # knots left out at each end, as in the "not-a-knot" condition: otherwise a fast spline swings there

Rest = tuple[bool, bool]


@dataclass(frozen=True)
class Fit:
    """A spline (d,) through samples. rest: whether it was given rest at (start, end)."""

    spline: BSpline
    rest: Rest

    def __call__(self, t: Array) -> tuple[Array, Array, Array]:
        """Value, first and second derivative (N, d) at times t (N,)."""
        value, rate, bend = (np.asarray(self.spline(t, nu)) for nu in range(3))
        return value, rate, bend

    def spacing(self, t: Array) -> Array:
        """(N,) s between knots: the least of the intervals that hold or neighbour each time."""
        knots = self.spline.t[DEGREE:-DEGREE]
        k = np.clip(np.searchsorted(knots, t, side="right") - 1, 0, len(knots) - 2)
        wide = np.diff(knots)
        return np.asarray(np.minimum.reduce([wide[np.clip(k + j, 0, len(wide) - 1)] for j in (-1, 0, 1)]))

    def acceleration_error(self, t: Array, step: Array | float, bent: bool = False) -> Array:
        """(N,) standard deviation of the second derivative for samples of unit noise every `step` s.

        bent: as if the ends were free and no knots were left out there: noise hides that a motion was bent there, or
        was not at rest.
        """
        knots, h = self.spline.t[DEGREE:-DEGREE], self.spacing(t)
        profiles = [_end_error(False, 0) if bent else _end_error(rest, _END) for rest in self.rest]
        factor = np.maximum(np.interp((t - knots[0]) / h, *profiles[0]), np.interp((knots[-1] - t) / h, *profiles[1]))
        return np.asarray(factor * np.sqrt(step / h) / h**2)


def fit(t: Array, y: Array, bandwidth: Array, rest: Rest = (False, False)) -> Fit:
    """Fit samples y (N, d) at increasing t (N,). bandwidth: (N,) Hz. rest: at (start, end), no velocity and no
    acceleration there."""
    return Fit(_solve(t, y, knots_for(t, bandwidth), rest), rest)


def knots_for(t: Array, bandwidth: Array) -> Array:
    """Clamped knots, 2 f of them a second, each with a sample of its own between it and the next."""
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


def _solve(t: Array, y: Array, knots: Array, rest: Rest) -> BSpline:
    """A clamped spline has no velocity and acceleration at an end
    exactly when its three outermost coefficients are equal; there they are one unknown."""
    design = BSpline.design_matrix(t, knots, DEGREE)
    merge = _merge(design.shape[1], rest)
    reduced = design @ merge
    normal = (reduced.T @ reduced).tocsr()
    banded = np.zeros((DEGREE + 1, normal.shape[0]))
    for k in range(min(DEGREE + 1, normal.shape[0])):
        banded[DEGREE - k, k:] = normal.diagonal(k)
    banded[DEGREE] += _RIDGE * banded[DEGREE].max()
    middle = y.mean(axis=0)
    coefficients = solveh_banded(banded, reduced.T @ (y - middle))
    # One step of refinement takes back what the ridge does.
    coefficients += solveh_banded(banded, reduced.T @ (y - middle - reduced @ coefficients))
    return BSpline(knots, merge @ coefficients + middle, DEGREE)


def _merge(n: int, rest: Rest) -> Any:
    columns = np.arange(n)
    if n < 2 * (DEGREE + 1):
        return sparse.identity(n, format="csr")
    if rest[0]:
        columns = np.maximum(columns - 2, 0)
    if rest[1]:
        columns = np.minimum(columns, columns[-3])
    return sparse.csr_matrix((np.ones(n), (np.arange(n), columns)))


@lru_cache(maxsize=4)
def _end_error(rest: bool, left_out: int) -> tuple[Array, Array]:
    """Standard deviation of the second derivative over the distance from an end, both in units of the spacing h and of
    sqrt(step / h) / h^2 for unit noise: by dense algebra on a long uniform spline without so many knots there."""
    intervals, each = 24, 12
    inner = np.arange(1.0 + left_out, intervals)
    knots = np.concatenate([np.zeros(DEGREE + 1), inner, np.full(DEGREE + 1, float(intervals))])
    t = (np.arange(intervals * each) + 0.5) / each
    merge = _merge(len(knots) - DEGREE - 1, (rest, False)).toarray()
    design = BSpline.design_matrix(t, knots, DEGREE).toarray() @ merge
    at = np.linspace(0.0, 8.0, 161)
    bend = np.asarray(BSpline(knots, merge, DEGREE)(at, 2))
    spread = np.sqrt(np.einsum("ij,jk,ik->i", bend, np.linalg.inv(design.T @ design), bend) * each)
    return at, spread
