"""Group laws of SO(3) and SE(3), on seeded random elements, near the identity, and near half a turn."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from salver import geometry as g

N = 200


def _rng():
    return np.random.default_rng(20240)


def _vectors(scale=1.0):
    return scale * _rng().normal(size=(N, 3))


def _rotation_vectors():
    """Angles from 1e-12 rad to just below pi, around random axes."""
    rng = _rng()
    axes = rng.normal(size=(N, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    angles = np.concatenate([np.geomspace(1e-12, 1e-2, N // 2), np.linspace(0.02, np.pi - 1e-9, N - N // 2)])
    return axes * angles[:, None]


def _poses(seed):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(N, 3)), Rotation.random(N, random_state=rng).as_matrix()


def _close(a, b, tol=1e-12):
    np.testing.assert_allclose(a, b, rtol=0, atol=tol)


def test_hat_is_the_cross_product_and_vee_its_inverse():
    x, y = _vectors(), _vectors()[::-1]
    _close(np.einsum("nij,nj->ni", g.hat(x), y), np.cross(x, y))
    _close(g.vee(g.hat(x)), x)


def test_exp_agrees_with_the_matrix_exponential():
    theta = _rotation_vectors()
    _close(g.exp(theta), np.array([expm(g.hat(t)) for t in theta]), 1e-13)


def test_exp_gives_rotations():
    R = g.exp(_rotation_vectors())
    _close(np.swapaxes(R, 1, 2) @ R, np.broadcast_to(np.eye(3), R.shape), 1e-14)
    _close(np.linalg.det(R), 1.0, 1e-14)


def test_log_inverts_exp_at_every_angle_below_pi():
    theta = _rotation_vectors()
    _close(g.log(g.exp(theta)), theta, 2e-15 + 1e-12)


def test_log_keeps_relative_accuracy_at_tiny_angles():
    theta = _rotation_vectors()[: N // 2]
    error = np.linalg.norm(g.log(g.exp(theta)) - theta, axis=1)
    assert np.all(error <= 1e-12 * np.linalg.norm(theta, axis=1) + 1e-16)


def test_half_a_turn():
    for axis in np.eye(3):
        R = g.exp(np.pi * axis)
        _close(np.abs(g.log(R)), np.pi * axis, 1e-12)
        _close(g.exp(g.log(R)), R, 1e-12)


def test_exp_turns_along_one_axis_add():
    theta = _rotation_vectors()
    _close(g.exp(0.3 * theta) @ g.exp(0.7 * theta), g.exp(theta), 1e-13)
    _close(g.exp(-theta), np.swapaxes(g.exp(theta), 1, 2), 1e-15)


def test_rotation_conjugates_its_axis():
    """R Exp(theta) R^T = Exp(R theta)."""
    theta, (_, R) = _rotation_vectors(), _poses(1)
    turned = np.einsum("nij,nj->ni", R, theta)
    _close(R @ g.exp(theta) @ np.swapaxes(R, 1, 2), g.exp(turned), 1e-13)


def test_quaternions_there_and_back():
    _, R = _poses(2)
    R = np.concatenate([R, g.exp(_rotation_vectors()), [np.diag(d) for d in ([1, -1, -1], [-1, 1, -1], [-1, -1, 1])]])
    quat = g.quat_wxyz_from_matrix(R)
    assert np.all(quat[:, 0] >= 0)
    _close(np.linalg.norm(quat, axis=1), 1.0, 1e-15)
    _close(g.matrix_from_quat_wxyz(quat), R, 1e-14)
    _close(g.matrix_from_quat_wxyz(-3 * quat), R, 1e-14)


def test_quaternion_order_is_wxyz():
    _, R = _poses(3)
    xyzw = Rotation.from_matrix(R).as_quat(canonical=True)
    _close(g.quat_wxyz_from_matrix(R), xyzw[:, [3, 0, 1, 2]], 1e-14)
    quarter = np.sqrt(0.5)
    _close(g.matrix_from_quat_wxyz([quarter, 0, 0, quarter]) @ [1, 0, 0], [0, 1, 0], 1e-15)


def test_roll_pitch_yaw_turns_about_fixed_axes():
    rpy = _vectors()
    _close(g.matrix_from_rpy(rpy), Rotation.from_euler("xyz", rpy).as_matrix(), 1e-14)


@pytest.mark.parametrize("scale", [1e-9, 1e-5, 1e-3, 0.1, 1.0, 2.5, 5.5])
def test_inverse_of_the_right_jacobian_undoes_the_derivative_of_exp(scale):
    theta = scale * np.array([[0.6, -0.64, 0.48]])
    inverse = g.right_jacobian_inverse(theta)[0]
    step = 1e-6
    numeric = np.zeros((3, 3))
    for axis in range(3):
        d = step * np.eye(3)[axis]
        change = g.log(g.exp(-theta) @ g.exp(theta + d)) - g.log(g.exp(-theta) @ g.exp(theta - d))
        numeric[:, axis] = change[0] / (2 * step)
    _close(inverse @ numeric, np.eye(3), 1e-8)


def test_poses_form_a_group():
    a, b, c = _poses(4), _poses(5), _poses(6)
    for left, right in zip(g.compose(*g.compose(*a, *b), *c), g.compose(*a, *g.compose(*b, *c)), strict=True):
        _close(left, right)
    p, R = g.compose(*a, *g.invert(*a))
    _close(p, 0.0)
    _close(R, np.broadcast_to(np.eye(3), R.shape), 1e-14)


def test_compose_acts_on_points_one_after_the_other():
    (p_AB, R_AB), (p_BC, R_BC) = _poses(7), _poses(8)
    x_C = _vectors()
    x_B = np.einsum("nij,nj->ni", R_BC, x_C) + p_BC
    x_A = np.einsum("nij,nj->ni", R_AB, x_B) + p_AB
    p_AC, R_AC = g.compose(p_AB, R_AB, p_BC, R_BC)
    _close(np.einsum("nij,nj->ni", R_AC, x_C) + p_AC, x_A)


def test_adjoint_is_a_homomorphism():
    a, b = _poses(9), _poses(10)
    _close(g.adjoint(*g.compose(*a, *b)), g.adjoint(*a) @ g.adjoint(*b))
    _close(np.linalg.inv(g.adjoint(*a)), g.adjoint(*g.invert(*a)), 1e-11)


def test_adjoint_moves_the_velocity_of_a_turning_body():
    """A body turning about B's origin with omega carries A's origin along with omega x p_BA."""
    p, R = _poses(11)
    omega_B = _vectors()
    twist_A = np.einsum("nij,nj->ni", g.adjoint(p, R), np.concatenate([np.zeros((N, 3)), omega_B], axis=1))
    omega_A = np.einsum("nij,nj->ni", R, omega_B)
    _close(twist_A[:, 3:], omega_A)
    _close(twist_A[:, :3], np.cross(omega_A, -p))


def test_power_does_not_depend_on_the_frame():
    p, R = _poses(12)
    rng = _rng()
    twist_B, wrench_A = rng.normal(size=(2, N, 6))
    ad = g.adjoint(p, R)
    twist_A = np.einsum("nij,nj->ni", ad, twist_B)
    wrench_B = np.einsum("nji,nj->ni", ad, wrench_A)
    _close(np.sum(twist_A * wrench_A, axis=1), np.sum(twist_B * wrench_B, axis=1))


def test_transposed_inverse_adjoint_has_the_lower_left_block_of_eq_3():
    p, R = _poses(13)
    transposed = np.swapaxes(g.adjoint(*g.invert(p, R)), 1, 2)
    _close(transposed[:, 3:, :3], g.hat(p) @ R)
    _close(transposed[:, :3, 3:], 0.0)


def test_leading_axes_are_kept():
    theta = _vectors().reshape(4, 5, 10, 3)
    assert g.exp(theta).shape == (4, 5, 10, 3, 3)
    _close(g.log(g.exp(theta[2, 3, 4])), g.log(g.exp(theta))[2, 3, 4], 0)
    assert g.adjoint(theta, g.exp(theta)).shape == (4, 5, 10, 6, 6)
    assert g.exp(np.zeros(3)).shape == (3, 3)


def test_gravity_cannot_be_changed_by_accident():
    with pytest.raises(ValueError, match="read-only"):
        g.GRAVITY_S[2] = 0.0


def test_cross_is_numpys():
    rng = np.random.default_rng(3)
    a, b = rng.normal(size=(5, 1, 3)), rng.normal(size=(4, 3))
    assert np.array_equal(g.cross(a, b), np.cross(a, b))
