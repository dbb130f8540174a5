"""The safest motion in a given time, and how a search is watched on the command line."""

from __future__ import annotations

import os
import signal

import numpy as np
import pytest
from typer.testing import CliRunner

from salver import scenario
from salver.cli import app
from salver.cli.plans.plan import Effort
from salver.cli.plans.searching import searching
from salver.errors import ScenarioError, UnreachableError
from salver.planning.fastest import EFFORTS, FastestOptions, plan_fastest
from salver.planning.fastest.safest import plan_safest

FEW = FastestOptions(spans=8)
POST = {"type": "capsule", "position": [0.55, -0.02, 0.35], "radius": 0.03, "length": 0.7}


@pytest.mark.slow
def test_the_safest_motion_keeps_more_than_the_fastest_and_what_it_says_is_verified():
    case = scenario.load("panda-cube").with_changes(motion__duration=1.0)
    plan = plan_safest(case, options=FEW)
    assert plan.ok, (plan.status, plan.arm_status)
    assert plan.duration == pytest.approx(1.0)
    assert plan.method == "safest"
    assert plan.space == "joint"
    fastest = plan_fastest(case.with_changes(motion__duration=None), options=FEW)
    assert plan.verification.slack > fastest.verification.slack + 0.1
    assert plan.verification.slack == pytest.approx(plan.solver["margin"], abs=5e-3)
    assert (
        f"keeps every contact {100 * plan.solver['margin']:.2g} % of the weight from its edge" in plan.status.sentence
    )
    more = plan_safest(case.with_changes(contact__margin=0.05), options=FEW)  # what is sought is beyond that margin
    assert f"every contact {100 * (more.solver['margin'] + 0.05):.2g} % of the weight" in more.status.sentence
    assert more.verification.slack == pytest.approx(more.solver["margin"] + 0.05, abs=5e-3)
    # The plan of the fastest is longer by what its check asks for.
    assert 1.0 <= fastest.duration / plan.solver["shortest"] <= 1.0 + 1e-4 + 1e-9


@pytest.mark.slow
def test_the_safest_motion_goes_around_what_stands_in_the_way():
    case = scenario.load("panda-cube").with_changes(motion__duration=1.5, objects__0__uncertainty={}, obstacles=[POST])
    plan = plan_safest(case)  # eight pieces are too few to see a post between their nodes
    assert plan.ok, (plan.status, plan.arm_status)
    assert plan.arm_status.details["obstacle_clearance"]["distance"] > 0.004


@pytest.mark.slow
@pytest.mark.parametrize("duration", [1.4, 2.0])
def test_the_safest_motion_is_found_where_parts_nearly_touch_at_its_end(duration):
    """At the goal a UR3 holds its load 0.19 mm below a lintel: it can be told from a touch, and the motion keeps
    that."""
    goal, height = np.array([0.2362047494723212, -0.03567476161176461, 0.17602303813189518]), 0.044787770299700824
    case = scenario.parse(
        {
            "name": "lintel",
            "motion": {
                "start": {"position": [0.11234846028754783, 0.23084238251289887, 0.14341710457936369]},
                "goal": {"position": goal.tolist()},
                "goal_yaw": "free",
                "duration": duration,
                "speeds": "full",
            },
            "objects": [
                {
                    "shape": {"type": "box", "size": [0.04287422272541662, 0.04287422272541662, height]},
                    "mass": 0.158,
                    "friction": 0.376,
                    "uncertainty": "none",
                    "support_inset": 0.002,
                }
            ],
            "contact": {"condition": "exact"},
            "surroundings": {"floor": "none"},
            "tray": {"size": [0.108, 0.108], "mass": 0.2},
            "arm": {"model": "ur3"},
            "obstacles": [
                {
                    "name": "lintel",
                    "type": "box",
                    "size": [0.06, 0.06, 0.02],
                    "position": (goal + np.array([0, 0, height / 2 + 0.00019 + 0.01])).tolist(),
                }
            ],
        },
        "a task",
    )
    plan = plan_safest(case)
    assert plan.ok, (plan.status, plan.arm_status)
    near = plan.arm_status.details["obstacle_clearance"]
    assert "lintel" in (near["first"], near["second"])
    assert 0.0 < near["distance"] < 2e-4


def test_the_safest_motion_needs_a_duration_that_is_long_enough():
    case = scenario.load("panda-cube").with_changes(objects__0__uncertainty={})
    with pytest.raises(ScenarioError, match=r"motion\.duration is missing"):
        plan_safest(case.with_changes(motion__duration=None))
    with pytest.raises(
        UnreachableError, match=r"no safe motion in 0\.3 s was found; the shortest one that was found takes 0\.6"
    ):
        plan_safest(case.with_changes(motion__duration=0.3), options=FEW)


def test_efforts_have_one_set_of_names():
    assert [effort.value for effort in Effort] == list(EFFORTS)
    assert EFFORTS["normal"] == FastestOptions()
    assert all(options.time_limit is None for options in EFFORTS.values())


@pytest.mark.parametrize("given", [["--effort", "quick"], ["--time-limit", "3"], ["--fastest", "--safest"]])
def test_options_of_a_search_without_one_are_wrong_use(tmp_path, given):
    result = CliRunner().invoke(app, ["plan", "panda-cube", "-o", str(tmp_path / "run"), *given])
    assert result.exit_code == 2
    assert not (tmp_path / "run").exists()


def test_an_interruption_ends_the_search_and_not_the_command(capsys):
    before = signal.getsignal(signal.SIGINT)
    with searching() as watch:
        assert not watch.over()
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)  # a shell may send it twice
        assert watch.over()
        assert watch.ended == "interrupted"
    assert signal.getsignal(signal.SIGINT) is before
    assert capsys.readouterr().err.count("best found so far") == 1
