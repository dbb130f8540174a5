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
    _part: tuple[int, int] = (0, 1)
    _begun: float = field(default_factory=lambda: time.perf_counter())  # whichever it is by then

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

    def begin(self, part: int, count: int) -> None:
        """Begin a part, 0 for the first, of a search in `count` equal ones."""
        self._part, self.best = (part, count), None

    def reached(self, share: float) -> None:
        """Report the share of the present part that is done."""
        part, count = self._part
        self.share = max(self.share, (part + min(1.0, share)) / count)
