"""Another load while live: it is believed where it is verified to be safe, and then all is planned for it."""

import time

import numpy as np
import pytest

import salver as sv
from live_runs import LEAD, PATIENCE, check, drive, executed, place
from salver.errors import Status
from salver.live import Live, Worker
from salver.live.committed.seal import sealed
from salver.live.reader import Reader
from salver.live.replanning.lead import LeadOptions
from salver.live.replanning.planner import Planner
from salver.live.standing import standing
from salver.planning.fastest import joint_plan


@pytest.fixture(scope="module")
def smooth(cube):
    """A heavier cube that slides sooner."""
    return cube.with_changes(objects__0__mass=0.5, objects__0__friction=0.2, objects__0__name="smooth")


def on_the_tray_of(scenario, other):
    data = scenario.model_dump(mode="json", exclude_none=True)
    return other.with_changes(tray=data["tray"], arm=data["arm"])


def outcome(live, told):
    """What the engine says of a motion that was executed, with the load that is believed."""
    problem = live.problem
    run = sv.simulate(joint_plan(problem.scenario, problem, executed(told), Status("recorded", "", True), {}))
    return run.outcome, max(item["peak_slip"] for item in run.summary["objects"])


@pytest.mark.slow
def test_each_load_stays_on_motions_that_were_planned_while_it_was_carried(cube, smooth):
    live = Live(cube, lead=LEAD)
    there = drive(live, 1.6, [(0.0, place(0.45, 0.1, 0.45))])
    check(live, there)
    assert outcome(live, there)[0] == "holds"
    assert live.load(smooth).ok
    assert live.problem.items[0].name == "smooth"
    assert outcome(live, there)[1] > 0.02  # m: it would have slid on the way that the first one took
    back = drive(live, 3.0, [(0.0, place(0.5, -0.25, 0.45))], begins=1.6)
    check(live, back)
    assert np.ptp(back.q, axis=0).max() > 0.3
    assert outcome(live, back)[0] == "holds"
    assert outcome(live, back)[1] < 1e-3
    # As heavy as it is, the torque that is commanded at rest is another one.
    assert not np.allclose(back.tau[0], there.tau[-1], atol=0.1)
    assert back.q[0] == pytest.approx(there.q[-1], abs=1e-12)


def test_a_load_that_would_not_stay_is_refused_and_the_one_before_stays_believed(cube):
    live = Live(cube, lead=LEAD)
    problem, running = live.problem, live._running
    refused = live.load(cube.with_changes(objects__0__mass=20.0))  # more than the arm can hold
    assert not refused.ok
    assert "The load is refused: " in refused.sentence
    assert "the load is not safe at rest at q" in refused.sentence
    assert live.problem is problem
    assert live._running is running


def test_another_load_is_not_believed_while_the_arm_moves_or_plans_or_is_another(cube, smooth):
    live = Live(cube, lead=LEAD)
    live.command(0.0)
    other = smooth.with_changes(tray__mass=1.0)
    assert "the scenario has another arm or another tray" in live.load(other).sentence
    live.goto((0.45, 0.1, 0.45))
    assert "the arm moves, or is about to" in live.load(smooth).sentence
    told = []
    live.plan(PATIENCE, lambda job: told.append(live.load(smooth)) or live._planner.answer(job))
    assert "a motion is being planned" in told[0].sentence
    drive(live, 0.3, begins=1e-3)
    assert "the arm moves, or is about to" in live.load(smooth).sentence
    assert live.problem.items[0].name == "cube"


def test_a_load_is_believed_only_where_the_arm_is(cube, smooth, monkeypatch):
    """Not while it is elsewhere than commanded, nor where it was when somebody asked."""
    live = Live(cube, lead=LEAD)
    live.command(0.0)
    q = live.committed.motion.q[0]
    live.measured(q + 0.2)
    live.plan(PATIENCE)
    assert "panda_joint1 is 0.200 rad from where it was commanded" in live.load(smooth).sentence
    assert not live.resume().ok
    live.measured(q)
    elsewhere = q + 0.1 * np.eye(7)[0]

    def slowly(*about):
        assert live.restart(elsewhere).ok
        return standing(*about)

    monkeypatch.setattr("salver.live.live.standing", slowly)
    assert "the arm was started again elsewhere meanwhile" in live.load(smooth).sentence
    assert live.problem.items[0].name == "cube"
    assert live.command(1e-3)[0] == pytest.approx(elsewhere)


def test_the_loop_reads_where_the_arm_is_while_another_load_comes(cube, smooth, monkeypatch):
    live = Live(cube, lead=LEAD)
    q, seen = live.command(0.0)[0].copy(), []

    class Watched(Reader):
        def read(self, now):
            seen.append(live.command(1e-3 * len(seen))[0].copy())  # from the loop's thread, before it is filled
            super().read(now)

    monkeypatch.setattr("salver.live.live.Reader", Watched)
    assert live.load(smooth).ok
    assert seen
    assert np.array(seen) == pytest.approx(np.tile(q, (len(seen), 1)))


def test_what_was_commanded_is_of_one_load(cube, smooth):
    """So that an audit of it judges no motion with a load that was not there."""
    live = Live(cube, lead=LEAD)
    drive(live, 0.02, every=None)
    assert live.load(smooth).ok
    drive(live, 0.01, every=None, begins=0.02)
    assert live.commanded().duration == pytest.approx(0.01)


def test_what_is_still_planned_for_the_load_before_is_verified_for_the_one_that_is_carried(cube, smooth):
    """A planner of one's own does not follow: what it found passed with the cube, and has a seal of this process."""
    live = Live(cube, lead=LEAD)
    live.command(0.0)
    planner, answers = Planner(live.problem), []
    assert live.load(smooth).ok
    live.goto((0.5, -0.25, 0.45))
    live.plan(PATIENCE, lambda job: answers.append(planner.answer(job)) or answers[0])
    assert answers[0].status.ok
    assert live._offer is None
    assert not sealed(answers[0].found, live.committed, live.problem)
    assert "contact of smooth would be exceeded by " in live.state.requests[0].why


@pytest.mark.slow
def test_the_planner_in_its_process_plans_for_the_load_that_is_believed(cube, smooth):
    """What it finds carries a valid seal: it was verified there, for this load."""
    live = Live(cube, lead=LEAD)
    live.command(0.0)
    process, answers = Worker(live)._process, []
    try:
        process.ready()
        first = process._running
        assert live.load(smooth).ok
        live.goto((0.5, -0.25, 0.45))
        live.plan(PATIENCE, lambda job: answers.append((job, process.answer(job))) or answers[-1][1])
        (job, answer) = answers[0]
        assert first.poll() is not None  # it has ended
        assert sealed(answer.found, job.base, live.problem)
    finally:
        process.close()
    told = drive(live, answer.found.motion.duration + 0.6, every=None, begins=1e-3)
    assert np.ptp(told.q, axis=0).max() > 0.3
    kind, slip = outcome(live, told)
    assert kind == "holds"
    assert slip < 1e-3


@pytest.mark.slow
def test_the_planner_is_there_for_another_load_before_anything_is_requested(cube, coffee):
    """So that no lead is learnt from its start, and none from the load before."""
    live = Live(cube)
    with Worker(live) as worker:
        drive(live, 0.3, [(0.0, place(0.45, 0.1, 0.45))])
        started = worker._process._running
        drive(live, 2.0, every=None, begins=0.3)
        while not (done := live.load(on_the_tray_of(cube, coffee), calm=True)).ok:
            assert "planned" in done.sentence or "about to" in done.sentence
        until = time.monotonic() + PATIENCE
        while worker._process.behind or worker._process._running in (None, started):
            assert time.monotonic() < until
            time.sleep(0.01)
    assert live.lead == LeadOptions().motion
    live._lead.took("motion", 2.0)
    assert live.lead == pytest.approx(2.6)  # with a liquid planning may take as long
