"""What was commanded of late, as one motion."""

from __future__ import annotations

import threading
from collections import deque

import numpy as np

from salver.live.committed.motion import SAME, between
from salver.trajectory import JointMotion


class Record:
    """The paths that were commanded, one after the other: the loop adds to it, whoever plans keeps it short.

    longest: s that are kept.
    """

    def __init__(self, longest: float) -> None:
        self.longest = longest
        self._taken: deque[tuple[float, JointMotion, float]] = deque()
        self._parts: deque[tuple[float, JointMotion]] = deque()
        self._folding = threading.Lock()

    def take(self, now: float, path: JointMotion, since: float) -> None:
        """From live time `now`, s, on a path is commanded whose own time 0 is live time `since`."""
        self._taken.append((now, path, since))

    def fold(self) -> None:
        """Keep of each path but the last what was commanded of it, and forget what is too long ago."""
        with self._folding:
            while len(self._taken) > 1:
                (now, path, since), (until, *_) = self._taken[0], self._taken[1]
                if until - now > SAME:
                    self._parts.append((now, between(path, now - since, until - since)))
                self._taken.popleft()
                while self._parts and self._parts[0][0] + self._parts[0][1].duration < until - self.longest:
                    self._parts.popleft()

    def motion(self, since: float, until: float) -> JointMotion | None:
        """The motion from one live time, s, to another, from time 0; as much of it as is kept, None for nothing."""
        self.fold()
        with self._folding:
            now, path, begun = self._taken[0]
            parts = [*self._parts, (now, between(path, now - begun, until - begun))]
        since = max(since, until - self.longest)
        parts = [(at, part) for at, part in parts if min(at + part.duration, until) - max(at, since) > SAME]
        if not parts:
            return None
        at, part = parts[0]
        if at < since - SAME:
            parts[0] = since, between(part, since - at, part.duration)
        t = np.concatenate([parts[0][0] + parts[0][1].t, *(at + part.t[1:] for at, part in parts[1:])])
        first, *later = (part for _, part in parts)
        states = (np.vstack([getattr(first, x), *(getattr(y, x)[1:] for y in later)]) for x in ("q", "dq", "ddq"))
        return JointMotion(t - t[0], *states)
