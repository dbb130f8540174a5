"""Forces in the tray's frame against free flight in the world: a thrown body knows nothing of any tray."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from salver import scenario as scenarios
from salver.geometry import GRAVITY_S, exp, hat, log, quat_wxyz_from_matrix
from salver.scenario import parse
from salver.simulation.scene.loads import true_world
from salver.simulation.scene.scene import build
from salver.simulation.tray_frame import TrayMotion, apply
from salver.trajectory import PolynomialReference, Reference, min_jerk_line

# No two moments alike, products of inertia, the centre of mass off the origin of B: nothing cancels.
PARAMETERS = {
    "mass": 0.3, "com_x": 0.004, "com_y": -0.006, "com_z": 0.01,
    "inertia_xx": 2e-4, "inertia_yy": 5e-4, "inertia_zz": 6e-4, "inertia_xy": 3e-5, "inertia_yz": -5e-5,
}  # fmt: skip
ANOTHER_FIRST = {"other": [-0.06, 0.0], "cube": [0.0, 0.0]}
STEP = 1e-3  # s, of the second differences; they err by some STEP^2 / 12 times (10 rad/s)^4


def tumbling() -> Reference:
    rng = np.random.default_rng(3)
    return PolynomialReference(1.0, exp([0.4, -0.3, 1.0]), rng.normal(size=(7, 3)), 2 * rng.normal(size=(5, 3)))


def turning_about_its_normal() -> Reference:
    return min_jerk_line(0.4, np.zeros(3), np.array([0.3, 0.1, 0.2]), np.eye(3), exp([0, 0, 1.5]))


def straight() -> Reference:
    return min_jerk_line(0.4, np.zeros(3), np.array([0.3, 0.1, 0.2]), exp([0.3, 0.2, 0.1]), exp([0.3, 0.2, 0.1]))


@pytest.mark.parametrize("make", [tumbling, turning_about_its_normal, straight])
@pytest.mark.parametrize("t", [0.11, 0.25])
def test_a_thrown_body_flies_as_in_the_world(make, t):
    """Newton's parabola of the centre of mass and Euler's equations in the world, seen from the tray."""
    data = scenarios.load("panda-cube").model_dump(mode="json", exclude_none=True)
    del data["arm"]
    data["objects"] = [data["objects"][0] | {"name": name, "at": at} for name, at in ANOTHER_FIRST.items()]
    case = parse(data, "two cubes")
    scene = build(case, true_world(case, {f"cube.{name}": value for name, value in PARAMETERS.items()}))
    body, reference = scene.loads[1].inertial, make()

    rng = np.random.default_rng(7)
    p_EB, R_EB = np.array([0.2, -0.1, 0.5]), exp(rng.normal(size=3))  # far from the tray: no contact
    v_E, w_B = rng.normal(size=3), 6 * rng.normal(size=3)  # relative to the tray

    def tray(time):
        s = reference.sample(time)
        return s.p_SB[0], s.R_SB[0], s.v_S[0], s.omega_B[0]

    p_SE, R_SE, v_SE, omega = tray(t)
    R_SB = R_SE @ R_EB
    W_B = w_B + R_EB.T @ omega  # absolute
    v_S = v_SE + R_SE @ (v_E + np.cross(omega, p_EB))
    com_S = p_SE + R_SE @ p_EB + R_SB @ body.com_B
    v_com_S = v_S + R_SB @ np.cross(W_B, body.com_B)

    def euler(_, x):
        R, w = x[:9].reshape(3, 3), x[9:]
        return np.concatenate(
            [(R @ hat(w)).ravel(), -np.linalg.solve(body.inertia_com, np.cross(w, body.inertia_com @ w))]
        )

    def seen_from_the_tray(dt):
        """Pose of B in E a time dt later."""
        x = solve_ivp(euler, (0, dt), np.concatenate([R_SB.ravel(), W_B]), rtol=1e-12, atol=1e-14).y[:, -1]
        R = x[:9].reshape(3, 3)
        p = com_S + dt * v_com_S + 0.5 * dt**2 * GRAVITY_S - R @ body.com_B
        p_tray, R_tray, *_ = tray(t + dt)
        return R_tray.T @ (p - p_tray), R_tray.T @ R

    (before, R_before), (after, R_after) = seen_from_the_tray(-STEP), seen_from_the_tray(STEP)
    acceleration = (after - 2 * p_EB + before) / STEP**2
    alpha_B = (log(R_EB.T @ R_after) + log(R_EB.T @ R_before)) / STEP**2

    model, data = scene.model, mujoco.MjData(scene.model)
    data.qpos[:3], data.qvel[:6] = [5, 5, 5], 3.0  # the other one is elsewhere
    data.qpos[7:10], data.qpos[10:14] = p_EB, quat_wxyz_from_matrix(R_EB)
    data.qvel[6:9], data.qvel[9:12] = v_E, w_B
    mujoco.mj_step1(model, data)
    motion = TrayMotion.of(reference.sample(np.array([0.0, t, 0.3])))
    apply(motion, 1, model, data, scene.object_ids, scene.qvel_ids)
    mujoco.mj_forward(model, data)
    assert data.ncon == 0
    assert np.linalg.norm(alpha_B) > 1
    np.testing.assert_allclose(data.qacc[6:9], acceleration, atol=1e-4 * max(1, np.abs(acceleration).max()))
    np.testing.assert_allclose(data.qacc[9:12], alpha_B, atol=1e-4 * np.abs(alpha_B).max())


def test_only_a_tray_that_neither_turns_nor_begins_to_is_said_not_to_turn():
    assert TrayMotion.of(turning_about_its_normal().sample(0.1)).turns
    assert TrayMotion.of(turning_about_its_normal().sample(0.2)).turns  # half way: no angular acceleration
    assert not TrayMotion.of(straight().sample(0.1)).turns
