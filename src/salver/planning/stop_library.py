"""The load-safe stops that a plan carries: which one is taken when, and what is then moved."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from salver.display import Shown
from salver.geometry import Array
from salver.trajectory import JointMotion

SAME = 1e-9  # s; instants nearer than this are one


@dataclass(frozen=True, eq=False, repr=False)
class StopLibrary(Shown):
    """K stops. t: (K,) instants of the plan, s, increasing. duration: (K,) of each stop, s. s: (M,) from 0 to 1, its
    samples' shares of that. q, dq, ddq: (K, M, n) rad, rad/s, rad/s^2.

    end: s, when the plan itself is at rest.
    """

    t: Array
    duration: Array
    s: Array
    q: Array
    dq: Array
    ddq: Array
    end: float

    def best(self, now: float) -> int | None:
        """Index of the stop that is at rest first, of those whose instant is not before `now`; None: finish."""
        ahead = np.flatnonzero(self.t >= now - SAME)
        if not len(ahead):
            return None
        k = int(ahead[np.argmin(self.t[ahead] + self.duration[ahead])])
        return k if self.t[k] + self.duration[k] < self.end else None

    def rests_at(self, now: float) -> float:
        """When the arm is at rest if a stop is asked for at `now`, s of the plan's time."""
        k = self.best(now)
        return self.end if k is None else float(self.t[k] + self.duration[k])

    @property
    def longest(self) -> float:
        """The most that a stop takes, s, whenever it is asked for.

        Just after an instant the next one must be waited for, so it is enough to look there.
        """
        instants = np.concatenate([[0.0], self.t + 2 * SAME])
        return max(self.rests_at(float(now)) - float(now) for now in instants[instants < self.end])

    def motion(self, k: int) -> JointMotion:
        """Stop k, from its own time 0."""
        return JointMotion(self.s * self.duration[k], self.q[k], self.dq[k], self.ddq[k])

    def stopped(self, plan: JointMotion, now: float) -> JointMotion:
        """What is moved when a stop is asked for at `now`: the plan to the instant of the best stop, and that stop."""
        k = self.best(now)
        if k is None:
            return plan
        before = plan.t[plan.t < self.t[k] - SAME]
        stop = self.motion(k)
        t = np.concatenate([before, self.t[k] + stop.t])
        states = (np.vstack([a, b]) for a, b in zip(plan.sample(before), (stop.q, stop.dq, stop.ddq), strict=True))
        return JointMotion(t, *states)

    def facts(self) -> dict[str, str]:
        """What a notebook shows of it."""
        return {"stops": str(len(self.t)), "longest": f"{self.longest:.3g} s"}

    @property
    def sentence(self) -> str:
        return (
            f"It can be stopped at any time within {self.longest:.2f} s with the load in place, by one of "
            f"{len(self.t)} planned stops or by finishing."
        )

    def arrays(self) -> dict[str, Array]:
        """As `plan.npz` holds them."""
        return {f"stop_{name}": getattr(self, name) for name in ("t", "duration", "s", "q", "dq", "ddq")}

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, Array], end: float) -> StopLibrary | None:
        """From the arrays of a plan file; None when it has no stops."""
        if "stop_t" not in arrays:
            return None
        t, duration, s, q, dq, ddq = (arrays[f"stop_{name}"] for name in ("t", "duration", "s", "q", "dq", "ddq"))
        return cls(t, duration, s, q, dq, ddq, end)
