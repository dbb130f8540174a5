"""The outcomes of requests."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

KEPT = 200  # latest requests whose outcomes are kept; at most half of them can be open
Outcome = Literal["accepted", "late", "followed", "reached", "dropped"]


@dataclass(frozen=True)
class Request:
    """An accepted request.

    Attributes:
        id: its number, which the Status that accepted it names.
        what: the request in words.
        outcome: "accepted": no motion towards it yet. "late": a motion towards it came too late, another is planned.
            "followed": the robot's loop took a verified motion towards it, the last outcome of a twist. "reached": the
            arm rests at the goal. "dropped": it is not, or no longer, carried out.
        why: reason why it was dropped; empty otherwise.
    """

    id: int
    what: str
    outcome: Outcome = "accepted"
    why: str = ""

    def __str__(self) -> str:
        return f"Request {self.id} ({self.what}): {self.outcome}{f', {self.why}' if self.why else ''}."


class Requests:
    """The latest requests by their numbers, from 1 on."""

    def __init__(self) -> None:
        self._each: dict[int, Request] = {}
        self._last = 0

    def new(self, what: str) -> int:
        """The number of another request."""
        self._last += 1
        self._each[self._last] = Request(self._last, what)
        self._each.pop(self._last - KEPT, None)
        return self._last

    def becomes(self, number: int, outcome: Outcome, why: str = "") -> None:
        """Change the outcome of a request. A final outcome stays, and "followed" does not become "late"; number 0 is no
        request."""
        request = self._each.get(number)
        over = ("reached", "dropped") if outcome != "late" else ("reached", "dropped", "followed")
        if request is not None and request.outcome not in over:
            self._each[number] = replace(request, outcome=outcome, why=why)

    def ended(self, number: int, why: str) -> None:
        """End twists and chunks: they are dropped unless they were followed."""
        request = self._each.get(number)
        if request is not None and request.outcome != "followed":
            self.becomes(number, "dropped", why)

    @property
    def each(self) -> tuple[Request, ...]:
        """The requests in the order in which they came."""
        return tuple(self._each.values())
