"""Stops that are kept ready, so that the arm can be stopped without planning."""

from __future__ import annotations

from dataclasses import dataclass

from salver.live.committed.motion import Committed
from salver.live.replanning.lookout import Sighting
from salver.live.running import Running


@dataclass(frozen=True)
class ReadyOptions:
    """Which stops are kept ready.

    Attributes:
        every: s between the instants at which stops begin. Doubled, half as many are planned, and a requested stop
            begins up to 0.1 s later.
        early: s by which the beginning of a stop must be ahead of the loop for the stop to be taken.
    """

    every: float = 0.1
    early: float = 2e-3


class Ready:
    """Stops from instants of one committed motion, `after`; those of another are forgotten."""

    def __init__(self, options: ReadyOptions) -> None:
        self.options = options
        self._stops: tuple[Running, ...] = ()
        self._after: Committed | None = None
        self._until = 0.0  # live time of the last instant that was looked at

    def due(self, after: Committed) -> float:
        """Live time, s, of the next instant from which a stop is to be planned."""
        if self._after is not after:
            self._after, self._stops, self._until = after, (), after.begins - self.options.every
        return self._until + self.options.every

    def looked_at(self, begins: float) -> None:
        """Note that a stop from this instant is being planned, whatever the result."""
        self._until = begins

    def add(self, stop: Running, after: Committed) -> None:
        """Add a planned stop, unless stops from another motion are needed by now."""
        if self._after is after:
            self._stops += (stop,)

    def soonest(self, after: Committed, now: float, sighting: Sighting) -> Running | None:
        """The stop that is at rest first, of those that can still be taken and knew of all that was seen since; None if
        there is none."""
        left = [
            x
            for x in self._stops
            if x.after is after
            and x.committed.begins > now + self.options.early
            and x.outlook.sighting.news == sighting.news
        ]
        return min(left, key=lambda x: x.committed.ends, default=None)
