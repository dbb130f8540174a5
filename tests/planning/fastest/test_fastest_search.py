"""What a search for the fastest motion tries, gives up and counts, and what may end it."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

from salver import scenario
from salver.errors import Status
from salver.planning.fastest import FastestOptions, fastest, search, transport_problem
from salver.planning.fastest.optimum import few_pieces
from salver.planning.fastest.planned import _planned, _sterner, plan_fastest
from salver.planning.fastest.search import _Search
from salver.planning.seeds.starts import around, ends
from salver.planning.trajopt.bound import least_duration
from salver.planning.trajopt.curves import FreeCurve
from salver.planning.trajopt.exchange import rough
from salver.planning.trajopt.watch import Watch
from transport_problems import ROUGH


@pytest.mark.slow
def test_a_start_that_cannot_be_the_best_is_given_up_early_and_one_that_can_is_not(behind_a_post):
    problem = behind_a_post
    few, watch = few_pieces(FastestOptions()), Watch()
    rng = np.random.default_rng(0)
    way = around(problem, ends(problem, rng), rng)
    assert way is not None
    begin = way.motion(problem, few)
    whole = rough(problem, FreeCurve, begin, 2, watch, 0.01)
    assert whole.iterate.violation < 1e-3
    better, worse = (
        rough(problem, FreeCurve, begin, 2, watch, 0.01, beat=x * whole.iterate.duration) for x in (0.7, 1.5)
    )
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


@pytest.mark.slow
def test_what_an_interruption_takes_is_as_short_as_was_said_though_other_speeds_come_after_it():
    """The cup's motion of 0.75 s spills at other speeds until it is searched for again."""
    said = []

    class Impatient(Watch):
        def __setattr__(self, name, value):
            super().__setattr__(name, value)
            if name == "best" and value is not None:
                said.append(value)
                self.interrupt()

    plan = plan_fastest(scenario.load("panda-coffee"), options=ROUGH, watch=Impatient())
    assert plan.ok
    assert plan.speeds.every
    assert plan.duration < 1.03 * said[0]


def test_a_search_that_finds_nothing_answers_with_a_straight_line_that_holds(behind_a_post):
    """Where the time is up before anything was found too; never with a line through something."""
    cube = scenario.load("panda-cube").with_changes(motion__duration=None, objects__0__friction=0.1)
    found = fastest(transport_problem(cube), watch=Watch(time_limit=0.0))
    assert found.status.ok
    assert "ended by the time limit before it was done" in found.status.sentence
    assert "It is the straight path of the joints, gone along slowly: nothing" in found.status.sentence
    assert max(found.worst.values()) <= 0.0
    q = found.sample(np.linspace(0, found.duration, 9))[0]
    along = (q - q[0]) @ (q[-1] - q[0]) / np.sum((q[-1] - q[0]) ** 2)
    assert np.allclose(q, q[0] + along[:, None] * (q[-1] - q[0]), atol=1e-3)
    rng = np.random.default_rng(0)
    assert _Search(behind_a_post, FastestOptions(), Watch(), ends(behind_a_post, rng), rng)._line() is None


def test_every_step_of_every_part_of_a_search_is_counted(monkeypatch):
    """Of the first optima with few pieces, and of what is made of them."""
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
    assert len(counted) >= 2
    assert min(part.iterations for part in counted) > 0
    assert found.iterations == sum(part.iterations for part in counted)
    assert min(part.wall_time for part in counted) > 0
    assert sum(part.wall_time for part in counted) <= found.wall_time <= took
    again = replace(found, wall_time=2.0, iterations=5).after(replace(found, wall_time=1.5, iterations=3))
    assert (again.wall_time, again.iterations) == (3.5, 8)


@pytest.mark.parametrize("kept", [True, False])
def test_a_rough_optimum_that_promises_too_much_does_not_end_the_search(kept):
    """The first start is given up for the second, whose motion takes longer than it promises or is not safe; the last
    promises less than the first one's motion takes."""
    promise = {"given up": 0.78, "promising": 0.70, "slow": 0.80}
    takes = {"given up": 0.75, "promising": 0.90 if kept else 0.72, "slow": 0.77}
    refined = []

    class Search(_Search):
        def _first(self):
            return [(None, SimpleNamespace(name=name, sampled=np.full((2, 1), x))) for name, x in promise.items()]

        def _further(self):
            return iter(())

        def _rough(self, problem, start, beat=np.inf):
            beaten = start.name == "given up" and (np.isfinite(beat) or not refined)
            if beaten:
                self.given_up.append((0.99 * promise["promising"], (problem, start)))
            iterate = SimpleNamespace(name=start.name, duration=promise[start.name], violation=0.04 if beaten else 0.0)
            return (problem, start), SimpleNamespace(iterate=iterate)

        def _refined(self, problem, start, found, beat):
            refined.append(found.name)
            safe = kept or found.name != "promising"
            return Motion(takes[found.name], Status("optimal" if safe else "infeasible", "", safe))

    rigid = SimpleNamespace(cases=())
    found = Search(rigid, FastestOptions(), Watch(), [], np.random.default_rng(0)).best()
    assert found.duration == 0.75
    assert refined == ["promising", "given up"]


def test_where_waves_keep_the_first_motion_from_being_safe_all_starts_are_begun_anew_with_them():
    """The rough optima without waves are not refined any more, nor are starts given up for one of them. A refinement
    has to beat the safe motion that is known."""
    begun, beats = [], []

    class Search(_Search):
        def _first(self):
            return [(None, SimpleNamespace(name=name, sampled=np.full((2, 1), x))) for x, name in enumerate("ab")]

        def _rough(self, problem, start, beat=np.inf):
            begun.append((start.name, self.dynamic))
            if not self.dynamic:
                self.given_up.append((0.5, (problem, start)))
            duration = {"a": 0.8, "b": 0.7}[start.name] if self.dynamic else 0.5
            return (problem, start), SimpleNamespace(iterate=SimpleNamespace(duration=duration, violation=0.0))

        def _refined(self, problem, start, found, beat):
            beats.append(beat)
            return Motion(found.duration + 0.2, Status("", "", self.dynamic))

    found = Search(SimpleNamespace(cases=((),)), FastestOptions(), Watch(), [], np.random.default_rng(0)).best()
    assert begun == [("a", False), ("b", False), ("a", True), ("b", True)]
    assert found.duration == pytest.approx(0.9)
    assert beats == pytest.approx([np.inf, np.inf, 0.9])


@dataclass(frozen=True)
class Motion:
    duration: float
    status: Status
    iterations: int = 0


def test_a_way_around_nothing_is_not_tried_after_the_straight_path():
    leaning = scenario.load("panda-coffee").with_changes(motion__goal__rpy_deg=[12.0, 0.0, 0.0])
    problem, rng = transport_problem(leaning), np.random.default_rng(0)
    found = search._Search(problem, FastestOptions(), Watch(), ends(problem, rng)[:1], rng)
    first, ways = found._first(), found._ways()
    assert ways
    assert list(found._new([*first, *ways])) == first


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


@pytest.mark.slow
def test_a_goal_posture_to_which_the_way_is_free_is_found_beside_one_that_promises_more():
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


def test_a_motion_that_fails_its_verdict_gets_nodes_at_the_instants_at_which_it_does():
    """Of a cube with a range of mass, the rest after the motion is judged too: nodes are shares of the motion alone."""
    case = scenario.load("panda-cube").with_changes(motion__speeds="full")
    found = fastest(transport_problem(case), FastestOptions(starts=1))
    limits = found.problem.limits
    slower = replace(found.problem, limits=replace(limits, acceleration=0.97 * limits.acceleration))
    failing = replace(found, problem=slower)
    sterner = _sterner(failing, _planned(case, failing, True), True)
    nodes = np.setdiff1d(sterner.nodes, slower.nodes)
    motion = found.joint_motion()
    share = np.abs(motion.sample(nodes * motion.duration)[2] / limits.acceleration).max(axis=1)
    assert len(nodes)
    assert np.mean(share > 0.97) > 0.5  # each instant has one on either side
    assert share.min() > 0.8


def test_a_time_limit_is_of_one_clock(monkeypatch):
    """Another clock than that of the import, such as processor time, at the beginning of a search and later."""
    now = [-1e6]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    watch = Watch(time_limit=1.0)
    now[0] += 0.9
    assert not watch.over()
    now[0] += 0.2
    assert watch.over()
