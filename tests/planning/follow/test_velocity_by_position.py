"""Velocity limits that fall towards the ends of a joint's range, as the Franka Research 3 has them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

import salver as sv
from odd_arms import cell, gantry, loaded
from salver import scenario
from salver.driver.preflight import check_plan
from salver.driver.robots.franka import check_franka
from salver.errors import ScenarioError
from salver.geometry import Array
from salver.models.arm.arm import load_arm
from salver.planning.fastest import EFFORTS, transport_problem
from salver.planning.follow.limits import verdict
from salver.planning.make import make_plan
from salver.planning.plan import Plan
from salver.planning.stops import plan_stops, stop_problem
from salver.planning.trajopt.constraints.constraints import JointLimit
from salver.planning.verdict.judged import PLANNED, Judged
from salver.planning.verdict.verify import verify
from salver.scenario import Scenario, load
from salver.trajectory import JointMotion


def cube(**changes: object) -> Scenario:
    """The Panda's cube on an FR3: at its start posture joint 6 is 0.3 rad from the end of its range, and the fastest
    motion without these limits turned it at 186 % of them."""
    return load("panda-cube").with_changes(arm__model="fr3", **changes)


def upwards(q: Array) -> Array:
    """libfranka, include/franka/rate_limiting.h, computeUpperLimitsJointVelocity, without its tolerance."""
    q1, q2, q3, q4, q5, q6, q7 = np.moveaxis(q, -1, 0)
    return np.stack(
        [
            np.minimum(2.62, np.maximum(0.0, -0.30 + np.sqrt(np.maximum(0.0, 12.0 * (2.75010 - q1))))),
            np.minimum(2.62, np.maximum(0.0, -0.20 + np.sqrt(np.maximum(0.0, 5.17 * (1.79180 - q2))))),
            np.minimum(2.62, np.maximum(0.0, -0.20 + np.sqrt(np.maximum(0.0, 7.00 * (2.90650 - q3))))),
            np.minimum(2.62, np.maximum(0.0, -0.30 + np.sqrt(np.maximum(0.0, 8.00 * (-0.1458 - q4))))),
            np.minimum(5.26, np.maximum(0.0, -0.35 + np.sqrt(np.maximum(0.0, 34.0 * (2.81010 - q5))))),
            np.minimum(4.18, np.maximum(0.0, -0.35 + np.sqrt(np.maximum(0.0, 11.0 * (4.52050 - q6))))),
            np.minimum(5.26, np.maximum(0.0, -0.35 + np.sqrt(np.maximum(0.0, 34.0 * (3.01960 - q7))))),
        ],
        axis=-1,
    )


def downwards(q: Array) -> Array:
    """The same header, computeLowerLimitsJointVelocity."""
    q1, q2, q3, q4, q5, q6, q7 = np.moveaxis(q, -1, 0)
    return np.stack(
        [
            np.maximum(-2.62, np.minimum(0.0, 0.30 - np.sqrt(np.maximum(0.0, 12.0 * (2.750100 + q1))))),
            np.maximum(-2.62, np.minimum(0.0, 0.20 - np.sqrt(np.maximum(0.0, 5.17 * (1.791800 + q2))))),
            np.maximum(-2.62, np.minimum(0.0, 0.20 - np.sqrt(np.maximum(0.0, 7.00 * (2.906500 + q3))))),
            np.maximum(-2.62, np.minimum(0.0, 0.30 - np.sqrt(np.maximum(0.0, 8.00 * (3.048100 + q4))))),
            np.maximum(-5.26, np.minimum(0.0, 0.35 - np.sqrt(np.maximum(0.0, 34.0 * (2.810100 + q5))))),
            np.maximum(-4.18, np.minimum(0.0, 0.35 - np.sqrt(np.maximum(0.0, 11.0 * (-0.54092 + q6))))),
            np.maximum(-5.26, np.minimum(0.0, 0.35 - np.sqrt(np.maximum(0.0, 34.0 * (3.019600 + q7))))),
        ],
        axis=-1,
    )


def largest_share(motion: JointMotion) -> float:
    """Of libfranka's limits, at every 0.1 ms."""
    q, dq, _ = motion.sample(np.arange(0.0, motion.duration, 1e-4))
    return float(np.max(np.where(dq > 0, dq / np.maximum(upwards(q), 1e-9), dq / np.minimum(downwards(q), -1e-9))))


@pytest.fixture(scope="module")
def fastest() -> Plan:
    return make_plan(cube(), "fastest")


def test_limits_are_libfrankas() -> None:
    limits = load_arm(cube().arm, cube().tray).limits  # type: ignore[arg-type]
    q = np.random.default_rng(1).uniform(limits.q_min, limits.q_max, (4000, 7))
    q[:1000], q[1000:2000] = limits.q_max - 0.02 * q[:1000] ** 2, limits.q_min + 0.02 * q[1000:2000] ** 2
    one = np.ones_like(q)
    assert limits.velocity_at(q, one)[0] == pytest.approx(np.maximum(upwards(q), 1e-9), rel=1e-12)
    assert limits.velocity_at(q, -one)[0] == pytest.approx(np.maximum(-downwards(q), 1e-9), rel=1e-12)
    half = limits.scaled({"velocity": 0.5}).velocity_at(q, one)[0]
    assert half == pytest.approx(np.maximum(0.5 * upwards(q), 1e-9), rel=1e-9)


def test_a_share_of_the_velocity_is_of_the_limit_where_the_joint_is() -> None:
    """12 rad/s^2 and .3 rad/s of joint 1, .19 rad from its end: sqrt(2.28) - .3 = 1.21 rad/s towards it."""
    limits = load_arm(cube().arm, cube().tray).limits  # type: ignore[arg-type]
    q = 0.5 * (limits.q_min + limits.q_max)
    q[0], dq = 2.7501 - 0.19, np.eye(7)[0]
    for sign, share in ((1.0, 1 / (np.sqrt(2.28) - 0.3)), (-1.0, -1 / 2.62)):
        assert limits.shares({"position": q, "velocity": sign * dq})["velocity"][0] == pytest.approx(share)
    assert limits.shares({"velocity": dq})["velocity"][0] == pytest.approx(1 / 2.62)  # nobody knows where


def test_derivatives_of_the_rows_are_those_of_differences() -> None:
    """At random states near either end of the range and beyond it, with what the arm strays."""
    problem = transport_problem(cube())
    limits, rng, n = problem.limits, np.random.default_rng(3), problem.n
    nodes = 9
    z = rng.normal(size=(4, nodes, n))
    away = rng.uniform(-0.002, 0.6, (nodes, n))
    z[0] = np.where(rng.random((nodes, n)) < 0.5, limits.q_max - away, limits.q_min + away)
    s = np.linspace(0.0, 1.0, nodes)
    here = problem.at(s, z, 1.0)
    assert here.response is not None

    def block(z: Array) -> tuple[Array, object]:
        moved = replace(here, z=z)
        vars(moved)["response"] = here.response  # the radii are not part of the derivative
        made = list(JointLimit(limits, (1,)).blocks(moved))
        assert [one.name for one in made] == ["velocity", "velocity"]
        return made[1].values, made[1].gradient

    values, gradient = block(z)
    off, extra = (here.between_nodes(here.joint_radius(order)) for order in (0, 1))
    ends = limits.velocity_by_position
    assert ends is not None
    up, down = ends.towards_ends(z[0] + off)[0][:, :n], ends.towards_ends(z[0] - off)[0][:, n:]
    beyond = np.concatenate([z[1] + extra - up, extra - z[1] - down], axis=1)
    assert values == pytest.approx(beyond / np.tile(limits.velocity, 2), abs=1e-12)
    assert min(off.min(), extra.min()) > 1e-9
    node, row = (each.ravel() for each in np.indices(values.shape))
    slopes, h = gradient(node, row).reshape(nodes, 2 * n, 4, n), 1e-6
    for order in range(4):
        for joint in range(n):
            moved = [z.copy(), z.copy()]
            moved[0][order, :, joint] += h
            moved[1][order, :, joint] -= h
            difference = (block(moved[0])[0] - block(moved[1])[0]) / (2 * h)
            assert slopes[:, :, order, joint] == pytest.approx(difference, abs=1e-5)
    assert np.abs(slopes[:, :, 0]).max() > 1.0


def test_the_fastest_motion_keeps_libfrankas_limits_and_is_at_one(fastest: Plan) -> None:
    assert fastest.ok, fastest.verdict
    assert fastest.joint is not None
    assert 0.95 < largest_share(fastest.joint) <= 0.985  # 98 % are planned with
    arm = load_arm(fastest.scenario.arm, fastest.scenario.tray)  # type: ignore[arg-type]
    checks = check_plan(fastest, arm, fastest.scenario.payload.bodies) + check_franka(
        fastest.scenario, arm, fastest.joint
    )
    assert [check.sentence for check in checks if check.required and not check.ok] == []


def test_the_verdict_refuses_what_is_too_fast_near_an_end(fastest: Plan) -> None:
    """The same motion in nine tenths of its time, which all but these limits would allow."""
    problem = replace(transport_problem(fastest.scenario), tracking=None, contacts=())
    assert fastest.joint is not None
    others = ("velocity", "acceleration", "jerk", "torque", "torque_rate")
    limits = {key: 2.0 * getattr(problem.limits, key) for key in others}
    free = replace(problem, limits=replace(problem.limits, **limits))
    assert verify(free, fastest.joint, options=PLANNED).ok
    joint = fastest.joint
    hurried = JointMotion(0.9 * joint.t, joint.q, joint.dq / 0.9, joint.ddq / 0.81)
    said = verify(free, hurried, options=PLANNED).sentence
    assert said.startswith("velocity of fr3_joint6 would be exceeded by "), said
    without = replace(free, limits=replace(free.limits, velocity_by_position=None))
    assert verify(without, hurried, options=PLANNED).ok


def test_the_limit_where_the_joint_is_is_named() -> None:
    """Joint 6 goes down at .2 rad/s: .3 rad before its end it may at .98 of sqrt(11 * .3) - .35 rad/s, at it not at
    all."""
    case = cube()
    arm = load_arm(case.arm, case.tray)  # type: ignore[arg-type]
    t = np.linspace(0.0, 0.01, 11)
    for away, dq, said in (
        (0.3, 3.0, f"over its limit of {0.98 * (np.sqrt(3.3) - 0.35):.4g}"),
        (0.003, 0.2, "where it must not move towards that end of its range"),
    ):
        q, rate = np.tile(0.5 * (arm.limits.q_min + arm.limits.q_max), (11, 1)), np.zeros((11, 7))
        q[:, 5], rate[:, 5] = 0.54092 + away + dq * (t[-1] - t), -dq
        sentence = verdict(arm, JointMotion(t, q, rate, 0.0 * rate)).sentence
        assert f"the velocity of fr3_joint6 reaches -{dq:g} rad/s at t = 0.0" in sentence
        assert said in sentence


@pytest.mark.parametrize("exact", [True, False])
def test_between_instants_the_verdict_bounds_what_a_fine_scan_finds(fastest: Plan, exact: bool) -> None:
    """Of an arm that follows exactly, and of one that strays by as much as at either instant."""
    problem = transport_problem(fastest.scenario)
    problem = replace(problem, tracking=None) if exact else problem
    assert fastest.joint is not None
    judged = Judged.of(problem, fastest.joint, PLANNED)
    row = list(judged.joints(1))[1]
    t = np.linspace(judged.t[:-1], judged.t[1:], 41)
    q, dq = (each.reshape(*t.shape, 7) for each in fastest.joint.sample(t.ravel())[:2])
    off = extra = np.zeros_like(q[0])
    if not exact:
        off, extra = (np.maximum(r[:-1], r[1:]) for r in (judged.along.joint_radius(order) for order in (0, 1)))
    ends = problem.limits.velocity_by_position
    assert ends is not None
    up, down = ends.towards_ends(q + off)[0][..., :7], ends.towards_ends(q - off)[0][..., 7:]
    seen = np.concatenate([dq + extra - up, extra - dq - down], axis=-1) / np.tile(problem.limits.velocity, 2)
    seen = seen.max(axis=0)
    assert np.all(row.values >= seen - 1e-10)
    near = seen > -0.2
    assert np.max((row.values - seen)[near]) < 1e-3


def test_a_urdf_with_the_makers_element_has_the_same_limits(tmp_path: Path) -> None:
    """`<position_based_velocity_limits>` of franka_description, with the ends of `<limit>`."""
    known = load_arm(cube().arm, cube().tray)  # type: ignore[arg-type]
    root, ends = ElementTree.fromstring(known.urdf), known.limits.velocity_by_position
    assert ends is not None
    for k, name in enumerate(known.joint_names):
        joint = next(joint for joint in root.iter("joint") if joint.get("name") == name)
        limits = {"lower": ends.lower[k], "upper": ends.upper[k], "velocity": known.limits.velocity[k], "effort": 80}
        for tag in ("limit", "safety_controller"):
            joint.remove(joint.find(tag))  # type: ignore[arg-type]
        ElementTree.SubElement(joint, "limit", {key: str(value) for key, value in limits.items()})
        by_position = {"velocity_offset": str(ends.offset[k]), "deceleration_limit": str(0.5 * ends.slope[k])}
        ElementTree.SubElement(joint, "position_based_velocity_limits", by_position)
    path = tmp_path / "arm.urdf"
    path.write_text(ElementTree.tostring(root, encoding="unicode"))
    found = load_arm(scenario.Arm(model=str(path), flange="fr3_link8"), cube().tray).limits  # type: ignore[arg-type]
    q = np.random.default_rng(1).uniform(known.limits.q_min, known.limits.q_max, (400, 7))
    for sign in (1.0, -1.0):
        towards = np.full_like(q, sign)
        assert found.velocity_at(q, towards)[0] == pytest.approx(known.limits.velocity_at(q, towards)[0], rel=1e-12)


ELEMENT = '<position_based_velocity_limits velocity_offset="0.2" deceleration_limit="2.0"/>'


@pytest.mark.slow
def test_of_a_urdf_some_joints_may_have_them(tmp_path: Path) -> None:
    """One of six joints: the others are limited as before, though nobody gives one of them a velocity."""
    text = gantry(turn="revolute", more=ELEMENT).replace('velocity="2.0"', 'velocity="0"', 1)
    case = cell(tmp_path, text)
    plan = make_plan(case, "fastest")
    assert plan.ok, plan.verdict
    limits = load_arm(case.arm, case.tray).limits  # type: ignore[arg-type]
    q = np.array([0.0, 0.0, 0.0, 1.9, 0.0, 0.0])
    at = limits.velocity_at(q, np.ones(6))[0]
    assert at == pytest.approx([np.sqrt(2e6) - 1, 2, 2, np.sqrt(4 * 0.1) - 0.2, 2, 2], rel=1e-3)
    used = limits.shares({"position": plan.joint.q, "velocity": plan.joint.dq})["velocity"]  # type: ignore[union-attr]
    assert np.abs(used).max() <= 1.0


@pytest.mark.parametrize("wrong", ['velocity_offset="0"', 'velocity_offset="-1"'])
def test_an_element_that_cannot_be_is_refused(tmp_path: Path, wrong: str) -> None:
    with pytest.raises(ScenarioError, match=r"<position_based_velocity_limits> in turn are .* both must be above 0"):
        loaded(tmp_path, gantry(turn="revolute", more=ELEMENT.replace('velocity_offset="0.2"', wrong)))


@pytest.mark.slow
def test_safest_retimed_and_stopped_motions_keep_them_too(fastest: Plan) -> None:
    assert fastest.joint is not None
    safest = make_plan(cube(motion__duration=1.0), "safest", options=EFFORTS["quick"])
    retimed = sv.retime(fastest.joint.q[::20], cube())  # type: ignore[union-attr]
    stopping = replace(fastest, stops=plan_stops(stop_problem(fastest), fastest.joint, every=0.3, space=fastest.space))
    for plan in (safest, retimed, stopping):
        assert plan.ok, plan.verdict
        assert largest_share(plan.joint) <= 0.985
    assert stopping.stops is not None
    for now in (0.2, 0.4, 0.6):
        assert largest_share(stopping.stops.stopped(stopping.joint, now)) <= 1.0


@pytest.mark.slow
def test_a_live_motion_keeps_them_too() -> None:
    live = sv.Live(cube(), lead=0.1)
    assert live.goto((0.444272, 0.100574, 0.4)).ok
    live.plan(60.0)
    for k in range(40):
        live.command(0.05 * k)
    assert np.abs(live.committed.motion.q[-1] - live.problem.start_posture).max() > 0.1
    assert largest_share(live.committed.motion) <= 1.0
