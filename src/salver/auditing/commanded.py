"""A commanded trajectory: waypoints with velocities, joined as the robot's controller joins them.

ros2_control's joint trajectory controller goes from waypoint to waypoint along cubics, or along quintics where the
waypoints have accelerations. Nothing is unknown then but what the file itself leaves open.
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import BPoly

from salver.geometry import Array
from salver.motion_files.samples import JointSamples

LONGEST, SHORTEST = 64, 3  # instants judged in one piece: a polynomial of degree five is met to 0.1 %
FINE = 2e-3  # s between instants, where that makes fewer
_ALIKE = 30.0  # factor between velocities and the steps of the positions, beyond which the units differ
_AT_SPEED = 1e-3  # rad/s


def commanded_motion(samples: JointSamples) -> tuple[Array, Array, Array, Array]:
    """(t, q, dq, ddq) of waypoints with velocities, both sides of every waypoint among the instants: the acceleration
    of cubics jumps there."""
    assert samples.dq is not None
    given = [samples.q, samples.dq, *([samples.ddq] if samples.ddq is not None else [])]
    curve = BPoly.from_derivatives(samples.t, np.stack(given, axis=1))
    step = np.diff(samples.t)
    parts = []
    for count in np.unique(counts := np.clip(np.ceil(step / FINE), SHORTEST, LONGEST).astype(int)):
        k = np.flatnonzero(counts == count)
        inner = np.linspace(0, 1, count + 1)
        inner[0], inner[-1] = 1e-9, 1 - 1e-9
        parts.append((samples.t[k, None] + step[k, None] * inner).ravel())
    t = np.unique(np.clip(np.concatenate(parts), samples.t[0], samples.t[-1]))
    q, dq, ddq = (curve.derivative(k)(t) if k else curve(t) for k in range(3))
    return t, q, dq, ddq


def open_questions(samples: JointSamples) -> list[tuple[str, str]]:
    """(code, sentence) of what the file does not say about what the controller will do."""
    assert samples.dq is not None
    found = []
    step = np.diff(samples.t)
    moved = float(np.sum(np.abs(np.diff(samples.q, axis=0))))
    told = float(np.sum(0.5 * np.abs(samples.dq[1:] + samples.dq[:-1]) * step[:, None]))
    if told > 1e-3 and not told / _ALIKE < moved < told * _ALIKE:  # a stop at every waypoint tells nothing
        clause = (
            f"the velocities would move the joints by {told:.3g} rad in all, the positions by {moved:.3g} rad: the "
            "times are not in s, or the velocities not in rad/s"
        )
        found.append(("clock", clause))
    for end, k in (("starts", 0), ("ends", -1)):
        speed = float(np.abs(samples.dq[k]).max())
        if speed > _AT_SPEED:
            found.append(("speed", f"it {end} at {speed:.3g} rad/s, and how the arm comes to rest is not in it"))
    return found
