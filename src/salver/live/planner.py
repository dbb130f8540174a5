"""One step of planning: what is asked and what was found. It knows no clock and no thread, so it may be made anywhere.

What it gives was verified (`salver.live.verify`); whoever asked decides whether it still comes in time.
"""

from __future__ import annotations

from dataclasses import dataclass

from salver.errors import Status
from salver.live.motion import Committed
from salver.live.replan import Replanner
from salver.live.steer import Steering
from salver.live.wishes import Follow, Halt, Wish, why_not
from salver.planning.fastest import Anywhere, TransportProblem


@dataclass(frozen=True, eq=False)
class Job:
    """wish: what for. base: what is committed; begins: live time, s, at which it may be left. budget: s."""

    wish: Wish
    base: Committed
    begins: float
    budget: float


@dataclass(frozen=True, eq=False)
class Answer:
    """found: a verified motion that goes on from the base, or None. done: the base fulfils the wish as well."""

    found: Committed | None
    status: Status
    done: bool = False


class Planner:
    """Answers jobs about one problem."""

    def __init__(self, problem: TransportProblem) -> None:
        self.problem = problem
        self._replanner = Replanner.of(problem)
        self._steering = Steering.of(problem, self._replanner.sought)

    def answer(self, job: Job) -> Answer:
        wish, base, begins = job.wish, job.base, job.begins
        if isinstance(wish, Follow):
            return Answer(*self._steering.tick(wish.wanted if begins <= wish.until else wish.then, base, begins))
        if isinstance(wish, Halt):
            found, status = self._replanner.to(Anywhere(), base, begins, job.budget)
            late = found is not None and found.ends >= base.ends  # it is at rest no later as it is
            return Answer(None if late else found, status, late)
        blocked = why_not(self.problem, wish)
        if blocked:
            return Answer(None, Status("unreachable", blocked, False))
        return Answer(*self._replanner.to(wish.end, base, begins, job.budget))
