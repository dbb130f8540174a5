"""Obstacles that move: rows of clearance in time, ways out of the way, and a clear word when there is none."""

import copy
import re

import numpy as np
import pytest

from live_runs import drive, in_turn, rows_of
from salver.live import Live, Moving
from salver.live.obstacles import Passing, nearest, predicted
from salver.live.verify import few
from salver.models.arm_geometry import arm_geometry
from salver.planning.fastest import evaluate
from salver.planning.fastest.obstacles import NEAR

G = (0.0, 0.0, -9.81)


@pytest.fixture(scope="module")
def problem(cube):
    return Live(cube).problem


def thrown(at, seconds, come_from):
    """A ball that is at a place in so many seconds."""
    begin = np.add(at, come_from)
    velocity = np.subtract(at, begin) / seconds - 0.5 * seconds * np.array(G)
    return Moving("ball", "sphere", begin, velocity, G, radius=0.05)


def test_distances_are_those_of_an_obstacle_that_stands_there(cube, problem):
    """Against the geometry with that obstacle built in, which compares pairs by another way."""
    q = problem.start.q
    p = problem.arm.tray_pose(q)[0] + np.array([0.09, 0.05, 0.07])
    for seen, still in (
        (Moving("x", "sphere", p, radius=0.03), {"type": "sphere", "radius": 0.03}),
        (Moving("x", "capsule", p, radius=0.02, length=0.1), {"type": "capsule", "radius": 0.02, "length": 0.1}),
        (Moving("x", "box", p, size=(0.04, 0.03, 0.02)), {"type": "box", "size": [0.04, 0.03, 0.02]}),
    ):
        there = cube.with_changes(obstacles=[{"name": "x", "position": p.tolist(), **still}])
        parts = arm_geometry(problem.arm, problem.items, there.obstacles)
        pairs = [(parts.names[i], d) for (i, j), d in zip(parts.pairs, parts.clearance(q[None])[0], strict=True)
                 if parts.names[j] == "x"]  # fmt: skip
        passing = Passing(problem.keep_out.parts, (), 0.0)
        mine = passing.distances(q[None], predicted(seen, 0.0), p[None])[0]
        named = [problem.keep_out.parts.names[k] for k in passing._movable]
        near = [(name, d) for name, d in zip(named, mine, strict=True) if d < 0.1]
        assert len(near) >= 2
        for name, distance in near:
            assert min(abs(distance - d) for other, d in pairs if other == name) < 1e-6
        for name, distance in zip(named, mine, strict=True):
            assert distance <= min(d for other, d in pairs if other == name) + 1e-6 or named.count(name) > 1


def test_derivatives_by_posture_and_duration_match_differences(problem):
    rng, q = np.random.default_rng(3), problem.start.q
    at = problem.arm.tray_pose(q)[0] + np.array([0.05, 0.04, 0.1])
    ball = predicted(Moving("ball", "sphere", at, (0.4, -0.3, 0.1), radius=0.03), 2.0)
    passing = Passing(problem.keep_out.parts, (ball,), 2.0)
    s, duration = np.linspace(0, 1, 4), 0.2
    z = np.zeros((4, 4, 7))
    z[0] = q + 0.02 * rng.standard_normal((4, 7))

    def rows(z, duration):
        return {block.name: block for block in evaluate([passing], problem.at(s, z, duration))}

    here = rows(z, duration)["clearance of ball"]
    i, f = np.nonzero(here.values > -1.0)
    assert len(i) >= 4
    slope = here.gradient(i, f)
    for joint in range(7):
        step = np.zeros_like(z)
        step[0, :, joint] = 1e-6
        up, down = (rows(z + sign * step, duration)["clearance of ball"].values for sign in (1, -1))
        # What the arm may stray by is part of the row and moves a little with the posture: that is left out.
        assert np.abs((up - down)[i, f] / 2e-6 - slope[:, joint]).max() < 0.02
    up, down = (rows(z, duration * np.exp(sign * 1e-5))["clearance of ball"].values for sign in (1, -1))
    assert np.abs((up - down)[i, f] / 2e-5 - here.by_duration[i, f]).max() < 0.02


def test_between_the_postures_that_are_looked_at_no_pair_moves_unseen(problem):
    """Whichever way the joints turn."""
    parts, turn = problem.keep_out.parts, np.array([1, -1, 1, -1, 1, -1, 1.0])
    for span in (1e-3, 0.1, 0.4, 2.0):
        q = problem.start.q + np.linspace(0, span, 65)[:, None] * turn
        looked = few(parts, q)
        steps = np.abs(np.diff(looked, axis=0)) @ parts.levers(q).T
        assert steps.max() < NEAR or len(looked) == len(q)
        assert np.array_equal(few(parts, q[::-1]), looked[::-1])
        assert np.array_equal(looked[[0, -1]], q[[0, -1]])
    assert len(few(parts, problem.start.q + np.zeros((65, 1)))) == 9


@pytest.mark.slow
def test_a_ball_that_would_hit_is_evaded_and_one_that_misses_is_not(cube):
    live = Live(cube, lead=0.1)
    parts, q = live.problem.keep_out.parts, live.command(0.0)[0].copy()
    p = live.problem.arm.tray_pose(q)[0]
    away = Moving("ball", "sphere", p + np.array([0.6, 0.0, 0.6]), (2.0, 0.0, 0.0), radius=0.05)
    assert live.obstacles([away]).ok
    live.plan(60.0)
    assert live.idle
    assert live.committed.at_rest

    ball = thrown(p, 0.7, (1.5, 0.3, 0.2))
    assert live.obstacles([ball]).ok
    here = predicted(ball, live.now)
    t = live.now + 1e-3 * np.arange(1500)
    assert nearest(parts, [here], np.repeat(q[None], 300, axis=0), t[::5])[0] < -0.05  # it would hit
    states = drive(live, 1.5)
    assert live.state.passing == ""
    assert nearest(parts, [here], states[0][::5], t[::5])[0] > 0.0
    assert max(rows_of(live.problem, states).values()) <= 0.0


def test_when_it_is_too_late_that_is_said_and_the_load_is_kept(cube):
    live = Live(cube, lead=0.1)
    states = drive(live, 0.4, [(0.0, lambda live: live.goto((0.45, 0.1, 0.45)))])
    p = live.problem.arm.tray_pose(states[0][-1])[0]
    live.obstacles([Moving("fist", "box", p + np.array([0.2, 0, 0]), (-3.0, 0, 0), size=(0.2, 0.2, 0.2), lasts=0.5)])
    live.plan(60.0)
    assert re.search("Nothing was found that keeps clear of fist: it (stops|goes on), and fist", live.state.passing)
    live.obstacles([])
    more = drive(live, 2.0, begins=0.4)
    assert live.state.passing == ""
    assert max(rows_of(live.problem, in_turn(states, more)).values()) <= 0.0


def test_nothing_is_said_any_more_of_what_counts_as_gone(cube):
    """From the end of its prediction on, though nobody said that it is."""
    live = Live(cube, lead=0.1)
    p = live.problem.arm.tray_pose(live.command(0.0)[0])[0]
    live.obstacles([Moving("fist", "sphere", p, radius=0.1, lasts=0.1)])
    live.plan(60.0)
    drive(live, 0.05, every=None)
    assert "fist" in live.state.passing
    drive(live, 0.1, every=None, begins=0.05)
    assert live.state.passing == ""


def test_where_the_arm_is_put_it_is_looked_anew_at_what_passes(cube):
    """What was clear of it where it was before is not where it is now."""
    live = Live(cube, lead=0.1)
    live.command(0.0)
    turned = live.problem.start.q + 0.8 * np.eye(7)[0]
    fist = Moving("fist", "sphere", live.problem.arm.tray_pose(turned)[0] + [0, 0, 0.05], radius=0.1, growth=0.0)
    assert live.obstacles([fist]).ok
    assert live.plan(60.0).passing == ""
    assert live.idle
    assert live.restart(turned).ok
    assert "Nothing was found that keeps clear of fist" in live.plan(60.0).passing


def test_a_motion_that_comes_too_late_is_not_done_later_where_something_passes(cube):
    """It is clear of what passes in its own time only."""
    live = Live(cube, lead=0.1)
    drive(live, 0.05, every=None)
    away = Moving("ball", "sphere", (2.0, 0.0, 0.5), radius=0.05)
    assert live.obstacles([away]).ok
    live.plan(60.0)
    planner, late = live._planner, []

    def slow(job):
        answer = planner.answer(job)
        late.append(answer.found)
        drive(live, 0.2, every=None, begins=0.06)
        return answer

    live.goto((0.45, 0.1, 0.45))
    live.plan(60.0, slow)
    assert late[0].begins < live.now
    drive(live, 0.1, every=None, begins=0.26)
    assert live.committed.at_rest
    live.obstacles([])
    live.plan(60.0)
    drive(live, 0.02, every=None, begins=0.36)
    live.plan(60.0)
    drive(live, 0.2, every=None, begins=0.38)
    assert not live.committed.at_rest


def test_what_cannot_be_is_refused_in_a_sentence(cube):
    live = Live(cube, lead=0.1)
    for seen, sentence in (
        (Moving("x", "sphere", (0, 0, np.nan), radius=0.1), "position must be"),
        (Moving("x", "sphere", (0, 0, 0), (300, 0, 0), radius=0.1), "velocity must be .* at most 50"),
        (Moving("x", "sphere"), "type must be"),
        (Moving("x", "ring", radius=0.1), "type must be"),
        (Moving("x", "box", size=(1, 1, 0)), "type must be"),
        (Moving("x", "sphere", radius=-1), "radius must not be negative"),
        (Moving("x", "sphere", radius=0.1, growth=-1), "growth must not be negative"),
        (Moving("x", "sphere", radius=0.1, lasts=np.inf), "lasts must be"),
        (Moving("x", "sphere", radius=0.1, rotation=np.ones((3, 3))), "rotation must be orthonormal"),
        (Moving("x", "sphere", radius=0.1, samples=([1, 0], np.zeros((2, 3)))), "samples must be increasing"),
        (Moving("x", "sphere", radius=0.1, samples=([0, 1], np.zeros((3, 3)))), "samples must be increasing"),
        (Moving("x", "sphere", radius=0.1, samples=3), "samples must be times and positions"),
        (Moving("x", "sphere", radius=0.1, samples=(3, np.zeros((2, 3)))), "samples must be times and positions"),
        (Moving("x", "sphere", radius=0.1, samples=(np.array(3), 0)), "samples must be times and positions"),
        (Moving("x", "sphere", radius=0.1, samples=([[0], [1, 2]], np.zeros((2, 3)))), "samples must be increasing"),
        (Moving("x", "sphere", radius=0.1, samples=([0, 1e-3], [[0, 0, 0], [1, 0, 0]])), "more than 50 m/s .* 1e.03"),
        (
            Moving("x", "sphere", radius="big"),
            "radius must be a finite number, at most 10: the radius of the obstacle x",
        ),
        ("a ball", "a list of Moving"),
        (Moving("x", "sphere", radius=0.1, samples=([0, 2000], np.zeros((2, 3)))), "samples must be increasing"),
        (Moving("x", "sphere", radius=0.1, samples=([0, 1], np.full((2, 3), 2e3))), "samples must be increasing"),
    ):
        status = live.obstacles([seen])
        assert not status.ok
        assert re.search(sentence, status.sentence), status.sentence
    assert "a list of Moving" in live.obstacles("ball").sentence
    assert "a list of Moving" in live.obstacles(None).sentence
    assert live.idle


def test_what_is_predicted_travels_to_another_process():
    seen = Moving("x", "capsule", (1, 2, 3), radius=0.1, length=0.4, samples=([0.0, 1.0], [[0, 0, 0], [1, 0, 0]]))
    here = predicted(seen, 5.0)
    there = copy.copy(here)  # by the way that pickle goes
    t = np.linspace(4.5, 6.5, 9)
    for mine, other in zip(here.at(t), there.at(t), strict=True):
        assert np.array_equal(mine, other)
    assert (there.shape.radius, there.shape.halfLength) == (0.1, 0.2)
    p, v = here.at(np.array([4.0, 5.5, 7.0]))
    assert np.allclose(p[:, 0], [0, 0.5, 1])
    assert np.allclose(v[:, 0], [0, 1, 0])
