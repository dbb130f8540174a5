"""Live motions with open liquids: waves go on from motion to motion, and nothing is spilt, now or later."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import salver as sv
from live_runs import APART, LEAD, ROUNDS, check, drive, executed, in_turn, place, rows_of
from salver.dynamics.modal_history import Past
from salver.errors import ScenarioError, Status
from salver.live import Live
from salver.live.committed.commit import verified
from salver.live.committed.motion import between
from salver.live.replanning.objective import TwistWanted
from salver.live.replanning.steer import STANDARD, TICK, Steering
from salver.planning.fastest import evaluate, joint_plan
from salver.planning.trajopt.constraints.load_limits import LoadConstraint
from salver.planning.trajopt.evaluation import NOTHING
from salver.planning.verdict.judged import Judged
from salver.sensitivity.arm.compliance import LoadResponses
from transport_problems import cup_and_jar

FULL = {"fill": 0.065, "damping": 0.00168, "mass": 0.275, "friction": 0.36}
LOW = {"fill": 0.035, "damping": 0.03, "mass": 0.225, "friction": 0.44}


@pytest.fixture(scope="module")
def changed(coffee):
    """A goal that is changed while the arm moves, and again when it has just come to rest and the waves have not; what
    is committed then, and what was told."""
    placed = coffee.with_changes(objects__0__uncertainty__position=[0.002, 0.0])
    live, bases = Live(placed, lead=LEAD), []

    def noted(wish):
        def say(live):
            bases.append(live.committed)
            wish(live)

        return say

    wishes = [(0.0, place(0.45, 0.1, 0.45)), (0.35, noted(place(0.5, -0.3, 0.4))), (1.4, noted(place(0.5, -0.1, 0.45)))]
    told = drive(live, 1.7, wishes)
    return live, [*bases, live.committed], told


def whole(problem, told) -> Past:
    """The waves of all that was told, as one motion from its beginning at rest."""
    motion = executed(told)
    t = motion.t
    jerk = 0.5 * (motion.jerk(t) + motion.jerk(np.maximum(t - APART, 0.0)))
    at = problem.at(t / motion.duration, np.stack([*motion.sample(t), jerk]), motion.duration, imposed=False)
    return LoadResponses.of(problem.every_case, t, at.terms.w, at.response, rounds=ROUNDS).past(t)


def off(mine, other) -> float:
    """How far arrays are from others, as a share of the largest."""
    return float(np.abs(mine - other).max() / np.abs(other).max())


@pytest.mark.slow
def test_waves_that_go_on_from_motion_to_motion_are_those_of_all_as_one(changed):
    """At every fill and damping, as planned, with what the arm makes of them, and of what is uncertain."""
    live, bases, told = changed
    problem, now = live.problem, [base.begins for base in bases[1:]]
    assert now[1] > bases[1].ends  # once from rest, in which the waves go on
    one = whole(problem, told)
    for base, begins in zip(bases, now, strict=False):
        found = base.left(begins, problem).past.begun(problem.every_case)
        known = replace(one, now=begins).begun(problem.every_case)
        assert np.abs(known.planned.r).max() > 1e-3  # m: there are some
        for name in ("planned", "compliant", "change"):
            for what in ("r", "rate"):
                assert off(getattr(getattr(found, name), what), getattr(getattr(known, name), what)) < 5e-3, (
                    name,
                    what,
                )
        assert off(found.planned.r, known.planned.r) < 1e-3
        assert off(found.reaction[0], known.reaction[0]) < 0.02  # by three rounds, against eight
        np.testing.assert_allclose(found.compliant.spin, known.compliant.spin, atol=1e-3)
        np.testing.assert_allclose(found.compliant.peak, known.compliant.peak, rtol=5e-3)


@pytest.mark.slow
def test_nothing_is_spilt_when_goals_change_and_it_is_stopped(changed):
    """By the rows of all that was told and of the rest after it; in the engine at both ends of what is uncertain."""
    live, _, told = changed
    told = in_turn(told, drive(live, 1.5, [(0.0, Live.stop)], begins=1.7))
    check(live, told)
    assert holds(live, told, FULL, LOW)
    assert live.state.refused == ""


def test_rows_of_waves_change_with_a_bend_as_differences_say(changed, monkeypatch):
    """The arm gives way to what it is bent to as it does to what is committed. The posture at the end stays: rows of
    what is left take it as given."""
    live, (base, *_), _ = changed
    steering, noted = live._planner._steering, []
    rows, unknowns = Steering._rows, Steering._unknowns
    monkeypatch.setattr(Steering, "_unknowns", lambda self, motion: noted.append(motion) or unknowns(self, motion))
    monkeypatch.setattr(Steering, "_rows", lambda self, *of: noted.append((*of, rows(self, *of))) or noted[-1][-1])
    begins = TICK * round((base.begins + 0.18) / TICK)
    steering._increment(TwistWanted(np.zeros(6), np.zeros(6), begins), base, begins)
    motion, (blocks, masks, _, matrix) = noted[:2]
    bend = 1e-5 * np.random.default_rng(1).normal(size=(steering.grid.basis.shape[2], live.problem.n))
    bend[[0, -1]] = 0.0

    def values(sign):
        bent = replace(motion, z=motion.z + sign * steering.grid.motion(bend, STANDARD.horizon), known=NOTHING)
        return evaluate(constraints, bent.giving_way_as(motion))

    constraints = list(dict.fromkeys(block.of for block in blocks))
    after, before = values(1.0), values(-1.0)
    begin, looked = 0, 0
    for block, mask, one, other in zip(blocks, masks, after, before, strict=True):
        count = int(mask.sum())
        if isinstance(getattr(block.of, "judged", block.of), LoadConstraint) and count:
            change = 0.5 * (one.values - other.values)[mask]
            said = matrix[begin : begin + count] @ bend.ravel()
            # Of waves that the arm gives way to the derivatives are those of waves as planned.
            planned, most = np.nonzero(mask)[1] < len(live.problem.cases[0]), np.abs(change).max()
            np.testing.assert_allclose(said[planned], change[planned], atol=2e-3 * most, err_msg=block.name)
            np.testing.assert_allclose(said[~planned], change[~planned], atol=0.2 * most, err_msg=block.name)
            looked += count
        begin += count
    assert looked >= 8


@pytest.mark.slow
def test_a_twist_that_reverses_spills_nothing(coffee):
    live = Live(coffee, lead=0.02)
    speeds = [(0.4, 0.0, 0.0), (-0.6, 0.5, 0.0), (0.3, -0.8, 0.2), (0.0, 0.9, -0.2)]
    said = [(0.01 * k, lambda live, k=k: live.twist(speeds[k // 15 % 4])) for k in range(60)]
    told = in_turn(drive(live, 0.6, said), drive(live, 1.2, begins=0.6))
    assert np.abs(told.dq).max() > 0.3
    check(live, told)
    assert holds(live, told, FULL)


def holds(live, told, *each) -> bool:
    plan = joint_plan(live.problem.scenario, live.problem, executed(told), Status("optimal", "", True), {})
    return all(sv.simulate(plan, parameters=parameters).outcome == "holds" for parameters in each)


def test_calm_water_is_never_taken_for_granted(changed):
    """A motion that goes on from one that is under way, of which nobody knows the waves, is a mistake."""
    live, (base, *_), _ = changed
    with pytest.raises(ScenarioError, match="unless it is known how it moves"):
        verified(
            live.problem, between(base.motion, 0.2, base.motion.duration), base.begins + 0.2, replace(base, loads=None)
        )


def test_where_how_a_liquid_moves_is_not_known_the_arm_rests_until_it_is_calm(coffee):
    live = Live(coffee, lead=LEAD)
    drive(live, 0.2, [(0.0, place(0.45, 0.1, 0.45))])
    assert not live.committed.at_rest
    live.measured(live.command(0.2)[0] + 0.1)  # the arm is elsewhere
    assert live.state.doing == "stopping"
    for wish in (
        place(0.5, 0.0, 0.5),
        lambda live: live.twist((0.1, 0, 0)),
        lambda live: live.chunk([0.5], [(0.5, 0, 0.5)]),
    ):
        status = wish(live)
        assert not status.ok
        assert status.sentence.endswith(
            "how the liquid in cup moves is not known any more; restart(q, calm=True) when it stands still."
        )
    drive(live, 1.0, every=None, begins=0.2)
    q = live.command(1.2)[0].copy()
    refused = live.restart(q)
    assert (
        refused.sentence
        == "A restart is refused: the liquid in cup may still move; say calm=True when it stands still."
    )
    assert live.restart(q, calm=True).ok
    assert not live.goto((0.5, 0.0, 0.5)).ok
    assert live.resume().ok
    assert live.goto((0.5, 0.0, 0.5)).ok
    live.command(9.0)  # nor after a clock that jumped, for waves go on meanwhile
    assert not live.goto((0.5, 0.0, 0.5)).ok


def test_a_solid_load_needs_no_calm(cube):
    live = Live(cube, lead=LEAD)
    live.command(0.0)
    live.command(9.0)
    assert live.goto((0.5, 0.0, 0.5)).ok
    assert live.restart(live.committed.motion.q[0]).ok


@pytest.mark.slow
def test_at_rest_waves_go_on_and_die_away(changed):
    """For eight seconds: as worked out of all of them at once, and undisturbed as damped pendulums do."""
    live, (_, base, _), _ = changed
    problem, cases = live.problem, live.problem.every_case
    begun = base.left(base.ends, problem)
    t, z = np.linspace(0.0, 8.0, 801), np.zeros((4, 801, problem.n))
    z[0] = base.motion.q[-1]
    at = begun.at(t / 8.0, z, 8.0)
    one = LoadResponses.of(cases, t, at.terms.w, at.response, begun.past, rounds=4 * ROUNDS).past(t)

    def both(seconds):
        found = base.left(base.ends + seconds, problem).past.begun(cases)
        return found, replace(one, now=seconds).begun(cases)

    for seconds in (0.3, 1.0, 3.0):
        found, known = both(seconds)
        for name in ("planned", "compliant", "change"):
            for what in ("r", "rate"):
                assert off(getattr(getattr(found, name), what), getattr(getattr(known, name), what)) < 0.01
    found, known = both(8.0)  # the arm that gives way has been left out for a while: it brakes them
    assert off(found.planned.r, known.planned.r) < 1e-3
    assert off(found.compliant.r, known.compliant.r) < 0.3
    end = begun.past.begun(cases)
    which = [case for liquid in cases for case in liquid]
    omega = np.stack([case.modes.omega for case in which])
    sigma = omega * np.array([case.damping for case in which])[:, None, None]

    def size(waves):
        return np.hypot(waves.r, waves.rate / omega)

    np.testing.assert_allclose(size(found.planned), np.exp(-8.0 * sigma) * size(end.planned), rtol=0.1, atol=2e-5)


def test_a_rest_goes_on_at_whatever_time_it_began(changed):
    """Also where the sum of when a motion began and how long it took is rounded up, or down."""
    live, (_, base, _), _ = changed
    problem, ends = live.problem, base.loads.t[-1]
    cases = problem.every_case
    known = base.left(base.ends + 0.205, problem).past.begun(cases)
    begins = np.linspace(1.0, 30.0, 400)
    rounded = (begins + ends) - begins - ends
    for begun in (begins[np.argmax(rounded)], begins[np.argmin(rounded)]):
        assert (begun + ends) - begun != ends
        later = replace(base, begins=begun, nodes=base.nodes - base.begins + begun)
        found = later.left(later.ends + 0.205, problem).past.begun(cases)
        np.testing.assert_allclose(found.compliant.r, known.compliant.r, atol=1e-9)


def test_on_a_tray_that_leans_a_calm_surface_stays_where_it_is(changed):
    live, (base, *_), _ = changed
    problem, z = live.problem, np.zeros((4, 21, live.problem.n))
    z[0] = base.motion.q[-1] + 0.1 * (np.arange(live.problem.n) == 5)
    at = problem.at(np.linspace(0.0, 1.0, 21), z, 0.2)
    now = replace(at.left, now=0.2).begun(problem.cases).planned.r
    assert np.abs(now).max() > 1e-3  # m
    np.testing.assert_allclose(at.rested(2.0).begun(problem.cases).planned.r, now, atol=1e-9)


def test_how_far_the_arm_may_stray_includes_that_it_gives_way_to_waves(changed):
    live, (before, base, *_), _ = changed
    found = Judged.of(before.left(base.begins, live.problem), base.motion).along.joint_radius(0).max(axis=0)
    alone = replace(base, loads=None).stray(live.problem)
    assert np.all(base.stray(live.problem) >= 0.999 * found)
    assert np.all(found >= alone)
    assert (found / alone).max() > 1.1


def test_the_rest_after_a_motion_is_judged_with_the_waves_and_the_deviation_that_there_are_then(changed):
    live, (before, base, *_), _ = changed
    after = Judged.of(before.left(base.begins, live.problem), base.motion).along.rest
    wanted, cases = base.left(base.ends, live.problem), live.problem.every_case
    found, there = (at.past.begun(cases).planned.r for at in (after, wanted))
    assert np.abs(there).max() > 1e-4  # m
    np.testing.assert_allclose(found, there, atol=1e-9)
    np.testing.assert_allclose(after.tracking.start, wanted.tracking.start, atol=1e-9)
    assert np.abs(wanted.tracking.start).max() > 1e-4


def test_a_long_stir_does_not_count_for_ever(changed):
    """How far the phase of a high wave may have drifted is a wave as well, and dies away."""
    live, (_, base, _), _ = changed
    cases = live.problem.every_case
    end, later = (base.left(base.ends + more, live.problem).past.begun(cases).compliant.peak for more in (0.0, 65.0))
    damping = np.array([case.damping * case.modes.omega[0, 0] for liquid in cases for case in liquid])
    np.testing.assert_allclose((later / end) ** 3, np.exp(-damping * 60.0), rtol=1e-2)


@pytest.mark.slow
def test_what_stands_on_a_tray_that_leans_after_a_stop_stays_in_the_wave_after_it():
    """Judged as one motion with a second of rest: a stop that ended on 12 degrees broke its cup's contact by .02 then,
    and made its waves steeper than is known."""
    live = sv.Live(cup_and_jar(), lead=0.1)
    wishes = [(0.0, lambda _: live.goto((0.464, -0.303, 0.305))), (0.2, lambda _: live.stop())]
    rows = rows_of(live.problem, drive(live, 1.6, wishes))
    assert live.committed.ends < 1.0
    assert max(rows.values()) <= 0.0, rows
