"""Builds sdist and wheel: the same bytes from the same files, whenever and wherever they were checked out.

    SOURCE_DATE_EPOCH=1700000000 python tools/dist.py [SOURCE] [-o dist] [--release PYTHON ...]

The wheel is built from the sdist, so that the one holds all that the other needs. Setuptools writes the times of files
and of the build into an sdist; they become SOURCE_DATE_EPOCH here (reproducible-builds.org), owners and modes plain.

With --release the checkout must be at the tag of its version, and the wheel must do what the README says in a fresh
environment of each Python. Nothing is published.
"""

from __future__ import annotations

import argparse
import gzip
import io
import os
import re
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

PLANS = "import salver as sv; sv.report(sv.plan('panda-cube').save('cube'))"  # needs no extra
SDIST = "import sys; from setuptools import build_meta; build_meta.build_sdist(sys.argv[1])"


def build(source: Path, place: Path) -> tuple[Path, Path]:
    """The sdist and the wheel that are written into `place`."""
    place.mkdir(parents=True, exist_ok=True)
    place = place.resolve()
    stamp = os.environ.get("SOURCE_DATE_EPOCH", "315619200")  # 1980, the first year that a wheel's dates can have
    quiet = {"check": True, "stdout": subprocess.DEVNULL, "env": {**os.environ, "SOURCE_DATE_EPOCH": stamp}}
    subprocess.run([sys.executable, "-W", "ignore", "-c", SDIST, place], cwd=source, **quiet)
    sdist = next(place.glob("*.tar.gz"))
    sdist.write_bytes(plain(sdist.read_bytes(), int(stamp)))
    pip = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation"]
    subprocess.run([*pip, "-w", place, sdist], **quiet)
    return sdist, next(place.glob("*.whl"))


def plain(content: bytes, stamp: int) -> bytes:
    """A .tar.gz with its members in order, all of one time, owner and kind of mode."""
    made = io.BytesIO()
    with tarfile.open(fileobj=io.BytesIO(content)) as old, tarfile.open(fileobj=made, mode="w") as new:
        for member in sorted(old.getmembers(), key=lambda m: m.name):
            member.mtime, member.uid, member.gid, member.uname, member.gname = stamp, 0, 0, "", ""
            member.mode = 0o755 if member.isdir() or member.mode & 0o100 else 0o644
            member.pax_headers = {}
            new.addfile(member, old.extractfile(member) if member.isfile() else None)
    return gzip.compress(made.getvalue(), mtime=0)


def untagged(source: Path, wheel: Path) -> str:
    """Why the checkout is not the release of this wheel, or nothing."""
    tag = f"v{wheel.name.split('-')[1]}"
    describe = ["git", "-C", source, "describe", "--tags", "--always", "--dirty"]
    found = subprocess.run(describe, check=True, capture_output=True, text=True).stdout.strip()
    return "" if found == tag else f"The checkout is {found}; a release is at the tag of its version, {tag}."


def first_example(readme: str) -> tuple[str, str]:
    """The README's first Python listing, and what it says that it prints."""
    found = re.search(r"```python\n(.*?)```\n\n```text\n(.*?)```", readme, re.S)
    assert found, "README.md has no Python listing with its output"
    return found[1], found[2]


def tried(wheel: Path, python: str, code: str, says: str) -> str:
    """A line on what the wheel does in a fresh environment of a Python; ends the program if that is something else."""
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([python, "-m", "venv", folder], check=True)
        own = Path(folder, "bin", "python")
        sizes = []
        for extra in ("", "[engine]"):  # to plan, and with what the README's lines need
            sizes.append(sum(p.lstat().st_blocks for p in Path(folder).rglob("*")))
            given = f"{wheel.resolve()}{extra}"
            subprocess.run([own, "-m", "pip", "install", "-q", "--disable-pip-version-check", given], check=True)
            if not extra:
                subprocess.run([own, "-I", "-c", PLANS], cwd=folder, stdout=subprocess.DEVNULL, check=True)
        done = subprocess.run([own, "-I", "-c", code], cwd=folder, capture_output=True, text=True, check=False)
        if done.stdout != says:
            sys.exit(f"{python}: the README's lines print\n{done.stdout}{done.stderr}and not\n{says}")
        sizes.append(sum(p.lstat().st_blocks for p in Path(folder).rglob("*")))
    alone, engine = (512e-6 * (size - sizes[0]) for size in sizes[1:])
    return f"{python}: {alone:.0f} MB to plan, {engine:.0f} MB with the engine; the README's lines print what it says"


if __name__ == "__main__":
    options = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    options.add_argument("source", nargs="?", type=Path, default=Path(__file__).parents[1])
    options.add_argument("-o", type=Path, default=Path("dist"))
    options.add_argument("--release", nargs="+", metavar="PYTHON", help="check the release, in these Pythons")
    chosen = options.parse_args()
    made = build(chosen.source, chosen.o)
    print(*made, sep="\n")
    if chosen.release:
        if why := untagged(chosen.source, made[1]):
            sys.exit(why)
        code, says = first_example((chosen.source / "README.md").read_text(encoding="utf-8"))
        for python in chosen.release:
            print(tried(made[1], python, code, says), flush=True)
