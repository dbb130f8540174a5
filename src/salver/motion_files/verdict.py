"""The verdict in a motion file: an unsafe motion says so in its name and first in its text; one that loses its load
when it is run slower says that first in its text."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from salver.errors import UnsafeError

UNSAFE = "UNSAFE"
SPEED = "NOT AT EVERY SPEED"
_SAID = re.compile(rf'({UNSAFE}|{SPEED}): ([^\n"]*)')
_HEAD = 2000  # bytes of a file in which its verdict stands


def one_line(text: str) -> str:
    """The text without line breaks and control characters: as a comment of any format may hold it."""
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())


def warns(verdict: str) -> bool:
    """Whether a verdict must be read before its motion is run, also where a file has no room for a heading."""
    return verdict.startswith((UNSAFE, SPEED))


def place_for(path: str | Path, verdict: str, unsafe: bool) -> Path:
    """The path of a motion with that verdict: `path`, or with UNSAFE at the end of its name.

    unsafe: whether a motion that fails its verdict may be written at all. Raises UnsafeError.
    """
    path = Path(path)
    if not verdict.startswith(UNSAFE):
        return path
    if not unsafe:
        reason = verdict.removeprefix(f"{UNSAFE}: ").rstrip(".")
        raise UnsafeError(
            f"{path} is not written as if it were safe: {reason} (--unsafe, in Python unsafe=True, writes it with "
            f"{UNSAFE} in its name)."
        )
    return path if UNSAFE in path.name else path.with_name(f"{path.stem}-{UNSAFE}{path.suffix}")


def verdict_in(path: Path) -> str:
    """ "UNSAFE: why" where a motion file says so of itself, in its text or its name, or that it is not safe at every
    speed; else empty."""
    found = _SAID.search(_text(path))
    if found:
        return f"{found[1]}: {found[2].strip()}"
    return f"{UNSAFE}: {path.name} calls itself so." if UNSAFE in path.name else ""


def _text(path: Path) -> str:
    """The text with the verdict of a file or of a bag."""
    if path.suffix.lower() == ".npz":
        with np.load(path, allow_pickle=False) as arrays:
            return str(arrays["verdict"]) if "verdict" in arrays.files else ""
    if path.is_dir():
        path = path / "metadata.yaml"
        return path.read_text(encoding="utf-8", errors="replace") if path.is_file() else ""
    with open(path, "rb") as file:
        return file.read(_HEAD).decode("utf-8", errors="replace")
