"""The general sensitivity engine, section III: closed forms, misuse, and the tray against two other computations."""

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import expm

from salver import scenario
from salver.control.object import Gains
from salver.geometry import exp, hat
from salver.models.rigid_body import RigidBody
from salver.models.uncertain.parameters import INERTIAL, inertial_vector, parameters_of, phi_jacobian, phi_of
from salver.sensitivity import engine
from salver.sensitivity.engine import ClosedLoop, closed_loop_rate, sensitivity, simulate, variational
from salver.sensitivity.tray import BodyMotion, TrayLoop
from salver.simulation.closed_loop import rollout
from salver.trajectory import PolynomialReference, SampledReference
from tray_casadi import _exp, _right_jacobian_inverse, sampled, tray_loop, tray_sensitivity

GAINS = Gains(kp=(500.0, 300.0), kd=(25.0, 15.0))
CUBE = scenario.load("panda-cube").payload.first
GRASP_MAP = CUBE.contacts.grasp_map
NAMES = ("mass", "com_x", "com_y", "com_z", "inertia_xx", "inertia_xy", "inertia_zz")
STEPS = np.array([2e-4, *[2e-5] * 3, *[3e-7] * 3])  # a thousandth of what is carried, or 20 micrometres
TIMES = np.linspace(0, 0.5, 11)


def own(names):
    """The cube's parameters of these names."""
    return [p for p in parameters_of("cube", True) if p.name in names]


def tumbling() -> PolynomialReference:
    rng = np.random.default_rng(3)
    return PolynomialReference(1.0, exp([0.4, -0.3, 1.0]), 0.2 * rng.normal(size=(7, 3)), 1.5 * rng.normal(size=(5, 3)))


def symbols(*names: str) -> list[ca.SX]:
    return [ca.SX.sym(name) for name in names]


def pi_controlled(leak: float = 0.0) -> ClosedLoop:
    """x' = a x + u + d under u = -4 (x - r) - 3 xi, xi' = x - r - leak xi: p = (a, d), nominally (0.5, 0)."""
    x, u, xi, r, t = symbols("x", "u", "xi", "r", "t")
    p = ca.SX.sym("p", 2)
    f, h = p[0] * x + u + p[1], -4 * (x - r) - 3 * xi
    return ClosedLoop(x=x, u=u, p=p, f=f, h=h, xi=xi, g=x - r - leak * xi, y_d=r, t=t, reference=ca.sin(2 * t))


def largest_relative(a: np.ndarray, b: np.ndarray) -> float:
    """Of (T, rows, parameters): relative to each parameter's largest value in the row's kind."""
    return float((np.abs(a - b).max(axis=(0, 1)) / np.abs(b).max(axis=(0, 1))).max())


def closed_form(t):
    """(T, 9) x, xi, sin 2t, cos 2t, 1, dx/da, dxi/da, dx/dd, dxi/dd of the leaking loop: everything is linear, so they
    are blocks of one matrix exponential."""
    loop = np.array([[0.5 - 4, -3], [1, -0.2]])
    m = np.zeros((9, 9))
    m[:2, :2] = m[5:7, 5:7] = m[7:, 7:] = loop
    m[:2, 2] = [4, -1]
    m[2, 3], m[3, 2] = 2, -2
    m[5, 0], m[7, 4] = 1, 1
    return np.array([expm(m * ti) @ [0.3, 0.1, 0, 1, 1, 0, 0, 0, 0] for ti in t])


@pytest.mark.parametrize("tolerance", [1e-3, 1e-8, 1e-10])
def test_the_error_is_no_less_than_is_said(tolerance):
    """Of the motion and of every sensitivity, relative to its peak; halved steps promise 16 and often give 255."""
    t = np.linspace(0, 3, 7)
    result, z = sensitivity(pi_controlled(leak=0.2), [0.5, 0.0], t, [0.3], [0.1], tolerance=tolerance), closed_form(t)
    found = [result.x, result.xi, result.state_sensitivity[:, 0], result.controller_sensitivity[:, 0]]
    error = np.abs(np.hstack(found) - z[:, [0, 1, 5, 7, 6, 8]]).max(axis=0)
    worst = (error / np.abs(z[:, [0, 1, 5, 7, 6, 8]]).max(axis=0)).max()
    assert worst <= result.status.details["error"] <= min(tolerance, 255 * worst)


def test_linear_loop_with_integral_action_has_the_closed_form():
    t = np.linspace(0, 3, 7)
    result = sensitivity(pi_controlled(leak=0.2), [0.5, 0.0], t, [0.3], [0.1])
    assert result.status.ok
    z = closed_form(t)
    np.testing.assert_allclose(result.x[:, 0], z[:, 0], atol=1e-10)
    np.testing.assert_allclose(result.xi[:, 0], z[:, 1], atol=1e-10)
    np.testing.assert_allclose(result.state_sensitivity[:, 0], z[:, [5, 7]], atol=1e-10)
    np.testing.assert_allclose(result.controller_sensitivity[:, 0], z[:, [6, 8]], atol=1e-10)
    np.testing.assert_allclose(result.u[:, 0], -4 * (z[:, 0] - z[:, 2]) - 3 * z[:, 1], atol=1e-10)
    np.testing.assert_allclose(result.input_sensitivity[:, 0], -4 * z[:, [5, 7]] - 3 * z[:, [6, 8]], atol=1e-10)


@pytest.mark.slow
def test_integral_action_cancels_a_constant_disturbance():
    result = sensitivity(pi_controlled(), [0.5, 0.0], [0.0, 15.0], [0.0], [0.0])
    np.testing.assert_allclose(result.state_sensitivity[-1, 0, 1], 0, atol=1e-9)
    np.testing.assert_allclose(result.input_sensitivity[-1, 0, 1], -1, atol=1e-8)
    np.testing.assert_allclose(result.controller_sensitivity[-1, 0, 1], 1 / 3, atol=1e-8)


def test_initial_state_may_depend_on_the_parameters():
    """x' = -p x from x(0) = p^2: x = p^2 exp(-p t), dx/dp = (2 p - p^2 t) exp(-p t)."""
    x, u, p = symbols("x", "u", "p")
    t = np.array([0.5, 1.0, 2.5])  # starts at t[0], not at zero
    result = sensitivity(ClosedLoop(x=x, u=u, p=p, f=-p * x + 0 * u, h=0 * x), [1.5], t, [2.25], Pi0=[[3.0]])
    elapsed = t - 0.5
    np.testing.assert_allclose(result.x[:, 0], 2.25 * np.exp(-1.5 * elapsed), rtol=1e-9)
    np.testing.assert_allclose(
        result.state_sensitivity[:, 0, 0], (3 - 2.25 * elapsed) * np.exp(-1.5 * elapsed), rtol=1e-8, atol=1e-10
    )


def test_parameters_that_reach_the_controller_act_directly_too():
    """A sensor of scale p: u = -p x, so x' = -p x and du/dp = -x - p dx/dp."""
    x, u, p = symbols("x", "u", "p")
    with pytest.raises(ValueError, match="g or h depends on the true parameters p, which a controller cannot know"):
        ClosedLoop(x=x, u=u, p=p, f=u, h=-p * x)
    loop = ClosedLoop(x=x, u=u, p=p, f=u, h=-p * x, parameters_reach_controller=True)
    t = np.linspace(0, 2, 5)
    result = sensitivity(loop, [0.8], t, [1.0])
    decay = np.exp(-0.8 * t)
    np.testing.assert_allclose(result.state_sensitivity[:, 0, 0], -t * decay, atol=1e-10)
    np.testing.assert_allclose(result.input_sensitivity[:, 0, 0], -decay + 0.8 * t * decay, atol=1e-10)


def test_parameters_that_reach_the_controllers_state_act_directly_too():
    """The integral of a sensor of scale p, xi' = p x: of (x, xi, dx/dp, dxi/dp) everything is linear."""
    x, u, p, xi = symbols("x", "u", "p", "xi")
    loop = ClosedLoop(x=x, u=u, p=p, f=u, h=-2 * x - xi, xi=xi, g=p * x, parameters_reach_controller=True)
    t = np.linspace(0, 2, 5)
    result = sensitivity(loop, [0.8], t, [1.0], [0.3])
    m = np.kron(np.eye(2), [[-2.0, -1.0], [0.8, 0.0]])
    m[3, 0] = 1.0
    z = np.array([expm(m * ti) @ [1.0, 0.3, 0.0, 0.0] for ti in t])
    np.testing.assert_allclose(result.state_sensitivity[:, 0, 0], z[:, 2], atol=1e-10)
    np.testing.assert_allclose(result.controller_sensitivity[:, 0, 0], z[:, 3], atol=1e-10)


def test_what_the_controller_believes_is_not_perturbed():
    """x' = p u, u = -x / p_n: at p = p_n the loop is x' = -x, but dx/dp = -(t / p) exp(-t)."""
    x, u, p, p_n = symbols("x", "u", "p", "p_n")
    loop = ClosedLoop(x=x, u=u, p=p, f=p * u, h=-x / p_n, p_nominal=p_n)
    t = np.linspace(0, 2, 5)
    result = sensitivity(loop, [2.0], t, [1.0])
    np.testing.assert_allclose(result.state_sensitivity[:, 0, 0], -t / 2 * np.exp(-t), atol=1e-10)
    motions = simulate(loop, [[2.0], [3.0]], [2.0], t, [1.0])
    np.testing.assert_allclose(motions.x[:, :, 0], np.exp(-np.outer([1.0, 1.5], t)), rtol=1e-8)
    np.testing.assert_allclose(motions.u, -motions.x / 2, rtol=1e-12)


def test_sampled_reference_equals_its_expression():
    given = pi_controlled()
    x, u, p, xi, r = given.x, given.u, given.p, given.xi, given.y_d
    open_loop = ClosedLoop(x=x, u=u, p=p, f=given.f, h=given.h, xi=xi, g=given.g, y_d=r)
    t = np.linspace(0, 3, 7)
    a = sensitivity(given, [0.5, 0.0], t, [0.3], [0.1])
    b = sensitivity(open_loop, [0.5, 0.0], t, [0.3], [0.1], reference=lambda t: np.sin(2 * t)[:, None])
    np.testing.assert_allclose(a.input_sensitivity, b.input_sensitivity, atol=1e-13)
    with pytest.raises(ValueError, match="y_d is a symbol; give reference"):
        sensitivity(open_loop, [0.5, 0.0], t, [0.3], [0.1])


def test_misuse_is_told_in_a_sentence():
    x, u, p, other = symbols("x", "u", "p", "other")
    with pytest.raises(ValueError, match="f has 2 entries but x has 1; they must agree"):
        ClosedLoop(x=x, u=u, p=p, f=ca.vertcat(u, u), h=-x)
    with pytest.raises(ValueError, match="p_nominal has 2 entries but p has 1"):
        ClosedLoop(x=x, u=u, p=p, f=u, h=-x, p_nominal=ca.SX.sym("p_n", 2))
    with pytest.raises(ValueError, match="contains the unknown symbol other"):
        sensitivity(ClosedLoop(x=x, u=u, p=p, f=u + other, h=-x), [1.0], [0.0, 1.0], [0.0])
    with pytest.raises(ValueError, match=r"x0 has shape \(2,\); \(1,\) is needed"):
        sensitivity(ClosedLoop(x=x, u=u, p=p, f=u, h=-x), [1.0], [0.0, 1.0], [0.0, 0.0])
    with pytest.raises(ValueError, match='"friction" does not act through the dynamics; accepted are mass, com_x'):
        tray_loop(CUBE.inertial, GRASP_MAP, GAINS, ("mass", "friction"))


def test_a_tolerance_that_cannot_be_met_is_reported(monkeypatch):
    monkeypatch.setattr(engine, "_HALVINGS", 3)
    result = sensitivity(pi_controlled(), [0.5, 0.0], [0.0, 3.0], [0.3], [0.1], tolerance=1e-15, absolute_tolerance=0.0)
    assert not result.status.ok
    assert result.status.code == "step_limit"
    assert "still err by about" in str(result.status)


@pytest.mark.slow
def test_a_motion_that_escapes_to_infinity_has_not_converged():
    """x' = p x^2 from x = 1 is 1 / (1 - p t): 2 at t = 0.5, and dx/dp = t / (1 - p t)^2 too; nowhere at t = 16."""
    x, u, p = symbols("x", "u", "p")
    loop = ClosedLoop(x=x, u=u, p=p, f=p * x * u, h=x)
    early = sensitivity(loop, [1.0], [0.0, 0.5], [1.0])
    assert early.status.ok
    np.testing.assert_allclose([early.x[-1, 0], early.state_sensitivity[-1, 0, 0]], 2, rtol=1e-9)
    assert not sensitivity(loop, [1.0], [0.0, 16.0], [1.0]).status.ok


def test_equations_serve_other_casadi_programmes():
    """The gradient of Pi' with respect to the state, from inside another expression."""
    function = variational(pi_controlled())
    x = ca.MX.sym("x")
    rate = function(x, 0.0, ca.DM([[1.0, 0.0]]), ca.DM([[0.0, 0.0]]), [0.5, 0.0], ca.DM(0, 1), 0.3, ca.DM(0, 1))[2]
    assert float(ca.Function("gradient", [x], [ca.jacobian(rate[0], x)])(2.0)) == 1.0  # f_p = x for the parameter a
    assert closed_loop_rate(pi_controlled()).size1_out(2) == 1


@pytest.fixture(scope="module")
def tray():
    return tray_sensitivity(CUBE.inertial, GRASP_MAP, GAINS, NAMES, tumbling(), TIMES)


def central_differences(share: float) -> tuple[np.ndarray, np.ndarray]:
    """Pi and Theta from full nonlinear rollouts of the other implementation of plant and controller."""
    columns = [INERTIAL.index(name) for name in NAMES]
    shifts = np.zeros((2, len(NAMES), 10))
    shifts[0, range(len(NAMES)), columns] = share * STEPS
    shifts[1] = -shifts[0]
    phi = phi_of((inertial_vector(CUBE.inertial) + shifts).reshape(-1, 10))
    runs = rollout(tumbling(), CUBE.inertial, GRASP_MAP, GAINS, phi, TIMES)

    def difference(values: np.ndarray) -> np.ndarray:
        ahead, behind = values.reshape(2, len(NAMES), *values.shape[1:])
        return np.moveaxis((ahead - behind) / (2 * share * STEPS[:, None, None]), 0, -1)

    return difference(runs.deviation), difference(runs.cone_coefficients)


def test_tray_agrees_with_central_differences_of_nonlinear_rollouts(tray):
    assert tray.status.ok
    Pi, Theta = central_differences(0.1)
    assert largest_relative(Pi, tray.state_sensitivity) < 1e-6
    assert largest_relative(Theta, tray.input_sensitivity) < 1e-6
    # Row by row as well: the bar is 1e-4 for every state and every coefficient.
    for difference, exact in ((Pi, tray.state_sensitivity), (Theta, tray.input_sensitivity)):
        peak = np.abs(exact).max(axis=0)
        assert (np.abs(difference - exact).max(axis=0) / np.maximum(peak, 1e-3 * peak.max(axis=0))).max() < 1e-4


def test_error_of_central_differences_falls_with_the_square_of_the_step(tray):
    errors = []
    for share in (10.0, 5.0, 2.5):
        Pi, Theta = central_differences(share)
        errors.append([largest_relative(Pi, tray.state_sensitivity), largest_relative(Theta, tray.input_sensitivity)])
    slopes = np.diff(np.log2(errors), axis=0)
    np.testing.assert_allclose(slopes, -2, atol=0.1)


def test_tray_agrees_with_the_linear_filter_form(tray):
    exact = TrayLoop(CUBE.inertial, GAINS, phi_jacobian(CUBE.inertial, "cube", own(NAMES))).along(tumbling(), TIMES)
    assert largest_relative(exact.state, tray.state_sensitivity) < 2e-8
    assert largest_relative(np.linalg.pinv(GRASP_MAP) @ exact.wrench, tray.input_sensitivity) < 2e-8


def test_tray_state_is_nominally_zero_and_its_input_is_eq_19(tray):
    assert np.abs(tray.x).max() < 1e-10
    nominal = rollout(tumbling(), CUBE.inertial, GRASP_MAP, GAINS, CUBE.inertial.phi, TIMES)
    np.testing.assert_allclose(tray.u, nominal.cone_coefficients[0], atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("angle", [0.0, 1e-3, 9.9e-3, 1.01e-2, 0.3, 1.5, 3.1])
def test_maps_of_rotations_are_those_of_the_whole_program(angle):
    """Across the border between series and closed form: what differs by rounding of 1 - cos is some 1e-16 / angle^2."""
    axis = np.array([2.0, -1.0, 2.0]) / 3
    theta = ca.SX.sym("theta", 3)
    both = ca.Function("f", [theta], [_exp(theta), _right_jacobian_inverse(theta)])
    turn, inverse = (np.array(x) for x in both(angle * axis))
    assert turn == pytest.approx(expm(angle * hat(axis)), abs=1e-12)
    # The integral of exp(-s theta) over s from 0 to 1, by its definition.
    nodes, weights = np.polynomial.legendre.leggauss(20)
    jacobian = sum(0.5 * w * expm(-0.5 * (x + 1) * angle * hat(axis)) for x, w in zip(nodes, weights, strict=True))
    assert inverse @ jacobian == pytest.approx(np.eye(3), abs=1e-11)


def test_tray_loop_moves_as_the_rollouts_do_far_from_nominal():
    """Two ways of writing plant, controller and error coordinates; turned by more than half a radian."""
    names = ("mass", "com_x", "com_y", "com_z", "inertia_xx", "inertia_yz")
    columns = [INERTIAL.index(name) for name in names]
    rng = np.random.default_rng(2)
    values = np.tile(inertial_vector(CUBE.inertial), (4, 1))
    values[:, columns] += rng.uniform(-1, 1, (4, 6)) * [0.05, *[3e-3] * 3, 6e-5, 3e-5]
    loop, nominal = tray_loop(CUBE.inertial, GRASP_MAP, GAINS, names), inertial_vector(CUBE.inertial)[columns]
    motions = simulate(loop, values[:, columns], nominal, TIMES, np.zeros(12), reference=sampled(tumbling()))
    runs = rollout(tumbling(), CUBE.inertial, GRASP_MAP, GAINS, phi_of(values), TIMES)
    assert np.abs(runs.deviation[..., 3:6]).max() > 0.5
    np.testing.assert_allclose(motions.x, runs.deviation, atol=1e-8 * np.abs(runs.deviation).max())
    np.testing.assert_allclose(motions.u, runs.cone_coefficients, atol=1e-8 * np.abs(runs.cone_coefficients).max())


def test_body_with_a_displaced_nominal_centre_of_mass():
    """The filter form wants the centre of mass at the origin of B; the engine does not."""
    body = RigidBody(0.4, np.array([0.01, -0.005, 0.02]), CUBE.inertial.inertia_com * 2)
    result = tray_sensitivity(body, GRASP_MAP, GAINS, ("mass", "com_z"), tumbling(), TIMES)
    steps = np.array([4e-4, 2e-5])
    values = np.tile(inertial_vector(body), (4, 1))
    values[[0, 1], 0] += [steps[0], -steps[0]]
    values[[2, 3], 3] += [steps[1], -steps[1]]
    runs = rollout(tumbling(), body, GRASP_MAP, GAINS, phi_of(values), TIMES)
    Pi = np.moveaxis((runs.deviation[::2] - runs.deviation[1::2]) / (2 * steps[:, None, None]), 0, -1)
    assert largest_relative(Pi, result.state_sensitivity) < 1e-5


@pytest.mark.slow
def test_a_sampled_trajectory_is_followed_through_its_corners():
    """A reference of samples only: its jerk jumps at each, and steps end there, no shorter than a smooth one's. The
    filter takes the forcing as cubic between its instants, also across a jump: its error there is of second order."""
    rough = SampledReference(tumbling().sample(np.linspace(0, 1, 11)))
    names = ("mass", "com_x")
    result, smooth = (tray_sensitivity(CUBE.inertial, GRASP_MAP, GAINS, names, x, TIMES) for x in (rough, tumbling()))
    assert result.status.ok
    assert result.status.details["step"] >= smooth.status.details["step"]
    loop = TrayLoop(CUBE.inertial, GAINS, phi_jacobian(CUBE.inertial, "cube", own(names)))
    assert largest_relative(loop.along(rough, TIMES).state, result.state_sensitivity) < 1e-7
    closer = loop.instants(TIMES[-1], len(TIMES) - 1, 0.01)
    third = loop.sensitivity(closer, BodyMotion.of(rough.sample(closer)), len(TIMES)).state
    assert largest_relative(third, result.state_sensitivity) < 2e-8
