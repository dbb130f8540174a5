"""The load-safe stops of a plan: which one is taken after a stop request, and the resulting motion."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from salver.display import Shown
from salver.errors import FileFormatError
from salver.geometry import Array
from salver.trajectory import JointMotion

SAME = 1e-9  # s; instants closer than this count as equal
_ARRAYS = ("t", "duration", "s", "q", "dq", "ddq", "stray")


@dataclass(frozen=True)
class StopCourse:
    """The motion after a stop request: the plan until `leaves`, s, then stop number `stop` of the library; with stop
    None, the plan to its end. rests: when the arm is at rest, s."""

    leaves: float
    stop: int | None
    rests: float


@dataclass(frozen=True, eq=False, repr=False)
class StopLibrary(Shown):
    """K load-safe stops of a plan.

    t: (K,) increasing instants, s, at which they leave the plan. duration: (K,) of each stop, s. s: (M,) instants of
    the samples, as shares of the duration, from 0 to 1. q, dq, ddq: (K, M, n) rad, rad/s, rad/s^2. stray: (K + 1, n)
    largest deviation of each joint under the uncertain set, rad, up to the end of each stop and of the whole plan. end:
    when the plan itself is at rest, s.
    """

    t: Array
    duration: Array
    s: Array
    q: Array
    dq: Array
    ddq: Array
    stray: Array
    end: float

    def course(self, now: float) -> StopCourse:
        """The motion that comes to rest first after a stop request at `now`, s of the plan's time."""
        if now <= 0:
            return StopCourse(now, None, now)  # at rest where the plan would begin
        ahead = np.flatnonzero(self.t >= now - SAME)
        if len(ahead):
            k = int(ahead[np.argmin(self.t[ahead] + self.duration[ahead])])
            if (rests := float(self.t[k] + self.duration[k])) < self.end:
                return StopCourse(float(self.t[k]), k, rests)
        return StopCourse(max(now, self.end), None, max(now, self.end))

    @cached_property
    def taken(self) -> tuple[int, ...]:
        """The stops that are at rest first for some request, by time: a request leads to the next of them, or to the
        end of the plan after the last."""
        return tuple(k for k, now in enumerate(self.t) if self.course(float(now)).stop == k)

    @cached_property
    def _instants(self) -> Array:
        """Instants, s, just after which another course becomes the first at rest."""
        changes = np.concatenate([[SAME], self.t + 2 * SAME])
        return changes[changes < self.end]

    @property
    def longest(self) -> float:
        """Longest time from a stop request to rest, s. It occurs just after one of the instants, when the next one must
        be awaited."""
        return max(self.course(float(now)).rests - float(now) for now in self._instants)

    @property
    def finishing(self) -> float:
        """When, s, the end of the plan becomes the earliest rest; `end` if never."""
        return next((float(now) for now in self._instants if self.course(float(now)).stop is None), self.end)

    def motion(self, k: int) -> JointMotion:
        """The motion of stop k, from its own time 0."""
        return JointMotion(self.s * self.duration[k], self.q[k], self.dq[k], self.ddq[k])

    def stopped(self, plan: JointMotion, now: float) -> JointMotion:
        """The motion after a stop request at `now` > 0, s: the plan up to the best stop, and that stop."""
        course = self.course(now)
        return plan if course.stop is None else self.after(plan, course.stop)

    def after(self, plan: JointMotion, k: int) -> JointMotion:
        """The motion of the plan up to the instant at which stop k leaves it, and then of that stop."""
        before, stop = plan.t[plan.t < self.t[k] - SAME], self.motion(k)
        t = np.concatenate([before, self.t[k] + stop.t])
        states = (np.vstack([a, b]) for a, b in zip(plan.sample(before), (stop.q, stop.dq, stop.ddq), strict=True))
        return JointMotion(t, *states)

    def facts(self) -> dict[str, str]:
        """Facts that a notebook shows."""
        return {"stops": str(len(self.t)), "longest": f"{self.longest:.3g} s"}

    @property
    def sentence(self) -> str:
        if not len(self.t):
            return f"No stop is sooner at rest than the plan: it can only be finished, within {self.end:.2f} s."
        last = (
            f"; from {self.finishing:.2f} s on only by finishing, within {self.end - self.finishing:.2f} s"
            if self.end - self.finishing > SAME
            else ""
        )
        return (
            f"It can be stopped at any time within {self.longest:.2f} s with the load in place, by one of "
            f"{len(self.t)} planned stops{last}."
        )

    def arrays(self) -> dict[str, Array]:
        """The arrays of `plan.npz`."""
        return {f"stop_{name}": getattr(self, name) for name in _ARRAYS}

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, Array], end: float) -> StopLibrary | None:
        """The stops in the arrays of a plan file; None if it has none. Raises FileFormatError when arrays are
        missing."""
        if "stop_t" not in arrays:
            return None
        missing = [f"stop_{name}" for name in _ARRAYS if f"stop_{name}" not in arrays]
        if missing:
            raise FileFormatError(f"The plan's stops lack the array {missing[0]}; plan again with --stops.")
        return cls(**{name: arrays[f"stop_{name}"] for name in _ARRAYS}, end=end)
