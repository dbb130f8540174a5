"""`salver simulate`: what it writes, what it says, what it refuses."""

from __future__ import annotations

import json

import pytest
from typer.testing import CliRunner

from salver import scenario as scenarios
from salver.cli import app
from salver.planning.make import make_plan
from salver.simulation.record import load_record


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
    result = salver("simulate", run_directory, "--stem", "both", "--set", "mass=0.306", "--set", "friction=0.45")
    assert result.exit_code == 0
    assert "mass = 0.306" in result.stdout
    assert "holds" in result.stdout
    for stem in ("plan", "baseline"):
        record = load_record(run_directory, stem)
        assert record.parameters == {"mass": 0.306, "friction": 0.45}
        assert record.outcome == "holds"


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
    assert "slides on the tray already at rest" in sliding
    heavy = ["mass=12", "inertia_xx=0.01", "inertia_yy=0.01", "inertia_zz=0.01"]
    assert "torque saturated" in salver("simulate", run_directory, *(x for s in heavy for x in ("--set", s))).stdout


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--set", "mass"], ["mass=0.3"]),
        (["--set", "mass=heavy"], ["mass=heavy"]),
        (["--set", "weight=1"], ['"weight"', "mass"]),
        (["--stem", "other"], ["baseline, nominal or both"]),
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


def test_a_directory_without_a_plan(tmp_path):
    result = salver("simulate", tmp_path)
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
        assert "is a file; of a motion, say also what is carried: --scenario." in salver(command, motion).stderr
    for command in (("simulate",), ("report",), ("campaign",), ("figures",), ("render", "-o", "x.gif")):
        told = salver(*command, array).stderr
        assert told == f"salver: {array} is a file of a run directory; give the directory: {run}.\n", command
        told = salver(*command, tmp_path / "none").stderr
        assert f"{tmp_path / 'none'} is not a run directory: there is none;" in told, command
    told = salver("audit", run, "-s", "panda-cube").stderr
    assert told.endswith(f"write one: salver export '{run}' --format csv -o motion.csv.\n")
