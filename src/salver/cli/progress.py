"""Progress of commands that take longer than a second.

If standard error is a terminal, it is a bar, which is hidden before anything is printed and shown again after a second
without output. Otherwise it is a line every few seconds, for commands that report steps.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, TextIO

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress

AFTER = 1.0  # s without output until the bar is shown
EVERY = 3.0  # s between lines

_now: Bar | Lines | None = None  # progress of the running command


class Bar:
    """The progress bar of a command. Before the first `step` it shows only the elapsed time."""

    def __init__(self, name: str, console: Console | None = None) -> None:
        self._name, self._console = name, console
        self._lock = threading.RLock()  # a timer thread shows the bar, the command hides it
        self._timer: threading.Timer | None = None
        self._shown: Progress | None = None
        self._done: tuple[int | None, int | None, str] = (None, None, "")

    def step(self, done: int, total: int, words: str = "") -> None:
        """Note that `done` of `total` steps are done."""
        with self._lock:
            self._done = (done, total, words)
            if self._shown is not None:
                self._shown.update(self._shown.task_ids[0], completed=done, total=total, description=words)

    def wait(self) -> None:
        """Show the bar after a while."""
        with self._lock:
            self._timer = threading.Timer(AFTER, self._show)
            self._timer.daemon = True
            self._timer.start()

    def end(self) -> None:
        with self._lock:
            if self._timer is not None:
                self._timer.cancel()
            if self._shown is not None:
                self._shown.stop()
            self._timer = self._shown = None

    def _show(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

        with self._lock:
            if self._timer is None:  # hidden in the meantime
                return
            done, total, words = self._done
            self._shown = Progress(
                TextColumn(self._name),
                BarColumn(),
                TaskProgressColumn(),
                TimeElapsedColumn(),
                TextColumn("{task.description}", markup=False),
                console=self._console or Console(stderr=True, highlight=False),
                transient=True,
            )
            self._shown.add_task(words, total=total, completed=done or 0)
            self._shown.start()


class Lines:
    """Progress of a command, a line every `EVERY` s."""

    def __init__(self, name: str) -> None:
        self._name, self._ended, self._begun = name, threading.Event(), time.monotonic()
        self._done: tuple[int, int, str] = (0, 1, "")

    def step(self, done: int, total: int, words: str = "") -> None:
        """Note that `done` of `total` steps are done."""
        self._done = done, total, words

    def wait(self) -> None:
        """Start the thread that prints the lines."""
        threading.Thread(target=self._tell, args=(sys.stderr,), daemon=True).start()

    def end(self) -> None:
        self._ended.set()

    def _tell(self, stream: TextIO) -> None:
        while not self._ended.wait(EVERY):
            done, total, words = self._done
            if words:
                seconds = time.monotonic() - self._begun
                stream.write(f"salver {self._name}: {seconds:.0f} s, {100 * done // total} %: {words}\n")
                stream.flush()


@contextmanager
def working(name: str) -> Iterator[None]:
    """A context in which a command shows its progress; only one bar exists at a time."""
    global _now
    if _now is not None:
        yield
        return
    _now = Bar(name) if sys.stderr.isatty() else Lines(name)
    _now.wait()
    try:
        yield
    finally:
        _now.end()
        _now = None


def step(done: int, total: int, words: str = "") -> None:
    """Report that the running command has done `done` of `total` steps, with a comment."""
    if _now is not None:
        _now.step(done, total, words)


def hide() -> None:
    """Hide the bar before something is printed or asked."""
    if isinstance(_now, Bar):
        _now.end()
        _now.wait()
