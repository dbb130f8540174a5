"""The page and the way between it and the world: server-sent events there, small JSON messages back."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from types import TracebackType
from typing import Any, Self

from salver.errors import SalverError
from salver.live import Worker
from salver.playground.page import page
from salver.playground.world import World
from salver.reports.pages.local_page import HTML, LocalPage, Shown


class Playground:
    """The world runs and the page is served while it is entered."""

    def __init__(self, world: World, port: int = 0, *, process: bool = True) -> None:
        """port: 0 for one that is free. process: plan in another process, so that planning does not hold up the world.

        Raises SalverError when the port is taken.
        """
        self.world = world
        self._worker = Worker(world.live, process=process)
        self._closing = threading.Event()
        self._frame, self._fresh = b"", threading.Condition()
        self.pace = 1.0
        self.page = page(world)
        self._served = LocalPage(self._show_at, self._say, port)
        self._thread = threading.Thread(target=self._run, name="world", daemon=True)

    @property
    def url(self) -> str:
        return self._served.url

    def __enter__(self) -> Self:
        self._worker.start()
        self._thread.start()
        self._served.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._closing.set()
        with self._fresh:
            self._fresh.notify_all()
        self._served.close()
        self._thread.join()
        self._worker.close()

    def _show_at(self, what: str) -> Shown:
        return (self.page, HTML) if what == "" else self.frames() if what == "frames" else None

    def _say(self, message: Any) -> dict[str, Any]:
        status = self.world.say(message)
        return {"ok": status.ok, "sentence": status.sentence}

    def frames(self) -> Iterator[bytes]:
        """Each new frame, as JSON, until the end."""
        while not self._closing.is_set():
            with self._fresh:
                self._fresh.wait(1.0)
                frame = self._frame
            yield frame

    def _run(self) -> None:
        """The world, as fast as the clock; slower where the machine does not keep up, and it says so."""
        world, offset = self.world, time.perf_counter()
        due, marks = 0.0, [(time.perf_counter(), world.t)]
        behind = 0.05  # s behind the clock, from where on the world's clock is slowed instead of caught up
        while not self._closing.is_set():
            try:
                now = time.perf_counter()
                if now - offset - world.t > behind:
                    offset = now - world.t - behind
                while world.t <= now - offset:
                    world.advance()
                    if time.perf_counter() - now > behind:
                        break
                if now >= due:
                    due = now + 1 / 30
                    marks = [mark for mark in marks if now - mark[0] < 1.0] + [(now, world.t)]
                    spent = now - marks[0][0]
                    self.pace = (world.t - marks[0][1]) / spent if spent > 0.2 else self.pace
                    self._show()
            except SalverError as error:
                world.note = str(error)
                self._show()
                return
            time.sleep(2e-3)

    def _show(self) -> None:
        frame = {**self.world.frame(), "pace": round(self.pace, 3), "planner": self._worker.alive}
        with self._fresh:
            self._frame = json.dumps(frame, separators=(",", ":")).encode()
            self._fresh.notify_all()
