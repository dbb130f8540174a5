"""`salver simulate`: what it writes, what it says, what it refuses."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from typer.testing import CliRunner

from salver import scenario as scenarios
from salver.cli import app
from salver.models.uncertain.parameters import Parameter, UncertainSet
from salver.planning.make import make_plan
from salver.reports.pages.page import write_report
from salver.reports.pages.words import true_parameters, verdict
from salver.reports.run import read_run
from salver.simulation.record import load_record
from salver.simulation.scene.loads import outside


@pytest.fixture(scope="module")
def run_directory(tmp_path_factory):
    directory = tmp_path_factory.mktemp("run")
    changes = {"motion__duration": 1.2, "physics__settle_before": 0.1, "physics__settle_after": 0.1}
    scenario = scenarios.load("panda-cube").with_changes(**changes)
    for method, stem in (("robust", "plan"), ("baseline", "baseline")):
        make_plan(scenario, method).save(directory, stem)
    return directory


def salver(*arguments):
    return CliRunner().invoke(app, [str(a) for a in arguments])


@pytest.mark.slow
def test_both_plans_side_by_side(run_directory):
    result = salver("simulate", run_directory, "--plan", "both", "--set", "mass=0.306", "--set", "friction=0.45")
    assert result.exit_code == 0
    assert "mass = 0.306" in result.stdout
    assert "holds" in result.stdout
    for stem in ("plan", "baseline"):
        record = load_record(run_directory, f"{stem}-what-if")
        assert record.parameters == {"mass": 0.306, "friction": 0.45}
        assert record.outcome == "holds"


@pytest.mark.slow
def test_a_run_with_a_value_outside_its_range_is_no_run_of_the_plan_to_the_page(run_directory, tmp_path):
    run = shutil.copytree(run_directory, tmp_path / "run")
    shutil.rmtree(run / "simulation", ignore_errors=True)
    low, high = 0.256 * 0.9, 0.256 * 1.1
    said = salver("simulate", run, "--set", "friction=0.1", "--set", "mass=0.2561").stdout
    assert "What if: friction = 0.1, which the plan assumes to be exact" in said
    assert "mass = 0.2561 is outside" not in said
    assert sorted(path.name for path in (run / "simulation").iterdir()) == ["plan-what-if.json", "plan-what-if.npz"]
    shown = read_run(run)
    assert shown.plan.simulation is None
    assert verdict(shown).headline == "The cube is predicted to stay put for every parameter in the assumed range"
    text = write_report(run).read_text()
    assert 'id="what_if"' in text
    assert 'id="simulation"' not in text
    assert "friction 0.1 (taken as known exactly by the plan), mass 256.1 g" in text
    assert "what if, friction 0.1 (taken as known exactly by the plan)" in text  # the replay, where there is no other
    salver("simulate", run, "--set", f"mass={high:.6f}")  # the end of the range is what the plan promises
    assert read_run(run).plan.simulation.summary["outcome"] == "holds"
    said = salver("simulate", run, "--set", f"mass={high + 0.001:.6f}").stdout
    assert f"mass = {high + 0.001:.6g} is outside its range, {low:.4g} to {high:.4g}" in " ".join(said.split())
    shown = read_run(run)
    assert shown.plan.simulation.summary["parameters"] == {"mass": pytest.approx(high, abs=1e-6)}
    assert true_parameters(shown, shown.plan.what_if.summary).startswith("mass 282.6 g (outside its range, 230.4 g to")
    assert verdict(shown).headline == "The cube stays put, in theory and in simulation with mass 281.6 g"


@pytest.mark.parametrize(
    ("kind", "values", "out"),
    [
        ("box", {"a": 1.2, "b": 10.9}, []),
        ("box", {"a": 1.2 + 1e-6, "b": 10.9}, ["a"]),
        ("box", {"a": 0.8, "b": 8.9, "c": 0.0}, ["b", "c"]),
        ("ellipsoid", {"a": 1.2}, []),
        ("ellipsoid", {"a": 1.15, "b": 10.8}, ["a", "b"]),  # 0.75 and 0.8 of the half ranges: 1.097 together
        ("ellipsoid", {"a": 1.11, "b": 10.8}, []),  # 0.55 and 0.8: 0.971
    ],
)
def test_which_values_are_outside_what_a_plan_was_made_for(kind, values, out):
    names = (Parameter("", "a"), Parameter("", "b"))
    found = outside(UncertainSet(names, np.array([1.0, 10.0]), np.array([0.2, 1.0]), kind), values)
    assert list(found) == out
    ranges = {"a": (0.8, 1.2), "b": (9.0, 11.0), "c": None}
    assert all(found[name] == (pytest.approx(ranges[name]) if ranges[name] else None) for name in out)


@pytest.mark.slow
def test_json_is_one_document(run_directory):
    result = salver("simulate", run_directory, "--set", "friction=0.1", "--json")
    assert result.exit_code == 0
    document = json.loads(result.stdout)
    assert document["plan"]["outcome"] == "slides"
    assert document["plan"]["objects"][0]["peak_slip"] > 1e-3
    assert document["plan"]["provenance"]["scenario"] == "panda-cube"


@pytest.mark.slow
def test_sentences_for_what_happened(run_directory):
    assert "slides from t =" in salver("simulate", run_directory, "--set", "friction=0.1").stdout
    sliding = salver("simulate", run_directory, "--set", "friction=0.1", "--set", "tilt_x=0.15").stdout
    assert "slides on the tray even at rest" in sliding
    heavy = ["mass=12", "inertia_xx=0.01", "inertia_yy=0.01", "inertia_zz=0.01"]
    assert "torque saturated" in salver("simulate", run_directory, *(x for s in heavy for x in ("--set", s))).stdout


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--set", "mass"], ["mass=0.3"]),
        (["--set", "mass=heavy"], ["mass=heavy"]),
        (["--set", "weight=1"], ['"weight"', "mass"]),
        (["--plan", "other"], ["baseline, nominal or both"]),
        (["--run", "0"], ["campaign"]),
        (["--seed", "-1"], ["--seed", "0"]),
    ],
)
def test_wrong_use_gets_a_sentence(run_directory, arguments, words):
    result = salver("simulate", run_directory, *arguments)
    assert result.exit_code == 2
    for word in words:
        assert word in result.stderr
    assert "Traceback" not in result.output


@pytest.mark.parametrize("which", ["plan", "both"])
def test_a_directory_without_a_plan(tmp_path, which):
    result = salver("simulate", tmp_path, "--plan", which)
    assert result.exit_code == 2
    assert "salver plan" in result.stderr


def test_a_file_where_a_run_directory_is_wanted_and_the_other_way_round(tmp_path):
    """One sentence each, which says what to give instead."""
    run = tmp_path / "a run"
    run.mkdir()
    motion, array = tmp_path / "motion.csv", run / "plan.npz"
    for path in (motion, array, run / "scenario.toml"):
        path.touch()
    for command in ("simulate", "report"):
        assert "is a file; for a motion file, name the scenario too: --scenario." in salver(command, motion).stderr
    for command in (("simulate",), ("report",), ("campaign",), ("render", "-o", "x.gif")):
        told = salver(*command, array).stderr
        assert told == f"salver: {array} is a file of a run directory; give the directory: {run}.\n", command
        told = salver(*command, tmp_path / "none").stderr
        assert f"{tmp_path / 'none'} is not a run directory: there is none;" in told, command
    told = salver("audit", run, "-s", "panda-cube").stderr
    assert told.endswith(f"write one: salver export '{run}' --format csv -o motion.csv.\n")
