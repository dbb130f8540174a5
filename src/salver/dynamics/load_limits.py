"""What the inner dynamics of a load must keep, and the verdict on it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from salver.dynamics.motion_gradients import Unknowns
from salver.errors import Status
from salver.geometry import Array, Indices
from salver.models.load_dynamics import LEAST_WEIGHT, LoadDynamics

LIGHTEST = 1 - LEAST_WEIGHT  # share of its weight that what moves inside may be relieved of
LIGHT = "the weight that may be taken away"  # group of that limit, in words


@dataclass(frozen=True, eq=False)
class LoadLimit:
    """One thing that a load may not exceed in any of K cases: values (K, T), or (K, 1) of what is left after the
    motion, are to be no larger than `most` (K,). by, bends: first derivatives (m, c) of values (m,) of cases at nodes
    by unknowns of the motion, and factors (m, k, c) of second ones: their squares summed over k. group: limits that a
    verdict names together.
    """

    name: str
    values: Array
    most: Array
    by: Callable[[Indices, Indices, Unknowns], Array]
    bends: Callable[[Indices, Indices, Unknowns], Array]
    group: str

    def left(self, instants: int) -> Array:
        """(K, T) of what is allowed the shares that are left, at so many instants; infinite where nothing is asked."""
        left = np.full((len(self.most), instants), np.inf)
        left[:, -self.values.shape[1] :] = 1 - self.values / self.most[:, None]
        return left


def of_end(derivative: Callable[[Indices, Unknowns], Array]) -> Callable[[Indices, Indices, Unknowns], Array]:
    """`LoadLimit.by` of what is left after the motion."""
    return lambda case, node, unknowns: derivative(case, unknowns)


@dataclass(frozen=True, eq=False)
class LoadVerdict:
    """How near what moves in one body comes to its limits, at its worst case.

    slack: (T,) the least of what is left, as shares of what is allowed; of each group of limits in `kept`. size: (T,)
    m, as of `LoadDynamics.edge`."""

    name: str
    inner: LoadDynamics
    t: Array
    slack: Array
    kept: dict[str, float]
    size: Array

    @classmethod
    def of(cls, name: str, inner: LoadDynamics, t: Array, limits: Sequence[LoadLimit], size: Array) -> LoadVerdict:
        """limits: of all parts."""
        count, left = len(t), dict[str, Array]()
        for limit in limits:
            own = limit.left(count).min(axis=0)
            left[limit.group] = np.minimum(left.get(limit.group, np.inf), own)
        least = {group: float(own.min()) for group, own in left.items()}
        return cls(name, inner, t, np.min(list(left.values()), axis=0), least, size)

    @property
    def room(self) -> float:
        """m that are left to its edge; infinite where nothing is in the way."""
        return float((self.inner.edge(self.inner.value) - self.size).min())

    def status(self, case: str = "") -> Status:
        """Whether it keeps its limits, in one sentence. case: words for the parameters."""
        k, group = int(np.argmin(self.slack)), min(self.kept, key=self.kept.__getitem__)
        first = int(np.argmax(self.slack < 0)) if self.slack[k] < 0 else k
        when: dict[str, Any] = {"interface": self.name, "time": float(self.t[first]), "left": self.kept[group]}
        share = 100 * abs(self.kept[group])
        if self.slack[k] < 0:
            sentence = (
                f"The {self.inner.noun} in {self.name} {case}exceeds {group} by {share:.2g} % at {self.t[k]:.3f} s"
            )
            return Status(self.inner.outcome, f"{sentence}, the first time at {when['time']:.3f} s.", False, when)
        return Status("holds", f"The {self.inner.noun} in {self.name} keeps {share:.2g} % of {group}.", True, when)
