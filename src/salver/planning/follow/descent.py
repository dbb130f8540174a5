"""BFGS with backtracking (J. Nocedal and S. Wright, "Numerical Optimization", 2006, algorithms 6.1 and 3.1).

Own code because SciPy takes a tenth of a second to import, a tenth of a short command's time.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from salver.geometry import Array

Slope = Callable[[Array], tuple[float, Array]]  # from x (k,) to a value and its gradient (k,)


def descend(at: Slope, x: Array, steps: int, flat: float) -> Array:
    """Minimise a function from x (k,); returns the last point (k,).

    at: returns the function's value and gradient. x: (k,) the initial point. steps: at most. flat: ends when no entry
    of the gradient exceeds it, or when no step lowers the value.
    """
    value, slope = at(x)
    inverse = np.eye(len(x)) / max(1.0, float(np.linalg.norm(slope)))
    for k in range(steps):
        if not np.abs(slope).max() > flat:
            break
        way = -inverse @ slope
        for share in 0.5 ** np.arange(10.0):
            there, gradient = at(x + share * way)
            if there <= value + 1e-4 * share * float(slope @ way):  # Armijo's condition
                break
        else:
            break
        step, turned = share * way, gradient - slope
        along = float(turned @ step)
        if along > 0.0:  # else the inverse would no longer be positive
            if k == 0:
                inverse = np.eye(len(x)) * along / float(turned @ turned)
            left = np.eye(len(x)) - np.outer(step, turned) / along
            inverse = left @ inverse @ left.T + np.outer(step, step) / along
        x, value, slope = x + step, there, gradient
    return x
