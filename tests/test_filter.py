"""The error dynamics as a filter: against an adaptive integrator, and known integrals."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from salver.linear_filter import LinearFilter, fastest_rate, settled, swinging_at, transition


def forcing(t):
    return np.exp(-t) * np.sin(7 * t) + 1


@pytest.mark.parametrize(("kp", "kd"), [(500.0, 25.0), (300.0, 15.0), (100.0, 20.0), (50.0, 40.0)])
@pytest.mark.parametrize("instants", [41, 301, 1601])
def test_response_agrees_with_an_adaptive_integrator(kp, kd, instants):
    """Cubics miss the forcing by at most 9/384 h^4 times its fourth derivative, 7^4."""
    t = np.linspace(0, 2, instants)
    e, rate = LinearFilter.on_nodes(t, kp, kd, 3).respond(forcing(t)[:, None])
    answer = solve_ivp(
        lambda t, x: [x[1], forcing(t) - kd * x[1] - kp * x[0]],
        (0, 2),
        [0, 0],
        t_eval=t,
        method="DOP853",
        rtol=1e-12,
        atol=1e-15,
    )
    tolerance = max(1e-10, 9 / 384 * t[1] ** 4 * 7**4)
    assert e[:, 0] == pytest.approx(answer.y[0], abs=tolerance * np.abs(e).max())
    assert rate[:, 0] == pytest.approx(answer.y[1], abs=tolerance * fastest_rate(kp, kd) * np.abs(e).max())


def test_constant_forcing_settles_at_its_static_error():
    e, rate = LinearFilter.on_nodes(np.linspace(0, 5, 201), 500.0, 25.0, 3).respond(np.ones(201))
    assert e[-1] == pytest.approx(1 / 500)
    assert np.abs(rate[-1]).max() < 1e-9 * np.abs(rate).max()


def test_a_filter_without_gains_integrates():
    """Twice, and exactly for cubics between nodes: x'' = d."""
    for f, once, twice, tolerance in (
        (lambda t: 6 * t**2, lambda t: 2 * t**3, lambda t: t**4 / 2, 1e-14),
        (lambda t: np.cos(3 * t), lambda t: np.sin(3 * t) / 3, lambda t: (1 - np.cos(3 * t)) / 9, 3e-7),
    ):
        t = np.linspace(0, 1.5, 61)
        x, rate = LinearFilter.on_nodes(t, 0.0, 0.0, 3).respond(f(t))
        assert rate == pytest.approx(once(t), abs=tolerance)
        assert x == pytest.approx(twice(t), abs=tolerance)


def test_nothing_in_nothing_out():
    e, rate = LinearFilter.on_nodes(np.linspace(0, 1, 11), 500.0, 25.0, 3).respond(np.zeros((11, 3, 0)))
    assert e.shape == rate.shape == (11, 3, 0)


NODES = np.array([0.0, 0.002, 0.05, 0.3, 0.31, 0.9, 3.0, 3.4])
GAINS = [(500.0, 25.0), (156.25, 25.0), (40.0, 30.0), (448.0, 0.2)]


@pytest.mark.parametrize("order", [1, 3])
@pytest.mark.parametrize(("kp", "kd"), GAINS)
def test_polynomials_between_nodes_of_any_spacing_are_exact(kp, kd, order):
    """A particular solution that is a polynomial, and what of the start dies away."""
    solution = np.polynomial.Polynomial([0.3, -0.2, 0.1, 0.05][: order + 1])
    rate = solution.deriv()
    drive = solution.deriv(2)(NODES) + kd * rate(NODES) + kp * solution(NODES)
    offset = np.array([0.01, -0.5])
    start = np.array([solution(0.0), rate(0.0)]) + offset
    x, v = LinearFilter.on_nodes(NODES, kp, kd, order).respond(drive, start)
    left = transition(kp, kd, NODES) @ offset
    scale = np.array([1.0, fastest_rate(kp, kd)])
    assert np.abs(np.array([x - solution(NODES), v - rate(NODES)]) - left.T).max(axis=1) == pytest.approx(
        np.zeros(2), abs=1e-11 * scale.max()
    )


def test_a_motion_that_begins_moving_goes_on_from_its_state():
    """The first half and, from the state at its end, the second are the whole."""
    t = np.linspace(0, 1, 41)
    drive = forcing(t)
    x, rate = LinearFilter.on_nodes(t, 500.0, 25.0).respond(drive)
    second = LinearFilter.on_nodes(t[20:], 500.0, 25.0).respond(drive[20:], np.array([x[20], rate[20]]))
    assert second[0] == pytest.approx(x[20:], abs=1e-12)
    assert second[1] == pytest.approx(rate[20:], abs=1e-10)


def test_settled_for_ever_stays_at_rest():
    """Under a constant drive the state has gone to 1 / kp and moves no more."""
    response = LinearFilter.on_nodes(np.linspace(0.0, 1.0, 21), 500.0, 25.0, 3)
    e, rate = response.respond(np.ones(21), settled(500.0, 25.0, 60.0, np.ones(())))
    assert e == pytest.approx(np.full(21, 1 / 500), rel=1e-9)
    assert rate == pytest.approx(np.zeros(21), abs=1e-10)
    assert response.acceleration(np.ones(21), e, rate) == pytest.approx(np.zeros(21), abs=1e-8)


def test_settling_twice_is_settling_longer():
    one = np.ones(())
    first, longer = settled(500.0, 25.0, 0.1, one), settled(500.0, 25.0, 0.25, one)
    assert longer == pytest.approx(settled(500.0, 25.0, 0.15, one) + transition(500.0, 25.0, 0.15) @ first, rel=1e-12)


def test_between_nodes_what_swings_is_the_cubic_of_both_sides():
    """Exact for a cubic, at nodes of any spacing; beyond them too."""
    t = np.array([0.0, 0.1, 0.4, 0.45])
    x, rate = np.polynomial.Polynomial([1.0, -2.0, 3.0, 5.0]), np.polynomial.Polynomial([-2.0, 6.0, 15.0])
    for now in (-0.1, 0.0, 0.03, 0.1, 0.33, 0.42, 0.45):
        found = swinging_at(t, np.stack([x(t), -x(t)], axis=1), np.stack([rate(t), -rate(t)], axis=1), now)
        np.testing.assert_allclose(found, [[x(now), -x(now)], [rate(now), -rate(now)]], rtol=1e-12)


@pytest.mark.parametrize("uneven", [0.0, 1e-6, 0.02])
def test_steps_that_are_nearly_alike_have_each_its_own_length(uneven):
    """Without anything that stiffens it: the transition over each step, and the answer to a cubic drive."""
    t, kp, kd = np.linspace(0, 1, 31), np.array([400.0]), np.array([3.0])
    t[1:-1] += uneven * np.random.default_rng(0).uniform(-1, 1, 29) / 30
    found = LinearFilter.stiffened(t, kp, kd, np.zeros((1, 31)))
    np.testing.assert_allclose(found.step[0], transition(400.0, 3.0, np.diff(t)), rtol=1e-9, atol=1e-9)
    drive = (1 - 5 * t + 3 * t**3)[:, None]
    expected = LinearFilter.on_nodes(t, 400.0, 3.0, 3).respond(drive)
    np.testing.assert_allclose(found.respond(drive[None])[0][0], expected[0], atol=1e-10)
