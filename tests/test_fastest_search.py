"""What a search for the fastest motion tries, gives up and counts, and what may end it."""

from __future__ import annotations

import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from salver import scenario
from salver.errors import Status
from salver.planning.fastest import FastestOptions, fastest, search, transport_problem
from salver.planning.fastest.bound import least_duration
from salver.planning.fastest.curves import FreeCurve
from salver.planning.fastest.exchange import rough
from salver.planning.fastest.optimum import few_pieces, refitted
from salver.planning.fastest.sides import past
from salver.planning.fastest.spline import SplineMotion
from salver.planning.fastest.starts import WAY, Start, ends
from salver.planning.fastest.watch import Watch


def test_a_start_that_cannot_be_the_best_is_given_up_early_and_one_that_can_is_not(behind_a_post):
    problem = behind_a_post
    few, watch = few_pieces(FastestOptions()), Watch()
    begin = past(problem, ends(problem, np.random.default_rng(0))[0])[0].motion(problem, few)
    whole = rough(problem, FreeCurve, begin, 2, watch)
    assert whole.iterate.violation < 1e-3
    better, worse = (rough(problem, FreeCurve, begin, 2, watch, beat=x * whole.iterate.duration) for x in (0.7, 1.5))
    assert better.iterations < whole.iterations
    assert better.iterate.duration > 0.7 * whole.iterate.duration
    assert worse.iterations == whole.iterations
    assert worse.iterate.duration == whole.iterate.duration


@pytest.mark.slow
def test_a_search_that_is_interrupted_says_so_and_keeps_what_it_has(behind_a_post):
    shares, tried = [], []

    def tell(watch: Watch) -> None:
        shares.append(watch.share)
        tried.append(watch.trying)
        if watch.best is not None:
            watch.interrupt()

    watch = Watch(tell=tell)
    found = fastest(behind_a_post, FastestOptions(spans=8, starts=5), watch=watch)
    assert found.status.ok
    assert found.status.code == "interrupted"
    assert "ended by an interruption" in found.status.sentence
    assert shares == sorted(shares)
    assert 0 < shares[-1] < 1
    assert "straight path of the joints" in tried
    assert tried[-1].endswith(" s, refined")


def test_a_search_that_finds_nothing_answers_with_a_straight_line_that_holds(behind_a_post):
    """Where the time is up before anything was found too; never with a line through something."""
    cube = scenario.load("panda-cube").with_changes(motion__duration=None)
    for problem, ok in ((transport_problem(cube), True), (behind_a_post, False)):
        found = fastest(problem, watch=Watch(time_limit=0.0))
        assert found.status.ok == ok
        assert "ended by the time limit before it was done" in found.status.sentence
        assert ("It is the straight path of the joints, gone along slowly: nothing" in found.status.sentence) == ok
        assert ok == (max(found.worst.values()) <= 0.0)
        q = found.sample(np.linspace(0, found.duration, 9))[0]
        along = (q - q[0]) @ (q[-1] - q[0]) / np.sum((q[-1] - q[0]) ** 2)
        assert ok == np.allclose(q, q[0] + along[:, None] * (q[-1] - q[0]), atol=1e-3)
    assert "violates clearance, by " in found.status.sentence
    assert " mm. The search" in found.status.sentence


def test_an_end_is_turned_by_a_quarter_where_the_last_joint_has_room_for_it(monkeypatch):
    """Both ways in the middle of its range, one way near an end of it; none where that alone takes longer than what was
    found. The start stays."""
    problem, options = transport_problem(scenario.load("panda-cube")), FastestOptions()
    one = search._Search(problem, options, Watch(), [], np.random.default_rng(0))
    monkeypatch.setattr(search._Search, "_rough_from", lambda self, problem, start, damping, beat: start)
    few, low, high = few_pieces(options), problem.limits.q_min[-1], problem.limits.q_max[-1]

    def turned(end, duration=3.0):
        coefficients = np.zeros((few.size, 7))
        coefficients[-1, -1] = end
        found = SimpleNamespace(iterate=SimpleNamespace(coefficients=coefficients, duration=duration, violation=0.0))
        motions = list(one._turned(problem, found))
        assert all(motion.duration == duration for motion in motions)
        assert all(np.array_equal(motion.coefficients[:, :-1], coefficients[:, :-1]) for motion in motions)
        assert all(motion.coefficients[0, -1] == 0.0 for motion in motions)
        return [motion.coefficients[-1, -1] - end for motion in motions]

    for end in (0.1, low + 1.6, high - 1.6):
        assert turned(end) == pytest.approx([0.5 * np.pi, -0.5 * np.pi])
    assert turned(high - 1.5) == pytest.approx([-0.5 * np.pi])
    assert turned(low + 1.5) == pytest.approx([0.5 * np.pi])
    assert turned(0.0, duration=0.3) == []  # 1.57 rad at 2.6 rad/s


def test_every_step_of_every_part_of_a_search_is_counted(monkeypatch):
    """Of the first optima with few pieces, of those a quarter turn away, and of what is made of them."""
    counted = []

    def counting(part):
        def run(*arguments, **options):
            found = part(*arguments, **options)
            counted.append(found)
            return found

        return run

    for part in ("rough", "optimum"):
        monkeypatch.setattr(search, part, counting(getattr(search, part)))
    case = scenario.load("panda-cube").with_changes(objects__0__uncertainty={}, motion__goal_yaw="free")
    begun = time.perf_counter()
    found = fastest(transport_problem(case), FastestOptions(spans=8, pairs=1))
    took = time.perf_counter() - begun
    assert found.status.ok
    bound = least_duration(found.problem.limits, found.coefficients[0], found.coefficients[-1])
    assert 0.2 * found.duration < bound < found.duration  # no motion is faster than its joints alone
    assert len(counted) > 2
    assert min(part.iterations for part in counted) > 0
    assert found.iterations == sum(part.iterations for part in counted)
    assert min(part.wall_time for part in counted) > 0
    assert sum(part.wall_time for part in counted) <= found.wall_time <= took
    again = replace(found, wall_time=2.0, iterations=5).after(replace(found, wall_time=1.5, iterations=3))
    assert (again.wall_time, again.iterations) == (3.5, 8)


def a_refined(monkeypatch, rows, *ends):
    """Of a rough optimum of 1 s with these rows: what of ends (what binds, s, steps) in turn is kept, and the steps."""
    options, ok = FastestOptions(), Status("optimal", "It is.", True)
    few = few_pieces(options)
    size = refitted(SplineMotion(few, np.zeros((few.size, 7)), 1.0), options.spans).coefficients.shape
    results = [
        SimpleNamespace(status=ok, binding=binding, iterations=steps, duration=seconds, coefficients=np.zeros(size))
        for binding, seconds, steps in ends
    ]
    found = iter(results)
    monkeypatch.setattr(search, "optimum", lambda *_, **__: next(found))
    grid = SimpleNamespace(s=np.linspace(0, 1, 21), nodes=np.arange(0, 21, 5))
    begun = SimpleNamespace(
        coefficients=np.zeros((few.size, 7)),
        duration=1.0,
        curve=SimpleNamespace(grid=grid),
        blocks=[SimpleNamespace(name=name) for name in rows],
    )
    one = search._Search(transport_problem(scenario.load("panda-cube")), options, Watch(), [], np.random.default_rng(0))
    kept = one._refined(one.problem, begun)
    return results.index(kept), one.iterations


def test_a_search_that_nothing_stopped_goes_on_from_there_and_counts_all_its_steps(monkeypatch):
    """The first refinement ends where nothing binds; the second is faster and bound, and that is the end."""
    ends = ((), 1.0, 5), (("torque",), 0.9, 3), ((), 0.8, 7)
    assert a_refined(monkeypatch, ["torque", "acceleration"], *ends) == (1, 5 + 3)


def test_a_refined_motion_may_be_longer_where_the_rough_one_knew_less(monkeypatch):
    """With more pieces the shortest motion is no longer; with more conditions it may be, and the rough one's time then
    says nothing."""
    ends = (("torque", "waves in cup"), 1.1, 5), (("torque", "waves in cup"), 1.05, 3), (("torque",), 0.8, 7)
    assert a_refined(monkeypatch, ["torque"], *ends) == (0, 5)
    assert a_refined(monkeypatch, ["torque", "waves in cup"], *ends) == (2, 5 + 3 + 7)


def test_of_rough_optima_that_know_less_the_others_too_become_longer():
    """One takes 1 s and becomes 1.03 s long: if the same binds, one of 1.07 s may still take 0.96 of that; if something
    binds that none of them knows, not even one of 1.01 s is worth it."""
    rough = SimpleNamespace(duration=1.0, blocks=[SimpleNamespace(name="torque")])
    refining = [search._refining(rough, SimpleNamespace(duration=1.03, binding=x)) for x in (["torque"], ["waves"])]
    assert refining == [search.REFINING, 1.03]
    shorter = SimpleNamespace(duration=0.8, binding=["waves"])
    assert search._refining(rough, shorter) == search.REFINING


@pytest.mark.slow
def test_a_coffee_is_refined_once(monkeypatch):
    """Its rough motions know of no waves: 0.709 s; with them none takes less than 0.72 s."""
    spent = []
    optimum = search.optimum
    monkeypatch.setattr(search, "optimum", lambda *a, **k: spent.append(optimum(*a, **k)) or spent[-1])
    found = fastest(transport_problem(scenario.load("panda-coffee")))
    assert found.status.ok
    assert 0.72 < found.duration < 0.73
    assert len(spent) == 1


def test_where_nothing_holds_but_ways_that_were_drawn_more_are_drawn(monkeypatch):
    """A way around is one of many, by chance: where a line holds too, the search has what it needs."""
    problem = transport_problem(scenario.load("panda-cube"))
    postures, drawn, holding = np.zeros((2, 7)), [], []
    made = {"straight": Start("straight", postures), WAY: Start(WAY, postures)}

    def rough(self, problem, start, beat=np.inf):
        drawn.append(start.name)
        holds = start.name in holding
        return problem, SimpleNamespace(iterate=SimpleNamespace(violation=0.0 if holds else 0.5, duration=1.0))

    def refined(self, problem, found):
        raise InterruptedError

    monkeypatch.setattr(search._Search, "_first", lambda self: [(problem, made["straight"]), (problem, made[WAY])])
    monkeypatch.setattr(search._Search, "_further", lambda self: iter(()))
    monkeypatch.setattr(search._Search, "_ways", lambda self, pairs: [made[WAY]])
    monkeypatch.setattr(search._Search, "_promising", lambda self, found: [(problem, start) for start in found])
    monkeypatch.setattr(search._Search, "_rough", rough)
    monkeypatch.setattr(search._Search, "_turned", lambda self, problem, found: [])
    monkeypatch.setattr(search._Search, "_refined", refined)
    monkeypatch.setattr(Start, "least", lambda self, problem: 0.1)
    pair = SimpleNamespace(free=True)
    for names, again in ({"straight", WAY}, 0), ({"straight"}, 0), (set(), 0), ({WAY}, search.DRAWN_AGAIN):
        holding[:], drawn[:] = names, []
        one = search._Search(problem, FastestOptions(), Watch(), [pair], np.random.default_rng(0))
        with pytest.raises(InterruptedError):
            one.best()
        assert drawn == ["straight", WAY, *[WAY] * again]


@pytest.mark.slow
def test_another_start_takes_the_place_of_one_that_becomes_longer_when_it_is_refined():
    """In the goal posture that promises most, something is within a millimetre of something else, about as near
    as the arm may stray; to the other posture the way is free, and takes 1.199 s."""
    case = scenario.parse(
        {
            "name": "two-ends",
            "motion": {
                "start": {"position": [0.49670281, 0.61522311, 0.5464039]},
                "goal": {"position": [0.48675431, -0.31498546, 0.54518059]},
                "goal_yaw": "fixed",
            },
            "objects": [
                {
                    "shape": {"type": "box", "size": [0.09449807, 0.09449807, 0.09091334]},
                    "mass": 0.16143063,
                    "friction": 0.44288296,
                    "support_inset": 0.002,
                    "uncertainty": {"mass": "10%", "friction": "10%"},
                }
            ],
            "contact": {"condition": "exact"},
            "tray": {"size": [0.18, 0.18], "mass": 0.2, "height": 0.05},
            "arm": {"model": "ur10"},
            "surroundings": {"floor": "none"},
            "obstacles": [
                {"type": "box", "position": [0.42032934, -0.08351663, 0.37796455], "size": [0.18, 0.18, 0.12]}
            ],
        },
        "two-ends",
    )
    found = fastest(transport_problem(case))
    assert found.status.ok
    assert found.duration < 1.21
