"""The lead time: how long before a hand-over planning begins, which is a little more than recent planning took."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass


@dataclass(frozen=True)
class LeadOptions:
    """How the lead time is learnt from the times that planning takes.

    Attributes:
        tick, speed, motion: s from the beginning of planning a tick, another speed or a whole motion to the hand-over,
            before it is known how long that takes.
        of: number of recent plans from whose times the lead is taken.
        spare: ratio of the lead to the longest of these times.
        least: s, least lead.
        most, most_with_dynamics: s, largest lead, without and with load dynamics.
    """

    tick: float = 0.05
    speed: float = 0.1
    motion: float = 0.25
    of: int = 5
    spare: float = 1.3
    least: float = 0.02
    most: float = 1.0
    most_with_dynamics: float = 3.0


class Lead:
    """Time from the beginning of planning to the hand-over, s, for each kind of planning: given, or learnt from the
    time that planning takes. inner: whether a load has inner dynamics."""

    def __init__(self, given: float | None, inner: bool, options: LeadOptions) -> None:
        self._given, self._options = given, options
        self._most = self._options.most_with_dynamics if inner else self._options.most
        self._spent: dict[str, deque[float]] = {
            kind: deque(maxlen=self._options.of) for kind in ("tick", "speed", "motion")
        }

    def took(self, kind: str, seconds: float) -> None:
        """Learn from the time, s, that one planning of this kind took."""
        self._spent[kind].append(seconds)

    def of(self, kind: str) -> float:
        """Lead time of a kind of planning, s."""
        if self._given is not None:
            return self._given
        options, spent = self._options, self._spent[kind]
        first = float(getattr(options, kind))
        return min(max(options.least, options.spare * max(spent) if spent else first), self._most)
