"""A commanded trajectory: waypoints with velocities, interpolated as by the robot's controller.

ros2_control's joint trajectory controller interpolates waypoints by cubics, or by quintics if they have accelerations.
So the motion is known exactly, except for what the file leaves open.
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import BPoly

from salver.geometry import Array
from salver.motion_files.samples import JointSamples


def commanded_motion(
    samples: JointSamples, fine: float = 2e-3, each: tuple[int, int] = (3, 64)
) -> tuple[Array, Array, Array, Array]:
    """t, q, dq, ddq of waypoints with velocities. Each waypoint is there twice, because the acceleration of cubics
    jumps at it.

    fine: s between instants. each: least and largest number of instants in a piece; 64 resolve a quintic to 0.1 %.
    """
    assert samples.dq is not None
    given = [samples.q, samples.dq, *([samples.ddq] if samples.ddq is not None else [])]
    curve = BPoly.from_derivatives(samples.t, np.stack(given, axis=1))
    step = np.diff(samples.t)
    parts = []
    for count in np.unique(counts := np.clip(np.ceil(step / fine), *each).astype(int)):
        k = np.flatnonzero(counts == count)
        inner = np.linspace(0, 1, count + 1)
        inner[0], inner[-1] = 1e-9, 1 - 1e-9
        parts.append((samples.t[k, None] + step[k, None] * inner).ravel())
    t = np.unique(np.clip(np.concatenate(parts), samples.t[0], samples.t[-1]))
    q, dq, ddq = (curve.derivative(k)(t) if k else curve(t) for k in range(3))
    return t, q, dq, ddq


def open_questions(samples: JointSamples, alike: float = 30.0, at_rest: float = 1e-3) -> list[tuple[str, str]]:
    """Doubts (code, sentence) about the motion that the controller will make of the file.

    alike: factor between velocities and differences of positions above which their units differ. at_rest: rad/s, above
    which an end is not at rest.
    """
    assert samples.dq is not None
    found = []
    step = np.diff(samples.t)
    moved = float(np.sum(np.abs(np.diff(samples.q, axis=0))))
    told = float(np.sum(0.5 * np.abs(samples.dq[1:] + samples.dq[:-1]) * step[:, None]))
    if told > 1e-3 and not told / alike < moved < told * alike:  # a stop at every waypoint tells nothing
        clause = (
            f"the velocities would move the joints by {told:.3g} rad in all, the positions by {moved:.3g} rad: the "
            "times are not in s, or the velocities not in rad/s"
        )
        found.append(("clock", clause))
    for end, k in (("starts", 0), ("ends", -1)):
        speed = float(np.abs(samples.dq[k]).max())
        if speed > at_rest:
            found.append(("speed", f"it {end} at {speed:.3g} rad/s, and how the arm comes to rest is not in it"))
    return found
