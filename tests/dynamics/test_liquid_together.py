"""Liquids worked out side by side are those worked out one at a time."""

from __future__ import annotations

import numpy as np
import pytest

from salver import linear_filter as filters
from salver.dynamics.liquid.sloshing import SloshingResponse
from salver.dynamics.motion_gradients import Unknowns
from salver.geometry import Array
from salver.linear_filter import LinearFilter
from salver.planning.trajopt.curves import FreeCurve, Grid
from salver.planning.trajopt.evaluation import MotionEvaluation
from salver.planning.trajopt.problem import TransportProblem, transport_problem
from salver.planning.trajopt.spline import RestSpline
from salver.scenario import load
from salver.sensitivity.arm.compliance import LoadResponses
from transport_problems import straight_start

BOX = {
    "objects__1__shape": {"type": "box", "size": [0.06, 0.07, 0.09]},
    "objects__1__liquid": {"kind": "water", "size": [0.05, 0.06], "fill": 0.05, "brim": 0.085},
}


def moved(problem: TransportProblem, faster: float = 1.0, swing: float = 0.1) -> MotionEvaluation:
    """A straight motion with a swing of the wrist in it, rad."""
    spline = RestSpline(5, 8)
    start = straight_start(problem, spline)
    grid, t = Grid.of(spline, spline.nodes(3)), start.duration / faster
    coefficients = start.coefficients.copy()
    coefficients[3:-3, 4:] += swing * np.sin(np.arange(coefficients[3:-3, 4:].size)).reshape(-1, problem.n - 4)
    curve = FreeCurve(problem, grid)
    return problem.at(grid.s, curve.motion(coefficients, t), t, grid.nodes)


@pytest.fixture(scope="module", params=["round", "round and a box"])
def glasses(request: pytest.FixtureRequest) -> TransportProblem:
    scenario = load("panda-four-glasses")
    return transport_problem(scenario if request.param == "round" else scenario.with_changes(**BOX))


def rows(part: SloshingResponse, unknowns: Unknowns) -> list[Array]:
    """All that is read of a part, and its derivatives."""
    K, T, _ = part.wrench.shape
    case, node = np.arange(40) % K, np.arange(40) * 7 % T
    found = [part.crest, part.free_height, part.wrench, part.left(), part.left(0.3)]
    return [
        *found,
        part.crest_by(case, node, unknowns),
        part.free_by(case, node, unknowns),
        part.left_by(case, unknowns),
    ]


def test_several_side_by_side_are_each_as_if_alone(glasses: TransportProblem) -> None:
    motion = moved(glasses)
    t, w, response = motion.s * motion.duration, motion.terms.w, motion.response
    rng = np.random.default_rng(0)
    unknowns = Unknowns(rng.standard_normal((len(t), 12, 5)), rng.standard_normal(5))
    together = LoadResponses.of(glasses.cases, t, w, response).each
    assert set(together) == {liquid[0].body.name for liquid in glasses.cases}
    for liquid in glasses.cases:
        name = liquid[0].body.name
        alone = LoadResponses.of((liquid,), t, w, response).each[name]
        for part, only in zip(together[name], alone, strict=True):
            assert part.modes.cases.each == liquid
            for x, y in zip(rows(part, unknowns), rows(only, unknowns), strict=True):
                np.testing.assert_allclose(x, y, rtol=1e-9, atol=1e-12)


def test_taken_to_give_way_as_itself_a_motion_is_what_it_was(glasses: TransportProblem) -> None:
    motion = moved(glasses)
    same = moved(glasses).giving_way_as(motion)
    for name, parts in motion.loads.items():
        for part, other in zip(parts, same.loads[name], strict=True):
            np.testing.assert_allclose(other.crest, part.crest, atol=1e-12)
            np.testing.assert_allclose(other.wrench, part.wrench, atol=1e-12)
            np.testing.assert_allclose(other.left(), part.left(), atol=1e-12)


def test_taken_to_give_way_as_one_near_by_waves_err_by_less_than_they_change(glasses: TransportProblem) -> None:
    motion, truly = moved(glasses), moved(glasses, 1.01)
    taken = moved(glasses, 1.01).giving_way_as(motion)
    for name, parts in truly.loads.items():
        before, after, guessed = (x.loads[name][1].crest for x in (motion, truly, taken))
        assert np.abs(guessed - after).max() < 0.25 * np.abs(after - before).max(), name
        assert taken.loads[name][1].planned is taken.loads[name][0].planned
        assert len(parts) == 2


@pytest.mark.parametrize("columns", [filters.MOST_BANDED_DRIVES, filters.MOST_BANDED_DRIVES + 1, 29, 30])
@pytest.mark.parametrize("moving", [True, False])
def test_few_and_many_drives_are_answered_alike(columns: int, moving: bool) -> None:
    rng, t = np.random.default_rng(1), np.sort(np.random.default_rng(2).uniform(0, 1, 30))
    kp = rng.uniform(300, 700, (3, 2, 1))
    kd, extra = 0.02 * np.sqrt(kp), 0.1 * kp[..., None] * rng.standard_normal((3, 2, 1, 30))
    several = LinearFilter.stiffened(t, kp, kd, extra)
    drive, start = rng.standard_normal((3, 2, 1, 30, columns)), rng.standard_normal((3, 2, 1, 2, columns))
    x, rate = several.respond(drive, start if moving else None)
    for column in (0, columns - 1):
        some = slice(column, column + 1)
        alone = several.respond(drive[..., some], start[..., some] if moving else None)
        np.testing.assert_allclose(x[..., column : column + 1], alone[0], rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(rate[..., column : column + 1], alone[1], rtol=1e-10, atol=1e-12)


def test_what_is_known_of_another_motion_is_refused(glasses: TransportProblem) -> None:
    """Its waves are the same only if what the tray feels is."""
    motion = moved(glasses)
    with pytest.raises(ValueError, match="belong to another motion"):
        moved(glasses, swing=0.2).knowing(terms=motion.terms)
    half = motion.knowing(terms=motion.terms, response=motion.response, sag=motion.sag).at_factor(0.5)
    assert half.terms.twist == pytest.approx(0.5 * motion.terms.twist)


def test_an_arm_taken_to_stray_as_from_a_motion_near_by_is_felt_as_its_own_motion_is(glasses: TransportProblem) -> None:
    """What it strays is the other's, what the tray then feels follows from where this motion is; standing still it sags
    as there."""
    motion, truly = moved(glasses), moved(glasses, 1.01)
    taken = moved(glasses, 1.01).straying_as(motion)
    before, after, guessed = (x.felt() for x in (motion, truly, taken))
    assert np.abs(guessed[0] - after[0]).max() < 0.1 * np.abs(before[0] - after[0]).max()
    np.testing.assert_array_equal(guessed[1].dw, before[1].dw)
    assert taken.felt(0.0)[1] is motion.sag
