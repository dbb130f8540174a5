"""The live mode of a window: a hand steers the load, and beside it the same load on an arm that the same hand moves
without protection."""

from __future__ import annotations

import threading
from collections.abc import Generator, Mapping
from typing import Any

from salver.errors import SalverError, Status
from salver.live import Worker
from salver.playground import World
from salver.scenario import Scenario
from salver.studio.words import compared, steered


class LiveMode:
    """world: the protected arm with its load. worker: its planner, a process. unprotected: what if nothing kept the
    load; None where it is not shown."""

    def __init__(self, scenario: Scenario, true: Mapping[str, float] | None) -> None:
        """true: values of parameters that are not nominal, for both arms."""
        self._scenario, self._true = scenario, true
        self.world = World(scenario, true)
        self.worker = Worker(self.world.live).start()
        self.unprotected: World | None = None
        self._lock = threading.RLock()
        self._spilt: list[float] = []  # s from the hand's first move until the unprotected load was lost, of each round
        self._moved: float | None = None  # the protected world's time when the hand moved first, s
        self._beside(True)

    def say(self, message: Any) -> Status:
        """Handle a message of the page, as `World.say`; {"beside": bool} shows the unprotected arm or does not, and
        both begin again."""
        with self._lock:
            match message:
                case {"beside": bool(wanted)}:
                    status = self.world.say({"again": True})
                    if status.ok:
                        self._beside(wanted)
                    return status
            status = self.world.say(message)
            if self.unprotected is None or not isinstance(message, dict):
                return status
            if status.ok and "again" in message:
                self._beside(True)
            elif "stop" in message:
                self.unprotected.say(message)
            elif message.keys() & {"goto", "twist"} and not self.world.live.stopped:
                self.unprotected.say(message)  # also what the planner refuses
                if self._moved is None:
                    self._moved = self.world.t
            return status

    def _beside(self, wanted: bool) -> None:
        """A new round."""
        self.unprotected = World(self._scenario, self._true, protected=False) if wanted else None
        if self.unprotected is not None:
            self._later = self.world.t - self.unprotected.t  # s, the difference of their clocks
        self._moved = None
        self._lost: list[float | None] = [None, None]  # s after that
        self._failed = ""

    def frames(self) -> Generator[dict[str, Any]]:
        """What the page shows, as long as the arm can be controlled."""
        for pace in self.world.paced():
            yield self.frame(pace)

    def frame(self, pace: float = 1.0) -> dict[str, Any]:
        """What the page shows now. pace: speed of the world's clock, as a share of real time."""
        with self._lock:
            frames = [self.world.frame()]
            if self.unprotected is not None:
                frames.append(self._caught_up(self.unprotected).frame())
            names, since = [], None if self._moved is None else self.world.t - self._moved
            for k, frame in enumerate(frames):
                frame["gone"] = any(item["became"] not in ("", "slid") for item in frame["load"])
                if frame["gone"] and self._lost[k] is None and since is not None:
                    self._lost[k] = since
                    if k:
                        self._spilt.append(since)
                names.append(compared(frame, since, self._lost[k], self._failed if k else "", self._spilt))
            words = steered(frames[0], pace, self.worker.alive)
            return frames[0] | words | {"names": names, "beside": frames[1:]}

    def _caught_up(self, unprotected: World) -> World:
        try:
            while not self._failed and unprotected.t + self._later < self.world.t:
                unprotected.advance()
        except SalverError as error:
            self._failed = str(error)
        return unprotected

    def close(self) -> None:
        self.worker.close()
