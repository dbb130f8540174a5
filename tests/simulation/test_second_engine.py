"""Loads in Drake, as an independent judge of the engine: only where Drake is installed (`pip install drake`)."""

import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pydrake", reason="drake is not installed")
sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

from by_hand import rocking
from salver.scenario import load
from salver.simulation.physics import simulate_tray
from salver.simulation.scene.loads import true_world
from salver.trajectory import min_jerk_line
from second_engine import in_drake, onset, random_cases


def test_sliding_begins_where_coulomb_says():
    expected, seen = onset(0.3)
    assert seen == pytest.approx(expected, rel=0.03)


def test_engines_and_hand_agree_on_random_boxes_and_cylinders():
    clear = [case for case in random_cases(8, 3) if not 0.97 < case.demand < 1.2]
    assert len(clear) >= 4
    for case in clear:
        held = case.demand < 1
        assert [outcome == "holds" for outcome in case.in_both()] == [held, held], case


def test_a_turning_tray_throws_a_load_off_in_both_or_in_neither():
    """What the frame's rotation does is a force in one engine and a motion in the other."""
    scenario = load("panda-cube").with_changes(arm=None, physics__settle_before=0.2, physics__settle_after=0.1)
    turned = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    for duration, holds in ((0.9, True), (0.5, False)):
        line = min_jerk_line(duration, np.zeros(3), np.array([0.3, 0.2, 0.0]), np.eye(3), turned)
        outcomes = simulate_tray(line, scenario).summary["outcome"], in_drake(line, scenario)["outcome"]
        assert [outcome == "holds" for outcome in outcomes] == [holds, holds]


@pytest.mark.slow
def test_rocking_by_hand_is_that_of_a_block_on_a_step_of_acceleration():
    """Below r / h of the weight it does not move, just above it comes back, far above it falls (Housner)."""
    scenario = load("panda-cube").with_changes(arm=None)
    (item,) = true_world(scenario).loads

    def peak(demand):
        """Of a line whose peak acceleration is a share of g r / h = g of the cube, which here cannot slide."""
        duration = np.sqrt(10 / np.sqrt(3) * 0.3 / (demand * 9.81))
        return rocking(item, min_jerk_line(duration, np.zeros(3), np.array([0.3, 0.0, 0.0]), np.eye(3), np.eye(3)))

    assert peak(0.99) == 0.0
    assert 0.0 < peak(1.02) < peak(1.05) < peak(1.1) < np.deg2rad(5)
    assert peak(3.0) > 0.5
