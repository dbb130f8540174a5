"""Tubes around nominal quantities: paper, eqs (8) to (12).

All are first order: the quantity is assumed linear in the parameters over their set. Under this assumption the box
radius is the exact bound over the box (8), and the ellipsoid radius the exact bound over the ellipsoid; the paper uses
the latter for the box, which is too small if more than one parameter varies.
"""

from __future__ import annotations

import numpy as np

from salver.geometry import Array
from salver.models.uncertain.parameters import UncertainSet, support


def radius(sensitivity: Array, uncertain: UncertainSet) -> Array:
    """Half-width (...) of the tube of quantities with sensitivity (..., n_p) over a box or an ellipsoid: eq (11).

    Box: sum_j |s_j| delta_j. Ellipsoid: sqrt(s W s^T).
    """
    return support(sensitivity * uncertain.half_range, uncertain.spread)


def excess(values: Array, nominal: Array, tube_radius: Array) -> Array:
    """Distance of values (..., T, c) outside the tubes nominal +- radius of eq (12), each (T, c); negative inside."""
    return np.asarray(np.abs(values - nominal) - tube_radius)


def ellipsoid(sensitivity: Array, uncertain: UncertainSet) -> Array:
    """Shape matrix S W S^T (..., n, n) of eqs (9), (10): deviations d with d^T (S W S^T)^-1 d <= 1."""
    spread = sensitivity @ uncertain.factor
    return spread @ np.swapaxes(spread, -1, -2)
