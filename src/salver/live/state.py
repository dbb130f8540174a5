"""The state of a live motion, in words and figures."""

from __future__ import annotations

from dataclasses import dataclass

from salver.display import Shown
from salver.live.requests import Request

LIMITING = 0.03  # of what a row limits: nearer than this it is said to limit the motion


@dataclass(frozen=True)
class State(Shown):
    """The state of a live motion. doing: "resting", "following" or "stopping". rests_in: s until the arm is at rest.
    limit, margin: the constraint that comes nearest to its boundary from now to that rest, and its least distance from
    it, as a share of the limited quantity. refused: the last refused request, and why; clock: the fault of the times
    given to `command`; both are empty without one. lead: s from now to the next hand-over. passing: the expected
    passage of moving obstacles, when no motion that keeps clear of them was found. stopped: who stopped the arm, and
    why; empty without a latched stop. refusals: number of refused requests since the beginning. speed: a reduced speed
    or a hold, in words; empty at full speed. requests: the outcomes of the latest requests, the oldest first. granted:
    share, 0 to 1, of the requested twist or joint velocities that the arm is commanded to have now; 1 where none are
    requested. withheld: why it is less, in words; empty where it is not.
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
    granted: float = 1.0
    withheld: str = ""

    def facts(self) -> dict[str, str]:
        told = {"live": self.doing, "at rest in": f"{self.rests_in:.2f} s", "nearest limit": self.nearest}
        said = ("stopped", "speed", "refused", "passing", "withheld", "clock")
        return {**told, **{name: text for name in said if (text := getattr(self, name))}}

    @property
    def nearest(self) -> str:
        """The constraint that limits the motion; or, if none does, the nearest one and its distance, in words."""
        if self.margin < LIMITING:
            return f"limited by {self.limit}"
        return f"{100 * self.margin:.0f} % from its nearest limit, {self.limit}"

    def __str__(self) -> str:
        sentence = "The arm rests." if self.doing == "resting" else f"It is {self.doing}, {self.nearest}."
        said = (self.stopped, self.speed, self.passing, self.withheld, self.refused, self.clock)
        return " ".join([sentence, *filter(None, said)])
