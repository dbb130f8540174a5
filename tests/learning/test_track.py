"""Robots that are not their model: what they did is known from logs, and what it costs."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from lagging_joint_logs import UNEQUAL, lagging, logged
from salver.cli import app
from salver.errors import FileFormatError, SalverError, ScenarioError
from salver.geometry import Array
from salver.learning.tracking.executed import executed, read_joints
from salver.learning.tracking.track import Judge, track
from salver.models.arm.arm import load_arm
from salver.planning.plan import Plan, load_plan
from salver.planning.trajopt.problem import transport_problem
from salver.scenario import load
from salver.simulation.physics import Experiment
from salver.simulation.scene.robots import robot_for


@pytest.fixture(scope="module")
def directory(bottle_plan: Plan, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return bottle_plan.save(tmp_path_factory.mktemp("run"))


@pytest.fixture(scope="module")
def plan(directory: Path) -> Plan:
    return load_plan(directory)


@pytest.fixture(scope="module")
def judge(plan: Plan) -> Judge:
    return Judge.of(plan.scenario)


def with_robot(plan: Plan, **changes: object) -> Plan:
    return replace(plan, scenario=plan.scenario.with_changes(**changes))


@pytest.mark.slow
def test_a_lag_is_found_under_noise_with_its_derivatives(plan: Plan) -> None:
    """Accelerations to 1.5 rad/s^2 where 20 urad of white noise, differenced twice at 1 kHz, are some 50."""
    t, q, dq, ddq = lagging(plan, UNEQUAL, 0.7)
    assert plan.joint is not None
    done = executed(plan.joint, logged(plan, t, q, noise=2e-5))
    assert done.shift == pytest.approx(0.2 + 2 * 0.7 / (2 * np.pi * 12), abs=1.5e-3)  # the log's clock begins at rest
    at = done.t + done.shift - 0.2
    for seen, true, off in ((done.q, q, 8e-5), (done.dq, dq, 8e-3), (done.ddq, ddq, 1.5)):
        known = np.stack([np.interp(at, t, column) for column in true.T], axis=1)
        assert np.abs(seen - known).max() < off
    assert done.noise * np.sqrt(done.each) == pytest.approx(2e-5, rel=0.1)


@pytest.mark.slow
def test_what_all_joints_are_late_together_costs_nothing(plan: Plan, judge: Judge) -> None:
    assert plan.joint is not None
    t = np.arange(-0.2, plan.duration + 0.6, 1e-3)
    found = track(plan, logged(plan, t, plan.joint.sample(t - 0.05)[0], noise=1e-6), judge)
    assert found.row == pytest.approx(found.planned, abs=2e-3)
    assert found.ok
    assert max(abs(joint.lag) for joint in found.joints) < 1e-4
    assert found.planned <= 0  # as the plan's own verdict


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.0, 2e-5])
def test_excess_is_that_of_the_true_states(plan: Plan, noise: float) -> None:
    """Within 20 % or half a per cent of the weight."""
    slow = with_robot(plan, physics__robot={"control": "position", "bandwidth": UNEQUAL})
    judge = Judge.of(slow.scenario)
    t, q, dq, ddq = lagging(slow, UNEQUAL, 0.7)
    true = judge.largest(judge.along(t, (q, dq, ddq)))[0]
    found = track(slow, logged(slow, t, q, noise), judge)
    assert true > 0.02
    assert found.excess == pytest.approx(true, abs=max(0.005, 0.2 * true))
    assert found.margin > true
    assert not found.ok


@pytest.mark.slow
def test_the_joint_that_lags_is_named(plan: Plan, judge: Judge) -> None:
    """Of seven joints one is 6 ms late: against all together it is later by most of that."""
    assert plan.joint is not None
    t = np.arange(-0.2, plan.duration + 0.6, 1e-3)
    q, late = plan.joint.sample(t)[0], plan.joint.sample(t - 0.006)[0]
    moves = int(np.argmax(np.ptp(q, axis=0)))
    q[:, moves] = late[:, moves]
    found = track(plan, logged(plan, t, q, noise=1e-6), judge)
    first = max(found.joints, key=lambda joint: abs(joint.lag))
    assert first.name == judge.arm.joint_names[moves]
    assert first.lag + found.done.shift - 0.2 == pytest.approx(0.006, abs=3e-4)


def test_position_control_is_the_lag_it_says(plan: Plan) -> None:
    """The engine's arm against SciPy: torques are held for a millisecond, and the load is the nominal one."""
    robot = {"control": "position", "bandwidth": UNEQUAL, "damping": 0.5, "delay": 0.008}
    slow = with_robot(plan, physics__robot=robot)
    done = Experiment(slow).strapped()
    t, q = done.t, done.q
    known = lagging(plan, UNEQUAL, 0.5, late=0.008)
    assert np.abs(q - np.stack([np.interp(t, known[0], column) for column in known[1].T], axis=1)).max() < 4e-4
    assert np.abs(q - lagging(plan, UNEQUAL, 0.5)[1][: len(t)]).max() > 5e-3


def test_a_wrong_payload_pushes_with_its_weight(plan: Plan) -> None:
    """At rest: half a kilogram at the load's place, by virtual work with the arm's Jacobian."""
    wrong = with_robot(plan, physics__robot={"payload_error": 0.5})
    assert plan.joint is not None
    assert plan.scenario.arm is not None
    arm, body = load_arm(plan.scenario.arm, plan.scenario.tray), plan.scenario.payload.first
    q = plan.joint.q[0]
    from salver.control.arm import ArmState

    state = ArmState(q, np.zeros(arm.n))
    right, heavy = (
        robot_for(p.scenario, plan.joint, p.reference, arm, "joint").step(state, 0.0) for p in (plan, wrong)
    )
    R_SE = arm.tray_pose(q)[1]
    jacobian = arm.body_jacobian(q)
    at_load = jacobian[:3] - np.cross(body.p_EB, jacobian[3:], axisb=0, axisc=0)
    assert heavy - right == pytest.approx(at_load.T @ (R_SE.T @ [0, 0, 0.5 * 9.81]), abs=1e-9)
    with pytest.raises(ScenarioError, match="negative"):
        robot_for(with_robot(plan, physics__robot={"payload_error": -1}).scenario, plan.joint, None, arm, "joint")


@pytest.mark.slow
def test_logs_that_are_not_of_the_plan_are_refused(plan: Plan) -> None:
    assert plan.joint is not None
    t = np.arange(-0.2, plan.duration + 0.6, 2e-3)
    q = plan.joint.sample(t - 0.01)[0]
    q[:, 2] = plan.joint.sample(t - 0.012)[0][:, 2]

    def refused(match: str, t: Array = t, q: Array = q) -> None:
        assert plan.joint is not None
        with pytest.raises(FileFormatError, match=match):
            executed(plan.joint, logged(plan, t, q))

    executed(plan.joint, logged(plan, t, q))
    refused("in degrees", q=np.rad2deg(q))
    refused("no motion", q=q[:1] + 0 * q)
    refused("as commanded", q=plan.joint.sample(t)[0])
    refused("another motion", q=q[:, ::-1])
    refused("another motion", q=plan.joint.sample(0.5 * t)[0], t=t)
    refused("slower than planned", q=plan.joint.sample(0.95 * t)[0])
    refused("ends .* s before", t=t[t < 0.6], q=q[t < 0.6])
    refused("begins .* s after", t=t[t > 0.2], q=q[t > 0.2])
    refused("samples a second", t=t[::10], q=q[::10])
    gap = (t < 0.3) | (t > 0.35)
    refused("no samples for", t=t[gap], q=q[gap])
    moving = t < plan.duration + 0.01
    refused(
        "still moves",
        t=t[moving],
        q=plan.joint.sample(t[moving] * 1.0 - 0.02)[0] + 0.3 * np.maximum(t[moving, None] - plan.duration + 0.04, 0),
    )


@pytest.mark.slow
def test_commands_tell_and_keep_to_their_codes(plan: Plan, directory: Path, tmp_path: Path) -> None:
    run = CliRunner()
    t, q, _, _ = lagging(plan, UNEQUAL, 0.7)
    np.savez(tmp_path / "log.npz", t=t, q=q)
    done = run.invoke(app, ["track", str(directory), str(tmp_path / "log.npz"), "--json"])
    assert done.exit_code == 3
    found = json.loads(done.stdout)
    assert not found["ok"]
    assert found["excess"] > 0.02
    assert found["margin_that_pays"] > found["excess"]
    shown = run.invoke(app, ["track", str(directory), str(tmp_path / "log.npz")])
    assert shown.stdout.startswith("not checked")


def test_of_a_table_with_the_tray_and_the_joints_the_joints_are_read(plan: Plan, tmp_path: Path) -> None:
    """As salver simulate --write writes what a run did."""
    assert plan.joint is not None
    arm = Judge.of(plan.scenario).arm
    t = np.arange(0.0, 0.5, 1e-2)
    q = plan.joint.sample(t)[0]
    header = ["t", "x", "y", "z", "qw", "qx", "qy", "qz", *(f"q_{name}" for name in arm.joint_names)]
    both = np.column_stack([t, np.zeros((len(t), 3)), np.ones(len(t)), np.zeros((len(t), 3)), q])
    np.savetxt(tmp_path / "did.csv", both, delimiter=",", header=",".join(header), comments="", fmt="%.17g")
    assert np.array_equal(read_joints(tmp_path / "did.csv", arm).q, q)


def test_a_joint_that_its_friction_holds_back_is_not_controlled(plan: Plan) -> None:
    """Friction of 0.4 N m is no log of this plan any more."""
    done = Experiment(stiff := with_robot(plan, physics__joint_friction=0.4)).strapped()
    with pytest.raises(FileFormatError, match="not controlled"):
        track(stiff, logged(stiff, done.t, done.q))


def test_a_motion_is_judged_at_every_speed_that_its_scenario_asks_for() -> None:
    judge = Judge.of(load("panda-tall-bottle").with_changes(contact__condition="exact", motion__speeds="any"))
    assert len(judge.problem.speeds) > 1
    assert {constraint.speed for constraint in judge.constraints} == set(judge.problem.speeds)


def test_what_cannot_be_tracked_is_said(plan: Plan, tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match="has no arm"):
        Judge.of(load("tall-box-56"))
    with pytest.raises(ScenarioError, match="liquid"):
        Judge.of(load("panda-coffee"))
    with pytest.raises(ScenarioError, match="has 3 values"):
        Experiment(with_robot(plan, physics__joint_friction=[1.0, 1.0, 1.0])).strapped()
    with pytest.raises(ScenarioError, match="unstable"):
        plan.scenario.with_changes(physics__robot={"control": "position", "bandwidth": 400})
    tray = tmp_path / "tray.csv"
    tray.write_text("t,x,y,z,qw,qx,qy,qz\n" + "".join(f"{k / 100},0,0,{k / 1000},1,0,0,0\n" for k in range(30)))
    with pytest.raises(SalverError, match="motion of the tray"):
        read_joints(tray, Judge.of(plan.scenario).arm)


def test_plans_and_logs_are_judged_with_the_robot_of_the_scenario(plan: Plan) -> None:
    """Under position control the slowest joint, of 9.6 Hz, says how far the arm deviates under the load's errors."""
    slow = with_robot(plan, physics__robot={"control": "position", "bandwidth": UNEQUAL, "damping": 0.5})
    rate = 2 * np.pi * 9.6
    for loop in (transport_problem(slow.scenario).tracking, Judge.of(slow.scenario).problem.tracking):
        assert loop is not None
        assert (loop.kp, loop.kd) == pytest.approx((rate**2, rate))
