"""Conditions for all times: what a check between nodes finds, where nodes are added, and what comes of it. Motions of
one joint, of which the answer is known."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from salver.geometry import Array
from salver.planning.trajopt import exchange
from salver.planning.trajopt.constraints.constraints import UNSEEN, Block, Constraint
from salver.planning.trajopt.curves import FreeCurve, Grid
from salver.planning.trajopt.ends import AtPosture
from salver.planning.trajopt.evaluation import Indices, MotionEvaluation
from salver.planning.trajopt.exchange import SHORTEST, ExchangeOptions, _between, optimise
from salver.planning.trajopt.objectives import Point
from salver.planning.trajopt.problem import TransportProblem
from salver.planning.trajopt.spline import RestSpline, SplineMotion
from salver.trajectory import smooth_step


def nothing(node: Indices, row: Indices) -> Array:
    return np.zeros((len(node), 4))


@dataclass(frozen=True)
class Given(Constraint):
    """Blocks that are what they are."""

    each: tuple[Block, ...]

    def blocks(self, motion: MotionEvaluation) -> Iterator[Block]:
        yield from self.each


def checked(*blocks: Block, s: Array) -> tuple[dict[str, float], tuple[str, ...], float, list[int]]:
    """What a check on points s finds."""
    fine: Any = SimpleNamespace(grid=SimpleNamespace(s=s), problem=SimpleNamespace(constraints=[Given(blocks)]))
    motion: Any = SimpleNamespace(imposed=False, moving=False)
    largest, binding, slower, peaks = _between(fine, SHORTEST, Point(np.zeros((1, 1)), 1.0), motion)
    return largest, binding, slower, peaks.tolist()


def test_nodes_are_added_where_a_row_is_broken_the_most_and_at_both_ends_of_what_couples_two() -> None:
    """Not where it is kept, however near, and not beside a peak. A row of a step between two nodes names both."""
    s, kept = np.linspace(0.0, 1.0, 12), (0.0, 0.0)
    at, rate = np.full((12, 1), -1.0), np.full((11, 1), -1.0)
    at[[2, 3, 4, 8], 0] = 0.1, 0.3, 0.2, -0.01
    rate[6] = 0.05
    points = np.arange(12)
    state = Block("state", at, nothing, points, kept, slows=1.5)
    step = Block("step", rate, nothing, points, kept, following=nothing, slows=4.0)
    largest, _, slower, peaks = checked(state, step, s=s)
    assert largest == {"state": 0.3, "step": 0.05}
    assert slower == pytest.approx(1.5 * 0.3)
    assert peaks == [3, 6, 7]
    ends = np.linspace(0.2, -0.5, 12)[:, None]
    assert checked(replace(state, values=ends), s=s)[3] == [0]
    assert checked(replace(state, values=ends[::-1]), s=s)[3] == [11]
    assert checked(replace(state, values=-np.ones((12, 1))), s=s)[2:] == (0.0, [])


def test_of_rows_of_one_name_the_largest_counts_whichever_comes_last() -> None:
    """A wide constraint of one's own hid what a tight one of the same name lacked."""
    s, kept = np.linspace(0.0, 1.0, 12), (0.0, 0.0)
    broken = np.full((12, 1), -1.0)
    broken[3] = 0.1
    tight, wide = (Block("pace", rows, nothing, np.arange(12), kept) for rows in (broken, np.full((12, 1), -1.0)))
    for blocks in ((tight, wide), (wide, tight)):
        assert checked(*blocks, s=s) == ({"pace": 0.1}, ("pace",), pytest.approx(0.15), [3])


def test_what_hinders_a_shorter_time_is_what_depends_on_time_and_is_at_its_edge() -> None:
    def block(name: str, value: float, **more: Any) -> Block:
        return Block(name, np.full((3, 1), value), nothing, np.arange(3), (0.0, 0.0), **more)

    near, far = -0.5 * ExchangeOptions.binding, -1.5 * ExchangeOptions.binding
    blocks = block("at", near), block("below", far), block("place", 0.0, scales=False), block("beyond", 0.5)
    slows = block("by T", near, scales=False, by_duration=np.ones((3, 1)))
    assert checked(*blocks, slows, s=np.linspace(0, 1, 3))[1] == ("at", "beyond", "by T")


@dataclass(frozen=True)
class Slower(Constraint):
    """dq/dt at most v(q), and a place that is of no matter to time."""

    most: Callable[[Array], Array]

    def blocks(self, motion: MotionEvaluation) -> Iterator[Block]:
        q, dq = motion.at_nodes[:2]
        h = 1e-6

        def gradient(node: Indices, row: Indices) -> Array:
            out = np.zeros((len(node), 4))
            slope = (1 / self.most(q[node] + h) - 1 / self.most(q[node] - h)) / (2 * h)
            out[:, 0], out[:, 1] = (dq[node] * slope)[:, 0], 1 / self.most(q[node])[:, 0]
            return out

        yield Block("speed", dq / self.most(q) - 1, gradient, motion.nodes)
        yield Block("place", q - 2.0, lambda i, f: np.eye(4)[np.zeros(len(i), dtype=int)], motion.nodes, scales=False)


def a_joint(constraint: Constraint) -> TransportProblem:
    """From 0 to 1."""
    made: Any = SimpleNamespace(
        nodes=np.zeros(0),
        n=1,
        arm=SimpleNamespace(n=1, base=None),
        limits=None,
        constraints=(constraint,),
        cases=(),
        moving=False,
        keep_out=None,
    )
    made.start, made.goal = AtPosture(np.zeros(1)), AtPosture(np.ones(1))

    def at(s: Array, z: Array, duration: float, nodes: Indices, imposed: bool = True) -> MotionEvaluation:
        return MotionEvaluation(None, 0, None, s, duration, z, nodes, imposed, False)

    made.at = at
    return made


def test_a_narrow_place_between_the_nodes_is_gone_through_slowly_and_every_step_is_counted(monkeypatch) -> None:
    """About q = 0.3 a joint may be no faster than 0.85 of what it may be elsewhere, and with 25 nodes that is between
    two of them; looked at 4001 times it is kept. No motion takes less than the sum of dq / v(q)."""
    steps, minimise = [], exchange.minimise

    def counted(*arguments: Any) -> Any:
        found = minimise(*arguments)
        steps.append(found.iterations)
        return found

    def most(q: Array) -> Array:
        return np.asarray(1.0 - 0.15 * np.exp(-(((q - 0.3) / 0.02) ** 2)))

    monkeypatch.setattr(exchange, "minimise", counted)
    spline, s = RestSpline(5, 8), np.linspace(0, 1, 101)
    begin = SplineMotion(spline, spline.fit(s, smooth_step(s)[:, None]), 4.0)
    found = optimise(a_joint(Slower(most)), FreeCurve, begin, 3)
    assert found.status.ok, found.status
    assert found.binding == ("speed",)
    assert len(steps) > 1
    assert found.iterations == sum(steps)
    q, dq = Grid.of(spline, np.linspace(0, 1, 4001)).motion(found.coefficients, found.duration)[:2]
    checked = Grid.of(spline, spline.nodes(3), exchange.ExchangeOptions().finer).motion(
        found.coefficients, found.duration
    )[0]
    step = np.diff(checked[np.abs(checked - 0.3) < 0.03]).max()
    assert step < 0.02
    assert np.max(dq / most(q)) < 1 + 0.15 * (0.5 * step / 0.02) ** 2  # half way between two points of the check
    u = np.linspace(0, 1, 10001)
    assert np.trapezoid(1 / most(u), u) < found.duration < 1.5


def test_a_search_goes_on_only_while_it_may_come_below_what_is_to_be_beaten() -> None:
    """No motion at speeds of at most 1 from 0 to 1 takes less than 1 s, and at rest at its ends somewhat more."""
    spline, s = RestSpline(5, 6), np.linspace(0, 1, 101)
    begin = SplineMotion(spline, spline.fit(s, smooth_step(s)[:, None]), 4.0)
    problem = a_joint(Slower(np.ones_like))
    free, wide, tight = (optimise(problem, FreeCurve, begin, 3, beat=beat) for beat in (np.inf, 1.5, 1.0))
    assert free.status.ok
    assert 1.0 < free.duration < 1.5
    assert wide.duration == free.duration
    assert not tight.status.ok
    assert tight.status.code == "beaten"
    assert tight.iterations <= free.iterations


def test_rows_that_may_join_a_programme_are_the_ones_furthest_out_of_each_node() -> None:
    """Of two hundred rows a node two at most, and thrice as many where a step led beyond some that were left out."""
    values = np.random.default_rng(0).uniform(-0.1, 0.1, (40, 200))
    block = Block("rows", values, lambda i, f: np.zeros((len(i), 4)), np.arange(40), most=2)
    out = block.joining(np.zeros(values.shape, dtype=bool))
    for row, chosen in zip(values, out, strict=True):
        sixth = np.sort(row)[-6]
        assert chosen.tolist() == [bool(x >= sixth and x > UNSEEN) for x in row]
