"""Arms that are unlike most: joints that slide or turn for ever, and fewer of them than a tray can move."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from odd_arms import CELL, LINK, cell, gantry, joint, loaded
from salver import scenario
from salver.control.arm import ArmState
from salver.driver.execution import Watchdog
from salver.errors import ScenarioError, UnreachableError
from salver.learning.tracking.track import track
from salver.models.arm.arm import load_arm
from salver.motion_files.samples import joint_samples
from salver.planning.fastest import plan_fastest
from salver.planning.follow.limits import peaks, verdict
from salver.planning.follow.motion import follow_scenario
from salver.planning.make import make_plan, plan_baseline
from salver.planning.postures import PoseTarget, start_posture
from salver.simulation.physics import simulate
from salver.trajectory import JointMotion


@pytest.mark.slow
def test_what_is_out_of_reach_is_told_with_how_far_and_with_the_heading_that_would_do(tmp_path):
    """By hand: the slide along y ends at 0.8 m, so a tray that stays level misses y = 1.8 by 1 m, and one that leans on
    its 0.3 m of wrist by no less than 0.7. A wrist that turns 0.5 rad either way reaches no heading of 60 degrees."""
    stiff = gantry(turn="revolute").replace('lower="-2.0" upper="2.0"', 'lower="-0.5" upper="0.5"', 1)
    case = cell(tmp_path, stiff)
    assert plan_fastest(case).ok
    far = case.with_changes(motion__start__position=[-0.2, 1.8, 0.9])
    with pytest.raises(UnreachableError, match="reaches the start: the nearest found misses it by") as told:
        plan_fastest(far)
    missed = re.search(r"by ([\d.]+) mm", str(told.value))
    assert missed is not None
    assert 700 < float(missed[1]) < 1020
    assert "Turned" not in str(told.value)
    with pytest.raises(UnreachableError, match="reaches the goal") as told:
        plan_fastest(case.with_changes(motion__goal__rpy_deg=[0, 0, 60]))
    turn = re.search(r"Turned by (-\d+) deg about its vertical it is reached", str(told.value))
    assert turn is not None
    assert abs(60 + int(turn[1])) < np.rad2deg(0.5)
    assert plan_fastest(case.with_changes(motion__goal__rpy_deg=[0, 0, 60 + int(turn[1])])).ok


@pytest.mark.slow
def test_a_gantry_is_planned_checked_and_run(tmp_path: Path) -> None:
    case = cell(tmp_path, gantry(), limits={"acceleration": 10.0, "jerk": 500.0})
    for method in ("robust", "fastest"):
        plan = make_plan(case, method)
        assert plan.ok, (plan.status, plan.arm_status)
        assert plan.arm_status is not None
        assert plan.arm_status.details["velocity"]["unit"] in ("m/s", "rad/s")
        assert simulate(plan).summary["outcome"] == "holds"


def test_units_of_a_joint_that_slides(tmp_path: Path) -> None:
    """A slide of 0.3 m in 1 s by min-jerk: 15/8 0.3 = 0.5625 m/s; gravity on z alone: all that hangs on it, 2.5 kg."""
    arm = loaded(tmp_path, gantry())
    assert arm.linear == (True, True, True, False, False, False)
    ends = np.zeros((2, 6))
    ends[1, 1] = 0.3
    motion = JointMotion(np.array([0.0, 1.0]), ends, np.zeros((2, 6)), np.zeros((2, 6)))
    fine = JointMotion(np.linspace(0, 1, 201), *motion.sample(np.linspace(0, 1, 201)))
    found = {peak.kind: peak for peak in peaks(arm, fine)}
    assert (found["velocity"].unit, found["acceleration"].unit) == ("m/s", "m/s^2")
    assert found["velocity"].value == pytest.approx(15 / 8 * 0.3)
    hanging = 1 + 3 * 0.5 + scenario.Tray().mass
    assert arm.gravity(np.zeros(6))[2] == pytest.approx(9.81 * hanging)
    down = loaded(tmp_path, gantry(), limits={"torque": [200, 200, 10, 200, 200, 200]})
    told = verdict(down, fine).sentence
    assert f"the torque of z reaches {9.81 * hanging:.4g} N at" in told


def test_a_continuous_joint_keeps_within_a_turn(tmp_path: Path) -> None:
    arm = loaded(tmp_path, gantry())
    assert (arm.limits.q_min[3], arm.limits.q_max[3]) == pytest.approx((-2 * np.pi, 2 * np.pi))


def test_a_joint_that_slides_is_told_in_metres(tmp_path: Path) -> None:
    """In the sentence on a start posture, by the watchdog, and where a log is compared with a plan; others in rad."""
    case, arm = cell(tmp_path, gantry()), loaded(tmp_path, gantry())
    middle = np.array([0.0, 0.0, 0.1, 0.0, 0.0, 0.0])
    for k, unit in ((0, "m"), (4, "rad")):
        beyond = middle.copy()
        beyond[k] = arm.limits.q_max[k] + 0.5
        with pytest.raises(ScenarioError, match=rf"= \S+ {unit} is beyond the limits .*\] {unit}\."):
            start_posture(arm, beyond, PoseTarget(*arm.tray_pose(middle)))
        said = Watchdog(0.1).astray(arm, ArmState(beyond, 0 * beyond), middle, 0.1)
        assert said.endswith(f" {unit} off its reference at t = 0.100 s; 0.1 {unit} are allowed.")
    plan = make_plan(case, "baseline")
    assert plan.joint is not None
    t = np.arange(-0.3, plan.duration + 0.5, 2e-3)
    q = plan.joint.sample(t)[0]
    q[:, 0] += 0.02 * np.exp(-((t / plan.duration - 0.5) ** 2) / 0.02)
    found = track(plan, joint_samples(t, arm.joint_names, q, None, None, "the log"))
    assert [joint.unit for joint in found.joints if joint.name in ("x", "y", "z")] == ["m", "m", "m"]
    assert [joint.unit for joint in found.joints if joint.name in ("turn", "lean", "tip")] == ["rad"] * 3
    assert re.match(r"x .*\(1\d\.\d\d mm off at most\)", found.cause)


def four_joints() -> str:
    """A SCARA: two turns about z, a slide along z, a turn about z."""
    links = [
        LINK.format(name="base", mass=10, com="0 0 0.15", size="0.15 0.15 0.3"),
        LINK.format(name="upper", mass=4, com="0.2 0 0.03", size="0.42 0.08 0.06"),
        LINK.format(name="fore", mass=3, com="0.15 0 0.03", size="0.32 0.07 0.06"),
        LINK.format(name="quill", mass=1, com="0 0 0.1", size="0.03 0.03 0.2"),
        LINK.format(name="plate", mass=0.3, com="0 0 0.01", size="0.05 0.05 0.02"),
    ]
    joints = [
        joint("shoulder", "revolute", "base", "upper", "0 0 0.32", "0 0 1", low=-2.5, high=2.5, speed=6),
        joint("elbow", "revolute", "upper", "fore", "0.4 0 0.07", "0 0 1", low=-2.4, high=2.4, speed=8),
        joint("slide", "prismatic", "fore", "quill", "0.3 0 0.07", "0 0 1", low=0, high=0.2, speed=1),
        joint("turn", "continuous", "quill", "plate", "0 0 0.2", "0 0 1", speed=15),
    ]
    return f'<robot name="scara">{"".join(links)}{"".join(joints)}</robot>'


def scara(tmp_path: Path, **motion: object) -> scenario.Scenario:
    path = tmp_path / "scara.urdf"
    path.write_text(four_joints())
    ends = {"start": {"position": [0.5, -0.3, 0.8]}, "goal": {"position": [0.5, 0.3, 0.85]}, **motion}
    arm = {"model": str(path), "flange": "plate", "limits": {"acceleration": [30.0, 30.0, 10.0, 60.0]}}
    tray = {"height": 0.04, "size": [0.12, 0.12]}
    return scenario.parse({**CELL, "name": "scara", "motion": ends, "arm": arm, "tray": tray}, "the test")


def test_four_joints_follow_what_needs_no_more(tmp_path: Path) -> None:
    """A level line, where the tray is by Pinocchio's forward kinematics and its derivatives; not one that tilts."""
    case = scara(tmp_path, duration=1.5)
    line = plan_baseline(case).reference
    made, status = follow_scenario(case, line)
    assert status.ok, status.sentence
    assert made is not None
    assert case.arm is not None
    arm, body = load_arm(case.arm, case.tray), case.payload.first
    wanted = line.sample(made.t)
    for k in range(0, len(made.t), 20):
        p, rotation = arm.object_pose(made.q[k], body.p_EB, body.R_EB)
        assert p == pytest.approx(wanted.p_SB[k], abs=1e-10)
        assert rotation == pytest.approx(wanted.R_SB[k], abs=1e-10)
    step = made.t[1] - made.t[0]
    assert made.dq == pytest.approx(np.gradient(made.q, step, axis=0, edge_order=2), abs=2e-3)
    assert made.ddq == pytest.approx(np.gradient(made.dq, step, axis=0, edge_order=2), abs=2e-2)
    tilted = scara(tmp_path, duration=1.5, goal={"position": [0.5, 0.3, 0.85], "rpy_deg": [0.0, 5.0, 0.0]})
    none, said = follow_scenario(tilted, plan_baseline(tilted).reference)
    assert none is None
    assert "4 joints do not turn and tilt a tray every way" in said.sentence


@pytest.mark.slow
def test_four_joints_carry_as_fast_as_they_go(tmp_path: Path) -> None:
    """Safe by the plan's own verdict, and in the engine."""
    plan = plan_fastest(scara(tmp_path, goal_yaw="free"))
    assert plan.ok, plan.status.sentence
    assert simulate(plan).outcome == "holds"


@pytest.mark.slow
def test_an_arm_of_one_joint_is_told_that_it_does_not_reach(tmp_path: Path) -> None:
    """Its Jacobian has one column."""
    file = tmp_path / "one.urdf"
    links = LINK.format(name="base", mass=1, com="0 0 0", size="0.05 0.05 0.05") + LINK.format(
        name="tool", mass=1, com="0 0 0.05", size="0.05 0.05 0.05"
    )
    turn = joint("turn", "revolute", "base", "tool", "0 0 0.1", "0 0 1")
    file.write_text(f'<robot name="one">{links}{turn}</robot>')
    case = scenario.parse({**CELL, "arm": {"model": str(file), "flange": "tool", "collisions": "unchecked"}}, "one")
    with pytest.raises(UnreachableError, match="No posture within the joint limits reaches"):
        plan_fastest(case)
