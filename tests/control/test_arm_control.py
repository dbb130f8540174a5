"""The arm's controller in closed loop with forward dynamics, and against the paper's equations term by term."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from scipy.linalg import expm

from object_controller import distribute, errors, wrench_command
from salver import scenario
from salver.control.arm import POSTURE_GAINS, ArmController, ArmState, controller_for
from salver.control.object import Gains, command
from salver.errors import ScenarioError
from salver.geometry import exp, log
from salver.models.arm.arm import load_arm, with_load
from salver.planning.follow.motion import follow_scenario
from salver.planning.postures import PoseTarget, posture_at
from salver.trajectory import min_jerk_line
from sampled_sets import object_jacobian

CUBE = scenario.load("panda-cube")
GAINS = Gains(CUBE.control.kp, CUBE.control.kd)
DURATION = 1.5


@pytest.fixture(scope="module")
def panda():
    return load_arm(CUBE.arm, CUBE.tray)


@pytest.fixture(scope="module")
def reference():
    """The paper's move, with a turn about the vertical on the way."""
    move = CUBE.motion
    turned = exp(np.array([0.0, 0.0, 0.4]))
    return min_jerk_line(DURATION, np.array(move.start.position), np.array(move.goal.position), np.eye(3), turned)


@pytest.fixture(scope="module")
def joint(panda, reference):
    motion, status = follow_scenario(CUBE, reference, panda)
    assert status.ok, status
    return motion


def state_at(arm, q, dq, body):
    """An `ArmState` with the object exactly where it sits on the tray."""
    p, rotation = arm.object_pose(q, body.p_EB, body.R_EB)
    twist = object_jacobian(arm, q, body.p_EB, body.R_EB) @ dq
    return ArmState(q, dq, p, rotation, rotation @ twist[:3], twist[3:])


def rollout(arm, carried, controller, q, dq, duration, start=0.0, period=1e-3, hold=False):
    """Forward dynamics of the arm with everything stuck to its tray; RK4, the controller in every stage or held."""
    plant = with_load(arm, carried)

    def rate(t, q, dq, torque):
        torque = controller.step(ArmState(q, dq), t) if torque is None else torque
        return dq, pin.aba(plant.pin_model, plant.data, q, dq, torque).copy()

    history = [(q, dq)]
    for k in range(round(duration / period)):
        t = start + k * period
        held = controller.step(ArmState(q, dq), t) if hold else None
        k1 = rate(t, q, dq, held)
        k2 = rate(t + period / 2, q + period / 2 * k1[0], dq + period / 2 * k1[1], held)
        k3 = rate(t + period / 2, q + period / 2 * k2[0], dq + period / 2 * k2[1], held)
        k4 = rate(t + period, q + period * k3[0], dq + period * k3[1], held)
        q = q + period / 6 * (k1[0] + 2 * k2[0] + 2 * k3[0] + k4[0])
        dq = dq + period / 6 * (k1[1] + 2 * k2[1] + 2 * k3[1] + k4[1])
        history.append((q, dq))
    return np.array([x[0] for x in history]), np.array([x[1] for x in history])


def second_order(kp, kd, e, de, t):
    """Solution (T, 3) of e'' = -kd e' - kp e."""
    a = np.array([[0.0, 1.0], [-kp, -kd]])
    return np.array([(expm(a * s) @ np.stack([e, de]))[0] for s in t])


# ---- term by term ---------------------------------------------------------------------------------------------


def torque_of_the_paper(panda, joint, reference, state, t, inverse):
    """tau = J_c^T F_c + C dq + N + M u, every term from the module that owns it; inverse: of the object's Jacobian."""
    cube, q, dq = CUBE.payload.first, state.q, state.dq
    q_star, dq_star, ddq_star = (x[0] for x in joint.sample(t))
    now = reference.sample(t)
    seen = state.p_SB[None], state.R_SB[None], state.v_S[None], state.omega_B[None]
    a_cmd, alpha_cmd = command(GAINS, now, errors(now, *seen))
    rate = np.concatenate([state.R_SB.T @ a_cmd[0] - np.cross(state.omega_B, state.R_SB.T @ state.v_S), alpha_cmd[0]])
    jacobian, h = object_jacobian(panda, q, cube.p_EB, cube.R_EB), 1e-6
    ahead, behind = (object_jacobian(panda, q + sign * h * dq, cube.p_EB, cube.R_EB) for sign in (1, -1))
    drift = (ahead - behind) @ dq / (2 * h)
    kp, kd = POSTURE_GAINS
    posture = ddq_star + kp * (q_star - q) + kd * (dq_star - dq)
    u = inverse(jacobian) @ (rate - drift) + (np.eye(7) - inverse(jacobian) @ jacobian) @ posture
    wrench_B = wrench_command(GAINS, cube.inertial.phi, now, *seen)[0]
    forces = cube.contacts.cone_edges @ distribute(cube.contacts.grasp_map, wrench_B)
    return jacobian.T @ cube.contacts.grasp_matrix @ forces + panda.bias(q, dq) + panda.mass_matrix(q) @ u


@pytest.mark.parametrize("feedback", ["joints", "object"])
def test_torque_is_equation_22_with_25(panda, joint, feedback):
    """Of a reference that leans otherwise at either end: turns about one axis would be the same in either order."""
    cube, move = CUBE.payload.first, CUBE.motion
    ends = np.array(move.start.position), np.array(move.goal.position)
    reference = min_jerk_line(DURATION, *ends, exp(np.array([0.2, -0.1, 0.0])), exp(np.array([-0.1, 0.15, 0.4])))
    controller = ArmController(panda, [cube], joint, reference, GAINS, feedback=feedback, limit_torque=False)
    rng = np.random.default_rng(0)
    # Between multiples of the period the reference is a Taylor series, short of the snap by 1e-5 of the acceleration.
    for t, tolerance in ((0.3, 1e-7), (0.7504, 1e-5), (1.1, 1e-7)):
        q_star, dq_star, _ = (x[0] for x in joint.sample(t))
        state = state_at(panda, q_star + 0.02 * rng.normal(size=7), dq_star + 0.1 * rng.normal(size=7), cube)
        if feedback == "object":
            state.p_SB += np.array([0.003, -0.002, 0.001])
            state.omega_B += np.array([0.1, 0.0, -0.2])
        expected = torque_of_the_paper(panda, joint, reference, state, t, np.linalg.pinv)
        assert controller.step(state, t) == pytest.approx(expected, abs=tolerance)


def test_what_stands_beside_the_object_is_part_of_the_arm(panda, reference, joint):
    """A second body, 1.3 kg and away from the first: the torque is that of an arm with it stuck to its tray."""
    cube = CUBE.payload.first
    beside = replace(
        cube,
        name="beside",
        inertial=replace(cube.inertial, mass=1.3, inertia_com=2 * cube.inertial.inertia_com),
        p_EB=np.array([-0.03, 0.05, 0.08]),
        R_EB=exp(np.array([0.0, 0.0, 0.6])),
    )
    controller = ArmController(panda, [cube, beside], joint, reference, GAINS, limit_torque=False)
    q, dq, _ = (x[0] for x in joint.sample(0.3))
    state = state_at(panda, q + 0.01, dq - 0.05, cube)
    expected = torque_of_the_paper(with_load(panda, [beside]), joint, reference, state, 0.3, np.linalg.pinv)
    assert controller.step(state, 0.3) == pytest.approx(expected, abs=1e-7)


def test_feedback_from_a_sticking_object_changes_nothing(panda, reference, joint):
    cube = CUBE.payload.first
    by_joints, by_object = (
        ArmController(panda, [cube], joint, reference, GAINS, feedback=feedback) for feedback in ("joints", "object")
    )
    state = state_at(panda, joint.q[50] + 0.01, joint.dq[50] - 0.02, cube)
    assert by_joints.step(state, 0.25) == pytest.approx(by_object.step(state, 0.25), abs=1e-10)


# ---- closed loop ----------------------------------------------------------------------------------------------


def test_nominal_error_dynamics_are_linear(panda, reference, joint):
    """From a wrong start, in full motion: e_p'' = -kd e_p' - kp e_p exactly. Without J-dot dq it would not be."""
    cube = CUBE.payload.first
    controller = ArmController(panda, [cube], joint, reference, GAINS, limit_torque=False)
    start, span = 0.5, 0.3
    q, dq = (x[0] for x in joint.sample(start)[:2])
    rng = np.random.default_rng(1)
    q, dq = q + 0.03 * rng.normal(size=7), dq + 0.2 * rng.normal(size=7)
    path, _ = rollout(panda, [cube], controller, q, dq, span, start)
    times = start + np.arange(len(path)) * 1e-3
    now = reference.sample(times)
    poses = [panda.object_pose(x, cube.p_EB, cube.R_EB) for x in path]
    e_p = now.p_SB - np.array([p for p, _ in poses])
    first = state_at(panda, q, dq, cube)
    expected = second_order(GAINS.kp[0], GAINS.kd[0], e_p[0], now.v_S[0] - first.v_S, times - start)
    assert np.abs(e_p[0]).max() > 5e-3
    assert e_p == pytest.approx(expected, abs=1e-7)
    e_R = [np.linalg.norm(log(rotation.T @ goal)) for (_, rotation), goal in zip(poses, now.R_SB, strict=True)]
    assert e_R[-1] < 0.25 * e_R[0]


def test_null_space_moves_the_posture_and_not_the_object(panda, reference, joint):
    cube = CUBE.payload.first
    controller = ArmController(panda, [cube], joint, reference, GAINS, limit_torque=False)
    free = np.linalg.svd(panda.body_jacobian(joint.q[0]))[2][6]
    q, left = posture_at(panda, PoseTarget(*panda.tray_pose(joint.q[0])), joint.q[0] + 0.15 * free)
    assert left < 1e-10
    assert np.abs(q - joint.q[0]).max() > 0.05
    path, _ = rollout(panda, [cube], controller, q, np.zeros(7), 1.0, start=-1.0)
    assert np.abs(path[-1] - joint.q[0]).max() < 1e-3
    off = [np.linalg.norm(panda.tray_pose(x)[0] - panda.tray_pose(q)[0]) for x in path]
    assert max(off) < 1e-8


@pytest.mark.parametrize("space", ["object", "joint"])
def test_whole_motion_at_a_thousand_hertz(panda, reference, joint, space):
    """Torque held for 1 ms, limits on: the object is back on its path, and stays at the end."""
    cube = CUBE.payload.first
    controller = ArmController(panda, [cube], joint, reference, GAINS, space=space)
    q = joint.q[0] + np.array([0.01, -0.01, 0.01, 0.0, 0.01, 0.0, 0.0])
    path, speed = rollout(panda, [cube], controller, q, np.zeros(7), DURATION + 0.5, hold=True)
    p, rotation = panda.object_pose(path[-1], cube.p_EB, cube.R_EB)
    end = reference.sample(DURATION)
    assert p == pytest.approx(end.p_SB[0], abs=2e-6)
    assert np.linalg.norm(log(rotation.T @ end.R_SB[0])) < 1e-5
    assert np.abs(speed[-1]).max() < 1e-4
    assert controller.saturation.steps == len(path) - 1
    assert controller.saturation.torque == 0
    assert 0.3 < controller.saturation.peak_share < 0.6


def test_wrong_mass_shows_as_a_tracking_error(panda, reference, joint):
    """The plant carries 0.5 kg more than the controller knows: it settles low by dm g / (kp effective mass)."""
    cube = CUBE.payload.first
    heavier = replace(cube, inertial=replace(cube.inertial, mass=cube.inertial.mass + 0.5))
    controller = ArmController(panda, [cube], joint, reference, GAINS)
    path, _ = rollout(panda, [heavier], controller, joint.q[-1], np.zeros(7), 1.5, start=DURATION, hold=True)
    p, _ = panda.object_pose(path[-1], cube.p_EB, cube.R_EB)
    sag = reference.sample(DURATION).p_SB[0] - p
    # At rest: M u = J^T dw with u = J^+ (0, 0, kp sag, ...), so J u = J M^-1 J^T dw.
    jacobian = object_jacobian(panda, path[-1], cube.p_EB, cube.R_EB)
    mass = with_load(panda, [cube]).mass_matrix(path[-1])
    _, rotation = panda.object_pose(path[-1], cube.p_EB, cube.R_EB)
    weight = np.concatenate([rotation.T @ [0, 0, 0.5 * 9.81], np.zeros(3)])
    predicted = rotation @ (jacobian @ np.linalg.solve(mass, jacobian.T @ weight))[:3] / GAINS.kp[0]
    assert sag == pytest.approx(predicted, rel=0.02, abs=1e-5)
    assert sag[2] > 1e-3


# ---- limits, mistakes -----------------------------------------------------------------------------------------


def test_torques_and_their_rates_are_cut_and_counted(panda, reference, joint):
    cube = CUBE.payload.first
    controller = ArmController(panda, [cube], joint, reference, GAINS)
    calm = ArmState(joint.q[0], joint.dq[0])
    first = controller.step(calm, 0.0)
    far = ArmState(joint.q[0] + 0.3, np.full(7, -2.0))
    second = controller.step(far, 0.001)
    assert np.abs(second - first).max() == pytest.approx(1.0)
    assert controller.saturation.torque_rate == 1
    for k in range(200):
        torque = controller.step(far, 0.001 * k)
        assert np.all(np.abs(torque) <= panda.limits.torque + 1e-12)
    assert controller.saturation.torque > 100
    assert controller.saturation.peak_share > 1
    assert np.abs(torque / panda.limits.torque).max() == pytest.approx(1.0)
    controller.reset()
    assert controller.saturation.steps == 0
    assert controller.step(calm, 0.0) == pytest.approx(first, abs=0)


@pytest.mark.parametrize(("bent", "near"), [(0.0, True), (-4e-4, True), (4e-4, True), (2e-3, False)])
def test_singular_posture_is_left_by_damped_least_squares(panda, reference, joint, bent, near):
    """Stretched out, J has a pivot of zero, and a small one nearly so: u is least in |J u - wanted|^2 + (1e-3 |u|)^2
    there (Wampler 1986)."""
    cube = CUBE.payload.first
    controller = ArmController(panda, [cube], joint, reference, GAINS, limit_torque=False)
    stretched, slow = bent * np.array([0.3, 1.0, -0.5, -1.0, 0.7, 1.0, 0.2]), np.full(7, 0.01)
    state = state_at(panda, stretched, slow, cube)
    assert (np.linalg.svd(object_jacobian(panda, stretched, cube.p_EB, cube.R_EB))[1][-1] < 1e-3) == near

    def damped(jacobian):
        stacked = np.vstack([jacobian, 1e-3 * np.eye(7)])
        return np.linalg.lstsq(stacked, np.vstack([np.eye(6), np.zeros((7, 6))]))[0]

    expected = torque_of_the_paper(panda, joint, reference, state, 0.3, damped if near else np.linalg.pinv)
    assert controller.step(state, 0.3) == pytest.approx(expected, rel=1e-4)


def test_mistakes(panda, reference, joint):
    with pytest.raises(ValueError, match="needs the object's reference"):
        ArmController(panda, CUBE.payload.bodies, joint, None, GAINS)
    controller = ArmController(panda, CUBE.payload.bodies, joint, reference, GAINS, feedback="object")
    with pytest.raises(ValueError, match="needs its pose and twist"):
        controller.step(ArmState(joint.q[0], joint.dq[0]), 0.0)
    with pytest.raises(ScenarioError, match="has no arm"):
        controller_for(CUBE.with_changes(arm=None), joint, reference)


def test_scenario_sets_gains_feedback_and_period(joint, reference):
    controller = controller_for(CUBE.with_changes(physics__feedback="object", control__kp=[400, 200]), joint, reference)
    assert controller.gains.kp == (400, 200)
    assert controller.feedback == "object"
    assert controller.period == CUBE.physics.command_period
