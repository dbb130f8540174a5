"""Extremes of a motion that a person can picture: tilt, turn, height, speed, clearance."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from salver.errors import Status
from salver.geometry import Array, lean
from salver.trajectory import MotionSamples

_WORTH, _LEVEL = 5e-3, 0.05  # m, deg: less is not said


@dataclass(frozen=True)
class Extent:
    """The extremes along a motion.

    lean: angle between the tray's normal and the vertical, rad. turn: of the heading of the tray (its x axis, seen from
    above) away from that at the start, rad. rise, sink: of the first object's frame B above and below both ends, m.
    speed: of B, m/s. nearest: of what stands around ("second") and what passes it ("first") the two that come nearest,
    their "distance", m, and the "time", s, of it; None where nothing stands around or no arm was planned.
    """

    lean: float
    turn: float
    rise: float
    sink: float
    speed: float
    nearest: Mapping[str, Any] | None

    @property
    def sentence(self) -> str:
        """In one line."""
        lean, turn = np.rad2deg([self.lean, self.turn])
        parts = [
            f"leans by up to {lean:.1f} deg" if lean > _LEVEL else "stays level",
            f"turns by up to {turn:.1f} deg" if turn > _LEVEL else "keeps its heading",
        ]
        if self.rise > _WORTH:
            parts.append(f"rises {self.rise:.2f} m above its ends")
        if self.sink > _WORTH:
            parts.append(f"sinks {self.sink:.2f} m below its ends")
        text = f"The tray {', '.join(parts)} and moves at up to {self.speed:.2f} m/s"
        if self.nearest is None:
            return f"{text}."
        near = "{first} passes {second} at {mm:.0f} mm (t = {time:.2f} s)"
        return f"{text}; {near.format(mm=1e3 * self.nearest['distance'], **self.nearest)}."

    def record(self) -> dict[str, Any]:
        """The record of plan.json: SI units, and the sentence."""
        return {**asdict(self), "sentence": self.sentence}


def extent(samples: MotionSamples, R_EB: Array, arm: Status | None) -> Extent:
    """The extremes of a motion of B.

    Args:
        samples: the motion of B in S, T instants.
        R_EB: (3, 3) orientation of B on the tray.
        arm: the verdict on the arm that follows (`salver.planning.follow.limits.verdict`), which knows distances.

    Returns:
        The most of each over the T instants.
    """
    R_SE = samples.R_SB @ R_EB.T
    heading = np.unwrap(np.arctan2(R_SE[:, 1, 0], R_SE[:, 0, 0]))
    z = samples.p_SB[:, 2]
    return Extent(
        lean=float(lean(R_SE).max()),
        turn=float(np.abs(heading - heading[0]).max()),
        rise=float(z.max() - max(z[0], z[-1])),
        sink=float(min(z[0], z[-1]) - z.min()),
        speed=float(np.linalg.norm(samples.v_S, axis=1).max()),
        nearest=None if arm is None else arm.details.get("obstacle_clearance"),
    )
