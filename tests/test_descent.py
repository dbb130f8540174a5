"""BFGS of our own against SciPy's: the same points, bit for bit, also where a line search fails."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from salver.planning.follow.descent import descend


def rosenbrock(x):
    value = np.sum(100 * (x[1:] - x[:-1] ** 2) ** 2 + (1 - x[:-1]) ** 2)
    slope = np.zeros_like(x)
    slope[:-1] = -400 * x[:-1] * (x[1:] - x[:-1] ** 2) - 2 * (1 - x[:-1])
    slope[1:] += 200 * (x[1:] - x[:-1] ** 2)
    return value, slope


def wavy(x):
    """Many minima: lines along which slopes change sign several times."""
    return float(np.sum(np.sin(3 * x) + 0.1 * x**2)), 3 * np.cos(3 * x) + 0.2 * x


def largest_of_all(x):
    """A soft maximum of powers, as what an arm uses of its limits."""
    sizes = np.array([x @ x + 1, np.sum((x - 1) ** 2), np.sum((x + 0.5) ** 4)])
    slopes = np.stack([2 * x, 2 * (x - 1), 4 * (x + 0.5) ** 3])
    value = float(np.sum(sizes**20) ** (1 / 20))
    return value, (sizes / value) ** 19 @ slopes


def walled(x):
    """Beyond a wall the value is high and flat, as where an arm cannot follow: line searches fail there."""
    return (1e3, np.zeros_like(x)) if x[0] > 0.3 else (float(-x[0] + x @ x), 2 * x - np.eye(len(x))[0])


def cliff(x):
    """A slope that lies: it falls by its gradient and rises in truth, so that no line search finds anything."""
    return float(x @ x), -2 * x


def endless(x):
    """Infinite beyond a wall: the search that is asked second finds a step before it."""
    return (np.inf, np.zeros_like(x)) if x[0] > 0.3 else (float(x @ x - 3 * x[0]), 2 * x - 3 * np.eye(len(x))[0])


@pytest.mark.parametrize("at", [rosenbrock, wavy, largest_of_all, walled, cliff, endless])
@pytest.mark.parametrize("steps", [1, 12, 80])
def test_the_same_points_as_scipy(at, steps):
    rng = np.random.default_rng(3)
    for k in range(20):
        agrees(at, rng.normal(size=2 + k % 5) * 10.0 ** rng.integers(-2, 2), steps)


def test_the_same_points_where_a_first_step_falls_but_not_enough():
    for distance in np.linspace(0.50500, 0.50506, 7):  # the first step is 1.01 long, to just before the other side
        agrees(lambda x: (float(x @ x), 2 * x), np.array([distance, 0.0]), 12)


def agrees(at, start, steps):
    asked = ([], [])

    def seen(x, points):
        points.append(x.copy())
        return at(x)

    found = descend(lambda x: seen(x, asked[0]), start, steps, 1e-3)
    theirs = minimize(seen, start, args=(asked[1],), method="BFGS", jac=True, options={"maxiter": steps, "gtol": 1e-3})
    assert np.array_equal(asked[0], asked[1])
    assert np.array_equal(found, theirs.x)
