"""The safest motion in a given time, and how a search is watched on the command line."""

from __future__ import annotations

import os
import signal
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

from salver import scenario, simulate_legs
from salver.cli import app
from salver.cli.plans.plan import Effort
from salver.cli.plans.searching import searching
from salver.errors import ScenarioError, Status, UnreachableError
from salver.geometry import exp
from salver.models.contact_rows import contact_rows
from salver.models.tray_motion import at_rest
from salver.planning.fastest import EFFORTS, FastestOptions, plan_fastest, safest
from salver.planning.fastest.found import FastestMotion
from salver.planning.fastest.legs import plan_legs
from salver.planning.fastest.safest import _as_found, _margin_at_rest, plan_safest, plan_safest_legs, shared
from salver.planning.make import make_plan
from salver.planning.trajopt.spline import RestSpline

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


def test_shares_of_the_time_leave_all_legs_the_same_margin():
    """Of legs that lack c / T^p of their margin at rest, by hand: after one step where p is right."""
    at_rest, c, power = np.array([0.3, 0.25, 0.28]), np.array([0.1, 0.02, 0.05]), 3.0
    times = np.array([1.0, 1.0, 1.0])
    found = shared(times, at_rest, at_rest - c / times**power, power)
    assert found.sum() == pytest.approx(3.0)
    margins = at_rest - c / found**power
    assert np.ptp(margins) < 1e-9
    assert margins.min() > (at_rest - c).min()
    assert np.abs(shared(found, at_rest, margins, 2.0) - found).max() < 1e-9


def test_a_leg_is_taken_up_as_it_was_planned_with_the_margin_that_its_ends_have_at_rest():
    """The tray ends tilted by 10 degrees: there gravity alone takes part of what friction gives."""
    ends = {
        "motion__goal": {"position": [0.444272, 0.100574, 0.4], "rpy_deg": [10, 0, 0]},
        "motion__orientation": "free",
    }
    case = scenario.load("panda-cube").with_changes(objects__0__uncertainty={}, motion__duration=1.5, **ends)
    plan = make_plan(case)
    found = _as_found(plan, FEW)
    t = np.linspace(0, 1.5, 31)
    np.testing.assert_allclose(found.sample(t)[0], plan.joint.sample(t)[0], atol=5e-3)  # by eight pieces
    for ours, theirs in ((found.problem.start, plan.joint.q[0]), (found.problem.goal, plan.joint.q[-1])):
        assert np.array_equal(ours.q, theirs)
    (rows,) = contact_rows(case.payload)
    level, tilted = (-rows.worst(at_rest(R)[None]).max() for R in (np.eye(3), exp(np.array([np.deg2rad(10), 0, 0]))))
    assert tilted < level - 0.05
    assert _margin_at_rest(found) == pytest.approx(tilted, abs=1e-3)


def test_the_time_of_a_round_is_shared_until_its_legs_keep_the_same_margin(monkeypatch):
    """Of two legs that lack c / T^3 of their margin at rest: from the first two sharings it is seen which power it is,
    and the third is right. All searches are counted, and what is told counts from the edge of the contact."""
    at_rest, c = {"a": 0.3, "b": 0.25}, {"a": 0.10, "b": 0.02}
    good, asked = Status("optimal", "", True), []

    def optima(objective, begin, time, options, watch, anew):
        asked.append(anew)
        margin = at_rest[begin.name] - c[begin.name] / time**3
        return [replace(begin, margin=x, duration=time) for x in (margin - 0.1, margin)]

    @dataclass(frozen=True)
    class Leg:
        name: str
        duration: float = 0.9
        margin: float = 0.0
        wall_time: float = 0.5
        status: Status = good

    quickest = SimpleNamespace(
        ok=True, duration=1.8, legs=(Leg("a"), Leg("b")), solver={"seconds": 2.0, "name": "it"}, status=good
    )
    monkeypatch.setattr(safest, "plan_legs", lambda *_, **__: quickest)
    monkeypatch.setattr(safest, "_as_found", lambda leg, options: leg)
    monkeypatch.setattr(safest, "_margin_at_rest", lambda begin: at_rest[begin.name])
    monkeypatch.setattr(safest, "optima", optima)
    monkeypatch.setattr(safest, "_planned", lambda leg, motion, said: motion)
    case = scenario.load("waiters-round").with_changes(motion__duration=2.4, contact__margin=0.05)
    found = plan_safest_legs(case, options=FEW)
    margins = [leg.margin for leg in found.legs]
    assert found.duration == pytest.approx(2.4)
    assert np.ptp(margins) < 1e-8
    assert asked == [True, True, False, False, False, False]
    assert found.solver["seconds"] == pytest.approx(2.0 + 3 * 2 * 0.5)
    assert f"every contact {100 * (min(margins) + 0.05):.2g} % of the weight from its edge" in found.status.sentence


def test_how_far_the_safest_motion_keeps_a_contact_from_its_edge_is_told(monkeypatch):
    """What is sought is beyond the margin that the scenario asks for anyway."""
    good, problem = Status("optimal", "", True), SimpleNamespace(cases=())
    motion = FastestMotion(problem, RestSpline(5, 8), np.zeros((9, 7)), 0.7, good, {}, (), 0.1, 1)
    monkeypatch.setattr(safest, "quickest_within", lambda *_: (motion, 1.0))
    monkeypatch.setattr(safest, "optima", lambda *_: [replace(motion, margin=x) for x in (0.1, 0.2)])
    monkeypatch.setattr(FastestMotion, "joint_motion", lambda self: None)
    monkeypatch.setattr(safest, "at_every_speed", lambda found, plan, again: (found, plan))
    monkeypatch.setattr(safest, "solver_record", lambda found, robust: {})

    def joint_plan(case, problem, joint, status, record, method):
        return SimpleNamespace(status=status)

    monkeypatch.setattr(safest, "joint_plan", joint_plan)
    monkeypatch.setattr(safest, "judged", lambda plan, problem: plan)
    told = plan_safest(scenario.load("panda-cube").with_changes(contact__margin=0.05)).status.sentence
    assert "keeps every contact 25 % of the weight from its edge; the shortest found takes 0.7000 s." in told


@pytest.mark.slow
def test_the_safest_round_gives_its_legs_the_same_margin_and_takes_its_time(monkeypatch):
    """It keeps more than the fastest round, and holds in the engine. The fastest, which each begins from, is looked for
    once."""
    case = scenario.load("waiters-round").with_changes(motion__speeds="full")
    quickest = plan_legs(case, options=FEW)
    given = case.with_changes(motion__duration=1.3 * quickest.duration)
    with pytest.raises(ScenarioError, match="--safest"):
        plan_legs(given, options=FEW)
    monkeypatch.setattr(safest, "plan_legs", lambda *_, **__: quickest)
    found = plan_safest_legs(given, options=FEW)
    assert found.ok
    assert found.apart == 0
    assert found.duration == pytest.approx(1.3 * quickest.duration)
    margins = [leg.solver["margin"] for leg in found.legs]
    assert np.ptp(margins) < 0.03 * max(margins)
    assert min(margins) > 0.02 + max(leg.margins.exact_worst.min() for leg in quickest.legs)
    assert simulate_legs(found).outcome == "holds"
    with pytest.raises(UnreachableError, match="the shortest that were take"):
        plan_safest_legs(case.with_changes(motion__duration=0.5 * quickest.duration), options=FEW)
    with pytest.raises(ScenarioError, match="duration is missing"):
        plan_safest_legs(case, options=FEW)


@pytest.mark.slow
def test_the_safest_round_keeps_a_liquid_as_far_below_its_brim_as_the_loads_from_their_edge():
    """A glass of water beside a box that is taken off: with what is still uncertain of it, and in the engine."""
    water = {"radius": 0.035, "fill": 0.045, "brim": 0.08}
    cup = {
        "name": "cup",
        "shape": {"type": "cylinder", "radius": 0.038, "height": 0.085},
        "mass": 0.22,
        "friction": 0.4,
        "at": (0.05, 0.0),
        "liquid": water,
        "uncertainty": {"fill": "10%", "mass": "10%"},
    }
    box = {"name": "box", "shape": {"type": "box", "size": (0.05, 0.05, 0.08)}, "mass": 0.2, "friction": 0.4}
    box["uncertainty"] = "none"
    case = scenario.parse(
        {
            "name": "round",
            "motion": {
                "duration": 2.6,
                "speeds": "full",
                "orientation": "free",
                "start": {"position": (0.5, -0.3, 0.46)},
            },
            "legs": [
                {"goal": {"position": (0.56, -0.05, 0.46)}, "take": "box"},
                {"goal": {"position": (0.46, 0.2, 0.42)}},
            ],
            "objects": [cup, {**box, "at": (-0.05, 0.0)}],
            "contact": {"condition": "exact"},
            "arm": {"model": "panda"},
        },
        "round",
    )
    found = plan_safest_legs(case, options=FEW)
    assert found.ok, found.status.sentence
    for leg in found.legs:
        kept = leg.solver["margin"]
        assert kept > 0.1
        assert min(spill.slack.min() for spill in leg.margins.load_verdicts(worst=True)) > kept - 5e-3
        assert leg.verification.slack > kept - 5e-3
    least = min(leg.solver["margin"] for leg in found.legs)
    assert f"{100 * least:.2g} % of its room" in found.status.sentence
    assert simulate_legs(found, parameters={"cup.fill": 0.0495}).outcome == "holds"
