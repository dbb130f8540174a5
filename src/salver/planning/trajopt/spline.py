"""Joint motions from rest to rest as clamped B-splines in normalised time s = t / T, T itself a variable.

The three outermost control points coincide at each end, so velocity and acceleration vanish there whatever
the other coefficients are; inside, the motion of degree p has p - 1 continuous derivatives.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from salver.geometry import Array

DERIVATIVES = 4  # position, velocity, acceleration, jerk


@dataclass(frozen=True)
class RestSpline:
    """Basis of rest-to-rest motions: rows of coefficients are (start, interior..., goal) postures.

    degree: of the polynomial pieces, at least 4. spans: number of pieces. crowding: in [0, 1): share by which pieces at
    the ends are shorter than the average, because acceleration builds up from zero there.
    """

    degree: int
    spans: int
    crowding: float = 0.7

    @property
    def size(self) -> int:
        """Number of coefficient rows."""
        return self.spans + self.degree - 4

    def breaks(self) -> Array:
        """Breakpoints (spans + 1,) between the pieces, 0 and 1 included."""
        x = np.linspace(0.0, 1.0, self.spans + 1)
        return np.clip(x - self.crowding * np.sin(2 * np.pi * x) / (2 * np.pi), 0.0, 1.0)

    def knots(self) -> Array:
        return np.concatenate([np.zeros(self.degree), self.breaks(), np.ones(self.degree)])

    def nodes(self, per_span: int) -> Array:
        """Points (spans * per_span + 5,): equally many in each piece, and two more next to each end."""
        breaks = self.breaks()
        inner = np.interp(np.arange(self.spans * per_span + 1) / per_span, np.arange(self.spans + 1), breaks)
        first = np.array([0.05, 0.4]) * inner[1]  # torque builds up fastest out of rest
        return np.unique(np.concatenate([inner, first, 1 - first]))

    def matrices(self, s: Array) -> Array:
        """The basis at s in [0, 1] and its first three derivatives by s, (4, len(s), size)."""
        return _matrices(self, np.asarray(s, dtype=float).tobytes())

    def fit(self, s: Array, q: Array) -> Array:
        """Coefficients (size, n) of the least-squares fit to postures q (len(s), n), exact at both ends."""
        basis = self.matrices(s)[0]
        ends = np.stack([q[0], q[-1]])
        rest = q - basis[:, [0, -1]] @ ends
        inner = np.linalg.lstsq(basis[:, 1:-1], rest, rcond=None)[0]
        return np.vstack([ends[:1], inner, ends[1:]])


@lru_cache(maxsize=16)
def _matrices(spline: RestSpline, points: bytes) -> Array:
    """`RestSpline.matrices`, cached because searches need the same ones repeatedly."""
    rows = b_splines(spline.knots(), spline.degree, np.frombuffer(points), DERIVATIVES)
    merged = rows[:, :, 2:-2].copy()
    merged[:, :, 0] += rows[:, :, 0] + rows[:, :, 1]
    merged[:, :, -1] += rows[:, :, -1] + rows[:, :, -2]
    merged.setflags(write=False)
    return merged


def b_splines(knots: Array, degree: int, s: Array, derivatives: int) -> Array:
    """All B-splines over clamped knots at s within them, and their derivatives below an order, as (derivatives, len(s),
    len(knots) - degree - 1); by the recursions of de Boor (A Practical Guide to Splines, 1978, chapter X).

    Own code because importing SciPy takes longer than everything that is done with them.
    """
    last = len(knots) - degree - 2  # index of the last piece that is not empty
    piece = np.clip(np.searchsorted(knots, s, side="right") - 1, degree, last)
    found = (piece[:, None] == np.arange(len(knots) - 1)).astype(float)
    by_degree = [found]
    for d in range(1, degree + 1):
        rising = (s[:, None] - knots[:-d]) * _over(knots, d)
        found = rising[:, :-1] * found[:, :-1] + (1 - rising[:, 1:]) * found[:, 1:]
        by_degree.append(found)
    rows, slopes = [found], np.eye(found.shape[1])
    for d in range(degree, degree - derivatives + 1, -1):
        each = np.diag(d * _over(knots, d))
        slopes = (each[:, :-1] - each[:, 1:]) @ slopes  # degree d from degree d - 1
        rows.append(by_degree[d - 1] @ slopes)
    return np.stack(rows)


def _over(knots: Array, d: int) -> Array:
    """1 / (t_(i+d) - t_i), 0 where knots coincide."""
    apart = knots[d:] - knots[:-d]
    return np.divide(1.0, apart, out=np.zeros_like(apart), where=apart > 0)


@dataclass(frozen=True)
class SplineMotion:
    """A spline with coefficients (size, m) in normalised time, and its duration in s."""

    spline: RestSpline
    coefficients: Array
    duration: float
