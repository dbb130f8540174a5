"""The initial value solver: order, dense output, corners, and what it asks of the rate."""

import numpy as np
import pytest

from salver.integration import integrate

TIMES = np.array([0.3, 0.35, 1.0, 1.7, 2.0])


def oscillator(t, state):
    """x'' = -x + sin(2 t), started so that x = cos t - sin(2 t) / 3."""
    return np.stack([state[1], -state[0] + np.sin(2 * t)])


def exact(t):
    return np.stack([np.cos(t) - np.sin(2 * t) / 3, -np.sin(t) - 2 / 3 * np.cos(2 * t)], axis=-1)


def error(step: float, t: np.ndarray = TIMES) -> float:
    return float(np.abs(integrate(oscillator, exact(0.0), 0.0, t, step) - exact(t)).max())


def test_error_falls_with_the_eighth_power_of_the_step():
    assert np.log2(error(0.8, np.array([4.0])) / error(0.4, np.array([4.0]))) > 7.5
    assert error(0.1) < 1e-12


def test_answers_inside_steps_are_of_seventh_order_at_least():
    inside = np.linspace(0.01, 3.99, 57)
    assert np.log2(error(0.8, inside) / error(0.4, inside)) > 6.5


def test_start_is_returned_and_stacks_march_together():
    start = np.stack([exact(0.0), 2 * exact(0.0)], axis=1)
    t = np.array([0.0, 1.0])
    together = integrate(lambda t, s: np.stack([s[1], -s[0]]), start, 0.0, t, 0.1)
    np.testing.assert_array_equal(together[0], start)
    np.testing.assert_allclose(together[1, :, 1], 2 * together[1, :, 0], rtol=1e-14)
    only = integrate(lambda t, s: s, start, 0.0, t[:1], 0.1)
    np.testing.assert_array_equal(only, start[None])


def test_what_escapes_to_infinity_is_no_number_from_there_on():
    """x' = x^2 from 1 is 1 / (1 - t): 2 at t = 0.5, nowhere at t = 1."""
    with np.errstate(over="ignore", invalid="ignore"):
        x = integrate(lambda _, x: x * x, np.array([1.0]), 0.0, np.array([0.5, 2.0, 3.0]), 0.02)[:, 0]
    assert x[0] == pytest.approx(2.0, rel=1e-9)
    assert np.isnan(x[1:]).all()


def test_rates_are_asked_at_no_instant_outside_the_span():
    asked = []

    def rate(t, state):
        asked.append(t)
        return oscillator(t, state)

    integrate(rate, exact(0.0), 0.0, TIMES, 0.07, corners=(0.9,))
    assert min(asked) == 0.0
    assert max(asked) == TIMES[-1]


def test_rounding_moves_no_instant_into_the_next_piece():
    """a + (b - a) can be more than b; a reference sampled there would already be at rest."""
    pairs = np.random.default_rng(0).uniform([0, 1], [0.4, 2], (200, 2))
    a, b = next((a, b) for a, b in pairs if a + (b - a) > b)
    latest = []

    def rate(t, state):
        latest.append(t)
        return oscillator(t, state)

    integrate(rate, exact(a), a, np.array([b]), 2.0)
    assert max(latest) == b


def test_a_corner_costs_no_accuracy_when_it_is_declared():
    """x' = |t - 0.55|: a step across the kink cannot know; one that ends there is exact."""
    t = np.array([0.4, 1.0])
    expected = [(0.55**2 - 0.15**2) / 2, (0.55**2 + 0.45**2) / 2]

    def rate(t, state):
        return np.abs(t - 0.55) * np.ones(1)

    declared = integrate(rate, np.zeros(1), 0.0, t, 0.1, corners=(0.55,))[:, 0]
    np.testing.assert_allclose(declared, expected, rtol=1e-14)
    blind = integrate(rate, np.zeros(1), 0.0, t, 0.1)[:, 0]
    assert abs(blind[1] - expected[1]) > 1e-6
    assert blind[0] == pytest.approx(expected[0], rel=1e-14)
