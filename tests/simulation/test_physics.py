"""Runs with the arm and its controller: outcome, creep, forces against the plan, limits, records."""

from __future__ import annotations

from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from newton_euler import wrench
from salver import scenario as scenarios
from salver.control.arm import ArmState, controller_for
from salver.errors import FileFormatError, SalverError, ScenarioError, UnreachableError
from salver.geometry import matrix_from_quat_wxyz
from salver.models.arm.arm import load_arm
from salver.planning.make import make_plan
from salver.scenario import parse
from salver.simulation.physics import Experiment, simulate, simulate_tray
from salver.simulation.record import load_record
from salver.simulation.run import Options

G = 9.81


def quick(**changes):
    """The paper's move in 1.2 s with little waiting: a third of the run time."""
    changes = {"motion__duration": 1.2, "physics__settle_before": 0.1, "physics__settle_after": 0.1} | changes
    return make_plan(scenarios.load("panda-cube").with_changes(**changes), "baseline")


@pytest.fixture(scope="module")
def fast():
    return quick()


@pytest.fixture(scope="module")
def plain(fast):
    return simulate(fast)


@pytest.mark.slow
def test_the_papers_move_holds_and_creep_is_not_slip(nominal):
    """Raw displacement in the engine is 70 um; what the creep law leaves of it is below a tenth of a micrometre."""
    assert nominal.outcome == "holds"
    raw = np.linalg.norm(nominal.slip_E[:, 0, :2], axis=1)
    assert 50e-6 < raw.max() < 100e-6
    np.testing.assert_allclose(nominal.slip_E[:, 0, :2], nominal.creep_E[:, 0, :2], atol=1e-7)
    assert nominal.slip.max() < 1e-7
    assert nominal.in_contact.all()


@pytest.mark.slow
@pytest.mark.parametrize("method", ["baseline", "fastest"])
def test_a_run_is_the_same_alone_and_after_others_of_the_same_experiment(fast, method):
    """In object space and in joint space; the run before asks for more torque than there is, and loses the cube."""
    plan = replace(fast, method=method)
    experiment = Experiment(plan)
    assert experiment.run({"mass": 12.0, "inertia_xx": 0.01, "inertia_yy": 0.01, "inertia_zz": 0.01}).outcome != "holds"
    again, alone = experiment.run({"mass": 0.27}, seed=3), simulate(plan, parameters={"mass": 0.27}, seed=3)
    for name in ("q", "tau", "p_SB", "slip", "contact_forces_B", "e_p"):
        np.testing.assert_array_equal(getattr(again, name), getattr(alone, name))
    assert {**again.summary, "wall_time": 0} == {**alone.summary, "wall_time": 0}


@pytest.mark.slow
def test_creep_law_holds_at_another_timestep():
    plan = quick(physics__timestep=1e-3)
    record = simulate(plan)
    assert np.linalg.norm(record.slip_E[-1, 0, :2]) > 200e-6
    np.testing.assert_allclose(record.slip_E[:, 0, :2], record.creep_E[:, 0, :2], atol=5e-7)


@pytest.mark.slow
def test_tracking_errors_are_small_and_told_of_the_right_frames(baseline, nominal):
    assert nominal.tray_e_p.max() < 5e-5
    assert nominal.e_p.max() < 2e-4
    R = matrix_from_quat_wxyz(nominal.quat_SE_wxyz)
    p_EB = np.einsum("tji,tj->ti", R, nominal.p_SB[:, 0] - nominal.p_SE)
    np.testing.assert_allclose(p_EB, np.tile([0, 0, 0.02], (len(p_EB), 1)), atol=3e-4)
    wanted = baseline.reference.sample(nominal.t)
    np.testing.assert_allclose(np.linalg.norm(wanted.p_SB - nominal.p_SB[:, 0], axis=1), nominal.e_p, atol=1e-12)
    arm = load_arm(baseline.scenario.arm, baseline.scenario.tray)
    for k in (0, 200, 500):
        p, R_pin = arm.tray_pose(nominal.q[k])
        np.testing.assert_allclose(nominal.p_SE[k], p, atol=1e-9)
        np.testing.assert_allclose(R[k], R_pin, atol=1e-9)


def test_measured_cone_coefficients_are_the_plans(baseline, nominal):
    moving = nominal.t <= baseline.duration
    expected = np.array([np.interp(nominal.t[moving], baseline.t, c) for c in baseline.cone_coefficients.T]).T
    np.testing.assert_allclose(nominal.cone_coefficients[moving], expected, atol=1e-3)
    # and the four corner forces themselves are the pseudo-inverse distribution
    body = baseline.scenario.objects[0]

    contacts = baseline.scenario.payload.first.contacts
    at = np.argmin(np.linalg.norm(contacts.p_BC[:, None] - nominal.contact_points_B, axis=2), axis=1)
    np.testing.assert_allclose(nominal.contact_points_B[at], contacts.p_BC, atol=1e-12)
    forces = (contacts.cone_edges @ nominal.cone_coefficients.T).T.reshape(-1, 4, 3)
    np.testing.assert_allclose(nominal.contact_forces_B[:, at], forces, atol=2e-3)
    assert body.mass * G == pytest.approx(nominal.contact_force_E[-1, 0, 2], abs=1e-3)


def test_a_heavier_object_weighs_more_and_sags(baseline):
    """+50 g: at rest each of the 16 coefficients grows by 0.306 / 0.256; the arm gives way to the unknown weight."""
    record = simulate(baseline, parameters={"mass": 0.306})
    assert record.outcome == "holds"
    at_rest = 0.306 * G / 16 * np.sqrt(1 + 0.5**2)
    np.testing.assert_allclose(record.cone_coefficients[-1], at_rest, rtol=0.02)
    # a position error of the closed loop: delta m g = m kp e_p, but for what the arm's own inertia adds
    sag = 0.05 * G / (0.256 * 500)
    assert 0 < record.e_p[-1] < sag
    assert record.summary["tube"]["excess"] > 0.03


def test_contact_force_is_the_bodys_inverse_dynamics(fast):
    """Independent of the planner: F from the measured motion of the tray itself, by second differences."""
    record = simulate(fast, parameters={"mass": 0.2})
    inner = slice(1, -1)
    h = record.t[1] - record.t[0]
    a = (record.p_SB[2:, 0] - 2 * record.p_SB[1:-1, 0] + record.p_SB[:-2, 0]) / h**2
    R = matrix_from_quat_wxyz(record.quat_SB_wxyz[inner, 0])
    zero = np.zeros_like(a)
    phi = np.array([0.2, 0, 0, 0, *3.4e-4 * np.array([1, 0, 1, 0, 0, 1])])
    force = wrench(phi, R, a, zero, zero)[:, :3]
    np.testing.assert_allclose(record.contact_forces_B.sum(axis=1)[inner], force, atol=0.01)


@pytest.mark.slow
def test_the_first_sliding_duration_with_the_arm_is_that_of_the_exact_cone():
    """Level straight moves with the arm, friction 0.2: the engine slides first where Coulomb says, to 3 %."""
    scenario = scenarios.load("panda-cube")
    length = np.linalg.norm(np.subtract(scenario.motion.goal.position, scenario.motion.start.position))
    limit = np.sqrt(10 / np.sqrt(3) * length / (0.2 * G))
    peaks = {}
    for factor in (1.015, 0.985):
        plan = quick(motion__duration=factor * limit)
        record = simulate(plan, parameters={"friction": 0.2})
        assert record.summary["arm"]["limits_kept"]
        peaks[factor] = record.slip.max()
    assert peaks[1.015] < 5e-6
    assert peaks[0.985] > 1e-4


@pytest.mark.slow
def test_tray_alone_and_arm_agree_on_a_tilting_slide():
    """Two formulations of the same physics: the world's frame with the arm, the tray's frame with inertial forces."""
    goal = {"position": [0.444272, 0.100574, 0.4], "rpy_deg": [-20.0, 10.0, 30.0]}
    changes = {"motion__goal": goal, "motion__duration": 1.2, "physics__settle_after": 0.1}
    plan = make_plan(scenarios.load("panda-cube-tilted-goal").with_changes(**changes), "baseline")
    parameters = {"friction": 0.53}
    arm = simulate(plan, parameters=parameters)
    tray = simulate_tray(plan.reference, plan.scenario, parameters)
    assert arm.outcome == tray.outcome == "slides"
    assert tray.slip.max() > 0.02
    difference = arm.slip_E - arm.creep_E - tray.slip_E
    assert np.abs(difference).max() < 0.06 * tray.slip.max()


@pytest.mark.slow
def test_sampled_runs_are_reproducible(fast):
    noisy = replace(
        fast, scenario=fast.scenario.with_changes(physics__position_noise=1e-5, physics__velocity_noise=1e-3)
    )
    first, again, other = (simulate(noisy, seed=s) for s in (3, 3, 4))
    np.testing.assert_array_equal(first.q, again.q)
    np.testing.assert_array_equal(first.contact_forces_B, again.contact_forces_B)
    assert np.abs(first.q - other.q).max() > 0
    assert first.outcome == other.outcome == "holds"


@pytest.mark.parametrize(("of_q", "of_dq"), [(1e-4, 0.0), (0.0, 1e-2)])
def test_noise_of_the_sensors_is_as_large_as_asked_for_and_of_the_seed(fast, of_q, of_dq):
    """The first command by the controller itself, on joints and speeds off by numbers drawn from the seed."""
    changes = {"physics__settle_before": 0.0, "physics__settle_after": 0.0}
    changes |= {"physics__position_noise": of_q, "physics__velocity_noise": of_dq}
    noisy = replace(fast, scenario=fast.scenario.with_changes(**changes))
    record = simulate(noisy, seed=5)
    rng, q = np.random.default_rng(5), fast.joint.sample(0.0)[0][0]
    controller = controller_for(noisy.scenario, fast.joint, fast.reference)
    seen = ArmState(q + of_q * rng.standard_normal(7), of_dq * rng.standard_normal(7))
    np.testing.assert_allclose(record.tau[0], controller.step(seen, 0.0), atol=1e-9)
    np.testing.assert_allclose(record.q[0], q, atol=1e-12)  # what is recorded is the truth


@pytest.mark.slow
def test_a_loop_closed_on_the_first_object_keeps_it_where_it_should_be_though_it_creeps():
    """Soft contacts creep by 0.14 mm. Closed on the joints, the tray keeps its place and the cube is off by as much;
    closed on the cube's own pose it is the other way round, whatever else is carried."""
    cube = scenarios.load("panda-cube").objects[0].model_dump(exclude_unset=True)
    two = [{**cube, "at": [0.03, 0.0]}, {**cube, "name": "other", "at": [-0.05, 0.02], "yaw_deg": 30.0}]
    plan = quick(objects=two, contact__condition="exact", arm__start_posture=None)
    by_object = replace(plan, scenario=plan.scenario.with_changes(physics__feedback="object"))
    joints, seen = simulate(plan), simulate(by_object)
    assert joints.outcome == seen.outcome == "holds"
    creep = np.linalg.norm(joints.creep_E[:, 0], axis=1).max()
    assert joints.tray_e_p.max() < 0.3 * creep < 0.8 * creep < joints.e_p.max()
    assert seen.e_p.max() < 0.3 * creep < 0.8 * creep < seen.tray_e_p.max()


@pytest.mark.slow
def test_figures_of_the_summary_are_those_of_the_record(fast):
    """With every command kept, each figure is the largest (or least) of what is recorded."""
    plan = replace(fast, scenario=fast.scenario.with_changes(physics__settle_after=0.05))
    record = simulate(plan, parameters={"mass": 0.29}, options=Options(record_rate=1000.0))
    np.testing.assert_allclose(record.t, 1e-3 * np.arange(1251), atol=1e-12)
    summary = record.summary
    for name in ("e_p", "e_o", "tray_e_p", "tray_e_o"):
        assert summary[f"{name}_peak"] == getattr(record, name).max(), name
    assert summary["cone_coefficient_min"] == record.cone_coefficients.min()
    assert summary["duration"] == 1.2
    arm, limits = summary["arm"], load_arm(plan.scenario.arm, plan.scenario.tray).limits
    assert arm["torque_share_peak"] == pytest.approx((np.abs(record.tau) / limits.torque).max(), rel=1e-3)
    assert arm["velocity_share_peak"] == pytest.approx((np.abs(record.dq) / limits.velocity).max(), rel=1e-2)
    # The tube of the first-order theory along the measured coefficients, while the plan lasts.
    moving = record.t <= 1.2
    columns = zip(plan.cone_coefficients.T, plan.cone_radius.T, record.cone_coefficients[moving].T, strict=True)
    beyond = np.array(
        [np.abs(seen - CubicSpline(plan.t, c)(record.t[moving])) - np.interp(record.t[moving], plan.t, r)
         for c, r, seen in columns]
    )  # fmt: skip
    assert summary["tube"]["excess"] == pytest.approx(beyond.max(), abs=1e-6)
    sparse = simulate(plan, parameters={"mass": 0.29}, options=Options(record_rate=100.0))
    np.testing.assert_array_equal(sparse.q, record.q[::10])
    assert {**sparse.summary, "wall_time": 0} == {**summary, "wall_time": 0, "tube": sparse.summary["tube"]}


@pytest.mark.slow
def test_what_lies_between_controller_and_arm_shows(fast, plain):
    """Delay, joint friction and measured object: each changes the run, none drops the cube."""

    def with_physics(**changes):
        return simulate(replace(fast, scenario=fast.scenario.with_changes(**changes)))

    rubbing = with_physics(physics__joint_friction=0.3)
    assert rubbing.tray_e_p.max() > 3 * plain.tray_e_p.max()
    late = with_physics(physics__delay_steps=2)
    assert late.outcome == "holds"
    assert late.tray_e_p.max() > plain.tray_e_p.max()
    seen = with_physics(physics__feedback="object")
    assert seen.outcome == "holds"
    assert seen.e_p[-1] < 2e-5  # the loop is closed on the object itself, engine's creep included
    assert plain.e_p[-1] > 2e-5


def test_torque_limits_are_kept_and_saturation_is_told(fast, plain):
    """A payload of 12 kg, unknown to the controller, is more than the wrist can carry."""
    record = simulate(fast, parameters={"mass": 12.0, "inertia_xx": 0.01, "inertia_yy": 0.01, "inertia_zz": 0.01})
    arm = load_arm(fast.scenario.arm, fast.scenario.tray)
    assert np.all(np.abs(record.tau) <= arm.limits.torque + 1e-9)
    change = np.abs(np.diff(plain.tau, axis=0)) / (record.t[1] - record.t[0])
    assert np.all(change <= arm.limits.torque_rate)
    assert 0 < record.summary["arm"]["torque_cut"] <= 1
    assert record.outcome != "holds"


def with_limit(plan, folder, joint, limit, value):
    """The same plan on an arm of which one limit of one joint is another."""
    root = ElementTree.fromstring(load_arm(plan.scenario.arm, plan.scenario.tray).urdf)
    element = next(j for j in root.iter("joint") if j.get("name") == f"panda_joint{joint + 1}").find("limit")
    element.set(limit, repr(value))
    path = folder / "arm.urdf"
    path.write_bytes(ElementTree.tostring(root))
    return replace(plan, scenario=plan.scenario.with_changes(arm__model=str(path), arm__flange="panda_link8"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("limit", "joint", "used", "step", "told"),
    [
        ("velocity", 0, lambda r: np.abs(r.dq[:, 0]).max(), 0.01, "velocity_share_peak"),
        ("velocity", 3, lambda r: -r.dq[:, 3].min(), 0.01, "velocity_share_peak"),  # a joint that turns back
        ("upper", 1, lambda r: r.q[:, 1].max(), 0.01, "position_margin"),
        ("lower", 4, lambda r: r.q[:, 4].min(), -0.01, "position_margin"),
        ("effort", 1, lambda r: np.abs(r.tau[:, 1]).max(), 0.2, "torque_share_peak"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_load_that_holds_while_the_arm_breaks_a_limit_is_not_said_to_hold(
    fast, plain, tmp_path, limit, joint, used, step, told
):
    """A limit just beyond what the motion uses changes nothing; just short of it the word is `limit`."""
    peak = used(plain)
    kept = simulate(with_limit(fast, tmp_path, joint, limit, float(peak + step)))
    assert (kept.outcome, kept.summary["arm"]["limits_kept"]) == ("holds", True)
    broken = simulate(with_limit(fast, tmp_path, joint, limit, float(peak - step)))
    arm = broken.summary["arm"]
    assert (broken.outcome, arm["limits_kept"]) == ("limit", False)
    assert broken.summary["objects"][0]["outcome"] == "holds"
    if told == "position_margin":  # the engine has a stop there, which gives way
        assert kept.summary["arm"][told] == pytest.approx(0.01, abs=1e-4)
        assert -0.0101 < arm[told] < 0
    elif told == "velocity_share_peak":
        assert arm[told] == pytest.approx(used(broken) / (peak - step), rel=1e-3)
    else:
        assert kept.summary["arm"][told] == pytest.approx(peak / (peak + step), rel=1e-3)
        assert arm[told] > 1
    assert (arm["torque_cut"] > 0) == (limit == "effort")
    if (limit, joint) == ("velocity", 0):  # that the load slides besides is the worse of the two
        slippery = simulate(with_limit(fast, tmp_path, joint, limit, float(peak - step)), parameters={"friction": 0.1})
        assert (slippery.outcome, slippery.summary["arm"]["limits_kept"]) == ("slides", False)


@pytest.mark.slow
def test_round_base_with_many_feet_does_not_chatter():
    """A bottle off the tray's centre, 24 feet, some of which unload: the contact force stays smooth."""
    record = simulate(make_plan(scenarios.load("ur10-bottle"), "baseline"), options=Options(record_rate=1000.0))
    force = record.contact_force_E[:, 0, 2]
    assert np.abs(np.diff(force)).max() < 0.02 * force.mean()
    assert record.slip.max() < 1e-6


def test_friction_decides_the_outcome(fast):
    slides = simulate(fast, parameters={"friction": 0.1})
    assert slides.outcome == "slides"
    assert slides.summary["objects"][0]["first_slip"] > 0.05
    assert slides.summary["objects"][0]["final_slip"] > 1e-3
    at_rest = simulate(fast, parameters={"friction": 0.1, "tilt_x": 0.2})
    assert at_rest.summary["slides_at_rest"]


def test_a_collision_with_an_obstacle_is_told(fast, plain):
    """A post in the way of the tray, half way along the line."""
    assert plain.summary["collides_at"] is None
    post = {"type": "box", "size": [0.02, 0.02, 0.6], "position": [0.6, -0.135, 0.3]}
    plan = replace(fast, scenario=fast.scenario.with_changes(obstacles=[post]))
    record = simulate(plan)
    assert 0.3 < record.summary["collides_at"] < 0.6
    assert record.tray_e_p.max() > 1e-3


@pytest.mark.slow
def test_tall_object_tips_with_the_arm():
    data = quick().scenario.model_dump(mode="json", exclude_none=True)
    data["objects"][0] |= {"shape": {"type": "box", "size": [0.03, 0.03, 0.3]}, "friction": 0.8}
    data["objects"][0].pop("inertia")
    data["arm"].pop("start_posture")
    data["motion"]["duration"] = 1.5
    data["contact"] = {"condition": "exact"}
    record = simulate(make_plan(parse(data, "tall"), "baseline"))
    assert record.outcome == "tips"


def test_record_saves_and_loads(nominal, tmp_path):
    nominal.save(tmp_path, "baseline")
    again = load_record(tmp_path, "baseline")
    np.testing.assert_array_equal(again.contact_forces_B, nominal.contact_forces_B)
    assert again.outcome == nominal.outcome
    assert again.object_names == ("cube",)
    np.testing.assert_allclose(np.diff(again.t), 1 / 200, atol=1e-9)
    (tmp_path / "simulation" / "baseline.json").write_text("{}")
    with pytest.raises(FileFormatError, match=r"baseline\.json"):
        load_record(tmp_path, "baseline")
    with pytest.raises(FileFormatError):
        load_record(tmp_path, "plan")


def test_without_an_arm_the_tray_moves_exactly():
    plan = make_plan(scenarios.load("panda-cube").with_changes(arm=None), "baseline")
    record = simulate(plan, parameters={"mass": 0.3})
    assert record.q.shape[1] == 0
    assert record.tray_e_p.max() == 0
    assert record.outcome == "holds"
    np.testing.assert_array_equal(record.p_SE, simulate_tray(plan.reference, plan.scenario).p_SE)


def test_what_cannot_be_simulated_says_so(baseline):
    with pytest.raises(UnreachableError, match="panda-cube"):
        simulate(replace(baseline, joint=None))
    scenario = baseline.scenario.with_changes(physics__timestep=3e-4)
    with pytest.raises(ScenarioError, match=r"command_period.*timestep"):
        simulate(replace(baseline, scenario=scenario))


@pytest.mark.slow
def test_an_engine_that_diverged_under_an_arm_gives_an_error_and_no_verdict(fast, tmp_path, monkeypatch):
    """A joint without a torque limit and high gains on a state 20 ms old: the loop swings itself up."""
    monkeypatch.chdir(tmp_path)  # where MuJoCo writes its own log of it
    strong = with_limit(fast, tmp_path, 0, "effort", 1e30)
    stiff = {"physics__delay_steps": 20, "control__kp": [1e5, 1e5], "control__kd": [600, 600]}
    unstable = replace(strong, scenario=strong.scenario.with_changes(**stiff))
    with pytest.raises(SalverError, match=r"diverged .* s into the run; give physics.timestep a smaller value than"):
        simulate(unstable)
