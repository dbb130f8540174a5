"""How long before a hand-over planning begins: as long as it took of late, and a little more."""

from __future__ import annotations

from collections import deque

# s from the beginning of planning to the hand-over, before it is known how long planning takes.
FIRST = {"tick": 0.05, "motion": 0.25}
LEADS = 5  # plans from whose times the lead is taken
SPARE = 1.3  # of the longest of them
LEAST_LEAD, MOST_LEAD, MOST_LEAD_WET = 0.02, 1.0, 3.0  # s; with open liquids


class Lead:
    """s from the beginning of planning to the hand-over, of a tick or a whole motion: given, or learnt from how long
    planning each takes. wet: with open liquids."""

    def __init__(self, given: float | None, wet: bool) -> None:
        self._given, self._most = given, MOST_LEAD_WET if wet else MOST_LEAD
        self._spent: dict[str, deque[float]] = {kind: deque(maxlen=LEADS) for kind in FIRST}

    def took(self, kind: str, seconds: float) -> None:
        """Planning one took so long."""
        self._spent[kind].append(seconds)

    def of(self, kind: str) -> float:
        """s."""
        if self._given is not None:
            return self._given
        return min(max(LEAST_LEAD, SPARE * max(self._spent[kind], default=FIRST[kind] / SPARE)), self._most)
