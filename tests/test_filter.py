"""The error dynamics as a filter: against an adaptive integrator, and known integrals."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from salver.sensitivity.filter import ErrorFilter, QuadratureGrid


def forcing(t):
    return np.exp(-t) * np.sin(7 * t) + 1


@pytest.mark.parametrize(("kp", "kd"), [(500.0, 25.0), (300.0, 15.0), (100.0, 20.0), (50.0, 40.0)])
@pytest.mark.parametrize("instants", [41, 301])
def test_response_agrees_with_an_adaptive_integrator(kp, kd, instants):
    grid = QuadratureGrid.for_gains(np.linspace(0, 2, instants), [(kp, kd)])
    e, rate = ErrorFilter(grid, kp, kd).respond(forcing(grid.times)[:, None])
    answer = solve_ivp(
        lambda t, x: [x[1], forcing(t) - kd * x[1] - kp * x[0]],
        (0, 2),
        [0, 0],
        t_eval=grid.t,
        method="DOP853",
        rtol=1e-12,
        atol=1e-15,
    )
    assert e[:, 0] == pytest.approx(answer.y[0], abs=2e-8 * np.abs(e).max())
    assert rate[:, 0] == pytest.approx(answer.y[1], abs=2e-8 * np.abs(rate).max())


def test_constant_forcing_settles_at_its_static_error():
    grid = QuadratureGrid.for_gains(np.linspace(0, 5, 201), [(500.0, 25.0)])
    e, rate = ErrorFilter(grid, 500.0, 25.0).respond(np.ones(len(grid.times)))
    assert e[-1] == pytest.approx(1 / 500)
    assert np.abs(rate[-1]).max() < 1e-9 * np.abs(rate).max()


def test_running_integrals_are_exact_for_quadratics_and_accurate_for_waves():
    grid = QuadratureGrid(np.linspace(0, 1.5, 31), 2)
    for f, integral, tolerance in (
        (lambda t: 3 * t**2, lambda t: t**3, 1e-14),
        (lambda t: np.cos(3 * t), lambda t: np.sin(3 * t) / 3, 2e-8),
    ):
        at_grid, at_times = grid.cumulative(f(grid.times))
        assert at_grid == pytest.approx(integral(grid.t), abs=tolerance)
        assert at_times == pytest.approx(integral(grid.times), abs=tolerance)


def test_nothing_in_nothing_out():
    grid = QuadratureGrid.for_gains(np.linspace(0, 1, 11), [(500.0, 25.0)])
    e, rate = ErrorFilter(grid, 500.0, 25.0).respond(np.zeros((len(grid.times), 3, 0)))
    assert e.shape == rate.shape == (11, 3, 0)
