"""What logs with encoder noise say of what was executed: the excess of the rows is that of the true motion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from salver.geometry import Array
from salver.learning.executed import Answers, Lag, executed
from salver.learning.track import Judge, track
from salver.planning.plan import Plan
from salver.simulation.physics import Experiment
from salver.trajectory import JointMotion
from test_track import UNEQUAL, lagging, logged

SETTLED = {"physics__settle_before": 1.0}
ROBOTS: dict[str, dict[str, object]] = {
    "delay": {"physics__delay_steps": 2},
    "payload": {"physics__robot": {"payload_error": 0.3}, **SETTLED},
    "friction": {"physics__joint_friction": 0.2, **SETTLED},
    "unequal lags": {"physics__robot": {"control": "position", "bandwidth": UNEQUAL, "damping": 0.4}},
    "a lag": {"physics__robot": {"control": "position", "bandwidth": 8.0}},
}


@pytest.fixture(scope="module")
def plan(bottle_plan: Plan) -> Plan:
    return bottle_plan


@pytest.fixture(scope="module")
def done(plan: Plan) -> Callable[[str], tuple[Plan, Judge, Array, Array, float]]:
    """What the engine's arm did under a robot's control, once for all noises: the plan there, its judge, t and q at
    1 kHz, and by how much what it truly did breaks a row."""

    @cache
    def by(robot: str) -> tuple[Plan, Judge, Array, Array, float]:
        real = replace(plan, scenario=plan.scenario.with_changes(**ROBOTS[robot]))
        judge = Judge.of(real.scenario)
        t, q = Experiment(real).joint_log()
        dq = np.gradient(q, t, axis=0)
        terms = judge.terms(q, dq, np.gradient(dq, t, axis=0))
        return real, judge, t, q, max(0.0, float(judge.rows(terms.w, judge.drift(t, terms))[0][t > -0.2].max()))

    return by


@pytest.mark.slow
@pytest.mark.parametrize(
    ("robot", "noise", "seed"),
    [*((robot, 2e-5, 0) for robot in ROBOTS), ("friction", 1e-4, 1), ("unequal lags", 1e-4, 1)],
)
def test_excess_from_noisy_logs_is_that_of_what_the_engines_arm_did(done, robot: str, noise: float, seed: int) -> None:
    """Within 20 % or .005 up to 2e-5 rad of noise at 1 kHz, and at 1e-4 never less by more."""
    real, judge, t, q, true = done(robot)
    assert true > 0.001
    off = max(0.2 * true, 0.005)
    found = track(real, logged(real, t, q, noise, seed), judge).excess
    assert found >= true - off
    assert found <= true + off or noise > 2e-5


@pytest.mark.slow
def test_lags_that_no_table_has_are_found_with_their_accelerations(plan: Plan) -> None:
    """Of 7.3 to 16.8 Hz, damping .53: to .15 rad/s^2 under 20 urad of noise, which differenced twice at 1 kHz is 50."""
    t, q, _, ddq = lagging(plan, [7.3, 11.1, 16.8, 7.9, 10.4, 14.5, 9.2], 0.53)
    assert plan.joint is not None
    done = executed(plan.joint, logged(plan, t, q, noise=2e-5))
    known = np.stack([np.interp(done.t + done.shift - 0.2, t, column) for column in ddq.T], axis=1)
    moving = (done.t > 0.01) & (done.t < plan.duration)
    # At an instant where the plan's jerk jumps, interpolation between samples of the log errs by as much itself.
    assert np.sqrt(np.mean((done.ddq - known)[moving] ** 2)) < 0.15


def test_what_a_lag_changes_by_is_its_derivative(plan: Plan) -> None:
    """By the logarithm of its rate and by its damping, and their rates: central differences. At the ends the plan's
    acceleration jumps between samples, and both err."""
    assert plan.joint is not None
    t, h = np.arange(-0.2, plan.duration + 0.3, 1e-3), 1e-4
    lag = Lag(2 * np.pi * 9, 0.6, 2e-3)
    slopes = lag.answer(t, plan.joint, slice(None))[2]
    for slope, up, down in (
        (slopes[0], replace(lag, rate=lag.rate * np.exp(h)), replace(lag, rate=lag.rate * np.exp(-h))),
        (slopes[1], replace(lag, damping=lag.damping + h), replace(lag, damping=lag.damping - h)),
    ):
        ends = [each.answer(t, plan.joint, slice(None))[0].z for each in (up, down)]
        differences = (ends[0] - ends[1]) / (2 * h)
        for k in range(2):
            assert np.std(slope[k] - differences[k]) < 0.01 * np.abs(slope[k]).max()
            assert np.median(np.abs(slope[k] - differences[k])) < 1e-3 * np.abs(slope[k]).max()


def test_a_deviation_that_one_number_explains_is_fitted_by_one(plan: Plan) -> None:
    """What is shared by all joints comes out as it went in, whichever multiple of it there was."""
    assert plan.joint is not None
    t = np.arange(0.0, plan.duration, 2.5e-3)
    n = plan.joint.q.shape[1]
    shape = np.stack([np.outer(np.sin(k * 9 * t), np.arange(1, n + 1)) for k in (1, 2, 3)])
    answers = Answers.along(t, plan.joint, 3e-4 * shape[0], lambda *_: ([[shape]], []))
    assert answers[-1].fitted(np.zeros((len(t), n))) == pytest.approx(3e-4 * shape, rel=1e-9)


@pytest.mark.filterwarnings("error")
def test_a_joint_that_stands_still_and_is_read_so_leaves_the_others_as_they_are(plan: Plan) -> None:
    """A coarse encoder reads one number all along: no noise there, and no deviation."""
    assert plan.joint is not None
    t = np.arange(-0.2, plan.duration + 0.3, 1e-3)
    moved = [np.where(np.arange(7) == 2, 0.0, x) for x in (plan.joint.q, plan.joint.dq, plan.joint.ddq)]
    joint = JointMotion(plan.joint.t, *moved)
    q = joint.sample(t)[0] + 2e-5 * np.random.default_rng(0).standard_normal((len(t), 7))
    q[:, 2] = 0.0
    done = executed(joint, logged(plan, t, q))
    assert np.abs(done.q - joint.sample(done.t)[0]).max() < 1e-5
    assert done.noise[2] < 1e-12
    assert np.all(np.delete(done.noise, 2) > 1e-5)
