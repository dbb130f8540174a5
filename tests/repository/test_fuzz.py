"""Some damaged inputs of every kind, as `make fuzz` makes many: refused with a sentence or rightly accepted, soon."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_a_short_run_of_the_fuzzer_finds_nothing(tmp_path):
    done = subprocess.run(
        [sys.executable, ROOT / "tools" / "fuzz", "-n", "24", "--seed", "7", "--minutes", "5"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    counted = done.stdout.splitlines()[-1]
    assert "0 DEFECT, 0 SLOW, 0 MEMORY, 0 CRASH, 0 WRONG" in counted


@pytest.mark.slow
def test_the_fuzzer_notices_a_defect(tmp_path):
    """With a reader that falls over, it says which case, keeps the input and exits with 1."""
    (tmp_path / "sitecustomize.py").write_text(
        "import salver.motion_files.readers as readers\n"
        "def broken(*_):\n    raise ZeroDivisionError('planted')\n"
        "assert readers.read_table\n"
        "readers.read_table = broken\n"
    )
    done = subprocess.run(
        [sys.executable, ROOT / "tools" / "fuzz", "-n", "20", "--only", "trajectory"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": f"{tmp_path}:{ROOT / 'src'}"},
    )
    assert done.returncode == 1
    assert "DEFECT: trajectory 0" in done.stdout
    assert "ZeroDivisionError: planted" in done.stdout
    (kept, *_) = (tmp_path / "out" / "fuzz").iterdir()
    assert (kept / "traceback.txt").is_file()
    assert [p for p in kept.iterdir() if p.name.startswith("case")]
