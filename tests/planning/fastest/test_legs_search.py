"""Which postures a task of several legs stops in and how its legs are planned one after the other, by hand."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import product
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from salver.errors import UnreachableError
from salver.planning.fastest import FastestOptions, legs
from salver.planning.fastest.legs import _merit, chains, in_turn, plan_legs
from salver.planning.seeds.starts import Ends
from salver.planning.trajopt.ends import AtPosture
from salver.planning.trajopt.spline import RestSpline, SplineMotion
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


def planned_in_turn(monkeypatch, begin: list[SplineMotion] | None, ok: str = "yyy") -> list[Any]:
    """What each of three legs was planned from, in turn; of those that end at 1, 2 and 3, every one at 0.5 between."""
    asked: list[Any] = []

    def plan_problem(problem: Task, options: Any, watch: Any, near: Any) -> Any:
        asked.append((problem, watch, near))
        k = len(asked)
        return SimpleNamespace(ok=ok[k - 1] == "y", joint=SimpleNamespace(q=np.array([[k - 1.0], [0.5], [float(k)]])))

    monkeypatch.setattr(legs, "plan_problem", plan_problem)
    task: list[Any] = [Task(f"start {k}", f"goal {k}") for k in range(3)]
    assert len(in_turn(task, begin, FastestOptions(), Watch())) == len(asked)
    return asked


def test_each_leg_begins_where_the_one_before_it_ended(monkeypatch) -> None:
    asked = planned_in_turn(monkeypatch, None)
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
        asked = planned_in_turn(monkeypatch, begin, ok)
        assert len(asked) == count
        ends = [(0.1, 1.2), (1.2, 2.3), (2.3, 3.4)][:count]
        assert [(p.start.q.tolist(), p.goal.q.tolist()) for p, *_ in asked] == [([a], [b]) for a, b in ends]
        assert [(pair.start.tolist(), pair.goal.tolist()) for pair in pairs] == [([a], [b]) for a, b in ends]


def test_the_legs_share_the_work_evenly(monkeypatch) -> None:
    """The reported share of the work goes on from one leg to the next."""
    told: list[float] = []

    def plan_problem(problem: Task, options: Any, watch: Watch, near: Any) -> Any:
        assert watch.best is None
        for share in (0.5, 2.0, 0.1):  # never more than the whole, nor back
            watch.reached(share)
            told.append(watch.share)
        watch.best = 1.0
        return SimpleNamespace(ok=True, joint=SimpleNamespace(q=np.zeros((1, 1))))

    monkeypatch.setattr(legs, "plan_problem", plan_problem)
    in_turn([Task("a", "b"), Task("b", "c"), Task("c", "d")], None, FastestOptions(), Watch())
    assert told == pytest.approx(np.array([0.5, 1, 1, 1.5, 2, 2, 2.5, 3, 3]) / 3)


def test_where_a_leg_that_chose_its_end_leads_nowhere_legs_are_planned_along_chains_of_postures(monkeypatch) -> None:
    """What is safe at once is taken; else the first chain that is, and what is out of reach is told."""
    tried: list[Any] = []
    outcomes: dict[Any, Any] = {}

    def planned(problems: Any, begin: Any, options: Any, watch: Any) -> list[Any]:
        tried.append(begin)
        found = outcomes[begin]
        if found is None:
            raise UnreachableError(f"out of reach by {begin}")
        return found

    safe, unsafe = (
        SimpleNamespace(ok=ok, duration=1.0, solver={"name": "s", "seconds": 0.0}, status=None, arm_status=None)
        for ok in (True, False)
    )
    case = SimpleNamespace(
        name="case",
        legs=[1, 2],
        motion=SimpleNamespace(duration=None),
        each_leg=[1],
        with_changes=lambda **_: case,
    )
    monkeypatch.setattr(legs, "transport_problem", lambda leg, passing: leg)
    monkeypatch.setattr(legs, "in_turn", planned)
    monkeypatch.setattr(legs, "_begins", lambda *_: iter([None, "first", "second"]))
    monkeypatch.setattr(legs, "MultiLegPlan", lambda *fields: fields[1])
    monkeypatch.setattr(legs, "_status", lambda *_: None)
    for given, count in (
        ({None: [safe]}, 1),
        ({None: [unsafe], "first": [unsafe], "second": [safe]}, 3),
        ({None: None, "first": [safe]}, 2),
    ):
        outcomes = given
        tried.clear()
        assert plan_legs(case) == (safe,)  # type: ignore[arg-type]
        assert len(tried) == count
    for later in (None, [unsafe]):
        outcomes = {None: None, "first": later, "second": later}
        with pytest.raises(UnreachableError, match="out of reach by None"):
            plan_legs(case)  # type: ignore[arg-type]


def test_a_task_that_lacks_a_leg_or_is_not_safe_is_worse_than_a_slow_one() -> None:
    quick, slow, unsafe = (SimpleNamespace(ok=x, duration=t) for x, t in ((True, 0.5), (True, 9.0), (False, 0.5)))
    both: list[Any] = [None, None]
    ordered: list[Any] = [[quick, quick], [quick, slow], [quick, unsafe], [slow]]
    merits = [_merit(found, both) for found in ordered]
    assert merits == sorted(merits)
    assert len(set(merits)) == 4
    assert merits[0] == (False, 0, 1.0)
