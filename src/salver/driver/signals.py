"""Ctrl-C and the other signals that ask a process to end, as a request that the loop reads in its next period."""

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
    """A request to stop. seen: the first request; empty without one."""

    seen: str = ""

    def note(self, what: str) -> None:
        """Request a stop, from any thread: the loop begins it in its next period. what: the source of the request for
        the log, such as "Protective stop"."""
        self.seen = self.seen or what

    def wish(self, t: float) -> str:
        """The request in one sentence; empty without one."""
        return f"{self.seen} at t = {t:.3f} s." if self.seen else ""


@contextlib.contextmanager
def noted_signals(signals: Signals | None = None) -> Iterator[Signals]:
    """A context in which these signals interrupt nothing and are only noted; repeated signals count as one.

    signals: the object that notes them; default: a new one. Python allows this in the main thread only; in others
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
