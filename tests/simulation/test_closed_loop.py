"""The nonlinear closed loop under wrong parameters, and tube coverage."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from salver import scenario
from salver.control.object import Gains
from salver.geometry import GRAVITY_S, exp, hat, log, matrix_from_quat_wxyz, quat_wxyz_from_matrix
from salver.models.rigid_body import RigidBody
from salver.models.uncertain.parameters import inertial_vector, parameters_of, phi_jacobian, phi_of
from salver.sensitivity.tray import TrayLoop
from salver.sensitivity.tubes import excess
from salver.simulation.closed_loop import rollout
from salver.trajectory import PolynomialReference, min_jerk_line

GAINS = Gains(kp=(500.0, 300.0), kd=(25.0, 15.0))
CUBE = scenario.load("panda-cube").payload.first
GRASP_MAP = CUBE.contacts.grasp_map
MOVE = min_jerk_line(
    2.5, np.array([0.54237, -0.370574, 0.4]), np.array([0.444272, 0.100574, 0.4]), np.eye(3), np.eye(3)
)


def own(names):
    """The cube's parameters of these names."""
    return [p for p in parameters_of("cube", True) if p.name in names]


def tumbling() -> PolynomialReference:
    rng = np.random.default_rng(3)
    return PolynomialReference(1.0, exp([0.4, -0.3, 1.0]), 0.2 * rng.normal(size=(7, 3)), 1.5 * rng.normal(size=(5, 3)))


def perturbed(n: int, com: float = 0.004, seed: int = 5) -> np.ndarray:
    """phi of n cubes with mass, inertia off by up to 20 %, centre of mass by `com`; 4 mm turn them 60 deg."""
    rng = np.random.default_rng(seed)
    values = np.tile(inertial_vector(CUBE.inertial), (n, 1))
    values[:, [0, 4, 6, 9]] *= 1 + rng.uniform(-0.2, 0.2, (n, 4))
    values[:, 1:4] += rng.uniform(-com, com, (n, 3))
    values[:, [5, 7, 8]] += rng.uniform(-3e-5, 3e-5, (n, 3))
    return phi_of(values)


def test_agrees_with_the_textbook_equations_integrated_in_absolute_coordinates():
    """Newton and Euler at the true centre of mass, a quaternion, an adaptive solver, the law written out."""
    reference, phi, start = tumbling(), perturbed(1)[0], np.array([0.02, -0.01, 0.015])
    true, nominal = RigidBody.from_phi(phi), CUBE.inertial
    m, c, inertia = true.mass, true.com_B, true.inertia_com
    (kp, kp_R), (kd, kd_R) = GAINS.kp, GAINS.kd
    m0, inertia0 = nominal.mass, nominal.inertia_com
    inverse = np.linalg.pinv(GRASP_MAP)

    def split(x):
        return x[:3], matrix_from_quat_wxyz(x[3:7]), x[7:10], x[10:13]

    def law(t, x):
        p, R, v, w = split(x)
        s = reference.sample(t)
        E = R.T @ s.R_SB[0]
        wt = E @ s.omega_B[0]
        a = s.a_S[0] + kd * (s.v_S[0] - v) + kp * (s.p_SB[0] - p)
        alpha = E @ s.alpha_B[0] - np.cross(w, wt) + kd_R * (wt - w) + kp_R * log(E)
        force = m0 * R.T @ (a - GRAVITY_S)
        torque = inertia0 @ alpha + np.cross(w, inertia0 @ w)
        return inverse @ np.concatenate([force, torque])

    def rate(t, x):
        _, R, v, w = split(x)
        wrench = GRASP_MAP @ law(t, x)
        force, torque = wrench[:3], wrench[3:] - np.cross(c, wrench[:3])
        alpha = np.linalg.solve(inertia, torque - np.cross(w, inertia @ w))
        a_com = R @ force / m + GRAVITY_S
        a = a_com - R @ (np.cross(alpha, c) + np.cross(w, np.cross(w, c)))
        q = x[3:7]
        dq = 0.5 * np.concatenate([[-q[1:] @ w], q[0] * w + hat(q[1:]) @ w])
        return np.concatenate([v, dq, a, alpha])

    times = np.array([0.05, 0.1, 0.2, 0.25])
    s0 = reference.sample(0.0)
    x0 = np.concatenate(
        [s0.p_SB[0] + start, quat_wxyz_from_matrix(s0.R_SB[0] @ exp(3 * start)), s0.v_S[0], s0.omega_B[0] - start]
    )
    solution = solve_ivp(rate, (0, 0.25), x0, method="DOP853", t_eval=times, rtol=1e-11, atol=1e-12).y.T
    s = reference.sample(times)
    states = [split(x) for x in solution]
    expected = np.array(
        [
            np.concatenate([p - s.p_SB[i], log(s.R_SB[i].T @ R), v - s.v_S[i], w - s.omega_B[i]])
            for i, (p, R, v, w) in enumerate(states)
        ]
    )
    start12 = np.concatenate([start, 3 * start, np.zeros(3), -start])
    result = rollout(reference, nominal, GRASP_MAP, GAINS, phi, times, start12, max_step=0.005)
    np.testing.assert_allclose(result.deviation[0], expected, atol=1e-8 * np.abs(expected).max())
    inputs = np.array([law(t, x) for t, x in zip(times, solution, strict=True)])
    np.testing.assert_allclose(result.cone_coefficients[0], inputs, atol=1e-7)


def test_knowing_the_truth_means_no_deviation():
    result = rollout(tumbling(), CUBE.inertial, GRASP_MAP, GAINS, CUBE.inertial.phi, np.linspace(0, 1, 11))
    assert np.abs(result.deviation).max() < 1e-11  # rounding of angular accelerations of nearly 100 rad/s^2


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_one_that_diverges_leaves_the_others_alone():
    """A body of a hundredth of the mass makes the loop a hundred times as fast, too fast for the steps."""
    phi, t = CUBE.inertial.phi * np.array([[1.1], [0.01], [0.9]]), np.linspace(0, 0.5, 3)
    start = 0.01 * np.random.default_rng(2).normal(size=(3, 12))
    together = rollout(tumbling(), CUBE.inertial, GRASP_MAP, GAINS, phi, t, start, max_step=0.02)
    assert np.isnan(together.deviation[1, -1]).all()
    for k in (0, 2):
        alone = rollout(tumbling(), CUBE.inertial, GRASP_MAP, GAINS, phi[k], t, start[k], max_step=0.02)
        np.testing.assert_allclose(together.deviation[k], alone.deviation[0], rtol=1e-12, atol=1e-15)
        np.testing.assert_allclose(together.cone_coefficients[k], alone.cone_coefficients[0], rtol=1e-12, atol=1e-12)


def test_wrong_mass_at_rest_sags_as_the_oscillator_it_is():
    """e'' = -r (kd e' + kp e) + (1 - r) g with r = m_n / m: a heavy cube sinks to g (m / m_n - 1) / kp."""
    p = np.array([0.5, 0.0, 0.4])
    still = min_jerk_line(1.0, p, p, np.eye(3), np.eye(3))
    ratio = 1 / 1.1
    t = np.linspace(0, 3, 31)
    phi = CUBE.inertial.phi * np.array([1.1] + 9 * [1.0])
    result = rollout(still, CUBE.inertial, GRASP_MAP, GAINS, phi, t)
    dynamics = np.array([[0, 1, 0], [-500 * ratio, -25 * ratio, -(1 - ratio) * 9.81], [0, 0, 0]])
    expected = np.array([expm(dynamics * ti) @ [0, 0, 1] for ti in t])
    np.testing.assert_allclose(
        result.deviation[0][:, [2, 8]], expected[:, :2], atol=1e-6 * np.abs(expected[:, :2]).max()
    )
    assert result.deviation[0, -1, 2] == pytest.approx(-0.1 * 9.81 / 500, rel=1e-9)
    others = np.delete(result.deviation[0], [2, 8], axis=1)
    assert np.abs(others).max() < 1e-12
    np.testing.assert_allclose(result.cone_coefficients[0, -1], 1.1 * 0.256 * 9.81 / 16 * np.sqrt(1.25), rtol=1e-8)


@pytest.mark.slow
def test_displaced_centre_of_mass_needs_the_torque_of_its_weight():
    """In equilibrium the controller's torque carries m g c: kp_R I_n tilt = m g x (after gravity turns with B)."""
    p = np.array([0.5, 0.0, 0.4])
    still = min_jerk_line(1.0, p, p, np.eye(3), np.eye(3))
    values = inertial_vector(CUBE.inertial)
    values[1] = 0.002
    result = rollout(still, CUBE.inertial, GRASP_MAP, GAINS, phi_of(values), np.array([0.0, 6.0]))
    wrench = GRASP_MAP @ result.cone_coefficients[0, -1]
    tilt = result.deviation[0, -1, 3:6]
    weight_B = exp(tilt).T @ np.array([0, 0, 0.256 * 9.81])
    np.testing.assert_allclose(wrench[:3], weight_B, atol=1e-9)
    np.testing.assert_allclose(wrench[3:], np.cross(values[1:4], weight_B), atol=1e-9)
    np.testing.assert_allclose(wrench[3:], -300 * CUBE.inertial.inertia_com @ tilt, atol=1e-9)
    assert abs(tilt[1]) > 0.04  # 2 mm of offset tilts the object by 3 degrees: the effect is not small


def test_initial_deviation_decays_as_the_nominal_error_dynamics():
    offset = np.array([0.01, 0, -0.02, 0, 0, 0, 0.1, 0.0, 0.05, 0, 0, 0])
    t = np.linspace(0, 0.6, 7)
    result = rollout(MOVE, CUBE.inertial, GRASP_MAP, GAINS, CUBE.inertial.phi, t, offset)
    dynamics = np.array([[0.0, 1.0], [-500.0, -25.0]])
    for axis in range(3):
        expected = np.array([expm(dynamics * ti) @ offset[[axis, 6 + axis]] for ti in t])
        np.testing.assert_allclose(result.deviation[0][:, [axis, 6 + axis]], expected, atol=1e-7)


@pytest.mark.slow
def test_default_step_errs_by_less_than_a_millionth_and_the_order_is_eight():
    """Relative to the largest deviation, which is half a radian here."""
    reference, phi = tumbling(), perturbed(10, com=0.002)
    t = np.sort(np.append(np.random.default_rng(0).uniform(0, 1, 25), [0.4, 0.8, 1.0]))

    def run(step):
        result = rollout(reference, CUBE.inertial, GRASP_MAP, GAINS, phi, t, max_step=step)
        return np.concatenate([result.deviation, result.cone_coefficients], axis=-1)

    fine = run(0.005)
    size = np.abs(fine - fine.mean(axis=0)).max(axis=(0, 1))
    assert size[3:6].max() > 0.4

    def error(step):
        return float((np.abs(run(step) - fine).max(axis=(0, 1)) / size).max())

    assert 1e-9 < error(None) < 1e-6  # a finer one would cost time and gain nothing
    assert np.log2(error(0.04) / error(0.01)) / 2 > 7


@pytest.mark.slow
def test_a_record_does_not_depend_on_the_other_samples_or_on_the_other_times():
    phi, t = perturbed(6), np.linspace(0, 1, 6)
    together = rollout(tumbling(), CUBE.inertial, GRASP_MAP, GAINS, phi, t)
    alone = rollout(tumbling(), CUBE.inertial, GRASP_MAP, GAINS, phi[4], t)
    np.testing.assert_allclose(together.deviation[4], alone.deviation[0], rtol=1e-12, atol=1e-14)
    sparse = rollout(tumbling(), CUBE.inertial, GRASP_MAP, GAINS, phi, t[[2, 5]])
    np.testing.assert_array_equal(sparse.deviation, together.deviation[:, [2, 5]])
    again = rollout(tumbling(), CUBE.inertial, GRASP_MAP, GAINS, phi, t)
    np.testing.assert_array_equal(again.cone_coefficients, together.cone_coefficients)


@pytest.mark.slow
def test_a_step_ends_where_the_reference_does():
    """There its jerk jumps by 60 times distance over duration cubed."""
    start, goal = np.array([0.5, -0.2, 0.4]), np.array([0.5, 0.2, 0.4])
    quick = min_jerk_line(0.513, start, goal, np.eye(3), np.eye(3))
    phi, t = perturbed(5, com=0.002), np.array([0.4, 0.6, 0.7, 1.0])
    default, fine = (
        rollout(quick, CUBE.inertial, GRASP_MAP, GAINS, phi, t, max_step=h).deviation for h in (None, 0.513 / 120)
    )
    assert (np.abs(default - fine).max(axis=(0, 1)) / np.abs(fine).max(axis=(0, 1))).max() < 3e-7


def test_times_must_increase():
    for t in ([0.2, 0.1], [-0.1, 0.2], [0.1, 0.1]):
        with pytest.raises(ValueError, match="t must increase"):
            rollout(MOVE, CUBE.inertial, GRASP_MAP, GAINS, CUBE.inertial.phi, t)


@pytest.mark.slow
def test_first_order_tubes_miss_by_second_order():
    """Paper's move, mass alone: the excess at the ends of the range is small and falls fourfold when that halves."""
    loop = TrayLoop(CUBE.inertial, GAINS, phi_jacobian(CUBE.inertial, "cube", own(("mass",))))
    t = np.linspace(0, 2.5, 126)
    sensitivity = loop.along(MOVE, t)
    inverse = np.linalg.pinv(GRASP_MAP)
    nominal = rollout(MOVE, CUBE.inertial, GRASP_MAP, GAINS, CUBE.inertial.phi, t).cone_coefficients[0]
    beyond = []
    for share in (0.1, 0.05):
        half_range = share * CUBE.inertial.mass
        phi = CUBE.inertial.phi + half_range * np.linspace(-1, 1, 5)[:, None] * np.eye(10)[0]
        runs = rollout(MOVE, CUBE.inertial, GRASP_MAP, GAINS, phi, t)
        states = excess(runs.deviation, np.zeros((126, 12)), np.abs(sensitivity.state[..., 0]) * half_range)
        radius = np.abs(inverse @ sensitivity.wrench)[..., 0] * half_range
        inputs = excess(runs.cone_coefficients, nominal, radius)
        relative = inputs.max(axis=1) / radius.max(axis=0)
        assert 0 < np.any(relative > 1e-6, axis=1).sum() < 5  # the nominal body never leaves
        assert relative.max() < share
        beyond.append([states.max(), inputs.max()])
    np.testing.assert_allclose(np.divide(*beyond), 4.0, rtol=0.15)
