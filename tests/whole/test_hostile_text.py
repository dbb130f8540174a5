"""Text from files stays text: on the terminal no colours and commands, in the page no elements and scripts."""

import json
import re
import resource
import shutil
from pathlib import Path

import pytest
import tomli_w
from typer.testing import CliRunner

from browser import chromium, missing
from salver import files, scenario
from salver.campaigns import run_campaign
from salver.cli import app
from salver.cli.common import headed, printable, result_console
from salver.errors import FileFormatError, SalverError
from salver.export import write_export
from salver.planning.make import plan_baseline, plan_object
from salver.reports.pages import cells
from salver.reports.pages.page import page, write_report
from salver.reports.run import read_run
from salver.simulation.physics import simulate

pytestmark = pytest.mark.slow

HOSTILE = "[/] [bold]b[/bold] :smile: \x1b[31mred \x9b31m \u202ereversed <script>window.broken=1</script><!--<script>"
CASE = scenario.load("slippery-cube").with_changes(
    arm=None, motion__degree=7, motion__nodes=21, summary=HOSTILE, source=HOSTILE
)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    directory = tmp_path_factory.mktemp("made") / "[/] <script>window.broken=1<%script>"
    plan = plan_object(CASE)
    plan.save(directory)
    plan_baseline(CASE).save(directory, "baseline")
    simulate(plan).save(directory)
    run_campaign(directory, n=2, jobs=1)
    return directory


@pytest.fixture
def run(made, tmp_path):
    return Path(shutil.copytree(made, tmp_path / made.name))


def test_what_a_terminal_would_obey_is_written_out():
    assert printable("a\x1b[2J\x07\x9b\u202eb\tc\nd é 漢 ±") == "a\\x1b[2J\\x07\\x9b\\u202eb\tc\nd é 漢 ±"


def test_a_console_shows_markup_as_it_is(capsys):
    from rich.table import Table

    table = Table(box=None)
    table.add_column("[red]head[/]")
    table.add_row("[/] :smile: \x1b[31m")
    result_console().print(table)
    result_console().print("[/] :smile: \x1b[31m")
    result_console().print(headed("[/]", "[/]\x1b[31m"))
    out = capsys.readouterr().out
    assert out.split("\n")[0].strip() == "[red]head[/]"
    assert out.count("[/] :smile: \\x1b[31m") == 2
    assert "[/]: [/]\\x1b[31m" in out
    assert "\x1b" not in out


@pytest.mark.parametrize("arguments", [["--json"], []])
def test_a_hostile_summary_and_path_pass_through_every_command(tmp_path, arguments):
    toml = tmp_path / "[/]\x1b[31m.toml"
    toml.parent.mkdir()
    toml.write_text(tomli_w.dumps(CASE.model_dump(mode="json", exclude_none=True)))
    out = tmp_path / "[/]\x1b[31mrun"
    for command in (
        ["plan", toml, "-o", out],
        ["simulate", out],
        ["campaign", out, "-n", 2, "-j", 1],
        ["report", out],
        ["export", out, "--format", "csv"],
    ):
        done = CliRunner().invoke(app, [*map(str, command), *arguments])
        assert done.exit_code == 0, done.stderr
        shown = done.stdout + done.stderr
        assert not re.search("[\x00-\x08\x0b-\x1f\x7f-\x9f]", shown)
        if arguments:
            json.loads(done.stdout)


def test_cells_escape_whatever_is_no_markup():
    hostile = "<script>"
    made = cells.table([hostile], [[hostile], [["<b>"]], [{"<i>": 1}], [None], [1.5], [cells.outcome_cell(hostile)]])
    assert "<script>" not in made
    assert "<b>" not in made
    assert "<i>" not in made
    assert made.count("&lt;script&gt;") == 3


def changed(obj, change, key=""):
    """The object with every leaf changed: change(key, value)."""
    if isinstance(obj, dict):
        return {k: changed(value, change, k) for k, value in obj.items()}
    if isinstance(obj, list):
        return [changed(value, change, key) for value in obj]
    return change(key, obj)


def test_an_edited_campaign_is_refused(run):
    path = run / "campaign" / "campaign.json"
    summary = json.loads(path.read_text())
    summary["plans"]["plan"]["worst_run"]["run"] = "<script>alert(1)</script>"
    path.write_text(json.dumps(summary))
    with pytest.raises(FileFormatError, match=r"campaign\.json was edited or damaged since salver wrote it"):
        write_report(run)


@pytest.mark.parametrize("name", ["campaign/runs.parquet", "simulation/plan.npz", "simulation/plan.json"])
def test_an_edited_result_is_refused(run, name):
    content = bytearray((run / name).read_bytes())
    content[len(content) // 2] ^= 1
    (run / name).write_bytes(content)
    with pytest.raises(FileFormatError, match=Path(name).name.replace(".", r"\.")):
        write_report(run)


def test_no_value_of_a_campaign_becomes_an_element(run):
    """Even sealed again by somebody who knows how: whatever is no number is text, whatever its type."""
    path = run / "campaign" / "campaign.json"
    original = json.loads(path.read_text())
    hostile = "<img src=x onerror=alert(1)>"
    counted = ("runs", "count", "of")  # with which the page reckons
    for kind in (str, int):
        summary = changed(original, lambda k, x, kind=kind: hostile if type(x) is kind and k not in counted else x)
        kept = {key: original[key] for key in ("complete", "table_digest", "definition", "provenance")}
        summary = {**summary, **kept}
        for own, real in zip(summary["plans"].values(), original["plans"].values(), strict=True):
            own["outcomes"] = {f"{hostile}{k}": rate for k, rate in real["outcomes"].items()}
        del summary["digest"]
        path.write_text(json.dumps(files.sealed(summary)))
        text = page(read_run(run))
        assert hostile not in text
        assert "&lt;img src=x" in text


def test_the_page_shows_hostile_text_and_runs_none_of_it(made, tmp_path):
    text = page(read_run(made))
    assert "<script>window" not in text
    assert text.count("<script") == 2
    assert "<!--" not in text
    policy = re.search(r'http-equiv="Content-Security-Policy" content="([^"]*)"', text)[1]
    assert "unsafe-inline" not in policy.split("script-src")[1]


@pytest.mark.skipif(missing() is not None, reason=str(missing()))
def test_in_a_browser_nothing_of_it_runs(made, tmp_path):
    path = write_report(made, tmp_path / "page.html")
    with chromium() as tab:
        tab.open(path)
        tab.wait_for("window.salver")  # the page's own script has run
        assert tab.script("return typeof window.broken") == "undefined"


@pytest.mark.parametrize("file_format", ["csv", "yaml", "ros2", "mujoco"])
def test_an_export_onto_a_full_disk_is_one_sentence_and_leaves_nothing(made, tmp_path, file_format):
    """A limit on the size of files stands for the disk: the same errors come from the same calls."""
    ending = {"csv": ".csv", "yaml": ".yaml"}.get(file_format, "")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        with pytest.raises(SalverError, match="cannot be written: file too large"):
            write_export(made, file_format, tmp_path / f"out{ending}")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert list(tmp_path.iterdir()) == []
