"""Progress of commands that take longer than a second, on standard error.

In a terminal it is one line, which is renewed every second and taken away before anything is printed. Otherwise it is a
line every few seconds, for commands that report steps.
"""

from __future__ import annotations

import shutil
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

ERASE = "\r\x1b[2K"  # the line of a terminal

_now: Progress | None = None  # of the running command


class Progress:
    """Progress of a command, shown by a thread of its own until the command ends.

    after: s until the line is shown in a terminal, and between its renewals. every: s between lines elsewhere.
    """

    after, every = 1.0, 3.0

    def __init__(self, name: str) -> None:
        self._name, self._begun, self._stream = name, time.monotonic(), sys.stderr
        self._lock, self._ended = threading.Lock(), threading.Event()
        self._terminal, self._shown = self._stream.isatty(), False
        self._done: tuple[int, int, str] = (0, 1, "")
        threading.Thread(target=self._tell, daemon=True).start()

    def step(self, done: int, total: int, words: str = "") -> None:
        """Note that `done` of `total` steps are done."""
        self._done = done, total, words

    def hide(self) -> None:
        """Take the line away, until it is renewed."""
        with self._lock:
            if self._shown:
                self._stream.write(ERASE)
                self._stream.flush()
            self._shown = False

    def end(self) -> None:
        self._ended.set()
        self.hide()

    def _tell(self) -> None:
        while not self._ended.wait(self.after if self._terminal else self.every):
            done, total, words = self._done
            line = f"salver {self._name}: {time.monotonic() - self._begun:.0f} s"
            if words:
                line += f", {100 * done // total} %: {words}"
            with self._lock:
                if self._ended.is_set():
                    return
                if self._terminal:
                    self._stream.write(ERASE + line[: shutil.get_terminal_size().columns - 1])
                    self._shown = True
                elif words:
                    self._stream.write(f"{line}\n")
                self._stream.flush()


@contextmanager
def working(name: str) -> Iterator[None]:
    """A context in which a command shows its progress; only the outermost does."""
    global _now
    if _now is not None:
        yield
        return
    _now = Progress(name)
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
    """Hide the progress before something is printed or asked."""
    if _now is not None:
        _now.hide()
