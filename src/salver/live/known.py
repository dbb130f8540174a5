"""What was worked out when a motion was looked at, for a programme that bends it: the arm's terms and what a wrong load
does to the arm along what is committed are those that the verdict on it rests on."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from salver.geometry import Array, Mask
from salver.live.motion import Committed
from salver.planning.fastest import MotionEvaluation
from salver.planning.fastest.obstacles import KeepOut
from salver.sensitivity.arm.finer import Finer, Smooth
from salver.sensitivity.arm.liquids import Sloshing
from salver.sensitivity.arm.terms import MotionTerms

JUST_ENDED = 0.021  # s of rest, a tick, in which the arm gives way to waves about as it did when it came to rest


@dataclass(frozen=True, eq=False)
class Known:
    """Of a motion of its own time, s, to its end at rest: t (K,) instants at which its terms were worked out, ends (K,)
    which of them are knots, terms with derivatives. response: what a wrong load does to the arm, or None. keep_out:
    with the pairs that come near along it. sloshing: of all liquids, None without."""

    t: Array
    ends: Mask
    terms: MotionTerms
    response: Finer | None
    keep_out: KeepOut | None = None
    sloshing: Sloshing | None = None

    def along(self, motion: MotionEvaluation, own: Array) -> MotionEvaluation:
        """The same motion at other nodes, at own times (N,), with all this known; it rests after its end."""
        last = self.t[-1]
        onto = Smooth.onto(self.t, self.ends, np.minimum(own, last))
        terms = self.terms.continued(motion.at_nodes[:3], onto.each, derivatives=True)
        motion.feeling(terms)
        if self.response is not None:
            motion.straying(self.response.onto(terms, onto, own < last))
        if self.sloshing is not None and motion.past is not None:
            t = motion.shares * motion.duration
            motion.swinging(self.sloshing.onto(motion.liquids, t, terms.w, motion.past, onto.each))
        return motion

    def reaches(self, own: float) -> bool:
        """Whether it is known at an own time, s: at rest nothing changes any more, but for waves."""
        return self.sloshing is None or own <= self.t[-1] + JUST_ENDED


class Recent:
    """What was worked out for the motions that were committed last."""

    def __init__(self) -> None:
        self._found: deque[tuple[Committed, Known]] = deque(maxlen=2)

    def add(self, committed: Committed, known: Known) -> None:
        self._found.append((committed, known))

    def of(self, base: Committed) -> Known | None:
        """None when it is not one of them. It may have come back from another process."""
        for one, known in self._found:
            if one is base or (one.begins == base.begins and np.array_equal(one.motion.q, base.motion.q)):
                return known
        return None
