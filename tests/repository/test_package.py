"""What is built is what the repository holds: all data, the same bytes each time, for the Pythons it says."""

import os
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "tools"))

import dist  # noqa: E402

TEXT, MUCH = (".py", ".toml", ".md", ".in"), 2000
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """(sdist, wheel), twice: from two copies of the repository's files, of other times and rights. Shapes, which take
    long to compress, are cut short."""
    files = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    ).stdout.split("\n")
    both = []
    for name, mode, age in (("first", 0o644, 0), ("second", 0o664, 1e6)):
        place = tmp_path_factory.mktemp(name)
        for file in filter(None, files):
            if (ROOT / file).is_file() and file.startswith(("src/", "pyproject", "README", "LICENSE", "MANIFEST")):
                copy = place / "source" / file
                copy.parent.mkdir(parents=True, exist_ok=True)
                whole = (ROOT / file).read_bytes()
                copy.write_bytes(whole if file.endswith(TEXT) else whole[:MUCH])
                copy.chmod(mode)
                os.utime(copy, (age, age + 1.6e9))
        both.append(dist.build(place / "source", place / "dist"))
    return both


def test_a_wheel_holds_every_file_of_the_package(built):
    """It is built from the sdist, so that holds them too; and no tests, which are of no use without the rest."""
    sdist, wheel = built[0]
    inside = set(zipfile.ZipFile(wheel).namelist())
    own = [p for p in (ROOT / "src" / "salver").rglob("*") if p.is_file() and "__pycache__" not in p.parts]
    missing = [str(p) for p in own if str(p.relative_to(ROOT / "src")) not in inside]
    assert len(own) > 150
    assert missing == []
    with tarfile.open(sdist) as archive:
        assert not [name for name in archive.getnames() if "/tests" in name]


def test_what_is_built_is_the_same_twice(built):
    (sdist, wheel), (other_sdist, other_wheel) = built
    assert wheel.read_bytes() == other_wheel.read_bytes()
    assert sdist.read_bytes() == other_sdist.read_bytes()


def test_the_pythons_it_names_are_the_pythons_it_takes():
    named = {c.rsplit(" ", 1)[1] for c in PROJECT["classifiers"] if c.startswith("Programming Language :: Python ::")}
    low, high = PROJECT["requires-python"].removeprefix(">=").split(",<")
    minor = range(int(low.split(".")[1]), int(high.split(".")[1]))
    assert named == {f"3.{k}" for k in minor}
    assert f"({low.replace('.', ', ')}) <= sys.version_info" in (ROOT / "Makefile").read_text(encoding="utf-8")


def test_a_release_is_a_clean_checkout_at_the_tag_of_its_version(tmp_path):
    def git(*words):
        subprocess.run(["git", "-C", tmp_path, "-c", "user.name=a", "-c", "user.email=a@b", *words], check=True)

    wheel = Path("salver-0.1.0-py3-none-any.whl")
    git("init", "-q")
    (tmp_path / "file").write_text("1")
    git("add", "file")
    git("commit", "-q", "-m", "first")
    assert "a release is at the tag of its version, v0.1.0." in dist.untagged(tmp_path, wheel)
    git("tag", "v0.1.0")
    assert dist.untagged(tmp_path, wheel) == ""
    assert "The checkout is v0.1.0;" in dist.untagged(tmp_path, Path("salver-0.2.0-py3-none-any.whl"))
    (tmp_path / "file").write_text("2")
    assert "The checkout is v0.1.0-dirty;" in dist.untagged(tmp_path, wheel)


def test_a_release_runs_the_lines_of_the_readme():
    code, says = dist.first_example((ROOT / "README.md").read_text(encoding="utf-8"))
    assert code.startswith("import salver as sv  # ")
    assert len(code.splitlines()) == 6
    assert says.count(" s: ") == 2
