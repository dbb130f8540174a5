"""The start of a live motion: the arm at rest, in a posture in which the load is safe."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from itertools import islice

import numpy as np
import numpy.typing as npt

from salver.errors import ScenarioError, UnreachableError
from salver.geometry import Array
from salver.live.committed.commit import verified
from salver.live.committed.motion import Committed, resting
from salver.live.replanning.wishes import Refused, numbers
from salver.planning.fastest import AtPosture, TransportProblem
from salver.planning.seeds.starts import standing_at
from salver.planning.trajopt.constraints.obstacles import KeepOut
from salver.scenario import Scenario

LOOKS = 8  # at postures at the scenario's start, when none is given


def live_scenario(scenario: Scenario) -> Scenario:
    """The scenario of live motions, which hold at every constant speed; with a liquid or pendulum at full speed
    only."""
    if scenario.payload.dynamic:
        return scenario.with_changes(motion__speeds="full")
    return scenario.with_changes(motion__speed_rate=0.0)


def standing(
    problem: TransportProblem, q: npt.ArrayLike | None, begins: float = 0.0
) -> tuple[TransportProblem, Committed]:
    """A committed motion at rest at q (n,), rad, from live time `begins`, s, on. Default of q: the scenario's start
    posture, or one at its start pose.

    Also returns the problem. Parts that are too near to each other there must keep half of their distance, as at a
    start posture that is given.

    Raises ScenarioError when the load is not safe there, UnreachableError when no posture reaches the pose.
    """
    name = problem.scenario.name
    begin, out, reasons = q, problem.keep_out, []
    if q is None and isinstance(problem.start, AtPosture):
        begin = problem.start.q
    postures: Iterable[Array] = islice(standing_at(problem, problem.start, np.random.default_rng(0)), LOOKS)
    if begin is not None:
        try:
            postures = [numbers(begin, (problem.n,), "q")]
        except Refused as reason:
            raise ScenarioError(f"{name}: {reason}.") from None
    for posture in postures:
        here = problem if out is None else replace(problem, keep_out=KeepOut.of(out.parts, posture[None]))
        found = verified(here, resting(posture), begins, None)
        if found.committed is not None:
            return here, found.committed
        reasons.append(found.sentence)
    if not reasons:
        raise UnreachableError(f"{name}: no posture reaches motion.start.")
    any_of = f"in any of {len(reasons)} postures " if len(reasons) > 1 else ""
    where = f"{any_of}at motion.start; in the first," if begin is None else "at q:"
    raise ScenarioError(f"{name}: the load is not safe at rest {where} {reasons[0]}.")
