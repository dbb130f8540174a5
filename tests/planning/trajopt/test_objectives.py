"""What is made small or large: its model is its derivative."""

from types import SimpleNamespace

import numpy as np
import pytest

from salver.planning.fastest.planned import _held_by
from salver.planning.trajopt.curves import FreeCurve, Grid
from salver.planning.trajopt.objectives import Duration, LeastMargin, Point
from salver.planning.trajopt.problem import transport_problem
from salver.planning.trajopt.spline import RestSpline
from transport_problems import Distance, cube, line

SPLINE = RestSpline(5, 6)


@pytest.fixture(scope="module")
def curve():
    problem = transport_problem(cube(), robust=False)
    return FreeCurve(problem, Grid.of(SPLINE, SPLINE.nodes(3)))


@pytest.mark.parametrize("kind", ["duration", "margin", "distance"])
def test_the_model_of_an_objective_is_its_derivative(curve, kind):
    """By the coefficients and the scalar: the change of T^2 relative to T^2, or of the margin."""
    rng = np.random.default_rng(1)
    here = line(curve.problem, SPLINE)
    wanted = curve.motion(here + 0.05 * rng.normal(size=here.shape), 0.9)
    distance = Distance(wanted, np.array([1.0, 0.1, 0.01, 0.0]))
    objective = {"duration": Duration(), "margin": LeastMargin(), "distance": distance}[kind]
    direction, h = rng.normal(size=here.shape), 1e-5

    def at(step):
        margin = 0.1 + step if kind == "margin" else 0.1
        longer = np.sqrt(1 + step) if kind == "duration" else 1.0
        return objective.value(curve, Point(here + step * direction, 0.9 * float(longer), margin))

    model = objective.model(curve, Point(here, 0.9, 0.1))
    expected = model.slope @ direction.ravel() + (model.by_scalar if kind != "distance" else 0.0)
    assert (at(h) - at(-h)) / (2 * h) == pytest.approx(expected, rel=1e-6)
    assert abs(expected) > 1e-4


def test_more_margin_and_less_time_are_better(curve):
    here = line(curve.problem, SPLINE)
    least, shortest = LeastMargin(), Duration()
    assert least.value(curve, Point(here, 0.9, 0.2)) < least.value(curve, Point(here, 0.9, 0.1))
    assert shortest.value(curve, Point(here, 0.8)) < shortest.value(curve, Point(here, 0.9))


def test_how_far_a_motion_is_above_its_bound_is_said_in_per_cent():
    motion = SimpleNamespace(duration=0.88, binding=())
    assert "at most 10.0 % above the shortest" in _held_by(motion, 0.8, "no arm takes less than")
    without = _held_by(motion, 0.0, "the joints' limits alone take")  # of an arm for which nobody gave limits
    assert without == ""
    bound = SimpleNamespace(duration=0.88, binding=("contact of cube",))
    assert _held_by(bound, 0.0, "") == "What hinders a shorter one: contact of cube."
