"""Vibration of the tray from a log: simulated logs with a shake of known size in a direction askew to all axes, on the
tall bottle's fastest motion, whose tray turns and leans."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from lagging_joint_logs import logged
from salver.cli import app
from salver.cli.learning.track import shake_table
from salver.geometry import Array
from salver.learning.tracking.executed import executed
from salver.learning.tracking.track import Judge, track
from salver.learning.tracking.vibration import vibration_of
from salver.models.uncertain.parameters import Vibration
from salver.planning.plan import Plan, load_plan
from salver.planning.trajopt.problem import transport_problem

ASKEW = np.array([0.36, 0.48, 0.8])
Log = tuple[Array, Array]


@pytest.fixture(scope="module")
def judge(bottle_plan: Plan) -> Judge:
    return Judge.of(bottle_plan.scenario)


@pytest.fixture(scope="module")
def shaken(bottle_plan: Plan, judge: Judge) -> Callable[..., Log]:
    """A log of the plan, 10 ms late, whose tray is displaced by shift (6,), m and rad in S, at each of some
    frequencies."""
    plan = bottle_plan
    assert plan.joint is not None
    t = np.arange(-0.2, plan.duration + 0.6, 1e-3)
    calm = plan.joint.sample(t - 0.01)[0]
    terms = judge.along(t, plan.joint.sample(t - 0.01)).terms
    to_S = np.kron(np.eye(2), np.ones((3, 3))) * np.tile(terms.R_SE, (1, 2, 2))
    by_tray = np.linalg.pinv(to_S @ terms.jacobian)

    def log(shift: Array, *hertz: float) -> Log:
        wave = sum((np.sin(2 * np.pi * f * t + 0.3) for f in hertz), np.zeros(len(t)))
        return t, calm + np.einsum("tij,j,t->ti", by_tray, shift, wave)

    return log


def read(plan: Plan, judge: Judge, log: Log, noise: float = 2e-6) -> Vibration | None:
    assert plan.joint is not None
    done = executed(plan.joint, logged(plan, *log, noise))
    return vibration_of(done, judge.along(done.t, done.states).terms)


@pytest.mark.parametrize(
    ("hertz", "sign"),
    [(12.0, 1), *(pytest.param(*case, marks=pytest.mark.slow) for case in ((12.0, -1), (18.0, 1), (18.0, -1)))],
)
def test_a_shake_has_its_amplitude_and_frequency(bottle_plan, judge, shaken, hertz: float, sign: int) -> None:
    found = read(bottle_plan, judge, shaken(sign * 3e-5 * np.r_[ASKEW, 0, 0, 0], hertz))
    assert found is not None
    assert found.amplitude == pytest.approx(3e-5, rel=0.03)
    assert found.frequency == pytest.approx(hertz, abs=1.0)
    assert found.tilt == 0.0


@pytest.mark.slow
def test_two_shakes_at_once_have_the_sum_of_their_accelerations(bottle_plan, judge, shaken) -> None:
    found = read(bottle_plan, judge, shaken(3e-5 * np.r_[ASKEW, 0, 0, 0], 12.0, 18.0))
    assert found is not None
    assert found.frequency == pytest.approx(18.0, abs=1.0)
    assert found.acceleration == pytest.approx(3e-5 * (2 * np.pi) ** 2 * (12.0**2 + 18.0**2), rel=0.1)


def test_a_tray_that_turns_to_and_fro_has_a_tilt(bottle_plan, judge, shaken) -> None:
    found = read(bottle_plan, judge, shaken(np.deg2rad(0.02) * np.r_[0, 0, 0, ASKEW], 12.0))
    assert found is not None
    assert np.rad2deg(found.tilt) == pytest.approx(0.02, rel=0.03)
    assert found.amplitude < 2e-6


@pytest.mark.parametrize("noise", [2e-5, pytest.param(1e-4, marks=pytest.mark.slow)])
def test_noise_of_encoders_is_no_shake(bottle_plan, judge, shaken, noise: float) -> None:
    assert read(bottle_plan, judge, shaken(np.zeros(6)), noise) is None


@pytest.mark.slow
def test_steps_of_encoders_are_no_shake(bottle_plan, judge, shaken) -> None:
    t, q = shaken(np.zeros(6))
    step = 2 * np.pi / 2**16
    assert read(bottle_plan, judge, (t, step * np.round(q / step)), noise=0.0) is None


@pytest.mark.slow
def test_a_plan_with_the_shake_that_was_measured_counts_it_once(bottle_plan, judge, shaken, tmp_path) -> None:
    t, q = shaken(3e-5 * np.r_[ASKEW, 0, 0, 0], 12.0)
    first = track(bottle_plan, logged(bottle_plan, t, q, 2e-6), judge)
    assert first.shake is not None
    assert first.row > 0.005 > first.margin - bottle_plan.scenario.contact.margin  # the margin is for the rest
    table = shake_table(first.shake)
    assert table == {"amplitude": pytest.approx(3.3e-5, abs=1.1e-6), "frequency": pytest.approx(12.0)}
    counted = replace(bottle_plan, scenario=bottle_plan.scenario.with_changes(uncertainty__shake=table))
    again = track(counted, logged(counted, t, q, 2e-6))
    assert again.planned == pytest.approx(first.planned + first.shake.acceleration / 9.81, abs=0.005)
    assert again.row == pytest.approx(again.planned, abs=0.003)

    np.savez(tmp_path / "log.npz", t=t, q=q + 2e-6 * np.random.default_rng(0).standard_normal(q.shape))
    command = ["track", str(bottle_plan.save(tmp_path / "run")), str(tmp_path / "log.npz")]
    told = json.loads(CliRunner().invoke(app, [*command, "--json"]).stdout)
    assert told["shake"] == table
    words = f"[uncertainty] shake = {{ amplitude = {table['amplitude']:g}, frequency = 12 }}"
    assert words in " ".join(CliRunner().invoke(app, command).stdout.split())


def test_a_log_has_the_delay_of_held_commands_in_it_which_is_not_added_to_it(bottle_plan, judge) -> None:
    assert judge.problem.tracking.delay == 0.0 < transport_problem(bottle_plan.scenario).tracking.delay


@pytest.mark.slow
def test_a_plan_that_is_ok_is_ok_of_a_perfect_log(bottle_plan, judge, shaken, tmp_path) -> None:
    """Its margin is the plan's own, and no vibration is read of it."""
    plan = load_plan(bottle_plan.save(tmp_path / "run"))
    found = track(plan, logged(plan, *shaken(np.zeros(6)), 1e-6))
    assert found.planned <= 0
    assert found.row == pytest.approx(found.planned, abs=2e-4)
    assert found.ok
    assert found.shake is None
