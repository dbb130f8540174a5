"""How long before a hand-over planning begins: as long as it took of late, and a little more."""

from __future__ import annotations

from collections import deque

FIRST_LEAD = 0.25  # s from the beginning of planning to the hand-over, before it is known how long planning takes
FIRST_TICK = 0.05  # s, the same of a tick
LEADS = 5  # plans from whose times the lead is taken
SPARE = 1.3  # of the longest of them
LEAST_LEAD, MOST_LEAD, MOST_LEAD_WET = 0.02, 1.0, 3.0  # s; with open liquids


class Lead:
    """s from the beginning of planning to the hand-over, of motions and of ticks (steered): given, or learnt from how
    long planning takes. wet: with open liquids."""

    def __init__(self, given: float | None, wet: bool) -> None:
        self._given, self._most = given, MOST_LEAD_WET if wet else MOST_LEAD
        self._spent: dict[bool, deque[float]] = {steered: deque(maxlen=LEADS) for steered in (False, True)}

    def took(self, steered: bool, seconds: float) -> None:
        """Planning took so long."""
        self._spent[steered].append(seconds)

    def of(self, steered: bool) -> float:
        """s."""
        if self._given is not None:
            return self._given
        first = FIRST_TICK if steered else FIRST_LEAD
        return min(max(LEAST_LEAD, SPARE * max(self._spent[steered], default=first / SPARE)), self._most)
