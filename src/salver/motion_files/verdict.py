"""The verdict in a motion file: a file with an unsafe motion is marked in its name and at its beginning; one with a
motion that loses its load at lower speed at its beginning."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from salver.errors import UnsafeError

UNSAFE = "UNSAFE"
SPEED = "NOT AT EVERY SPEED"
_SAID = re.compile(rf'({UNSAFE}|{SPEED}): ([^\n"]*)')


def one_line(text: str) -> str:
    """The text without line breaks and control characters, for a comment in any format."""
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())


def warns(verdict: str) -> bool:
    """Whether a verdict is a warning, which every file must carry."""
    return verdict.startswith((UNSAFE, SPEED))


def place_for(path: str | Path, verdict: str, unsafe: bool) -> Path:
    """The path of a file for a motion with a verdict: `path`, with UNSAFE at the end of the name if the motion failed.

    unsafe: whether a motion that failed may be written; otherwise it raises UnsafeError.
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
    """The warning in the text or the name of a motion file, "UNSAFE: why" or that it is not safe at every speed; else
    empty."""
    found = _SAID.search(_text(path))
    if found:
        return f"{found[1]}: {found[2].strip()}"
    return f"{UNSAFE}: {path.name} calls itself so." if UNSAFE in path.name else ""


def _text(path: Path) -> str:
    """The text of a file or a bag that can contain its verdict."""
    if path.suffix.lower() == ".npz":
        with np.load(path, allow_pickle=False) as arrays:
            return str(arrays["verdict"]) if "verdict" in arrays.files else ""
    if path.is_dir():
        path = path / "metadata.yaml"
        return path.read_text(encoding="utf-8", errors="replace") if path.is_file() else ""
    with open(path, "rb") as file:
        return file.read(2000).decode("utf-8", errors="replace")
