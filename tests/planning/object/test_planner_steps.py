"""Steps of the search for a motion of the object: programmes with tangents, what they promise, and where they lead."""

from dataclasses import dataclass

import numpy as np
import pytest

from salver.geometry import Array
from salver.planning import qp
from salver.planning.object import solvers
from salver.planning.object.conditions import TiltRows
from salver.planning.object.problem import Linearisation, Problem
from salver.planning.object.solvers import _dual_value, _merit, solve_model, solve_sequential
from salver.planning.qp import Optimum, Quadratic
from salver.scenario import load


def test_a_step_is_damped_as_least_squares_with_a_row_for_each_unknown():
    """Where no row hinders it, of |r + J d|^2 + damping |d|^2."""
    problem = Problem(load("panda-cube"), 41)
    model = problem.linearise(np.zeros(problem.size))
    jacobian, residual, n = model.residual_jacobian, model.residual, problem.size
    damping = 0.1 * np.trace(jacobian.T @ jacobian) / n
    step = solve_model(model, -1e9, damping, np.inf)
    rows, wanted = np.vstack([jacobian, np.sqrt(damping) * np.eye(n)]), np.concatenate([-residual, np.zeros(n)])
    np.testing.assert_allclose(step.d, np.linalg.lstsq(rows, wanted, rcond=None)[0], atol=1e-9 * np.abs(step.d).max())


def test_a_linear_row_is_cut_once():
    """min (d - 2)^2 with 1 - d >= 0: d = 1, where the cost is 1 and grows by 2 for each unit of d. Its one tangent is
    the row itself, so that a second programme has nothing left to find."""
    row, nothing = TiltRows(("tilt",), np.ones(1), -np.ones((1, 1))), np.zeros(0)
    model = Linearisation(np.array([-2.0]), np.ones((1, 1)), (row,), nothing, np.zeros((0, 1)))
    step = solve_model(model, 0.0, 0.0, np.inf)
    assert (step.d[0], step.lower_bound, step.price) == pytest.approx((1.0, 1.0, 2.0), abs=1e-9)
    assert (step.violation, step.rounds) == (pytest.approx(0.0, abs=1e-9), 2)


def test_the_price_of_a_step_is_that_of_its_rows_and_of_its_goal():
    """min (d_0 - 2)^2 + (d_1 - 1)^2 with 1 - d_0 >= 0 and d_1 = 0: a unit of either costs 2."""
    row = TiltRows(("tilt",), np.ones(1), np.array([[-1.0, 0.0]]))
    model = Linearisation(np.array([-2.0, -1.0]), np.eye(2), (row,), np.zeros(1), np.array([[0.0, 1.0]]))
    step = solve_model(model, 0.0, 0.0, np.inf)
    assert step.d == pytest.approx([1.0, 0.0], abs=1e-9)
    assert (step.lower_bound, step.price) == pytest.approx((2.0, 4.0), abs=1e-8)


def test_value_of_the_dual_bounds_every_choice_and_is_met_at_the_bounds_of_the_step():
    """Of min 1/2 |x - a|^2 over a box, a beyond both kinds of its faces: by hand."""
    a, free = np.array([2.0, -3.0, 0.2]), np.zeros((0, 3))
    programme = Quadratic(np.eye(3), -a, free, np.zeros(0), free, np.zeros(0), np.full(3, -1.0), np.full(3, 1.0))
    found = qp.solve(programme, 1e-10)
    assert found.x == pytest.approx([1.0, -1.0, 0.2], abs=1e-7)
    least = 0.5 * (1.0 + 4.0) - 0.5 * a @ a
    assert _dual_value(programme, found) == pytest.approx(least, abs=1e-6)
    held = np.array([[0.0, 0.0, 2.0]])  # the third at 0.5
    both = Quadratic(np.eye(3), -a, free, np.zeros(0), held, np.ones(1), np.full(3, -1.0), np.full(3, 1.0))
    assert _dual_value(both, qp.solve(both, 1e-10)) == pytest.approx(least + 0.5 * 0.3**2, abs=1e-6)
    hasty = Optimum(found.x, found.rows, found.equal, 0.5 * found.low, 0.9 * found.high)
    assert _dual_value(programme, hasty) < least - 1e-3  # still a bound where the multipliers are not the right ones


@dataclass(frozen=True)
class Circle:
    """Outside the unit circle: |z|^2 - 1 >= 0 of z in a plane, by its tangent at z."""

    z: Array
    owner = ("circle",)

    def slack(self, step: Array | None = None) -> Array:
        d = np.zeros(2) if step is None else step
        return np.array([[self.z @ self.z - 1 + 2 * self.z @ d]])

    def tangents(self, step: Array, instant: Array, row: Array) -> tuple[Array, Array]:
        return np.full(len(row), self.z @ self.z - 1), np.tile(2 * self.z, (len(row), 1))


@dataclass(frozen=True)
class Plane:
    """The nearest place to c in a plane, outside the unit circle, on the curve z_1 + bend z_0^2 = height."""

    c: Array
    bend: float
    height: float
    size = 2
    margin = 0.0
    rotates = False

    def goal_missed(self, z: Array) -> Array:
        return np.array([z[1] + self.bend * z[0] ** 2 - self.height])

    def linearise(self, z: Array) -> Linearisation:
        slope = np.array([[2 * self.bend * z[0], 1.0]])
        return Linearisation(z - self.c, np.eye(2), (Circle(z),), self.goal_missed(z), slope)


@pytest.mark.parametrize(
    ("c", "height"),
    [
        ((0.3, 0.4), 0.5),
        ((2.0, 0.0), 0.5),
        ((-0.5, 1.0), 0.5),
        ((3.0, -4.0), 0.5),  # by corrections
        ((1.0, 3.0), 1.5),  # by fewer steps than there are: some lead to dearer places
    ],
)
def test_the_nearest_place_on_a_curve_outside_a_circle_is_found_on_it_and_every_programme_is_counted(
    c, height, monkeypatch
):
    """Against all places on the curve, one by one. Without the circle and the curve c itself would do: nothing costs
    less than that."""
    plane, programmes = Plane(np.array(c), 0.7, height), []

    def counted(*arguments, **options):
        step = solve_model(*arguments, **options)
        programmes.append(0 if step is None else step.rounds)
        return step

    def corrected(*arguments, correct=solvers._correction):
        before = len(programmes)
        step = correct(*arguments)
        programmes[before:] = [int(step is not None)]  # one, however many rounds it took
        return step

    monkeypatch.setattr(solvers, "solve_model", counted)
    monkeypatch.setattr(solvers, "_correction", corrected)
    found = solve_sequential(plane, np.array([1.0 if c[0] > 0 else -1.0, 0.3]))
    assert found.status.ok, found.status
    x = np.linspace(-3, 3, 600_001)
    y = plane.height - plane.bend * x**2
    side = (x**2 + y**2 >= 1) & ((x > 0) == (c[0] > 0))
    least = np.min(((x - c[0]) ** 2 + (y - c[1]) ** 2)[side])
    assert found.cost == pytest.approx(least, abs=3e-5)  # of places 1e-5 apart
    assert np.abs(plane.goal_missed(found.z)).max() < 1e-12
    assert found.lower_bound == pytest.approx(0.0, abs=1e-12)
    assert found.iterations == sum(programmes)


def test_what_a_step_promises_is_what_it_brings_where_all_is_linear():
    """Also one that misses a row and the goal: the merit of the model after a step is that of what is there."""
    rng = np.random.default_rng(3)
    jacobian, residual, onto = rng.normal(size=(7, 5)), rng.normal(size=7), rng.normal(size=(2, 5))
    left, slope = np.array([0.2, 1.0]), rng.normal(size=(2, 5))
    for _ in range(5):
        d = rng.normal(size=5)
        goal = rng.normal(size=2)
        here = Linearisation(residual, jacobian, (TiltRows(("tilt",), left, slope),), goal - onto @ d, onto)
        row = TiltRows(("tilt",), left + slope @ d, slope)
        there = Linearisation(residual + jacobian @ d, jacobian, (row,), goal, onto)
        assert _merit(here, 0.5, 7.0, d) == pytest.approx(_merit(there, 0.5, 7.0))
        missed = max(0.0, *(0.5 - row.left))
        assert _merit(there, 0.5, 7.0) == pytest.approx(np.sum(there.residual**2) + 7.0 * (missed + np.abs(goal).sum()))


def test_a_step_to_a_goal_that_no_row_hinders_is_the_least_of_those_that_reach_it():
    """Of |r + J d|^2 with G d + g = 0: J and r on what the goal leaves free, by singular vectors of G."""
    rng = np.random.default_rng(8)
    jacobian, residual, goal = rng.normal(size=(7, 5)), rng.normal(size=7), rng.normal(size=2)
    onto = rng.normal(size=(2, 5))
    row = TiltRows(("tilt",), np.ones(1), np.zeros((1, 5)))
    step = solve_model(Linearisation(residual, jacobian, (row,), goal, onto), 0.0, 0.0, np.inf)
    reaches, free = -np.linalg.pinv(onto) @ goal, np.linalg.svd(onto)[2][2:].T
    along = np.linalg.lstsq(jacobian @ free, -(residual + jacobian @ reaches), rcond=None)[0]
    assert step.d == pytest.approx(reaches + free @ along)
    assert step.lower_bound == pytest.approx(np.sum((residual + jacobian @ step.d) ** 2))
