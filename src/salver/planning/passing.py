"""Via poses: when, and at what distance, a given motion passes them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from salver.geometry import Array, log
from salver.trajectory import Reference

LEVER = 0.2  # m: lever arm that converts an orientation error to a distance; 5 mrad count as 1 mm
LOOKS, CLOSER = 401, 4  # instants per search, and the number of searches, each in a narrower interval


def passed(reference: Reference, poses: Sequence[tuple[Array, Array]], yaw_free: bool) -> list[tuple[float, float]]:
    """The instant, s, and the distance, m (orientation by `LEVER`), of the closest approach to each pose (p_SB,
    R_SB)."""
    found = []
    for pose in poses:
        low, high = 0.0, reference.duration
        for _ in range(CLOSER):
            t = np.linspace(low, high, LOOKS)
            samples = reference.sample(t)
            away = _distance(pose, samples.p_SB, samples.R_SB, yaw_free)
            best, step = int(np.argmin(away)), t[1] - t[0]
            low, high = max(0.0, t[best] - step), min(reference.duration, t[best] + step)
        found.append((float(t[best]), float(away[best])))
    return found


def _distance(pose: tuple[Array, Array], p_SB: Array, R_SB: Array, yaw_free: bool) -> Array:
    """Distances (T,), m, of a pose from the poses of a motion."""
    wanted, R_wanted = pose
    turn = log(np.swapaxes(R_SB, 1, 2) @ R_wanted)
    if yaw_free:
        turn = np.cross(R_SB[:, :, 2], R_wanted[:, 2])
    return np.hypot(np.linalg.norm(wanted - p_SB, axis=1), LEVER * np.linalg.norm(turn, axis=1))
