"""Time laws along given paths: the trapezoid by hand, derivatives by differences, verdicts of other modules."""

from __future__ import annotations

import json
import time
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from salver.cli.common import handled
from salver.cli.plans.retime import retime as retime_command
from salver.errors import FileFormatError, ScenarioError
from salver.models.contact_rows import contact_rows
from salver.motion_files import read_path
from salver.planning.fastest import FastestOptions, fastest, object_motion, retiming
from salver.planning.fastest.retiming import (
    PATH_TOLERANCE,
    SplinePath,
    _within_limits,
    plan_retimed,
    reachable_law,
    retime,
)
from salver.planning.follow.limits import peaks
from salver.planning.plan import load_plan
from salver.planning.trajopt.curves import Grid, PathCurve
from salver.planning.trajopt.problem import TransportProblem, transport_problem
from salver.planning.trajopt.spline import RestSpline
from salver.scenario import Scenario, load
from salver.sensitivity.arm.terms import motion_terms


def cube(**changes: object) -> Scenario:
    return load("panda-cube").with_changes(**{"objects__0__friction": 0.4, "motion__goal_yaw": "free", **changes})


@pytest.fixture(scope="module")
def problem() -> TransportProblem:
    return transport_problem(cube(), level=False, robust=False)


def swing(problem: TransportProblem, turn: float) -> SplinePath:
    """A turn of the first joint alone."""
    q = np.tile(problem.start_posture, (9, 1))
    q[:, 0] += np.linspace(0, turn, 9)
    return SplinePath.through(q)


def test_path_passes_its_waypoints_in_proportion_to_length():
    q = np.random.default_rng(0).normal(size=(8, 7))
    path = SplinePath.through(q)
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(q, axis=0), axis=1))])
    assert np.abs(path.derivatives(length / length[-1], 0)[0] - q).max() < 1e-10
    u, h = np.linspace(0.1, 0.9, 20), 1e-5
    ahead, here, behind = (path.derivatives(u + d, 4) for d in (h, 0, -h))
    for k in range(4):
        # Central differences err by h^2 / 6 of the derivative two orders up: 1e-8 of so bent a path's.
        error = np.abs((ahead[k] - behind[k]) / (2 * h) - here[k + 1]).max()
        assert error < 1e-7 * np.abs(here[k + 1]).max()


def test_two_waypoints_make_a_straight_path():
    path = SplinePath.through(np.array([[0.0, 1.0], [2.0, -1.0]]))
    q, first, second = path.derivatives(np.linspace(0, 1, 11), 2)
    assert np.allclose(q, np.linspace([0, 1], [2, -1], 11))
    assert np.allclose(first, [2, -2])
    assert np.abs(second).max() < 1e-8


def test_a_dense_path_with_corners_is_followed_or_it_is_said_by_how_much():
    t = np.linspace(0, 1, 2001)[:, None]
    few, many = (np.abs((t * turns) % 1 - 0.5) * np.ones(7) + t for turns in (4, 60))
    for q in (few, many):
        path = SplinePath.through(q)
        curve = path.derivatives(np.linspace(0, 1, 20_001), 0)[0]
        passed = max(np.linalg.norm(curve - point, axis=1).min() for point in q[::10])
        assert passed <= np.sqrt(7) * max(path.missed, PATH_TOLERANCE)
    assert SplinePath.through(few).missed < 0.01
    assert SplinePath.through(many).missed > PATH_TOLERANCE


def test_waypoints_that_are_told_twice_do_not_bend_the_path():
    q = np.linspace(0, 1, 6)[:, None] * np.ones(7)
    rough = np.repeat(q, 2, axis=0) + 1e-5 * np.random.default_rng(0).standard_normal((12, 7))
    curve = SplinePath.through(rough).derivatives(np.linspace(0, 1, 401), 0)[0]
    assert np.ptp(curve, axis=1).max() < 1e-3
    assert np.array_equal(curve[[0, -1]], rough[[0, -1]])


def test_fewer_than_two_waypoints_are_refused():
    with pytest.raises(ScenarioError, match="at least two different waypoints"):
        SplinePath.through(np.ones((3, 7)))


def test_single_joint_runs_a_trapezoid(problem):
    """Velocity and acceleration limits alone: d/v + v/a."""
    free = replace(problem, contacts=(), limits=replace(problem.limits, torque=np.full(7, np.inf)))
    law = reachable_law(free, swing(problem, 1.2), 801)
    assert law is not None
    v, a = problem.limits.velocity[0], problem.limits.acceleration[0]
    assert law[0][-1] == pytest.approx(1.2 / v + v / a, rel=2e-3)


@pytest.mark.parametrize(("speed", "torque"), [(1.0, np.inf), (0.5, 0.6)])
def test_a_time_optimal_law_is_everywhere_as_fast_as_something_allows(problem, speed, torque):
    """Along a path that bends, whatever stands on the tray: at every instant but those next to a switch a joint is at
    its limit of speed, acceleration or torque, and none is beyond (Bobrow, Dubowsky, Gibson 1985)."""
    limits = replace(problem.limits, velocity=speed * problem.limits.velocity, torque=torque * problem.limits.torque)
    path = SplinePath.through(np.tile(problem.start_posture, (9, 1)) + 0.2 * np.sin(np.arange(63)).reshape(9, 7))
    t, u = reachable_law(replace(problem, contacts=(), limits=limits), path, 401)
    q, first, second = path.derivatives(0.5 * (u[1:] + u[:-1]), 2)
    rate = np.diff(u) / np.diff(t)
    change = 0.5 * np.gradient(rate**2, u[1])
    dq, ddq = first * rate[:, None], second * rate[:, None] ** 2 + first * change[:, None]
    inner = slice(3, -3)  # differences need neighbours
    tau = motion_terms(problem.model, problem.arm.tray_id, q, dq, ddq).torque
    of = ((dq, limits.velocity), (ddq, limits.acceleration), (tau, limits.torque))
    most = np.max([np.abs(value / limit).max(axis=1) for value, limit in of], axis=0)[inner]
    assert most.max() < 1.02
    assert np.mean(most > 0.99) > 0.94


def test_horizontal_swing_is_limited_by_friction(problem):
    """A cube at distance r from the first axis, level: from rest a <= mu g along a pyramid's edge; with the arm's
    own limits away, a turn d takes about 2 sqrt(r d / (mu g)), longer as the path bends."""
    loose = replace(
        problem.limits,
        velocity=np.full(7, 1e3),
        acceleration=np.full(7, 1e4),
        torque=np.full(7, np.inf),
    )
    turn = 0.1
    law = reachable_law(replace(problem, limits=loose), swing(problem, turn), 401)
    assert law is not None
    distance = float(np.hypot(0.54237, 0.370574))
    straight = 2 * np.sqrt(distance * turn / (0.4 * 9.81))
    assert straight < law[0][-1] < 1.5 * straight


def test_derivatives_of_a_time_law_match_differences(problem):
    path, law = swing(problem, 0.8), RestSpline(5, 8)
    path = SplinePath.through(path.derivatives(np.linspace(0, 1, 9), 0)[0] + 0.1 * np.sin(np.arange(63)).reshape(9, 7))
    curve = PathCurve(problem, Grid.of(law, law.nodes(3)), path)
    rng = np.random.default_rng(1)
    coefficients = np.sort(rng.uniform(0, 1, (law.size, 1)), axis=0)
    node = np.arange(len(curve.grid.s))
    parts, direction, h = rng.normal(size=(len(node), 4, 7)), rng.normal(size=coefficients.shape), 1e-6

    def value(step: float) -> np.ndarray:
        z = curve.motion(coefficients + step * direction, 0.9)
        return np.einsum("rkn,krn->r", parts, z[:, node])

    predicted = curve.columns(coefficients, 0.9, parts, node) @ direction[:, 0]
    difference = (value(h) - value(-h)) / (2 * h)
    assert np.allclose(difference, predicted, rtol=1e-5, atol=1e-5 * np.abs(predicted).max())


def test_waypoints_may_pass_a_limit_by_less_than_a_path_may_miss_them(problem):
    q = np.tile(problem.start_posture, (3, 1))
    for joint, end, side in ((2, problem.limits.q_min, -1), (4, problem.limits.q_max, 1)):
        for beyond, fits in ((-0.5e-3, True), (0.5e-3, True), (2e-3, False)):
            there = q.copy()
            there[1, joint] = end[joint] + side * beyond
            with nullcontext() if fits else pytest.raises(ScenarioError, match="waypoint 2 has"):
                _within_limits(problem.scenario, problem, there)


def test_a_time_law_never_goes_back(problem):
    law = RestSpline(5, 8)
    curve = PathCurve(problem, Grid.of(law, law.nodes(3)), swing(problem, 0.8))
    rng = np.random.default_rng(2)
    for _ in range(20):
        here, there = rng.uniform(0, 1, law.size), np.sort(rng.uniform(0, 1, law.size))
        there[1:] = rng.choice([there[1:], rng.permutation(there[1:])])  # in either case none before the first
        rows, most = curve.inequalities(here[:, None])
        assert np.all(rows @ (there - here) <= most + 1e-12) == np.all(np.diff(there) >= -1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("robust", [False, True])
def test_retimed_path_keeps_every_limit_and_the_contact(robust):
    uncertainty = {"mass": "20%", "com": [0.003, 0.003, 0.003], "friction": "10%"}
    scenario = cube(objects__0__uncertainty=uncertainty)
    given = transport_problem(scenario, level=False, robust=robust)
    found = retime(given, swing(given, 1.0))
    assert found.status.ok, found.status
    assert found.lower_bound < found.duration < 1.25 * found.lower_bound
    motion = found.joint_motion()
    for peak in peaks(given.arm, motion, given.items):
        assert peak.share < 1.001, peak
    terms = object_motion(given, motion.t, motion.q, motion.dq, motion.ddq)
    assert np.abs(terms.v_S[[0, -1]]).max() < 1e-9
    w = motion_terms(given.model, given.arm.tray_id, motion.q, motion.dq, motion.ddq).w
    for rows in contact_rows(scenario.payload if robust else scenario.payload.nominal):
        assert rows.worst(w).max() <= -0.5 * scenario.contact.margin


@pytest.mark.slow
def test_uncertainty_costs_time_on_the_same_path():
    scenario = cube(objects__0__uncertainty={"mass": "40%", "com": [0.01, 0.01, 0.01], "friction": "20%"})
    durations = []
    for robust in (False, True):
        given = transport_problem(scenario, level=False, robust=robust)
        durations.append(retime(given, swing(given, 1.0)).duration)
    assert durations[1] > 1.05 * durations[0]


def test_path_of_a_fastest_motion_cannot_be_timed_much_better(problem):
    found = fastest(problem, FastestOptions(spans=10))
    begun = time.perf_counter()
    again = retime(problem, SplinePath.of(found.joint_motion()), spans=14)
    assert 0 < again.wall_time < time.perf_counter() - begun
    assert again.status.ok, again.status
    assert 0.8 * again.duration < again.lower_bound < again.duration
    assert 0.97 * found.duration < again.duration < 1.05 * found.duration


def test_path_on_which_the_load_cannot_even_rest_has_a_status(problem):
    q = np.tile(problem.start_posture, (5, 1))
    q[:, 5] += np.linspace(0, 1.2, 5)  # tilts the tray by 69 degrees
    found = retime(problem, SplinePath.through(q))
    assert not found.status.ok
    assert "stay in place at rest" in found.status.sentence


# Plans and the command -----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_retimed_plan_checks_itself(problem):
    path = swing(problem, 1.0).derivatives(np.linspace(0, 1, 6), 0)[0]
    plan = plan_retimed(cube(), path)
    assert plan.ok, (plan.status, plan.verification.sentence, plan.arm_status)
    assert plan.joint is not None
    turned = plan.joint.q[-1] - plan.joint.q[0]
    assert np.allclose(turned, [1.0, 0, 0, 0, 0, 0, 0], atol=1e-9)
    assert plan.solver["lower_bound"] < plan.duration


def test_a_timing_that_is_a_hair_too_fast_is_slowed_and_its_sentence_says_the_time_it_takes(problem, monkeypatch):
    """In .9995 of its time it is some .1 % too quick; .001 of its time mends it."""
    found = []

    def hastened(*arguments, **options):
        motion = retime(*arguments, **options)
        found.append(motion.duration)
        return replace(motion, duration=0.9995 * motion.duration)

    monkeypatch.setattr(retiming, "retime", hastened)
    plan = plan_retimed(cube(), swing(problem, 1.0).derivatives(np.linspace(0, 1, 6), 0)[0])
    assert plan.ok
    assert plan.duration == pytest.approx(0.9995 * 1.001 * found[-1])
    assert f"takes {plan.duration:.4f} s" in plan.status.sentence
    assert f"{found[-1]:.4f}" not in plan.status.sentence


@pytest.mark.slow
def test_a_path_that_passes_nearer_than_the_arm_may_stray_is_unsafe(problem):
    """3.3 mm at the goal, with this load; the ball ahead of the cube's tray is 2 mm from it, and 4 mm."""
    uncertainty = {"mass": "40%", "com": [0.01, 0.01, 0.01], "friction": "20%"}
    path = swing(problem, 1.0).derivatives(np.linspace(0, 1, 6), 0)[0]
    centre = problem.arm.object_pose(path[-1], problem.items[0].p_EB, problem.items[0].R_EB)[0]
    ahead = np.array([-np.sin(1.0), np.cos(1.0), 0.0])
    verdicts = []
    for distance in (0.1092, 0.1133):
        ball = {"type": "sphere", "name": "ball", "radius": 0.02, "position": tuple(centre + distance * ahead)}
        plan = plan_retimed(cube(objects__0__uncertainty=uncertainty, obstacles=[ball]), path)
        verdicts.append((plan.ok, "clearance of tray from ball would be 0.5" in plan.status.sentence))
    assert verdicts == [(False, True), (True, False)]


def test_waypoints_of_another_arm_are_refused():
    with pytest.raises(ScenarioError, match=r"needs rows of 7"):
        plan_retimed(cube(), np.zeros((3, 6)))


def test_a_waypoint_beyond_a_limit_is_named():
    q = np.array([[0.08, 1.04, -0.78, -1.68, -2.2, 0.84, 1.12]] * 2)
    q[1] = np.rad2deg(q[1])
    with pytest.raises(
        ScenarioError, match=r"waypoint 2 has panda_joint1 at 4\.584; it must be from -2\.\d+ to 2\.\d+"
    ):
        plan_retimed(load("panda-cube"), q)


@pytest.mark.slow
def test_command_reads_waypoints_and_writes_a_run(problem, tmp_path):
    q = swing(problem, 0.6).derivatives(np.linspace(0, 1, 4), 0)[0]
    file = tmp_path / "waypoints.csv"
    np.savetxt(file, q, delimiter=",", header="q1,q2,q3,q4,q5,q6,q7", comments="")
    app = typer.Typer()
    app.command()(handled(retime_command))
    result = CliRunner().invoke(app, [str(file), "--scenario", "panda-cube", "-o", str(tmp_path / "run"), "--json"])
    assert result.exit_code == 0, result.output
    again = load_plan(tmp_path / "run")
    assert again.joint is not None
    assert np.allclose(again.joint.q[-1], q[-1], atol=1e-9)


def test_a_first_posture_with_a_mistake_is_no_heading(tmp_path):
    file, names = tmp_path / "waypoints.csv", ("joint1", "joint2", "joint3")
    file.write_text("0.3,O.2,0.1\n0,0,0\n0.1,0.1,0.1\n")
    with pytest.raises(FileFormatError, match=r'line 1: "O.2" is not a number; each row must be 3 joint angles'):
        read_path(file, names)
    file.write_text("joint1,joint2,joint3\n0.3,0.2,0.1\n0,0,0\n")
    assert read_path(file, names).tolist() == [[0.3, 0.2, 0.1], [0, 0, 0]]
    file.write_text("joint2,joint3,joint1\n0.2,0.1,0.3\n0,0,0\n")
    assert read_path(file, names).tolist() == [[0.3, 0.2, 0.1], [0, 0, 0]]
    file.write_text("shoulder,elbow,wrist\n0.2,0.1,0.3\n0,0,0\n")
    with pytest.raises(FileFormatError, match="must name the joints joint1, joint2, joint3 or q1"):
        read_path(file, names)
    file.write_text("0.3,0.2,0.1\n0,0\n")
    with pytest.raises(FileFormatError, match="line 2: 2 values"):
        read_path(file, names)


def test_a_way_may_have_two_postures_whatever_file_it_is_in(tmp_path):
    names = ("joint1", "joint2")
    message = {
        "joint_names": ["joint2", "joint1"],
        "points": [
            {"positions": [0.2, 0.1], "time_from_start": 0.0},
            {"positions": [0.4, 0.3], "time_from_start": 1.0},
        ],
    }
    (tmp_path / "way.json").write_text(json.dumps(message))
    (tmp_path / "way.csv").write_text("t,joint1,joint2\n0,0.1,0.2\n1,0.3,0.4\n")
    for name in ("way.json", "way.csv"):
        assert read_path(tmp_path / name, names).tolist() == [[0.1, 0.2], [0.3, 0.4]]


@pytest.mark.parametrize("text", ["1,2\n3", "", "a,b\nc,d"])
def test_broken_waypoint_files_are_refused(tmp_path, text):
    file = tmp_path / "waypoints.csv"
    file.write_text(text)
    app = typer.Typer()
    app.command()(handled(retime_command))
    assert CliRunner().invoke(app, [str(file), "--scenario", "panda-cube"]).exit_code == 2


def test_a_reserve_is_kept_by_every_contact_and_costs_time(problem, tmp_path):
    q = swing(problem, 0.6).derivatives(np.linspace(0, 1, 4), 0)[0]
    file = tmp_path / "waypoints.csv"
    np.savetxt(file, q, delimiter=",")
    app = typer.Typer()
    app.command()(handled(retime_command))
    words = [str(file), "--scenario", "panda-cube", "--no-robust", "--json"]
    took = []
    for share in ("0", "20%"):
        run = tmp_path / share.rstrip("%")
        assert CliRunner().invoke(app, [*words, "--reserve", share, "-o", str(run)]).exit_code == 0
        plan = load_plan(run)
        took.append((plan.duration, float(plan.margins.exact.min())))
    assert plan.scenario.contact.margin == 0.2
    (fast, without), (slow, kept) = took
    assert without < 0.2 < kept
    assert plan.verification.slack == pytest.approx(0.2, abs=0.002)  # and no more while the speed changes
    assert fast < slow
    for wrong in ("much", "100%", "-1%"):
        refused = CliRunner().invoke(app, [*words, "--reserve", wrong])
        assert refused.exit_code == 2
        assert "must be a share from 0 to below 100%" in " ".join(refused.output.split())
