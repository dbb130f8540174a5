"""The benchmark of plans at other speeds: factors stay within what plans promise, a pause rests, records add up."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import speeds
from salver.planning.fastest import plan_fastest
from speeds import RATE, SLOWEST, STEP


def place(s):
    """Where on the motion it is, s at full speed."""
    return np.concatenate([[0.0], np.cumsum(0.5 * STEP * (s[1:] + s[:-1]))])


@pytest.mark.parametrize("law", [speeds.override, speeds.pause])
def test_factors_change_within_the_rate_and_reach_the_end(law):
    rng = np.random.default_rng(3)
    for duration in (0.5, 0.9, 3.0):
        _, s = law(duration, rng)
        assert np.abs(np.diff(s)).max() / STEP == pytest.approx(RATE, rel=2e-3)
        assert s.min() >= 0.0
        assert s.max() <= 1.0 + 1e-12
        assert place(s)[-1] > duration
    assert speeds.override(0.9, rng)[1].min() >= SLOWEST - 1e-12


def test_a_pause_rests_on_the_motion():
    rng = np.random.default_rng(4)
    for duration in (0.5, 0.9, 3.0):
        _, s = speeds.pause(duration, rng)
        resting = place(s)[s < 1e-9]
        assert len(resting) * STEP >= 0.95 * speeds.REST
        assert 0.0 < resting[0] < duration


def test_an_overridden_motion_is_the_integral_of_its_velocities():
    plan = plan_fastest(speeds.task("loads", "cube, friction 0.5"))
    moved = speeds.overridden(plan, *speeds.pause(plan.duration, np.random.default_rng(5)))
    joint = moved.joint
    walked = joint.q[0] + np.cumsum(0.5 * STEP * (joint.dq[1:] + joint.dq[:-1]), axis=0)
    assert joint.q[1:] == pytest.approx(walked, abs=1e-4)
    assert np.diff(joint.dq, axis=0)[1:-2] == pytest.approx(
        0.5 * STEP * (joint.ddq[1:] + joint.ddq[:-1])[1:-2], abs=1e-4
    )
    assert joint.q[-1] == pytest.approx(plan.joint.q[-1], abs=1e-9)


def test_records_of_tasks_count_runs_by_kind():
    def line(kind, number, outcome, duration=1.0):
        return {"group": "loads", "task": "a", "kind": kind, "number": number, "outcome": outcome, "duration": duration}

    lines = [line("plan", "any", "planned", 1.1), line("plan", "full", "planned"), line("plan", "level", "none"),
             *(line("pause", k, outcome) for k, outcome in enumerate(("holds", "holds", "tips"))),
             line("half", 0, "slides")]  # fmt: skip
    (found,) = speeds.gathered(lines)
    assert (found["any"], found["full"], found["level"]) == (1.1, 1.0, None)
    assert found["outcomes"] == {"pause": {"holds": 2, "tips": 1}}
    assert found["full at half speed"] == {"slides": 1}
    said = speeds.summary([found])
    assert "10.0 % at the mean" in said
    assert "2 of 3 runs hold at other speeds; of plans for full speed only, at half speed, 0 of 1" in said
