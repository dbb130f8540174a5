"""Sequential quadratic programming of motions, on problems in a plane whose answers are known: q is the unknown."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest

from salver.geometry import Array
from salver.planning.trajopt import sqp
from salver.planning.trajopt.constraints.constraints import UNSEEN, Block, Constraint
from salver.planning.trajopt.curves import ORDERS, Grid
from salver.planning.trajopt.evaluation import Indices, MotionEvaluation
from salver.planning.trajopt.objectives import Duration, Objective, Point, QuadraticModel, Scalar
from salver.planning.trajopt.programme import Iterate, Linearised, Programme, Subproblem
from salver.planning.trajopt.sqp import Attempt, SqpOptions, minimise
from salver.planning.trajopt.trust import Trust
from transport_problems import Distance

Value = Callable[[Array, float], Array]
PLAIN = {"margins": (0.0, 0.0), "scales": False}


@dataclass(frozen=True, eq=False)
class Plane:
    """A curve that stays at one place q (n,): coefficients (1, n)."""

    n: int = 2
    given: tuple[int, int] = (0, 0)
    below: tuple[Array, Array] | None = None
    walled: bool = False  # places with q_0 > 1 are none

    grid = Grid(np.array([0.0, 1.0]), np.tile([[[1.0]], [[0.0]], [[0.0]], [[0.0]]], (1, 2, 1)), np.array([0]))

    @property
    def width(self) -> int:
        return self.n

    def motion(self, coefficients: Array, duration: float) -> Array:
        return self.grid.motion(coefficients, duration)

    def evaluated(self, coefficients: Array, duration: float) -> MotionEvaluation:
        z = self.motion(coefficients, duration)
        return MotionEvaluation(None, 0, None, self.grid.s, duration, z, self.grid.nodes, True, False)

    def metric(self, duration: float, damping: float) -> Array:
        return np.full((1, 1), damping)

    def by_duration(self, coefficients: Array, duration: float, z: Array) -> Array:
        return np.asarray(-ORDERS * z)

    def columns(self, coefficients: Array, duration: float, parts: Array, point: Indices) -> Array:
        return self.grid.chained(parts, point, duration)

    def fixed(self) -> tuple[int, int]:
        return self.given

    def equalities(self, coefficients: Array) -> tuple[Array, Array]:
        return np.zeros((0, self.n)), np.zeros(0)

    def inequalities(self, coefficients: Array) -> tuple[Array, Array]:
        return self.below or (np.zeros((0, self.n)), np.zeros(0))

    def repaired(self, coefficients: Array) -> Array | None:
        return None if self.walled and coefficients[0, 0] > 1.0 else coefficients


@dataclass(frozen=True, eq=False)
class Rows(Constraint):
    """Rows (m,) of q and T, with derivatives by q and log T from central differences."""

    value: Value
    name: str = "rows"
    more: dict[str, Any] = field(default_factory=dict)

    def blocks(self, motion: MotionEvaluation) -> Iterable[Block]:
        q, duration, h = motion.z[0, 0], motion.duration, 1e-6
        sides = [[self.value(q + s * h * e, duration) for s in (-1, 1)] for e in np.eye(len(q))]
        slope = np.stack([(up - down) / (2 * h) for down, up in sides], axis=1)

        def gradient(node: Indices, row: Indices) -> Array:
            return np.hstack([slope[row], np.zeros((len(row), 3 * len(q)))])

        values = self.value(q, duration)[None]
        slower = (self.value(q, duration * (1 + h)) - self.value(q, duration * (1 - h))) / (2 * h)
        yield Block(self.name, values, gradient, np.array([0]), **{**PLAIN, "by_duration": slower[None], **self.more})


@dataclass(frozen=True)
class Along(Objective):
    """-c q, without curvature."""

    c: tuple[float, ...]

    def value(self, curve: Any, at: Point) -> float:
        return -float(np.dot(self.c, at.coefficients[0]))

    def model(self, curve: Any, at: Point) -> QuadraticModel:
        return QuadraticModel(-np.array(self.c))


@dataclass(frozen=True)
class Roomy(Objective):
    """The distance from the edge of the rows called "counted", made large."""

    scalar = Scalar.MARGIN

    def value(self, curve: Any, at: Point) -> float:
        return -at.margin

    def model(self, curve: Any, at: Point) -> QuadraticModel:
        return QuadraticModel(np.zeros(at.coefficients.size), -1.0)

    def scale(self, at: Point, value: float) -> float:
        return 0.1

    def counts(self, block: Block) -> bool:
        return block.name == "counted"


def disc(x: float, y: float, radius: float) -> Rows:
    """Within a circle: the distance from its middle, less its radius."""
    return Rows(lambda q, _: np.array([np.hypot(*(q[:2] - [x, y])) - radius]))


def to(*place: float) -> Distance:
    wanted = np.zeros((4, 2, len(place)))
    wanted[0] = place
    return Distance(wanted)


def programme(objective: Objective, *rows: Rows, **plane: Any) -> Programme:
    return Programme(Plane(**plane), rows, objective)


def place(*q: float, duration: float = 1.0, margin: float = 0.0) -> Point:
    return Point(np.array([q], dtype=float), duration, margin)


# What is found ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("start", [(0.0, 0.0), (2.0, -1.0), (0.6, 0.8)])
def test_the_nearest_point_of_a_disc_is_found_and_every_programme_counted(start, monkeypatch):
    asked, tried = [], []
    solve, attempt = Subproblem.solve, sqp._attempt

    def solving(self: Subproblem, rows: Linearised) -> Any:
        asked.append(rows)
        return None if len(asked) == 1 else solve(self, rows)  # the solver gives up once

    monkeypatch.setattr(Subproblem, "solve", solving)
    monkeypatch.setattr(sqp, "_attempt", lambda *given: tried.append(attempt(*given)) or tried[-1])
    task = programme(to(3.0, 4.0), disc(0, 0, 1.0))
    found = minimise(task, task.begin(np.array([start]), 1.0), SqpOptions())
    assert found.status.ok
    assert found.iterate.coefficients[0] == pytest.approx([0.6, 0.8], abs=0.01)  # the cost to 1e-4 of 8
    assert found.programmes == len(asked)
    assert found.iterations == len(tried)
    assert found.iterations < 12


def test_where_no_place_is_allowed_that_is_seen_soon():
    """Two discs of radius 1 with middles 4 apart: 1 is missed at best."""
    task = programme(to(0.0, 3.0), disc(0, 0, 1.0), disc(4.0, 0, 1.0))
    found = minimise(task, task.begin(np.array([[2.0, 0.5]]), 1.0), SqpOptions(iterations=200))
    assert found.status.code == "infeasible"
    assert 1.0 - 1e-9 < found.status.details["violation"] < 1.05
    assert found.iterations < 20


def test_a_time_that_only_rows_of_its_square_limit_is_found_at_once():
    """Rows (1 + q q) / T^2 - 1: the shortest time is 1, at q = 0; multiplied by T^2 they are linear in it."""
    rows = Rows(lambda q, t: np.array([(1 + q @ q) / t**2 - 1]), more={"scales": True})
    for duration in (0.5, 3.0):
        task = programme(Duration(), rows)
        found = minimise(task, task.begin(np.array([[0.5, -0.3]]), duration), SqpOptions())
        assert found.status.ok
        assert found.iterate.duration == pytest.approx(1.0, abs=1e-3)
        assert found.iterations < 15


def test_the_largest_margin_is_that_of_the_middle():
    """Between two walls that count 2 apart, and below a ceiling that does not count."""
    walls = Rows(lambda q, _: np.array([q[0] - 1.5, -0.5 - q[0]]), "counted")
    ceiling = Rows(lambda q, _: np.array([q[1] - 0.1]))
    task = programme(Roomy(), walls, ceiling)
    begin = task.begin(np.array([[1.3, 0.05]]), 1.0)
    assert begin.point.margin == pytest.approx(0.2)
    assert begin.blocks[0].values.max() == pytest.approx(0.0, abs=1e-12)
    assert begin.blocks[1].values.max() == pytest.approx(-0.05)
    found = minimise(task, begin, SqpOptions())
    assert found.status.ok
    assert found.iterate.point.margin == pytest.approx(1.0, abs=1e-3)
    assert found.iterate.coefficients[0, 0] == pytest.approx(0.5, abs=1e-3)


@pytest.mark.parametrize("start", [(-1.2, 1.4), (-4.0, 5.0)], ids=["near", "too far for one step"])
def test_what_an_iteration_promises_and_brings_is_counted_in_the_merit(start, monkeypatch):
    """Cost and price times violation: what the model of both loses by the step, and what they themselves lose; a step
    that loses nothing is not taken."""
    seen, attempt = [], sqp._attempt

    def noted(task: Programme, path: Iterate, masks: Any, trust: Trust, *more: Any) -> Any:
        seen.append((path, found := attempt(task, path, masks, trust, *more), trust.penalty))
        return found

    monkeypatch.setattr(sqp, "_attempt", noted)
    bent = Rows(lambda q, _: np.array([q[1] - np.sin(3 * q[0]), q[0] ** 2 + q[1] ** 2 - 2.0]))
    task = programme(Along((1.0, 2.0)), bent)
    found = minimise(task, task.begin(np.array([start]), 1.0), SqpOptions())
    assert found.status.ok
    accepted = [path for path, _, _ in seen[1:]] + [found.iterate]
    for (path, tried, price), after in zip(seen, accepted, strict=True):

        def merit(at: Iterate, price: float = price) -> float:
            x, y = at.coefficients[0]
            return -(x + 2 * y) + price * max(0.0, y - np.sin(3 * x), x**2 + y**2 - 2.0)

        assert tried.gained == pytest.approx(merit(path) - merit(tried.trial), abs=1e-9)
        assert tried.predicted == pytest.approx(tried.hoped + price * (path.violation - tried.slack), abs=1e-9)
        assert merit(after) <= merit(path)
    assert max(tried.programmes for _, tried, _ in seen) == 2


def test_a_correction_is_tried_where_a_step_brings_less_than_it_promised_and_only_there():
    flat, bent = (Rows(lambda q, _, k=k: np.array([q[1] + k * q[0] ** 2])) for k in (0.0, 0.3))
    for rows, programmes in ((flat, 1), (bent, 2)):
        task = programme(Along((1.0, 20.0)), rows)
        path = task.begin(np.array([[0.0, 0.0]]), 1.0)
        masks = [np.ones((1, 1), dtype=bool)]
        tried = sqp._attempt(task, path, masks, Trust(penalty=100.0), SqpOptions())
        assert tried is not None
        assert tried.programmes == programmes


def test_the_share_of_an_arc_that_is_taken_is_the_best_of_it():
    """Along x + a d + a^2 b cost falls by p a and the violation grows as L a^3: best is a = sqrt(p / (3 price L)). The
    straight way, and the arc on the other side, are worse."""
    p, left, price = 1.0, 4.0, 1.0
    rows = Rows(lambda q, _: np.array([left * q[0] ** 3 + 9.0 * (q[1] - q[0] ** 2) ** 2]))
    task = programme(Along((p, 0.0)), rows)
    path = replace(task.begin(np.zeros((1, 2)), 1.0))
    step, corrected = np.array([1.0, 0.0, 0.0]), (np.array([1.0, 1.0, 0.0]), 0.0, np.zeros(1))
    trial = task.moved(path, step)
    assert trial is not None
    taken, share = sqp._along_arc(task, path, trial, step, corrected, 0.0, p, price)
    assert share == pytest.approx(np.sqrt(p / (3 * price * left)))
    assert taken.coefficients[0] == pytest.approx([share, share**2])
    straight, share = sqp._along_arc(task, path, trial, step, None, 0.0, p, price)  # without: as if it grew like a^2
    assert share == pytest.approx(max(0.1, p / (2 * price * (left + 9.0))))
    assert straight.coefficients[0] == pytest.approx([share, 0.0])
    good = np.array([0.1, 0.0, 0.0])
    assert sqp._along_arc(task, path, task.moved(path, good), good, None, 0.0, 0.1, price)[1] == 1.0


def test_a_search_is_beaten_where_what_it_can_still_hope_for_is_not_enough():
    task = programme(to(1.0, 0.0), disc(0, 0, 5.0))
    path = replace(task.begin(np.zeros((1, 2)), 1.0), cost=1.0)
    assert [SqpOptions(beat=beat).beaten(path, 0.1) for beat in (0.85, 0.95)] == [True, False]
    assert not SqpOptions(beat=0.85).beaten(replace(path, cost=0.2), 0.1)
    assert not SqpOptions(beat=0.5).beaten(path, 0.2)  # a long step: no telling
    # What it takes to keep its rows makes it longer; from afar that is said to be too much, so half of it counts.
    assert [SqpOptions(beat=beat).beaten(path, -0.1) for beat in (1.04, 1.06)] == [True, False]
    # A row is still violated by a little: what ended the search is said, so that it may be taken up again.
    outside = programme(to(1.0, 0.0), disc(0, 0, 0.99))
    path = outside.begin(np.array([[1.0, 0.0]]), 1.0)
    assert 5e-4 < path.violation < 0.05
    assert minimise(outside, replace(path, cost=1.0), SqpOptions(beat=0.5)).status.code == "beaten"


@pytest.mark.parametrize(("hoped", "steps"), [(0.005, 1), (0.007, 3)])
def test_near_an_end_a_step_that_led_nowhere_is_not_tried_again(hoped, steps, monkeypatch):
    """Where 1e-3 counts as nothing and a step that was to bring six times that brought none, the search ends."""
    tried = []

    def in_vain(*given: Any) -> Attempt:
        tried.append(given)
        left = hoped / 2 ** (len(tried) // 3)  # smaller steps promise less
        return Attempt(None, 0.1, -np.inf, left, 0.0, 1.0, (np.zeros((1, 1), dtype=bool),), 1)

    monkeypatch.setattr(sqp, "_attempt", in_vain)
    task = programme(to(1.0, 0.0), disc(0, 0, 5.0))
    path = replace(task.begin(np.zeros((1, 2)), 1.0), cost=1.0)
    assert minimise(task, path, SqpOptions(gain=1e-3)).status.code == "optimal"
    assert len(tried) == steps


def test_the_change_of_rows_is_that_of_those_near_their_edge():
    values = Rows(lambda q, _: np.array([q[0], -0.5 - q[0], -7.0 + 3 * q[0]]))
    task = programme(to(0.0, 0.0), values)
    before, after = (task.begin(np.array([[x, 0.0]]), 1.0) for x in (-0.2, 0.3))
    assert sqp._change(before, after) == pytest.approx([0.5])


# What a programme is made of -------------------------------------------------------------------------------------


def test_a_step_moves_the_place_and_the_scalar():
    shortest, roomy = programme(Duration(), disc(0, 0, 1)), programme(Roomy(), disc(0, 0, 1))
    path = shortest.begin(np.array([[0.1, 0.2]]), 2.0)
    moved = shortest.moved(path, np.array([0.5, -3.0, 0.21]))
    assert moved is not None
    assert moved.coefficients[0] == pytest.approx([0.6, -2.8])
    assert moved.duration == pytest.approx(2.2)  # the scalar is the share by which T^2 grows
    assert shortest.moved(path, np.array([0.5, 3.0, -1.0])) is None
    path = roomy.at(place(0.1, 0.2, margin=0.3))
    moved = roomy.moved(path, np.array([0.5, 0.7, 0.04]))
    assert moved is not None
    assert moved.point.margin == pytest.approx(0.34)


def test_rows_of_a_margin_change_by_it_and_others_do_not():
    walls, other = Rows(lambda q, _: np.array([q[0] - 1.0]), "counted"), Rows(lambda q, _: np.array([q[1]]))
    task = programme(Roomy(), walls, other)
    path, more = (task.at(place(0.3, -0.2, margin=x)) for x in (0.1, 0.15))
    rows = task.linearised(path, [np.ones((1, 1), dtype=bool)] * 2)
    change = np.concatenate(
        [b.values.ravel() - a.values.ravel() for a, b in zip(path.blocks, more.blocks, strict=True)]
    )
    assert change == pytest.approx(rows.matrix[:, -1] * 0.05)
    assert rows.matrix == pytest.approx(np.array([[1.0, 0.0, 1.0], [0.0, 1.0, 0.0]]), abs=1e-9)


def test_corrected_rows_are_exact_where_the_step_led():
    """Those that scale are multiplied by the square of the time, as shares of its own; far ones are left out."""
    value = Rows(lambda q, t: np.array([(1 + q[0] ** 2) / t**2 - 1, q[1] ** 2 / t**2 - 6.0]), more={"scales": True})
    plain = Rows(lambda q, _: np.array([np.sin(q[0]) - 0.1]))
    task = programme(Duration(), value, plain)
    path, step = task.at(place(0.2, 0.1)), np.array([0.5, 0.3, -0.19])
    trial = task.moved(path, step)
    assert trial is not None
    rows = task.linearised(path, [np.ones((1, 2), dtype=bool), np.ones((1, 1), dtype=bool)])
    bent = task.corrected(rows, trial, step)
    true = np.array([1.49 - 0.81, np.sin(0.7) - 0.1])  # (1 + 0.7^2) - T^2 with T = 0.9, and what knows no time
    assert len(bent.bound) == 2
    assert bent.matrix == pytest.approx(rows.matrix[[0, 2]])
    assert bent.matrix @ step - bent.bound == pytest.approx(true)


@pytest.mark.parametrize("objective", [Duration(), Roomy()])
def test_rows_beyond_a_kink_are_those_of_the_trial(objective):
    """Exact there, and in the scalar as the step counts it: shares of the square of the path's time, not of its own."""
    name = "counted" if isinstance(objective, Roomy) else "rows"
    rows = Rows(lambda q, t: np.array([(2 + q[0]) / t**2 - 1]), name, more={"scales": True, "kinked": True})
    task = programme(objective, rows)
    path = task.at(place(0.0, 0.0, duration=1.3, margin=0.1))
    trial = task.moved(path, np.array([0.4, 0.2, -0.2]))
    assert trial is not None
    found = task.beyond_kinks(path, trial)
    (value,) = trial.blocks[0].values[0]
    there = np.array([0.4, 0.2, -0.2])
    assert value > 0
    assert found.matrix @ there - found.bound == pytest.approx([value])
    by_scalar = -1 / 0.8 if isinstance(objective, Duration) else 1.0  # of (2.4 / T_1^2) - (1 + x) / (1 + x_1)
    assert found.matrix == pytest.approx(np.array([[1 / trial.duration**2, 0.0, by_scalar]]), abs=1e-6)


def test_the_programme_of_an_iteration_bends_as_the_cost_does():
    """Along any step, without the proximal term: half the second derivative. What is given is no unknown."""
    near = programme(to(1.0, 2.0, 3.0, 4.0, 5.0), n=5, given=(1, 2))
    path = near.at(place(0.0, 0.0, 0.0, 0.0, 0.0))
    posed = near.subproblem(path, Trust(damping=0.0, penalty=5.0))
    assert posed.hessian[:5, :5] == pytest.approx(np.eye(5), abs=1e-6)
    assert posed.cost[:5] == pytest.approx([-1.0, -2.0, -3.0, -4.0, -5.0])
    assert posed.free.tolist() == [1, 2, 6]  # two places and the slack


def posed(rows: Sequence[Sequence[float]], bound: Sequence[float], **plane: Any) -> tuple[Array, float, Array]:
    """The step from 0 nearest to (0.4, -0.2), with rows of (q, scalar): step, slack and multipliers."""
    task = programme(to(0.4, -0.2), **plane)
    found = task.subproblem(task.at(place(0.0, 0.0)), Trust(damping=0.0, penalty=50.0)).solve(
        Linearised(np.array(rows, dtype=float).reshape(-1, 3), np.array(bound, dtype=float))
    )
    assert found is not None
    return found


def test_the_step_of_a_programme_by_hand():
    step, slack, _ = posed([], [])
    assert step == pytest.approx([0.4, -0.2, 0.0], abs=1e-4)
    assert slack == pytest.approx(0.0, abs=1e-4)
    step, slack, worth = posed([[1, 0, 0]], [0.1])  # half the square of 0.4 - x: a unit of room is worth 0.3
    assert step == pytest.approx([0.1, -0.2, 0.0], abs=1e-4)
    assert slack == pytest.approx(0.0, abs=1e-4)
    assert worth == pytest.approx([0.3], abs=1e-3)
    step, slack, _ = posed([[1, 0, 0], [-1, 0, 0]], [-0.5, -0.3])  # left of -0.5 and right of 0.3: 0.4 is missed
    assert step == pytest.approx([-0.1, -0.2, 0.0], abs=1e-4)
    assert slack == pytest.approx(0.4, abs=1e-4)
    step, slack, worth = posed([[1, 0, 0]], [0.1], below=(np.array([[0.0, -1.0]]), np.array([-0.3])))
    assert step == pytest.approx([0.1, 0.3, 0.0], abs=1e-4)  # what the curve asks for has no slack
    assert len(worth) == 1
    step, _, _ = posed([], [], given=(1, 0))
    assert step == pytest.approx([0.0, -0.2, 0.0], abs=1e-4)


def test_a_step_that_leads_nowhere_is_shortened():
    task = programme(to(1.5, 0.0), disc(0, 0, 9.0), walled=True)
    found = minimise(task, task.begin(np.zeros((1, 2)), 1.0), SqpOptions())
    assert 0.8 < found.iterate.coefficients[0, 0] <= 1.0


def test_the_foremost_rows_of_each_node_are_considered_and_three_times_as_many_may_join():
    """What joins is at its edge, or beyond, and was not known."""
    values = np.random.default_rng(0).uniform(-0.1, 0.1, (40, 300))
    block = Block("rows", values, lambda node, row: np.zeros((len(row), 8)), np.arange(40), most=4)
    last = np.sort(values, axis=1)[:, ::-1]
    assert np.array_equal(block.near(1.0), values >= last[:, 3:4])
    assert np.array_equal(block.near(0.05), (values >= last[:, 3:4]) & (values > -0.05))
    known = np.random.default_rng(1).uniform(size=values.shape) < 0.5
    assert np.array_equal(block.joining(known), (values >= last[:, 11:12]) & (values > UNSEEN) & ~known)
