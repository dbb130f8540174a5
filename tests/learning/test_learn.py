"""Careful first, then fast: the load stays on every trip, ranges shrink around the truth, motions get quicker."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from salver.cli import app
from salver.errors import SalverError, ScenarioError
from salver.learning import trips as made
from salver.learning.load.ranges import NAMES
from salver.learning.trips import _Hidden, trips, true_load
from salver.planning.fastest import plan_fastest
from salver.planning.plan import Plan
from salver.scenario import Scenario, load


@pytest.mark.slow
def test_second_trip_is_quicker_nothing_is_lost_and_the_truth_stays_within_the_ranges() -> None:
    """With the engine's steps of .5 ms the load of the third trip rocks on soft contacts and slides by 5.6 mm."""
    scenario, seed = load("panda-tall-bottle").with_changes(motion__speeds="full"), 0
    true, made = true_load(scenario, seed), list(trips(scenario, 3, seed))
    assert [trip.outcome for trip in made] == ["holds"] * 3
    assert made[1].plan.duration < 0.95 * made[0].plan.duration
    assert made[0].excitation is not None
    assert made[0].excitation.outcome == "holds"
    assert made[1].excitation is None
    widths = [scenario.payload.uncertain.half_range[:4]]
    for trip in made:
        assert trip.learnt is not None
        assert trip.margin >= 0
        body = trip.learnt.scenario.payload.first
        values = [true[0], *(true[1:4] - body.com_G)]
        for name, value in zip(NAMES, values, strict=True):
            assert trip.learnt.ranges[name].low - 1e-9 <= value <= trip.learnt.ranges[name].high + 1e-9
        widths.append(trip.known.payload.uncertain.half_range[:4])
    assert np.all(np.diff(widths, axis=0) <= 1e-12)


@pytest.mark.slow
def test_a_plan_that_is_slower_is_not_taken(cube: Scenario, monkeypatch: pytest.MonkeyPatch) -> None:
    """The one before was safe for wider ranges; one that is quicker is taken."""
    case = cube.with_changes(objects__0__uncertainty={"mass": "10%"}, motion__speeds="full")
    plan = plan_fastest(case.with_changes(contact__margin=0.02))
    monkeypatch.setattr(_Hidden, "excite", lambda hidden: None)
    for others, kept in ((plan.at_speed(0.9), True), (plan_fastest(case), False)):
        monkeypatch.setattr(made, "plan_fastest", lambda known, options, others=others: others)
        second = list(trips(case, 2, 1, "torques", plan))[1]
        assert second.kept == kept
        assert second.plan is (plan if kept else others)
    monkeypatch.setattr(_Hidden, "identify", lambda *_: (_ for _ in ()).throw(SalverError("The log ends early.")))
    (trip,) = trips(case, 1, 1, "torques", plan)
    assert (trip.outcome, trip.learnt, trip.told) == ("holds", None, "The log ends early.")


@pytest.mark.slow
def test_ranges_are_narrowed_by_all_logs_within_what_was_known(bottle_plan: Plan) -> None:
    """Twice the same motion: half the variance. What was known besides, here the mass, stays known."""
    hidden = _Hidden(bottle_plan.scenario, true_load(bottle_plan.scenario, 3), 3, "wrist")
    one, two = (hidden.identify(bottle_plan, name) for name in ("one", "two"))
    share = np.diag(two.covariance)[:4] / np.diag(one.covariance)[:4]
    assert 0.4 < np.mean(share) < 0.7  # both estimates of the noise vary
    assert len(hidden.runs) == 2
    mass, half = float(hidden.true[0]), 1e-7
    known = {"objects__0__mass": mass, "objects__0__uncertainty__mass": half}
    hidden.known = bottle_plan.scenario.with_changes(**known)
    hidden.identify(bottle_plan, "three")
    assert hidden.known.payload.uncertain.half_range[0] <= half * (1 + 1e-9)
    assert abs(hidden.known.payload.first.inertial.mass - mass) <= half


def test_true_load_lies_in_the_set_and_differs_with_the_seed() -> None:
    scenario = load("panda-tall-bottle")
    body, half = scenario.payload.first, scenario.payload.uncertain.ranges
    for seed in range(5):
        true = true_load(scenario, seed)
        off = np.append(true[0] - body.inertial.mass, true[1:4] - body.com_G)
        assert np.all(np.abs(off) <= list(half.values())[:4])
    assert not np.array_equal(true_load(scenario, 0), true_load(scenario, 1))


def test_what_cannot_be_learnt_is_refused() -> None:
    with pytest.raises(ScenarioError, match="one rigid load"):
        next(trips(load("panda-coffee"), 1))
    with pytest.raises(ScenarioError, match="no arm; learning"):
        next(trips(load("tall-box-56"), 1))


def test_command_refuses_to_write_over_a_file(tmp_path: Path) -> None:
    there = tmp_path / "there.toml"
    there.write_text("")
    done = CliRunner().invoke(app, ["learn", "panda-tall-bottle", "-o", str(there)])
    assert done.exit_code == 2
    assert there.read_text() == ""


@pytest.mark.slow
def test_joint_torques_locate_a_load_by_an_excitation_trajectory() -> None:
    """Carried gently they weigh it; that motion takes a tenth off the second trip. Nothing is lost, the truth stays in
    the ranges."""
    wide = {"mass": "50%", "com": [0.015, 0.015, 0.015], "friction": 0.2}
    scenario, seed = load("panda-tall-bottle").with_changes(objects__0__uncertainty=wide, objects__0__friction=0.4), 1
    careful, second = trips(scenario, 2, seed, "torques")
    assert [careful.outcome, careful.excitation.outcome, second.outcome] == ["holds"] * 3
    assert second.plan.duration < 0.9 * careful.plan.duration
    known, true = second.known.payload, true_load(scenario, seed)
    off = np.abs(true[:4] - [known.first.inertial.mass, *known.first.com_G])
    assert np.all(off <= known.uncertain.half_range[:4] + 1e-12)
    assert np.all(known.uncertain.half_range[:2] < [0.03, 0.013])  # a sensor may be wrong beside its noise
