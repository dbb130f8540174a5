"""The content of a motion file: joints, tray and object at common instants."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

from salver.display import Outlined
from salver.geometry import Array

STOPS = "/salver/stops"  # topic of a bag


@dataclass(frozen=True, repr=False)
class MotionSeries(Outlined):
    """A motion at T instants; time in whole nanoseconds, so that t is exact in every format.

    ns (T,): int64, nanoseconds from the start. joint_names: n names, empty without joints; q, dq, ddq, tau (T, n).
    p_SE, quat_SE_wxyz: the tray. p_SB, quat_SB_wxyz, v_S, a_S, omega_B, alpha_B: the first object. Unknown quantities
    are None. about: scenario, arm and version, for the heading of a program. verdict: one line, which begins with
    "UNSAFE: " if the motion failed; empty without a verdict. stops: (instant in ns at which this motion may be left,
    motion of the joints to rest, with its own time from 0). After a stop request the next stop is taken, or the motion
    is finished if none is left.
    """

    ns: Array
    joint_names: tuple[str, ...] = ()
    q: Array | None = None
    dq: Array | None = None
    ddq: Array | None = None
    tau: Array | None = None
    p_SE: Array | None = None
    quat_SE_wxyz: Array | None = None
    p_SB: Array | None = None
    quat_SB_wxyz: Array | None = None
    v_S: Array | None = None
    a_S: Array | None = None
    omega_B: Array | None = None
    alpha_B: Array | None = None
    about: Mapping[str, Any] = field(default_factory=dict)
    verdict: str = ""
    stops: tuple[tuple[int, MotionSeries], ...] = ()

    @property
    def t(self) -> Array:
        """Times (T,), s."""
        return self.ns * 1e-9

    @classmethod
    def in_turn(cls, parts: Sequence[MotionSeries], pause: float, step: float) -> MotionSeries:
        """Several motions in sequence, of joints and tray only, because the first object changes between them.

        pause: s at rest between two motions, at least `step`, with a sample every `step`, s. If the motions have stops,
        a stop request during a pause prevents the next motion.
        """
        pause_ns, step_ns = round(max(pause, step) * 1e9), round(step * 1e9)
        names = [name for name in OF_ALL if all(getattr(part, name) is not None for part in parts)]
        ns, rows = parts[0].ns, {name: [getattr(parts[0], name)] for name in names}
        stops = list(parts[0].stops)
        for before, after in pairwise(parts):
            begins = ns[-1] + pause_ns
            still = np.arange(ns[-1] + step_ns, begins, step_ns)
            if (before.stops or after.stops) and before.q is not None:
                q = np.repeat(before.q[-1:], 2, axis=0)
                stay = cls(np.array([0, step_ns]), before.joint_names, q, 0.0 * q, 0.0 * q)
                stops += [(int(ns[-1]), stay), (int(begins), stay)]
            stops += [(int(begins) + leave, stop) for leave, stop in after.stops]
            ns = np.concatenate([ns, still, begins + after.ns - after.ns[0]])
            for name in names:
                last = getattr(before, name)[-1:] * (0.0 if name in RATES else 1.0)
                rows[name] += [np.repeat(last, len(still), axis=0), getattr(after, name)]
        joined: dict[str, Any] = {name: np.concatenate(values) for name, values in rows.items()}
        return cls(ns, parts[0].joint_names, **joined, stops=tuple(stops))


RATES = ("dq", "ddq")
OF_JOINTS = ("q", *RATES, "tau")
OF_ALL = ("p_SE", "quat_SE_wxyz", *OF_JOINTS)
QUANTITIES = (*OF_ALL[:2], "p_SB", "quat_SB_wxyz", "v_S", "a_S", "omega_B", "alpha_B", *OF_JOINTS)  # in a table's order
