"""Where first-order tubes fall short, and whether the inflated ones hold samples that did not shape them."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from salver.planning.object.evaluation import evaluate
from salver.scenario import Scenario, load
from salver.simulation.inflation import RESERVE, Inflation, inflate
from salver.trajectory import min_jerk_line

CUBE = load("panda-cube").with_changes(arm=None)


def inflated(made: Scenario, n: int = 60) -> Inflation:
    start, goal = (np.array(p.position) for p in (made.motion.start, made.motion.goal))
    line = min_jerk_line(2.5, start, goal, np.eye(3), np.eye(3))
    return inflate(made, line, evaluate(made, line, 101), n, seed=1)


def with_com(size: float) -> Scenario:
    return CUBE.with_changes(objects__0__uncertainty={"mass": "10%", "com": [size, size, size]})


def test_large_ranges_leave_first_order_tubes_and_stay_in_inflated_ones() -> None:
    found = inflated(with_com(0.002))
    assert found.first_order.left > 0
    assert found.share > 0
    assert found.checked.left == 0
    assert "all 30 records stayed" in str(found)
    assert_allclose(found.share, RESERVE * found.first_order.relative.max())


def test_what_is_missing_is_of_second_order() -> None:
    """A quarter of the mass and centre of mass ranges: a share of the radius that is a quarter as large."""
    large = with_com(0.002)
    small = CUBE.with_changes(objects__0__uncertainty={"mass": "2.5%", "com": [0.0005] * 3})
    ratio = inflated(large).share / inflated(small).share
    assert ratio == pytest.approx(4, rel=0.35)


def test_tubes_grow_by_the_share_of_their_largest_radius() -> None:
    found = inflated(with_com(0.001), 20)
    start, goal = (np.array(p.position) for p in (CUBE.motion.start, CUBE.motion.goal))
    first = evaluate(with_com(0.001), min_jerk_line(2.5, start, goal, np.eye(3), np.eye(3)), 101).cone_radius
    assert_allclose(found.radius - first, np.broadcast_to(found.share * first.max(axis=0), first.shape), atol=1e-12)
