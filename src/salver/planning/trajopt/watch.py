"""Progress of a search, and its early end."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

TIME_LIMIT, INTERRUPTED = "time_limit", "interrupted"
WHY = {TIME_LIMIT: "the time limit", INTERRUPTED: "an interruption"}


@dataclass
class Watch:
    """Progress of a search, which calls `over` between iterations. Without a time limit no result depends on a clock.

    time_limit: s from now, or None. tell: called with the watch at every report. ended: why the search was ended early,
    one of `WHY`; "" if not. share: of the work done, in [0, 1]. best: the shortest duration found so far, s; None
    before the first. trying: the current step, in words.
    """

    time_limit: float | None = None
    tell: Callable[[Watch], None] | None = None
    ended: str = ""
    share: float = 0.0
    best: float | None = None
    trying: str = ""
    _begun: float = field(default_factory=time.perf_counter)

    def over(self) -> bool:
        """Whether to end now with the best result so far."""
        if self.tell is not None:
            self.tell(self)
        if not self.ended and self.time_limit is not None and time.perf_counter() - self._begun > self.time_limit:
            self.ended = TIME_LIMIT
        return bool(self.ended)

    def interrupt(self) -> None:
        """End the search at its next call of `over`."""
        self.ended = self.ended or INTERRUPTED

    def part(self, first: float, size: float) -> Watch:
        """A watch for a part of the search, which begins at the share `first` of the work and has the share `size`."""
        return _Part(whole=self, first=first, size=size)


@dataclass
class _Part(Watch):
    whole: Watch = field(default_factory=Watch)
    first: float = 0.0
    size: float = 1.0

    def over(self) -> bool:
        self.whole.share, self.whole.trying = self.first + self.size * self.share, self.trying
        over = self.whole.over()
        self.ended = self.whole.ended
        return over
