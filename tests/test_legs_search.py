"""Which postures a task of several legs stops in and how its legs are planned one after the other, by hand."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise, product
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from salver.geometry import Array
from salver.planning.fastest import FastestOptions, legs
from salver.planning.fastest.legs import _merit, chains, in_turn
from salver.planning.fastest.together import LegsCurve, LegsProgramme
from salver.planning.seeds.starts import Ends
from salver.planning.trajopt.constraints.constraints import Block, Constraint
from salver.planning.trajopt.curves import Grid
from salver.planning.trajopt.ends import AtPosture
from salver.planning.trajopt.evaluation import MotionEvaluation
from salver.planning.trajopt.exchange import SHORTEST
from salver.planning.trajopt.objectives import Point
from salver.planning.trajopt.spline import RestSpline, SplineMotion, min_jerk_blend
from salver.planning.trajopt.watch import Watch


@dataclass(frozen=True, eq=False)
class Task:
    """What is asked of a leg here: where it begins, what it passes and where it ends."""

    start: Any
    goal: Any
    through: tuple[Any, ...] = ()
    keep_out: None = None
    scenario: Any = field(default_factory=lambda: SimpleNamespace(motion=SimpleNamespace(goal_yaw="fixed")))


def test_the_cheapest_of_all_ways_through_the_postures_of_a_task_comes_first(monkeypatch) -> None:
    """Each stop can be reached in two postures, at a price for each pair: of all eight ways the six cheapest."""
    stops = {"start": [0.0], "stop": [1.0, 1.1], "pass": [2.0, 2.1], "end": [3.0, 3.1]}
    rng = np.random.default_rng(5)
    postures = sorted(q for each in stops.values() for q in each)
    price = {pair: rng.uniform(0.5, 2.0) for pair in product(postures, repeat=2)}

    def ends(stage: Task, rng: np.random.Generator) -> list[Ends]:
        start = stage.start.q[0] if isinstance(stage.start, AtPosture) else 0.0
        found = [Ends(np.array([start]), np.array([q]), price[start, q], True) for q in stops[stage.goal]]
        return sorted(found, key=lambda pair: pair.cost)

    monkeypatch.setattr(legs, "ends", ends)
    task: list[Any] = [Task("start", "stop"), Task("stop", "end", ("pass",))]
    found = chains(task, rng)
    every = {
        (a, b, c): price[0.0, a] + price[a, b] + price[b, c]
        for a, b, c in product(stops["stop"], stops["pass"], stops["end"])
    }
    assert [tuple(chain[1].ravel()) for chain in found] == sorted(every, key=lambda way: every[way])[:6]
    for first, second in found:
        assert first.ravel().tolist() == [0.0, second[0, 0]]


def planned_in_turn(monkeypatch, begin: list[SplineMotion] | None, done: float, ok: str = "yyy") -> list[Any]:
    """What each of three legs was planned from, in turn; of those that end at 1, 2 and 3, every one at 0.5 between."""
    asked: list[Any] = []

    def plan_problem(problem: Task, options: Any, watch: Any, near: Any) -> Any:
        asked.append((problem, watch, near))
        k = len(asked)
        return SimpleNamespace(ok=ok[k - 1] == "y", joint=SimpleNamespace(q=np.array([[k - 1.0], [0.5], [float(k)]])))

    monkeypatch.setattr(legs, "plan_problem", plan_problem)
    task: list[Any] = [Task(f"start {k}", f"goal {k}") for k in range(3)]
    assert len(in_turn(task, begin, FastestOptions(), Watch(), done)) == len(asked)
    return asked


def test_each_leg_begins_where_the_one_before_it_ended(monkeypatch) -> None:
    asked = planned_in_turn(monkeypatch, None, 0.5)
    assert asked[0][0].start == "start 0"
    assert [problem.start.q.tolist() for problem, *_ in asked[1:]] == [[1.0], [2.0]]
    assert [problem.goal for problem, *_ in asked] == ["goal 0", "goal 1", "goal 2"]


def test_along_a_motion_of_all_legs_each_keeps_the_ends_that_it_has_there(monkeypatch) -> None:
    """Up to the first that is not safe."""
    spline, pairs = RestSpline(5, 4), []
    monkeypatch.setattr(legs, "between", lambda problem, pair: pairs.append(pair) or problem)
    u = np.linspace(0, 1, spline.size)[:, None] ** 2
    begin = [SplineMotion(spline, a + (b - a) * u, 1.0) for a, b in ((0.1, 1.2), (1.2, 2.3), (2.3, 3.4))]
    for ok, count in (("yyy", 3), ("yny", 2), ("nyy", 1)):
        pairs.clear()
        asked = planned_in_turn(monkeypatch, begin, 0.0, ok)
        assert len(asked) == count
        ends = [(0.1, 1.2), (1.2, 2.3), (2.3, 3.4)][:count]
        assert [(p.start.q.tolist(), p.goal.q.tolist()) for p, *_ in asked] == [([a], [b]) for a, b in ends]
        assert [(pair.start.tolist(), pair.goal.tolist()) for pair in pairs] == [([a], [b]) for a, b in ends]


@pytest.mark.parametrize(("done", "until"), [(0.0, 0.5), (0.5, 1.0)])
def test_the_legs_share_the_work_that_is_left_evenly(monkeypatch, done: float, until: float) -> None:
    """What is told of how far a search is goes on from one leg to the next."""
    told = []
    for _, part, _ in planned_in_turn(monkeypatch, None, done):
        for share in (0.0, 1.0):
            part.share = share
            part.over()
            told.append(part.whole.share)
    assert told == pytest.approx(np.repeat(np.linspace(done, until, 4), 2)[1:-1])


# All legs in one programme -----------------------------------------------------------------------------------------


def legs_in_a_plane() -> tuple[LegsCurve, Array]:
    """Two legs of 0.3 and 0.7 of the time, from (0, 0) over (1, 0) to (1, 2), and coefficients: straight lines of the
    joints that end elsewhere, and shares that make more than one."""
    stops = [AtPosture(np.array(q)) for q in ((0.0, 0.0), (1.0, 0.0), (1.0, 2.0))]
    plane: list[Any] = [
        SimpleNamespace(n=2, arm=SimpleNamespace(n=2), limits=None, start=a, goal=b, at=seen)
        for a, b in pairwise(stops)
    ]
    spline = RestSpline(5, 4)
    grid = Grid.of(spline, spline.nodes(2), 2)
    curve = LegsCurve(tuple(plane), spline, grid.s, grid.nodes, np.array([0.3, 0.7]))
    at, blend = np.zeros((curve.grid.basis.shape[2], 2)), min_jerk_blend(np.linspace(0, 1, spline.size))[:, None]
    ends = np.array([[0.1, -0.2], [1.2, 0.1], [0.7, 2.3]])
    for k in range(2):
        at[curve.rows(k)] = ends[k] + blend * (ends[k + 1] - ends[k])
    at[curve.postures] = 0.1, 0.05
    return curve, at


def seen(s: Array, z: Array, duration: float, nodes: Any, imposed: bool = True) -> MotionEvaluation:
    return MotionEvaluation(None, 0, None, s, duration, z, nodes, imposed, False)


def test_legs_follow_one_another_in_time_each_for_its_share() -> None:
    curve, at = legs_in_a_plane()
    each, count = Grid.of(curve.spline, curve.spline.nodes(2), 2), len(curve.s)
    assert curve.grid.s[:count] == pytest.approx(0.3 * each.s)
    assert curve.grid.s[count:] == pytest.approx(0.3 + 0.7 * each.s)
    assert curve.grid.nodes.tolist() == [*each.nodes, *(count + each.nodes)]
    z = curve.motion(at, 2.0)
    for k, (begin, share, log) in enumerate(((0.0, 0.3, 0.1), (0.3, 0.7, 0.05))):
        duration = 2.0 * share * np.exp(log)
        assert z[:, k * count : (k + 1) * count] == pytest.approx(each.motion(at[curve.rows(k)], duration), rel=1e-9)
        assert begin == pytest.approx(curve.grid.s[k * count])


def test_a_leg_whose_ends_are_moved_stays_the_line_that_it_is() -> None:
    """Its stops are where they must be, the legs take all of the time, in the same proportion, and what is right stays
    as it is."""
    curve, at = legs_in_a_plane()
    found = curve.repaired(at)
    assert found is not None
    blend = min_jerk_blend(np.linspace(0, 1, curve.spline.size))[:, None]
    for k, (one, other) in enumerate((((0, 0), (1, 0)), ((1, 0), (1, 2)))):
        assert found[curve.rows(k)] == pytest.approx(np.array(one) + blend * (np.array(other) - one))
    shares = curve.durations(found, 1.0)
    assert shares.sum() == pytest.approx(1.0)
    assert shares[0] / shares[1] == pytest.approx(0.3 / 0.7 * np.exp(0.05))
    assert curve.repaired(found) == pytest.approx(found)


def test_a_leg_takes_neither_much_more_nor_much_less_of_the_time_at_once() -> None:
    curve, at = legs_in_a_plane()
    rows, most = curve.inequalities(at)
    for change, allowed in ((0.19, True), (-0.19, True), (0.21, False), (-0.21, False)):
        for k in range(2):
            step = np.random.default_rng(0).normal(size=at.size)
            step[curve.columns_of_shares] = 0.0
            step[curve.columns_of_shares[k]] = change
            assert np.all(rows @ step <= most) == allowed


def test_rows_of_a_leg_are_at_the_points_of_that_leg() -> None:
    curve, at = legs_in_a_plane()

    class Here(Constraint):
        def blocks(self, motion: MotionEvaluation) -> Iterator[Block]:
            yield Block("here", motion.at_nodes[0], lambda i, f: np.zeros((len(i), 8)), motion.nodes, (0.0, 0.0))

    found = LegsProgramme(curve, (), SHORTEST, ((Here(),), (Here(), Here()))).at(Point(at, 2.0))
    z = curve.motion(at, 2.0)
    assert [block.points[0] // len(curve.s) for block in found.blocks] == [0, 1, 1]
    for block in found.blocks:
        assert block.values == pytest.approx(z[0, block.points])


def test_a_task_that_lacks_a_leg_or_is_not_safe_is_worse_than_a_slow_one() -> None:
    quick, slow, unsafe = (SimpleNamespace(ok=x, duration=t) for x, t in ((True, 0.5), (True, 9.0), (False, 0.5)))
    both: list[Any] = [None, None]
    ordered: list[Any] = [[quick, quick], [quick, slow], [quick, unsafe], [slow]]
    merits = [_merit(found, both) for found in ordered]
    assert merits == sorted(merits)
    assert len(set(merits)) == 4
    assert merits[0] == (False, 0, 1.0)
