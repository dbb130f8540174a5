"""A stop latches until it is lifted, whoever requests what meanwhile; who requests has a priority."""

import numpy as np
import pytest

from live_runs import LEAD, PATIENCE, check, drive, in_turn, place
from salver.live import Live, LiveOptions, Moving
from salver.live.ready import ReadyOptions

TWIST = (0.2, 0.1, 0.0)


def at_rest(states):
    return not np.any(states[1][-1])


@pytest.fixture(scope="module")
def astray(cube):
    """An arm that is 0.2 rad off, as it is reported 100 times a second, while a policy sends a twist as often."""
    live, offset = Live(cube, lead=LEAD), np.eye(7)[1] * 0.2
    told = [drive(live, 0.3, [(0.0, place(0.45, 0.1, 0.45))])]
    for k in range(120):
        live.measured(live.command(0.3 + 0.01 * k)[0] + offset)
        live.twist(TWIST, source="policy")
        told.append(drive(live, 0.01, every=5, begins=0.3 + 0.01 * k))
    return live, in_turn(*told)


def test_an_arm_that_is_elsewhere_stays_stopped_whatever_a_policy_sends(astray):
    live, states = astray
    assert at_rest(states)
    assert not np.any(states[1][-300:])  # s of rest, at 1 kHz
    assert live.state.doing == "resting"
    assert live.stopped.startswith(
        "Stopped by the monitor: panda_joint2 is 0.200 rad from where it was commanded to be."
    )
    assert live.stopped.endswith("120 requests were refused since.")
    assert live.state.refusals == 120


def test_it_goes_on_when_the_arm_is_there_again_and_the_operator_says_so(astray):
    live, _ = astray
    assert "panda_joint2 is 0.200 rad from where" in live.resume().sentence
    assert live.measured(live.command(2.0)[0]).ok
    assert not live.twist(TWIST).ok
    assert "the monitor stopped the arm" in live.resume(source="policy").sentence
    assert live.resume().ok
    assert live.stopped == live.state.stopped == ""
    assert live.twist(TWIST).ok


def test_an_operators_stop_is_not_cancelled_by_the_next_twist(cube):
    """Neither by one of the same source, nor by what was planned before and comes late."""
    live = Live(cube, lead=LEAD)
    before = drive(live, 0.35, [(0.0, place(0.45, 0.1, 0.45))])
    live.goto((0.5, -0.3, 0.4))
    planner = live._planner

    def stopped_meanwhile(job):
        answer = planner.answer(job)
        assert live.stop("a hand is in the way").ok
        return answer

    live.plan(60.0, stopped_meanwhile)
    goal = live._offer.committed
    twists = [(0.01 * k, lambda live: live.twist(TWIST)) for k in range(100)]
    others = [(0.0, place(0.5, 0.0, 0.5)), (0.0, lambda live: live.chunk([0.5], [(0.5, 0.0, 0.5)]))]
    after = drive(live, 1.0, [*others, *twists], begins=0.35)
    assert live.committed is not goal
    assert at_rest(after)
    assert not np.any(after[1][-400:])
    assert live.stopped == "Stopped by the operator: a hand is in the way. 102 requests were refused since."
    assert "the arm was stopped by the operator (a hand is in the way); call resume() first" in live.refused
    check(live, in_turn(before, after))
    assert live.resume().ok
    assert live.goto((0.5, 0.0, 0.5)).ok
    assert np.any(drive(live, 0.4, begins=1.35)[1])


def test_what_a_policy_requests_waits_for_the_operator(cube):
    live = Live(cube, lead=LEAD)
    drive(live, 0.2, [(0.0, lambda live: live.goto((0.45, 0.1, 0.45), source="policy"))])
    assert live.goto((0.5, -0.2, 0.45)).ok  # the operator takes over from a policy,
    sentence = live.twist(TWIST, source="policy").sentence  # and not the other way round,
    assert sentence == "The twist is refused: a request of the operator is carried out first."
    drive(live, 2.0, begins=0.2)
    assert live.settled
    assert live.twist(TWIST, source="policy").ok  # before that is done.
    assert live.state.refusals == 1


def test_what_was_planned_for_a_policy_is_not_committed_when_the_operator_has_spoken(cube):
    live, planner = Live(cube, lead=LEAD), None
    drive(live, 0.05, every=None)
    live.goto((0.45, 0.1, 0.45), source="policy")
    planner = live._planner

    def meanwhile(job):
        answer = planner.answer(job)
        assert live.goto((0.5, -0.3, 0.45)).ok
        return answer

    live.plan(60.0, meanwhile)
    drive(live, 0.02, every=None, begins=0.05)
    assert live.committed.at_rest
    assert not live.idle


def test_a_policy_lifts_only_its_own_stop(cube):
    live = Live(cube, lead=LEAD)
    live.command(0.0)
    assert live.stop("no object seen", source="policy").ok
    assert live.resume(source="policy").ok
    live.stop("no object seen", source="policy")
    live.stop(source="operator")
    live.stop("again", source="policy")
    assert live.stopped == "Stopped by the operator."
    assert not live.resume(source="policy").ok
    assert live.resume().ok
    assert (
        "source is 'me'; it must be one of policy, operator, monitor" in live.goto((0.5, 0, 0.5), source="me").sentence
    )
    live.stop(source="me")  # never refused
    assert live.stopped == "Stopped by the operator."


def test_where_the_arm_is_put_a_stop_stays(cube):
    live = Live(cube, lead=LEAD)
    live.command(0.0)
    live.stop()
    assert live.restart(live.committed.motion.q[0]).ok
    assert not live.goto((0.5, 0, 0.5)).ok
    assert live.idle
    assert live.resume().ok
    assert live.goto((0.5, 0, 0.5)).ok


def test_queued_goals_are_not_without_end(cube):
    live = Live(cube, lead=LEAD)
    answers = [live.goto((0.5, 0, 0.5), queued=True) for _ in range(101)]
    assert all(answer.ok for answer in answers[:100])
    assert answers[100].sentence == "The goal is refused: 100 goals are queued already, the most that are accepted."
    assert "queued is 'no'; it must be True or False" in live.goto((0.5, 0, 0.5), queued="no").sentence


def test_a_short_stop_keeps_its_limits_between_the_instants_of_the_verdict_too(bottle):
    """With instants 2.5 ms apart it is beyond a limit of torque rate, as it is executed."""
    rng = np.random.default_rng([81, 5])
    at, goal = rng.uniform(0.25, 0.6), rng.uniform((0.4, -0.4, 0.4), (0.55, 0.15, 0.6))
    live = Live(bottle, lead=LEAD)
    told = drive(live, 1.2, [(0.0, place(*goal)), (at, lambda live: live.stop())])
    assert live.committed.ends - live.committed.begins < 0.4
    check(live, told)


def test_a_stop_is_not_refused_whatever_its_reason_is(cube):
    live = Live(cube, lead=LEAD)
    live.command(0.0)
    assert live.stop(10**5000).ok  # no text can be made of it
    assert live.stopped == "Stopped by the operator: a value of type int that is no text."


def slow(cube, **options):
    """An arm on its way for 7 s more, at a tenth of full speed, with stops ready."""
    live = Live(cube, lead=LEAD, options=LiveOptions(**options))
    drive(live, 0.6, [(0.0, lambda live: live.override(0.1)), (0.0, place(0.45, 0.25, 0.5))])
    assert live.committed.ends - live.now > 4.0
    return live


def test_a_ready_stop_that_comes_too_late_is_planned_instead(cube):
    live = slow(cube, ready=ReadyOptions(early=-1.0))
    for _ in range(3):
        assert live.prepare(PATIENCE)
    drive(live, 0.25, every=None, begins=0.6)  # beyond the first of them
    assert live.stop().ok
    assert live._halt.committed.begins < live.now
    live.plan(PATIENCE)
    assert at_rest(drive(live, 0.8, begins=0.85))


def test_a_stop_is_planned_again_after_the_planner_failed(cube):
    live, calls = slow(cube), []

    def failing_once(job):
        calls.append(job.wish)
        if len(calls) == 1:
            raise MemoryError
        return live._planner.answer(job)

    live.stop()
    live.plan(PATIENCE, failing_once)
    assert "The planner failed (MemoryError" in live.refused
    live.plan(PATIENCE, failing_once)
    assert calls == [live._stopped.halt] * 2
    assert at_rest(drive(live, 0.8, begins=0.6))


def test_a_planner_that_fails_for_one_request_drops_no_other(cube):
    live = Live(cube, lead=LEAD)
    drive(live, 0.05, every=None)
    live.goto((0.45, 0.1, 0.45))

    def failing(job):
        live.goto((0.5, -0.2, 0.45))
        raise MemoryError

    live.plan(PATIENCE, failing)
    assert [request.outcome for request in live.state.requests] == ["dropped", "accepted"]
    drive(live, 2.0, begins=0.05)
    assert live.state.requests[1].outcome == "reached"


def test_a_ready_stop_is_not_taken_when_something_came_into_sight_since(cube):
    """It would rest where a ball comes by, and the motion that it ends goes on before that."""
    live = Live(cube, lead=LEAD)
    drive(live, 0.2, [(0.0, place(0.45, 0.25, 0.5))])
    while live.prepare(PATIENCE):
        pass
    live.command(0.2)
    ready = live._ready.soonest(live.committed, live.now, live._sighting)
    arm = live.problem.arm
    p = arm.tray_pose(ready.committed.motion.q[-1])[0]
    assert np.linalg.norm(arm.tray_pose(live.committed.motion.q[-1])[0] - p) > 0.15
    comes = ready.committed.ends - live.now + 0.3  # s
    path = [comes - 0.1, comes, comes + 0.1], p + np.outer([-1.0, 0.0, -1.0], [0.0, 0.0, 1.0])
    ball = Moving("ball", "sphere", radius=0.03, samples=path, growth=0.0)
    assert live.obstacles([ball]).ok
    assert not live.state.passing
    live.stop()
    drive(live, 1.5, begins=0.201)
    assert not live.state.passing
    assert not np.any(live.command(1.702)[1])
