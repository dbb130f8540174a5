"""The commanded motion, as the robot's loop reads it: the committed motion, and the hand-over to the next."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from pathlib import Path

from salver.geometry import Array
from salver.live.committed.motion import Committed
from salver.live.history import CommandHistory
from salver.live.options import LiveOptions
from salver.live.reader import Reader
from salver.live.replanning.lookout import Sighting
from salver.live.replanning.wishes import Halt, id_of
from salver.live.requests import Requests
from salver.live.running import Running
from salver.planning.fastest import TransportProblem
from salver.trajectory import JointMotion


class Commanded(ABC):
    """The commanded motion. The planner offers the next motion to the robot's loop, which alone decides whether it
    comes in time; neither waits for the other."""

    def __init__(self, options: LiveOptions, problem: TransportProblem, running: Running, reader: Reader) -> None:
        self.options, self._problem = options, problem
        # Written by the loop alone.
        self._running, self._reader = running, reader
        self._history = CommandHistory(options.record, 0.0, running.path, running.since)
        self._now = 0.0  # live time of the last command
        self._last: float | None = None  # the clock then
        self._clock = ""
        # Written by whoever plans or requests, taken by the loop.
        self._offer: Running | None = None
        self._halt: Running | None = None  # a stop that was ready
        # What is predicted to pass. Nothing but a stop is committed that was not looked at in the newest sighting.
        self._sighting = Sighting()
        self._requests = Requests()
        reader.read(0.0)

    @abstractmethod
    def _wanted(self, running: Running) -> bool:
        """Whether a motion may still be committed, as far as requests are concerned."""

    @abstractmethod
    def _lose_sight(self) -> None:
        """How loads move inside is not known any more."""

    def command(self, t: float) -> tuple[Array, Array, Array, Array]:
        """Return the command at time t, s, of any clock that advances. Never waits and never raises.

        Times that go back, stand still, jump by more than `LiveOptions.longest_gap` or are not finite do not move the
        arm: the motion continues from where it was when the clock does.

        Returns:
            q, dq, ddq (n,) in rad, and the torque (n,) in N m with the nominal load; the next call overwrites them.
        """
        reader = self._reader
        try:
            self._advance(t, reader)
        except Exception as error:  # what was commanded last stays commanded
            self._clock = f"A command failed ({type(error).__name__}); the arm kept what it was told last."
        return reader.q, reader.dq, reader.ddq, reader.tau

    def _advance(self, t: float, reader: Reader) -> None:
        """Read the command at time t, s, of the loop's clock."""
        if not math.isfinite(t):
            self._clock = "A time was no number; the arm kept what it was told last."
            return
        last, self._last = self._last, t
        if last is None:
            return
        if not 0.0 <= t - last <= self.options.longest_gap:
            self._clock = "The clock jumped; the motion went on from where it was."
            self._lose_sight()
            return
        now = self._now + (t - last)
        if offer := self._halt or self._offer:
            self._take_over(offer, now, reader)
        reader.read(now)
        self._now = now

    def _take_over(self, offer: Running, now: float, reader: Reader) -> None:
        """Command the offered motion from live time `now`, s, on, if it comes in time, serves the present request and
        keeps clear."""
        in_time = offer.after is self._running.committed and self._now <= offer.committed.begins
        wanted = in_time and self._wanted(offer)
        seen = isinstance(offer.wish, Halt) or offer.outlook.sighting is self._sighting
        if wanted and seen and offer.keeps_clear:
            reader.take(offer.pieces)
            self._running = offer
            self._history.take(now, offer.path, offer.since)
            self._requests.becomes(id_of(offer.wish), "followed")
        elif not in_time:
            self._requests.becomes(id_of(offer.wish), "late")
        if offer is self._halt:
            self._halt = None
        elif seen or not wanted:  # else it is being looked at
            self._offer = None

    def save(self, path: str | Path, *, since: float = 0.0, rate: float = 1000.0) -> list[Path]:
        """Write the motion that was commanded up to now as a motion file, which `salver audit` and `salver report`
        open.

        Args:
            path: ends in .csv, .json or .yaml, or in nothing (a ROS 2 bag); another file there is kept.
            since: live time, s, at which it begins; no more than `LiveOptions.record` s are kept.
            rate: samples a second; an audit of a fast motion needs 1000.

        Returns:
            The files. After `restart` or `load` the motion begins there.

        Raises:
            SalverError: nothing was commanded since then, the ending is another one, or the rate is not from 1 to
                10000.
        """
        return self._history.save(path, self._problem, since, self._now, rate)

    def commanded(self, since: float = 0.0) -> JointMotion | None:
        """The commanded motion from a live time, s, to now; as much of it as is kept, None for nothing."""
        return self._history.motion(since, self._now)

    @property
    def now(self) -> float:
        """Live time of the last command, s: the time of the loop's clock since its first command."""
        return self._now

    @property
    def committed(self) -> Committed:
        """The committed motion."""
        return self._running.committed

    @property
    def path(self) -> tuple[JointMotion, float]:
        """The path that is commanded from now to rest, and the live time at which it began, s."""
        return self._running.path, self._running.since

    @property
    def stray(self) -> Array:
        """(n,) rad, bound on each joint's deviation from the command under the uncertain set."""
        return self._running.allowed

    @property
    def problem(self) -> TransportProblem:
        """The constraints by which motions are judged."""
        return self._problem
