"""The command from now to rest: a committed motion, with the motion that leads to it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from salver.geometry import Array
from salver.live.committed.motion import Committed, between, joined
from salver.live.reader import Pieces
from salver.live.replanning.lookout import Outlook, Path, Sighting
from salver.live.replanning.wishes import Wish
from salver.planning.fastest import TransportProblem
from salver.trajectory import JointMotion


@dataclass(eq=False)
class Running:
    """A path: a committed motion with the motion that leads to it. after: the motion that it replaces from its
    beginning on. wish: the request that it serves. stray: (n,) rad, largest deviation of each joint from the committed
    motion under the uncertain set; allowed: that of the whole path. outlook: its clearance from moving obstacles at the
    latest sighting. resigned: whether it is commanded although it may not keep clear, as a stop or a first step of an
    evasion."""

    committed: Committed
    looked: Path
    pieces: Pieces
    stray: Array
    allowed: Array
    after: Committed | None = None
    wish: Wish | None = None
    outlook: Outlook = field(default_factory=lambda: Outlook(Sighting()))
    resigned: bool = False

    @classmethod
    def first(cls, rest: Committed, problem: TransportProblem) -> Running:
        """The path of an arm that rests."""
        stray = rest.stray(problem)
        looked = Path(rest.motion, rest.begins, rest.nodes, rest.off)
        return cls(rest, looked, Pieces(rest.motion, rest.begins), stray, stray)

    def then(self, found: Committed, wish: Wish, now: float, problem: TransportProblem) -> Running:
        """This path until the beginning of another committed motion, and then that motion; finished parts are
        dropped."""
        before, since = self.path, self.since
        first = float(before.t[max(int(np.searchsorted(before.t, now - since, side="right")) - 1, 0)])
        path = joined(between(before, first, found.begins - since), found.motion)
        since, stray = since + first, found.stray(problem)
        allowed = np.maximum(stray, self.stray if self.committed.begins <= now else self.allowed)
        t, off = self.looked.t, self.looked.off
        some = (t >= since) & (t < found.begins)
        looked = Path(path, since, np.append(t[some], found.nodes), np.append(off[some], found.off))
        return Running(found, looked, Pieces(path, since), stray, allowed, self.committed, wish)

    @property
    def keeps_clear(self) -> bool:
        """Whether moving obstacles allow committing it."""
        return self.resigned or self.outlook.clear

    @property
    def path(self) -> JointMotion:
        """The commanded path from live time `since`, s, on."""
        return self.looked.motion

    @property
    def since(self) -> float:
        return self.looked.since
