"""Which postures a task of several legs stops in and how its legs are planned one after the other, by hand."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import product
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from salver.errors import Status, UnreachableError
from salver.planning.fastest import FastestOptions, legs
from salver.planning.fastest.legs import _merit, chains, in_turn, plan_legs
from salver.planning.seeds.starts import Ends
from salver.planning.trajopt.ends import AtPosture
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


CHAIN = [np.array([[a], [b]]) for a, b in ((0.1, 1.2), (1.2, 2.3), (2.3, 3.4))]


def test_each_leg_begins_where_the_one_before_it_ended_and_is_sought_towards_the_chain(monkeypatch) -> None:
    """Three legs that end at 1, 2 and 3, beside their chain; the second is not safe."""
    asked: list[Any] = []

    def plan_problem(problem: Task, options: Any, watch: Any, pair: Ends) -> Any:
        asked.append((problem, pair))
        return SimpleNamespace(ok=len(asked) != 2, joint=SimpleNamespace(q=np.array([[0.5], [float(len(asked))]])))

    monkeypatch.setattr(legs, "plan_problem", plan_problem)
    task: list[Any] = [Task(f"start {k}", f"goal {k}") for k in range(3)]
    assert len(in_turn(task, CHAIN, FastestOptions(), Watch())) == 3
    assert asked[0][0].start == "start 0"
    assert [problem.start.q.tolist() for problem, _ in asked[1:]] == [[1.0], [2.0]]
    assert [problem.goal for problem, _ in asked] == ["goal 0", "goal 1", "goal 2"]
    assert [(*pair.start, *pair.goal) for _, pair in asked] == [(0.1, 1.2), (1.0, 2.3), (2.0, 3.4)]


def test_the_legs_share_the_work_evenly(monkeypatch) -> None:
    """The reported share of the work goes on from one leg to the next."""
    told: list[float] = []

    def plan_problem(problem: Task, options: Any, watch: Watch, pair: Ends) -> Any:
        assert watch.best is None
        for share in (0.5, 2.0, 0.1):  # never more than the whole, nor back
            watch.reached(share)
            told.append(watch.share)
        watch.best = 1.0
        return SimpleNamespace(ok=True, joint=SimpleNamespace(q=np.zeros((1, 1))))

    monkeypatch.setattr(legs, "plan_problem", plan_problem)
    task: list[Any] = [Task("a", "b"), Task("b", "c"), Task("c", "d")]
    in_turn(task, CHAIN, FastestOptions(), Watch())
    assert told == pytest.approx(np.array([0.5, 1, 1, 1.5, 2, 2, 2.5, 3, 3]) / 3)


def test_the_next_chain_of_postures_is_tried_where_the_legs_along_one_are_not_safe(monkeypatch) -> None:
    """At most as many as there are `pairs`; what is safe at once is taken, else the best. Planned is only what no end
    prevents."""
    tried: list[Any] = []
    outcomes: dict[str, list[Any]] = {}

    def planned(problems: Any, chain: str, options: Any, watch: Any) -> list[Any]:
        tried.append(chain)
        return outcomes[chain]

    safe, unsafe, worse = (
        SimpleNamespace(ok=ok, duration=t, solver={"name": "s", "seconds": 0.0}, status=None, arm_status=None)
        for ok, t in ((True, 1.0), (False, 1.0), (False, 2.0))
    )
    case = SimpleNamespace(
        name="case",
        legs=[1, 2],
        motion=SimpleNamespace(duration=None),
        each_leg=[SimpleNamespace(name="case-leg1")],
        with_changes=lambda **_: case,
    )
    blocked: list[Status | None] = [None]
    monkeypatch.setattr(legs, "transport_problem", lambda leg, passing: SimpleNamespace(scenario=leg))
    monkeypatch.setattr(legs, "possible_ends", lambda *_: ([], blocked[0]))
    monkeypatch.setattr(legs, "in_turn", planned)
    monkeypatch.setattr(legs, "chains", lambda *_: ["first", "second", "third"])
    monkeypatch.setattr(legs, "MultiLegPlan", lambda *fields: fields[1])
    monkeypatch.setattr(legs, "_status", lambda *_: None)
    for given, count, best in (
        ({"first": [safe]}, 1, safe),
        ({"first": [unsafe], "second": [safe]}, 2, safe),
        ({"first": [unsafe], "second": [worse]}, 2, unsafe),
        ({"first": [worse], "second": [unsafe]}, 2, unsafe),
    ):
        outcomes = given
        tried.clear()
        assert plan_legs(case, options=FastestOptions(pairs=2)) == (best,)  # type: ignore[arg-type]
        assert len(tried) == count
    blocked[0] = Status("unreachable", "The start is out of reach.", False)
    tried.clear()
    with pytest.raises(UnreachableError, match=r"case-leg1: The start is out of reach\."):
        plan_legs(case)  # type: ignore[arg-type]
    assert not tried


def test_a_task_that_is_not_safe_is_worse_than_a_slow_one() -> None:
    quick, slow, unsafe = (SimpleNamespace(ok=x, duration=t) for x, t in ((True, 0.5), (True, 9.0), (False, 0.5)))
    ordered: list[Any] = [[quick, quick], [quick, slow], [quick, unsafe], [unsafe, unsafe]]
    merits = [_merit(found) for found in ordered]
    assert merits == sorted(merits)
    assert len(set(merits)) == 4
    assert merits[0] == (0, 1.0)
