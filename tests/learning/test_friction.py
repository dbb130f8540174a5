"""What runs show of friction: against dense search over all loads, hand formulas, and what slides in the engine."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from salver.cli import app
from salver.errors import SalverError, ScenarioError
from salver.geometry import Array, log
from salver.learning.friction.friction import OPTIONS, friction, needed
from salver.learning.friction.tilts import _motion, tilt_test
from salver.models.arm.arm import load_arm
from salver.models.tray_motion import at_rest
from salver.motion_files.samples import joint_samples
from salver.planning.plan import Plan
from salver.scenario import load
from salver.simulation.physics import Experiment
from salver.trajectory import JointMotion, MotionSamples, smooth_step

SHOWN = 0.35


@pytest.fixture(scope="module")
def plan() -> Plan:
    return tilt_test(load("panda-cube"), SHOWN)


def ratio(w: Array, c: Array) -> Array:
    """(T, K) |f_t| / f_n of loads with their centres of mass at c (K, 3), from the definition."""
    f, alpha, wxx, wxy, wyy, wxz, wyz, wzz = w[:, :3], w[:, 3:6], *w[:, 6:].T
    square = np.stack(
        [
            np.stack([-wyy - wzz, wxy, wxz], -1),
            np.stack([wxy, -wxx - wzz, wyz], -1),
            np.stack([wxz, wyz, -wxx - wyy], -1),
        ],
        1,
    )
    force = f[:, None] + np.cross(alpha[:, None], c) + np.einsum("tij,kj->tki", square, c)
    return np.asarray(np.hypot(force[..., 0], force[..., 1]) / force[..., 2])


def test_bounds_hold_for_every_load_and_are_tight() -> None:
    """Against 8000 centres of mass each: never beyond any of them, and within half a per cent of the best known."""
    rng, com, reach = np.random.default_rng(0), np.array([0.01, -0.02, 0.12]), np.array([0.015, 0.01, 0.03])
    omega = rng.normal(0, 1.5, (40, 3))
    products = np.stack([omega[:, i] * omega[:, j] for i, j in ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2))], 1)
    w = np.hstack([rng.normal(0, 2.0, (40, 3)) + np.array([0, 0, 9.81]), rng.normal(0, 12.0, (40, 3)), products])
    least, most = needed(w, com, reach, 0.0)
    axes = [np.linspace(-1, 1, 20)] * 3
    all_of = ratio(w, com + np.stack(np.meshgrid(*axes), -1).reshape(-1, 3) * reach)
    assert np.all(least <= all_of.min(axis=1) + 1e-12)
    assert np.all(least >= 0.995 * all_of.min(axis=1) - 0.01)  # a grid misses a zero by its step
    assert most == pytest.approx(all_of.max(axis=1), rel=1e-9)
    assert np.all(needed(w, com, reach, 0.1)[0] <= least)


def test_at_rest_it_is_the_tangent_of_the_tilt_wherever_the_load_is() -> None:
    angle = 0.3
    R = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    least, most = needed(at_rest(R)[None], np.array([0.02, 0.0, 0.1]), np.full(3, 0.02), 0.0)
    assert least[0] == pytest.approx(np.tan(angle), rel=1e-9)
    assert most[0] == pytest.approx(np.tan(angle), rel=1e-9)


def test_a_tray_planned_to_tilt_proves_what_was_asked(plan: Plan) -> None:
    assert plan.ok
    found = friction(plan)
    assert found.high is None
    assert found.low is not None
    assert SHOWN <= found.low < SHOWN + 0.01
    assert "2.36 N, a mean pressure of 1.47 kPa on 16 cm^2" in found.sentences[-1]
    steepest = np.arccos(plan.reference.sample(plan.t).R_SB[:, 2, 2].min())
    assert found.low < np.tan(steepest)
    shakier = friction(plan, level=2.0).low
    assert shakier is not None
    assert shakier < found.low
    assert friction(plan, slid=0.9).high_time == pytest.approx(0.9, abs=0.02)  # a sample


@pytest.mark.parametrize("heading", [0.7, -2.0])
def test_from_a_start_that_is_turned_rates_are_those_of_the_turn(heading: float) -> None:
    """Against differences of R_SB; the tray falls towards the heading, and its frame stays where it is."""
    turned = load("panda-cube").with_changes(motion__start__rpy_deg=[10.0, -5.0, 110.0])
    t, h = np.linspace(0.0, 1.0, 21), 1e-5

    def at(t: Array) -> MotionSamples:
        return _motion(turned, heading, t, 0.3 * np.sin(2 * t), 0.6 * np.cos(2 * t), -1.2 * np.sin(2 * t))

    now, before, after = at(t), at(t - h), at(t + h)
    turns = log(np.swapaxes(before.R_SB, 1, 2) @ after.R_SB) / (2 * h)
    np.testing.assert_allclose(now.omega_B, turns, atol=1e-8)
    np.testing.assert_allclose(now.alpha_B, (after.omega_B - before.omega_B) / (2 * h), atol=1e-8)
    fallen = (now.R_SB @ turned.motion.start.rotation.T)[-1, :, 2]  # of what was upright
    np.testing.assert_allclose(fallen[:2], np.sin(0.3 * np.sin(2.0)) * np.array([np.cos(heading), np.sin(heading)]))
    assert np.ptp(now.p_SB, axis=0).max() == 0


@pytest.mark.slow
@pytest.mark.parametrize("true", [0.34, 0.5])
def test_ranges_hold_what_the_engine_had(plan: Plan, true: float) -> None:
    """It slides or it does not: what is said of friction then is so. A slip is seen late, when it has gone 2 mm."""
    record = Experiment(plan).run({"friction": true})
    slipped = record.t[record.slip[:, 0] > 2e-3]
    assert (len(slipped) == 0) == (true > 0.4)
    assert plan.scenario.arm is not None
    names = tuple(load_arm(plan.scenario.arm, plan.scenario.tray).joint_names)
    noisy = record.q + 2e-5 * np.random.default_rng(1).standard_normal(record.q.shape)
    seen = joint_samples(record.t, names, noisy, None, None, "log")
    if not len(slipped):
        low = friction(plan, seen).low
        assert low is not None
        assert SHOWN <= low <= true
        return
    still = float(record.t[record.slip[:, 0] < 2e-4][-1])
    found = friction(plan, seen, held=min(still, slipped[0] - 0.1), slid=float(slipped[0]))
    assert found.low is not None
    assert found.high is not None
    assert found.low <= true <= found.high
    assert found.high - found.low < 2 * np.deg2rad(0.5) * (1 + true) + 3 * OPTIONS.shakes + 0.03


@pytest.mark.slow
def test_what_would_tip_is_refused_with_what_can_be_asked_for(tmp_path: Path) -> None:
    """Tipping of the bottle (radius 30 mm, centre of mass 7.1 mm off and 125 mm high): at tan = 0.183 at most."""
    with pytest.raises(ScenarioError, match=r"could tip at .* at most 0\.1\d* can be asked for") as told:
        tilt_test(load("panda-tall-bottle"), 0.3)
    most = float(str(told.value).split("at most ")[1].split(" can")[0])
    assert most < (0.03 - 0.005 * np.sqrt(2)) / 0.125
    assert tilt_test(load("panda-tall-bottle"), most).ok


@pytest.mark.parametrize("shown", [0.0, -1.0, 5.0, float("nan")])
def test_absurd_friction_is_refused(shown: float) -> None:
    with pytest.raises(ScenarioError, match="must be above 0"):
        tilt_test(load("panda-cube"), shown)


def test_contradictions_are_told_and_nothing_widened(plan: Plan) -> None:
    wide = load("panda-cube").with_changes(objects__0__uncertainty__friction=0.4)
    learnt = friction(plan).learnt_scenario(wide).payload
    assert learnt.least_friction(learnt.first) == pytest.approx(friction(plan).low)
    with pytest.raises(SalverError, match=r"at least 0\.35"):
        friction(plan).learnt_scenario(load("panda-cube").with_changes(objects__0__friction=0.2))
    with pytest.raises(SalverError, match="at most"):
        friction(plan, held=2.0, slid=4.0).learnt_scenario(load("panda-cube"))
    moved = load("panda-cube").with_changes(objects__0__uncertainty__com=[0.01, 0.0, 0.0])
    with pytest.raises(ScenarioError, match="wider ranges"):
        friction(plan).learnt_scenario(moved)


@pytest.mark.parametrize(
    ("asked", "said"),
    [({"held": 99.0}, "not within"), ({"held": 3.0, "slid": 2.0}, "must be before"), ({"slid": -1}, "not")],
)
def test_times_that_cannot_be_are_refused(plan: Plan, asked: dict[str, float], said: str) -> None:
    with pytest.raises(ScenarioError, match=said):
        friction(plan, held=asked.get("held"), slid=asked.get("slid"))


@pytest.mark.slow
def test_command_plans_and_reads(tmp_path: Path) -> None:
    def said(*words: str) -> str:
        done = CliRunner().invoke(app, ["calibrate", "friction", *words])
        return f"{done.exit_code} {done.output}"

    run = str(tmp_path / "tilt")
    assert said("panda-cube", "--shows", "0.3", "-o", run).startswith("0 ")
    assert "Friction is at least 0.30" in said(run, "--scenario", "panda-cube")
    alone, beside = said(run), " ".join(said(run, "--against", run).split())
    assert "--against" in alone
    assert "--against" not in beside
    assert "The plan presses with up to 2.51 N: the friction holds for it." in beside
    assert said("panda-cube", "--shows", "0.3", "-o", run, "--against", run).startswith("2 ")
    assert said("panda-cube", "--slid", "3").startswith("2 ")
    assert said("panda-cube", "--shows", "0.3").startswith("2 ")
    assert said("upright-cups", "--shows", "0.3", "-o", str(tmp_path / "cups")).startswith("2 ")


def test_the_force_is_that_of_the_tilted_weight_and_plans_that_press_harder_need_another_test(plan: Plan) -> None:
    """A tray lifted by 0.06 m in 0.4 s presses its cube with m (g + 5.77 x 0.06 / 0.16)."""
    found, cube = friction(plan), plan.scenario.payload.first
    tilt = np.arctan(found.low + 2 * np.deg2rad(0.7))  # half a degree of the base, 0.2 of the tray
    assert found.force == pytest.approx(cube.inertial.mass * 9.81 * np.cos(tilt), rel=0.01)
    area = 1e4 * float(np.prod(np.ptp(cube.base_polygon_B, axis=0)[:2]))  # cm^2
    assert f"{found.force:.3g} N, a mean pressure of {10 * found.force / area:.3g} kPa" in found.pressed
    assert "the friction holds for it" in found.against(plan)

    assert plan.joint is not None
    arm = load_arm(plan.scenario.arm, plan.scenario.tray)
    t = np.linspace(0.0, 0.4, 201)
    start = plan.joint.q[0]
    lift = np.linalg.pinv(arm.body_jacobian(start))[:, 2] * 0.06  # the tray is level there: up in E is up
    shape = [smooth_step(t / 0.4, k) / 0.4**k for k in range(3)]
    q, dq, ddq = (np.outer(each, lift) for each in shape)
    hopping = replace(plan, joint=JointMotion(t, start + q, dq, ddq), reference=plan.reference)
    force = cube.inertial.mass * (9.81 + 0.06 * 5.7735 / 0.16)
    said = found.against(hopping)
    assert f"more than the {found.force:.3g} N of the test" in said
    assert float(said.split("up to ")[1].split(" N")[0]) == pytest.approx(force, rel=0.03)
    assert "kg more on the load" in said
