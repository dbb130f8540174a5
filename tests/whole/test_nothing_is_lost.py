"""What is replaced is kept, what belongs to another plan is not shown, a damaged line costs one run."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from salver import files, run_directory, scenario
from salver.campaigns import run_campaign
from salver.campaigns.journal import Journal
from salver.cli import app
from salver.errors import FileFormatError, SalverError, ScenarioError
from salver.export import write_export
from salver.planning.make import plan_baseline, plan_object
from salver.planning.plan import load_plan
from salver.reports.pages.page import write_report
from salver.simulation.physics import simulate
from salver.simulation.record import load_record

CASE = scenario.load("slippery-cube").with_changes(arm=None, motion__degree=7, motion__nodes=21)


def command(*arguments):
    return CliRunner().invoke(app, list(map(str, arguments)))


@pytest.fixture(scope="module")
def plans():
    return {"plan": plan_object(CASE), "baseline": plan_baseline(CASE)}


@pytest.fixture(scope="module")
def made(plans, tmp_path_factory):
    """A run directory with a simulation, a campaign and a report."""
    directory = tmp_path_factory.mktemp("made") / "run"
    for stem, plan in plans.items():
        plan.save(directory, stem)
        simulate(plan).save(directory, stem)
    run_campaign(directory, n=4, jobs=1)
    write_report(directory)
    return directory


@pytest.fixture
def run(made, tmp_path):
    return Path(shutil.copytree(made, tmp_path / "run"))


def contents(directory):
    return {str(p.relative_to(directory)): p.read_bytes() for p in directory.rglob("*") if p.is_file()}


def other(plan):
    """Another plan of the same scenario: the straight line under the name of the plan."""
    return replace(plan, method="robust")


@pytest.mark.slow
def test_another_plan_takes_its_results_along(run, plans):
    before = contents(run)
    (run / "notes.txt").write_text("mine")
    other(plans["baseline"]).save(run)
    after = contents(run)
    assert {k.removeprefix("earlier/1/"): v for k, v in after.items() if k.startswith("earlier/1/")} == {
        k: v for k, v in before.items() if k != "scenario.toml"
    }
    assert {k for k in after if not k.startswith("earlier")} == {"scenario.toml", "plan.npz", "plan.json", "notes.txt"}
    plans["plan"].save(run)
    assert (run / "earlier" / "2" / "plan.npz").read_bytes() == after["plan.npz"]


@pytest.mark.slow
def test_the_same_plan_again_moves_nothing(run, plans):
    before = contents(run)
    plans["plan"].save(run)
    plans["baseline"].save(run, "baseline")
    after = contents(run)
    assert after.keys() == before.keys()
    assert {k for k in after if after[k] != before[k]} <= {"plan.json", "baseline.json"}  # which hold the time it took


def test_another_baseline_leaves_what_is_of_the_plan_alone(run, plans):
    plans["plan"].save(run, "baseline")
    assert (run / "simulation" / "plan.npz").is_file()
    moved = {p.name for p in (run / "earlier" / "1").iterdir()}
    assert moved == {"baseline.npz", "baseline.json", "simulation", "campaign", "report.html"}
    assert {p.name for p in (run / "earlier" / "1" / "simulation").iterdir()} == {"baseline.npz", "baseline.json"}


def test_the_command_plan_says_where_the_earlier_plan_is(tmp_path):
    toml = tmp_path / "cube.toml"
    shutil.copy(scenario.SCENARIO_DIR / "panda-cube.toml", toml)
    done = command("plan", toml, "--no-arm", "-o", tmp_path / "run")
    assert done.exit_code == 0
    arrays = files.load_npz(tmp_path / "run" / "plan.npz")
    files.write_atomic(
        tmp_path / "run" / "plan.npz", files.npz_bytes({**arrays, "q": arrays["t"]})
    )  # as if it had been made with an arm
    done = command("plan", toml, "--no-arm", "-o", tmp_path / "run")
    assert done.exit_code == 0
    assert "and its results are now in" in done.stderr
    assert "q" in files.load_npz(tmp_path / "run" / "earlier" / "1" / "plan.npz")


def test_a_directory_of_another_scenario_is_left_alone_and_the_plan_is_kept_beside_it(run, tmp_path):
    from salver.cli.common import ExitCode, save_plans

    before = contents(run)
    faster = plan_baseline(CASE.with_changes(motion__duration=2.0, name="another"))
    with pytest.raises(ScenarioError, match="holds the plan of another scenario"):
        faster.save(run)
    import typer

    with pytest.raises(typer.Exit) as ended:
        save_plans(run, {"plan": faster})
    assert ended.value.exit_code == ExitCode.WRONG_USE
    assert contents(run) == before
    assert (tmp_path / "run-1" / "plan.npz").is_file()


def test_an_edited_scenario_replaces_its_plans_and_keeps_all_that_rested_on_them(run):
    from salver.cli.common import save_plans

    before = contents(run)
    edited = plan_baseline(CASE.with_changes(motion__duration=2.0))
    with pytest.raises(ScenarioError, match="another scenario"):  # unasked, Python replaces nothing
        edited.save(run)
    save_plans(run, {"plan": edited})
    assert contents(run / "earlier" / "1") == before
    assert load_plan(run).duration == 2.0
    assert {name.split("/")[0] for name in contents(run)} == {"earlier", "scenario.toml", "plan.npz", "plan.json"}


def test_plans_of_another_scenario_are_replaced_by_force_only(run, tmp_path):
    before = contents(run)
    toml = tmp_path / "other.toml"
    toml.write_text((run / "scenario.toml").read_text().replace(f'name = "{CASE.name}"', 'name = "other"'))
    done = command("plan", toml, "--no-arm", "-o", run)
    assert done.exit_code == 2
    assert "replace its plans with --force" in done.stderr
    assert contents(run) == before
    done = command("plan", toml, "--no-arm", "-o", run, "--force")
    assert done.exit_code == 0, done.stderr
    assert "and its results are now in" in done.stderr
    assert contents(run / "earlier" / "1") == before


def test_a_scenario_of_ones_own_without_plans_is_never_moved(tmp_path, plans):
    """A folder where somebody keeps a scenario is no run directory yet."""
    (tmp_path / "scenario.toml").write_text((scenario.SCENARIO_DIR / "panda-cube-1.2s.toml").read_text())
    done = command("plan", "panda-cube", "--no-arm", "-o", tmp_path, "--force")
    assert done.exit_code == 2
    assert (tmp_path / "scenario.toml").read_text() == (scenario.SCENARIO_DIR / "panda-cube-1.2s.toml").read_text()


@pytest.mark.parametrize("name", ["plan.json", "plan.npz", "baseline.json"])
def test_files_of_others_are_not_replaced(tmp_path, plans, name):
    (tmp_path / name).write_text("somebody's")
    with pytest.raises(SalverError, match=f"{name} exists already and is not from a plan of salver"):
        plans["plan"].save(tmp_path)
    assert contents(tmp_path) == {name: b"somebody's"}
    done = command("plan", "panda-cube", "--no-arm", "-o", tmp_path)
    assert done.exit_code == 2
    assert "is not from a plan of salver" in done.stderr


def test_a_scenario_with_comments_is_not_rewritten(tmp_path, plans):
    import tomli_w

    text = "# my comment\n" + tomli_w.dumps(CASE.model_dump(mode="json", exclude_none=True))
    (tmp_path / "scenario.toml").write_text(text)
    plans["plan"].save(tmp_path)
    assert (tmp_path / "scenario.toml").read_text() == text


def test_a_place_that_cannot_be_written_to_is_known_before_planning(tmp_path):
    (tmp_path / "file").write_text("")
    for place, words in ((tmp_path / "file", "is a file"), (Path("/proc/salver"), "cannot be written to")):
        done = command("plan", "panda-cube", "--no-arm", "-o", place)
        assert done.exit_code == 2
        assert words in done.stderr
        assert len(done.stderr.splitlines()) == 1


def test_a_plan_is_not_replaced_under_a_running_campaign(run, plans):
    with Journal(run / "campaign"), pytest.raises(SalverError, match="A campaign is running in"):
        other(plans["baseline"]).save(run)
    assert (run / "campaign" / "campaign.json").is_file()


@pytest.mark.slow
def test_every_simulation_is_kept(run, plans):
    first = (run / "simulation" / "plan.npz").read_bytes()
    for mass in (0.26, 0.27):
        simulate(plans["plan"], parameters={"mass": mass}).save(run)
    folder = run / "simulation"
    assert (folder / "plan.npz").read_bytes() == first  # the plan takes the mass as known: these are what-if runs
    kept = [json.loads((folder / f"plan-what-if{n}.json").read_text())["parameters"]["mass"] for n in ("-1", "")]
    assert kept == [0.26, 0.27]
    simulate(plans["plan"], parameters={"mass": 0.27}).save(run)
    assert not (folder / "plan-what-if-2.npz").exists()  # the same run again
    simulate(plans["plan"], parameters={"friction": 0.11}).save(run)  # within its range: a run of the plan
    assert (folder / "plan-1.npz").read_bytes() == first


@pytest.mark.slow
def test_results_of_another_plan_are_named_and_not_reported(run, plans):
    said = []
    write_report(run, say=said.append)
    assert said == []
    assert "perturbed runs" in (run / "report.html").read_text()
    for ending in (".npz", ".json"):  # a plan under the results of another one, as a hand may copy it
        shutil.copy(run / f"baseline{ending}", run / f"plan{ending}")
    write_report(run, run / "page.html", said.append)
    assert [s for s in said if "simulation/plan.npz" in s]
    assert [s for s in said if "campaign/campaign.json is a campaign of other plans" in s]
    page = (run / "page.html").read_text()
    assert "perturbed runs" not in page
    assert "is of another plan than" in page
    with pytest.raises(FileFormatError, match="is of another plan"):
        load_record(run)


@pytest.mark.parametrize("name", ["scenario.toml", "plan.json", "plan.npz", "campaign/campaign.json"])
def test_no_output_goes_over_the_files_of_a_run(run, name):
    before = contents(run)
    for write in (
        lambda: write_report(run, run / name),
        lambda: write_export(run, "csv", run / name),
        lambda: write_export(run, "yaml", run / name),
    ):
        with pytest.raises(SalverError, match=r"must end in|among the files of a run"):
            write()
    assert contents(run) == before


@pytest.mark.slow
def test_an_output_keeps_what_stands_in_its_place(run, tmp_path):
    page, table = tmp_path / "index.html", tmp_path / "motion.csv"
    for path in (page, table):
        path.write_text("mine")
    for _ in range(2):  # the same output twice is kept once
        write_report(run, page)
        write_export(run, "csv", table)
    assert sorted(p.name for p in tmp_path.glob("*-*")) == ["index-1.html", "motion-1.csv"]
    assert (tmp_path / "index-1.html").read_text() == (tmp_path / "motion-1.csv").read_text() == "mine"


def flip(content, at):
    return content[:at] + bytes([content[at] ^ 4]) + content[at + 1 :]


@pytest.mark.slow
@pytest.mark.parametrize(
    "damage",
    [
        lambda line: b"{" + line,
        lambda line: b"",
        lambda line: b"\x00\xff" * 20,
        lambda line: b'{"stem": 3, "run": "x"}',
        lambda line: b'{"stem": "plan", "run": 0}',
        lambda line: b"[" * 100_000,
        lambda line: b"9" * 5000,
        lambda line: line[:40] + line,
        lambda line: flip(line, line.index(b"com_x") + 12),  # a digit
        lambda line: line.replace(b'"outcome":"holds"', b'"outcome":"slide"'),
    ],
)
def test_a_damaged_line_costs_one_run_and_a_sentence(run, damage, caplog):
    journal = run / "campaign" / "journal.jsonl"
    lines = journal.read_bytes().splitlines()
    lines[2] = damage(lines[2])
    journal.write_bytes(b"\n".join(lines) + b"\n")
    with Journal(run / "campaign") as opened:
        assert len(opened.records) == 7
        assert caplog.messages == [f"{journal}: 1 damaged line(s) are dropped; their runs are made again."]


@pytest.mark.slow
def test_what_a_damaged_line_said_is_made_again(run, made, caplog):
    journal = run / "campaign" / "journal.jsonl"
    whole = journal.read_bytes()
    lines = whole.splitlines()
    lines[2] = flip(lines[2], lines[2].index(b"com_x") + 12)
    journal.write_bytes(b"\n".join(lines) + b"\n")
    with Journal(run / "campaign") as opened:
        assert len(opened.records) == 7
    caplog.clear()
    run_campaign(run, n=4, jobs=1)
    assert not caplog.messages  # once is enough
    assert sorted(journal.read_bytes().splitlines()) != sorted(lines)
    assert [r["outcome"] for r in sorted_records(journal.read_bytes())] == [r["outcome"] for r in sorted_records(whole)]
    assert (run / "campaign" / "runs.parquet").read_bytes() == (made / "campaign" / "runs.parquet").read_bytes()


def sorted_records(content):
    return sorted(map(json.loads, content.splitlines()), key=lambda r: (r["stem"], r["run"]))


@pytest.mark.parametrize(
    "content",
    ["[]", "{}", '{"definition": []}', '{"definition": {"n": "many"}}', "1e999", "[" * 100_000, "9" * 5000],
)
def test_a_foreign_campaign_is_one_sentence(run, content):
    (run / "campaign" / "campaign.json").write_text(content)
    with pytest.raises(FileFormatError, match=r"campaign\.json"):
        run_campaign(run, n=4, jobs=1)


@pytest.mark.parametrize("folder", ["", ".", "..", "../elsewhere", "/tmp/elsewhere"])
def test_a_campaign_stays_in_its_directory(run, folder):
    with pytest.raises(SalverError, match="must be one name"):
        run_campaign(run, n=4, jobs=1, folder=folder)


def test_belongings_are_all_that_commands_write(run):
    """A new kind of result that is not listed would stay under the next plan."""
    left = {p.name for p in run.iterdir()} - {"scenario.toml"}
    assert run_directory.make_room(run, "plan") is not None
    assert {p.name for p in run.iterdir()} == {"scenario.toml", "earlier"}
    assert {p.name for p in (run / "earlier" / "1").iterdir()} == left
