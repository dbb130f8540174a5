"""Extremes of a motion that a person can picture: tilt, turn, height, speed, clearance."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from salver.errors import Status
from salver.geometry import GRAVITY_S, Array, lean
from salver.trajectory import MotionSamples


@dataclass(frozen=True)
class Extent:
    """The extremes along a motion.

    lean: largest angle between the tray's normal and the vertical, rad. turn: largest change of the tray's heading (its
    x axis, seen from above) since the start, rad. rise, sink: how far the origin of the first object's frame B goes
    above and below both of its ends, m. speed: largest speed of B, m/s. nearest: the moving part ("first") and the
    obstacle ("second") that come closest, with their "distance" (m) and its "time" (s); None without obstacles or
    without an arm. brim: how far a still surface rises at the wall of the widest cylinder that is carried as a solid,
    if it is an open cup, m: its radius times the largest slope of the specific force at B; None without such a
    cylinder, or if the tray drops away from it.
    """

    lean: float
    turn: float
    rise: float
    sink: float
    speed: float
    nearest: Mapping[str, Any] | None
    brim: float | None = None

    @property
    def sentence(self) -> str:
        """The extremes in one sentence, without those below 5 mm and 0.05 deg."""
        lean, turn = np.rad2deg([self.lean, self.turn])
        parts = [
            f"leans by up to {lean:.1f} deg" if lean > 0.05 else "stays level",
            f"turns by up to {turn:.1f} deg" if turn > 0.05 else "keeps its heading",
        ]
        if self.rise > 5e-3:
            parts.append(f"rises {self.rise:.2f} m above its ends")
        if self.sink > 5e-3:
            parts.append(f"sinks {self.sink:.2f} m below its ends")
        text = f"The tray {', '.join(parts)} and moves at up to {self.speed:.2f} m/s"
        if self.nearest is not None:
            near = "; {first} passes {second} at {mm:.0f} mm (t = {time:.2f} s)"
            text += near.format(mm=1e3 * self.nearest["distance"], **self.nearest)
        if self.brim is None:
            return f"{text}."
        below = f"{1e3 * self.brim:.0f} mm below its brim"
        return f"{text}. An open cup would spill if it were filled to less than {below}, sloshing not counted."

    def record(self) -> dict[str, Any]:
        """The extremes in SI units and the sentence, as plan.json stores them."""
        return {**asdict(self), "sentence": self.sentence}


def extent(samples: MotionSamples, R_EB: Array, arm: Status | None, radius: float | None = None) -> Extent:
    """The extremes of a motion of B.

    Args:
        samples: motion of the first object's frame B in S at T instants.
        R_EB: (3, 3) orientation of B on the tray.
        arm: verdict on the arm's motion (`salver.planning.follow.limits.verdict`), whose details have the distances.
        radius: of the widest cylinder or cone that is carried as a solid, at its top, m; None without one.

    Returns:
        The largest value of each quantity over the T instants.
    """
    R_SE = samples.R_SB @ R_EB.T
    heading = np.unwrap(np.arctan2(R_SE[:, 1, 0], R_SE[:, 0, 0]))
    z = samples.p_SB[:, 2]
    force = np.einsum("tji,tj->ti", R_SE, samples.a_S - GRAVITY_S)  # specific, in the tray's axes
    aside, up = np.hypot(force[:, 0], force[:, 1]), force[:, 2]
    return Extent(
        lean=float(lean(R_SE).max()),
        turn=float(np.abs(heading - heading[0]).max()),
        rise=float(z.max() - max(z[0], z[-1])),
        sink=float(min(z[0], z[-1]) - z.min()),
        speed=float(np.linalg.norm(samples.v_S, axis=1).max()),
        nearest=None if arm is None else arm.details.get("obstacle_clearance"),
        brim=None if radius is None or np.any(up <= 0.0) else radius * float((aside / up).max()),
    )
