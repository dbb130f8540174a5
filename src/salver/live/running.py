"""What the robot's loop is told, from now to rest: a committed motion, with what leads to it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from salver.geometry import Array
from salver.live.motion import Committed, between, joined
from salver.live.reader import Pieces
from salver.live.wishes import Wish
from salver.planning.fastest import TransportProblem
from salver.trajectory import JointMotion


@dataclass(frozen=True, eq=False)
class Running:
    """A committed motion with what leads to it: path, from live time `since` on. after: what it replaces from its
    beginning on. wish: what it is for. stray: (n,) rad, the most by which each joint may be off the committed motion
    under the uncertain set; allowed: the same of all of the path."""

    committed: Committed
    path: JointMotion
    since: float
    pieces: Pieces
    stray: Array
    allowed: Array
    after: Committed | None = None
    wish: Wish | None = None

    @classmethod
    def first(cls, rest: Committed, problem: TransportProblem) -> Running:
        """An arm that rests there."""
        stray = rest.stray(problem)
        return cls(rest, rest.motion, rest.begins, Pieces(rest.motion, rest.begins), stray, stray)

    def then(self, found: Committed, wish: Wish, now: float, problem: TransportProblem) -> Running:
        """This until the beginning of another committed motion, and then that one; what is over is forgotten."""
        first = self.path.t[max(int(np.searchsorted(self.path.t, now - self.since, side="right")) - 1, 0)]
        path = joined(between(self.path, float(first), found.begins - self.since), found.motion)
        since, stray = self.since + float(first), found.stray(problem)
        allowed = np.maximum(stray, self.stray if self.committed.begins <= now else self.allowed)
        return Running(found, path, since, Pieces(path, since), stray, allowed, self.committed, wish)
