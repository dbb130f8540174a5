"""Eqs (2) to (5): grasp matrix and cones against hand answers."""

import numpy as np
import pytest

from salver.geometry import exp
from salver.models.contact.contact import ContactSet, cone_edges, support_contacts

CUBE = 0.02 * np.array([[1, 1, -1], [-1, 1, -1], [-1, -1, -1], [1, -1, -1]])
WEIGHT = np.array([0, 0, 0.256 * 9.81, 0, 0, 0])


def test_paper_cube_at_rest_has_sixteen_equal_coefficients():
    contacts = support_contacts(CUBE, 0.5)
    coefficients = np.linalg.pinv(contacts.grasp_map) @ WEIGHT
    # A quarter of the weight on each foot, shared by four unit edges of slope 1 / sqrt(1.25).
    assert coefficients == pytest.approx(np.full(16, 0.256 * 9.81 / 16 * np.sqrt(1.25)))
    assert coefficients[0] == pytest.approx(0.1755, abs=5e-5)


def test_grasp_matrix_sums_forces_and_moments():
    rng = np.random.default_rng(1)
    points, rotations = rng.normal(size=(3, 3)), exp(rng.normal(size=(3, 3)))
    contacts = ContactSet(points, rotations, np.full(3, 0.4))
    forces = rng.normal(size=(3, 3))
    in_body = np.einsum("nij,nj->ni", rotations, forces)
    expected = np.concatenate([in_body.sum(axis=0), np.cross(points, in_body).sum(axis=0)])
    assert contacts.grasp_matrix @ forces.ravel() == pytest.approx(expected)


@pytest.mark.parametrize("edges", [3, 4, 7, 16])
@pytest.mark.parametrize("phase", [0.0, 0.3])
def test_edges_are_unit_vectors_on_the_coulomb_cone(edges, phase):
    rays = cone_edges(0.5, edges, phase)
    assert np.linalg.norm(rays, axis=0) == pytest.approx(np.ones(edges))
    assert np.hypot(rays[0], rays[1]) / rays[2] == pytest.approx(np.full(edges, 0.5))
    assert np.arctan2(rays[1, 0], rays[0, 0]) == pytest.approx(phase)


@pytest.mark.parametrize(("acceleration", "kept"), [(1.96, True), (1.97, False)])
def test_least_norm_coefficients_turn_negative_at_a_fifth_of_gravity(acceleration, kept):
    # Level tray, friction 0.5: the moment of the cube's height adds to the friction's own share, 0.2 g in all.
    wrench = WEIGHT + np.array([0.256 * acceleration, 0, 0, 0, 0, 0])
    coefficients = np.linalg.pinv(support_contacts(CUBE, 0.5).grasp_map) @ wrench
    assert (coefficients.min() >= 0) == kept
