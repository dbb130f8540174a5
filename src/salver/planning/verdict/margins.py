"""Margins of a committed motion by constraint name, for the state of a live motion."""

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
    """Margins of a verified motion.

    t: (N,) live time, s. row: (N,) the largest row there, as a share of its limit, 0 at the limit. what: (N,) its
    index in `names`.
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
                continue  # a level tray is always at this limit, which says nothing
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
        """The least margin from time t on, and the name of its constraint.

        Later instants count because what limits a motion, such as a joint's top speed, is often still ahead.
        """
        first = min(int(np.searchsorted(self.t, t)), len(self.t) - 1)
        k = first + int(np.argmax(self.row[first:]))
        return -float(self.row[k]), self.names[int(self.what[k])]


def _labels(block: Block, problem: TransportProblem) -> Sequence[str]:
    """Names of a block's rows: by joint if there is one for each, else by pair of parts."""
    if isinstance(block.of, Clearance):
        parts = block.of.keep_out.parts
        return [f"{block.name} of {parts.names[i]} from {parts.names[j]}" for i, j in parts.pairs]
    if isinstance(block.of, JointLimit | TorqueLimit | TorqueRateLimit):
        return _by_joint(block.of, block.name, problem.arm.joint_names)
    return [block.name]


@lru_cache(maxsize=64)
def _by_joint(constraint: JointLimit | TorqueLimit | TorqueRateLimit, name: str, joints: tuple[str, ...]) -> list[str]:
    """Names of the rows of both sides of a limit."""
    kind = next(kind for kind in LIMITS if kind.name == name)
    finite = np.flatnonzero(np.isfinite(constraint.limits.range(kind)[1]))
    return [f"{name} of {joints[j]}" for j in (*finite, *finite)]
