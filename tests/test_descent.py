"""BFGS of our own against SciPy's: the same points, bit for bit, also where a line search fails."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from salver.planning.follow.descent import _thorough, descend


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


@pytest.mark.parametrize(
    ("steps", "at"),
    [
        pytest.param(steps, at, marks=[pytest.mark.slow] * (at is cliff and steps != 12))
        for steps in (1, 12, 80)
        for at in (rosenbrock, wavy, largest_of_all, walled, cliff, endless)
    ],
)
def test_the_same_points_as_scipy(at, steps):
    rng = np.random.default_rng(3)
    for k in range(20):
        agrees(at, rng.normal(size=2 + k % 5) * 10.0 ** rng.integers(-2, 2), steps)


def test_the_same_points_where_a_bracket_shrinks_to_nothing():
    """As steep after a minimum as before it: no step leaves less slope."""
    for x in ([0.0], [0.1, 0.2], [-1.0, 0.0, 3.0]):
        agrees(lambda x: (float(np.abs(x - 0.3).sum()), np.sign(x - 0.3)), np.array(x), 1)


def test_the_same_points_where_after_too_little_it_falls_ever_more_steeply():
    """The value at the first step, which is 5e-5 lower where 1e-4 was asked for, then counts in a cubic."""

    def at(x):
        if x[0] > 0.99:
            return -5e-5 * x[0], np.array([0.5])
        if x[0] > 0.8:
            return -0.5, np.array([1e-4])
        return -0.3 * x[0], np.array([-2.0 if x[0] else -1.0])

    agrees(at, np.array([0.0]), 1)


def test_the_same_points_where_a_first_step_falls_but_not_enough():
    for distance in np.linspace(0.50500, 0.50506, 7):  # the first step is 1.01 long, to just before the other side
        agrees(lambda x: (float(x @ x), 2 * x), np.array([distance, 0.0]), 12)


def chance(x, fall):
    """Values and slopes that have nothing to do with one another, always the same at the same place."""
    rng = np.random.default_rng(np.frombuffer(x.tobytes(), dtype=np.uint32))
    return 0.01 * rng.normal() - fall * np.abs(x).sum(), rng.normal(size=len(x)) * 10.0 ** rng.integers(-2, 2)


@pytest.mark.parametrize(("fall", "seeds"), [(0.0, [0, 89, 201]), (1.0, [1, 26, 85])])
def test_the_same_points_whatever_is_answered(fall, seeds):
    """Among them such as lead into every branch of a line search."""
    for seed in seeds:
        rng = np.random.default_rng(seed)
        agrees(lambda x: chance(x, fall), rng.normal(size=1 + seed % 3) * 10.0 ** rng.integers(-2, 3), 12)


def test_the_slope_after_a_step_is_that_of_where_it_led():
    """Downhill without end SciPy's search gives up after some steps, and does not say the slope there."""
    x, way = np.array([1.0]), np.array([1.0])

    def at(y):
        return float(-np.sqrt(1 + y @ y)), -y / np.sqrt(1 + y @ y)

    value, slope = at(x)
    share, there, gradient = _thorough(at, x, way, value, slope, value + 0.1)
    assert share > 10
    assert there == at(x + share)[0]
    assert np.array_equal(gradient, at(x + share)[1])


def agrees(at, start, steps):
    asked = ([], [])

    def seen(x, points):
        points.append(x.copy())
        return at(x)

    found = descend(lambda x: seen(x, asked[0]), start, steps, 1e-3)
    theirs = minimize(seen, start, args=(asked[1],), method="BFGS", jac=True, options={"maxiter": steps, "gtol": 1e-3})
    assert np.array_equal(asked[0], asked[1])
    assert np.array_equal(found, theirs.x)
