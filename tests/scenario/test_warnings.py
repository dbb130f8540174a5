"""What of a scenario is probably not meant: taken as it is, and said before everything else."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from salver import scenario
from salver.cli import app
from salver.planning.make import make_plan
from salver.reports.pages.page import page
from salver.reports.run import read_run
from salver.scenario.warnings import warnings_of

RUNNER = CliRunner()
CUBE = scenario.load("panda-cube")


@pytest.mark.parametrize("name", scenario.names())
def test_ready_made_scenarios_have_none(name: str) -> None:
    assert warnings_of(scenario.load(name)) == ()


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        (
            {"arm__limits": {"velocity": 120}},
            "The limit of velocity of panda_joint1 and of 6 more is above the arm's own: 120 instead of 2.175 rad/s.",
        ),
        (
            {"arm__limits": {"torque": [87, 87, 100, 87, 12, 12, 12]}},
            "The limit of torque of panda_joint3 is above the arm's own: 100 instead of 87 N m.",
        ),
        ({"tray__mass": 2.8}, "The tray and its load weigh 3.06 kg; the maker rates the panda for 3 kg."),
        ({"objects__0__friction": 1.5}, "friction = 1.5 of cube: few materials have more than 1.2."),
        (
            {"objects__0__mass": 0.001, "objects__0__inertia": None},
            "mass = 0.001 of cube is 1 g; masses are in kg.",
        ),
        (
            {"objects__0__mass": 2.0},
            "mass = 2 of cube makes 3.12e+04 kg/m^3 of its shape, heavier than gold; masses are in kg, lengths in m.",
        ),
        ({"motion__max_tilt_deg": 0.3}, "motion.max_tilt_deg = 0.3 looks like radians; keys that end in _deg are in "),
        ({"motion__goal__rpy_deg": [0, 0, 1.5708]}, "motion.goal.rpy_deg = (0.0, 0.0, 1.5708) looks like radians; "),
        ({"arm__base_rpy_deg": [0, 0, -0.785]}, "arm.base_rpy_deg = (0.0, 0.0, -0.785) looks like radians; "),
        (
            {"objects__0__uncertainty": {}},
            "No parameter is uncertain; a plan is safe for exactly these values only.",
        ),
    ],
)
def test_each_by_itself(changes: dict[str, Any], says: str) -> None:
    (sentence,) = warnings_of(CUBE.with_changes(**changes))
    assert sentence.startswith(says)


def test_what_is_assumed_is_said_and_exact_values_are_called_so() -> None:
    """Of the cube's 4 cm: 3 mm to the sides, 2 mm in height."""
    made = CUBE.with_changes(objects__0__uncertainty=None)
    (sentence,) = warnings_of(made)
    assert sentence == (
        "cube has no [objects.uncertainty]; assumed half-ranges are friction 15 %, mass 10 %, centre of mass "
        "3, 3, 2 mm, place 2 mm."
    )
    exact = make_plan(CUBE.with_changes(objects__0__uncertainty="none"), "baseline")
    assert exact.verification.sentence.startswith("Checked at 601 instants, for exactly these values: the contact ")
    assert "exactly" not in make_plan(made, "baseline").verification.sentence


@pytest.mark.parametrize(
    "changes",
    [
        {"arm__limits": {"velocity": 2.0, "torque": 12}},
        {"tray__mass": 2.7},
        {"objects__0__friction": 1.2},
        {"motion__max_tilt_deg": 2.0},
        {"motion__goal__rpy_deg": [0, 0, 2.1]},  # so typed it is no number of radians
        {"arm__base_rpy_deg": [0, 0, 45.0]},
    ],
)
def test_what_is_meant_is_not_warned_of(changes: dict[str, Any]) -> None:
    assert warnings_of(CUBE.with_changes(**changes)) == ()


def test_limits_of_a_urdf_are_its_own(tmp_path: Path) -> None:
    """Of an arm that nobody knows by name, what its URDF gives."""
    from salver.models.arm.arm import load_arm

    assert CUBE.arm is not None
    path = tmp_path / "mine.urdf"
    path.write_text(load_arm(CUBE.arm, CUBE.tray).urdf)
    mine = {"arm__model": str(path), "arm__flange": "panda_link8", "arm__start_posture": None}
    assert warnings_of(CUBE.with_changes(**mine)) == ()
    (sentence,) = warnings_of(CUBE.with_changes(**mine, arm__limits={"velocity": 3.0, "jerk": 1e6}))
    assert sentence.startswith("The limit of velocity of panda_joint1 and of ")


@pytest.mark.slow
def test_they_are_said_first_in_text_json_and_on_the_page(tmp_path: Path) -> None:
    case = CUBE.with_changes(objects__0__friction=1.5)
    (says,) = warnings_of(case)
    plan = make_plan(case)
    plan.save(tmp_path / "run")
    assert json.loads((tmp_path / "run" / "plan.json").read_text())["warnings"] == [says]
    text = page(read_run(tmp_path / "run"))
    assert text.count(f"Warning: {says}") == 1
    assert text.index(f"Warning: {says}") < text.index('<section id="motion"')
    file = tmp_path / "case.toml"
    file.write_text((scenario.SCENARIO_DIR / "panda-cube.toml").read_text().replace("friction = 0.5", "friction = 1.5"))
    done = RUNNER.invoke(app, ["plan", str(file)], env={"COLUMNS": "200"})
    assert done.exit_code == 0, done.output
    assert done.stdout.splitlines()[1] == f"Warning: {says}"
