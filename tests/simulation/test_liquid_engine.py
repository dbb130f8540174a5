"""Liquids in the physics engine, cups and boxes alike: what hangs in them is the liquid of the model, and swings as
plans say."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

import salver as sv
from salver.contact_margins import margins
from salver.dynamics.liquid.interiors import Rectangle, Round
from salver.dynamics.liquid.sloshing import Liquid
from salver.dynamics.liquid.surface import SurfaceMotion
from salver.dynamics.load_cases import LoadCase
from salver.errors import SalverError
from salver.export.mujoco import write_scene
from salver.geometry import exp
from salver.models.rigid_body import RigidBody
from salver.models.tray_motion import N_MOTION
from salver.planning.fastest import plan_fastest
from salver.planning.make import plan_baseline
from salver.sampling import draw
from salver.scenario import parse
from salver.simulation.physics import simulate_tray
from salver.simulation.scene.loads import true_world
from salver.simulation.scene.scene import build
from salver.trajectory import MotionSamples, SampledReference, min_jerk_line
from transport_problems import ROUGH

WALL = 0.004
# Inside, fill, brim and mass of the container. The light one is too long to be a solid, see `Load.still`.
BOXES = {
    "long": (0.09, 0.06, 0.05, 0.08, 0.25),
    "across": (0.06, 0.09, 0.05, 0.08, 0.25),
    "square": (0.07, 0.07, 0.05, 0.08, 0.25),
    "deep": (0.15, 0.05, 0.1, 0.14, 0.1),
    "light": (0.18, 0.06, 0.065, 0.09, 0.12),
}


GLASS = {
    "name": "glass",
    "shape": {"type": "cylinder", "radius": 0.036, "height": 0.1195},
    "mass": 0.348,
    "friction": 0.27,
    "support_inset": 0.002,
    "liquid": {"kind": "water", "fill": 0.0754, "brim": 0.1172, "radius": 0.0338, "highest_wave": 0.0069},
    "uncertainty": {"mass": "10%", "friction": "10%", "fill": "20%"},
}


def boxed(scenario, x, y, fill, brim, mass, **changes):
    box = {
        "objects__0__shape": {"type": "box", "size": [x + 2 * WALL, y + 2 * WALL, brim + WALL]},
        "objects__0__liquid": {"kind": "water", "size": [x, y], "fill": fill, "brim": brim},
        "objects__0__mass": mass,
        "objects__0__support_inset": 0.0,
    }
    return scenario.with_changes(**box, **changes)


def carrying(scenario, which, **changes):
    if which == "cup":
        return scenario.with_changes(**changes)
    return boxed(scenario, *BOXES[which], **changes)


def modes_by_hand(which, scenario):
    """Of each mode and axis: frequency, mass, height. Of a cylinder, roots of J1'; of a box, k = (2 n - 1) pi / L."""
    liquid = scenario.payload.first.inner
    h, density = liquid.fill, liquid.density
    if which == "cup":
        R, xi = 0.04, np.array([1.8411837813, 5.3314427735])[:, None] * np.ones(2)
        k, total = xi / R, density * np.pi * R**2 * h
        mass = total * 2 * R * np.tanh(k * h) / (xi * h * (xi**2 - 1))
    else:
        L = np.array(BOXES[which][:2])
        k, total = np.array([[1], [3]]) * np.pi / L, density * np.prod(L) * h
        mass = total * 8 * np.tanh(k * h) / (k**3 * L**2 * h)
    return np.sqrt(9.81 * k * np.tanh(k * h)), mass, -2 / k * np.tanh(k * h / 2)


@pytest.mark.parametrize("which", ["cup", "long", "across", "square", "deep"])
def test_what_hangs_in_a_container_is_its_liquid(coffee, which):
    """The engine's own mass matrix, with the container at the world's origin: held, all of it is the object with its
    liquid under a lid; a mode alone swings with its frequency, and pushes with its mass at its height."""
    scenario = carrying(coffee, which, arm=None)
    world = true_world(scenario)
    (load,), scene = world.loads, build(scenario, world)
    model, data = scene.model, mujoco.MjData(scene.model)
    model.opt.gravity = 0, 0, -9.81
    data.qpos[:] = 0
    data.qpos[3] = 1
    mujoco.mj_forward(model, data)
    M = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, M)
    frozen = load.modes.frozen
    held = RigidBody(frozen.mass, frozen.com_B + load.origin_B, frozen.inertia_com).phi + load.inertial.phi
    held = RigidBody.from_phi(held)
    assert held.mass == pytest.approx(load.inertial.mass + scenario.payload.first.inner.density * volume(which))
    x, y, z = held.mass * held.com_B
    lever = np.array([[0, z, -y], [-z, 0, x], [y, -x, 0]])
    about_B = held.inertia_com + held.mass * (held.com_B @ held.com_B * np.eye(3) - np.outer(held.com_B, held.com_B))
    np.testing.assert_allclose(M[:6, :6], np.block([[held.mass * np.eye(3), lever], [lever.T, about_B]]), atol=2e-9)
    omega, mass, height = modes_by_hand(which, scenario)
    still = data.qfrc_bias.copy()
    for n in range(2):
        for axis in range(2):
            joint = model.joint(f"salver:swing:0:{n}:{'xy'[axis]}")
            j, far = int(joint.dofadr[0]), 1e-4
            alone = M[6:, j].copy()
            alone[j - 6] = 0
            assert np.abs(alone).max() < 1e-9 * M[j, j]  # modes move one another through the container only
            data.qpos[joint.qposadr[0]] = far
            mujoco.mj_forward(model, data)
            stiffness = (data.qfrc_bias - still)[j] / far
            data.qpos[joint.qposadr[0]] = 0
            assert np.sqrt(stiffness / M[j, j]) == pytest.approx(omega[n, axis], rel=1e-5)
            push = np.zeros(3)
            push[axis] = M[axis, j]
            assert push[axis] ** 2 / M[j, j] == pytest.approx(mass[n, axis], rel=2e-5)
            np.testing.assert_allclose(M[:3, j], push, atol=1e-6 * abs(push[axis]))
            moment = np.cross(load.origin_B + np.array([0, 0, height[n, axis]]), push)
            np.testing.assert_allclose(M[3:6, j], moment, atol=1e-6 * abs(push[axis]))
            damping = model.dof_damping[j] / M[j, j] / (2 * omega[n, axis])
            assert damping == pytest.approx(load.damping, rel=2e-5)


def volume(which):
    if which == "cup":
        return np.pi * 0.04**2 * 0.05
    x, y, fill = BOXES[which][:3]
    return x * y * fill


def test_a_long_box_that_weighs_little_turns_about_its_long_side_with_what_swings(coffee):
    """The model would leave it less than no moment of its own; the engine gets none, and all else as it is."""
    scenario = carrying(coffee, "light", arm=None)
    world = true_world(scenario)
    (load,) = world.loads
    rest = load.modes.still
    rest = RigidBody(rest.mass, rest.com_B + load.origin_B, rest.inertia_com)
    exact = RigidBody.from_phi(load.inertial.phi + rest.phi)
    lacking = np.diag(load.still.inertia_com - exact.inertia_com)
    assert exact.inertia_com[0, 0] < 0
    assert lacking[0] == pytest.approx(-exact.inertia_com[0, 0], rel=0.1)
    np.testing.assert_allclose(lacking[1:], 0, atol=1e-15)
    model = build(scenario, world).model
    body = model.body("salver:object:0")
    np.testing.assert_allclose(sorted(body.inertia), sorted(np.diag(load.still.inertia_com)), rtol=1e-9, atol=1e-12)
    assert body.mass[0] == pytest.approx(exact.mass)
    weight = load.inertial.mass + scenario.payload.first.inner.density * volume("light")
    assert model.body_subtreemass[body.id] == pytest.approx(weight)


@pytest.mark.slow
def test_a_scene_that_a_file_cannot_hold_is_not_written(coffee, tmp_path):
    plan = plan_baseline(carrying(coffee, "light", motion__duration=0.5, arm=None))
    plan.save(tmp_path / "run")
    with pytest.raises(SalverError, match="liquid in cup"):
        write_scene(tmp_path / "run", tmp_path / "scene", unsafe=True)
    assert not list(tmp_path.glob("scene*"))


def tilted_and_pushed(along, tilt=0.1, duration=0.8):
    """A line of min jerk, and a tilt about (.6, .8, 0) there and back."""
    at = np.array([0.4, 0.0, 0.4])
    line = min_jerk_line(duration, at, at + along, np.eye(3), np.eye(3))
    t = np.linspace(0, duration, 401)
    u, du, ddu = t * (duration - t), duration - 2 * t, -2.0
    scale, axis = tilt * (2 / duration) ** 6, np.array([0.6, 0.8, 0.0])
    angle, rate, change = (
        scale * x for x in (u**3, 3 * u**2 * du, 6 * u * du**2 + 3 * u**2 * ddu)
    )  # u^3 is flat to second order at both ends
    line = line.sample(t)
    turned = exp(angle[:, None] * axis)
    return SampledReference(
        MotionSamples(t, line.p_SB, line.v_S, line.a_S, turned, np.outer(rate, axis), np.outer(change, axis))
    )


@pytest.mark.parametrize(
    "which", ["cup", "square", *(pytest.param(x, marks=pytest.mark.slow) for x in ("long", "deep", "light"))]
)
def test_waves_of_the_engine_are_those_of_plans(coffee, which):
    """On a tray that goes aside, up and tilts; waves of a seventh of the container at most, where pendulums are all but
    linear. Cup and boxes within the same: 2 % of the largest wave, 2.5 % of the largest force on the container."""
    scenario = carrying(coffee, which, arm=None, objects__0__friction=3.0, objects__0__uncertainty={})
    motion = tilted_and_pushed(np.array([0.05, -0.04, 0.015]))
    record = simulate_tray(motion, scenario)
    assert max(record.summary["objects"][0][key] for key in ("peak_slip", "peak_lift")) < 1e-4
    moving = (record.t >= 0) & (record.t <= 0.8)
    found, t = margins(scenario, motion.sample(np.linspace(0, 0.8, 201))), record.t[moving]

    def at_commands(x):
        return np.stack([np.interp(t, found.t, of) for of in x.T], axis=1)

    waves = found.loads.nominal["cup"][0].modes
    told, seen = at_commands(waves.eta[0]), record.surface[moving, 0, :2]
    largest = np.abs(told).max(axis=0)
    assert largest.min() > 2e-3
    np.testing.assert_array_less(np.abs(seen - told).max(axis=0), 0.02 * largest)
    assert record.surface[moving, 0, 2].max() == pytest.approx(waves.crest.max(), rel=0.03)
    force, pushed = at_commands(found.interfaces[0].wrench_B[:, :3]), record.contact_force_E[moving, 0]
    # Contacts chatter from one command to the next.
    pushed = np.stack([np.convolve(x, np.full(15, 1 / 15), "valid") for x in pushed.T], axis=1)
    np.testing.assert_array_less(np.abs(pushed - force[7:-7]).max(axis=0), 0.025 * np.abs(force).max(axis=0))


@pytest.mark.parametrize("down", [[0.2, -0.1, -1.0], [-0.3, 0.25, -1.0]])
@pytest.mark.parametrize("which", ["cup", "long", "across"])
def test_liquids_are_placed_level(coffee, which, down):
    """However the tray is tilted, the masses hang along gravity, on both hinges of each."""
    scenario = carrying(coffee, which, arm=None)
    scene = build(scenario, true_world(scenario))
    data = mujoco.MjData(scene.model)
    scene.place(data, down=np.array(down))
    for n, rods in enumerate(scene.loads[0].modes.pendulums):
        name = f"salver:swing:0:{n}:rod:{''.join('xy'[axis] for axis in rods[-1].along)}"
        rod = data.xmat[scene.model.body(name).id].reshape(3, 3) @ [0, 0, -1]
        np.testing.assert_allclose(rod, np.array(down) / np.linalg.norm(down), atol=1e-12)


@pytest.mark.parametrize("seed", [7, 10])
def test_a_cup_that_tumbles_through_the_air_is_no_trouble_for_the_engine(coffee, seed):
    """Where the second hinge of a mass was a quarter turn from upright, the first had no lever, the engine diverged."""
    scenario = coffee.with_changes(arm=None)
    scene = build(scenario, true_world(scenario))
    data = mujoco.MjData(scene.model)
    scene.place(data)
    first = scene.qvel_ids[0]
    data.qvel[first : first + 6] = [0.0, 0.0, 2.0, *(40.0 * np.random.default_rng(seed).uniform(-1, 1, 3))]
    mujoco.mj_step(scene.model, data, nstep=1000)
    assert sum(warning.number for warning in data.warning) == 0


@pytest.mark.parametrize(
    "inside",
    [
        Round(0.04),
        Round(0.03, 0.2),
        *(Rectangle(*sides) for sides in ((0.09, 0.06), (0.06, 0.09), (0.2, 0.05), (0.07, 0.07 * (1 + 1e-8)))),
    ],
)
@pytest.mark.parametrize("depth", [0.5, 1.0, 2.5])
def test_rods_have_the_levers_and_moments_of_modes(inside, depth):
    """About each hinge m L and m L^2 under z + L, for both axes; no mass is negative, nor is what is left."""
    half = float(inside.half(0.0).max())
    modes = Liquid(inside, 0.005, depth * half, 1.0, 1000.0, (0.0, 0.0)).modes(depth * half)
    for n, rods in enumerate(modes.pendulums):
        assert sorted(axis for rod in rods for axis in rod.along) == [0, 1]
        for axis in range(2):
            k = next(i for i, rod in enumerate(rods) if axis in rod.along)
            hung = rods[k:]  # what swings along this axis: the rod, and those that hang on it
            levers = np.array([rods[k].pivot - rod.height for rod in hung])
            mass, length = modes.mass[n, axis], modes.length[n, axis]
            assert rods[k].pivot == pytest.approx(modes.height[n, axis] + length, rel=1e-6)
            assert sum(rod.mass * x for rod, x in zip(hung, levers, strict=True)) == pytest.approx(mass * length)
            assert sum(rod.mass * x**2 for rod, x in zip(hung, levers, strict=True)) == pytest.approx(mass * length**2)
        assert min(rod.mass for rod in rods) > 0
    assert modes.still.mass > 0.2 * modes.frozen.mass


def test_waves_in_a_box_that_turns_go_the_way_that_is_known(coffee):
    """Pushed along one side and turned by 1.5 rad: what the walls take along is most of the waves along the other side.
    The engine's pendulums turn as those of a cup, the liquid at .81 of that."""
    scenario = carrying(coffee, "square", arm=None, objects__0__friction=3.0, objects__0__uncertainty={})
    t, duration = np.linspace(0, 0.8, 401), 0.8
    at = np.array([0.4, 0.0, 0.4])
    line = min_jerk_line(duration, at, at + np.array([0.1, 0.0, 0.0]), np.eye(3), np.eye(3)).sample(t)
    u = t / duration
    angle = 1.5 * u**3 * (10 - 15 * u + 6 * u**2)
    rate = 1.5 / duration * 30 * u**2 * (1 - u) ** 2
    change = 1.5 / duration**2 * 60 * u * (1 - u) * (1 - 2 * u)
    up = np.array([0.0, 0.0, 1.0])
    turned = exp(angle[:, None] * up)
    motion = SampledReference(
        MotionSamples(t, line.p_SB, line.v_S, line.a_S, turned, np.outer(rate, up), np.outer(change, up))
    )
    record, found = simulate_tray(motion, scenario), margins(scenario, motion.sample(np.linspace(0, duration, 201)))
    known = found.loads.nominal["cup"][0].modes
    alone = SurfaceMotion.along(
        known.cases.each, found.t, found.w * (np.arange(N_MOTION) != 5)
    )  # as if it did not begin to turn
    moving = (record.t >= 0) & (record.t <= duration)
    seen = record.surface[moving, 0, :2]

    def missed(waves):
        told = np.stack([np.interp(record.t[moving], waves.t, waves.eta[0, :, axis]) for axis in range(2)], axis=1)
        return np.abs(seen - told).max()

    assert missed(known) < 0.15 * np.abs(seen).max()
    assert missed(alone) > 2 * missed(known)


def test_a_cup_beside_its_place_sloshes_as_plans_say(coffee):
    """Turned there and back about the axis on which it should stand, where no wave would be."""
    scenario = coffee.with_changes(
        arm=None, objects__0__friction=3.0, objects__0__uncertainty={"position": [0.02, 0.02]}
    )
    t, duration = np.linspace(0, 0.8, 401), 0.8
    u, du, ddu = t * (duration - t), duration - 2 * t, -2.0
    scale, up, still = 0.35 * (2 / duration) ** 6, np.array([0.0, 0.0, 1.0]), np.zeros((len(t), 3))
    angle, rate, change = (scale * x for x in (u**3, 3 * u**2 * du, 6 * u * du**2 + 3 * u**2 * ddu))
    p = still + np.array([0.4, 0.0, 0.4])
    turned = exp(angle[:, None] * up)
    motion = SampledReference(MotionSamples(t, p, still, still, turned, np.outer(rate, up), np.outer(change, up)))
    found, body, aside = (
        margins(scenario, motion.sample(np.linspace(0, duration, 201))),
        scenario.payload.first,
        (0.02, -0.02),
    )
    record = simulate_tray(motion, scenario, parameters=dict(zip(("position_x", "position_y"), aside, strict=True)))
    case = LoadCase(body, body.inner.fill, body.inner.nominal_damping, aside)
    told = SurfaceMotion.along((case,), found.t, found.w).crest[0].max()
    assert told > 2.5e-3
    assert found.loads.nominal["cup"][0].crest.max() < 1e-6
    seen = record.surface[(record.t >= 0) & (record.t <= duration), 0, 2].max()
    assert seen == pytest.approx(told, rel=0.03)


@pytest.mark.slow
def test_a_cup_whose_waves_were_too_high_between_nodes_is_carried():
    """By .06 % of its room, which no longer time mends: it was given up."""
    motion = {"start": {"position": [0.45, -0.2, 0.4]}, "goal": {"position": [0.45, 0.2, 0.4]}}
    motion |= {"goal_yaw": "fixed", "speeds": "full"}
    tray = {"size": [0.25, 0.25], "height": 0.05, "mass": 0.3}
    made = {"motion": motion, "objects": [GLASS], "contact": {"condition": "exact"}, "tray": tray}
    scenario = parse({"name": "glass", **made, "arm": {"model": "xarm7"}}, "glass")
    plan = plan_fastest(scenario)
    assert plan.ok, plan.told
    assert plan.duration < 0.75
    assert sv.simulate(plan, parameters={"fill": 1.2 * 0.0754}).outcome == "holds"


@pytest.mark.slow
def test_a_square_box_that_turns_by_a_right_angle_keeps_its_water(coffee):
    """It spilt, in 3 of 4 corners, as long as what its walls take along was not known."""
    inside = {"kind": "water", "size": [0.06, 0.06], "fill": 0.05, "brim": 0.075}
    shape = {"type": "box", "size": [0.07, 0.07, 0.085]}
    goal = sv.load_scenario("panda-cube-yaw").motion.goal
    turned = {"motion__goal_yaw": "fixed", "motion__goal": goal.model_dump(), "motion__speeds": "full"}
    turned_cup = coffee.with_changes(objects__0__shape=shape, objects__0__liquid=inside, **turned)
    plan = plan_fastest(turned_cup, options=ROUGH)
    assert plan.ok, plan.told
    full = {"fill": 0.065, "damping": 0.0, "mass": 0.275, "friction": 0.36}
    assert sv.simulate(plan, parameters=full).outcome == "holds"


@pytest.mark.slow
def test_a_box_of_water_planned_fastest_keeps_it_and_the_line_does_not(coffee):
    """Corners and random draws of all that is uncertain, in the engine."""
    changes = {"objects__0__yaw_deg": 30, "arm__start_posture": None, "motion__speeds": "full"}
    scenario = boxed(coffee, *BOXES["long"], **changes)
    plan = plan_fastest(scenario)
    assert plan.ok, plan.told
    assert plan.duration < 0.8
    uncertain, liquid = scenario.payload.uncertain, scenario.payload.first.inner
    full = {"fill": 0.065, "damping": liquid.damping[0], "mass": 0.275, "friction": 0.36}
    draws = draw(uncertain, 3, seed=1, bodies=scenario.payload.bodies)
    for parameters in (
        full,
        {**full, "com_x": 0.002, "com_y": -0.002, "com_z": 0.002},
        {"fill": 0.035, "damping": liquid.damping[0]},
        *(dict(zip(uncertain.names, values.tolist(), strict=True)) for values in draws),
    ):
        (seen,) = sv.simulate(plan, parameters=parameters).summary["objects"]
        assert seen["outcome"] == "holds"
        assert 0.3 * seen["room"] < seen["peak_wave"] < seen["room"]
    line = plan_baseline(scenario.with_changes(motion__duration=plan.duration, objects__0__friction=2.0)).reference
    assert simulate_tray(line, scenario.with_changes(objects__0__friction=2.0)).outcome == "spills"
