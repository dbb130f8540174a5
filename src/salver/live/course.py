"""A live motion as the reference of an arm's controller, in place of a motion that is known beforehand."""

from __future__ import annotations

from salver.geometry import Array
from salver.live.live import Live


class LiveCourse:
    """A `salver.control.arm.Course` that reads the commanded motion at the controller's times, as its only reader."""

    def __init__(self, live: Live) -> None:
        self._live = live
        self.t = 0.0  # s, the last time that was asked for

    def instant(self, t: float) -> tuple[int, float]:
        self.t = t
        q, dq, ddq, _ = self._live.command(t)
        self._now = q.copy(), dq.copy(), ddq.copy()  # who follows it may keep them
        return 0, 0.0

    def at(self, index: int, offset: float) -> tuple[Array, Array, Array]:
        return self._now
