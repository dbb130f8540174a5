"""Initial value problems: an explicit eighth-order Runge-Kutta method with equal steps and dense output.

Dormand and Prince's method with its interpolant (Hairer, Norsett, Wanner, Solving Ordinary Differential
Equations I, 1993, section II.5), with SciPy's coefficients. SciPy's own driver chooses the steps by the error of one
state; here many states are integrated together, and the reference is sampled for all stages in one call.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
from scipy.integrate import DOP853

from salver.geometry import Array

Rate = Callable[[int, Array], Array]  # (index of an instant, state) to the derivative of the state
_NODES = np.concatenate([DOP853.C, DOP853.C_EXTRA, [1.0]])  # stages of a step, stages of the interpolant, end


def integrate(
    rates_at: Callable[[Array], Rate],
    state: Array,
    start: float,
    t: Array,
    max_step: float,
    corners: Sequence[float] = (),
) -> Array:
    """States (T, ...) at increasing instants t (T,) >= start, from `state` (...) at `start`.

    rates_at: called once with all instants (K,) of the stages, so that it can sample what depends on time alone;
        returns the function of (k, state) that evaluates the derivative of the state at instant k.
    corners: instants at which the derivative is not smooth; steps end there.
    A state that diverges is NaN from then on.
    """
    inside = sorted({c for c in corners if start < c < t[-1]})
    pieces = [
        np.linspace(a, b, int(np.ceil((b - a) / max_step)) + 1)[1:] for a, b in pairwise([start, *inside, float(t[-1])])
    ]
    grid = np.concatenate([[start], *pieces])
    steps = np.diff(grid)
    # Rounding must not put a stage after the end of its step: a sample there may belong to the next piece.
    instants = np.minimum(grid[:-1, None] + steps[:, None] * _NODES, grid[1:, None])
    rate = rates_at(instants.ravel())

    out = np.empty((len(t), *state.shape))
    out[t == start] = state
    slope = rate(0, state) if len(steps) else state
    for k, h in enumerate(steps):
        first = k * len(_NODES)
        slopes = [slope]
        for i in range(1, DOP853.n_stages):
            slopes.append(rate(first + i, state + h * _combine(DOP853.A[i], slopes)))
        end = state + h * _combine(DOP853.B, slopes)
        if not np.isfinite(end).any():  # all states have diverged
            out[t > grid[k]] = np.nan
            break
        slope = rate(first + len(_NODES) - 1, end)
        rows = np.flatnonzero((t > grid[k]) & (t <= grid[k + 1]))
        out[rows[t[rows] == grid[k + 1]]] = end
        rows = rows[t[rows] < grid[k + 1]]
        if len(rows):
            slopes.append(slope)
            for i, weights in enumerate(DOP853.A_EXTRA, start=DOP853.n_stages):
                slopes.append(rate(first + i, state + h * _combine(weights, slopes)))
            parts = _interpolant(end - state, slopes, h)
            for row in rows:
                out[row] = state + _evaluate(parts, (t[row] - grid[k]) / h)
        state = end
    return out


def _combine(weights: Array, slopes: Sequence[Array]) -> Array:
    return sum((w * slope for w, slope in zip(weights, slopes, strict=False) if w), start=np.zeros_like(slopes[0]))


def _interpolant(change: Array, slopes: Sequence[Array], h: float) -> list[Array]:
    """Terms of the seventh-order interpolant of a step, from its slopes."""
    first, last = h * slopes[0], h * slopes[DOP853.n_stages]
    return [change, first - change, 2 * change - (last + first), *(h * _combine(row, slopes) for row in DOP853.D)]


def _evaluate(parts: Sequence[Array], share: float) -> Array:
    """Change of the state after a share (0 to 1) of the step."""
    value = np.zeros_like(parts[0])
    for i, part in enumerate(reversed(parts)):
        value = (value + part) * (share if i % 2 == 0 else 1 - share)
    return value
