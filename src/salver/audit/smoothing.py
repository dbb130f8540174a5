"""Position, velocity and acceleration from noisy, unevenly spaced samples: least-squares quintic splines.

Two differentiations turn a micrometre of noise at 1 kHz into metres per second squared, so what is differentiated is
a spline with far fewer knots than samples. Knots every 1/(2 f) let through what is slower than f, the
*bandwidth*. Which f: the one that generalised cross-validation picks (Craven and Wahba 1979; the coarsest within
2 % of the best), or the user's. Samples without noise are followed closely; noisy ones are not.

At the ends a spline has data on one side only, and its second derivative there is a hundred times less certain.
Most motions start and end at rest: where the samples do not speak against it, rest (no velocity, no acceleration) is
what the end is given.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse
from scipy.interpolate import BSpline
from scipy.linalg import solveh_banded
from scipy.special import chdtri

from salver.errors import SalverError
from salver.geometry import Array

DEGREE = 5
_STEP = 2**0.5  # ratio of neighbouring bandwidths on the ladder
_TOLERANCE = 1.02  # of the cross-validation score: prefer the smoother of two that are equally good
_PATIENCE = 4  # rungs of the ladder without improvement before it is left
_DENSEST = 0.7  # knots per sample, at most
_AGAINST_REST = 1e-3  # probability under which the samples speak against rest at an end

Rest = tuple[bool, bool]


@dataclass(frozen=True)
class Smooth:
    """A smooth curve through samples. spline: t -> (..., d). bandwidth: Hz. rest: at (start, end).

    noise: standard deviation of a sample about the curve, in its unit. acceleration_noise: what that noise
    leaves in the second derivative (standard deviation, mid-motion), unit/s^2.
    """

    spline: BSpline
    bandwidth: float
    noise: float
    acceleration_noise: float
    rest: Rest

    def __call__(self, t: Array) -> tuple[Array, Array, Array]:
        """Value, first and second derivative (N, d) at times t (N,)."""
        value, rate, bend = (np.asarray(self.spline(t, nu)) for nu in range(3))
        return value, rate, bend


def smooth(t: Array, y: Array, bandwidth: float | None = None) -> Smooth:
    """Fit samples y (N, d) at increasing t (N,). bandwidth: Hz, or None to find it from the data.

    Raises SalverError when the samples are too few for the bandwidth.
    """
    if bandwidth is not None:
        knots = _knots(t, bandwidth)
        if knots is None:
            highest = 0.5 * (_DENSEST * len(t) - DEGREE) / (t[-1] - t[0])
            raise SalverError(
                f"A bandwidth of {bandwidth:g} Hz was asked for; {len(t)} samples in {t[-1] - t[0]:.3g} s allow more "
                f"than 0 and less than {highest:.3g} Hz."
            )
        return _finish(t, y, knots, bandwidth)
    # Scores at the level of rounding are all as good as zero.
    floor = (1e-12 * (1 + np.abs(y).max())) ** 2
    fits: list[tuple[float, float, Array]] = []
    frequency, best, stale = max(1.0, 1 / (t[-1] - t[0])), np.inf, 0
    while stale < _PATIENCE and best > floor and (knots := _knots(t, frequency)) is not None:
        score = _cross_validation(t, y, knots)
        fits.append((score, frequency, knots))
        stale = 0 if score < best / _TOLERANCE else stale + 1
        best = min(best, score)
        frequency *= _STEP
    if not fits:
        frequency = 0.5 / (t[-1] - t[0])
        return _finish(t, y, np.repeat([t[0], t[-1]], DEGREE + 1), frequency)
    _, frequency, knots = next(fit for fit in fits if fit[0] <= max(_TOLERANCE * best, floor))
    return _finish(t, y, knots, frequency)


def _knots(t: Array, frequency: float) -> Array | None:
    """Clamped knots every 1/(2 f), leaving out those without two samples between them; None if too dense."""
    if not frequency > 0:
        return None
    intervals = max(1, int(np.ceil(2 * frequency * (t[-1] - t[0]))))
    if intervals + DEGREE > _DENSEST * len(t):
        return None
    inner = np.linspace(t[0], t[-1], intervals + 1)[1:-1]
    kept, last = [], 0
    for knot, count in zip(inner, np.searchsorted(t, inner), strict=True):
        if count - last >= 2 and len(t) - count >= 2:
            kept.append(knot)
            last = int(count)
    return np.concatenate([np.full(DEGREE + 1, t[0]), kept, np.full(DEGREE + 1, t[-1])])


def _cross_validation(t: Array, y: Array, knots: Array) -> float:
    residual = y - _fit(t, y, knots).spline(t)
    share = (len(knots) - DEGREE - 1) / len(t)
    return float(np.mean(residual**2) / (1 - share) ** 2)


@dataclass(frozen=True)
class _Fit:
    """Least squares with its normal equations, of the coefficients that `merge` leaves free."""

    spline: BSpline
    merge: Any
    banded: Array

    def squares(self, t: Array, y: Array) -> float:
        return float(np.sum((y - self.spline(t)) ** 2))


def _fit(t: Array, y: Array, knots: Array, rest: Rest = (False, False)) -> _Fit:
    """A clamped spline has no velocity and acceleration at an end exactly when its three outermost coefficients are
    equal; there they are one unknown."""
    design = BSpline.design_matrix(t, knots, DEGREE)
    n = design.shape[1]
    merge = _merge(n, rest)
    reduced = design @ merge
    normal = (reduced.T @ reduced).tocsr()
    banded = np.zeros((DEGREE + 1, normal.shape[0]))
    for k in range(DEGREE + 1):
        banded[DEGREE - k, k:] = normal.diagonal(k)
    coefficients = merge @ solveh_banded(banded, reduced.T @ y)
    return _Fit(BSpline(knots, coefficients, DEGREE), merge, banded)


def _merge(n: int, rest: Rest) -> Any:
    columns = np.arange(n)
    if rest[0]:
        columns = np.maximum(columns - 2, 0)
    if rest[1]:
        columns = np.minimum(columns, columns[-3])
    return sparse.csr_matrix((np.ones(n), (np.arange(n), columns)))


def _finish(t: Array, y: Array, knots: Array, frequency: float) -> Smooth:
    free = _fit(t, y, knots)
    squares, d = free.squares(t, y), y.shape[1]
    freedom = d * max(1, len(t) - (len(knots) - DEGREE - 1))
    allowed = max(squares / freedom * chdtri(2 * d, _AGAINST_REST), len(t) * d * (1e-12 * (1 + np.abs(y).max())) ** 2)
    start, end = (
        bool(_fit(t, y, knots, rest).squares(t, y) - squares <= allowed) for rest in ((True, False), (False, True))
    )
    fit = _fit(t, y, knots, (start, end))
    noise = float(np.sqrt(squares / freedom))
    return Smooth(fit.spline, frequency, noise, noise * _acceleration_gain(t, knots, fit), (start, end))


def _acceleration_gain(t: Array, knots: Array, fit: _Fit) -> float:
    """Standard deviation of the second derivative, mid-motion, for samples of unit noise."""
    middle = np.linspace(0.4, 0.6, 41) * (t[-1] - t[0]) + t[0]
    bend = _bend_rows(knots, middle) @ fit.merge
    return float(np.sqrt(np.einsum("mn,nm->m", bend, solveh_banded(fit.banded, bend.T)).mean()))


def _bend_rows(knots: Array, at: Array) -> Array:
    """(m, n) second derivatives of all basis functions at few instants: only six are not zero at each."""
    n = len(knots) - DEGREE - 1
    rows = np.zeros((len(at), n))
    for i, x in enumerate(at):
        last = int(np.clip(np.searchsorted(knots, x, side="right") - 1, DEGREE, n - 1))
        for j in range(last - DEGREE, last + 1):
            rows[i, j] = BSpline.basis_element(knots[j : j + DEGREE + 2], extrapolate=False)(x, 2)
    return rows


def gaps(t: Array) -> tuple[float, float]:
    """(longest time between two samples, when it begins), s."""
    step = np.diff(t)
    k = int(np.argmax(step))
    return float(step[k]), float(t[k])
