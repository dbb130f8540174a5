"""What became of each request, and the commanded motion as a file."""

import numpy as np
import pytest
from typer.testing import CliRunner

import salver as sv
from live_runs import LEAD, PATIENCE, drive, place
from salver.cli import app
from salver.errors import SalverError, Status
from salver.live import Live, LiveOptions, Moving
from salver.live.history import CommandHistory
from salver.live.replanning.planner import Answer
from salver.live.requests import KEPT, Requests
from salver.motion_files import read
from salver.trajectory import JointMotion


def outcomes(live):
    return [(request.id, request.outcome) for request in live.state.requests]


def test_each_request_has_a_number_and_an_outcome(cube):
    live = Live(cube, lead=LEAD)
    first = live.goto((0.45, 0.1, 0.45))
    assert first.details == {"request": 1}
    assert outcomes(live) == [(1, "accepted")]
    second = live.goto((5.0, 0.1, 0.45))
    assert second.details == {"request": 2}
    assert not live.goto((np.nan, 0, 0)).details
    drive(live, 0.1)
    replaced, unreachable = live.state.requests
    assert (replaced.outcome, replaced.why) == ("dropped", "request 2 came instead")
    assert (unreachable.outcome, unreachable.why) == ("dropped", "no posture of the arm within its limits reaches it")
    live.goto((0.5, 0.0, 0.42))
    live.goto((0.45, -0.2, 0.45), queued=True)
    drive(live, 0.2, begins=0.1)
    assert outcomes(live)[2:] == [(3, "followed"), (4, "accepted")]
    drive(live, 2.0, begins=0.3)
    assert outcomes(live)[2:] == [(3, "reached"), (4, "reached")]
    live.goto((0.5, 0.1, 0.45))
    drive(live, 0.2, begins=2.3)
    live.stop("a hand is near")
    assert (
        str(live.state.requests[-1]) == "Request 5 (to (0.500, 0.100, 0.450) m): dropped, the operator stopped the arm."
    )


def test_a_goal_from_which_an_obstacle_goes_while_it_is_planned_is_planned_again(cube):
    """It was dropped, for an obstacle that was not there any more; while that stays there, it is refused."""
    goal = (0.444, 0.35, 0.45)
    for goes, outcome in ((True, "reached"), (False, "dropped")):
        live = Live(cube, lead=LEAD)
        drive(live, 0.05, every=None)
        assert live.obstacles([Moving("ball", "sphere", goal, radius=0.08)]).ok
        live.goto(goal)

        def answer(job, goes=goes, live=live):
            answered = live._planner.answer(job)
            if goes:
                live.obstacles([])
            return answered

        live.plan(0.0, answer)  # one attempt: with time it finds a motion that takes nine seconds
        assert outcomes(live) == [(1, "accepted" if goes else "dropped")]
        drive(live, 2.0, begins=0.05)
        assert outcomes(live) == [(1, outcome)]


def test_what_became_of_requests_is_told_once_each_time(cube):
    live = Live(cube, lead=LEAD)
    news = live.outcomes()
    assert next(news) == []
    live.goto((0.45, 0.1, 0.45))
    live.goto((0.5, 0.0, 0.42), queued=True)
    assert [(one.id, one.outcome) for one in next(news)] == [(1, "accepted"), (2, "accepted")]
    assert next(news) == []
    drive(live, 0.2)
    assert [(one.id, one.outcome) for one in next(news)] == [(1, "followed")]
    drive(live, 3.0, begins=0.2)
    assert [(one.id, one.outcome) for one in next(news)] == [(1, "reached"), (2, "reached")]
    live.goto((0.45, 0.1, 0.45))
    drive(live, 0.3, begins=3.2)
    drive(live, 2.0, every=None, begins=3.5)  # nobody plans any more
    assert [(one.id, one.outcome) for one in next(news)] == [(3, "reached")]


def finding_nothing(job):
    return Answer(None, Status("refused", "nothing was found", False))


def test_a_goal_that_was_dropped_is_not_gone_to_after_a_hold(cube):
    live = Live(cube, lead=LEAD)
    live.command(0.0)
    live.goto((0.45, 0.2, 0.5))
    live.plan(PATIENCE, finding_nothing)
    assert live.state.requests[0].outcome == "dropped"
    told = drive(live, 0.5, [(0.0, lambda live: live.hold()), (0.1, lambda live: live.release())])
    assert not np.any(told.dq)
    assert live.settled


def test_each_goal_has_all_its_attempts(cube):
    live = Live(cube, lead=LEAD)
    drive(live, 0.2, [(0.0, place(0.45, 0.25, 0.5)), (0.0, lambda live: live.override(0.3))])
    for _ in range(2):
        live.goto((0.5, -0.2, 0.45))
        for _ in range(LiveOptions().attempts - 1):
            live.plan(PATIENCE, finding_nothing)
    assert outcomes(live) == [(1, "dropped"), (2, "dropped"), (3, "accepted")]
    assert live.state.requests[1].why == "request 3 came instead"
    live.plan(PATIENCE, finding_nothing)
    assert live.state.requests[2].why == "nothing was found"


def test_a_policy_does_not_drop_what_an_operator_queued(cube):
    live = Live(cube, lead=LEAD)
    live.goto((0.45, 0.1, 0.45), source="policy")
    live.goto((0.5, -0.2, 0.45), queued=True)
    drive(live, 0.2)
    sentence = live.twist((0.1, 0.0, 0.0), source="policy").sentence
    assert sentence == "The twist is refused: a request of the operator is carried out first."
    drive(live, 3.0, begins=0.2)
    assert outcomes(live) == [(1, "reached"), (2, "reached")]
    assert live.twist((0.1, 0.0, 0.0), source="policy").ok


def test_a_motion_that_comes_too_late_is_said_to_be_late_until_another_is_followed(cube):
    live = Live(cube, lead=LEAD)
    drive(live, 0.3, [(0.0, place(0.45, -0.2, 0.5))])

    def slowly(job):
        answer = live._planner.answer(job)
        for k in range(150):
            live.command(0.3 + 1e-3 * k)
        return answer

    live.goto((0.45, 0.1, 0.45))
    live.plan(PATIENCE, slowly)
    assert outcomes(live)[1] == (2, "accepted")
    live.command(0.45)
    assert outcomes(live)[1] == (2, "late")
    drive(live, 2.0, begins=0.451)
    assert outcomes(live) == [(1, "dropped"), (2, "reached")]


def test_twists_that_were_followed_stay_so_though_one_comes_late(cube):
    live = Live(cube, lead=0.02)
    hand = [(t, lambda live: live.twist((0.1, 0.0, 0.0))) for t in np.arange(0.0, 0.1, 0.01)]
    drive(live, 0.1, hand)

    def slowly(job):
        answer = live._planner.answer(job)
        for k in range(60):
            live.command(0.1 + 1e-3 * k)
        return answer

    live.twist((0.1, 0.0, 0.0))
    live.plan(PATIENCE, slowly)
    live.command(0.16)
    assert live._offer is None
    assert outcomes(live) == [(1, "followed")]
    live.stop()
    assert outcomes(live) == [(1, "followed")]


def test_a_goal_is_not_reached_by_a_hold_on_the_way(cube):
    """Though nothing is planned, nor asked, after the motion to rest was."""
    live = Live(cube, lead=LEAD)
    drive(live, 0.3, [(0.0, place(0.45, 0.1, 0.45))])
    live.hold()
    live.plan(PATIENCE)
    drive(live, 2.0, every=None, begins=0.3)
    assert live.now > live.committed.ends
    assert outcomes(live) == [(1, "followed")]
    live.release()
    drive(live, 2.0, begins=2.3)
    assert outcomes(live) == [(1, "reached")]


@pytest.mark.slow
def test_twists_are_one_request_until_there_are_none_for_a_while(cube):
    live = Live(cube, lead=0.02)
    hand = [(t, lambda live: live.twist((0.1, 0.0, 0.0))) for t in np.arange(0.0, 0.2, 0.01)]
    drive(live, 0.8, hand)
    drive(live, 0.8, hand, begins=0.8)
    assert outcomes(live) == [(1, "followed"), (2, "followed")]
    live.twist((0.1, 0.0, 0.0))
    live.twist((0.1, 0.0, 0.0), source="policy")
    assert len(live.state.requests) == 3  # that of the policy is refused
    live.stop()
    assert live.state.requests[-1].outcome == "dropped"


def test_another_source_or_kind_of_velocities_is_another_request(cube):
    """It begins anew: a twist of six numbers says nothing of how seven joint velocities change."""
    live = Live(cube, lead=0.02)
    live.command(0.0)
    assert live.twist((0.1, 0.0, 0.0), source="policy").ok
    live.command(0.01)
    assert live.twist((0.1, 0.0, 0.0)).ok
    live.command(0.02)
    assert live.jog([0.1, 0, 0, 0, 0, 0, 0]).ok
    live.command(0.03)
    assert live.jog([0.2, 0, 0, 0, 0, 0, 0]).ok
    assert [one.what for one in live.state.requests] == ["twists", "twists", "joint velocities"]


@pytest.mark.slow
def test_a_chunk_is_followed_and_its_end_is_reached(cube):
    live = Live(cube, lead=0.02)
    q = live.command(0.0)[0] + np.linspace(0.02, 0.2, 5)[:, None] * np.eye(7)[0]
    assert live.chunk(np.linspace(0.1, 0.5, 5), joints=q).details == {"request": 1}
    drive(live, 0.3, begins=1e-3)
    assert outcomes(live) == [(1, "followed")]
    drive(live, 2.0, begins=0.301)
    assert outcomes(live) == [(1, "reached")]


def test_requests_of_long_ago_are_forgotten():
    requests = Requests()
    for _ in range(3 * KEPT):
        requests.new("twists")
    assert [request.id for request in requests.each] == list(range(2 * KEPT + 1, 3 * KEPT + 1))
    requests.becomes(1, "reached")
    requests.ended(1, "")
    assert len(requests.each) == KEPT


@pytest.fixture(scope="module")
def session(cube):
    """A goal, another on the way to it, and twists; what the loop was told."""
    live = Live(cube, lead=LEAD, options=LiveOptions(record=2.0))
    hand = [(t, lambda live: live.twist((0.1, 0.1, 0.0))) for t in np.arange(1.0, 1.3, 0.01)]
    told = drive(live, 1.8, [(0.0, place(0.45, 0.1, 0.45)), (0.3, place(0.5, -0.2, 0.42)), *hand])
    return live, told


@pytest.mark.slow
def test_what_was_commanded_is_kept_as_one_motion(session):
    live, told = session
    motion = live.commanded()
    assert motion.duration == pytest.approx(live.now)
    for kept, said in zip(motion.sample(told.t), told[:3], strict=True):
        assert np.abs(kept - said).max() < 1e-7
    later = live.commanded(0.5)
    assert later.duration == pytest.approx(live.now - 0.5)
    assert np.abs(later.sample(told.t[500:] - 0.5)[0] - told.q[500:]).max() < 1e-7
    assert live.commanded(live.now) is None


@pytest.mark.slow
def test_only_so_many_seconds_are_kept(cube):
    live = Live(cube, lead=0.02, options=LiveOptions(record=0.25))
    hand = [(t, lambda live: live.twist((0.1, 0.1, 0.0))) for t in np.arange(0.0, 0.6, 0.01)]
    told = drive(live, 0.6, hand)
    motion = live.commanded()
    assert motion.duration == pytest.approx(0.25)
    assert live._history._parts[0][0] > 0.25  # live time, s: what is too long ago takes no memory
    assert np.abs(motion.sample(told.t[-200:] - live.now + 0.25)[0] - told.q[-200:]).max() < 1e-7
    drive(live, 1.0, begins=0.6)
    live.restart(live.committed.motion.q[-1])
    assert live.commanded() is None


@pytest.mark.slow
def test_the_file_of_a_session_is_audited(session, tmp_path):
    live, told = session
    for name in ("session.csv", "session.yaml", "session"):
        files = live.save(tmp_path / name)
        samples = read(files[0] if name != "session" else tmp_path / name, lambda: live.problem.arm.joint_names)
        assert samples.t[-1] == pytest.approx(live.now)
        within = samples.t <= told.t[-1]
        expected = np.stack([np.interp(samples.t[within], told.t, q) for q in told.q.T], axis=1)
        assert np.abs(samples.q[within] - expected).max() < 1e-5
    assert sv.audit(tmp_path / "session.csv", "panda-cube").summary()["worst_case"]["code"] == "holds"
    page = tmp_path / "page.html"
    told_of = ["report", str(tmp_path / "session.csv"), "-s", "panda-cube", "-o", str(page)]
    assert CliRunner().invoke(app, told_of).exit_code == 0
    assert page.stat().st_size > 1000


def test_what_cannot_be_written_is_refused_in_a_sentence(cube, tmp_path):
    live = Live(cube)
    for now in (0.0, 0.01):
        live.command(now)
    with pytest.raises(SalverError, match="rate is 0; it must be from 1 to 10000 samples a second"):
        live.save(tmp_path / "a.csv", rate=0)
    with pytest.raises(SalverError, match="since is 99; nothing was commanded after it"):
        live.save(tmp_path / "a.csv", since=99)
    with pytest.raises(SalverError, match="it must end in"):
        live.save(tmp_path / "a.docx")


def test_a_path_that_is_replaced_at_once_leaves_nothing_behind():
    still = JointMotion(np.array([0.0, 1.0]), np.zeros((2, 7)), np.zeros((2, 7)), np.zeros((2, 7)))
    history = CommandHistory(60.0, 0.0, still, 0.0)
    for now in (0.0, 0.5):
        history.take(now, still, now)
    assert history.motion(0.0, 2.0).duration == 2.0
