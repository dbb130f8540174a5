"""The speed override of a live motion, and a hold, after which what was requested is gone on with."""

from dataclasses import replace

import numpy as np
import pytest

import salver as sv
from live_runs import LEAD, PATIENCE, check, drive, executed, in_turn, place
from salver.campaigns.summary import DROPPED, LARGEST_SLIP
from salver.errors import Status
from salver.live import Live, Moving
from salver.live.committed.profile import SpeedProfile
from salver.live.committed.seal import sealed
from salver.live.replanning.planner import Answer, Job, Planner
from salver.live.replanning.wishes import Halt, Retime
from salver.live.script import Prompter, script
from salver.planning.fastest import joint_plan

FIRST, SECOND = (0.45, 0.1, 0.45), (0.55, -0.2, 0.45)


def override(factor, **more):
    return lambda live: live.override(factor, **more)


def hold(live):
    return live.hold()


def release(live):
    return live.release()


def where(live):
    """Of the first object, m."""
    body = live.problem.items[0]
    return live.problem.arm.object_pose(live._reader.q, body.p_EB, body.R_EB)[0]


@pytest.fixture(scope="module")
def full(cube):
    """From rest to the first goal, at full speed."""
    live = Live(cube, lead=LEAD)
    told = drive(live, 0.2, [(0.0, place(*FIRST))])
    return live.committed, in_turn(told, drive(live, 1.0, begins=0.2))


def test_a_goal_is_gone_to_at_a_share_of_the_speed_along_the_same_path(cube, full):
    live = Live(cube, lead=LEAD)
    assert live.override(0.4).ok
    told = drive(live, 0.2, [(0.0, place(*FIRST))])
    fast, slow = full[0].motion, live.committed.motion
    assert "40 % of full speed" in str(live.state)
    told = in_turn(told, drive(live, slow.duration + 0.3, begins=0.2))
    assert slow.duration == pytest.approx(fast.duration / 0.4, rel=1e-6)
    u = np.linspace(0.0, fast.duration, 50)
    for order, (q, same) in enumerate(zip(slow.sample(u / 0.4), fast.sample(u), strict=True)):
        np.testing.assert_allclose(q, 0.4**order * same, atol=1e-6)
    np.testing.assert_allclose(where(live), FIRST, atol=1e-4)
    check(live, told)


@pytest.mark.parametrize(
    ("factor", "to", "at"),
    [
        (0.8, 0.3, 0.3),
        pytest.param(0.3, 1.0, 0.45, marks=pytest.mark.slow),
        pytest.param(0.1, 0.5, 1.5, marks=pytest.mark.slow),
    ],
)
def test_the_speed_changes_on_the_way_and_every_limit_is_kept(cube, full, factor, to, at):
    """On the path of full speed, that is; and no sooner or later than the factors say."""
    live, fast = Live(cube, lead=LEAD), full[0].motion
    told = drive(live, 8.0, [(0.0, override(factor)), (0.0, place(*FIRST)), (at, override(to))])
    run = live.committed.run
    assert (run.factor, run.to) == (factor, to)
    check(live, told)
    np.testing.assert_allclose(where(live), FIRST, atol=1e-4)
    path = fast.sample(np.linspace(0.0, fast.duration, 2000))[0]
    off = np.abs(told.q[::25, None] - path).max(axis=2).min(axis=1)
    assert off.max() < 2e-3  # rad: half of the way from one of these postures to the next, at the most
    u, there, _ = run.along(np.array([run.within]))
    assert there[0] == pytest.approx(to)
    ends = run.begins + run.within + (fast.duration - u[0]) / to
    assert live.committed.ends == pytest.approx(ends, abs=1e-6)


def test_a_speed_that_is_none_is_refused_in_a_sentence(cube):
    live = Live(cube, lead=LEAD)
    for wrong in (-0.1, 0.0, 0.01, 1.2, np.nan, np.inf, "0.5", "half", None, True, [0.5], 10**400, 1j):
        said = live.override(wrong)
        assert not said.ok
        assert said.sentence.startswith("The override is refused: factor is ")
        assert said.sentence.endswith("it must be a number from 0.05 to 1; call hold() to stop.")
    assert live.state.speed == ""


@pytest.mark.parametrize("at", [pytest.param(0.25, marks=pytest.mark.slow), 0.35])
def test_a_hold_brings_the_arm_to_rest_and_what_was_requested_is_gone_on_with(cube, at):
    live = Live(cube, lead=LEAD)
    wishes = [(0.0, place(*FIRST)), (0.0, lambda live: live.goto(SECOND, queued=True)), (at, hold)]
    told = drive(live, 1.5, wishes)
    assert not np.any(told.dq[-500:])
    assert live.state.doing == "resting"
    assert str(live.state).endswith("Held by the operator.")
    assert np.abs(where(live) - FIRST).max() > 0.01
    after = drive(live, 2.5, [(0.0, release)], begins=1.5)
    body = live.problem.items[0]
    passed = np.array([live.problem.arm.object_pose(q, body.p_EB, body.R_EB)[0] for q in after.q[::10]])
    assert np.abs(passed - FIRST).max(axis=1).min() < 1e-4  # before what was queued
    np.testing.assert_allclose(where(live), SECOND, atol=1e-4)
    assert live.state.speed == ""
    assert live.settled
    check(live, in_turn(told, after))


def test_nothing_begins_that_was_planned_while_the_arm_was_held(cube):
    live = Live(cube, lead=LEAD)
    assert live.goto(FIRST).ok
    planner = live._planner

    def held_meanwhile(job):
        answer = planner.answer(job)
        assert live.hold().ok
        return answer

    live.command(0.0)
    live.plan(PATIENCE, held_meanwhile)
    assert live._offer is not None
    told = drive(live, 0.6, [(0.3, place(*SECOND))], begins=0.001)
    assert not np.any(told.dq)
    assert np.any(drive(live, 0.5, [(0.0, release)], begins=0.601).dq)
    drive(live, 1.0, begins=1.101)
    np.testing.assert_allclose(where(live), SECOND, atol=1e-4)  # what was requested last


@pytest.mark.slow
def test_a_stop_that_is_ready_is_taken_by_a_hold(cube):
    live = Live(cube, lead=LEAD)
    drive(live, 0.2, [(0.0, place(*FIRST))])
    while live.prepare(PATIENCE):
        pass
    before = live.committed
    assert live.hold().ok
    drive(live, 0.002, every=None, begins=0.2)
    assert live.committed is not before
    assert live.committed.ends < before.ends


def test_after_a_stop_nothing_is_gone_on_with(cube):
    live = Live(cube, lead=LEAD)
    told = drive(live, 0.8, [(0.0, place(*FIRST)), (0.3, hold), (0.4, lambda live: live.stop("a hand"))])
    said = live.release()
    assert not said.ok
    assert said.sentence == (
        "To release is refused: the arm was stopped by the operator (a hand); call resume() first."
    )
    assert not live.override(0.5).ok
    assert live.resume().ok
    told = in_turn(told, drive(live, 0.3, [(0.0, release)], begins=0.8))
    assert live.state.speed == ""
    assert not np.any(told.dq[-300:])
    check(live, told)


@pytest.mark.slow
def test_a_stop_while_it_slows_down_is_a_stop(cube):
    live = Live(cube, lead=LEAD)
    wishes = [(0.0, override(0.8)), (0.0, place(*FIRST)), (0.3, override(0.3)), (0.45, lambda live: live.stop())]
    told = drive(live, 1.5, wishes)
    assert live.state.doing == "resting"
    assert not np.any(told.dq[-500:])
    check(live, told)


@pytest.mark.parametrize("factor", [pytest.param(0.15, marks=pytest.mark.slow), 0.3])
def test_a_slow_motion_stops_on_its_path_at_once(cube, full, factor):
    """Where a search for another stop takes half a second, and finds none at the lowest speeds."""
    live = Live(cube, lead=LEAD)
    live.override(factor)
    path = full[0].motion.sample(np.linspace(0.0, full[0].motion.duration, 2000))[0]
    told = drive(live, 1.3, [(0.0, place(*FIRST)), (0.8, hold)])
    assert live.committed.ends < 0.8 + LEAD + 0.3
    assert np.abs(told.q[-1] - path).max(axis=1).min() < 2e-3  # rad
    told = in_turn(told, drive(live, 6.0, [(0.0, release)], begins=1.3))
    np.testing.assert_allclose(where(live), FIRST, atol=1e-4)
    check(live, told)


@pytest.mark.slow
def test_a_slow_motion_that_was_steered_stops_at_once():
    """It ends 6 s later, so the search for a stop from there finds none; the arm went on for all of them."""
    live = Live("ur10-bottle", lead=0.1)
    live.override(0.1)

    def commanded(since, until):
        for k in range(round(1e3 * since), round(1e3 * until)):
            state = np.stack(live.command(1e-3 * k))
            if k % 20 == 0:
                live.plan(60.0)
        return state

    commanded(0.0, 0.13)
    assert live.goto([0.85, -0.09, 0.555]).ok
    commanded(0.13, 0.33)
    assert live.jog(np.array([-0.2, 0.6, 0.1, 0.2, -0.6, 0.8])).ok
    commanded(0.33, 0.53)
    assert live.committed.ends > 5.0
    live.stop("now")
    np.testing.assert_array_equal(commanded(0.53, 1.1)[1], 0.0)


def test_a_policy_neither_releases_nor_hurries_what_the_operator_slowed(cube):
    live = Live(cube, lead=LEAD)
    assert live.override(0.5).ok
    assert live.override(0.2, source="policy").ok
    assert live.override(0.5, source="policy").ok
    assert live.override(0.6, source="policy").sentence == "The override is refused: the operator allows 0.5 at most."
    assert live.hold(source="policy").ok
    assert live.release(source="policy").ok
    assert live.hold(source="policy").ok
    assert live.hold().ok
    assert live.release(source="policy").sentence == "To release is refused: the operator holds the arm."
    assert not live.release(source="nobody").ok
    assert live.release().ok


@pytest.mark.slow
def test_a_goal_that_comes_while_it_is_too_fast_is_begun_at_rest(cube):
    live = Live(cube, lead=LEAD)
    told = drive(live, 0.4, [(0.0, place(*FIRST))])
    fast = live.committed
    told = in_turn(told, drive(live, 0.6, [(0.0, override(0.2)), (0.0, place(*SECOND))], begins=0.4))
    assert live.committed.begins == pytest.approx(fast.ends, abs=1e-6)
    assert live.committed.run.to == 0.2
    told = in_turn(told, drive(live, live.committed.motion.duration, begins=1.0))
    np.testing.assert_allclose(where(live), SECOND, atol=1e-4)
    check(live, told)


@pytest.mark.slow
def test_a_twist_is_slower_by_as_much(cube):
    live = Live(cube, lead=LEAD)
    live.override(0.5)
    told = drive(live, 0.6, [(0.01 * k, lambda live: live.twist((0.2, 0.0, 0.0))) for k in range(60)])
    assert where_speed(live, told, 0.5) == pytest.approx(0.1, rel=0.05)


@pytest.mark.slow
def test_a_chunk_is_slower_by_as_much(cube):
    live = Live(cube, lead=LEAD)
    live.override(0.5)
    live.command(0.0)
    p = where(live)
    drive(live, 0.7, [(0.0, lambda live: live.chunk([0.1, 0.6], [p, p + np.array([0.1, 0.0, 0.0])]))], begins=0.001)
    assert where(live)[0] - p[0] == pytest.approx(0.05, abs=0.005)  # half of it, in half of 1.2 s, and 0.1 s


@pytest.mark.slow
def test_a_chunk_that_was_held_is_followed_with_what_is_left_of_it(cube):
    """There and back: it is held on its way there."""
    live = Live(cube, lead=LEAD)
    live.command(0.0)
    p, there = where(live), np.array([0.1, 0.0, 0.0])
    chunk = [(0.0, lambda live: live.chunk([0.1, 0.6, 1.1], [p, p + there, p]))]
    told = drive(live, 1.5, [*chunk, (0.2, hold)], begins=0.001)
    assert 0.02 < where(live)[0] - p[0] < 0.07
    told = in_turn(told, drive(live, 0.4, [(0.0, release)], begins=1.501))
    assert where(live)[0] - p[0] > 0.08
    told = in_turn(told, drive(live, 1.5, begins=1.901))
    np.testing.assert_allclose(where(live), p, atol=2e-3)
    check(live, told)


def where_speed(live, told, t):
    """m/s of the tray at a time."""
    motion = executed(told)
    q, dq, _ = motion.sample(t)
    return float(np.linalg.norm((live.problem.arm.body_jacobian(q[0]) @ dq[0])[:3]))


@pytest.mark.slow
def test_a_slower_motion_is_not_taken_where_it_would_meet_what_passes(cube):
    """A ball crosses the path where the arm would be if it went slower, and long after it is gone as it goes."""
    live = Live(cube, lead=LEAD)
    live.override(0.6)
    drive(live, 0.3, [(0.0, place(*FIRST))])
    planner = Planner(live.problem)

    def slower():
        job = Job(Retime(0.2), live.committed, live.now + LEAD, PATIENCE, live._sighting.obstacles)
        return planner.answer(job).found

    found = slower()
    t = 0.7 * found.begins + 0.3 * found.ends
    p = live.problem.arm.tray_pose(found.state(t)[0])[0]
    far, away = p + p * [1, 1, 0] / np.linalg.norm(p[:2]), t - live.now
    samples = [0.0, away - 0.25, away, away + 0.25], [far, far, p, far]
    ball = Moving("ball", "sphere", radius=0.03, samples=samples, uncertainty=0.0, growth=0.0, lasts=away + 0.25)
    assert live.obstacles([ball]).ok
    assert slower() is None
    live.override(0.2)
    for k in range(20):
        drive(live, 0.1, begins=0.3 + 0.1 * k)
        assert live.state.passing == ""
        assert live.refused == ""


def test_a_factor_never_leaves_the_range_between_its_ends():
    path = sv.trajectory.JointMotion(
        np.array([0.0, 2.0]), *np.array([[[0.0], [1.0]], np.zeros((2, 1)), np.zeros((2, 1))])
    )
    for rate in (0.0, 0.3, 1.0, -0.3):
        for to in (0.1, 0.5, 1.0):
            profile = SpeedProfile(path, 5.0, 0.2, 0.5, rate, to, 1.2)
            t = np.linspace(0.0, 2.0, 400)
            u, factor, slope = profile.along(t)
            assert profile.settled == (5.0 if to == 0.5 and not rate else 6.2)
            np.testing.assert_allclose(np.gradient(u, t)[1:-1], factor[1:-1], atol=1e-4)
            np.testing.assert_allclose(np.gradient(factor, t)[1:-1], slope[1:-1], atol=1.5e-2)
            inside = min(0.5, to) - 1e-9 <= factor.min() and factor.max() <= max(0.5, to) + 1e-9
            assert not profile.possible or inside
            assert profile.possible == (rate * (to - 0.5) >= 0 and abs(rate) * 1.2 <= 3 * abs(to - 0.5))
    rest = SpeedProfile(path, 5.0, 0.2, 0.5, 0.0, 0.0, 1.2).motion()
    assert rest.duration == 1.2
    assert rest.q[-1] == pytest.approx(path.sample(np.array([0.5]))[0][0], abs=1e-12)  # rounding


def test_the_same_is_said_by_lines(cube):
    live = Live(cube, lead=LEAD)
    prompter = Prompter(live).of(
        script(
            [
                '{"t": 0, "override": 0.5}',
                '{"t": 0, "goto": [0.45, 0.1, 0.45]}',
                '{"t": 0.4, "hold": true}',
                '{"t": 0.5, "override": "fast"}',
                '{"t": 1.0, "release": true}',
            ],
            "it",
        )
    )
    told = drive(live, 3.5, [(0.001 * k, lambda live, k=k: prompter.period(0.001 * k)) for k in range(1200)])
    assert (prompter.accepted, prompter.refused) == (4, 1)
    assert "factor is 'fast'" in prompter.notes[3]["answer"]
    assert not np.any(told.dq[900])
    np.testing.assert_allclose(where(live), FIRST, atol=1e-4)


def test_what_is_requested_after_a_release_is_done_when_nothing_was_before_it(cube):
    live = Live(cube, lead=LEAD)
    drive(live, 0.1, [(0.0, hold), (0.05, release)])
    assert live.settled
    drive(live, 1.2, [(0.0, lambda live: live.goto(FIRST, queued=True))], begins=0.1)
    np.testing.assert_allclose(where(live), FIRST, atol=1e-4)


@pytest.mark.slow
def test_a_goal_is_gone_on_with_after_a_hold_that_ends_before_anything_is_planned(cube):
    live = Live(cube, lead=LEAD)
    drive(live, 0.2, [(0.0, place(*FIRST))])
    while live.prepare(PATIENCE):
        pass
    drive(live, 0.005, [(0.0, hold)], every=None, begins=0.2)
    drive(live, 2.0, [(0.0, release)], begins=0.205)
    np.testing.assert_allclose(where(live), FIRST, atol=1e-4)


@pytest.mark.slow
def test_a_chunk_that_comes_while_the_arm_is_held_is_put_off_by_the_rest_of_the_hold(cube):
    live = Live(cube, lead=LEAD)
    drive(live, 0.5, [(0.0, hold)])
    p = where(live)
    drive(live, 0.1, [(0.0, lambda live: live.chunk([0.1, 0.6], [p, p + np.array([0.1, 0.0, 0.0])]))], begins=0.5)
    drive(live, 0.8, [(0.0, release)], begins=0.6)
    assert where(live)[0] - p[0] > 0.095


def test_no_source_and_no_value_makes_a_request_raise(cube):
    live = Live(cube, lead=LEAD)
    for wrong in ([], 10**5000, None, np.zeros(2)):
        assert live.hold(source=wrong).ok
        assert live.stop(source=wrong).ok
        for ask in (live.release, live.resume, lambda source: live.override(0.5, source=source)):
            assert "it must be one of policy, operator, monitor" in ask(source=wrong).sentence
    assert live.resume().ok
    for wrong in (10**5000, np.True_, np.array([0.5])):
        assert live.override(wrong).sentence.startswith("The override is refused: factor is ")
    assert not live.goto(FIRST, queued=10**5000).ok


def test_the_bounds_of_the_override_are_accepted(cube):
    live = Live(cube, lead=LEAD)
    for factor in (0.05, np.float32(0.5), 1):
        assert live.override(factor).ok


@pytest.mark.slow
def test_what_is_left_of_a_chunk_is_as_much_later_as_the_first_hold_took(cube):
    live = Live(cube, lead=LEAD)
    live.command(0.0)
    p = where(live)
    assert live.chunk([0.1, 0.6], [p, p + np.array([0.1, 0.0, 0.0])]).ok
    before = live._wish
    wishes = [(0.1, lambda live: live.hold(source="policy")), (0.4, hold)]
    drive(live, 0.9, wishes, begins=0.001)
    assert live.override(2.0).ok is False
    assert live.release().ok
    assert live.refused == ""
    held = pytest.approx(0.8, abs=0.002)
    assert live._wish.until - before.until == held
    assert live._wish.then is live._wish.wanted
    np.testing.assert_allclose(live._wish.wanted.t - before.wanted.t, 0.8, atol=0.002)


def test_an_arm_that_is_held_may_be_put_elsewhere(cube):
    live = Live(cube, lead=LEAD)
    drive(live, 0.8, [(0.0, place(*FIRST)), (0.25, hold)])
    q = live._reader.q + np.array([0.05, 0, 0, 0, 0, 0, 0])
    assert live.restart(q).ok
    drive(live, 0.002, every=None, begins=0.8)
    assert live.settled
    told = drive(live, 0.3, [(0.1, release)], begins=0.802)
    np.testing.assert_array_equal(told.q, np.tile(q, (300, 1)))
    assert live.settled


@pytest.mark.parametrize("late", [False, True])
def test_the_path_at_full_speed_is_known_of_what_is_proposed_or_comes_late(cube, late):
    live = Live(cube, lead=LEAD)
    live.override(0.4)
    live.goto(FIRST)
    live.command(0.0)

    def unsealed(job):
        answer = live._planner.answer(job)
        assert not sealed(replace(answer.found, profile=replace(answer.found.profile, to=0.9)), job.base, live.problem)
        if not late:
            return replace(answer, found=replace(answer.found, seal=b""))
        drive(live, 0.3, every=None, begins=0.001)
        return answer

    live.plan(PATIENCE, unsealed)
    found = live._offer.committed
    assert (found.run.factor, found.run.to, found.run.begins) == (0.4, 0.4, found.begins)
    assert found.motion.duration == pytest.approx(found.run.path.duration / 0.4)


def test_just_before_the_end_a_motion_is_neither_slowed_nor_stopped_later_than_it_ends(cube):
    """At 85 % braking on the path takes longer than finishing."""
    live = Live(cube, lead=LEAD)
    live.override(0.85)
    drive(live, 0.2, [(0.0, place(*FIRST))])
    base = live.committed
    found = live._planner.answer(Job(Halt(), base, base.ends - 0.11, PATIENCE)).found
    assert found is None or found.ends < base.ends
    drive(live, base.ends - 0.05 - 0.2, every=None, begins=0.2)
    drive(live, 0.04, [(0.0, override(0.1))], begins=live.now + 0.001)
    assert live.committed is base
    assert live.refused == ""


def test_no_speed_is_begun_whose_factor_would_leave_the_range_between_its_ends(cube):
    """While it speeds up it slows down no sooner than it is as fast as was asked for."""
    live = Live(cube, lead=LEAD)
    live.override(0.3)
    drive(live, 0.3, [(0.0, place(*FIRST))])
    live.override(0.7)
    drive(live, 0.1, begins=0.3)
    run = live.committed.run
    assert run.to == 0.7
    for to in (0.1, 0.3):
        for share in (0.1, 0.5):
            job = Job(Retime(to), live.committed, run.begins + share * run.within, PATIENCE)
            assert live._planner.answer(job).found is None


def test_a_slow_motion_does_not_stop_on_its_path_where_something_will_pass(cube):
    live = Live(cube, lead=LEAD)
    live.override(0.2)
    drive(live, 0.8, [(0.0, place(*FIRST))])
    base, begins = live.committed, live.now + LEAD
    planner = Planner(live.problem)
    found = planner.answer(Job(Halt(), base, begins, PATIENCE)).found
    assert found.profile.to == 0.0
    p, aside = live.problem.arm.tray_pose(found.motion.q[-1])[0], np.array([0.0, 0.6, 0.0])
    away = found.ends - live.now + 0.05
    samples = [0.0, away, away + 0.3], [p + aside, p, p - aside]
    ball = Moving("ball", "sphere", radius=0.03, samples=samples, uncertainty=0.0, growth=0.0, lasts=away + 0.3)
    assert live.obstacles([ball]).ok
    found = planner.answer(Job(Halt(), base, begins, 0.1, live._sighting.obstacles)).found
    assert found is None or found.profile is None


@pytest.mark.slow
def test_another_goal_is_gone_to_from_a_slow_motion_without_coming_to_rest(cube):
    live = Live(cube, lead=LEAD)
    live.override(0.3)
    told = drive(live, 0.8, [(0.0, place(*FIRST))])
    first = live.committed
    told = in_turn(told, drive(live, 0.2, [(0.0, place(*SECOND))], begins=0.8))
    assert live.committed.begins < first.ends - 0.5
    assert live.committed.run.factor == 0.3
    told = in_turn(told, drive(live, live.committed.motion.duration, begins=1.0))
    np.testing.assert_allclose(where(live), SECOND, atol=1e-4)
    check(live, told)


def test_another_speed_is_begun_sooner_than_another_motion(cube):
    live = Live(cube)
    live.override(0.3)
    drive(live, 0.3, [(0.0, place(*FIRST))])
    live.override(0.6)
    jobs = []
    live.plan(PATIENCE, lambda job: jobs.append(job) or Answer(None, Status("refused", "", False)))
    assert isinstance(jobs[0].wish, Retime)
    assert jobs[0].begins - live.now < 0.15  # s, where it is 0.25 before any motion was planned
    live.plan(PATIENCE, jobs.append)
    assert len(jobs) == 1  # not tried again at once


@pytest.mark.slow
def test_the_bottle_stays_in_the_engine_when_it_is_held_and_slowed(bottle):
    """At corners of its ranges, at random instants."""
    rng = np.random.default_rng(11)
    for _ in range(2):
        live = Live(bottle, lead=LEAD)
        a, b, c = np.sort(rng.uniform(0.15, 2.0, 3))
        wishes = [(0.0, place(*FIRST)), (a, override(rng.uniform(0.3, 0.9))), (b, hold), (b + 0.5, release)]
        told = drive(live, 5.0, [*wishes, (b + 0.5, place(*SECOND)), (b + 0.5 + c, override(1.0))])
        check(live, told)
        plan = joint_plan(live.problem.scenario, live.problem, executed(told), Status("optimal", "", True), {})
        values = plan.uncertain.nominal + plan.uncertain.half_range * rng.choice([-1, 1], len(plan.uncertain.names))
        run = sv.simulate(plan, parameters=dict(zip(map(str, plan.uncertain.names), values.tolist(), strict=True)))
        assert run.outcome not in DROPPED
        assert max(item["peak_slip"] for item in run.summary["objects"]) < LARGEST_SLIP


@pytest.mark.slow
def test_a_cup_is_carried_slowly_and_held(coffee):
    """A cup's tray leans for full speed only: at half of it the motion is another one, with sloshing as it then is."""
    live = Live(coffee, lead=0.3)
    live.override(0.5)
    told = drive(live, 0.7, [(0.0, place(*FIRST))], every=50)
    assert live.committed.run.factor == 0.5
    told = in_turn(told, drive(live, 1.6, [(0.0, hold)], begins=0.7, every=50))
    assert not np.any(told.dq[-100:])
    assert np.abs(where(live) - FIRST).max() > 0.01
    told = in_turn(told, drive(live, 2.5, [(0.0, release)], begins=2.3, every=50))
    np.testing.assert_allclose(where(live), FIRST, atol=1e-4)
    assert live.refused == ""
    check(live, told)
