"""Margins of a committed motion by the name of each constraint, for the state of a live motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from salver.geometry import Array, Indices
from salver.models.arm.arm_limits import LIMITS
from salver.planning.trajopt.constraints.constraints import (
    Block,
    Clearance,
    JointLimit,
    LevelConstraint,
    TorqueLimit,
    TorqueRateLimit,
)
from salver.planning.trajopt.problem import TransportProblem


@dataclass(frozen=True, eq=False)
class ConstraintMargins:
    """Margins of a verified motion from its constraints.

    t: (N,) live time, s. row: (N,) the largest row there, as a share of what it limits, 0 at the constraint's
    boundary; what: (N,) which row, an index into names.
    """

    t: Array
    row: Array
    what: Indices
    names: tuple[str, ...]

    @classmethod
    def of(cls, blocks: Sequence[Block], t: Array, problem: TransportProblem) -> ConstraintMargins:
        """The largest row of some blocks at each of their points t (N,), and its name."""
        names: list[str] = []
        largest, what = np.full(len(t), -np.inf), np.zeros(len(t), dtype=np.intp)
        for block in blocks:
            if not block.values.size:
                continue
            value = block.values.max(axis=1)
            if isinstance(block.of, LevelConstraint) and np.all(value <= 0.0):
                continue  # a tray that has to stay level is always as near to that, and nothing is limited by it
            at = block.points[: len(value)]
            above = np.flatnonzero(value > largest[at])
            above = above[np.argsort(value[above])]  # several rows may be of one point
            if len(above):
                label = _labels(block, problem)
                row = np.argmax(block.values[above], axis=1) if len(label) > 1 else 0
                largest[at[above]], what[at[above]] = value[above], len(names) + row
                names += label
        if np.isneginf(largest).all():
            return cls(t, np.full(len(t), -1.0), what, ("nothing",))
        return cls(t, largest, what, tuple(names))

    def from_(self, t: float) -> tuple[float, str]:
        """Distance from the constraint that the motion comes nearest to from t on, and whose it is.

        What limits a motion is seldom what is near now: a joint that will be at its fastest a while ahead, perhaps.
        """
        first = min(int(np.searchsorted(self.t, t)), len(self.t) - 1)
        k = first + int(np.argmax(self.row[first:]))
        return -float(self.row[k]), self.names[int(self.what[k])]


def _labels(block: Block, problem: TransportProblem) -> Sequence[str]:
    """Names of a block's constraints: by joint if there is one for each, else by the pair that must keep apart."""
    if isinstance(block.of, Clearance):
        parts = block.of.keep_out.parts
        return [f"{block.name} of {parts.names[i]} from {parts.names[j]}" for i, j in parts.pairs]
    if isinstance(block.of, JointLimit | TorqueLimit | TorqueRateLimit):
        return _by_joint(block.of, block.name, problem.arm.joint_names)
    return [block.name]


@lru_cache(maxsize=64)
def _by_joint(constraint: JointLimit | TorqueLimit | TorqueRateLimit, name: str, joints: tuple[str, ...]) -> list[str]:
    """Names of rows either side of a limit."""
    kind = next(kind for kind in LIMITS if kind.name == name)
    finite = np.flatnonzero(np.isfinite(constraint.limits.range(kind)[1]))
    return [f"{name} of {joints[j]}" for j in (*finite, *finite)]
