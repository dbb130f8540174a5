"""What anyone proposes to a live motion is only believed after it was looked at."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

from live_runs import LEAD, drive, executed, place
from salver.live import Live
from salver.live.committed import seal
from salver.live.committed.commit import verified
from salver.live.committed.motion import between, joined, resting
from salver.live.committed.seal import sealed
from salver.live.replanning.planner import Job, Planner
from salver.live.replanning.replan import Replanner, ReplanOptions
from salver.live.replanning.wishes import Goal, Halt
from salver.live.worker import _Process
from salver.planning.fastest import AtPosture, fastest
from salver.planning.trajopt.constraints.constraints import Clearance, ContactConstraint, evaluate
from salver.planning.trajopt.constraints.obstacles import CLEARANCE, KeepOut
from salver.planning.trajopt.exchange import optimise
from salver.planning.trajopt.sqp import minimise
from salver.planning.verdict.judged import Judged, VerdictEvaluation, peaks
from salver.trajectory import JointMotion


@pytest.fixture(scope="module")
def moving(cube):
    """On the way to a goal; only to be looked at."""
    live = Live(cube, lead=LEAD)
    drive(live, 0.4, [(0.0, place(0.45, 0.1, 0.45))])
    return live


def test_a_jolt_is_refused(moving):
    base, now = moving.committed, moving.committed.begins + 0.2
    goes_on = between(base.motion, 0.2, base.motion.duration)
    assert verified(moving.problem, goes_on, now, base).committed is not None
    for name, by in (("q", 1e-4), ("dq", 1e-3), ("ddq", 1e-2)):
        states = {key: getattr(goes_on, key).copy() for key in ("q", "dq", "ddq")}
        states[name][0, 2] += by
        found = verified(moving.problem, JointMotion(goes_on.t, **states), now, base)
        assert found.committed is None
        assert found.sentence == "it does not begin where the arm is then"


def test_a_motion_before_the_one_that_it_continues_is_refused(moving):
    """It begins in the state in which that one begins, but the arm is elsewhere, on the way there."""
    base = moving.committed
    assert verified(moving.problem, base.motion, base.begins, base).committed is not None
    found = verified(moving.problem, base.motion, base.begins - 0.05, base)
    assert found.committed is None
    assert found.sentence == "it begins 0.05 s before the motion that it continues"


def test_what_does_not_end_at_rest_is_refused(moving):
    base, now = moving.committed, moving.committed.begins + 0.1
    cut = between(base.motion, 0.1, 0.6 * base.motion.duration)
    found = verified(moving.problem, cut, now, base)
    assert found.committed is None
    assert found.sentence == "it does not end at rest"


def test_what_goes_too_fast_or_is_no_number_is_refused(moving):
    base = moving.committed
    quick = JointMotion(
        0.8 * base.motion.t, base.motion.q, base.motion.dq / 0.8, base.motion.ddq / 0.64
    )  # a time-optimal motion in 80 % of its time
    found = verified(moving.problem, quick, 0.0, None)
    assert found.committed is None
    assert "exceeded" in found.sentence
    lost = replace(quick, q=np.where(np.arange(len(quick.q))[:, None] == 3, np.nan, quick.q))
    assert "not numbers" in verified(moving.problem, lost, 0.0, None).sentence


def test_a_verdict_ends_at_the_first_check_that_fails_unless_it_is_to_be_thorough(moving, monkeypatch):
    """A motion in .8 of its time violates limits of its reference: known without what the arm strays, which is looked
    at for one that violates none."""
    base, problem = moving.committed, moving.problem
    whole, short = (verified(problem, base.motion, 3.0, None, thoroughly=x) for x in (True, False))
    assert short.excess == whole.excess < 0.0
    assert np.array_equal(short.committed.margins.row, whole.committed.margins.row)
    quick = JointMotion(0.8 * base.motion.t, base.motion.q, base.motion.dq / 0.8, base.motion.ddq / 0.64)
    thorough = verified(problem, quick, 3.0, None, thoroughly=True)
    monkeypatch.setattr(VerdictEvaluation, "response", property(lambda _: pytest.fail("the deviation was sought")))
    found = verified(problem, quick, 3.0, None)
    assert found.committed is None
    assert 0.0 < found.excess <= thorough.excess
    assert found.slower <= thorough.slower
    assert found.what.split(" of ")[0] in ("acceleration", "jerk", "torque rate", "tilt")


@pytest.mark.slow
def test_it_knows_what_a_wrong_load_has_brought_the_arm_into(bottle):
    """The deviation that goes on from motion to motion is that of all of them as one."""
    live = Live(bottle, lead=LEAD)
    states = drive(live, 1.4, [(0.0, place(0.45, 0.1, 0.5)), (0.35, place(0.5, -0.3, 0.55))])
    motion = executed(states)
    t = motion.t
    z = np.stack([*motion.sample(t), motion.jerk(t)])
    response = live.problem.at(t / motion.duration, z, motion.duration).response
    now = live.committed.begins + 0.2
    whole = response.state_at(t, now)
    carried = live.committed.deviation_at(now, live.problem)
    scale = np.abs(np.stack([response.joints.q, response.joints.dq])).max(axis=(1, 2))[:, None, :]
    assert (np.abs(whole - carried)[..., :-1] / scale).max() < 0.01  # nodes every 2 ms, against every 1 ms


def test_contact_keeps_a_margin_also_where_the_scenario_asks_for_none(cube, moving):
    """0.1 % of what holds, at peaks between the instants that are looked at. Of a load that slides on the way."""
    motion = moving.committed.motion
    at = verified(moving.problem, motion, 3.0, None).committed.margins.t
    assert at[[0, -1]] == pytest.approx([3.0, 3.0 + motion.duration + moving.problem.tracking.settling])
    problem = Live(cube.with_changes(contact__margin=0.0, objects__0__friction=0.2)).problem
    t = Judged.of(problem, motion).t
    z = np.stack([*motion.sample(t), motion.jerk(t)])
    blocks = evaluate(problem.constraints, problem.at(t / t[-1], z, t[-1], imposed=False))
    contacts = [block for block in blocks if isinstance(block.of, ContactConstraint)]
    more = 1e-3 - contacts[0].margins[1]  # the rows hold a margin already
    assert more > 5e-4
    found = verified(problem, motion, 3.0, None)
    assert found.sentence.startswith("contact of cube would be exceeded")
    # Derivatives of the dynamics are known every 10 ms to the verdict, here at every node.
    assert found.excess == pytest.approx(max(peaks(t, block.values).max() for block in contacts) + more, abs=1e-5)


@pytest.mark.slow
def test_a_margin_that_the_scenario_asks_for_is_kept_once_and_not_several_times(bottle):
    """With a twentieth of the normal force at rest as margin a goal takes 1.2 times as long as with almost none."""
    durations = []
    for margin in (1e-3, 0.05):
        live = Live(bottle.with_changes(contact__margin=margin), lead=LEAD)
        live.command(0.0)
        live.goto((0.45, 0.1, 0.5))
        live.plan(60.0)
        durations.append(live._offer.committed.motion.duration)
    assert 1.0 < durations[1] / durations[0] < 1.4


def test_distances_of_ones_own_are_looked_at_beside_those_that_are_kept_anyway(moving):
    """A metre more than the arm's parts have."""
    problem, motion = moving.problem, moving.committed.motion
    wide = KeepOut(problem.keep_out.parts, problem.keep_out.required + 1.0)
    found = verified(replace(problem, extra=(Clearance(wide),)), motion, 3.0, None)
    assert found.what.startswith("clearance of ")
    assert 8.0 < found.excess < 10.0  # in units of 0.1 m, less what there is beyond what is asked for
    assert verified(replace(problem, extra=(Clearance(problem.keep_out),)), motion, 3.0, None).committed is not None


def test_a_verdict_looks_at_the_distances_of_the_pairs_that_come_near(moving, monkeypatch):
    """To 5 cm or less; there are none that come just so near. It is what a verdict on what is far would cost most."""
    problem, motion, asked = moving.problem, moving.committed.motion, []
    rows = Judged.rows
    monkeypatch.setattr(Judged, "rows", lambda self, of, *given: asked.append(of) or rows(self, of, *given))
    assert verified(problem, motion, 3.0, None).committed is not None
    (looked,) = (x.keep_out.parts.pairs for x in asked if isinstance(x, Clearance))
    apart = problem.keep_out.parts.clearance(motion.sample(np.linspace(0.0, motion.duration, 150))[0]).min(axis=0)
    assert np.abs(apart - CLEARANCE.near).min() > 1e-4
    assert sorted(looked) == sorted(
        pair for pair, low in zip(problem.keep_out.parts.pairs, apart, strict=True) if low < CLEARANCE.near
    )
    assert 0 < len(looked) < 0.5 * len(apart)


def test_the_executed_is_the_same_in_pieces(moving):
    motion = moving.committed.motion
    parts = joined(between(motion, 0.0, 0.123), between(motion, 0.123, motion.duration))
    t = np.linspace(0, motion.duration, 200)
    for mine, other in zip(parts.sample(t), motion.sample(t), strict=True):
        assert np.abs(mine - other).max() < 1e-9


@pytest.mark.slow
def test_what_a_search_calls_safe_is_looked_at_all_the_same(cube, monkeypatch):
    """A search that answers with twice the speed, and says that it is safe."""

    def careless(problem, curve_of, start, *args, **kwargs):
        found = optimise(problem, curve_of, start, *args, **kwargs)
        return replace(found, duration=0.5 * found.duration)

    def careless_at_nodes(*args):
        found = minimise(*args)
        point = found.iterate.point
        return replace(found, iterate=replace(found.iterate, point=replace(point, duration=0.5 * point.duration)))

    def also_careless(problem, options):
        found = fastest(problem, options)
        return replace(found, duration=0.5 * found.duration)

    monkeypatch.setattr("salver.live.replanning.replan.optimise", careless)
    monkeypatch.setattr("salver.live.replanning.replan.minimise", careless_at_nodes)
    monkeypatch.setattr("salver.live.replanning.replan.fastest", also_careless)
    live = Live(cube, lead=LEAD)
    states = drive(live, 0.2, [(0.0, place(0.45, 0.1, 0.45))])
    assert not np.any(states[1])
    assert "is refused" in live.state.refused


def test_resting_is_a_motion_too(cube):
    live = Live(cube)
    motion = resting(live.problem.start.q)
    assert verified(live.problem, motion, 3.0, live.committed).committed is not None


def test_a_stop_is_sought_only_where_it_would_come_sooner(cube, monkeypatch):
    """The last tenth of a second of a motion is a stop: no shorter one is looked for, which would take as long."""
    live = Live(cube, lead=LEAD)
    drive(live, 0.2, [(0.0, place(0.45, 0.1, 0.45))])
    base, planner, sought = live.committed, Planner(live.problem), []
    to = Replanner.to
    monkeypatch.setattr(Replanner, "to", lambda *given, **how: sought.append(given) or to(*given, **how))
    early = planner.answer(Job(Halt(), base, base.ends - 0.4, 60.0))
    assert early.found is not None
    assert early.found.ends < base.ends
    assert len(sought) == 1
    late = planner.answer(Job(Halt(), base, base.ends - 0.09, 60.0))
    assert late.found is None
    assert late.done
    assert len(sought) == 1
    # While one motion follows another, a joint may be as far off as on either of them.
    own = early.found.stray(live.problem)
    other = own * np.where(np.arange(len(own)) % 2, 2.0, 0.5)
    both = replace(live._running, stray=other, allowed=other).then(early.found, Halt(), live.now, live.problem)
    assert np.array_equal(both.allowed, np.maximum(own, other))


@pytest.mark.slow
def test_a_motion_that_is_a_little_too_quick_between_the_nodes_is_made_longer_once(bottle, monkeypatch):
    """By what would do from rest, one that begins moving is not mended: then three looks in a row were in vain."""
    bottle = bottle.with_changes(motion__speeds="full")  # which is what time mends
    live, rng, judged, looks = Live(bottle, lead=LEAD), np.random.default_rng(4), Replanner._judged, []

    def seen(self, at, found, before, begins):
        finding = judged(self, at, found, before, begins)
        looks.append((found.duration, finding))
        return finding

    monkeypatch.setattr(Replanner, "_judged", seen)
    mended, how = [], ReplanOptions()
    for wait in 10 * (0.2, 0.3):
        goal = rng.uniform([0.40, -0.40, 0.35], [0.55, 0.15, 0.60])
        looks.clear()
        drive(live, wait, [(0.0, lambda live, goal=goal: live.goto(goal))], begins=live.now)
        if len(looks) > 1 and looks[0][1].slower < how.stretched:
            (first, refused), (second, finding) = looks[:2]
            mended.append(finding.committed is not None)
            assert second == pytest.approx(first * (1.0 + how.amply * refused.slower + how.a_little))
    assert len(mended) > 3
    assert np.mean(mended) > 0.7


def test_a_posture_in_which_the_load_would_not_stay_is_refused_at_once(cube, monkeypatch):
    """With the tray leaning by .6 rad and friction of .4 the cube slides at rest, however slowly the arm goes there."""
    live = Live(cube, lead=LEAD)
    leaning = live.committed.motion.q[0] + np.array([0, 0, 0, 0, 0, 0.6, 0])
    monkeypatch.setattr(Replanner, "to", lambda *given, **how: pytest.fail("a way there was sought"))
    answer = Planner(live.problem).answer(Job(Goal(AtPosture(leaning), "leaning"), live.committed, 0.1, 60.0))
    assert answer.found is None
    assert "would not be safe at rest there" in answer.status.sentence


@pytest.fixture
def asked(cube):
    """At rest, and asked for a goal, with what the planner proposes for it."""
    live = Live(cube, lead=LEAD)
    live.command(0.0)
    live.goto((0.45, 0.1, 0.45))
    return live, live._planner.answer


def altered(motion, times):
    """It, so many times as fast."""
    return JointMotion(motion.t / times, motion.q, motion.dq * times, motion.ddq * times**2)


def taken(live, answer):
    live.plan(60.0, answer)
    drive(live, 0.3, every=None)
    return live.committed


def test_an_answer_that_was_altered_after_it_was_verified_is_not_done(asked):
    """2.2 times as fast it would throw the load."""
    live, answer = asked

    def faster(job):
        found = answer(job)
        return replace(found, found=replace(found.found, motion=altered(found.found.motion, 2.2)))

    assert taken(live, faster).at_rest
    assert "would be exceeded by" in live.refused


def test_an_answer_of_somebody_else_is_verified_and_then_done(asked):
    """A little slower than what was proposed it is safe, though nobody has said so; what it claims of the arm's
    deviation is not believed."""
    live, answer = asked
    claimed = []

    def slower(job):
        found = answer(job)
        claimed.append(replace(found.found, motion=altered(found.found.motion, 0.95), deviation=None, seal=b"x" * 32))
        return replace(found, found=claimed[0])

    committed = taken(live, slower)
    assert np.array_equal(committed.motion.t, claimed[0].motion.t)
    assert committed is not claimed[0]
    assert committed.deviation is not None


def test_a_sealed_answer_is_done_as_it_is_wherever_it_was_found(asked, monkeypatch):
    """By a planner in another process: nothing is verified a second time."""
    live, answer = asked
    monkeypatch.setattr("salver.live.live.verified", None)

    def sent(what):
        return pickle.loads(pickle.dumps(what))  # noqa: S301

    committed = taken(live, lambda job: sent(answer(sent(job))))
    assert not committed.at_rest
    assert sealed(committed, live._running.after, live.problem)


def test_a_seal_is_of_one_motion_after_one_other_with_one_load(asked, cube):
    live, answer = asked
    base = live.committed
    found = answer(Job(live._wish, base, 0.1, 60.0)).found
    assert sealed(found, base, live.problem)
    other = Live(cube.with_changes(objects__0__mass=0.3), lead=LEAD)
    assert not sealed(found, other.committed, live.problem)
    for name, value in (
        ("begins", found.begins + 1e-3),
        ("deviation", 0.999 * found.deviation),
        ("off", 0.5 * found.off),
        ("margins", replace(found.margins, row=found.margins.row - 0.1)),
        ("motion", altered(found.motion, 1.0001)),
        ("seal", b""),
    ):
        assert not sealed(replace(found, **{name: value}), base, live.problem), name
    key = seal.key()
    seal.use(b"another process")
    assert not sealed(found, base, live.problem)
    seal.use(key)
    assert sealed(found, base, live.problem)


@pytest.mark.slow
def test_a_planner_in_another_process_seals_with_the_key_of_this_one(cube):
    live = Live(cube)
    process = _Process(live)
    try:
        live.goto((0.5, -0.25, 0.45))
        answer = process.answer(Job(live._wish, live.committed, 0.1, 60.0))
        assert sealed(answer.found, live.committed, live.problem)
    finally:
        process.close()
