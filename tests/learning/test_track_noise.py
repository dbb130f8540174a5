"""What logs with encoder noise say of what was executed: the excess of the rows is that of the true motion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from lagging_joint_logs import UNEQUAL, lagging, logged
from salver.geometry import Array
from salver.learning.tracking.deviations import DeviationFit, of_lags, under_torque
from salver.learning.tracking.executed import executed
from salver.learning.tracking.track import Judge, track
from salver.planning.plan import Plan
from salver.simulation.physics import Experiment
from salver.trajectory import JointMotion

SETTLED = {"physics__settle_before": 1.0}
ROBOTS: dict[str, dict[str, object]] = {
    "delay": {"physics__delay_steps": 2},
    "payload": {"physics__robot": {"payload_error": 0.3}, **SETTLED},
    "friction": {"physics__joint_friction": 0.2, **SETTLED},
    "unequal lags": {"physics__robot": {"control": "position", "bandwidth": UNEQUAL, "damping": 0.4}},
    "a lag": {"physics__robot": {"control": "position", "bandwidth": 6.0}},
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
        done = Experiment(real).strapped()
        t, q = done.t, done.q
        dq = np.gradient(q, t, axis=0)
        states, moving = (q, dq, np.gradient(dq, t, axis=0)), t > -0.2
        return real, judge, t, q, max(0.0, judge.largest(judge.along(t[moving], [x[moving] for x in states]))[0])

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


@pytest.mark.slow
def test_a_lag_with_friction_is_found_as_it_is(plan: Plan) -> None:
    """Of which SciPy made the deviation: without noise its position and acceleration come out; a deviation that is
    larger by what one of its numbers changes it is fitted as such."""
    t, q, _, ddq = lagging(plan, [7.3, 11.1, 16.8, 7.9, 10.4, 14.5, 9.2], 0.53)
    assert plan.joint is not None
    t, q, ddq = t[::4], q[::4], ddq[::4]
    here = plan.joint.sample(t)
    fit = of_lags(t, plan.joint, q - here[0])[1]
    assert fit.base[0] == pytest.approx(q - here[0], abs=2e-5)  # jumps of the plan's jerk lie between samples
    moving = (t > 0.01) & (t < plan.duration)
    assert np.sqrt(np.mean((fit.base[2] - (ddq - here[2]))[moving] ** 2)) < 0.1
    more = 1e-3 * fit.tangent[..., 1].swapaxes(1, 2)
    assert fit.to(fit.base[0] + more[0]) == pytest.approx(fit.base + more, abs=1e-9)


def test_of_a_wrong_payload_one_number_is_found_for_all_joints(plan: Plan, done) -> None:
    """Without noise the first reason explains what the engine's arm did, to a tenth; the others nearly nothing."""
    real, judge, t, q, _ = done("payload")
    t, q = t[t > -0.2][::5], q[t > -0.2][::5]
    off = q - real.joint.sample(t)[0]
    payload, delay, *_ = under_torque(real.scenario, judge.problem.model, judge.arm.tray_id)(t, real.joint, off)
    assert np.abs(payload.base[0] - off).max() < 0.1 * np.abs(off).max()
    assert np.abs(delay.base[0] - off).max() > 0.5 * np.abs(off).max()


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


def test_to_another_deviation_a_fit_moves_along_its_tangents() -> None:
    rng = np.random.default_rng(3)
    base, tangent, by = rng.normal(size=(3, 50, 2)), rng.normal(size=(3, 2, 50, 3)), rng.normal(size=(2, 3))
    moved = base + np.einsum("djkm,jm->dkj", tangent, by)
    assert DeviationFit(base, tangent).to(moved[0]) == pytest.approx(moved, abs=1e-9)
