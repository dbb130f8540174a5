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
    """A wish to stop. seen: what was asked for first; empty while nothing was."""

    seen: str = ""

    def note(self, what: str) -> None:
        """Ask for a stop, from any thread: the loop begins it in its next period. what: who or what asks, as it stands
        in the log, "Protective stop" say."""
        self.seen = self.seen or what

    def wish(self, t: float) -> str:
        """One sentence when something was asked for, else an empty one."""
        return f"{self.seen} at t = {t:.3f} s." if self.seen else ""


@contextlib.contextmanager
def noted_signals(signals: Signals | None = None) -> Iterator[Signals]:
    """Within, these signals interrupt nothing and are noted; once or many times makes no difference.

    signals: where they are noted, when it is there already. Python lets only the main thread do that; in others
    nothing changes.
    """
    signals, before = signals or Signals(), {}

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
