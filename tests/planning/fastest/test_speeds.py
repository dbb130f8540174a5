"""A plan that keeps its load only at full speed says so wherever it goes, and is not sent unless that is asked for."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import tomli_w
from typer.testing import CliRunner

import salver as sv
from salver import scenario
from salver.cli import app
from salver.driver.preflight import check_plan, demand
from salver.errors import SalverError, ScenarioError
from salver.export import FORMATS, write_export
from salver.export.motion import read_motion
from salver.export.urscript import program
from salver.files import read_json
from salver.models.arm.arm import load_arm
from salver.motion_files import read
from salver.planning.fastest import plan_fastest
from salver.planning.fastest.speeds import _lacking
from salver.planning.plan import Plan, load_plan
from salver.reports.pages.cells import speed_bar

BOTTLE = scenario.load("panda-tall-bottle").with_changes(motion__speeds="full")
ONLY = "NOT AT EVERY SPEED: Only at "


@pytest.fixture(scope="module")
def run(bottle_plan: Plan, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tall bottle on a tray that leans for the acceleration of full speed."""
    return bottle_plan.save(tmp_path_factory.mktemp("speeds") / "run")


@pytest.fixture(scope="module")
def plan(run: Path) -> Plan:
    return load_plan(run)


@pytest.fixture(scope="module")
def level() -> Plan:
    """The paper's cube on a tray that stays level."""
    return plan_fastest(scenario.load("panda-cube").with_changes(motion__orientation="fixed"))


def checks_of(plan: Plan, **options: bool) -> list[str]:
    """Names of the checks that fail and are required."""
    arm = load_arm(plan.scenario.arm, plan.scenario.tray)  # type: ignore[arg-type]
    checks = check_plan(plan, arm, plan.scenario.payload.bodies, **options)
    return [check.name for check in checks if check.required and not check.ok]


def test_the_plan_and_its_record_say_at_which_speeds_it_holds(run: Path, plan: Plan) -> None:
    said = read_json(run / "plan.json")["speeds"]
    assert plan.ok
    assert plan.speeds.sentence in plan.facts()["speeds"]
    assert said["sentence"].endswith(plan.speeds.verdict)
    assert said["sentence"].startswith("Not checked at other speeds: how far the arm strays")
    assert said["intervals"] == [[pytest.approx(plan.speeds.intervals[0][0]), 1.0]]
    assert said["code"] == "tips"
    assert 0 < said["posture_time"] < plan.duration


@pytest.mark.slow
def test_the_command_says_it_before_the_table_of_margins(tmp_path: Path) -> None:
    file = tmp_path / "bottle.toml"
    file.write_text(tomli_w.dumps(BOTTLE.model_dump(mode="json", exclude_none=True)))
    said = CliRunner().invoke(app, ["plan", str(file), "--fastest", "-o", str(tmp_path / "run")])
    assert said.exit_code == 0, said.output
    words = " ".join(said.output.split())
    assert words.index("Only at") < words.index("sensitivity cost")
    assert "% bottle on tray tips in the worst case" in words


@pytest.mark.slow
def test_an_audit_of_the_planned_motion_says_the_same(run: Path, tmp_path: Path, plan: Plan) -> None:
    file = write_export(run, "csv", tmp_path / "bottle.csv", rate=200.0)[0]
    audit = sv.audit(file, sv.load_scenario("panda-tall-bottle"))
    assert audit.speeds_worst.sentence.startswith("Only at ")
    assert audit.speeds_worst.intervals[0][0] == pytest.approx(plan.speeds.intervals[0][0], abs=5e-3)
    assert audit.speeds_worst.sentence in sv.report(audit).html.split('class="speeds"')[1]
    text = CliRunner().invoke(app, ["audit", str(file), "-s", "panda-tall-bottle"]).stdout
    assert f"Speeds, worst case: {audit.speeds_worst.sentence}" in " ".join(text.split())
    assert audit.summary()["speeds"]["worst_case"]["sentence"] == audit.speeds_worst.sentence


@pytest.mark.parametrize(
    "file_format",
    [pytest.param(x, marks=pytest.mark.slow) if x == "mujoco" else x for x in FORMATS if x != "urscript"],
)
def test_every_format_says_it_in_its_heading(run: Path, tmp_path: Path, file_format: str) -> None:
    files = write_export(run, file_format, tmp_path / f"carry{FORMATS[file_format]}")
    heads = [file.read_text()[:1000] for file in files if file.suffix in (".csv", ".json", ".yaml", ".xml")]
    assert heads
    assert all(ONLY in head for head in heads)
    if file_format == "csv":
        assert read(files[0]).verdict.startswith(ONLY)


def test_the_table_of_a_motion_that_holds_at_every_speed_begins_with_its_heading(level: Plan, tmp_path: Path) -> None:
    assert level.speeds.every
    assert "Holds at every speed from 0 to 100 %" in level.verdict
    level.save(tmp_path / "run")
    assert write_export(tmp_path / "run", "csv", tmp_path / "cube.csv")[0].read_text().startswith("t,")


def test_a_program_says_what_the_speed_slider_does(run: Path) -> None:
    motion = read_motion(run, "plan", 500.0)
    names = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
    six = replace(motion, joint_names=tuple(f"{n}_joint" for n in names), q=np.asarray(motion.q)[:, :6])
    text = program(six, 500.0)
    assert text.startswith(f"# {ONLY}")
    assert "# Speed slider at 100 %" in text
    other = program(replace(six, verdict="Holds at every speed from 0 to 100 %."), 500.0)
    assert "Speed slider at 100 %" not in other
    assert "# Speed slider: the load is kept at any constant setting" in other


@pytest.mark.slow
def test_it_is_not_sent_unless_full_speed_only_is_given(run: Path, plan: Plan) -> None:
    arm = load_arm(plan.scenario.arm, plan.scenario.tray)  # type: ignore[arg-type]
    checks = check_plan(plan, arm, plan.scenario.payload.bodies)
    assert [check.name for check in checks if check.required and not check.ok] == ["speeds"]
    assert checks_of(plan, full_speed_only=True) == []
    with pytest.raises(
        SalverError, match=r"Not moved\. .*Only at .* % of full speed|Only at full speed.*--full-speed-only"
    ):
        demand(checks)
    refused = CliRunner().invoke(app, ["execute", str(run), "--dry-run", "--no-realtime"])
    assert refused.exit_code != 0
    assert "--full-speed-only" in refused.output


@pytest.mark.slow
def test_in_the_engine_the_bottle_tips_at_half_speed_and_stays_at_full_speed(run: Path, plan: Plan) -> None:
    """Where the nominal bottle does not stay either; one on a level tray does."""
    audited = CliRunner().invoke(app, ["simulate", str(run), "--speed", "0.5", "--json"])
    assert audited.exit_code == 0, audited.output
    assert json.loads(audited.stdout)["plan"]["outcome"] in ("tips", "lost")
    full = CliRunner().invoke(app, ["simulate", str(run), "--json"])
    assert json.loads(full.stdout)["plan"]["outcome"] == "holds"
    assert plan.at_speed(0.5).duration == pytest.approx(2 * plan.duration)
    with pytest.raises(ScenarioError, match="above 0 and at most 1"):
        plan.at_speed(1.5)


def test_the_bar_of_a_page_is_green_where_it_holds() -> None:
    bar = speed_bar({"intervals": [[0.0, 0.4], [0.92, 1.0]], "sentence": "<b>"})
    assert re.findall(r"left:([0-9.]+)%;width:([0-9.]+)%", bar) == [("0.00", "40.00"), ("92.00", "8.00")]
    assert "&lt;b&gt;" in bar
    assert speed_bar(None) == ""


@pytest.mark.slow
def test_the_page_of_a_plan_shows_the_bar(run: Path) -> None:
    assert load_plan(run).speeds.verdict in sv.report(run).html.split('class="speeds"')[1]


def test_what_a_planner_looked_at_at_other_speeds_is_not_said_to_be_unchecked(plan: Plan, level: Plan) -> None:
    """It allows for an arm that strays at every speed that was asked for."""
    assert level.speeds.sentence == "Holds at every speed from 0 to 100 %."
    nominal = plan_fastest(level.scenario, robust=False)
    assert nominal.speeds.unchecked == plan.speeds.unchecked == "how far the arm strays from the motion"


@pytest.mark.slow
def test_sloshing_while_the_speed_changes_is_said_to_be_unchecked(coffee_plan: Plan) -> None:
    assert coffee_plan.speeds.unchecked.endswith("how loads swing inside while the speed changes")


def test_what_is_missing_at_rest_is_asked_of_the_weight_alone_and_of_the_slowest_speed_that_is_tried() -> None:
    """At 1 % of full speed the nodes of a programme are too far apart in time for the sloshing between them."""
    found = SimpleNamespace(problem=SimpleNamespace(cases=(1,)))
    for missing, asked in (((0.0,), [0.0, 1.04**-59]), ((0.5, 0.05), [0.5, 0.0, 1.04**-59])):
        speeds = _lacking(found, SimpleNamespace(lacking_speeds=missing))  # type: ignore[arg-type]
        assert [speed.factor for speed in speeds] == pytest.approx(asked)
