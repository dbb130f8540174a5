"""Every script in examples/ runs as it is told to in its own docstring, with small numbers."""

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow
EXAMPLES = Path(__file__).parents[1] / "examples"
SMALL = {
    "plan_in_ten_lines": [],
    "audit": [],
    "campaign": ["-n", "2"],
}


def run(name, directory):
    done = subprocess.run(
        [sys.executable, EXAMPLES / f"{name}.py", *SMALL[name]],
        cwd=directory,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_every_example_is_run_here():
    scripts = {path.stem for path in EXAMPLES.glob("*.py") if "__main__" in path.read_text() or path.stem in SMALL}
    elsewhere = {"unicycle", "quadrotor"}  # test_sensitivity_examples.py
    assert scripts == set(SMALL) | elsewhere


def test_plan_in_ten_lines(tmp_path):
    output = run("plan_in_ten_lines", tmp_path)
    assert "the cube holds" in output
    assert (tmp_path / "runs/ten-lines/plan.npz").is_file()


def test_audit_of_a_trapezoid_finds_its_corners(tmp_path):
    """Ramps of 0.6/0.8/0.2 = 3.75 m/s^2 need a friction of 0.38; the smoothed corners overshoot the sure 0.40."""
    believed, worst, slower = run("audit", tmp_path).splitlines()
    assert "Everything holds" in believed
    assert "slides" in worst
    assert "just holds at 1.0" in slower


def test_campaign_where_only_the_robust_plan_keeps_the_cube(tmp_path):
    lines = run("campaign", tmp_path).splitlines()
    assert lines[0] == "1.5 s, robust: planned safe; in the engine: holds 2"
    assert "1.3 s, robust: planned safe; in the engine: holds 2" in lines
    assert "1.3 s, baseline: planned not safe; in the engine: holds 1, slides 1" in lines
