"""Vibration of the tray in a log: what no model of the robot explains of its deviation from the plan, above noise.

The unexplained deviation moves the tray frame E by a displacement and a rotation. In windows of their spectrum, peaks
above `TrackingOptions.slowest_shake` count if white noise of the median power would hardly reach them, and if they
make a tenth of the window's largest acceleration or more. The vibration that is reported is at the highest of their
frequencies, with the sum of their accelerations, as `uncertainty.shake` bounds it.
"""

from __future__ import annotations

import numpy as np

from salver.geometry import Array
from salver.learning.tracking.executed import OPTIONS, Executed
from salver.models.uncertain.parameters import Vibration
from salver.sensitivity.arm.terms import MotionTerms


def vibration_of(done: Executed, terms: MotionTerms) -> Vibration | None:
    """The vibration of the tray along an executed motion with its terms; None if there is none beside noise."""
    moved = (terms.jacobian @ done.unexplained[:, :, None])[:, :, 0].reshape(-1, 2, 3)
    shift, turn = np.einsum("tij,tkj->kti", terms.R_SE, moved)
    (highest, pushed), (fastest, turned) = (_peaks(x, done.step, done.fastest) for x in (shift, turn))
    rate = 2 * np.pi * max(highest, fastest)
    if not rate:
        return None
    found = Vibration(pushed / rate**2, turned / rate**2, rate / (2 * np.pi))
    pushes = found.acceleration + OPTIONS.lever * found.angular_acceleration
    return found if pushes > OPTIONS.negligible else None


def _peaks(x: Array, step: float, fastest: float) -> tuple[float, float]:
    """The highest frequency, Hz, up to `fastest`, at which x (K, 3) oscillates above its noise, and the largest
    acceleration by oscillations, unit/s^2; 0 and 0 if there are none."""
    length = min(len(x), round(OPTIONS.window / step))
    window = np.hanning(length + 2)[1:-1]
    frames = np.lib.stride_tricks.sliding_window_view(x, length, axis=0)[:: max(1, length // 3)]
    power = np.sum(np.abs(np.fft.rfft(frames * window, axis=2)) ** 2, axis=1)  # (windows, frequencies)
    f = np.fft.rfftfreq(length, step)
    noise = np.median(power[:, 1:]) / np.log(2)  # mean of an exponential distribution
    least = -noise * np.log(OPTIONS.false_alarm / power.size)
    pushes = np.sqrt(power) / (0.5 * window.sum()) * (2 * np.pi * f) ** 2
    around = np.pad(power, ((0, 0), (1, 1)))
    peak = (power > around[:, :-2]) & (power >= around[:, 2:]) & (power > least)
    peak &= (f >= OPTIONS.slowest_shake) & (f <= fastest)
    pushes = np.where(peak, pushes, 0.0)
    pushes[pushes < 0.1 * pushes.max(axis=1, keepdims=True)] = 0.0
    return float(f[pushes.any(axis=0)].max(initial=0.0)), float(pushes.sum(axis=1).max())
