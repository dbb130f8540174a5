"""Does the engine do what Coulomb says? Slopes, rest, onset of sliding and how far it slides, tipping, creep."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from numpy.polynomial import Polynomial
from scipy.optimize import brentq

from salver import scenario as scenarios
from salver.errors import SalverError
from salver.geometry import exp
from salver.models.arm.arm import load_arm
from salver.scenario import parse
from salver.simulation import creep
from salver.simulation.physics import _check_engine, simulate_tray
from salver.simulation.scene.elements import DAMPING_WIDTH
from salver.simulation.scene.loads import true_world
from salver.simulation.scene.scene import build
from salver.trajectory import min_jerk_line

G = 9.81
UPRIGHT = np.eye(3)
MIN_JERK_PEAK = 10 / np.sqrt(3)  # largest acceleration of s(u) = 10 u^3 - 15 u^4 + 6 u^5


def cube(**changes):
    return scenarios.load("panda-cube").with_changes(**changes)


def bottle(height=0.24, radius=0.03):
    data = scenarios.load("panda-cube").model_dump(mode="json", exclude_none=True)
    data["objects"][0] |= {"shape": {"type": "cylinder", "radius": radius, "height": height}, "mass": 0.5}
    data["objects"][0].pop("inertia")
    return parse(data, "bottle")


def at_rest(duration):
    return min_jerk_line(duration, np.zeros(3), np.zeros(3), UPRIGHT, UPRIGHT)


def line(duration, length=0.48, R_goal=UPRIGHT):
    return min_jerk_line(duration, np.zeros(3), np.array([length, 0, 0]), UPRIGHT, R_goal)


@pytest.mark.slow
@pytest.mark.parametrize("friction", [0.1, 0.2, 0.5, 0.7])
@pytest.mark.parametrize("axis", ["tilt_x", "tilt_y"])
def test_sticks_below_the_friction_angle_and_slides_above_it_to_a_fifth_of_a_degree(friction, axis):
    scenario = cube(physics__settle_after=0.0)
    limit = np.arctan(friction)
    below = simulate_tray(at_rest(1.0), scenario, {"friction": friction, axis: limit - np.deg2rad(0.2)})
    assert below.outcome == "holds"
    assert below.slip.max() < 1e-6  # m in a second
    above = simulate_tray(at_rest(1.0), scenario, {"friction": friction, axis: limit + np.deg2rad(0.2)})
    assert above.outcome == "slides"
    assert above.summary["slides_at_rest"]
    angle = limit + np.deg2rad(0.2)
    acceleration = G * (np.sin(angle) - friction * np.cos(angle))
    expected = 0.5 * acceleration * (1.2**2 - 0.2**2)  # it has slid for 0.2 s when the motion starts
    assert above.slip[-1, 0] == pytest.approx(expected, rel=0.03)


def test_an_object_at_rest_on_a_level_tray_does_not_drift():
    record = simulate_tray(at_rest(2.5), cube())
    assert record.slip.max() < 1e-9
    assert record.lift.max() < 1e-9
    assert record.in_contact.all()
    np.testing.assert_allclose(record.contact_force_E[:, 0], np.tile([0, 0, 0.256 * G], (len(record.t), 1)), atol=1e-6)


def coulomb_slip(duration, length, friction):
    """How far a point mass slides in the first half of the min-jerk line: exact Coulomb friction on a level tray.

    It slides from where the tray's acceleration passes mu g until the friction has brought it up to the tray's speed.
    """
    s = Polynomial([0, 0, 0, 10, -15, 6])
    v, limit = s.deriv(), friction * G * duration**2 / length
    crossings = sorted(r.real for r in (s.deriv(2) - limit).roots() if abs(r.imag) < 1e-12 and 0 < r.real < 0.5)
    start = crossings[0]
    stop = brentq(lambda u: v(u) - v(start) - limit * (u - start), crossings[-1] + 1e-9, 1)
    return length * (s(stop) - s(start) - v(start) * (stop - start) - 0.5 * limit * (stop - start) ** 2)


@pytest.mark.slow
@pytest.mark.parametrize("friction", [0.1, 0.35, 0.6])
def test_the_first_sliding_duration_is_coulombs_to_three_per_cent(friction):
    """Level straight moves around the limit, where the cone is left: T^2 = (10 / sqrt 3) L / (mu g)."""
    limit = np.sqrt(MIN_JERK_PEAK * 0.48 / (friction * G))
    slips = {}
    for factor in (1.01, 0.99, 0.98, 0.97):
        record = simulate_tray(line(factor * limit), cube(), {"friction": friction})
        slips[factor] = record.slip.max()
        assert record.summary["objects"][0]["peak_slip"] >= slips[factor]
    assert slips[1.01] < 1e-6
    assert slips[0.99] > 1e-4
    assert slips[0.97] > 1e-3
    for factor in (0.98, 0.97):
        assert slips[factor] == pytest.approx(coulomb_slip(factor * limit, 0.48, friction), rel=0.02)


def test_mass_alone_does_not_make_a_body_slide_that_follows_its_tray():
    limit = np.sqrt(MIN_JERK_PEAK * 0.48 / (0.3 * G))
    light, heavy = (simulate_tray(line(0.97 * limit), cube(), {"friction": 0.3, "mass": m}) for m in (0.1, 1.0))
    assert light.slip.max() == pytest.approx(heavy.slip.max(), rel=0.02)
    light, heavy = (simulate_tray(line(1.01 * limit), cube(), {"friction": 0.3, "mass": m}) for m in (0.1, 1.0))
    assert max(light.slip.max(), heavy.slip.max()) < 1e-6


@pytest.mark.slow
def test_a_tall_object_tips_where_moments_say():
    """A bottle of radius r, centre of mass h up, tips first about the front of its base when a > g r / h."""
    scenario = bottle()
    r, h = 0.03, 0.12
    limit = np.sqrt(MIN_JERK_PEAK * 0.48 / (G * r / h))
    holds = simulate_tray(line(1.02 * limit), scenario, {"friction": 0.6})
    assert holds.outcome == "holds"
    assert holds.tip_angle.max() < np.deg2rad(0.05)
    falls = simulate_tray(line(0.90 * limit), scenario, {"friction": 0.6})
    assert falls.outcome == "tips"
    assert falls.summary["objects"][0]["first_tip"] < 0.5 * limit
    # an offset of the centre of mass moves the limit: r - 6 mm is what is left in front
    moved = np.sqrt(MIN_JERK_PEAK * 0.48 / (G * (r - 0.006) / h))
    assert simulate_tray(line(1.02 * moved), scenario, {"friction": 0.6, "com_x": -0.006}).outcome == "holds"
    assert simulate_tray(line(0.92 * moved), scenario, {"friction": 0.6, "com_x": -0.006}).outcome == "tips"


def test_a_tray_that_drops_faster_than_gravity_loses_the_object():
    """Down by 0.5 m in 0.35 s: the tray's peak acceleration is 2.4 g."""
    reference = min_jerk_line(0.35, np.zeros(3), np.array([0, 0, -0.5]), UPRIGHT, UPRIGHT)
    record = simulate_tray(reference, cube())
    assert record.outcome == "lifts"
    assert record.lift.max() > 0.05
    assert not record.in_contact.all()
    slow = min_jerk_line(0.56, np.zeros(3), np.array([0, 0, -0.5]), UPRIGHT, UPRIGHT)  # 0.94 g
    assert simulate_tray(slow, cube()).outcome == "holds"


def test_an_engine_that_diverged_gives_an_error_and_no_verdict(tmp_path, monkeypatch):
    """A tray thrown a million kilometres up in a tenth of a second: beyond what the engine can count."""
    monkeypatch.chdir(tmp_path)  # where MuJoCo writes its own log of it
    reference = min_jerk_line(0.1, np.zeros(3), np.array([0, 0, 1e9]), UPRIGHT, UPRIGHT)
    with pytest.raises(
        SalverError, match=r"diverged .* s into the run; give physics.timestep a smaller value than 0.0005"
    ):
        simulate_tray(reference, cube())


def test_one_coordinate_that_is_no_number_is_an_engine_that_diverged():
    xml = "<mujoco><worldbody><body><freejoint/><geom size='0.1'/></body></worldbody></mujoco>"
    data = mujoco.MjData(mujoco.MjModel.from_xml_string(xml))
    _check_engine(data, cube())
    data.qpos[2] = np.nan
    with pytest.raises(SalverError, match=r"diverged 0\.000 s into the run"):
        _check_engine(data, cube())


def test_contact_forces_of_a_moving_tray_are_the_bodys_inverse_dynamics():
    """While it sticks: the sum of measured forces is F = Y phi of the paper's eq (1), tilting and turning included."""
    from newton_euler import wrench

    scenario = cube()
    parameters = {"mass": 0.3, "com_x": 0.002, "com_z": 0.004}
    turn = exp(np.array([0.2, -0.15, 0.8]))
    reference = line(1.2, R_goal=turn)
    record = simulate_tray(reference, scenario, parameters)
    assert record.outcome == "holds"
    motion = reference.sample(record.t)
    phi = true_world(scenario, parameters).loads[0].inertial.phi
    expected = wrench(phi, motion.R_SB, motion.a_S, motion.omega_B, motion.alpha_B)
    measured = record.contact_forces_B.sum(axis=1)
    moment = np.cross(record.contact_points_B, record.contact_forces_B).sum(axis=1)
    # a step of 0.5 ms smears a force of some N that changes within 0.1 s by a few mN
    np.testing.assert_allclose(measured, expected[:, :3], atol=0.02)
    np.testing.assert_allclose(moment, expected[:, 3:], atol=5e-4)


def test_free_flight_in_the_trays_frame_is_a_parabola_in_the_world():
    """The tray falls and turns away from under the object, which then knows nothing of the tray."""
    turn = exp(np.array([0.3, 0.5, -0.4]))
    reference = min_jerk_line(0.5, np.zeros(3), np.array([0.1, 0, -1.5]), UPRIGHT, turn)
    record = simulate_tray(reference, cube(physics__settle_after=0.0))
    free = ~record.in_contact[:, 0] & (record.t > 0.1) & (record.t < 0.3)
    t, p = record.t[free], record.p_SB[free, 0]
    assert len(t) > 20
    fit = np.polyfit(t, p, 2)
    np.testing.assert_allclose(2 * fit[0], [0, 0, -G], atol=0.02)
    np.testing.assert_allclose(p, np.array([np.polyval(fit[:, i], t) for i in range(3)]).T, atol=2e-5)


TURNTABLE = """<robot name="turntable">
<link name="base"/>
<link name="table"><inertial><origin xyz="0 0 0"/><mass value="1000"/>
<inertia ixx="1000" ixy="0" ixz="0" iyy="1000" iyz="0" izz="1000"/></inertial></link>
<joint name="turn" type="revolute"><parent link="base"/><child link="table"/><axis xyz="0 0 1"/>
<limit effort="1" velocity="100" lower="-60" upper="60"/></joint>
<link name="post"><inertial><origin xyz="0 0 0"/><mass value="1"/>
<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
<joint name="swivel" type="revolute"><parent link="table"/><child link="post"/><axis xyz="0 0 1"/>
<limit effort="1" velocity="100" lower="-60" upper="60"/></joint>
<link name="rim"/>
<joint name="out" type="fixed"><parent link="post"/><child link="rim"/><origin xyz="0.5 0 0"/></joint>
</robot>"""


@pytest.mark.parametrize("timestep", [5e-4, 1e-3])
def test_creep_law_on_a_turntable(tmp_path, timestep):
    """A tray at r = 0.5 m that turns at w = 2 rad/s: its contacts creep outwards at gain w^2 r, whatever the friction.

    The law against the closed form, and both against the engine.
    """
    path = tmp_path / "turntable.urdf"
    path.write_text(TURNTABLE)
    scenario = cube(physics__timestep=timestep, arm__model=str(path), arm__flange="rim", arm__start_posture=[0.0, 0.0])
    arm = load_arm(scenario.arm, scenario.tray)
    scene = build(scenario, true_world(scenario, {"friction": 0.9}), arm)
    data = mujoco.MjData(scene.model)
    scene.place(data, np.zeros(2))
    speed, seconds = 2.0, 2.0
    data.qvel[0] = speed
    data.qvel[2:8] = [0, speed * 0.5, 0, 0, 0, speed]
    mujoco.mj_step(scene.model, data, nstep=round(0.2 / timestep))

    def place_on_tray():
        p, R = scene.tray_pose(data)
        return R.T @ (data.xpos[scene.object_ids[0]] - p)

    before = place_on_tray()
    mujoco.mj_step(scene.model, data, nstep=round(seconds / timestep))
    assert data.qvel[0] == pytest.approx(speed, rel=1e-3)
    measured = place_on_tray() - before

    gain = creep.gain(scene.contact_time, timestep, DAMPING_WIDTH)
    assert gain == pytest.approx(0.45 * timestep)
    t = np.linspace(0, seconds, 101)
    q, dq = np.outer(t, [speed, 0.0]), np.tile([speed, 0.0], (101, 1))
    load = scene.loads[0]
    predicted = creep.creep(t, creep.tray_bias(arm, q, dq, np.eye(3)), load.p_EB, load.p_EB, None, gain)[-1]
    np.testing.assert_allclose(predicted, [gain * speed**2 * 0.5 * seconds, 0, 0], atol=1e-9)
    assert measured[0] == pytest.approx(predicted[0], rel=0.03)
    assert abs(measured[1]) < 0.03 * predicted[0]


def test_creep_of_a_stack_on_a_turntable(tmp_path):
    """The upper creeps outwards on the lower one, at gain w^2 times the distance of their origins: law and engine.

    The slab is at the tray's middle and the cube 1.5 cm beyond its centre.
    """
    path = tmp_path / "turntable.urdf"
    path.write_text(TURNTABLE)
    data = cube(physics__timestep=1e-3).model_dump(mode="json", exclude_none=True)
    data["arm"] = {"model": str(path), "flange": "rim", "start_posture": [0.0, 0.0]}
    slab = {"name": "slab", "shape": {"type": "box", "size": [0.08, 0.08, 0.03]}, "mass": 0.4, "friction": 0.9}
    small = {"name": "cube", "shape": {"type": "box", "size": [0.03, 0.03, 0.03]}, "mass": 0.1, "friction": 0.9}
    data["objects"] = [slab, small | {"on": "slab", "at": [0.015, 0.0]}]
    scenario = parse(data, "stack")
    arm = load_arm(scenario.arm, scenario.tray)
    scene = build(scenario, true_world(scenario), arm)
    data = mujoco.MjData(scene.model)
    scene.place(data, np.zeros(2))
    speed, seconds = 2.0, 2.0
    data.qvel[0] = speed
    for load, i, j in zip(scene.loads, scene.qpos_ids, scene.qvel_ids, strict=True):
        data.qvel[j : j + 6] = [*np.cross([0, 0, speed], data.qpos[i : i + 3]), 0, 0, speed]
        np.testing.assert_allclose(load.R_EB, np.eye(3), atol=1e-12)
    mujoco.mj_step(scene.model, data, nstep=200)

    def upper_on_lower():
        lower, upper = scene.object_ids
        return data.xmat[lower].reshape(3, 3).T @ (data.xpos[upper] - data.xpos[lower])

    before = upper_on_lower()
    mujoco.mj_step(scene.model, data, nstep=round(seconds / 1e-3))
    measured = upper_on_lower() - before

    gain = creep.gain(scene.contact_time, 1e-3, DAMPING_WIDTH)
    t = np.linspace(0, seconds, 101)
    q, dq = np.outer(t, [speed, 0.0]), np.tile([speed, 0.0], (101, 1))
    bias = creep.tray_bias(arm, q, dq, np.eye(3))
    predicted = creep.creep(t, bias, *[scene.loads[1].p_EB] * 2, scene.loads[0].p_EB, gain)[-1]
    np.testing.assert_allclose(predicted, [gain * speed**2 * 0.015 * seconds, 0, 0], atol=1e-9)
    assert measured[0] == pytest.approx(predicted[0], rel=0.05)
