"""Walking downhill: to minima, never up, and no further than something lets it."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.optimize import minimize

from salver.planning.follow.descent import descend


def rosenbrock(x):
    value = np.sum(100 * (x[1:] - x[:-1] ** 2) ** 2 + (1 - x[:-1]) ** 2)
    slope = np.zeros_like(x)
    slope[:-1] = -400 * x[:-1] * (x[1:] - x[:-1] ** 2) - 2 * (1 - x[:-1])
    slope[1:] += 200 * (x[1:] - x[:-1] ** 2)
    return float(value), slope


def largest_of_all(x):
    """A soft maximum of powers, as what an arm uses of its limits."""
    sizes = np.array([x @ x + 1, np.sum((x - 1) ** 2), np.sum((x + 0.5) ** 4)])
    slopes = np.stack([2 * x, 2 * (x - 1), 4 * (x + 0.5) ** 3])
    value = float(np.sum(sizes**20) ** (1 / 20))
    return value, (sizes / value) ** 19 @ slopes


def walled(x):
    """Beyond a wall the value is high and flat, as where an arm cannot follow."""
    return (1e3, np.zeros_like(x)) if x[0] > 0.3 else (float(-x[0] + x @ x), 2 * x - np.eye(len(x))[0])


def cliff(x):
    """A slope that lies: it falls by its gradient and rises in truth."""
    return float(x @ x), -2 * x


@pytest.mark.parametrize("at", [rosenbrock, largest_of_all])
@pytest.mark.parametrize("n", [2, 5])
def test_it_finds_the_minimum_that_another_librarys_search_finds(at, n):
    begin = np.random.default_rng(n).normal(size=n)
    theirs = minimize(at, begin, jac=True, method="BFGS", options={"gtol": 1e-6})
    found = descend(at, begin, 200, 1e-5)
    assert np.abs(at(found)[1]).max() <= 1e-5
    assert at(found)[0] == pytest.approx(theirs.fun, abs=1e-8)


@pytest.mark.parametrize("at", [rosenbrock, largest_of_all, walled, cliff])
def test_more_steps_never_lead_up_and_none_leads_nowhere(at):
    begin = np.array([-0.4, 0.7, 0.1])
    values = [at(descend(at, begin, steps, 1e-9))[0] for steps in range(12)]
    assert values[0] == at(begin)[0]
    assert all(after <= before for before, after in pairwise(values))
    assert (values[-1] < values[0]) == (at is not cliff)


def test_before_a_wall_it_stays_on_this_side_of_it():
    assert 0.25 < descend(walled, np.array([-1.0, 0.5]), 40, 1e-6)[0] <= 0.3


def test_it_ends_where_it_is_flat_enough():
    asked = []

    def at(x):
        asked.append(x)
        return rosenbrock(x)

    descend(at, np.array([1.0, 1.0]) + 1e-9, 50, 1e-3)
    assert len(asked) == 1
