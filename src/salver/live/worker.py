"""A thread that plans for a live motion whenever there is something to plan."""

from __future__ import annotations

import sys
import threading
from types import TracebackType
from typing import Self

from salver.live.live import Live

PAUSE = 2e-3  # s between two looks for something to do
SWITCH = 5e-4  # s for which Python lets one thread run when another wants to: the robot's loop must not wait for long


class Worker:
    """Plans while it is entered: `with Worker(live): ...`, or `start` and `close`."""

    def __init__(self, live: Live, budget: float = 2.0) -> None:
        """budget: s that one step of planning may take, about."""
        self._live, self._budget = live, budget
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._work, name="salver-live", daemon=True)

    def start(self) -> Self:
        sys.setswitchinterval(min(sys.getswitchinterval(), SWITCH))
        self._thread.start()
        return self

    def close(self) -> None:
        """Plan no more; what is committed is finished."""
        self._closing.set()
        self._thread.join()

    @property
    def alive(self) -> bool:
        return self._thread.is_alive()

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _work(self) -> None:
        while not self._closing.is_set():
            if self._live.idle:
                self._closing.wait(PAUSE)
            else:
                self._live.plan(self._budget)
