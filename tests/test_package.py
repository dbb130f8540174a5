"""What is built is what the repository holds: all data, the same bytes each time, for the Pythons it says."""

import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


@pytest.fixture(scope="module")
def wheels(tmp_path_factory):
    """Two wheels, built one after the other."""
    files = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    ).stdout.split("\n")
    built = []
    for name in ("first", "second"):
        place = tmp_path_factory.mktemp(name)
        source = place / "source"
        for file in filter(None, files):
            if (ROOT / file).is_file() and file.startswith(("src/", "pyproject", "README", "LICENSE")):
                (source / file).parent.mkdir(parents=True, exist_ok=True)
                (source / file).write_bytes((ROOT / file).read_bytes())
        subprocess.run(
            [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "-w", place, source],
            check=True,
            capture_output=True,
            env={"SOURCE_DATE_EPOCH": "1700000000", "PATH": "/usr/bin:/bin"},
        )
        built.append(next(place.glob("*.whl")))
    return built


def test_a_wheel_holds_every_file_of_the_package(wheels):
    inside = set(zipfile.ZipFile(wheels[0]).namelist())
    own = [p for p in (ROOT / "src" / "salver").rglob("*") if p.is_file() and "__pycache__" not in p.parts]
    missing = [str(p) for p in own if str(p.relative_to(ROOT / "src")) not in inside]
    assert len(own) > 150
    assert missing == []


def test_a_wheel_is_built_the_same_twice(wheels):
    first, second = (wheel.read_bytes() for wheel in wheels)
    assert first == second


def test_the_pythons_it_names_are_the_pythons_it_takes():
    named = {c.rsplit(" ", 1)[1] for c in PROJECT["classifiers"] if c.startswith("Programming Language :: Python ::")}
    low, high = PROJECT["requires-python"].removeprefix(">=").split(",<")
    minor = range(int(low.split(".")[1]), int(high.split(".")[1]))
    assert named == {f"3.{k}" for k in minor}
    assert f"({low.replace('.', ', ')}) <= sys.version_info" in (ROOT / "Makefile").read_text(encoding="utf-8")
