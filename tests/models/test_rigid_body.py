"""Eq (1): the form linear in the motion against hand answers and Pinocchio."""

import numpy as np
import pinocchio as pin
import pytest

import newton_euler
from salver.geometry import exp
from salver.models.rigid_body import RigidBody, inertia_matrix, spatial_inertia
from salver.models.tray_motion import motion_vector, wrench_map
from salver.models.uncertain.parameters import Parameter, inertial_vector, parameters_of, phi_jacobian, phi_of


def wrench(phi, *motion):
    return wrench_map(phi) @ motion_vector(*motion)


@pytest.fixture
def body():
    return RigidBody(0.7, np.array([0.02, -0.01, 0.03]), inertia_matrix([3e-3, 1e-4, 4e-3, -2e-4, 3e-4, 5e-3]))


def test_at_rest_upright_the_wrench_is_the_weight():
    resting = RigidBody(0.256, np.zeros(3), np.eye(3) * 3.4e-4)
    zero = np.zeros(3)
    assert wrench(resting.phi, np.eye(3), zero, zero, zero) == pytest.approx([0, 0, 0.256 * 9.81, 0, 0, 0], abs=1e-15)


def test_weight_of_a_displaced_mass_makes_a_moment_about_b():
    body = RigidBody(2.0, np.array([0.1, 0.0, 0.0]), np.eye(3))
    zero = np.zeros(3)
    # The support must push up at x = 0.1: moment about y is -x * f_z.
    assert wrench(body.phi, np.eye(3), zero, zero, zero)[4] == pytest.approx(-0.1 * 2.0 * 9.81)


def test_wrench_agrees_with_pinocchio(body):
    rng = np.random.default_rng(0)
    inertia = pin.Inertia(body.mass, body.com_B, body.inertia_com)
    assert body.phi == pytest.approx(inertia.toDynamicParameters())
    assert spatial_inertia(body.phi) == pytest.approx(inertia.matrix())
    for _ in range(20):
        rotation, a, omega, alpha = exp(rng.normal(size=3)), *rng.normal(size=(3, 3))
        specific = rotation.T @ (a + np.array([0, 0, 9.81]))
        # Spatial acceleration of B has v' - ... : linear part is R^T a - omega x v; with v = 0 it is R^T a.
        motion, rate = pin.Motion(np.zeros(3), omega), pin.Motion(specific, alpha)
        expected = (inertia * rate + motion.cross(inertia * motion)).vector
        assert wrench(body.phi, rotation, a, omega, alpha) == pytest.approx(expected, abs=1e-13)
        assert newton_euler.wrench(body.phi, rotation, a, omega, alpha) == pytest.approx(expected, abs=1e-13)


def test_parameters_and_body_are_two_views_of_the_same_thing(body):
    again = RigidBody.from_phi(body.phi)
    assert again.com_B == pytest.approx(body.com_B)
    assert again.inertia_com == pytest.approx(body.inertia_com)
    assert phi_of(inertial_vector(body)) == pytest.approx(body.phi)


def test_parameter_jacobian_is_the_derivative_of_phi():
    body = RigidBody(0.7, np.zeros(3), inertia_matrix([3e-3, 1e-4, 4e-3, -2e-4, 3e-4, 5e-3]))
    nominal, h = inertial_vector(body), 1e-6
    jacobian = phi_jacobian(body, "cube", parameters_of("cube", True)[:10])
    for j in range(10):
        step = h * np.eye(10)[j]
        numeric = (phi_of(nominal + step) - phi_of(nominal - step)) / (2 * h)
        assert jacobian[:, j] == pytest.approx(numeric, abs=1e-9)
    assert not phi_jacobian(body, "cube", (Parameter("cube", "friction"),)).any()
