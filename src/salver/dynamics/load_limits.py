"""Limits of load dynamics, and the verdict on them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from salver.dynamics.motion_gradients import Unknowns
from salver.errors import Status
from salver.geometry import Array, Indices
from salver.models.load_dynamics import LEAST_WEIGHT, LoadDynamics

LIGHTEST = 1 - LEAST_WEIGHT  # largest share by which the weight of the moving mass may be reduced
LIGHT = "the weight that may be taken away"  # group of that limit, in words


@dataclass(frozen=True, eq=False)
class LoadLimit:
    """A limit of load dynamics in K cases: values (K, T), or (K, 1) of the residual after the motion, must not exceed
    `most` (K,).

    by: returns the first derivatives (m, c) of m values, each at a case and a node, by the c unknowns of the motion.
    group: name of the limits that a verdict reports together.
    """

    name: str
    values: Array
    most: Array
    by: Callable[[Indices, Indices, Unknowns], Array]
    group: str

    def left(self, instants: int) -> Array:
        """Remaining shares (K, T) of the limit at T = `instants` instants; infinite where there is no limit."""
        left = np.full((len(self.most), instants), np.inf)
        left[:, -self.values.shape[1] :] = 1 - self.values / self.most[:, None]
        return left


def of_end(derivative: Callable[[Indices, Unknowns], Array]) -> Callable[[Indices, Indices, Unknowns], Array]:
    """`LoadLimit.by` for a residual after the motion."""
    return lambda case, node, unknowns: derivative(case, unknowns)


@dataclass(frozen=True, eq=False)
class LoadVerdict:
    """Verdict on one body's inner dynamics in the worst case.

    slack: (T,) least remaining share of all limits; kept: that of each group of limits. size: (T,) displacement, m,
    compared with `LoadDynamics.edge`."""

    name: str
    inner: LoadDynamics
    t: Array
    slack: Array
    kept: dict[str, float]
    size: Array

    @classmethod
    def of(cls, name: str, inner: LoadDynamics, t: Array, limits: Sequence[LoadLimit], size: Array) -> LoadVerdict:
        """The verdict from the limits of all parts."""
        count, left = len(t), dict[str, Array]()
        for limit in limits:
            own = limit.left(count).min(axis=0)
            left[limit.group] = np.minimum(left.get(limit.group, np.inf), own)
        least = {group: float(own.min()) for group, own in left.items()}
        return cls(name, inner, t, np.min(list(left.values()), axis=0), least, size)

    @property
    def room(self) -> float:
        """Remaining distance to its edge, m; infinite without one."""
        return float((self.inner.edge(self.inner.value) - self.size).min())

    def status(self, case: str = "") -> Status:
        """Whether the limits are met, in one sentence. case: words for the parameters."""
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
