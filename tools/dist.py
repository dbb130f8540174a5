"""Builds sdist and wheel: the same bytes from the same files, whenever and wherever they were checked out.

    SOURCE_DATE_EPOCH=1700000000 python tools/dist.py [SOURCE] [-o dist]

The wheel is built from the sdist, so that the one holds all that the other needs. Setuptools writes the times of files
and of the build into an sdist; they become SOURCE_DATE_EPOCH here (reproducible-builds.org), owners and modes plain.
"""

from __future__ import annotations

import argparse
import gzip
import io
import os
import subprocess
import sys
import tarfile
from pathlib import Path

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


if __name__ == "__main__":
    options = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    options.add_argument("source", nargs="?", type=Path, default=Path(__file__).parents[1])
    options.add_argument("-o", type=Path, default=Path("dist"))
    chosen = options.parse_args()
    for path in build(chosen.source, chosen.o):
        print(path)
