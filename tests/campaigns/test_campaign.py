"""Campaigns: the same table whether made at once, in pieces after a kill, serially, in parallel or on a cluster."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from salver import scenario as scenarios
from salver.campaigns import parameters_of_run, run_campaign, seed_of_run
from salver.campaigns.definition import Definition
from salver.campaigns.journal import Journal
from salver.campaigns.summary import read_table
from salver.campaigns.workers import _single_threaded
from salver.errors import SalverError
from salver.planning.make import make_plan
from salver.sampling import METHODS

N = 8
QUICK = {  # a run without its arm takes 20 ms
    "objects__0__uncertainty__inertia": "10%",
    "motion__duration": 1.0,
    "motion__degree": 7,
    "physics__settle_before": 0.02,
    "physics__settle_after": 0.02,
    "physics__timestep": 1e-3,
}

needs_proc = pytest.mark.skipif(not Path("/proc/self/stat").is_file(), reason="processes are looked up in /proc")


@pytest.fixture(scope="module")
def planned(tmp_path_factory):
    """A run directory with a robust plan and its baseline."""
    directory = tmp_path_factory.mktemp("run")
    case = scenarios.load("panda-cube").with_changes(**QUICK, arm=None)
    make_plan(case, "robust").save(directory)
    make_plan(case, "baseline").save(directory, "baseline")
    return directory


@pytest.fixture
def run_dir(planned, tmp_path):
    return Path(shutil.copytree(planned, tmp_path / "run"))


@pytest.fixture(scope="module")
def finished(planned, tmp_path_factory):
    """A campaign made at once, serially."""
    directory = Path(shutil.copytree(planned, tmp_path_factory.mktemp("done") / "run"))
    return run_campaign(directory, n=N, jobs=1)


def parquet(directory: Path) -> bytes:
    return (directory / "campaign" / "runs.parquet").read_bytes()


@pytest.mark.slow
def test_all_plans_run_on_the_same_samples_within_the_set(finished):
    columns = read_table(finished.folder / "runs.parquet")
    assert columns["run"] == [k for k in range(N) for _ in range(2)]
    assert columns["stem"] == ["plan", "baseline"] * N
    mass = np.array(columns["mass"])
    assert np.array_equal(mass[::2], mass[1::2])
    assert len(set(mass)) == N
    assert np.all(np.abs(mass - 0.256) <= 0.0256)


@pytest.mark.slow
def test_parameters_of_a_run_are_those_in_the_table_and_follow_from_its_number(finished):
    """Uniform over the box, from numpy's generator seeded with (seed, run) alone: `salver.sampling`."""
    directory = finished.folder.parent
    columns = read_table(finished.folder / "runs.parquet")
    moments = [f"inertia_{pair}" for pair in ("xx", "yy", "zz")]
    for k in (0, 5, N - 1):
        parameters, _ = parameters_of_run(directory, k)
        assert set(parameters) == {"mass", *moments}
        assert all(columns[name][2 * k] == columns[name][2 * k + 1] == value for name, value in parameters.items())
        drawn = dict(zip(parameters, 2 * np.random.default_rng([0, k]).random(4) - 1, strict=True))
        assert parameters["mass"] == pytest.approx(0.256 + 0.0256 * drawn["mass"], rel=1e-12)
        assert [parameters[m] for m in moments] == pytest.approx([3.4e-4 * (1 + 0.1 * drawn[m]) for m in moments])
    for run in (-1, N):
        with pytest.raises(SalverError, match=f"no run {run}; the campaign has the runs 0 to {N - 1}"):
            parameters_of_run(directory, run)


def test_every_run_of_every_campaign_has_a_seed_of_its_own_for_its_noise():
    seeds = [seed_of_run(campaign, run) for campaign in range(20) for run in range(100)]
    assert len(set(seeds)) == len(seeds)
    assert all(0 <= seed < 2**31 for seed in seeds)
    assert len({seed // 2**27 for seed in seeds}) == 16  # all over the range, not one beside the other


@pytest.mark.slow
def test_more_runs_can_be_added_and_the_first_ones_stay(finished, run_dir):
    run_campaign(run_dir, n=5, jobs=1)
    first = (run_dir / "campaign" / "journal.jsonl").read_bytes()
    again = run_campaign(run_dir, n=N, jobs=1)
    assert (run_dir / "campaign" / "journal.jsonl").read_bytes().startswith(first)
    assert parquet(run_dir) == (finished.folder / "runs.parquet").read_bytes()
    for stem, plan in again.summary["plans"].items():
        assert plan | {"worst_run": 0} == finished.summary["plans"][stem] | {"worst_run": 0}  # it names the directory


@pytest.mark.parametrize("method", METHODS)
def test_runs_can_be_added_where_the_first_ones_do_not_depend_on_how_many_there_are(method):
    few = Definition("s", {"plan": "a", "baseline": "b"}, 4, 1, method)
    more = replace(few, n=6)
    assert few.extends(few)
    assert more.extends(few)
    assert not few.extends(more)
    others = {"scenario": "t", "plans": {"plan": "a"}, "seed": 2, "method": "?", "stops": True}
    for name, value in others.items():
        assert not replace(more, **{name: value}).extends(few), name


@pytest.mark.slow
def test_a_finished_campaign_is_not_run_again(finished, monkeypatch):
    from salver.campaigns.runners import Context

    def refuse(*_):
        raise AssertionError("a finished run was made again")

    monkeypatch.setattr(Context, "execute", refuse)
    before = (finished.folder / "runs.parquet").read_bytes()
    again = run_campaign(finished.folder.parent, n=N, jobs=1)
    assert again.summary == finished.summary
    assert (finished.folder / "runs.parquet").read_bytes() == before


@pytest.mark.parametrize("cut", [0, 1, 37, 300])
@pytest.mark.slow
def test_a_journal_cut_off_anywhere_is_completed(finished, run_dir, cut):
    shutil.copytree(finished.folder, run_dir / "campaign")
    journal = run_dir / "campaign" / "journal.jsonl"
    whole = journal.read_bytes()
    half = len(whole) // 2 + cut
    journal.write_bytes(whole[:half])
    (run_dir / "campaign" / "runs.parquet").unlink()
    run_campaign(run_dir, n=N, jobs=1)
    assert parquet(run_dir) == (finished.folder / "runs.parquet").read_bytes()
    items = [(r["stem"], r["run"]) for r in map(json.loads, journal.read_bytes().splitlines())]
    assert len(items) == len(set(items)) == 2 * N


def test_only_lines_that_end_and_are_whole_are_finished_runs(tmp_path):
    """A line without its newline is the begin of one that a kill cut off, even when it reads well as it is."""
    run = {"stem": "plan", "outcome": "holds", "parameters": {"mass": 2.0}, "scalars": {"peak_slip": 0.0}}
    first, second = (run | {"run": k} for k in (1, 12))
    path = tmp_path / "journal.jsonl"
    with Journal(tmp_path) as journal:
        journal.append(first)
        whole = path.read_bytes()
        journal.append(second)
    line = path.read_bytes()[len(whole) :]
    for rest in (line[:-1], line[:-4], b"12", b"{}\n", b"null\n", b"\n", line.replace(b"12", b"13")):
        path.write_bytes(whole + rest)
        with Journal(tmp_path) as journal:
            assert set(journal.records) == {("plan", 1)}
            journal.append(second)
            assert set(journal.records) == {("plan", 1), ("plan", 12)}
        assert path.read_bytes() == whole + line


@needs_proc
@pytest.mark.slow
def test_killed_in_the_middle_no_worker_stays_and_nothing_is_lost_or_done_twice(run_dir):
    command = [sys.executable, "-c", "from salver.cli import main; main()", "campaign", str(run_dir), "-n", "40"]
    command += ["--jobs", "2", "--json"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    journal = run_dir / "campaign" / "journal.jsonl"
    deadline = time.monotonic() + 60
    while not (journal.is_file() and journal.read_bytes().count(b"\n") >= 10) and time.monotonic() < deadline:
        time.sleep(0.01)
    workers = _children(process.pid)
    assert len(workers) >= 2
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    deadline = time.monotonic() + 20
    while any(_alive(pid) for pid in workers) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not any(_alive(pid) for pid in workers)
    kept = journal.read_bytes()
    kept = kept[: kept.rfind(b"\n") + 1]
    assert 10 <= kept.count(b"\n") < 80
    run_campaign(run_dir, n=40, jobs=1)
    assert journal.read_bytes().startswith(kept)
    items = [(record["stem"], record["run"]) for record in map(json.loads, journal.read_bytes().splitlines())]
    assert len(items) == len(set(items)) == 80
    assert len(read_table(run_dir / "campaign" / "runs.parquet")["run"]) == 80


def _children(pid: int) -> list[int]:
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[1]) == pid:
            found.append(int(stat.parent.name))
    return found


def _alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@needs_proc
@pytest.mark.slow
def test_a_campaign_one_of_whose_workers_died_goes_on_and_gives_the_table_of_one(run_dir):
    import threading

    journal, killed = run_dir / "campaign" / "journal.jsonl", []  # with how many runs done

    def kill_one():
        deadline = time.monotonic() + 120
        while not killed and time.monotonic() < deadline:
            done = journal.read_bytes().count(b"\n") if journal.is_file() else 0
            for pid in _children(os.getpid()) if done else []:
                if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes():
                    os.kill(pid, signal.SIGKILL)
                    killed.append(done)
                    break
            time.sleep(0.002)

    thread = threading.Thread(target=kill_one)
    thread.start()
    with pytest.raises(SalverError, match=r"died .* repeat the command"):
        run_campaign(run_dir, n=5 * N, jobs=2)
    thread.join()
    assert 0 < killed[0] < 10 * N
    run_campaign(run_dir, n=5 * N, jobs=1)
    alone = run_campaign(run_dir, n=5 * N, jobs=1, folder="alone")
    assert parquet(run_dir) == (alone.folder / "runs.parquet").read_bytes()


def test_runs_that_cannot_be_made_say_why_and_the_exit_code_tells(tmp_path):
    # The plan was made without the arm that the scenario has, so the engine has no joint motion to run.
    from typer.testing import CliRunner

    from salver.cli import app

    make_plan(scenarios.load("panda-cube").with_changes(**QUICK), "baseline", arm=False).save(tmp_path)
    result = CliRunner().invoke(app, ["campaign", str(tmp_path), "-n", "2", "-j", "1", "--json"])
    assert result.exit_code == 1
    worst = json.loads(result.stdout)["plans"]["plan"]["worst_run"]
    assert worst["outcome"] == "error"
    assert "no joint motion" in worst["sentence"]


def test_the_directory_of_another_campaign_is_not_touched(finished, run_dir):
    shutil.copytree(finished.folder, run_dir / "campaign")
    before = {path.name: path.read_bytes() for path in (run_dir / "campaign").iterdir()}
    for options in ({"seed": 1}, {"method": "corners"}, {"n": 4}, {"stems": ["plan"]}):
        with pytest.raises(SalverError, match=f"holds another campaign: {N} runs of plan and baseline"):
            run_campaign(run_dir, **{"n": N, "jobs": 1, **options})
    (run_dir / "plan.npz").write_bytes((run_dir / "baseline.npz").read_bytes())
    with pytest.raises(SalverError, match="was edited since"):
        run_campaign(run_dir, n=N, jobs=1)
    (run_dir / "plan.json").write_bytes((run_dir / "baseline.json").read_bytes())
    with pytest.raises(SalverError, match="holds another campaign"):
        run_campaign(run_dir, n=N, jobs=1)
    assert before == {path.name: path.read_bytes() for path in (run_dir / "campaign").iterdir()}


@pytest.mark.slow
def test_a_campaign_is_not_finished_by_other_versions(run_dir):
    run_campaign(run_dir, n=4, jobs=1)
    path = run_dir / "campaign" / "campaign.json"
    summary = json.loads(path.read_text())
    actual = summary["provenance"]["versions"]["mujoco"]
    summary["provenance"]["versions"]["mujoco"] = "3.0.0"
    path.write_text(json.dumps(summary))
    with pytest.raises(SalverError, match=f"was begun with mujoco 3.0.0 .now {actual}.; continue with those versions"):
        run_campaign(run_dir, n=6, jobs=1)
    assert json.loads(path.read_text()) == summary


@pytest.mark.slow
def test_runs_of_unknown_origin_are_not_taken_over(run_dir):
    run_campaign(run_dir, n=2, jobs=1)
    (run_dir / "campaign" / "campaign.json").unlink()
    with pytest.raises(SalverError, match=r"holds runs but no campaign\.json"):
        run_campaign(run_dir, n=2, jobs=1)


def test_two_campaigns_at_once_in_one_directory_are_refused(run_dir):
    with Journal(run_dir / "campaign"), pytest.raises(SalverError, match="Another campaign is running"):
        run_campaign(run_dir, n=3, jobs=1)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"n": 0}, "The number of runs is 0"),
        ({"method": "random"}, 'no sampling method "random"'),
        ({"stems": ["fast"]}, 'has no plan "fast" .*; it has plan, baseline'),
        ({"seed": -1}, "The seed is -1"),
        ({"jobs": 0}, "The number of jobs is 0"),
    ],
)
def test_wrong_use_is_one_sentence_and_leaves_nothing(run_dir, options, sentence):
    with pytest.raises(SalverError, match=sentence):
        run_campaign(run_dir, **{"n": 3, **options})
    assert not (run_dir / "campaign").exists()


def test_directories_that_are_no_run_directory_are_refused(tmp_path):
    with pytest.raises(SalverError, match=r"holds no scenario.toml"):
        run_campaign(tmp_path)
    with pytest.raises(SalverError, match="holds no campaign"):
        parameters_of_run(tmp_path, 0)


@pytest.mark.slow
def test_a_run_of_the_physics_engine_is_reproduced_alone_from_its_number(tmp_path):
    from salver.planning.plan import load_plan
    from salver.simulation.physics import simulate

    case = scenarios.load("panda-cube").with_changes(
        arm=None, motion__duration=0.7, physics__settle_before=0.05, physics__settle_after=0.1
    )
    # Half of the set of the friction lies below what 0.7 s needs (0.578): some runs slide.
    case = case.with_changes(objects__0__uncertainty={"mass": "10%", "friction": 0.2})
    directory = tmp_path / "uncertain"
    make_plan(case, "baseline").save(directory, "baseline")
    result = run_campaign(directory, n=4, stems=["baseline"], jobs=1)
    columns = read_table(result.folder / "runs.parquet")
    assert {"holds", "slides"} <= set(columns["outcome"])
    for k in (1, 3):
        parameters, seed = parameters_of_run(directory, k)
        record = simulate(load_plan(directory, "baseline"), parameters=parameters, seed=seed)
        assert record.outcome == columns["outcome"][k]
        assert record.summary["objects"][0]["peak_slip"] == columns["peak_slip"][k]


@pytest.mark.slow
def test_the_noise_of_a_run_is_that_of_its_seed(tmp_path):
    """With sensor noise and (almost) nothing else uncertain, runs differ by their seeds alone, and come again alone."""
    from salver.planning.plan import load_plan
    from salver.simulation.physics import simulate

    case = scenarios.load("panda-cube").with_changes(
        motion__duration=1.2, physics__settle_before=0.0, physics__settle_after=0.0, physics__velocity_noise=1e-3
    )
    case = case.with_changes(objects__0__uncertainty={"friction": 1e-9})  # it sticks: friction does nothing
    make_plan(case, "baseline").save(tmp_path, "baseline")
    result = run_campaign(tmp_path, n=2, stems=["baseline"], seed=8, jobs=1)
    errors = read_table(result.folder / "runs.parquet")["e_p_peak"]
    assert abs(errors[1] - errors[0]) > 1e-8
    plan = load_plan(tmp_path, "baseline")
    for k in range(2):
        assert simulate(plan, seed=seed_of_run(8, k)).summary["e_p_peak"] == pytest.approx(errors[k], rel=1e-6)


@pytest.mark.slow
def test_a_full_disk_loses_nothing_that_was_finished(finished, run_dir, monkeypatch):
    from salver.campaigns import journal as module

    real, room = os.write, [1500]

    def write(file, data):
        """A disk with 1500 bytes left, which takes what still fits."""
        if room[0] == 0:
            raise OSError(28, "No space left on device")
        count = real(file, data[: room[0]])
        room[0] -= count
        return count

    monkeypatch.setattr(module.os, "write", write)
    with pytest.raises(SalverError, match="No space left on device"):
        run_campaign(run_dir, n=N, jobs=1)
    monkeypatch.undo()
    kept = (run_dir / "campaign" / "journal.jsonl").read_bytes()
    assert 0 < kept.count(b"\n") < 2 * N
    run_campaign(run_dir, n=N, jobs=1)
    assert (run_dir / "campaign" / "journal.jsonl").read_bytes().startswith(kept[: kept.rfind(b"\n") + 1])
    assert parquet(run_dir) == (finished.folder / "runs.parquet").read_bytes()


def test_what_the_environment_becomes_meanwhile_stays(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.setenv("SALVER_OTHER", "before")
    with _single_threaded():
        assert os.environ["OMP_NUM_THREADS"] == "1"
        os.environ["SALVER_OTHER"] = "after"
    assert (os.environ["OMP_NUM_THREADS"], os.environ["SALVER_OTHER"]) == ("7", "after")
