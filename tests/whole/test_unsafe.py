"""A motion that fails a verdict leaves under no name but one that says so: every format, every command."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from salver import scenario
from salver.cli import app
from salver.errors import Status, UnsafeError
from salver.export import FORMATS, write_export
from salver.files import load_npz, read_json
from salver.motion_files import read
from salver.planning.make import plan_pair
from salver.planning.plan import load_plan

# Stem of a run directory to what fails there.
FAILING = {"plan": "cannot follow", "baseline": "contact condition is missed", "nominal": "no time left to search"}
OF_FILES = [name for name in FORMATS if name not in ("mujoco", "urscript")]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """In .8 s the plan is too fast for the arm and the straight line for the bottle; the third holds, and its search
    ended without saying that it does."""
    folder = tmp_path_factory.mktemp("unsafe") / "run"
    slow = scenario.load("ur5-bottle")
    plan, baseline = plan_pair(slow.with_changes(motion__duration=0.8), "robust")
    good = plan_pair(slow, "robust")[0]
    unfinished = replace(
        good, scenario=plan.scenario, status=Status("time_limit", "There was no time left to search.", False)
    )
    for stem, made in (("plan", plan), ("baseline", baseline), ("nominal", unfinished)):
        made.save(folder, stem)
    return folder


def called(*words: str | Path) -> tuple[int, str]:
    """Exit code of a command, and all that it says."""
    result = CliRunner().invoke(app, [str(word) for word in words])
    return result.exit_code, result.output + (result.stderr or "")


def heads(files: list[Path]) -> list[str]:
    """How the texts among them begin."""
    return [file.read_text()[:2000] for file in files if file.suffix in (".csv", ".json", ".yaml", ".script", ".xml")]


def test_a_verdict_gives_each_reason_once(run: Path) -> None:
    assert load_plan(run, "baseline").verdict.count(FAILING["baseline"]) == 1


@pytest.mark.parametrize(
    ("file_format", "stem"), [*((name, "plan") for name in FORMATS), ("csv", "baseline"), ("csv", "nominal")]
)
def test_no_format_is_written_unless_its_name_and_its_first_line_say_so(
    run: Path, tmp_path: Path, file_format: str, stem: str
) -> None:
    place = tmp_path / f"carry{FORMATS[file_format]}"
    with pytest.raises(
        UnsafeError, match=rf"carry.* is not written as if it were safe: .*{FAILING[stem]}.* \(--unsafe"
    ):
        write_export(run, file_format, place, stem)
    assert not list(tmp_path.iterdir())
    files = write_export(run, file_format, place, stem, unsafe=True)
    assert all("UNSAFE" in path.name for path in tmp_path.iterdir())
    assert len(list(tmp_path.iterdir())) >= 1
    for text in heads(files):
        first = text.splitlines()[1 if text.startswith("{") else 0]
        if "custom_data" not in text:  # the metadata of a bag are in alphabetical order
            assert "UNSAFE: " in first, first
        assert FAILING[stem].split()[0] in text


@pytest.mark.parametrize("file_format", OF_FILES)
def test_a_file_that_was_renamed_still_says_so(run: Path, tmp_path: Path, file_format: str) -> None:
    files = write_export(run, file_format, tmp_path / f"carry{FORMATS[file_format]}", rate=20.0, unsafe=True)
    written = files[0] if file_format != "ros2" else tmp_path / "carry_bag-UNSAFE"
    renamed = written.rename(tmp_path / f"fine{FORMATS[file_format]}")
    assert read(renamed).verdict.startswith("UNSAFE: ur5 cannot follow")


def test_every_file_of_a_run_directory_carries_the_verdict(run: Path) -> None:
    for stem, reason in FAILING.items():
        for verdict in (read_json(run / f"{stem}.json")["verdict"], str(load_npz(run / f"{stem}.npz")["verdict"])):
            assert verdict.startswith("UNSAFE: ")
            assert reason in verdict
    assert read(run / "plan.npz").verdict.startswith("UNSAFE: ur5 cannot follow")


def test_export_ends_with_3_and_one_sentence(run: Path, tmp_path: Path) -> None:
    code, said = called("export", run, "--format", "moveit", "--plan", "baseline", "-o", tmp_path / "m.yaml")
    assert code == 3
    assert said.startswith(f"salver: {tmp_path / 'm.yaml'} is not written as if it were safe: The straight")
    assert not list(tmp_path.iterdir())
    code, _ = called("export", run, "--format", "moveit", "--plan", "baseline", "-o", tmp_path / "m.yaml", "--unsafe")
    assert code == 0
    assert [path.name for path in tmp_path.iterdir()] == ["m-UNSAFE.yaml"]


@pytest.mark.slow
def test_what_was_recorded_of_an_unsafe_plan_says_so_in_file_and_film(run: Path, tmp_path: Path) -> None:
    from salver.reports.film import write_film

    code, said = called("simulate", run, "--plan", "plan", "--write", tmp_path / "done.csv")
    assert code == 0, said
    assert [path.name for path in tmp_path.iterdir()] == ["done-UNSAFE.csv"]
    assert str(load_npz(run / "simulation" / "plan.npz")["verdict"]) == load_plan(run).verdict
    assert read_json(run / "simulation" / "plan.json")["plan_verdict"] == load_plan(run).verdict
    film = write_film(run, tmp_path / "film.gif", "plan", rate=2.0, width=64, height=48)
    assert film.verdicts["plan"].startswith("UNSAFE: ur5 cannot follow")


def test_a_safe_plan_says_what_was_not_checked_and_is_written_under_its_own_name(tmp_path: Path) -> None:
    plan_pair(scenario.load("ur5-bottle"), "robust")[0].save(tmp_path / "run")
    (path,) = write_export(tmp_path / "run", "moveit", tmp_path / "m.yaml", rate=50.0)
    said = path.read_text().splitlines()[1]
    assert said.startswith("# Not checked: anything around the arm but the floor; jerk and torque rate")
    assert read(path).verdict == ""
