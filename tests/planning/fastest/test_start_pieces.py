"""Where searches for a motion begin, each piece by hand: what a pair of ends costs, and which paths there are."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from salver import scenario
from salver.errors import Status
from salver.models.arm.arm_limits import POSITION
from salver.planning.fastest import FastestOptions, search, transport_problem
from salver.planning.fastest.optimum import few_pieces
from salver.planning.seeds.starts import (
    EndOptions,
    Ends,
    Start,
    _apart,
    _cost,
    _Found,
    _shape,
    _sought,
    _stray_at_rest,
    _unwound,
    between,
    braking_time,
    ends,
    guess,
    slid_free,
    straight,
    touches,
)
from salver.planning.trajopt.constraints.constraints import strayed
from salver.planning.trajopt.constraints.obstacles import CLEARANCE, KeepOut
from salver.planning.trajopt.ends import AtPose, AtPosture
from salver.planning.trajopt.found import FastestMotion
from salver.planning.trajopt.problem import TransportProblem
from salver.planning.trajopt.spline import RestSpline
from salver.planning.trajopt.watch import Watch
from salver.scenario import Scenario

SOUGHT = EndOptions()


@pytest.fixture(scope="module")
def plain() -> TransportProblem:
    """The paper's cube, known exactly, with nothing around."""
    return replace(
        transport_problem(scenario.load("panda-cube").with_changes(objects__0__uncertainty={})), keep_out=None
    )


@pytest.fixture(scope="module")
def pair(behind_a_post: TransportProblem) -> Ends:
    return ends(behind_a_post, np.random.default_rng(0))[0]


def test_between_two_ends_no_joint_turns_by_more_than_half_a_turn_if_its_range_has_a_shorter_way() -> None:
    """A UR5e on a wall whose tray passes below the base's axis: 2.3 rad of its first joint, or 4 rad the other way, on
    which nothing was found. Only its elbow, which ends at half a turn, may turn by more."""
    shape = {"type": "cylinder", "radius": 0.03, "height": 0.14}
    data = {
        "name": "wall",
        "motion": {"start": {"position": [0.55, -0.25, 1.0]}, "goal": {"position": [0.55, 0.25, 1.0]}},
        "objects": [{"shape": shape, "mass": 0.3, "friction": 0.4, "uncertainty": "none"}],
        "arm": {"model": "ur5e", "base_position": [0.0, 0.0, 1.0], "base_rpy_deg": [0.0, 90.0, 0.0]},
        "surroundings": {"floor": "none"},
    }
    problem = transport_problem(scenario.parse(data, "wall"))
    found = ends(problem, np.random.default_rng(0), few=4)
    assert len(found) >= 4
    for pair in found:
        assert pair.free
        assert np.all(np.abs(np.delete(pair.goal - pair.start, 2)) < np.pi)
        assert np.all((pair.goal > problem.limits.q_min) & (pair.goal < problem.limits.q_max))


def test_whole_turns_bring_an_arm_nowhere_and_rails_do() -> None:
    problem: Any = SimpleNamespace(arm=SimpleNamespace(linear=np.array([False, False, True])))
    q, turn = np.array([0.4, -0.3, 0.1]), 2 * np.pi
    for more, less, apart in (
        ([0.1, -0.2, 0.0], [0.0, 0.0, 0.0], 0.2),
        ([turn, -2 * turn, 0.0], [0.1, -0.3, 0.05], 0.3),
        ([0.0, 0.0, turn], [0.0, 0.0, 0.0], turn),
    ):
        assert _apart(problem, q + np.array(more), q + np.array(less)) == pytest.approx(apart)


def test_a_pair_of_ends_begins_no_whole_turn_away_and_a_rail_stays_where_it_is() -> None:
    limits = SimpleNamespace(range=lambda kind: (np.zeros(3), np.array([2 * np.pi, 2.9, 5.0])))
    problem: Any = SimpleNamespace(arm=SimpleNamespace(linear=np.array([False, False, True])), limits=limits)
    start, goal = _unwound(problem, np.array([3.0, 2.8, 4.9]), np.array([6.0, 2.9, 4.5]))
    np.testing.assert_allclose(start, [3.0 - 2 * np.pi, 2.8, 4.9])
    np.testing.assert_allclose(goal, [6.0 - 2 * np.pi, 2.9, 4.5])


def test_a_pair_of_ends_is_dearer_where_a_joint_is_at_its_limit(plain) -> None:
    """Without a way to go a pair costs nothing in the middle of the joints' ranges, and `at_limits` at their ends."""
    centre, half = plain.limits.range(POSITION)
    assert _cost(plain, centre, centre, SOUGHT) == pytest.approx(0.0, abs=1e-9)
    for joint in range(plain.n):
        for side in (-1, 1):
            q = centre + side * half * np.eye(plain.n)[joint]
            assert _cost(plain, q, q, SOUGHT) == pytest.approx(SOUGHT.at_limits)


def test_a_pair_of_ends_is_dearer_where_something_is_near(behind_a_post, pair) -> None:
    keep_out = behind_a_post.keep_out
    there = keep_out.parts.clearance(np.stack([pair.start, pair.goal])).min(axis=0)
    base, costs = _cost(behind_a_post, pair.start, pair.goal, SOUGHT), []
    for room in (0.01, 0.02, 0.05):
        found = _Found(replace(behind_a_post, keep_out=KeepOut(keep_out.parts, there - room)), SOUGHT)
        found.add(pair.start, pair.goal)
        costs.append(found.pairs[0].cost - base)
        assert found.pairs[0].free
    assert costs == pytest.approx([0.02 * SOUGHT.too_near, 0.01 * SOUGHT.too_near, 0.0], abs=1e-5)  # distances to 3 um


def test_pairs_differ_by_what_both_of_their_ends_do(plain, pair) -> None:
    found = _Found(plain, SOUGHT)
    for start, goal in ((0.0, 0.0), (0.1, 0.1), (0.2, 0.2), (0.0, 0.4)):
        found.add(pair.start + start, pair.goal + goal)
    assert [round(float((x.goal - pair.goal)[0]), 6) for x in found.pairs] == [0.0, 0.2, 0.4]


def test_a_path_is_gone_along_by_its_length_from_its_first_posture_to_its_last() -> None:
    postures = np.array([[0.0, 0.0], [0.0, 0.0], [3.0, 0.0], [3.0, 1.0]])  # it stays, and then goes 3 and 1
    assert Start("", postures).path(np.array([0.0, 0.5, 1.0])) == pytest.approx(np.array([[0, 0], [2, 0], [3, 1]]))
    assert Start("", postures[:2]).path(np.array([0.3])) == pytest.approx(np.zeros((1, 2)))


def test_an_arm_that_moves_is_given_the_time_to_brake_and_to_go(plain, pair) -> None:
    """Twice as long as braking takes at even deceleration, and what the slowest joint needs at its full speed."""
    limits, velocity = plain.limits, np.array([0.3, -0.6, 0.0, 0.2, 0.0, 0.0, 0.1])
    moving = replace(plain, start=AtPosture(pair.start, dq=velocity))
    brake = 4 * np.max(np.abs(velocity) / limits.acceleration)
    assert brake > 0.1
    assert braking_time(moving) == pytest.approx(brake)
    start = Start("", np.stack([pair.start, pair.goal + 1.0, pair.goal]))
    go = np.max(np.abs(pair.goal - pair.start) / limits.velocity)
    assert start.motion(moving, few_pieces(FastestOptions())).duration == pytest.approx(brake + go)


def test_goals_are_sought_from_where_a_moving_arm_would_coast_to_and_from_further_and_further_away(
    plain, pair, monkeypatch
) -> None:
    """Half its velocity times the time it has; then shares of the way to random postures."""
    velocity, asked = np.array([0.3, -0.6, 0.0, 0.2, 0.0, 0.0, 0.1]), []
    moving = replace(plain, start=AtPosture(pair.start, dq=velocity))
    monkeypatch.setattr(AtPose, "nearest", lambda end, arm, limits, q, *more: asked.append(q))
    ends(moving, np.random.default_rng(3))
    coasted, rng = pair.start + 0.5 * velocity * braking_time(moving), np.random.default_rng(3)
    for k, q in enumerate(asked[: SOUGHT.others]):
        assert q == pytest.approx(coasted + k / SOUGHT.others * (guess(moving, rng, k) - coasted))
    assert asked[0] == pytest.approx(coasted)


def test_of_postures_in_which_an_arm_stands_and_moves_alike_one_is_kept() -> None:
    """An arm with a spherical shoulder and wrist, of which each posture has twins."""
    case = scenario.load("gen3-cup").with_changes(arm__start_posture=None, arm__gains=None)
    problem = transport_problem(case)
    found = _sought(problem, np.random.default_rng(0), 0, EndOptions(attempts=20, batches=1))
    shapes = [np.stack([_shape(problem, q) for q in pair[1:]]) for pair in found]
    costs = [cost for cost, _, _ in found]
    assert costs == sorted(costs)
    for k in range(len(found)):
        for j in range(k):
            stands_alike = np.abs(shapes[k] - shapes[j]).max() < 0.03
            assert not (stands_alike and costs[k] < 1.03 * costs[j])
    assert 2 < len(found) < 15  # of 20


def test_a_posture_that_isslid_free_has_the_room_that_an_end_needs(behind_a_post) -> None:
    problem = transport_problem(behind_a_post.scenario.with_changes(arm__start_posture=None, motion__goal_yaw="fixed"))
    rng, free = np.random.default_rng(1), 0
    for attempt in range(12):
        q = problem.start.nearest(problem.arm, problem.limits, guess(problem, rng, attempt))
        if q is None or problem.keep_out.distances(q[None]).min() >= CLEARANCE.enough_at_ends:
            continue
        slid = slid_free(problem, problem.start, q)
        assert np.abs(problem.start.residual(problem.arm, slid)[0]).max() < 1e-6
        left = problem.keep_out.distances(slid[None]).min()
        assert not -0.01 < left < CLEARANCE.enough_at_ends  # not left as soon as it hardly touches
        free += left >= CLEARANCE.enough_at_ends
    assert free > 0


# Past what stands in the way ------------------------------------------------------------------------------------


# Which of them are begun, and how long ---------------------------------------------------------------------------


def a_rough(duration: float, violation: float = 0.0) -> Any:
    coefficients = np.full((few_pieces(FastestOptions()).size, 7), duration)  # unlike others by its duration
    return SimpleNamespace(
        iterate=SimpleNamespace(duration=duration, violation=violation, coefficients=coefficients, blocks=[])
    )


def searching(problem: TransportProblem, **options: Any) -> search._Search:
    return search._Search(problem, FastestOptions(**options), Watch(), [], np.random.default_rng(0))


def test_another_start_has_to_be_a_hundredth_shorter_than_those_that_are_refined(plain) -> None:
    one = searching(plain, starts=2)
    begin: Any = plain, None
    roughs = [(begin, a_rough(x, y)) for x, y in ((1.5, 0.0), (0.7, 0.1), (1.0, 0.0), (1.2, 0.0))]
    assert one._beat(roughs) == pytest.approx((1 - FastestOptions.rough_gain) * 1.2)  # what breaks a row does not count
    assert one._beat(roughs[:3]) == pytest.approx((1 - FastestOptions.rough_gain) * 1.5)
    assert one._beat(roughs[:2]) == np.inf
    best = cast(Any, SimpleNamespace(duration=1.0, status=Status("optimal", "", True)))
    assert [one._hopeful((begin, a_rough(x)), best) for x in (0.98, 0.995)] == [True, False]


def test_a_path_promises_the_less_the_deeper_it_is_in_something(behind_a_post, pair) -> None:
    line = straight(pair)
    deep, free = touches(behind_a_post, line), replace(behind_a_post, keep_out=None)
    assert deep > 0.01
    assert search._promise((behind_a_post, line)) == pytest.approx(line.least(free) * (1 + 8.0 * deep))
    assert search._promise((free, line)) == pytest.approx(line.least(free))


def test_where_a_straight_path_is_blocked_ways_around_and_straight_paths_are_begun(behind_a_post, pair) -> None:
    """Each from a start to a goal."""
    one = searching(behind_a_post, ways=1)
    one.pairs = [pair]
    begun = one._first()
    names = [start.name for _, start in begun]
    assert names[0] == "way around"
    assert "straight path of the joints" in names
    promises = [search._promise(begin) for begin in begun[names.count("way around") :]]
    assert promises == sorted(promises)
    way = next(one._further())
    assert way[1].name == "way around"
    for problem, start in (*begun, way):
        assert np.abs(start.postures[0] - pair.start).max() < 1e-9
        assert np.abs(problem.goal.residual(problem.arm, start.postures[-1])[0]).max() < 1e-6


def test_the_shortest_ways_around_come_first(behind_a_post, pair, monkeypatch) -> None:
    """Of three times as many as are wanted."""
    one, lengths = searching(behind_a_post, ways=1), iter((0.3, 0.0, 0.2))
    one.pairs = [pair]
    aside = np.linspace(0.0, 1.0, 7)
    monkeypatch.setattr(
        search, "around", lambda *_: Start("way", np.stack([pair.start, pair.goal + next(lengths) * aside, pair.goal]))
    )
    first = one._first()
    assert [start.name == "way" for _, start in first] == [True] + [False] * (len(first) - 1)
    np.testing.assert_array_equal(first[0][1].postures[1], pair.goal)


def test_on_a_way_the_distances_are_kept_that_both_of_its_ends_keep(behind_a_post, pair, monkeypatch) -> None:
    """Here no more than there is at the goal."""
    parts = behind_a_post.keep_out.parts
    near = replace(behind_a_post, keep_out=KeepOut(parts, parts.clearance(pair.goal[None])[0] + 1e-3))
    way = Start("way", np.stack([pair.start, 0.5 * (pair.start + pair.goal), pair.goal]))
    monkeypatch.setattr(search, "around", lambda *_: way)
    ((problem, start),) = searching(near, ways=1)._ways()
    assert start is way
    np.testing.assert_allclose(problem.keep_out.required, between(near, pair).keep_out.required, atol=1e-5)  # to 3 um
    assert np.all(problem.keep_out.distances(pair.goal[None]) > 0)


def test_the_shortest_safe_motion_is_kept_and_what_brings_nothing_is_given_up(plain, pair, monkeypatch) -> None:
    """Of many starts that all take as long only some are tried; of those that are refined the best that is safe is
    kept, whichever came first."""
    rough_s, spline, shares = [], RestSpline(5, 8), []
    refined = iter([(True, 1.2), (False, 0.5), (True, 0.9), (True, 1.0)])

    def finish(self: Any, problem: TransportProblem, start: Start, found: Any, beat: float) -> FastestMotion:
        ok, duration = next(refined)
        status = Status("optimal" if ok else "infeasible", "", ok)
        return FastestMotion(spline, np.zeros((spline.size, 7)), duration, problem, status, {}, ("torque",), 0.0, 1)

    def begin(self: Any, problem: TransportProblem, start: Start, beat: float = np.inf) -> Any:
        rough_s.append(1.0 + 0.2 * len(rough_s) if len(rough_s) < 4 else 2.0)
        return (problem, start), a_rough(rough_s[-1])

    monkeypatch.setattr(search._Search, "_refined", finish)
    monkeypatch.setattr(search._Search, "_rough", begin)
    aside = np.outer([0.0, 1.0, 0.0], np.ones(7))
    ways = [Start("way", np.linspace(pair.start, pair.goal, 3) + 0.02 * i * aside) for i in range(60)]
    monkeypatch.setattr(search._Search, "_first", lambda self: [(plain, way) for way in (ways[0], *ways, *ways)])
    one = searching(plain, starts=4)
    one.pairs, one.watch = [pair], Watch(tell=lambda watch: shares.append(watch.share))
    found = one.best()
    assert found.status.ok
    assert found.duration == 0.9
    assert len(rough_s) == 4 + FastestOptions().patience * 4
    assert shares == sorted(shares)
    assert shares[-1] == pytest.approx((60 + 3) / (60 + 4))  # when the last refinement began, of 60 different paths


def test_a_rough_problem_has_waves_only_where_they_are_asked_for(coffee: Scenario) -> None:
    """With them the arm follows exactly; a motion that cannot beat what is known is not repaired."""
    problem = transport_problem(coffee)
    without, dynamic = problem.roughly(False), problem.roughly(True)
    assert (without.cases, without.tracking) == ((), problem.tracking)
    assert (dynamic.cases, dynamic.tracking, dynamic.at_rest) == (problem.cases, None, False)
    assert problem.cases
    one = searching(problem)
    one.pairs, blocked = search.possible_ends(problem, one.options, one.rng)
    assert blocked is None
    begin, found = one._rough(*one._first()[0])
    beaten = one._refined(*begin, found.iterate, found.iterate.duration)
    assert beaten.status.code == "beaten"


def test_an_arm_at_rest_strays_as_far_as_a_load_pulls_in_which_nothing_sloshes(coffee: Scenario) -> None:
    """In a posture that leans, in which a liquid that were level would slosh and push it further."""
    problem = transport_problem(coffee)
    z = np.zeros((4, 5, problem.n))
    z[0] = problem.start_posture + 0.2 * np.random.default_rng(0).normal(size=(2, problem.n))[1]
    away = strayed(*problem.at(np.linspace(0, 1, 5), z, 1.0, imposed=False).tray_radius())
    assert away.max() > 1.005 * away[0]
    assert _stray_at_rest(problem, z[0, 0]) == pytest.approx(away[0], rel=1e-9)
