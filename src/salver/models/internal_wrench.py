"""Internal wrenches of objects on several supports: the choice that leaves the largest margin."""

from __future__ import annotations

import numpy as np

from salver.geometry import Array

_COARSE = 25  # instants at which the programme is solved before interpolating between them
_MOST = 200  # further instants solved because the interpolated choice would not hold there


def internal_wrenches(value: Array, internal: Array) -> Array:
    """w_0 (T, n_w) that makes the rows value + internal w_0 (T, n) small.

    value (T, n): rows at w_0 = 0; internal (n, n_w). At the least favourable instants w_0 minimises the largest
    row, by a linear programme; elsewhere it is interpolated (any w_0 that keeps all rows negative proves
    that the objects hold).
    """
    count, n_w = len(value), internal.shape[1]
    if n_w == 0:
        return np.zeros((count, 0))
    knots = np.unique(np.linspace(0, count - 1, min(count, _COARSE)).astype(int))
    solved = {int(k): _least(value[k], internal) for k in knots}

    def interpolated() -> Array:
        at = sorted(solved)
        points = np.array([solved[k] for k in at])
        return np.stack([np.interp(np.arange(count), at, points[:, i]) for i in range(n_w)], axis=1)

    for _ in range(_MOST):
        largest = (value + interpolated() @ internal.T).max(axis=1)
        largest[list(solved)] = -np.inf
        # What matters are instants that fail by interpolation, and the one with the least margin.
        worst = int(np.argmax(largest))
        known = max(float((value[k] + internal @ w_0).max()) for k, w_0 in solved.items())
        if not np.isfinite(largest[worst]) or (largest[worst] <= 0 and largest[worst] <= known):
            break
        solved[worst] = _least(value[worst], internal)
    return interpolated()


def _least(value: Array, internal: Array) -> Array:
    """w_0 that minimises max(value + internal w_0)."""
    from scipy.optimize import linprog

    n_w = internal.shape[1]
    result = linprog(
        np.append(np.zeros(n_w), 1.0),
        A_ub=np.column_stack([internal, -np.ones(len(value))]),
        b_ub=-value,
        bounds=[(None, None)] * (n_w + 1),
        method="highs",
    )
    return np.asarray(result.x[:n_w])
