"""Tubes around nominal quantities: paper, eqs (8) to (12). No dynamics here.

All are first order: the quantity is taken as linear in the parameters over their set. Within that, the
box radius is the exact bound over the box (8) and the ellipsoid radius the exact bound over the ellipsoid;
the paper uses the latter for the former, which is too small as soon as two parameters vary together.
"""

from __future__ import annotations

import numpy as np

from salver.geometry import Array
from salver.models.parameters import UncertainSet


def radius(sensitivity: Array, uncertain: UncertainSet) -> Array:
    """Half-width (...) of the tube of quantities with sensitivity (..., n_p): eq (11), of the set's own kind.

    Box: sum_j |s_j| delta_j. Ellipsoid: sqrt(s W s^T).
    """
    if uncertain.size == 0:
        return np.zeros(sensitivity.shape[:-1])
    if uncertain.kind == "box":
        return np.abs(sensitivity) @ uncertain.half_range
    return np.linalg.norm(sensitivity @ uncertain.factor, axis=-1)


def envelope(nominal: Array, tube_radius: Array) -> tuple[Array, Array]:
    """Lower and upper bound of eq (12)."""
    return nominal - tube_radius, nominal + tube_radius


def ellipsoid(sensitivity: Array, uncertain: UncertainSet) -> Array:
    """Shape matrix S W S^T (..., n, n) of eqs (9), (10): deviations d with d^T (S W S^T)^-1 d <= 1."""
    spread = sensitivity @ uncertain.factor
    return spread @ np.swapaxes(spread, -1, -2)


def direction_radius(sensitivity: Array, uncertain: UncertainSet, direction: Array) -> Array:
    """Half-width (...) of the tube along a direction (n,) of a quantity with sensitivity (..., n, n_p): eq (11)."""
    return radius(np.einsum("i,...ij->...j", direction, sensitivity), uncertain)


def scalar_sensitivity(
    by_state: Array,
    state_sensitivity: Array,
    by_input: Array | None = None,
    input_sensitivity: Array | None = None,
    by_parameter: Array | None = None,
) -> Array:
    """dc/dp (T, n_p) = c_x Pi + c_u Theta + c_p of any scalar c(x, u, p) along a motion.

    by_state (T, 12), by_input (T, n_u), by_parameter (T, n_p): its partial derivatives. Friction enters
    contact margins only through the last, the direct term.
    """
    total = np.einsum("ti,tij->tj", by_state, state_sensitivity)
    if by_input is not None and input_sensitivity is not None:
        total = total + np.einsum("ti,tij->tj", by_input, input_sensitivity)
    return total if by_parameter is None else total + by_parameter
