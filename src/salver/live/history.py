"""The most recent part of the commanded motion, as one motion."""

from __future__ import annotations

import threading
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np

from salver.errors import SalverError
from salver.live.committed.motion import SAME, between, joined
from salver.motion_files import MotionSeries, write
from salver.planning.fastest import TransportProblem
from salver.trajectory import JointMotion


class CommandHistory:
    """The commanded paths, one after the other: the loop adds to them, the planner keeps the list short.

    longest: s that are kept. now, path, since: the first path, as in `take`.
    """

    def __init__(self, longest: float, now: float, path: JointMotion, since: float) -> None:
        self.longest = longest
        self._taken = deque([(now, path, since)])
        self._parts: deque[tuple[float, JointMotion]] = deque()
        self._folding = threading.Lock()

    def take(self, now: float, path: JointMotion, since: float) -> None:
        """Note that from live time `now`, s, on a path is commanded; its own time 0 is live time `since`, s."""
        self._taken.append((now, path, since))

    def fold(self) -> None:
        """Shorten each path but the last to its commanded part, and drop paths that are older than `longest`."""
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
        return joined(*(part for _, part in parts))

    def save(self, path: str | Path, problem: TransportProblem, since: float, until: float, rate: float) -> list[Path]:
        """Write the motion from one live time, s, to another as files, with `rate` samples a second; see
        `Live.save`."""
        if not 1.0 <= rate <= 1e4:
            raise SalverError(f"rate is {rate:g}; it must be from 1 to 10000 samples a second.")
        motion = self.motion(since, until)
        if motion is None:
            raise SalverError(f"since is {since:g}; nothing was commanded after it, and up to now ({until:g} s).")
        ns: Any = np.round(1e9 * np.append(np.arange(0.0, motion.duration - 0.5 / rate, 1 / rate), motion.duration))
        names, states = problem.arm.joint_names, motion.sample(1e-9 * ns)
        return write(MotionSeries(ns.astype(np.int64), names, *states), path)
