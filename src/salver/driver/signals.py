"""Ctrl-C and the other signals that ask a process to end, as a wish that the loop reads when it suits it."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

_WISHES = {"SIGINT": "Interrupted", "SIGTERM": "Terminated", "SIGHUP": "The terminal was closed"}


@dataclass
class Signals:
    """seen: what was asked for first; empty while nothing was."""

    seen: str = ""

    def note(self, what: str) -> None:
        self.seen = self.seen or what

    def wish(self, t: float) -> str:
        """One sentence when something was asked for, else an empty one."""
        return f"{self.seen} at t = {t:.3f} s." if self.seen else ""


@contextlib.contextmanager
def noted_signals() -> Iterator[Signals]:
    """Within, these signals interrupt nothing and are noted; once or many times makes no difference.

    Python lets only the main thread do that; in others nothing changes.
    """
    signals, before = Signals(), {}

    def handler(number: int, frame: Any) -> None:
        signals.note(_WISHES[signal.Signals(number).name])

    if threading.current_thread() is threading.main_thread():
        for name in _WISHES:
            if (number := getattr(signal, name, None)) is not None:
                before[number] = signal.signal(number, handler)
    try:
        yield signals
    finally:
        for number, old in before.items():
            signal.signal(number, old if old is not None else signal.SIG_DFL)
