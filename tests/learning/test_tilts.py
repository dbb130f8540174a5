"""Short tilts: how far a load slides on them, against mechanics by hand and the engine; what friction that proves."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from typer.testing import CliRunner

from salver.cli import app
from salver.errors import ScenarioError
from salver.geometry import Array, log
from salver.learning.friction.friction import GRAVITY, USUAL, FrictionOptions, friction, proves, ways
from salver.learning.friction.tilts import _motion, room, short_tilt, tilt_test
from salver.models.arm.arm import load_arm
from salver.models.tray_motion import N_MOTION
from salver.motion_files.samples import joint_samples
from salver.planning.plan import Plan
from salver.scenario import Scenario, load
from salver.simulation.physics import Experiment
from salver.trajectory import MotionSamples

WIDE = {"objects__0__friction": 0.4, "objects__0__uncertainty__friction": 0.2}
POINT = {"objects__0__uncertainty__com": None, "objects__0__uncertainty__position": None}


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return load("panda-cube").with_changes(**WIDE)


@pytest.fixture(scope="module")
def plan(scenario: Scenario) -> Plan:
    return short_tilt(scenario)


def felt(angle: Array) -> Array:
    """w (T, 12) of a tray that tilts so slowly that only gravity is felt."""
    w = np.zeros((len(angle), N_MOTION))
    w[:, 0], w[:, 2] = GRAVITY * np.sin(angle), GRAVITY * np.cos(angle)
    return w


def slid(friction: float, steepest: float, bend: float, off: float = 0.0) -> float:
    """m by which a block slides on a tray whose angle is steepest - bend t^2 / 2, from Newton's law."""
    start = -np.sqrt(2 * (steepest - np.arctan(friction)) / bend) if np.tan(steepest) > friction else 0.0

    def motion(t: float, state: Array) -> list[float]:
        angle = steepest - 0.5 * bend * t**2
        return [state[1], GRAVITY * (np.sin(angle) - friction * np.cos(angle)) + off]

    stops = lambda t, state: state[1] if t > start + 1e-6 else 1.0  # noqa: E731
    stops.terminal, stops.direction = True, -1  # type: ignore[attr-defined]
    run = solve_ivp(motion, (start, 2.0), [0.0, 1e-12], events=stops, rtol=1e-10, atol=1e-13)  # type: ignore[call-overload]
    return float(run.y[0, -1])


def test_a_block_slides_as_far_as_newton_says(scenario: Scenario) -> None:
    """And as the formula by hand: 4.5 g e^2 / a cos^3, where friction is less by e than the steepest tangent."""
    t, steepest, bend = np.linspace(-0.4, 0.4, 4001), np.arctan(0.23), 4.0
    slides = ways(t, felt(steepest - 0.5 * bend * t**2), scenario.with_changes(**POINT), 0.0)
    for coefficient in (0.18, 0.2, 0.22):
        least, most = slides(coefficient)
        assert least == pytest.approx(most, rel=1e-9)
        assert least == pytest.approx(slid(coefficient, steepest, bend), rel=1e-3)
    assert slides(0.229)[0] == pytest.approx(4.5 * GRAVITY * 0.001**2 / bend * np.cos(steepest) ** 3, rel=0.01)
    assert slides(0.23) == (0.0, 0.0)


@pytest.mark.parametrize("moved", [0.0, 0.004])
def test_with_the_friction_that_is_proven_a_block_slides_just_farther_than_could_be_seen(
    scenario: Scenario, moved: float
) -> None:
    """A millimetre that nobody notices, beyond what was seen."""
    t, steepest, bend = np.linspace(-0.4, 0.4, 4001), np.arctan(0.25), 4.0
    low = proves(t, felt(steepest - 0.5 * bend * t**2), scenario.with_changes(**POINT), 0.0, moved + USUAL.unnoticed)
    assert slid(low, steepest, bend) == pytest.approx(moved + 1e-3, rel=5e-3)


@pytest.mark.parametrize("heading", [0.7, -2.0])
def test_from_a_start_that_is_turned_rates_are_those_of_the_turn(scenario: Scenario, heading: float) -> None:
    """Against differences of R_SB; the tray falls towards the heading, and its frame stays where it is."""
    turned = scenario.with_changes(motion__start__rpy_deg=[10.0, -5.0, 110.0])
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


def test_way_lies_within_what_is_told_wherever_the_load_is_and_the_base_leans(scenario: Scenario) -> None:
    rng, t, steepest, bend, lean = np.random.default_rng(0), np.linspace(-0.4, 0.4, 1001), np.arctan(0.25), 5.0, 0.01
    least, most = ways(t, felt(steepest - 0.5 * bend * t**2), scenario, lean)(0.2)
    assert 0 < least < most
    for _ in range(20):
        leans = lean * rng.uniform(-1, 1)
        assert least <= slid(0.2, steepest + leans, bend) <= most


@pytest.mark.slow
def test_short_tilt_is_as_steep_as_the_least_friction_allows(scenario: Scenario, plan: Plan) -> None:
    assert plan.ok
    w_steeper = short_tilt(scenario, options=FrictionOptions(farthest=2 * USUAL.farthest))
    tilts = [np.arccos(p.reference.sample(p.t).R_SB[:, 2, 2].min()) for p in (plan, w_steeper)]
    assert np.arctan(0.2) < tilts[0] < tilts[1]
    proven, from_more = friction(plan).low, friction(plan, moved=0.004).low
    assert proven is not None
    assert from_more is not None
    assert from_more < proven < np.tan(tilts[0])


def test_the_base_stays_on_the_tray(scenario: Scenario) -> None:
    """A cube of 4 cm in the middle of a tray of 20 cm has 80 mm; on one of 52 mm it has 6, of 41 mm too little."""
    assert room(scenario) == pytest.approx(0.08)
    near = scenario.with_changes(tray__size=[0.2, 0.052])
    assert room(near) == pytest.approx(0.006)
    assert "moves by 6 mm at most" in short_tilt(near).status.sentence
    with pytest.raises(ScenarioError, match=r"0\.5 mm from the edge"):
        short_tilt(scenario.with_changes(tray__size=[0.041, 0.2]))


@pytest.mark.slow
def test_in_the_engine_no_load_moves_farther_than_is_said_and_what_is_proven_is_so(
    scenario: Scenario, plan: Plan
) -> None:
    assert plan.scenario.arm is not None
    names, experiment = tuple(load_arm(plan.scenario.arm, plan.scenario.tray).joint_names), Experiment(plan)
    rng, moved = np.random.default_rng(2), []
    for true in (0.2, 0.2, 0.207, 0.215, 0.4):
        record = experiment.run({"friction": true, "mass": 0.256 * rng.choice([0.9, 1.1])})
        assert record.outcome in ("holds", "slides")
        moved.append(float(record.slip.max()))
        log = joint_samples(record.t, names, record.q, None, None, "log")
        low = friction(plan, log, moved=moved[-1]).low
        assert low is not None
        assert 0.85 * min(true, 0.22) < low <= true
    assert max(moved) <= USUAL.farthest
    assert moved[0] > USUAL.unnoticed
    assert moved[-1] < 1e-4


@pytest.mark.slow
def test_what_tells_nothing_is_refused(scenario: Scenario, plan: Plan) -> None:
    slow = tilt_test(load("panda-cube"), 0.3)
    with pytest.raises(ScenarioError, match="on a short tilt only"):
        friction(slow, moved=0.001)
    for moved in (-0.001, float("nan"), 12.0):
        with pytest.raises(ScenarioError, match="from 0 to 1 m"):
            friction(plan, moved=moved)
    with pytest.raises(ScenarioError, match="by how much it moved"):
        friction(plan, held=0.3)
    for farthest in (0.0, 5.0, float("nan")):
        with pytest.raises(ScenarioError, match=r"by 0\.001 m to 0\.1 m"):
            short_tilt(scenario, options=FrictionOptions(farthest=farthest))


@pytest.mark.slow
def test_command_plans_and_reads(tmp_path: Path) -> None:
    def said(*words: str) -> str:
        done = CliRunner().invoke(app, ["calibrate", "friction", *words])
        return f"{done.exit_code} {done.output}"

    run = str(tmp_path / "tilt")
    assert said("panda-cube", "--short", "--shows", "0.3", "-o", run).startswith("2 ")
    assert said("panda-cube", "--short", "-o", run).startswith("0 ")
    far, near = said(run, "--moved", "0.005"), said(run)
    assert "Friction is at least 0." in far
    assert far.split("least ")[1][:5] < near.split("least ")[1][:5]
