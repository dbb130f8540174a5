"""A zero of a function of one variable.

SciPy 1.15 has this method, `scipy.optimize.elementwise.find_root`; its import takes longer than planning the paper's
motion.
"""

from __future__ import annotations

import math
from collections.abc import Callable


def zero_between(value: Callable[[float], float], low: float, high: float, tolerance: float) -> float:
    """A zero of a continuous function between two arguments at which its signs differ, or where its sign changes, by
    Chandrupatla's method (1997): inverse quadratic interpolation where it is sound, else bisection.

    tolerance: largest error of the zero, absolute. Raises ArithmeticError for a value that is no number.
    """

    def valued(x: float) -> float:
        found = value(x)
        if math.isnan(found):
            raise ArithmeticError(f"The function has no value at {x:g}.")
        return found

    x1, f1, x2, f2, share = low, valued(low), high, valued(high), 0.5
    while f1 != 0 and f2 != 0 and tolerance < abs(x2 - x1):
        x = x1 + share * (x2 - x1)
        f = valued(x)
        if (f < 0) == (f1 < 0):
            x3, f3 = x1, f1
        else:
            x3, f3, x2, f2 = x2, f2, x1, f1
        x1, f1 = x, f
        sound, turned = (x1 - x2) / (x3 - x2), (f1 - f2) / (f3 - f2)
        share = 0.5
        if turned**2 < sound and (1 - turned) ** 2 < 1 - sound:
            share = f1 / (f2 - f1) * f3 / (f2 - f3) + (x3 - x1) / (x2 - x1) * f1 / (f3 - f1) * f2 / (f3 - f2)
        least = min(0.5, 0.5 * tolerance / abs(x2 - x1))
        share = min(1 - least, max(least, share))
    return x1 if abs(f1) < abs(f2) else x2
