"""Zeros of functions of one variable, against SciPy's."""

import numpy as np
import pytest
from scipy.optimize import brentq

from salver.contact_margins.root_finding import zero_between

FUNCTIONS = [
    lambda x: 3.0 - x,
    lambda x: min(2.0 - 0.5 * x, 9.0 - 2.9 * x**2, 40.0 - np.exp(1.3 * x)),  # least of several, as margins are
    lambda x: 1e-9 * (x - 0.1) ** 3,
    lambda x: np.sign(x - 2.2),  # no zero, but a change of sign
    lambda x: -3e8 if x < 2.2 else 5e-11,
    lambda x: 2e-12 - 1e-12 * x if x < 2.2 else 50.0 * (2.2 - x) - 2e-13,  # flat beside its zero, steep beyond
]


@pytest.mark.parametrize("value", FUNCTIONS)
@pytest.mark.parametrize("ends", [(0.0, 25.0), (25.0, 0.0), (-0.5, 3.5)])
def test_a_zero_is_found_to_the_tolerance_from_either_side(value, ends):
    found = zero_between(value, *ends, 1e-6)
    assert found == pytest.approx(brentq(value, *ends, xtol=1e-9), abs=1e-6)


def test_an_end_that_is_a_zero_is_it():
    assert zero_between(lambda x: x - 3.0, 1.0, 3.0, 1e-9) == 3.0
    assert zero_between(lambda x: x - 1.0, 1.0, 3.0, 1e-9) == 1.0


@pytest.mark.parametrize("none", [1.0, 2.0, 3.0])
def test_a_value_that_is_no_number_ends_the_search(none):
    with pytest.raises(ArithmeticError, match=rf"no value at {none:g}\."):
        zero_between(lambda x: np.nan if abs(x - none) < 0.1 else x - 2.3, 1.0, 3.0, 1e-9)
