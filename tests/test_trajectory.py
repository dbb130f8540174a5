"""Eqs (14), (15), (26): boundary conditions, SO(3) integration, and derivatives that are derivatives."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import BPoly

from salver import trajectory
from salver.geometry import exp, hat, log
from salver.planning.verification import passed
from salver.trajectory import (
    JointMotion,
    PolynomialReference,
    SampledReference,
    boundary_map,
    boundary_solution,
    geodesic_angular_velocity,
    min_jerk_line,
    position_boundary,
)

START, GOAL = np.array([0.5, -0.3, 0.4]), np.array([0.4, 0.1, 0.5])
YAW, TILT = exp(np.array([0, 0, np.pi / 2])), exp(np.array([np.deg2rad(20), 0, 0]))


@pytest.fixture
def tumbling():
    rng = np.random.default_rng(3)
    return PolynomialReference(1.7, exp(rng.normal(size=3)), rng.normal(size=(10, 3)), 0.7 * rng.normal(size=(6, 3)))


@pytest.mark.parametrize("degree", [5, 6, 9, 20, 30])
@pytest.mark.parametrize("goal_rotation", [np.eye(3), YAW, TILT, YAW @ TILT])
def test_rest_to_rest_boundary_conditions_hold_to_1e_9(degree, goal_rotation):
    position = boundary_solution(degree, position_boundary(1.3, START, GOAL)).particular
    reference = PolynomialReference(1.3, TILT, position, geodesic_angular_velocity(1.3, TILT, goal_rotation))
    ends = reference.sample([0.0, 1.3])
    assert ends.p_SB == pytest.approx(np.stack([START, GOAL]), abs=1e-12)
    for still in (ends.v_S, ends.a_S, ends.omega_B, ends.alpha_B):
        assert np.abs(still).max() < 1e-9
    assert np.abs(log(np.stack([TILT, goal_rotation]).swapaxes(1, 2) @ ends.R_SB)).max() < 1e-9


def test_boundary_map_is_well_conditioned_where_monomials_are_not():
    assert np.linalg.cond(boundary_map(12)) < 1e4
    monomials = np.vander(np.linspace(0, 1, 13), 13)
    assert np.linalg.cond(monomials) > 1e8


def test_all_solutions_share_the_boundary_and_the_particular_one_is_shortest():
    values = position_boundary(1.0, START, GOAL)
    solution = boundary_solution(9, values)
    rng = np.random.default_rng(0)
    other = solution.particular + solution.null_space @ rng.normal(size=(4, 3))
    assert boundary_map(9) @ other == pytest.approx(values, abs=1e-9)
    assert np.linalg.norm(solution.particular) < np.linalg.norm(other)
    assert solution.null_space.T @ solution.null_space == pytest.approx(np.eye(4), abs=1e-12)


def test_min_jerk_line_is_the_known_quintic():
    line = min_jerk_line(2.0, START, GOAL, np.eye(3), YAW)
    t = np.linspace(0, 2, 11)
    u = t / 2
    profile = 10 * u**3 - 15 * u**4 + 6 * u**5
    samples = line.sample(t)
    assert samples.p_SB == pytest.approx(START + profile[:, None] * (GOAL - START), abs=1e-12)
    assert np.abs(log(exp(profile[:, None] * np.array([0, 0, -np.pi / 2])) @ samples.R_SB)).max() < 1e-12


def test_orientation_agrees_with_an_independent_integrator(tumbling):
    answer = solve_ivp(
        lambda t, r: (r.reshape(3, 3) @ hat(tumbling.sample(t).omega_B[0])).ravel(),
        (0, 1.7),
        tumbling.R_start.ravel(),
        method="DOP853",
        rtol=1e-12,
        atol=1e-13,
    )
    assert tumbling.sample(1.7).R_SB[0] == pytest.approx(answer.y[:, -1].reshape(3, 3), abs=1e-9)


def test_magnus_steps_converge_with_sixth_order(tumbling, monkeypatch):
    monkeypatch.setattr(trajectory, "ROTATION_STEPS", 512)
    exact = replace(tumbling).sample(1.7).R_SB
    errors = []
    for steps in (16, 32):
        monkeypatch.setattr(trajectory, "ROTATION_STEPS", steps)
        errors.append(np.abs(replace(tumbling).sample(1.7).R_SB - exact).max())
    assert np.log2(errors[0] / errors[1]) > 5.5


@pytest.mark.parametrize("offset", [np.zeros(3), np.array([0.1, -0.2, 0.3])])
def test_rates_are_derivatives_of_poses(tumbling, offset):
    def at(t):
        return tumbling.sample(t).of_frame(offset, TILT)

    h, t = 1e-5, np.linspace(0.2, 1.5, 7)
    ahead, here, behind = at(t + h), at(t), at(t - h)
    assert here.v_S == pytest.approx((ahead.p_SB - behind.p_SB) / (2 * h), rel=1e-6, abs=1e-6)
    assert here.a_S == pytest.approx((ahead.v_S - behind.v_S) / (2 * h), rel=1e-6, abs=1e-5)
    assert here.omega_B == pytest.approx(log(behind.R_SB.swapaxes(1, 2) @ ahead.R_SB) / (2 * h), rel=1e-6, abs=1e-6)
    assert here.alpha_B == pytest.approx((ahead.omega_B - behind.omega_B) / (2 * h), rel=1e-6, abs=1e-6)


def test_sampled_reference_reproduces_the_motion_it_was_sampled_from(tumbling):
    errors = []
    for n in (100, 200):
        again = SampledReference(tumbling.sample(np.linspace(0, 1.7, n)))
        t = np.linspace(0, 1.7, 777)
        made, true = again.sample(t), tumbling.sample(t)
        assert made.R_SB @ made.R_SB.swapaxes(1, 2) == pytest.approx(np.broadcast_to(np.eye(3), (777, 3, 3)))
        errors.append([np.abs(getattr(made, k) - getattr(true, k)).max() for k in ("p_SB", "R_SB", "a_S", "alpha_B")])
    assert max(errors[1][:2]) < 1e-8
    assert np.all(np.log2(np.array(errors[0]) / errors[1])[:2] > 5)  # sixth order in the pose
    assert np.all(np.log2(np.array(errors[0]) / errors[1])[2:] > 3)  # fourth in its second derivative


def test_references_rest_before_their_start_and_after_their_end(tumbling):
    for reference in (tumbling, SampledReference(tumbling.sample(np.linspace(0, 1.7, 50)))):
        outside = reference.sample([-1.0, 3.0])
        assert outside.p_SB == pytest.approx(tumbling.sample([0, 1.7]).p_SB)
        assert not outside.v_S.any()
        assert not outside.alpha_B.any()


def test_jerk_jumps_where_two_pieces_of_a_joint_motion_meet():
    """A first piece t^3, whose jerk is 6 everywhere, and a second one 1 + 3 u + 3 u^2 + u^4, whose jerk is 24 u."""
    t, states = np.array([0.0, 1.0, 1.5]), np.array([[0, 0, 0], [1, 3, 6], [3.3125, 6.5, 9]]).T[:, :, None]
    motion = JointMotion(t, *states)
    np.testing.assert_allclose(motion.jerk_before[:, 0], [6, 6, 12], atol=1e-12)
    np.testing.assert_allclose(motion.jerk(t)[:, 0], [6, 0, 12], atol=1e-12)


def test_joint_motion_interpolates_position_rate_and_acceleration():
    t = np.linspace(0, 2, 41)
    motion = JointMotion(t, *(np.stack([f(t), 2 * f(t)], axis=1) for f in (np.sin, np.cos, lambda x: -np.sin(x))))
    fine = np.linspace(0, 2, 333)
    q, dq, ddq = motion.sample(fine)
    assert q[:, 0] == pytest.approx(np.sin(fine), abs=1e-10)
    assert dq[:, 1] == pytest.approx(2 * np.cos(fine), abs=1e-8)
    assert ddq[:, 0] == pytest.approx(-np.sin(fine), abs=1e-6)
    assert motion.jerk(fine)[:, 0] == pytest.approx(-np.cos(fine), abs=1e-3)


def test_piecewise_quintics_are_those_of_scipy_with_derivatives_and_at_breaks_too():
    rng = np.random.default_rng(0)
    breaks = np.sort(rng.uniform(-1, 2, 9))
    coefficients = rng.normal(size=(6, 8, 3))
    t = np.concatenate([breaks, rng.uniform(breaks[0], breaks[-1], 60)])
    ours, theirs = trajectory.Quintics(breaks, coefficients), BPoly(coefficients, breaks)
    for order in range(4):
        expected = (theirs.derivative(order) if order else theirs)(t)
        assert ours.at(t, order) == pytest.approx(expected, rel=1e-12, abs=1e-12 * np.abs(expected).max())


@pytest.mark.parametrize("yaw_free", [False, True])
def test_how_near_a_motion_passes_a_pose_by_hand(yaw_free):
    """A straight line past a pose 30 mm beside its middle, turned by 0.3 rad about the vertical and leaning by 0.1."""
    line = min_jerk_line(2.0, np.zeros(3), np.array([1.0, 0, 0]), np.eye(3), np.eye(3))
    beside = np.array([0.5, 0.03, 0.0])
    ((when, away),) = passed(line, [(beside, exp([0.0, 0.0, 0.3]))], yaw_free)
    assert when == pytest.approx(1.0, abs=1e-3)
    assert away == pytest.approx(0.03 if yaw_free else np.hypot(0.03, 0.2 * 0.3), abs=1e-6)
    ((_, away),) = passed(line, [(beside, exp([0.1, 0.0, 0.0]))], yaw_free)
    assert away == pytest.approx(np.hypot(0.03, 0.2 * (np.sin(0.1) if yaw_free else 0.1)), abs=1e-6)


def test_bases_of_no_instants_are_none() -> None:
    """A run that ended before its first sample is logged too."""
    from salver.trajectory import chebyshev_bases

    assert [basis.shape for basis in chebyshev_bases(np.empty(0), 9, range(3))] == [(0, 10)] * 3
