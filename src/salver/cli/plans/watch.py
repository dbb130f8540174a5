"""Plan again whenever a file is saved."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from pathlib import Path

import typer

from salver.cli.common import say
from salver.errors import SalverError, ScenarioError

LOOK_EVERY = 0.3  # s


def watched(path: Path, plan: Callable[[], None], directory: Callable[[], Path], pause: float = LOOK_EVERY) -> None:
    """Plan now and after every change of the file, and write the page each time, until interrupted.

    directory: run directory of the plan. A mistake in the file is reported, and the next change is awaited. Raises
    ScenarioError when there is no such file, because a ready-made scenario does not change.
    """
    from salver.reports.pages.page import write_report

    if not path.is_file():
        raise ScenarioError(f"{path} is not a file to watch; give a .toml file with --watch.")
    while True:
        seen = _state(path)
        try:
            with contextlib.suppress(typer.Exit):  # no safe plan, which has been reported
                plan()
            page = write_report(directory(), None, say)
            say(f"Wrote {page}; watching {path}, Ctrl-C ends it.")
        except SalverError as error:
            say(f"salver: {error}")
            say(f"Watching {path}, Ctrl-C ends it.")
        while _state(path) == seen:
            time.sleep(pause)


def _state(path: Path) -> tuple[int, int]:
    """Modification time and size of a file; zero while an editor has removed it."""
    try:
        found = path.stat()
    except OSError:
        return 0, 0
    return found.st_mtime_ns, found.st_size
