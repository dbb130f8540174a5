"""A zero of a function of one variable, without SciPy's `optimize`, whose import takes longer than planning the paper's
motion."""

from __future__ import annotations

import math
from collections.abc import Callable


def zero_between(value: Callable[[float], float], low: float, high: float, tolerance: float) -> float:
    """A zero of a continuous function between two arguments at which its signs differ, by Ridders' method (1979).

    tolerance: largest error of the zero, absolute. Each round at least halves the bracket.
    """
    at_low, at_high, before = value(low), value(high), math.inf
    while True:
        middle = 0.5 * (low + high)
        at_middle = value(middle)
        if at_middle == 0:
            return middle
        share = at_middle / math.sqrt(at_middle**2 - at_low * at_high)
        zero = middle + (middle - low) * math.copysign(1.0, at_low - at_high) * share
        if abs(zero - before) <= tolerance or abs(high - low) <= tolerance:
            return zero
        at_zero, before = value(zero), zero
        if at_zero == 0:
            return zero
        ends = (middle, at_middle), (low, at_low), (high, at_high)
        low, at_low = next(end for end in ends if (end[1] < 0) != (at_zero < 0))
        high, at_high = zero, at_zero
