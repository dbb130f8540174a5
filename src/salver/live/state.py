"""What a live motion says of itself."""

from __future__ import annotations

from dataclasses import dataclass

from salver.display import Shown
from salver.live.requests import Request

LIMITING = 0.03  # of what a row limits: nearer than this it is said to limit the motion


@dataclass(frozen=True)
class State(Shown):
    """What is going on. doing: "resting", "following" or "stopping". rests_in: s until the arm is at rest. limit: which
    row comes nearest to its edge from now to that rest, and margin, how far from it at least, as a share of what it
    limits. refused: the last wish that was not granted, and why; clock: what was wrong with the times that were asked
    for. Both are empty when nothing was. lead: s from now to the next hand-over. passing: what is to be expected of
    obstacles that move, when nothing was found that keeps clear of them. stopped: by whom and why, while a stop is
    latched; empty when none is. refusals: requests that were refused since the beginning. speed: that goals are gone
    to slower, or the arm is held; empty at full speed. requests: what became of each of late, the oldest
    first.
    """

    doing: str
    rests_in: float
    limit: str
    margin: float
    refused: str
    clock: str
    lead: float
    passing: str = ""
    stopped: str = ""
    refusals: int = 0
    speed: str = ""
    requests: tuple[Request, ...] = ()

    def facts(self) -> dict[str, str]:
        told = {"live": self.doing, "at rest in": f"{self.rests_in:.2f} s", "nearest limit": self.nearest}
        said = ("stopped", "speed", "refused", "passing", "clock")
        return {**told, **{name: text for name in said if (text := getattr(self, name))}}

    @property
    def nearest(self) -> str:
        """What limits the motion; or, when nothing does, what would first, and how far that is."""
        if self.margin < LIMITING:
            return f"limited by {self.limit}"
        return f"{100 * self.margin:.0f} % from its nearest limit, {self.limit}"

    def __str__(self) -> str:
        sentence = "The arm rests." if self.doing == "resting" else f"It is {self.doing}, {self.nearest}."
        return " ".join([sentence, *filter(None, (self.stopped, self.speed, self.passing, self.refused, self.clock))])
