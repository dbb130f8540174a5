"""What may be asked of a live motion, from where, and why not."""

import re
from dataclasses import replace

import numpy as np
import pytest

from live_runs import LEAD, check, drive, place
from salver.errors import ScenarioError
from salver.live import Live
from salver.live.replanning.replan import ReplanOptions, straight
from salver.models.arm.arm_limits import POSITION
from salver.planning.fastest import transport_problem
from salver.planning.postures import PoseTarget, candidate_postures
from salver.planning.trajopt.constraints.obstacles import CLEARANCE
from salver.planning.trajopt.ends import AtPose, AtPosture


@pytest.fixture(scope="module")
def problem(cube):
    return transport_problem(cube)


def beside_a_wall(problem, room):
    """The arm where the cube starts, with a wall beside the tray, room m away."""
    place = problem.arm.tray_pose(problem.start.q)[0] + [0.0, 0.1 + 0.01 + room, 0.0]  # half the tray and half the wall
    wall = {"name": "wall", "type": "box", "size": [0.1, 0.02, 0.1], "position": place.tolist()}
    return Live(problem.scenario.with_changes(arm__start_posture=None, obstacles=[wall]), problem.start.q)


def test_what_cannot_be_is_refused_in_a_sentence(cube):
    live = Live(cube, lead=LEAD)
    for wish, sentence in (
        (lambda: live.goto((np.nan, 0, 0.5)), "the position has values that are not finite"),
        (lambda: live.goto((450.0, 0, 500.0)), "the position is 500 m away in S; it must be at most 100 m"),
        (lambda: live.goto((1.0, 2.0)), r"the position has shape \(2,\); it must be \(3,\)"),
        (lambda: live.goto([1.0, 2.0]), r"the position has shape \(2,\); it must be \(3,\)"),
        (lambda: live.goto(q=np.full(7, 9.0)), "panda_joint1 would be at 9; it must be within"),
        (lambda: live.goto(q=np.zeros(6)), r"the posture has shape \(6,\)"),
        (lambda: live.goto((0.5, 0, 0.5), q=np.zeros(7)), "a goal is a pose or a posture q, one of them"),
        (lambda: live.goto(((0.5, 0, 0.5), np.ones((3, 3)))), "the rotation is not a rotation matrix"),
        (lambda: live.goto(((0.5, 0, 0.5), np.diag([1.0, -1, -1]))), "leans the tray by 180 deg"),
        (lambda: live.goto(("0.5", "0", "0.5")), "the position is not an array of numbers"),
        (lambda: live.goto("123"), "the position is not an array of numbers"),
        (lambda: live.goto([True, 0.0, 0.5]), "the position is not an array of numbers"),
        (lambda: live.goto(np.array([True, False, True])), "the position is not an array of numbers"),
        (lambda: live.goto([0.5, 0.0, 10**400]), "the position is not an array of numbers"),
        (lambda: live.goto(np.array([0.5, 0, 0.5 + 1j])), "the position is not an array of numbers"),
        (lambda: live.goto(np.ma.masked_array([0.5, 0, 0.5], [0, 1, 0])), "the position is not an array of numbers"),
        (lambda: live.goto([[[0.5]], [0], [0.5]]), "the position is not an array of numbers"),
        (lambda: live.goto([[0.5], [0.0], [0.5]]), "the position is not an array of numbers"),
        (lambda: live.twist([0.1, 0, None]), "v is not an array of numbers"),
        (lambda: live.chunk("12", [(0.5, 0, 0.5)] * 2), "times is not an array of numbers"),
        (lambda: live.chunk(0.5, [(0.5, 0, 0.5)]), "times"),
        (lambda: live.measured(["0"] * 7), "the measured posture is not an array of numbers"),
    ):
        status = wish()
        assert not status.ok
        assert re.search(sentence, status.sentence)
    assert live.idle
    live.goto((3.0, 0.0, 0.5))
    assert "no posture of the arm within its limits reaches it" in live.plan(60.0).refused
    assert live.idle


def test_an_obstacle_at_the_goal_is_named(cube):
    post = {"type": "box", "name": "post", "position": [0.45, 0.1, 0.45], "size": [0.05, 0.05, 0.4]}
    live = Live(cube.with_changes(obstacles=[post]), lead=LEAD)
    live.goto(((0.45, 0.1, 0.45), np.eye(3)))
    assert "At the goal the tray is inside the obstacle post; move one of them." in live.plan(60.0).refused
    live.goto((0.45, 0.1, 0.45))
    assert "is inside the obstacle post whichever way it points (at 36 headings)" in live.plan(60.0).refused


def test_from_where_it_rests_near_to_something_it_goes_on(cube):
    """A post is half a millimetre further away than it must: more than the arm strays, less than planners keep."""
    post = {"type": "box", "name": "post", "position": [0.6934, -0.37, 0.5], "size": [0.1, 0.4, 1.0]}
    live = Live(cube.with_changes(obstacles=[post]), lead=LEAD)
    q, keep_out = live.problem.start.q[None], live.problem.keep_out
    assert 4e-4 < keep_out.near(q).distances(q).min() < 6e-4 < CLEARANCE.at_nodes
    live.command(0.0)
    live.goto((0.45, 0.1, 0.45))
    assert live.plan(60.0).refused == ""


def test_queued_goals_are_reached_one_after_the_other(cube):
    live = Live(cube, lead=LEAD)
    first = live.problem.items[0]
    live.goto((0.5, -0.25, 0.42))
    live.goto((0.48, -0.3, 0.45), queued=True)
    states = drive(live, 2.0)
    check(live, states)
    along = np.array([live.problem.arm.object_pose(q, first.p_EB, first.R_EB)[0] for q in states[0][::10]])
    for goal in ((0.5, -0.25, 0.42), (0.48, -0.3, 0.45)):
        assert np.abs(along - goal).max(axis=1).min() < 1e-4
    assert np.abs(along[-1] - (0.48, -0.3, 0.45)).max() < 1e-6


def test_an_arm_that_is_elsewhere_is_stopped(cube):
    live = Live(cube, lead=LEAD)
    drive(live, 0.4, [(0.0, place(0.45, 0.1, 0.45))])
    told = live.command(0.4)[0].copy()
    assert live.measured(told + 0.01).ok
    off = np.eye(7)[0] * 0.1
    assert "panda_joint1 is 0.100 rad from where it was commanded to be" in live.measured(told + off).sentence
    state = live.plan(60.0)
    assert state.doing == "stopping"
    assert "Stopped by the monitor: panda_joint1 is 0.100 rad from where it was commanded to be." in str(state)


def test_a_load_that_is_not_safe_at_rest_is_not_begun_with(cube, problem, monkeypatch):
    monkeypatch.setattr("salver.live.standing.LOOKS", 2)
    steep = {"motion__start__rpy_deg": [26.5, 0.0, 0.0], "motion__orientation": "free", "motion__duration": None}
    with pytest.raises(ScenarioError, match=r"in any of 2 postures at motion\.start; in the first, contact of cube"):
        Live(cube.with_changes(**steep, arm__start_posture=None))  # it slides from 26.57 deg on
    with pytest.raises(ScenarioError, match="the load is not safe at rest at q"):
        Live(cube, q=np.array([0.0, 0.5, 0.0, -1.5, 0.0, 2.6, 0.0]))  # the tray leans
    with pytest.raises(ScenarioError, match=r"clearance of tray from wall would be (3|3\.\d+) mm too small"):
        beside_a_wall(problem, -0.003)
    parts = beside_a_wall(problem, 0.003).problem.keep_out  # nearer than the 5 mm that are kept elsewhere
    pair = [(parts.parts.names[i], parts.parts.names[j]) for i, j in parts.parts.pairs].index(("tray", "wall"))
    assert parts.required[pair] == pytest.approx(0.0015, abs=1e-6)


@pytest.mark.slow
def test_it_leaves_a_wall_that_it_is_beside(problem):
    live = beside_a_wall(problem, 0.004)
    states = drive(live, 3.0, [(0.0, place(0.5, -0.1, 0.5))])
    assert not live.state.refused
    assert live.problem.arm.tray_pose(states[0][-1])[0][1] > -0.11
    check(live, states)


def test_a_posture_that_is_clear_is_found_where_the_first_one_is_not(cube):
    """Near the base the posture that is nearest to the middle of the joints' ranges has the tray in the forearm."""
    position = (0.26, 0.29, 0.34)
    live = Live(cube.with_changes(arm__start_posture=None, motion__start__position=position))
    problem, q = live.problem, live.committed.motion.q[:1]
    middle = problem.start.nearest(problem.arm, problem.limits, problem.limits.range(POSITION)[0])
    assert problem.keep_out.distances(middle[None]).min() < 0
    assert problem.keep_out.distances(q).min() > 0
    np.testing.assert_allclose(problem.start.residual(problem.arm, q[0])[0], 0.0, atol=1e-6)


def test_the_first_guess_of_a_way_ends_in_the_posture_that_is_nearest(cube):
    """A redundant arm reaches a pose in many ways: to where the tray is already it takes none at all."""
    problem = Live(cube).problem
    begun = replace(problem, start=AtPosture(problem.start.q))
    p, R = problem.arm.tray_pose(problem.start.q)
    guess = straight(replace(begun, goal=AtPose(PoseTarget(p, R))), ReplanOptions())
    assert np.abs(guess.coefficients - problem.start.q).max() < 1e-3
    # No posture is found from here for a pose on the other side; of those found from elsewhere the nearest is taken.
    p, R = problem.arm.tray_pose(np.array([1.04, 0.5, 1.05, -1.88, -2.04, 2.66, 0.14]))
    there = AtPose(PoseTarget(p, R))
    assert there.nearest(problem.arm, problem.limits, problem.start.q) is None
    ways = [np.abs(q - problem.start.q).max() for q in candidate_postures(problem.arm, there.target, seeds=16)]
    end = straight(replace(begun, goal=there), ReplanOptions()).coefficients[-1]
    assert np.abs(end - problem.start.q).max() == pytest.approx(min(ways))
    assert min(ways) < 0.5 * max(ways)
