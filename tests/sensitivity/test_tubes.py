"""Eqs (8) to (12): radii by hand, by support functions, and by sampling the sets."""

import numpy as np
import pytest

from salver.models.uncertain.parameters import NOTHING, Parameter, UncertainSet
from salver.sensitivity.tubes import ellipsoid, excess, radius


def uncertain(kind, correlation=None):
    parameters = (Parameter("cube", "mass"), Parameter("cube", "com", "x"))
    return UncertainSet(parameters, np.zeros(2), np.array([0.1, 0.2]), kind, correlation)


def test_radii_by_hand():
    sensitivity = np.array([[3.0, -2.0]])
    assert radius(sensitivity, uncertain("box")) == pytest.approx([0.3 + 0.4])
    assert radius(sensitivity, uncertain("ellipsoid")) == pytest.approx([np.hypot(0.3, 0.4)])


def test_the_papers_ellipsoid_does_not_bound_the_box():
    corner = np.array([0.1, -0.2])
    sensitivity = np.array([3.0, -2.0])
    assert abs(sensitivity @ corner) > radius(sensitivity, uncertain("ellipsoid"))
    assert abs(sensitivity @ corner) == pytest.approx(radius(sensitivity, uncertain("box")))


@pytest.mark.parametrize("kind", ["box", "ellipsoid"])
def test_radius_is_the_tight_bound_over_the_set(kind):
    rng = np.random.default_rng(0)
    correlation = np.array([[1, 0.6], [0.6, 1]]) if kind == "ellipsoid" else None
    known = uncertain(kind, correlation)
    sensitivity = rng.normal(size=(5, 2))
    unit = rng.uniform(-1, 1, size=(20000, 2))
    if kind == "ellipsoid":
        unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    else:
        unit = np.vstack([unit, [[1, 1], [1, -1]]])
    reached = np.abs(sensitivity @ known.factor @ unit.T).max(axis=1)
    bound = radius(sensitivity, known)
    assert np.all(reached <= bound + 1e-12)
    assert reached == pytest.approx(bound, rel=1e-6)


def test_shape_matrix_holds_the_image_of_the_set():
    rng = np.random.default_rng(1)
    known = uncertain("ellipsoid", np.array([[1, -0.3], [-0.3, 1]]))
    sensitivity = rng.normal(size=(2, 2))
    shape = ellipsoid(sensitivity, known)
    angle = np.linspace(0, 2 * np.pi, 50)
    boundary = sensitivity @ known.factor @ np.stack([np.cos(angle), np.sin(angle)])
    assert np.einsum("ik,ij,jk->k", boundary, np.linalg.inv(shape), boundary) == pytest.approx(np.ones(50))
    direction = np.array([0.6, 0.8])
    assert radius(direction @ sensitivity, known) == pytest.approx(np.sqrt(direction @ shape @ direction))


def test_nothing_uncertain_means_no_tube():
    nothing = NOTHING
    assert not radius(np.zeros((7, 3, 0)), nothing).any()


def test_excess_is_positive_outside_on_either_side():
    found = excess(np.array([[0.7], [0.8], [1.25], [1.5]]), np.ones((4, 1)), np.full((4, 1), 0.25))
    assert found[:, 0] == pytest.approx([0.05, -0.05, 0.0, 0.25])
