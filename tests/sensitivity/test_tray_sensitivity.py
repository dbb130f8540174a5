"""Section III for the tray: the linear filter against central differences of the full nonlinear closed loop."""

import numpy as np
import pytest

from salver.control.object import Gains
from salver.geometry import exp
from salver.models.contact.contact import support_contacts
from salver.models.rigid_body import RigidBody, inertia_matrix
from salver.models.uncertain.parameters import INERTIAL, inertial_vector, parameters_of, phi_jacobian, phi_of
from salver.sensitivity.dual import Dual, DualRotation
from salver.sensitivity.tray import TrayLoop
from salver.simulation.closed_loop import rollout
from salver.trajectory import PolynomialReference, min_jerk_line

GAINS = Gains((500.0, 300.0), (25.0, 15.0))
BODY = RigidBody(0.256, np.zeros(3), inertia_matrix([3e-4, 1e-5, 4e-4, 2e-5, -3e-5, 5e-4]))
CUBE = 0.02 * np.array([[1, 1, -1], [-1, 1, -1], [-1, -1, -1], [1, -1, -1]])
GRASP_MAP = support_contacts(CUBE, 0.5).grasp_map
T = np.linspace(0, 1.7, 52)


@pytest.fixture(scope="module")
def tumbling():
    rng = np.random.default_rng(3)
    position = min_jerk_line(1.7, np.zeros(3), np.ones(3), np.eye(3), np.eye(3)).position
    return PolynomialReference(1.7, exp(rng.normal(size=3)), position, 0.7 * rng.normal(size=(6, 3)))


def own(names):
    """The cube's parameters of these names."""
    return [p for p in parameters_of("cube", True) if p.name in names]


def central_differences(reference, names, step):
    """Pi (T, 12, n_p) and Theta (T, n_lambda, n_p) from pairs of nonlinear rollouts; step relative to `SIZE`."""
    nominal = inertial_vector(BODY)
    size = np.concatenate([[0.256], [0.02] * 3, [3e-4] * 6])
    rows = [INERTIAL.index(name) for name in names]
    samples = np.concatenate([nominal + sign * step * size[i] * np.eye(10)[i] for i in rows for sign in (1, -1)])
    phi = phi_of(samples.reshape(-1, 10))
    run = rollout(reference, BODY, GRASP_MAP, GAINS, phi, T)
    width = 2 * step * size[rows]
    state = (run.deviation[::2] - run.deviation[1::2]) / width[:, None, None]
    coefficients = (run.cone_coefficients[::2] - run.cone_coefficients[1::2]) / width[:, None, None]
    return np.moveaxis(state, 0, -1), np.moveaxis(coefficients, 0, -1)


def relative_error(got, expected):
    """Largest error of each parameter's column relative to its own largest entry."""
    return np.abs(got - expected).max(axis=(0, 1)) / np.abs(expected).max(axis=(0, 1))


def test_filter_agrees_with_central_differences_on_a_tumbling_reference(tumbling):
    loop = TrayLoop(BODY, GAINS, phi_jacobian(BODY, "cube", own(INERTIAL)))
    sensitivity = loop.along(tumbling, T)
    state, coefficients = central_differences(tumbling, INERTIAL, 1e-3)
    theta = np.linalg.pinv(GRASP_MAP) @ sensitivity.wrench
    assert np.all(relative_error(sensitivity.state, state) < 1e-4)
    assert np.all(relative_error(theta, coefficients) < 1e-4)


@pytest.mark.slow
def test_what_is_left_of_the_difference_falls_with_the_square_of_the_step(tumbling):
    names = ("mass", "com_x", "inertia_yy")
    loop = TrayLoop(BODY, GAINS, phi_jacobian(BODY, "cube", own(names)))
    state = loop.along(tumbling, T).state
    errors = [relative_error(state, central_differences(tumbling, names, h)[0]) for h in (0.08, 0.04)]
    assert np.all(np.log2(errors[0] / errors[1]) > 1.8)
    assert np.all(np.log2(errors[0] / errors[1]) < 2.2)


def test_wrong_mass_at_rest_sags_by_its_weight_over_the_stiffness():
    resting = min_jerk_line(3.0, np.zeros(3), np.zeros(3), np.eye(3), np.eye(3))
    loop = TrayLoop(BODY, GAINS, phi_jacobian(BODY, "cube", own(("mass",))))
    sensitivity = loop.along(resting, np.linspace(0, 3, 101))
    # m (g + kp dp) = (m + dm) g in balance, so dp = -g dm / (m kp); the wrench takes up all of the new weight.
    assert sensitivity.state[-1, :, 0] == pytest.approx([0, 0, -9.81 / (0.256 * 500), *[0] * 9], abs=1e-9)
    assert sensitivity.wrench[-1, :, 0] == pytest.approx([0, 0, 9.81, 0, 0, 0], abs=1e-8)
    assert not sensitivity.state[0].any()


def test_response_to_mass_does_not_depend_on_orientation(tumbling):
    loop = TrayLoop(BODY, GAINS, phi_jacobian(BODY, "cube", own(("mass",))))
    upright = PolynomialReference(1.7, np.eye(3), tumbling.position)
    assert loop.along(tumbling, T).state[:, :3] == pytest.approx(loop.along(upright, T).state[:, :3], abs=1e-10)


def test_several_matrices_map_a_dual_as_each_of_them_does():
    rng = np.random.default_rng(6)
    one = Dual(rng.normal(size=(5, 1, 3)), rng.normal(size=(5, 1, 3, 4)))
    matrices = rng.normal(size=(7, 3, 3))
    got, each = one.mapped(matrices), [one.mapped(matrix) for matrix in matrices]
    assert got.value == pytest.approx(np.concatenate([x.value for x in each], axis=1), rel=1e-14)
    assert got.tangent == pytest.approx(np.concatenate([x.tangent for x in each], axis=1), abs=1e-14)


def test_duals_carry_derivatives_of_products_and_rotations():
    rng = np.random.default_rng(5)
    z, h = rng.normal(size=4), 1e-6
    A, B, turn = rng.normal(size=(3, 3, 4)), rng.normal(size=(3, 4)), 0.1 * rng.normal(size=(3, 4))
    A = A[0]

    def at(z, tangents):
        a, b = (Dual((m @ z)[None, None], m[None, None] if tangents else None) for m in (A, B))
        # R(z) = R0 Exp(turn (z - z0)): exact derivative dtheta = turn at z0.
        rotation = DualRotation(exp(turn @ (z - z0))[None, None], turn[None, None] if tangents else None)
        return a.cross(b.mapped(np.diag([1.0, 2.0, 3.0]))) + rotation.to_world(a) - rotation.to_body(b).scaled(0.5)

    z0 = z.copy()
    got = at(z, True).tangent[0, 0]
    for j in range(4):
        step = h * np.eye(4)[j]
        numeric = (at(z + step, False).value - at(z - step, False).value)[0, 0] / (2 * h)
        assert got[:, j] == pytest.approx(numeric, abs=1e-8)
