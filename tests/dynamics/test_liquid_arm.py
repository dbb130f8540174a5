"""What liquids do to the arm that carries them, against the arm and its pendulums as one multibody system."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from scipy.special import jnp_zeros, jv

import salver as sv
from salver.dynamics.liquid.surface import SurfaceCases, SurfaceMotion
from salver.dynamics.load_cases import LoadCase
from salver.geometry import GRAVITY
from salver.planning.trajopt.constraints.constraints import TorqueLimit
from salver.planning.trajopt.problem import transport_problem
from salver.sensitivity.arm.compliance import LoadResponses
from shaken_loads import BOX

DURATION, STEPS, EVERY = 0.6, 180, 3
AWAY = np.array([0.5, 0.2, 0.0, 0.15, 0.0, 0.1, 0.0])


@pytest.fixture(scope="module")
def problem():
    """Of the coffee; commands are not held, so that the arm can be integrated."""
    made = transport_problem(sv.load_scenario("panda-coffee").with_changes(objects__0__uncertainty={"fill": "30%"}))
    return replace(made, tracking=replace(made.tracking, delay=0.0))


def swung(s, swing):
    """Position, speed and acceleration of the joints at shares s of the time."""
    s = np.asarray(s)[..., None]
    blend = (s**3 * (10 - 15 * s + 6 * s**2), 30 * s**2 * (1 - s) ** 2, 60 * s * (1 - s) * (1 - 2 * s))
    return [x * swing / DURATION**k for k, x in enumerate(blend)]


def planned(problem, swing):
    s = np.linspace(0, 1, STEPS // EVERY + 1)
    q, dq, ddq = swung(s, swing)
    return problem.at(s, np.stack([problem.start_posture + q, dq, ddq, 0 * q]), DURATION)


def with_pendulums(problem, case):
    """The arm and its tray with a cup in which the waves' masses hang as pendulums, two hinges each; and the damping of
    those hinges."""
    model, modes, body = problem.arm.pin_model.copy(), case.modes, case.body
    frame, own = model.frames[problem.arm.tray_id], body.own
    joint = frame.parentJoint
    to_cup = frame.placement * pin.SE3(body.R_EB, body.p_EB)
    model.appendBodyToJoint(joint, pin.Inertia(own.mass, own.com_B, own.inertia_com), to_cup)
    to_surface, still = to_cup * pin.SE3(np.eye(3), body.inner_origin_B(case.value)), modes.still
    model.appendBodyToJoint(joint, pin.Inertia(still.mass, still.com_B, still.inertia_com), to_surface)
    damping = np.zeros(model.nv)
    for mass, height, omega in zip(modes.mass[:, 0], modes.height[:, 0], modes.omega[:, 0], strict=True):
        length = GRAVITY / omega**2
        hinge = to_surface * pin.SE3(np.eye(3), np.array([0.0, 0.0, height + length]))
        across = model.addJoint(joint, pin.JointModelRX(), hinge, f"x{omega}")
        along = model.addJoint(across, pin.JointModelRY(), pin.SE3.Identity(), f"y{omega}")
        hanging = pin.Inertia(mass, np.array([0.0, 0.0, -length]), np.zeros((3, 3)))
        model.appendBodyToJoint(along, hanging, pin.SE3.Identity())
        damping = np.append(damping, np.full(2, 2 * case.damping * omega * mass * length**2))
    return model, damping


def followed(problem, case, swing):
    """(3, T, n) e, e' and torque of the arm that carries the pendulums, by Runge and Kutta; its controller knows of the
    nominal load, with a lid on its liquid, under which it has sagged before the motion."""
    arm, n, loop, start = problem.model, problem.n, problem.tracking, problem.start_posture
    known, (model, damping) = arm.createData(), with_pendulums(problem, case)
    data, hanging = model.createData(), model.nv - n

    def asked(t, state):
        q, dq, ddq = (x + (k == 0) * start for k, x in enumerate(swung(t / DURATION, swing)))
        e, rate = q - state[0, :n], dq - state[1, :n]
        return e, rate, pin.rnea(arm, known, state[0, :n], state[1, :n], ddq + loop.kd * rate + loop.kp * e)

    def speed(t, state):
        torque = np.append(asked(t, state)[2], -damping[n:] * state[1, n:])
        return np.stack([state[1], pin.aba(model, data, state[0], state[1], torque)])

    q, nothing = start.copy(), np.zeros(n)
    for _ in range(8):
        rest = pin.rnea(model, data, np.append(q, np.zeros(hanging)), np.zeros(model.nv), np.zeros(model.nv))[:n]
        lacking = rest - pin.rnea(arm, known, q, nothing, nothing)
        q = start - np.linalg.solve(np.asarray(pin.crba(arm, known, q)), lacking) / loop.kp
    state, found, h = np.stack([np.append(q, np.zeros(hanging)), np.zeros(model.nv)]), [], DURATION / STEPS
    for t in h * np.arange(STEPS + 1):
        found.append(np.stack(asked(t, state)))
        a = speed(t, state)
        b = speed(t + h / 2, state + h / 2 * a)
        c = speed(t + h / 2, state + h / 2 * b)
        state = state + h / 6 * (a + 2 * b + 2 * c + speed(t + h, state + h * c))
    return np.swapaxes(np.array(found), 0, 1)[:, ::EVERY]


def tray_at(problem, q):
    """The tray's placements at postures (T, n)."""
    model, data = problem.model, problem.model.createData()
    placed = []
    for posture in q:
        pin.framesForwardKinematics(model, data, posture)
        placed.append(data.oMf[problem.arm.tray_id].copy())
    return placed


def test_an_arm_gives_way_to_its_waves_as_with_pendulums_on_its_tray(problem):
    """Joints, speeds and commanded torques along a small motion, of a load that is known but for its waves."""
    (body,) = problem.items
    case, swing = LoadCase(body, body.inner.fill, 0.01), 0.01 * AWAY
    motion = planned(problem, swing)
    _, given = LoadResponses.of(((case,),), motion.s * DURATION, motion.terms.w, motion.response).each["cup"]
    e, rate, torque = followed(problem, case, swing)
    reaction = given.reaction.part(slice(0, 1))
    for seen, told in (
        (-e, reaction.joints.q),
        (-rate, reaction.joints.dq),
        (torque - motion.terms.torque, reaction.torque),
    ):
        assert np.abs(seen - told[..., 0]).max() < 0.04 * np.abs(seen).max()


def test_what_the_liquid_pushes_is_in_what_an_arm_may_stray(problem):
    """The fullest cup, hardly damped, waves of a seventh of the radius: joints, their speeds, torques and the tray lie
    within what rows allow for, to a fiftieth of it, and do not within what a lid on the liquid would leave."""
    swing = 0.35 * AWAY
    motion = planned(problem, swing)
    case = max(problem.cases[0], key=lambda case: (case.value, -case.damping))
    assert case.value == pytest.approx(0.065)
    e, rate, torque = followed(problem, case, swing)
    placed, away = (tray_at(problem, q) for q in (motion.z[0], motion.z[0] - e))
    moved = np.array([there.translation - here.translation for here, there in zip(placed, away, strict=True)])
    turned = np.array([pin.log3(here.rotation.T @ there.rotation) for here, there in zip(placed, away, strict=True)])
    for seen, told, lidded in (
        (e, motion.joint_radius(0), motion.response.joint_radius(0)),
        (rate, motion.joint_radius(1), motion.response.joint_radius(1)),
        (torque - motion.terms.torque, motion.torque_radius(), motion.response.torque_radius()),
        *zip((moved, turned), motion.tray_radius(), motion.response.tray_radius(), strict=True),
    ):
        strayed = np.abs(seen)
        assert (strayed - told).max() < 0.03 * strayed.max()
        assert (strayed - lidded).max() > 0.25 * strayed.max()
    bound = problem.limits.torque
    (block,) = TorqueLimit(problem.limits).blocks(motion)
    sides = (motion.terms.torque + motion.torque_radius(), motion.torque_radius() - motion.terms.torque)
    np.testing.assert_allclose(block.values, np.hstack([x / bound - 1 for x in sides]), atol=1e-12)


@pytest.mark.parametrize("shape", ["cup", "box"])
def test_what_a_wave_lifts_is_the_energy_of_its_surface(problem, shape):
    """Over g: half the density times the integral of the height's square, mode by mode; the centre of mass of the
    liquid rises so far."""
    made = sv.load_scenario("panda-coffee").with_changes(**(BOX if shape == "box" else {}))
    body = made.payload.first
    case = LoadCase(body, 0.05, 0.01)
    lifts, gain, half = (
        x[0] for x in (SurfaceCases.of((case,)).rising, SurfaceCases.of((case,)).gain, case.modes.half[None])
    )
    for n in range(2):
        for axis in range(2):
            if shape == "box":
                x = np.linspace(-1, 1, 4001)
                height, area = np.sin((2 * n + 1) * np.pi / 2 * x), 4 * half[0] * half[1]
                square = 0.5 * np.trapezoid(height**2, x) * area
            else:
                rho, root = np.linspace(0, 1, 4001), jnp_zeros(1, 2)[n]
                square = np.pi * half[0] ** 2 * np.trapezoid((jv(1, root * rho) / jv(1, root)) ** 2 * rho, rho)
            assert lifts[n, axis] / gain[n, axis] ** 2 == pytest.approx(body.inner.density * square, rel=1e-6)


def test_waves_are_driven_by_what_the_tray_of_a_late_arm_feels(problem):
    """Commands that are held for 10 ms change the waves as much as what they make the tray feel does."""
    swing, at_once = 0.35 * AWAY, planned(problem, 0.35 * AWAY)
    late = planned(replace(problem, tracking=replace(problem.tracking, delay=0.01)), swing)
    t, (felt, _) = late.s * DURATION, late.response.felt()
    swayed = [motion.loads["cup"][1].modes.eta for motion in (late, at_once)]
    alone = [SurfaceMotion.along(problem.cases[0], t, w).eta for w in (felt, late.terms.w)]
    changes = swayed[0] - swayed[1], alone[0] - alone[1]
    assert np.abs(changes[0] - changes[1]).max() < 0.15 * np.abs(changes[1]).max()
