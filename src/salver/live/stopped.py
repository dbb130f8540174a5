"""The states that keep the arm at rest: a hold, after which requests continue, or a stop, which refuses them."""

from __future__ import annotations

from dataclasses import dataclass

from salver.live.replanning.wishes import PRIORITY, Halt, Source


@dataclass(frozen=True)
class Hold:
    """A hold until it is released. halt: the planner's request because of it. at: live time, s."""

    halt: Halt
    at: float

    def __str__(self) -> str:
        return f"Held by the {self.halt.source}."


@dataclass
class Stopped:
    """A latched stop. reason: in words, or nothing. halt: the planner's request because of it. refused: number of
    requests refused since."""

    reason: str
    source: Source
    halt: Halt
    refused: int = 0

    def again(self, reason: str, source: Source, halt: Halt) -> Stopped:
        """The stop after another request to stop: it has the reason and source with the higher priority."""
        if PRIORITY[source] < PRIORITY[self.source]:
            reason, source = self.reason, self.source
        return Stopped(reason, source, halt, self.refused)

    def __str__(self) -> str:
        why = f": {self.reason.rstrip('.')}" if self.reason else ""
        since = f" {self.refused} requests were refused since." if self.refused else ""
        return f"Stopped by the {self.source}{why}.{since}"
