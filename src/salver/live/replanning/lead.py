"""How long before a hand-over planning begins: as long as it took of late, and a little more."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass


@dataclass(frozen=True)
class LeadOptions:
    """How a lead is learnt.

    Attributes:
        tick, speed, motion: s from the beginning of planning a tick, another speed or a whole motion to the hand-over,
            before it is known how long that takes.
        of: plans of late from whose times the lead is taken.
        spare: times the longest of them.
        least: s.
        most, most_with_dynamics: s.
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
    """s from the beginning of planning to the hand-over, by kind: given, or learnt from how long
    planning each takes. inner: where something moves inside a load."""

    def __init__(self, given: float | None, inner: bool, options: LeadOptions) -> None:
        self._given, self._options = given, options
        self._most = self._options.most_with_dynamics if inner else self._options.most
        self._spent: dict[str, deque[float]] = {
            kind: deque(maxlen=self._options.of) for kind in ("tick", "speed", "motion")
        }

    def took(self, kind: str, seconds: float) -> None:
        """Planning one took so long."""
        self._spent[kind].append(seconds)

    def of(self, kind: str) -> float:
        """s."""
        if self._given is not None:
            return self._given
        options, spent = self._options, self._spent[kind]
        first = float(getattr(options, kind))
        return min(max(options.least, options.spare * max(spent) if spent else first), self._most)
