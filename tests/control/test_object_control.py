"""The object's plant and controller: eqs (18), (19)."""

import numpy as np
import pytest

from object_controller import distribute, errors, wrench_command
from salver import scenario
from salver.control.object import Gains, acceleration, command
from salver.geometry import GRAVITY_S, exp, log, right_jacobian_inverse
from salver.models.rigid_body import RigidBody
from salver.trajectory import MotionSamples, PolynomialReference

GAINS = Gains(kp=(500.0, 300.0), kd=(25.0, 15.0))
CUBE = scenario.load("panda-cube").payload.first


@pytest.fixture
def rng():
    return np.random.default_rng(7)


def tumbling(rng) -> PolynomialReference:
    return PolynomialReference(1.3, exp([0.4, -0.3, 1.0]), 0.2 * rng.normal(size=(7, 3)), 1.5 * rng.normal(size=(5, 3)))


def random_body(rng) -> RigidBody:
    axes = exp(rng.normal(size=3))
    return RigidBody(0.7, np.array([0.03, -0.02, 0.05]), axes @ np.diag([2e-3, 3e-3, 4.5e-3]) @ axes.T)


def state_at_offset(reference: PolynomialReference, t: float, rng):
    """A state that deviates a lot from the reference at t."""
    m = reference.sample(t)
    dp, dtheta, dv, domega = rng.normal(size=(4, 3)) * np.array([[0.05], [0.6], [0.4], [1.0]])
    return m, m.p_SB + dp, m.R_SB @ exp(dtheta), m.v_S + dv, m.omega_B + domega


def test_plant_obeys_newton_and_euler_at_the_true_centre_of_mass(rng):
    body = random_body(rng)
    R, omega, force, torque = exp(rng.normal(size=3)), *rng.normal(size=(3, 3))
    a_S, alpha = acceleration(body.phi, R, omega, np.concatenate([force, torque]))
    c = body.com_B
    a_com_S = a_S + R @ (np.cross(alpha, c) + np.cross(omega, np.cross(omega, c)))
    np.testing.assert_allclose(body.mass * a_com_S, R @ force + body.mass * GRAVITY_S, atol=1e-12)
    inertia = body.inertia_com
    euler = inertia @ alpha + np.cross(omega, inertia @ omega)
    np.testing.assert_allclose(euler, torque - np.cross(c, force), atol=1e-12)


def test_cube_at_rest_is_held_by_sixteen_equal_coefficients():
    still = np.zeros((1, 3))
    reference = MotionSamples(np.zeros(1), still, still, still, np.eye(3)[None], still, still)
    wrench = wrench_command(GAINS, CUBE.inertial.phi, reference, still, np.eye(3)[None], still, still)
    np.testing.assert_allclose(wrench, [[0, 0, 0.256 * 9.81, 0, 0, 0]], atol=1e-14)
    # Each unit edge has a vertical part 1 / sqrt(1 + 0.5^2); 16 of them share the weight.
    expected = 0.256 * 9.81 / 16 * np.sqrt(1.25)
    np.testing.assert_allclose(distribute(CUBE.contacts.grasp_map, wrench), np.full((1, 16), expected), rtol=1e-12)
    assert expected == pytest.approx(0.1755, abs=5e-5)


def test_distribution_produces_the_wrench_with_least_norm(rng):
    grasp_map, wrench = CUBE.contacts.grasp_map, rng.normal(size=(4, 6))
    coefficients = distribute(grasp_map, wrench)
    np.testing.assert_allclose(coefficients @ grasp_map.T, wrench, atol=1e-12)
    least = np.array([np.linalg.lstsq(grasp_map, w, rcond=None)[0] for w in wrench])
    np.testing.assert_allclose(coefficients, least, atol=1e-12)


def test_nominal_closed_loop_accelerates_as_commanded(rng):
    reference, body = tumbling(rng), random_body(rng)
    m, p, R, v, omega = state_at_offset(reference, 0.4, rng)
    wrench = wrench_command(GAINS, body.phi, m, p, R, v, omega)
    a_S, alpha_B = acceleration(body.phi, R, omega, wrench)
    a_cmd, alpha_cmd = command(GAINS, m, errors(m, p, R, v, omega))
    np.testing.assert_allclose(a_S, a_cmd, atol=1e-10)
    np.testing.assert_allclose(alpha_B, alpha_cmd, atol=1e-9)


def test_error_dynamics_far_from_the_reference_are_those_claimed(rng):
    """Central differences of the errors along the true motion of the nominal plant, at large errors."""
    reference, body, t = tumbling(rng), random_body(rng), 0.6
    m, p, R, v, omega = state_at_offset(reference, t, rng)
    error = errors(m, p, R, v, omega)
    a_S, alpha_B = acceleration(body.phi, R, omega, wrench_command(GAINS, body.phi, m, p, R, v, omega))

    def errors_after(h: float):
        turn = h * omega + h**2 / 2 * alpha_B  # exact to O(h^3), and the next term is odd in h
        state = p + h * v + h**2 / 2 * a_S, R @ exp(turn), v + h * a_S, omega + h * alpha_B
        return errors(reference.sample(t + h), *state)

    h = 1e-5
    ahead, behind = errors_after(h), errors_after(-h)
    rate = {
        name: (getattr(ahead, name) - getattr(behind, name)) / (2 * h) for name in vars(error) if name != "transport"
    }
    (kp, kp_R), (kd, kd_R) = GAINS.kp, GAINS.kd
    np.testing.assert_allclose(rate["position_S"], error.velocity_S, atol=1e-6)
    np.testing.assert_allclose(rate["velocity_S"], -kd * error.velocity_S - kp * error.position_S, atol=1e-5)
    left_jacobian_inverse = right_jacobian_inverse(-error.rotation_B)[0]
    np.testing.assert_allclose(rate["rotation_B"][0], left_jacobian_inverse @ error.omega_B[0], atol=1e-6)
    np.testing.assert_allclose(rate["omega_B"], -kd_R * error.omega_B - kp_R * error.rotation_B, atol=1e-5)


def test_small_errors_are_minus_the_deviation_of_the_state(rng):
    """dx = -e to first order: the tangent of docs/conventions.md."""
    reference, size = tumbling(rng), 1e-6
    m = reference.sample(0.5)
    dp, dtheta, dv, domega = size * rng.normal(size=(4, 3))
    error = errors(m, m.p_SB + dp, m.R_SB @ exp(dtheta), m.v_S + dv, m.omega_B + domega)
    np.testing.assert_allclose(error.position_S[0], -dp, atol=1e-15)
    np.testing.assert_allclose(error.velocity_S[0], -dv, atol=1e-15)
    np.testing.assert_allclose(error.rotation_B[0], -dtheta, atol=1e-15)
    # domega = -e_w - dtheta x omega, because E turns with the object.
    expected = -error.omega_B[0] - np.cross(dtheta, m.omega_B[0])
    np.testing.assert_allclose(domega, expected, atol=1e-11)
    np.testing.assert_allclose(error.rotation_B[0], log(exp(-dtheta)), atol=1e-15)


def test_turning_the_world_about_the_vertical_changes_no_contact_force(rng):
    reference, turn = tumbling(rng), exp([0.0, 0.0, 1.1])
    m, p, R, v, omega = state_at_offset(reference, 0.9, rng)
    turned = MotionSamples(m.t, m.p_SB @ turn.T, m.v_S @ turn.T, m.a_S @ turn.T, turn @ m.R_SB, m.omega_B, m.alpha_B)
    phi = CUBE.inertial.phi
    before = wrench_command(GAINS, phi, m, p, R, v, omega)
    after = wrench_command(GAINS, phi, turned, p @ turn.T, turn @ R, v @ turn.T, omega)
    np.testing.assert_allclose(after, before, atol=1e-10)


def test_one_instant_of_the_reference_serves_many_states(rng):
    reference = tumbling(rng)
    m = reference.sample(0.3)
    dtheta = 0.2 * rng.normal(size=(5, 3))
    p, R, v, omega = m.p_SB + dtheta, m.R_SB @ exp(dtheta), np.tile(m.v_S, (5, 1)), m.omega_B - dtheta
    together = wrench_command(GAINS, CUBE.inertial.phi, m, p, R, v, omega)
    single = [wrench_command(GAINS, CUBE.inertial.phi, m, p[[i]], R[[i]], v[[i]], omega[[i]])[0] for i in range(5)]
    np.testing.assert_allclose(together, single, atol=1e-13)
