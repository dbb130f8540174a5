"""What a motion file holds: joints, tray, object, sampled at the same instants, as far as they are known."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from salver.display import Outlined
from salver.geometry import Array
from salver.motion_files.samples import JointSamples, Samples

STOPS = "/salver/stops"  # topic of a bag


@dataclass(frozen=True, repr=False)
class MotionSeries(Outlined):
    """A motion at T instants; time in whole nanoseconds, so that t is exact in every format.

    ns (T,): int64, nanoseconds from the start. joint_names: n names, empty without joints; q, dq, ddq, tau (T, n).
    p_SE, quat_SE_wxyz: the tray. p_SB, quat_SB_wxyz, v_S, a_S, omega_B, alpha_B: the first object. What is not known
    is None. about: where it comes from, for the heading of a file. verdict: on the motion, one line, that begins with
    "UNSAFE: " when it fails; empty when there is none. stops: instants, ns, at which this motion may be left for
    another one to rest (of joints, from its own time 0): who is asked to stop takes the first that is left, or goes on
    to the end where none is.
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
        """(T,) s."""
        return self.ns * 1e-9

    @property
    def known(self) -> dict[str, Array]:
        """Arrays that there are, by name, in the order of the files."""
        values = {name: getattr(self, name) for name in QUANTITIES}
        return {name: value for name, value in values.items() if value is not None and value.shape[1]}

    @classmethod
    def of(cls, samples: Samples) -> MotionSeries:
        """What was read, to be written again."""
        ns: Any = np.round(samples.t * 1e9).astype(np.int64)
        if isinstance(samples, JointSamples):
            return cls(ns, samples.names, samples.q, samples.dq, samples.ddq, verdict=samples.verdict)
        if samples.frame == "B":
            return cls(ns, p_SB=samples.p, quat_SB_wxyz=samples.quat_wxyz, verdict=samples.verdict)
        return cls(ns, p_SE=samples.p, quat_SE_wxyz=samples.quat_wxyz, verdict=samples.verdict)


QUANTITIES = (
    "p_SE", "quat_SE_wxyz", "p_SB", "quat_SB_wxyz", "v_S", "a_S", "omega_B", "alpha_B", "q", "dq", "ddq", "tau",
)  # fmt: skip
