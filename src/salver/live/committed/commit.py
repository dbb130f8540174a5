"""Commits a motion that passes the verdict (`salver.planning.verdict.verify`), from the state in which the committed
motion is left."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from salver.live.committed.motion import Committed
from salver.live.committed.profile import SpeedProfile
from salver.live.committed.seal import seal_of
from salver.planning.trajopt.problem import TransportProblem
from salver.planning.verdict.judged import STANDARD, VerdictOptions
from salver.planning.verdict.verify import Verdict, verify
from salver.trajectory import JointMotion


@dataclass(frozen=True)
class Finding:
    """The result of judging a motion: the committed motion, or why it was refused. excess, what, slower: as in
    `Verdict`."""

    committed: Committed | None
    excess: float
    sentence: str
    what: str = ""
    slower: float = np.inf


def verified(
    problem: TransportProblem,
    motion: JointMotion,
    begins: float,
    before: Committed | None,
    options: VerdictOptions = STANDARD,
    *,
    thoroughly: bool = False,
    profile: SpeedProfile | None = None,
) -> Finding:
    """The verdict on a motion from live time `begins`, s, on that continues the one before (None: a long rest).
    thoroughly: as in `verify`. profile: its path and speed factor, for later changes of the speed; nothing here depends
    on it."""
    if before is None:
        found = verify(problem, motion, None, options, thoroughly=thoroughly)
    elif begins < before.begins:  # before its beginning the state of the one before is not known
        return Finding(None, np.inf, f"it begins {before.begins - begins:.3g} s before the motion that it continues")
    else:
        left = before.left(begins, problem)
        found = verify(left, motion, before.state(begins), options, thoroughly=thoroughly)
    if not found.ok:
        return Finding(None, found.excess, found.sentence, found.what, found.slower)
    committed = replace(committed_of(found, begins), profile=profile)
    return Finding(replace(committed, seal=seal_of(committed, before, problem)), found.excess, "")


def committed_of(found: Verdict, begins: float) -> Committed:
    """The committed motion, in live time, of a motion that passed the verdict, with the state in which it leaves arm
    and load."""
    judged, margins = found.judged, found.margins
    assert judged is not None
    assert margins is not None
    t = begins + judged.t
    loads = judged.along.left if judged.problem.cases else None
    nodes = t[: judged.last + 1]
    margins = replace(margins, t=t)
    return Committed(begins, judged.motion, nodes, judged.deviation, margins, loads, judged.off)
