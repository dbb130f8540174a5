"""Obstacles that move: rows of clearance in time, evasion, and a clear word before it."""

import copy
import re
import time
from dataclasses import replace

import numpy as np
import pytest

from live_runs import drive, in_turn, rows_of
from salver.live import Live, Moving
from salver.live.committed.commit import verified
from salver.live.committed.motion import resting
from salver.live.replanning.lookout import Lookout, Sighting
from salver.live.replanning.obstacles import Movable, MovingClearance, Predicted, predicted
from salver.live.replanning.planner import Job
from salver.live.replanning.steer import TICK
from salver.live.replanning.wishes import Evade, Follow, Halt
from salver.models.arm.arm_geometry import arm_geometry
from salver.planning.fastest import evaluate, transport_problem
from salver.planning.trajopt.constraints.constraints import strayed
from salver.planning.trajopt.constraints.obstacles import CLEARANCE
from salver.planning.verdict import verify
from salver.planning.verdict.judged import STANDARD, Judged
from salver.trajectory import JointMotion

G = (0.0, 0.0, -9.81)


@pytest.fixture(scope="module")
def problem(cube):
    return Live(cube).problem


def thrown(at, seconds, come_from):
    """A ball that is at a place in so many seconds."""
    begin = np.add(at, come_from)
    velocity = np.subtract(at, begin) / seconds - 0.5 * seconds * np.array(G)
    return Moving("ball", "sphere", begin, velocity, G, radius=0.05)


def test_a_sighting_is_compared_with_the_prediction_from_now_on_alone():
    """Where a ball was foreseen for ever it rests now; before, it came from elsewhere."""
    solid, here = ("sphere", 0.05), np.array([0.3, 0.0, 0.5])
    rests = np.array([here, np.zeros(3), np.zeros(3)])
    foreseen = Predicted("ball", solid, np.eye(3), 0.0, rests, None, 0.05, 0.0, np.inf)
    for way, same in (([0.3, 0.0, 0.0], True), ([0.3, 0.04, 0.0], True), ([0.3, 0.06, 0.0], False)):
        samples = np.array([1.0, 1.9]), here + np.outer([1.0, 0.0], way) + [0.0, way[1], 0.0]
        seen = Predicted("ball", solid, np.eye(3), 2.0, rests, samples, 0.02, 0.0, 5.0)
        assert foreseen.foresaw(seen, 2.0) == same


def clearance(movable, seen, q, t):
    """Least distance, m, of postures (N, n) at live times (N,) from a predicted obstacle, beyond its uncertainty."""
    free = movable.distances(q, seen, seen.at(t)[0]).min(axis=1) - seen.around(t)
    return free[t <= seen.until].min()


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
        movable = Movable(problem.keep_out.parts)
        mine, named = movable.distances(q[None], predicted(seen, 0.0), p[None])[0], movable.names
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
    passing = MovingClearance(Movable(problem.keep_out.parts), (ball,), 2.0)
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


@pytest.mark.parametrize(("above", "kept"), [(0.13, True), (0.09, True), (0.06, False)])
def test_at_rest_what_passes_fast_is_looked_at_often_enough_to_be_known_to_miss(problem, above, kept):
    """At 3 m/s, 0.3 s after the arm has come to rest, and 6 cm, 2 cm or no way from it."""
    still, movable = resting(problem.start.q), Movable(problem.keep_out.parts.apart())
    at, v = problem.arm.tray_pose(still.q[0])[0] + np.array([0.0, 0.0, above]), np.array([0.0, 3.0, 0.0])
    ball = predicted(Moving("ball", "sphere", at - 0.3 * v, v, radius=0.03, uncertainty=0.0, growth=0.0), 0.0)
    assert (clearance(movable, ball, still.q[:1], np.arange(0.0, 0.6, 1e-3)) > 0.0) == kept
    found = verified(replace(problem, extra=(MovingClearance(movable, (ball,), 0.0),)), still, 0.0, None)
    assert (found.committed is not None) == kept
    assert kept or re.match(r"clearance of ball at rest would be [\d.]+ mm too small", found.sentence)


def test_at_rest_what_the_arm_strays_before_it_has_settled_counts(bottle):
    """Stopped in a fifth of a second it strays further than at the motion's end."""
    live = Live(bottle)
    problem = live.problem
    q = live.committed.motion.q[0] + np.array([[0.0] * 7, [0.1, -0.05, 0.05, 0.05, 0.1, 0.05, -0.1]])
    still = np.zeros((2, 7))
    judged = Judged.of(problem, JointMotion(np.array([0.0, 0.2]), q, still, still))
    off = strayed(*judged.along.tray_radius())[judged.t > 0.2 - 1e-9]
    assert off.max() > off[0] + 5e-5  # m
    movable = Movable(problem.keep_out.parts.apart())
    at = problem.arm.tray_pose(q[1])[0] + np.array([0.0, 0.0, 0.15])
    seen = predicted(Moving("ball", "sphere", at, radius=0.03, uncertainty=0.0, growth=0.0), 0.0)
    *_, rest = MovingClearance(movable, (seen,), 0.0).blocks(judged.along)
    free = movable.distances(q[1:], seen, at[None])[0] - CLEARANCE.safety - off.max()
    assert np.any(free < 0.1)
    assert -0.1 * rest.values[0][free < 0.1] == pytest.approx(free[free < 0.1], abs=1e-9)


@pytest.mark.parametrize(("there", "touch"), [(0.01, False), (0.05, True)])
def test_what_touches_between_two_instants_is_found(cube, problem, monkeypatch, there, touch):
    """There and back between two of them, towards a ball that is 2 cm away at both."""
    q, movable = problem.start.q, Movable(problem.keep_out.parts.apart())
    tray = problem.arm.tray_pose(q)[0]
    way = np.cross([0.0, 0.0, 1.0], tray) / np.hypot(*tray[:2])  # in which the first joint turns it

    def away(far):
        here = predicted(Moving("ball", "sphere", tray + far * way, radius=0.01), 0.0)
        return float(movable.distances(q[None], here, (tray + far * way)[None])[0].min())

    far = 0.2 - away(0.2) + 0.02
    ball = {"name": "ball", "type": "sphere", "radius": 0.01, "position": (tray + far * way).tolist()}
    beside = transport_problem(cube.with_changes(obstacles=[ball]))
    t, rate = np.append(np.linspace(0.0, 0.2, 5), 0.4), np.zeros((6, 7))
    rate[4, 0] = there / np.hypot(*tray[:2]) / (0.2 * 5 / 16)  # of a quintic from +rate to -rate: its height
    rate[5, 0] = -rate[4, 0]
    swing = JointMotion(t, np.tile(q, (6, 1)), rate, np.zeros((6, 7)))
    monkeypatch.setattr(verify, "CHECKS", (verify.clearance,))  # it is much too quick
    options = replace(STANDARD, step=1.0, instants=1, each=1, at_rest=np.inf)
    found = verified(replace(beside, tracking=None), swing, 0.0, None, options)
    assert found.sentence == "tray and ball would touch" * touch
    assert (found.committed is None) == touch


@pytest.mark.slow
def test_a_ball_that_would_hit_is_evaded_and_one_that_misses_is_not(cube):
    live = Live(cube, lead=0.1)
    parts, q = Movable(live.problem.keep_out.parts), live.command(0.0)[0].copy()
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
    assert clearance(parts, here, q[None], t[::5]) < -0.05  # it would hit
    states = drive(live, 1.5)
    assert live.state.passing == ""
    assert clearance(parts, here, states[0][::5], t[::5]) > 0.0
    assert max(rows_of(live.problem, states).values()) <= 0.0


def test_when_it_is_too_late_that_is_said_and_the_load_is_kept(cube):
    live = Live(cube, lead=0.1)
    states = drive(live, 0.4, [(0.0, lambda live: live.goto((0.45, 0.1, 0.45)))])
    p = live.problem.arm.tray_pose(states[0][-1])[0]
    live.obstacles([Moving("fist", "box", p + np.array([0.2, 0, 0]), (-3.0, 0, 0), size=(0.2, 0.2, 0.2), lasts=0.5)])
    live.plan(60.0)
    assert live.state.passing.startswith("fist comes too near")
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
    assert live.plan(60.0).passing.startswith("fist comes too near")


@pytest.mark.parametrize("comes", [False, True])
def test_a_motion_that_comes_too_late_is_done_later_only_where_it_keeps_clear_then(cube, comes):
    """Of what stands still far away it does later too; a ball would have been gone, had it begun in time."""
    live = Live(cube, lead=0.1)
    drive(live, 0.05, every=None)
    v = np.array([0.0, -2.0, 0.0]) if comes else np.zeros(3)
    p = live.problem.arm.tray_pose(live.problem.start.q)[0] + np.array([0.0, 0.0, 0.1])
    begin = p - 0.9 * v if comes else np.array([2.0, 0.0, 0.5])
    assert live.obstacles([Moving("ball", "sphere", begin, v, radius=0.05, uncertainty=0.0, growth=0.0)]).ok
    planner, late = live._planner, []

    def slow(job):
        answer = planner.answer(job)
        late.append(answer.found)
        drive(live, 0.6 if comes else 0.2, every=None, begins=0.06)
        return answer

    live.goto((0.45, 0.1, 0.45))
    live.plan(60.0, slow)
    assert late[0].begins < live.now
    drive(live, 0.1, every=None, begins=0.7)
    assert live.committed.at_rest == comes


def test_a_goal_is_reached_from_rest_by_a_machine_that_plans_and_judges_slowly(cube, monkeypatch):
    """Planning takes longer than the longest lead, so each motion comes late; a verdict takes 0.12 s."""
    live = Live(cube)
    live.command(0.0)

    def lasting(seconds):
        end = live.now + seconds
        while live.now < end:
            live.command(live.now + 1e-3)

    def slow(job):
        answer = live._planner.answer(job)
        lasting(1.5)
        return answer

    def judged(*given, **named):
        begun, found = time.perf_counter(), verified(*given, **named)
        time.sleep(max(0.0, 0.12 + begun - time.perf_counter()))
        lasting(0.12)
        return found

    monkeypatch.setattr("salver.live.live.verified", judged)
    live.goto((0.45, 0.1, 0.45))
    for _ in range(3):
        live.plan(60.0, slow)
        lasting(0.3)
        if not live.committed.at_rest:
            break
    assert live.state.requests[0].outcome == "followed"


def going(cube, **given):
    """A live motion on its way to a goal, and the ball that hits it there 0.6 s later."""
    live = Live(cube, **given)
    drive(live, 0.2, [(0.0, lambda live: live.goto((0.45, 0.1, 0.45)))])
    at = live.problem.arm.tray_pose(live.committed.state(live.now + 0.6)[0])[0]
    return live, thrown(at, 0.6, (1.5, 0.3, 0.2))


@pytest.mark.slow
def test_the_rest_of_a_chunk_is_followed_after_an_evasion(cube):
    """It ended with the evasion, in silence."""
    live = Live(cube, lead=2 * TICK)
    q0, times = live.problem.start.q, np.arange(0.05, 2.4, 0.05)
    q = q0 + np.outer(0.2 * (1.0 - np.cos(np.pi * times / 1.2)) + 0.05 * times, np.eye(7)[0])
    drive(live, 0.5, [(0.0, lambda live: live.chunk(times, joints=q))])
    p = live.problem.arm.tray_pose(live.committed.state(live.now)[0])[0] + [0.0, 0.0, 0.08]
    assert live.obstacles(
        [Moving("ball", "sphere", np.add(p, (1.05, 0.0, 0.0)), (-1.5, 0, 0), radius=0.05, lasts=0.9)]
    ).ok
    assert live.state.passing
    drive(live, 1.8, begins=0.5)
    assert isinstance(live._running.wish, Follow)
    now = live.command(2.301)[0]
    assert np.abs(now[0] - np.interp(live.now, times, q[:, 0])) < 0.01
    drive(live, 1.4, begins=2.302)
    assert live.state.requests[0].outcome == "reached"


def test_however_fast_planning_is_one_tick_of_an_evasion_is_taken_for_each_hand_over(cube):
    """With several from the same state, fewer obstacles are evaded."""
    live, ball = going(cube, lead=TICK)
    assert live.obstacles([ball]).ok
    begins = []

    def noted(job):
        answer = live._planner.answer(job)
        begins.extend([] if answer.found is None else [answer.found.begins])
        return answer

    for k in range(100):
        live.command(0.2 + 1e-3 * k)
        if not live.idle:
            live.plan(60.0, noted)
    assert 3 <= len(begins) <= 6
    assert len(set(begins)) == len(begins)


def test_what_comes_is_announced_at_once_whatever_planning_does(cube):
    """Nobody plans here at all. Nothing is announced of what misses, nor before, nor of what is gone."""
    live, ball = going(cube, lead=0.1)
    assert live.state.passing == ""
    begun = time.thread_time()
    assert live.obstacles([ball]).ok
    assert time.thread_time() - begun < 0.05  # s; 2 ms on a quiet machine
    assert re.fullmatch(r"ball comes too near to the \w+ at 0\.\d\d s\.", live.state.passing)
    drive(live, 0.3, every=None, begins=0.2)
    assert live.state.passing
    away = replace(ball, position=np.add(ball.position, [0.0, 0.0, 4.0]))
    assert live.obstacles([away]).ok
    assert live.state.passing == ""


def test_what_was_planned_for_another_world_is_not_committed(cube):
    """A ball is seen while a goal is planned: the motion there would go through it."""
    live = Live(cube, lead=0.1)
    drive(live, 0.05, every=None)
    planner, jobs = live._planner, []

    def meanwhile(job):
        answer = planner.answer(job)
        jobs.append(job.wish)
        end = live.problem.arm.tray_pose(answer.found.motion.q[-1])[0] + np.array([0.0, 0.0, 0.06])
        assert live.obstacles([Moving("fist", "sphere", end, radius=0.03, growth=0.0)]).ok
        return answer

    live.goto((0.45, 0.1, 0.45))
    live.plan(60.0, meanwhile)
    drive(live, 0.3, every=None, begins=0.05)
    assert [type(wish).__name__ for wish in jobs] == ["Goal"]
    assert live.committed.at_rest
    assert live.state.passing == ""
    assert not live.idle  # it is planned again


def test_what_comes_after_it_was_planned_and_before_it_is_handed_over_counts_too(cube):
    live = Live(cube, lead=0.1)
    drive(live, 0.05, every=None)
    live.goto((0.45, 0.1, 0.45))
    live.plan(60.0)
    end = live.problem.arm.tray_pose(live._offer.committed.motion.q[-1])[0] + np.array([0.0, 0.0, 0.06])
    live.obstacles([Moving("fist", "sphere", end, radius=0.03, growth=0.0)])
    drive(live, 0.3, every=None, begins=0.05)
    assert live.committed.at_rest
    live.obstacles([Moving("fist", "sphere", end + np.array([0, 0, 3.0]), radius=0.03, growth=0.0)])
    live.plan(60.0)
    drive(live, 0.2, every=None, begins=0.35)
    assert not live.committed.at_rest


@pytest.mark.slow
def test_looking_out_finds_what_a_fine_scan_of_time_finds(cube, monkeypatch):
    """Balls from everywhere at a moving arm, against distances at every two milliseconds; of few postures."""
    looks, distance = [], Movable.distance
    monkeypatch.setattr(Movable, "distance", lambda *given: looks.append(given) or distance(*given))
    live, _ = going(cube, lead=0.1)
    rng, counts = np.random.default_rng(4), [0, 0]
    path, lookout, movable = live._running.looked, Lookout(live.problem), Movable(live.problem.keep_out.parts.apart())
    assert path.ends - live.now > 0.3
    t = np.arange(live.now, live.now + 1.2, 2e-3)
    q = path.motion.sample(np.clip(t - path.since, 0.0, path.motion.duration))[0]
    for _ in range(30):
        at = live.problem.arm.tray_pose(path.motion.sample([rng.uniform(0, 0.8)])[0][0])[0] + rng.normal(0, 0.15, 3)
        begin, seconds = at + rng.normal(0, 0.8, 3), rng.uniform(0.2, 1.0)
        seen = Moving("ball", "sphere", begin, (at - begin) / seconds, radius=0.04, lasts=1.2, growth=0.05)
        ball = predicted(seen, live.now)
        near = lookout.outlook(path, Sighting((ball,)), live.now).near
        free = (
            movable.distances(q, ball, ball.at(t)[0]).min(axis=1) - ball.around(t) - path.off_at(t) - CLEARANCE.safety
        )
        first = t[int(np.argmax(free <= 0.0))]
        counts[bool(near)] += 1
        if near:
            assert free.min() < 0.01  # m: both go up to 10 m/s, half a step each
            assert near[0].t <= first + 2e-3 or free.min() > 0.0
        else:
            assert free.min() > 0.0
    assert min(counts) > 5
    assert 30 < len(looks) < 30 * 30


def test_an_obstacle_is_where_it_was_seen_when_it_was_seen(cube):
    """Reported 0.2 s late, it has flown on meanwhile."""
    live = Live(cube, lead=0.1)
    drive(live, 0.3, every=None, begins=7.0)  # the loop has a clock of its own
    late = Moving("x", "sphere", (3.0, 0, 0.5), (-2.0, 0, 0), radius=0.05, seen=7.099, lasts=1.0)
    assert live.obstacles([late]).ok
    (here,) = live._sighting.obstacles
    assert here.at(np.array([live.now]))[0][0, 0] == pytest.approx(3.0 - 2.0 * 0.2, abs=1e-9)
    assert here.until == pytest.approx(live.now + 0.8)
    sentence = live.obstacles([replace(late, seen=9.0)]).sentence
    assert "seen of the obstacle x must not be later than the loop's clock (it is by 1.7 s)" in sentence
    assert "each obstacle must have a name of its own" in live.obstacles([late, late]).sentence


def test_evasion_begins_as_soon_as_a_tick_can_be_planned_and_goes_on_tick_by_tick(cube, monkeypatch):
    """A tick takes 0.08 s here. The first comes too late, and is done from rest a little later; the next ones are
    handed over as much later. The lead of goals stays."""
    live, leads = Live(cube), []
    live.command(0.0)
    planner = live._planner
    monkeypatch.setattr(time, "perf_counter", lambda: live.now)

    def slow(job):
        leads.append(job.begins - job.now)
        answer = planner.answer(job)
        drive(live, 0.08, every=None, begins=live.now)
        return answer

    p = live.problem.arm.tray_pose(live.command(0.0)[0])[0]
    ball = thrown(p + np.array([0.0, 0.0, 0.06]), 1.2, (0.4, -1.7, 0.2))
    assert live.obstacles([replace(ball, growth=0.02, lasts=1.4)]).ok
    for _ in range(12):
        live.plan(1.0, slow)
        drive(live, 0.002, every=None, begins=live.now)
    assert leads[0] == pytest.approx(0.05, abs=0.011)
    assert 2 < len(leads) < 12
    assert all(1.3 * 0.08 - 1e-9 <= lead <= 1.3 * 0.08 + TICK for lead in leads[1:])
    assert live.state.passing == ""
    assert not live.committed.at_rest
    assert live._lead.of("motion") == 0.25


@pytest.mark.parametrize("come_from", [(1.2, 0.0, 0.0), (0.0, -1.2, 0.2), (-0.9, 0.9, 0.4)])
def test_the_first_tick_of_an_evasion_passes_the_verdict(cube, come_from):
    """Of an arm that rests: a large first increment violates constraints by which it is shortened too late."""
    live = Live(cube, lead=0.1)
    live.command(0.0)
    tray = live.problem.arm.tray_pose(live.problem.start.q)[0]
    assert live.obstacles([thrown(tray, 0.5, come_from)]).ok
    job = Job(Evade(), live.committed, 0.02, 1.0, live._sighting.obstacles, live._running.outlook.near)
    found = live._planner.answer(job).found
    assert found is not None
    assert not found.at_rest


@pytest.mark.parametrize("aside", [(0.0, -0.13, 0.0), (0.0, 0.0, 0.08)])
def test_what_comes_is_evaded_to_the_nearer_side(cube, aside):
    """A ball that comes along x, to one side of the tray's middle or above it: the other way is the shorter one,
    whichever way the ball is described."""
    live = Live(cube, lead=0.1)
    live.command(0.0)
    q, planner = live.problem.start.q, live._planner
    p, at = live.problem.arm.tray_pose(q)[0] + np.array(aside), 0.6
    begin, v = p + np.array([1.2, 0.0, 0.0]), np.array([-2.0, 0.0, 0.0])
    times = np.linspace(0.0, 1.4, 15)
    for how in ({"velocity": v}, {"samples": (times, begin + times[:, None] * v)}):
        assert live.obstacles([Moving("ball", "sphere", begin, radius=0.04, uncertainty=0.0, growth=0.0, **how)]).ok
        (near,) = live._running.outlook.near
        assert near.t == pytest.approx(at, abs=0.15)
        job = Job(Evade(), live.committed, 0.02, 1.0, live._sighting.obstacles, (near,))
        way = planner._shortest_aside(job, near)
        assert way @ aside < -0.99 * np.linalg.norm(aside)


def test_what_is_thrown_once_more_is_evaded_anew(cube):
    """First above the tray and then below it, by the same name. As long as it is the same throw the way stays."""
    live = Live(cube, lead=0.1)
    live.command(0.0)
    tray, v, ways = live.problem.arm.tray_pose(live.problem.start.q)[0], np.array([-2.0, 0.0, 0.0]), []
    for above, seconds in ((0.08, 0.6), (-0.12, 0.65), (-0.12, 1.4)):
        begin = tray + np.array([0.0, 0.0, above]) - seconds * v
        ball = Moving("ball", "sphere", begin, v, radius=0.04, uncertainty=0.0, growth=0.0, lasts=2.0)
        assert live.obstacles([ball]).ok
        near = live._running.outlook.near
        live._planner.answer(Job(Evade(), live.committed, 0.02, 1.0, live._sighting.obstacles, near))
        ways.append(live._planner._aside.way)
    assert ways[0] @ [0, 0, 1] < -0.99
    assert ways[1] is ways[0]
    assert ways[2] @ [0, 0, 1] > -0.5


def test_while_a_stop_is_latched_what_comes_is_announced_and_not_evaded(cube):
    live, jobs = Live(cube, lead=0.1), []
    live.command(0.0)
    planner = live._planner

    def noted(job):
        jobs.append(type(job.wish).__name__)
        return planner.answer(job)

    ball = thrown(live.problem.arm.tray_pose(live.problem.start.q)[0] + [0.0, 0.0, 0.06], 1.2, (0.4, -1.7, 0.2))
    assert live.stop("enough").ok
    assert live.obstacles([ball]).ok
    live.plan(60.0, noted)
    assert jobs == []
    assert live.state.passing.startswith("ball comes too near")
    live.resume()
    live.plan(60.0, noted)
    assert jobs == ["Evade"]


@pytest.mark.slow
def test_a_stop_is_made_where_neither_it_nor_going_on_keeps_clear_of_an_obstacle(cube):
    """A ball hangs above the load, on its way; the stop was refused, and the arm went on for 7 s."""
    live = Live(cube, lead=0.1)
    live.override(0.1)
    drive(live, 0.4, [(0.0, lambda live: live.goto((0.45, 0.15, 0.45)))])
    p = live.problem.arm.tray_pose(live.committed.state(live.now)[0])[0]
    live.obstacles([Moving("ball", "sphere", np.add(p, [0.0, 0.0, 0.1]), radius=0.08)])
    assert live.committed.ends > live.now + 5.0
    keeps_clear = Job(Halt(), live.committed, live.now + 0.1, 60.0, live._sighting.obstacles)
    assert live._planner.answer(keeps_clear).found is None  # then going on is better
    live.stop("it hangs there")
    states = drive(live, 0.5, begins=0.4)
    assert not np.any(states.dq[-1])
    assert max(rows_of(live.problem, states).values()) <= 0.0  # the load stays
    assert live.state.passing.startswith("ball comes too near")


@pytest.mark.slow
def test_after_an_evasion_on_its_way_the_arm_goes_on_to_its_goal(cube):
    live = Live(cube, lead=0.1)
    drive(live, 0.2, [(0.0, lambda live: live.goto((0.45, 0.1, 0.45)))])
    at, goal = live.problem.arm.tray_pose(live.committed.state(live.now + 0.35)[0])[0], live.committed.motion.q[-1]
    ball = thrown(np.add(at, [0.0, 0.0, 0.06]), 0.35, (1.5, 0.3, 0.2))
    assert live.obstacles([replace(ball, growth=0.02, lasts=0.5)]).ok
    assert live.state.passing
    drive(live, 0.3, begins=0.2)
    assert isinstance(live._running.wish, Evade)
    told = drive(live, 2.5, begins=0.5)
    assert live.settled
    there = live.problem.arm.tray_pose(told[0][-1])[0]
    assert there == pytest.approx(live.problem.arm.tray_pose(goal)[0], abs=1e-3)


@pytest.mark.slow
def test_what_stands_still_and_is_reported_a_hundred_times_a_second_takes_no_planning(cube):
    """Neither do twenty things that stand still; ticks go on."""
    live, jobs = Live(cube, lead=0.02), []
    planner = live._planner

    def noted(job):
        jobs.append(type(job.wish).__name__)
        return planner.answer(job)

    rng = np.random.default_rng(3)
    places = [rng.uniform(-1, 1, 3) * [1, 1, 0.3] + [0.0, 0.0, 2.2] for _ in range(20)]
    for k in range(20):
        live.command(0.01 * k)
        noise = rng.normal(0, 1e-3, (20, 3))
        boxes = [
            Moving(f"box {i}", "box", p + x, size=(0.1, 0.1, 0.1), seen=0.01 * k)
            for i, (p, x) in enumerate(zip(places, noise, strict=True))
        ]
        assert live.obstacles(boxes).ok
        live.twist((0.05, 0.05, 0.0))
        live.plan(60.0, noted)
    assert live._sighting.news == 1
    assert set(jobs) == {"Follow"}
    assert not live.committed.at_rest


def test_what_cannot_be_is_refused_in_a_sentence(cube):
    live = Live(cube, lead=0.1)
    for seen, sentence in (
        (Moving("x", "sphere", (0, 0, np.nan), radius=0.1), "position of the obstacle x must be"),
        (
            Moving("x", "sphere", (0, 0, 0), (300, 0, 0), radius=0.1),
            "velocity of the obstacle x must be 3 finite numbers, at most 50",
        ),
        (Moving("x", "sphere"), "type of the obstacle x must be"),
        (Moving("x", "ring", radius=0.1), "type of the obstacle x must be"),
        (Moving("x", np.array(["box", "box"]), size=(1, 1, 1)), "type of the obstacle x must be"),
        (Moving("x", "box", size=(1, 1, 0)), "type of the obstacle x must be"),
        (Moving("x", "sphere", radius=-1), "radius of the obstacle x must not be negative"),
        (Moving("x", "sphere", radius=0.1, growth=-1), "growth of the obstacle x must not be negative"),
        (Moving("x", "sphere", radius=0.1, lasts=np.inf), "lasts of the obstacle x must be"),
        (Moving("x", "sphere", radius=0.1, rotation=np.ones((3, 3))), "rotation of the obstacle x must be orthonormal"),
        (
            Moving("x", "sphere", radius=0.1, samples=([1, 0], np.zeros((2, 3)))),
            "samples of the obstacle x must be increasing",
        ),
        (
            Moving("x", "sphere", radius=0.1, samples=([0, 1], np.zeros((3, 3)))),
            "samples of the obstacle x must be increasing",
        ),
        (Moving("x", "sphere", radius=0.1, samples=3), "samples of the obstacle x must be times and positions"),
        (
            Moving("x", "sphere", radius=0.1, samples=(3, np.zeros((2, 3)))),
            "samples of the obstacle x must be times and positions",
        ),
        (
            Moving("x", "sphere", radius=0.1, samples=(np.array(3), 0)),
            "samples of the obstacle x must be times and positions",
        ),
        (
            Moving("x", "sphere", radius=0.1, samples=([[0], [1, 2]], np.zeros((2, 3)))),
            "samples of the obstacle x must be increasing",
        ),
        (Moving("x", "sphere", radius=0.1, samples=([0, 1e-3], [[0, 0, 0], [1, 0, 0]])), "more than 50 m/s .* 1e.03"),
        (
            Moving("x", "sphere", radius="big"),
            "radius of the obstacle x must be a finite number, at most 10",
        ),
        ("a ball", "a list of Moving"),
        (
            Moving("x", "sphere", radius=0.1, samples=([0, 2000], np.zeros((2, 3)))),
            "samples of the obstacle x must be increasing",
        ),
        (
            Moving("x", "sphere", radius=0.1, samples=([0, 1], np.full((2, 3), 2e3))),
            "samples of the obstacle x must be increasing",
        ),
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


def test_between_samples_what_moves_goes_straight_and_evenly():
    """A metre a second along x, then two along y, then at rest; seen now, at 3 s of the clock."""
    samples = ([0.0, 1.0, 2.0], [[0, 0, 0], [1, 0, 0], [1, 2, 0]])
    ball = predicted(Moving("ball", "sphere", radius=0.1, samples=samples), 3.0)
    where, speed = ball.at(3.0 + np.array([0.25, 1.5, 2.5]))
    np.testing.assert_allclose(where, [[0.25, 0, 0], [1, 1, 0], [1, 2, 0]], atol=1e-12)
    np.testing.assert_allclose(speed, [[1, 0, 0], [0, 2, 0], [0, 0, 0]], atol=1e-12)


def test_what_is_put_in_the_way_stays_there_until_it_is_removed(cube, problem):
    """Longer than any prediction lasts, and beside what moves."""
    live = Live(cube, lead=TICK)
    drive(live, 0.01)
    p = problem.arm.tray_pose(problem.start.q)[0]
    crate = Moving("crate", "box", np.add(p, (0.3, 0.1, 0.0)), size=(0.1, 0.2, 0.1))
    assert live.put(replace(crate, growth=0.2)).ok  # what stands does not become less sure
    assert live.obstacles([]).ok
    live.goto(tuple(np.add(p, (0.3, 0.1, 0.05))))
    drive(live, 2.0, begins=0.01)
    assert live.obstacles([]).ok
    assert not live.state.passing
    assert np.array_equal(live.committed.motion.q[-1], problem.start.q)  # it cannot go there
    assert live.put(Moving("crate", "box", np.add(p, (0.0, 0.0, 0.05)), size=(0.1, 0.2, 0.1))).ok
    assert live.state.passing.startswith("crate comes too near to the")
    assert live.remove("crate").ok
    assert not live.state.passing
    live.goto(tuple(np.add(p, (0.1, 0.1, 0.05))))
    drive(live, 1.5, begins=2.01)
    assert live.state.requests[-1].outcome == "reached"
    for refused, why in (
        (lambda: live.remove("crate"), "there is no 'crate'; there are none"),
        (lambda: live.put(thrown(p, 1.0, (0, 1, 0))), "must stand still"),
        (lambda: live.put("crate"), "it must be a Moving"),
        (lambda: live.put(replace(crate, name=["crate"])), "its name must be text, not"),
        (lambda: live.put(replace(crate, name=(["crate"],))), "its name must be text, not"),
        (lambda: live.obstacles([replace(crate, name=["crate"])]), "its name must be text, not"),
        (lambda: live.obstacles([replace(crate, name=(np.zeros(2),))]), "its name must be text, not"),
        (lambda: live.remove(["crate"]), "there are none"),
        (lambda: live.remove(np.array(["crate", "box"])), "there are none"),
        (lambda: live.obstacles([crate, crate]), "another one is 'crate'"),
    ):
        status = refused()
        assert not status.ok
        assert why in status.sentence
    live.put(crate)
    assert "another one is 'crate'" in live.obstacles([crate]).sentence
    assert live.obstacles([replace(crate, name="ball")]).ok
    assert "another one is 'ball'" in live.put(replace(crate, name="ball")).sentence
    assert "there is no \"['crate' 'box']\"; there are crate" in live.remove(np.array(["crate", "box"])).sentence


def test_a_policy_changes_only_the_obstacles_that_a_policy_put(cube):
    live = Live(cube)
    crate, post = (Moving(name, "box", (0.2, 0.9, 0.2), size=(0.1, 0.1, 0.1)) for name in ("crate", "post"))
    live.stop("the cell is changed")  # which is no request to move
    assert live.put(crate).ok
    assert live.put(post, source="policy").ok
    assert "crate was put there by the operator" in live.remove("crate", source="policy").sentence
    assert (
        "crate was put there by the operator" in live.put(replace(crate, position=(2, 2, 2)), source="policy").sentence
    )
    assert "source is 'nobody'; it must be one of" in live.put(post, source="nobody").sentence
    assert live.remove("post", source="policy").ok
    assert live.remove("crate").ok
