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
    """A committed motion with what leads to it: a path. after: what it replaces from its beginning on. wish: what it is
    for. stray: (n,) rad, the most by which each joint may be off the committed motion under the uncertain set; allowed:
    that of all of the path. outlook: whether it keeps clear of what passes, as of one sighting; anew with each.
    resigned: it is to be done though it may not keep clear: a stop, or a first step out of the way of what passes."""

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
        """An arm that rests there."""
        stray = rest.stray(problem)
        looked = Path(rest.motion, rest.begins, rest.nodes, rest.off)
        return cls(rest, looked, Pieces(rest.motion, rest.begins), stray, stray)

    def then(self, found: Committed, wish: Wish, now: float, problem: TransportProblem) -> Running:
        """This until the beginning of another committed motion, and then that one; what is over is forgotten."""
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
        """Whether it may be committed, as far as what passes is concerned."""
        return self.resigned or self.outlook.clear

    @property
    def path(self) -> JointMotion:
        """From live time `since` on."""
        return self.looked.motion

    @property
    def since(self) -> float:
        return self.looked.since
