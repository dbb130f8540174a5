"""Every script in examples/ runs as it is told to in its own docstring, with small numbers."""

import contextlib
import io
import re
import runpy
import subprocess
import sys
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

from salver.planning.fastest import fastest, nearby, transport_problem
from salver.scenario import load

pytestmark = pytest.mark.slow
EXAMPLES = Path(__file__).parents[2] / "examples"
SMALL = {
    "plan_in_ten_lines": [],
    "audit": [],
    "campaign": ["-n", "2"],
}


def run(name, directory):
    """What the script prints, as a process of its own."""
    done = subprocess.run(
        [sys.executable, EXAMPLES / f"{name}.py", *SMALL[name]],
        cwd=directory,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def printed(path):
    """What a script prints that is run as the main one, here."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out), mock.patch.object(sys, "argv", [str(path)]):
        runpy.run_path(str(path), run_name="__main__")
    return out.getvalue()


def test_every_example_is_run_here():
    scripts = {path.stem for path in EXAMPLES.glob("*.py") if "__main__" in path.read_text() or path.stem in SMALL}
    elsewhere = {"unicycle", "quadrotor", "lerobot_step"}  # the first two: test_sensitivity_examples.py
    assert scripts == set(SMALL) | elsewhere


def test_plan_in_ten_lines(tmp_path):
    with contextlib.chdir(tmp_path):
        output = printed(EXAMPLES / "plan_in_ten_lines.py")
    assert "the cube holds" in output
    assert (tmp_path / "runs/ten-lines/plan.npz").is_file()


def test_audit_of_a_trapezoid_finds_its_corners(tmp_path):
    """Ramps of 0.6/0.8/0.2 = 3.75 m/s^2 need a friction of 0.38 of the sure 0.40: at the corners the samples leave more
    open than is between the two."""
    with contextlib.chdir(tmp_path):
        believed, worst, slower = printed(EXAMPLES / "audit.py").splitlines()
    assert "Everything holds" in believed
    assert "It cannot be told" in worst
    assert "250 samples a second show its acceleration only to" in worst
    assert "just holds at 1.0" in slower


def test_campaign_where_only_the_robust_plan_keeps_the_cube(tmp_path):
    lines = run("campaign", tmp_path).splitlines()
    assert lines[0] == "1.5 s, robust: planned safe; in the engine: holds 2"
    assert "1.3 s, robust: planned safe; in the engine: holds 2" in lines
    assert "1.3 s, baseline: planned not safe; in the engine: holds 1, slides 1" in lines


def test_a_step_of_lerobot_keeps_what_a_policy_would_lose():
    pytest.importorskip("lerobot.processor", reason="LeRobot is not installed")
    asked, kept = printed(EXAMPLES / "lerobot_step.py").splitlines()
    assert not asked.endswith(": holds")
    assert kept == "after KeepLoad: holds"


def extended(name):
    """What a file of examples/extending prints; none may have grown too long to be read at once."""
    path = EXAMPLES / "extending" / f"{name}.py"
    assert len(path.read_text().splitlines()) < 40
    return printed(path)


def durations(output):
    return [float(seconds) for seconds in re.findall(r"safe motion found takes ([\d.]+) s", output)]


def test_every_extension_is_run_here_and_shown_in_the_documentation():
    page = (EXAMPLES.parent / "docs" / "extending.md").read_text(encoding="utf-8")
    names = {path.stem for path in (EXAMPLES / "extending").glob("*.py")}
    assert names == {"constraint", "cost", "uncertainty", "inner_dynamics", "urdf_arm"}
    assert all(f"<!-- example: {name} -->" in page for name in names)


def test_a_limit_on_the_trays_speed_is_kept_and_costs_time():
    output = extended("constraint")
    free, limited = durations(output)
    assert limited > 1.05 * free
    speeds = [float(speed) for speed in re.findall(r"top speed is ([\d.]+) m/s", output)]
    assert speeds[0] > 1.0
    assert speeds[1] == pytest.approx(0.8, abs=0.005)


def test_the_calmest_motion_takes_hardly_more_than_the_least_acceleration_there_is():
    """Over a distance d from rest to rest in T no law has less than sqrt(12) d / T^2, the cubic's, in the mean square.

    The joints begin and end with no acceleration, which costs a hundredth; the limits, at 1.1 times the least duration,
    two more.
    """
    output, calm = extended("cost"), runpy.run_path(str(EXAMPLES / "extending" / "cost.py"))["Calm"]()
    mean = [float(value) for value in re.findall(r"acceleration is ([\d.]+) rad/s", output)]
    quickest = fastest(transport_problem(load("panda-cube")))
    for factor, took, printed in zip((1.1, 1.3, 1.6), durations(output), mean, strict=True):
        found = nearby(quickest, calm, factor * quickest.duration)
        assert found.duration == pytest.approx(took, abs=1e-4)
        q, _, ddq, _ = found.sample(np.linspace(0, found.duration, 2001))
        rms = np.sqrt(np.mean(np.sum(ddq**2, axis=1)))
        assert rms == pytest.approx(printed, abs=0.06)
        least = np.sqrt(12) * np.linalg.norm(q[-1] - q[0]) / found.duration**2
        assert least < rms < (1.035 if factor == 1.1 else 1.02) * least


def test_a_draught_costs_time():
    still, windy = durations(extended("uncertainty"))
    assert 1.02 * still < windy < 1.2 * still


def test_a_lamp_on_a_long_cord_takes_longer_and_keeps_its_room():
    output = extended("inner_dynamics")
    short, *_, long = durations(output)
    assert long > 1.05 * short
    swings = [float(degrees) for degrees in re.findall(r"swings by ([\d.]+) degrees", output)]
    assert 19.0 < min(swings) <= max(swings) <= 20.0


def test_an_arm_from_a_urdf_carries_the_cube():
    followed, planned = extended("urdf_arm").splitlines()
    assert "follows within its limits" in followed
    assert "follows within its limits" in planned
    assert len(durations(planned)) == 1
