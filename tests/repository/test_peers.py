"""The benchmark against other planners: its scores, by hand; each adapter gives a motion of the task."""

import subprocess
import sys
import tomllib
from argparse import Namespace
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "benchmarks"))

import peers  # noqa: E402
from fastest import scenarios  # noqa: E402
from peer_planners import PLANNERS, Task, toppra_law  # noqa: E402
from salver import sampling  # noqa: E402

LIMITED = ("velocity", "acceleration", "torque")


@pytest.fixture(scope="module")
def task():
    return Task(scenarios()["tall bottle"])


def test_a_motion_twice_as_fast_as_a_limit_is_told_so(task):
    """A quintic of one joint by 1 rad: its top speed is 15/8 rad over its duration."""
    s = np.linspace(0, 1, 401)
    shape = np.stack([s**3 * (10 - 15 * s + 6 * s**2), 30 * s**2 * (1 - s) ** 2, 60 * s * (1 - s) * (1 - 2 * s)])
    limit = task.problem.arm.planning_limits.velocity[0]
    duration = 15 / 8 / (2 * limit)
    q, dq, ddq = (np.outer(x / duration**k, np.eye(7)[0]) for k, x in enumerate(shape))
    plan = peers.plan_of(task.scenario, task.problem, peers.JointMotion(s * duration, q + task.ends[0], dq, ddq))
    assert peers.broken(task, plan)["velocity"] == pytest.approx(2.0, rel=1e-3)


def test_totals_are_sums_over_loads():
    def row(duration, holds, limit, broken):
        return {"duration": duration, "seconds": duration, "runs": 4, "kind": "live", "broken": broken,
                "outcomes": {"holds": holds, "limit": limit, "tips": 4 - holds - limit}, "drawn": "101"}  # fmt: skip

    results = {"a": {"x": row(1.0, 3, 1, {"jerk": 2.0})}, "b": {"x": row(2.0, 1, 0, {})}, "c": {"x": {"failed": "no"}}}
    found = peers.totals(results, "x")
    assert (found["solved"], found["of"], found["runs"], found["held"], found["stayed"]) == (2, 3, 8, 4, 5)
    assert (found["duration"], found["broken"]) == (1.5, {"jerk": 2.0})
    assert (found["kept share"], found["stayed share"]) == (0.5, 0.625)
    assert found["kept between"] == pytest.approx((0.223, 0.957), abs=1e-3)  # 4 of 6, as tables of Clopper-Pearson say
    results["b"]["x"]["drawn"] = "10100000"  # more of one load than of the other are not counted
    assert peers.totals(results, "x")["kept between"] == found["kept between"]
    results["a"]["x"] |= {"runs": 8, "outcomes": {"holds": 6, "limit": 2}}  # more runs of a load weigh no more
    found = peers.totals(results, "x")
    assert (found["kept share"], found["stayed share"], found["runs"]) == (0.5, 0.625, 12)


def test_the_page_says_how_many_runs_there_are_of_which_loads():
    runs = {
        "a": {"x": {"runs": 4}, "y": {"runs": 4}},
        "b": {"x": {"runs": 4}, "y": {"failed": "no"}},
        "c": {"x": {"runs": 2}, "y": {"runs": 4}},
    }
    sentence = peers.counts(runs)
    assert sentence.startswith("18 runs in all: 4 of each motion for *a*, *b*; 2 to 4 of each motion for *c*.")


def test_intervals_are_of_what_was_drawn_and_hopeless_motions_are_given_up():
    chosen = Namespace(n=1000, hopeless=100)
    assert [peers._wanted({"runs": k, "outcomes": {"holds": h}}, chosen) for k, h in ((99, 0), (100, 0), (100, 1))] == [
        1000,
        100,
        1000,
    ]
    five = scenarios()["tall bottle"]
    assert [peers._extremes(five, n) for n in (32, 33, 1000)] == [0, 32, 32]
    drawn = sampling.draw(five.uncertain, 33, 0, "corners", five.bodies)
    inside = np.abs(drawn - five.uncertain.nominal) < 0.999 * five.uncertain.half_range
    assert not inside[:32].any()
    assert inside[32].all()


@pytest.mark.slow
def test_frozen_motions_are_of_the_task_and_say_where_they_come_from():
    """From rest with the load at its start to rest with it at its goal, within the limits that the planner was told; in
    postures along the line as they were chosen when the motion was made."""
    tasks = [Task(scenarios()[name]) for name in ("tall bottle", "cube, friction 0.2")]
    for folder in peers.FROZEN.iterdir():
        told = tomllib.loads((folder / "provenance.toml").read_text())
        assert {"package", "version", "made", "with", "on", "seconds"} == set(told)
        for task in tasks:
            motion, seconds = peers.frozen(folder.name, task)
            assert seconds > 0
            first = task.scenario.payload.first
            for q, end in zip(motion[1][[0, -1]], task.ends, strict=True):
                here, there = (task.problem.arm.object_pose(x, first.p_EB, first.R_EB) for x in (q, end))
                assert all(np.allclose(a, b, atol=1e-5) for a, b in zip(here, there, strict=True))
            assert np.abs(motion[2][[0, -1]]).max() < 1e-6
            plan = peers.plan_of(task.scenario, task.problem, peers.JointMotion(*motion))
            assert not {"velocity", "torque"} & set(peers.broken(task, plan))


@pytest.mark.parametrize("name", ["ruckig", "toppra", "Drake Toppra"])
def test_live_adapters_give_a_motion_within_the_limits_that_they_know(task, name):
    planner = PLANNERS[name]
    if planner.missing:
        pytest.skip(f"{planner.package} is not installed")
    t, q, dq, _ = planner.plan(task)
    assert np.allclose(q[[0, -1]], task.ends, atol=1e-6)
    assert np.allclose(np.gradient(q, t, axis=0)[5:-5], dq[5:-5], atol=0.05)
    plan = peers.plan_of(task.scenario, task.problem, peers.JointMotion(*planner.plan(task)))
    assert "velocity" not in peers.broken(task, plan)


def test_toppra_and_salvers_law_agree(task):
    """The same conditions at the same points, at ends of intervals and at their middles: within 1 %."""
    if PLANNERS["toppra"].missing:
        pytest.skip("toppra is not installed")
    u, rate = toppra_law(task.problem, task.path, 201, "intervals")
    theirs = float(np.sum(2 * np.diff(u) / (rate[1:] + rate[:-1])))
    assert peers.reachable_law(task.problem, task.path, 201)[0][-1] == pytest.approx(theirs, rel=0.01)


@pytest.mark.slow
def test_a_planner_of_ones_own_is_scored(tmp_path):
    """As the page shows it: the trapezoid's duration by hand, sqrt(4.5 L / (0.9 mu g)), for the paper's way."""
    words = [sys.executable, ROOT / "benchmarks" / "own_planner.py", "-n", "1", "--jobs", "1", "--again"]
    done = subprocess.run(
        [*words, "--only", "cube, friction 0.4", "--planners", "trapezoid", "--work", tmp_path],
        capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    length = np.hypot(0.471074, 0.098098)
    line = next(line for line in done.stdout.splitlines() if line.startswith("cube, friction 0.4"))
    assert f"trapezoid            {np.sqrt(4.5 * length / (0.9 * 0.4 * 9.81)):.3f} s" in line
    assert (tmp_path / "results.json").is_file()


@pytest.mark.slow
def test_a_planner_or_load_that_there_is_not_is_refused(monkeypatch, capsys):
    for words in (["--planners", "salvr"], ["--only", "tall botle"], ["--freeze", "salvr"]):
        monkeypatch.setattr(sys, "argv", ["peers.py", *words])
        with pytest.raises(SystemExit) as ended:
            peers.main()
        assert ended.value.code == 2
        assert words[1] in capsys.readouterr().err


def test_planners_are_told_nominal_values_only(task):
    """Only salver's last row may know the ranges."""
    assert task.problem.tracking is None
    changed = task.scenario.with_changes(objects=[{**task.scenario.objects[0].model_dump(), "uncertainty": {}}])
    other = Task(changed)
    for mine, theirs in zip(task.problem.contacts, other.problem.contacts, strict=True):
        assert np.allclose(mine.nominal, theirs.nominal)
    assert replace(task).friction == other.friction
