"""Convex programmes of the object's motion: their tangents, what they bound, and where rows contradict each other."""

from dataclasses import dataclass

import numpy as np
import pytest

from salver.geometry import Array
from salver.planning.object.problem import Linearisation
from salver.planning.object.solvers import solve_model


@dataclass(frozen=True)
class Half:
    """The row left + slope d >= 0, at one instant."""

    left: float
    slope: Array
    owner = ("half",)

    def slack(self, step: Array | None = None) -> Array:
        return np.array([[self.left + (0.0 if step is None else self.slope @ step)]])

    def tangents(self, step: Array, instant: Array, row: Array) -> tuple[Array, Array]:
        return np.full(len(row), self.left), np.tile(self.slope, (len(row), 1))


def test_a_linear_row_is_cut_once():
    """min (d - 2)^2 with 1 - d >= 0: d = 1, where the cost is 1. Its one tangent is
    the row itself, so that a second programme has nothing left to find."""
    model = Linearisation(np.array([-2.0]), np.ones((1, 1)), (Half(1.0, -np.ones(1)),))
    step = solve_model(model, 0.0)
    assert (step.d[0], step.lower_bound) == pytest.approx((1.0, 1.0), abs=1e-9)
    assert (step.violation, step.rounds) == (pytest.approx(0.0, abs=1e-9), 2)


def test_where_rows_contradict_each_other_the_least_violation_of_both_is_found():
    """1 - d >= 0 and d - 3 >= 0 with the cheapest d at 5: both are missed by 1 at d = 2."""
    rows = Half(1.0, -np.ones(1)), Half(-3.0, np.ones(1))
    model = Linearisation(np.array([-5.0]), np.ones((1, 1)), rows)
    assert solve_model(model, 0.0) is None
    step = solve_model(model, 0.0, relaxed=True)
    assert (step.d[0], step.violation) == pytest.approx((2.0, 1.0), abs=1e-6)


def test_the_bound_of_a_step_is_below_what_any_choice_costs_and_met_by_its_own():
    rng = np.random.default_rng(2)
    jacobian, residual = rng.normal(size=(7, 4)), rng.normal(size=7)
    row = Half(-0.5, rng.normal(size=4))
    step = solve_model(Linearisation(residual, jacobian, (row,)), 0.0)
    free = np.linalg.lstsq(jacobian, -residual, rcond=None)[0]
    assert row.slack(free)[0, 0] < 0  # it hinders
    cost = np.sum((residual + jacobian @ step.d) ** 2)
    assert step.lower_bound == pytest.approx(cost, rel=1e-9)
    metric = np.linalg.inv(jacobian.T @ jacobian)  # by hand: the shortest way in the metric of the cost onto the row
    onto = free - metric @ row.slope * row.slack(free)[0, 0] / (row.slope @ metric @ row.slope)
    assert step.d == pytest.approx(onto, abs=1e-9)
