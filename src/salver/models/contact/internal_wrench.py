"""Internal wrenches of objects on several supports, chosen for the largest margin."""

from __future__ import annotations

import numpy as np

from salver.geometry import Array, interpolated


def internal_wrenches(value: Array, internal: Array, first: int = 25, further: int = 200) -> Array:
    """Internal wrenches w_0 (T, n_w) that make the rows value + internal w_0 (T, n) small.

    value (T, n): rows at w_0 = 0; internal (n, n_w). At some instants, among them the worst one and the first that
    fails, a linear programme minimises the largest row: at `first` ones, evenly, and at most at `further` ones at which
    the interpolated choice fails. Elsewhere w_0 is interpolated. Any w_0 with negative rows proves that the objects
    hold.
    """
    count, n_w = len(value), internal.shape[1]
    if n_w == 0:
        return np.zeros((count, 0))
    knots = np.unique(np.linspace(0, count - 1, min(count, first)).astype(int))
    solved = {int(k): _least(value[k], internal) for k in knots}

    def between() -> Array:
        at = sorted(solved)
        return interpolated(np.array(at), np.array([solved[k] for k in at]), np.arange(count, dtype=float))

    def largest(k: int) -> float:
        return float((value[k] + internal @ solved[k]).max())

    for _ in range(further):
        seen = (value + between() @ internal.T).max(axis=1)
        worst, known = int(np.argmax(seen)), max(largest(k) for k in solved)
        failing = np.flatnonzero(seen > 0)
        if worst not in solved and seen[worst] > max(known, 0.0):
            solved[worst] = _least(value[worst], internal)  # the least margin must be exact
        elif len(failing) and failing[0] not in solved:
            solved[int(failing[0])] = _least(value[failing[0]], internal)  # and the first instant without one
        else:
            break
    return between()


def _least(value: Array, internal: Array) -> Array:
    """w_0 that minimises max(value + internal w_0)."""
    from scipy.optimize import linprog

    cost = np.append(np.zeros(internal.shape[1]), 1.0)
    rows = np.column_stack([internal, -np.ones(len(value))])
    result = linprog(cost, A_ub=rows, b_ub=-value, bounds=(None, None), method="highs")
    return np.asarray(result.x[:-1])
