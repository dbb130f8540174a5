"""Bounds of the slip by vibration that a recording does not show.

A vibration of amplitude A and frequency f, on top of a motion with the reserve r (m/s^2, acceleration in any direction
at which the load still holds), slides a load only if its acceleration a = A (2 pi f)^2 exceeds r, and then by at most
2 pi A (1 - r / a)^2 in each cycle: the sliding block of Newmark (Effects of earthquakes on dams and embankments,
Geotechnique 15, 1965) under a sine, to a quarter (`test_audit_slip.py` checks the bound). So vibration that noise
hides is judged by the slip that it could cause.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from salver.auditing.motion import AuditedMotion
from salver.auditing.recorded import LEVER
from salver.geometry import Array


@dataclass(frozen=True)
class Slip:
    """The largest slip (m), by a vibration of `frequency` (Hz) and `amplitude` (m) around `time` (s)."""

    distance: float
    frequency: float
    amplitude: float
    time: float


def per_cycle(amplitude: Array | float, frequency: Array | float, reserve: Array) -> Array:
    """Bound of the slip in one cycle to one side, m; reserve: m/s^2, to this side."""
    share = np.clip(reserve / np.maximum(amplitude * (2 * np.pi * frequency) ** 2, 1e-300), 0, 1)
    return np.asarray(2 * np.pi * amplitude * (1 - share) ** 2)


def slide(t: Array, reserve: Array) -> float:
    """Slip (m) by the motion itself: Newmark's block, which accelerates while the reserve is negative and decelerates
    afterwards, always to one side."""
    speed = moved = 0.0
    step = np.diff(t)
    if not (reserve < 0).any():
        return 0.0
    for k in range(int(np.argmax(reserve < 0)), len(step)):
        if speed > 0 or reserve[k] < 0:
            speed = max(0.0, speed - step[k] * float(reserve[k]))
            moved += speed * step[k]
    return moved


def _drift(amplitude: Array | float, frequency: Array | float, reserve: Array, rest: float) -> Array:
    """In one cycle of a vibration, m (2, ...): the slip to one side, and that slip less the slip back. The reserve of
    acceleration on the other side is 2 rest - reserve. rest: reserve at rest, m/s^2."""
    there = per_cycle(amplitude, frequency, reserve)
    back = per_cycle(amplitude, frequency, 2 * rest - reserve)
    return np.stack([there, np.maximum(there - back, 0.0)])


def hidden_shakes(motion: AuditedMotion, frequencies: Array) -> Iterator[tuple[float, float, float]]:
    """Frequency (Hz), cycles, and amplitude over the noise, of vibrations that noise just hides; a longer window hides
    less. frequencies: Hz, up to the highest that is considered."""
    assert motion.recording is not None
    for frequency in frequencies:
        cycles = 1.0
        while True:
            share = motion.options.hideable * np.sqrt(2 * frequency / (motion.recording.rate * cycles))
            yield float(frequency), cycles, float(share)
            if cycles / frequency > np.ptp(motion.samples.t):
                break
            cycles *= 2


def up_to(highest: float, count: int) -> Array:
    """Frequencies (count,) up to `highest`, Hz, evenly spaced in the logarithm."""
    return np.geomspace(min(1.0, highest), highest, count)


def hidden(motion: AuditedMotion, reserve: Array, rest: float) -> tuple[Slip, float]:
    """The largest slip by a vibration that noise or resolution hides, of any frequency up to the highest.

    Also returns the frequency up to which that slip is acceptable, Hz. reserve: (T,) m/s^2 along the motion. rest: the
    reserve at rest on a level tray.
    """
    assert motion.recording is not None
    t, sensor, highest = motion.samples.t, motion.recording.sensor, motion.options.highest
    grid = max(0.01, np.ptp(t) / 20_000)
    edges = np.arange(t[0], t[-1] + grid, grid)
    least = np.full(max(1, len(edges) - 1), np.inf)
    np.minimum.at(least, np.clip(((t - t[0]) / grid).astype(int), 0, len(least) - 1), reserve)
    empty = np.flatnonzero(np.isinf(least))
    least[empty] = np.interp(edges[empty], t, reserve)
    blur = np.hypot(sensor.position.blur, 2 * LEVER * sensor.orientation.blur)
    worst, harmful = Slip(0.0, highest, 0.0, float(t[0])), np.inf
    frequencies = up_to(highest, 16)
    for frequency, cycles, share in hidden_shakes(motion, frequencies):
        amplitude = max(share * sensor.displacement, float(blur))
        window = max(1, min(len(least), round(cycles / frequency / grid)))
        passed = np.cumsum(np.pad(_drift(amplitude, frequency, least, rest), ((0, 0), (1, 0))), axis=1)
        there, more = (passed[:, window:] - passed[:, :-window]) * cycles / window
        over = np.minimum(there, more + there * min(1.0, 2 / cycles))  # within two cycles it settles to the net slip
        k = int(np.argmax(over))
        if over[k] > motion.options.hidden:
            harmful = min(harmful, frequency)
        if over[k] > worst.distance:
            worst = Slip(float(over[k]), frequency, amplitude, float(edges[k] + 0.5 * window * grid))
    return worst, float(max(frequencies[frequencies < harmful], default=0.0))


def left_over(motion: AuditedMotion, reserve: Array, rest: float) -> Slip:
    """The slip by oscillations above the noise that the motion does not include, each window by its main frequency."""
    assert motion.recording is not None
    t = motion.samples.t
    worst = Slip(0.0, 0.0, 0.0, float(t[0]))
    for found in motion.recording.unseen:
        first = np.clip(np.searchsorted(t, found.first) - 1, 0, len(t) - 1)
        last = np.clip(np.searchsorted(t, found.last) + 1, first + 1, len(t))
        least = np.array([reserve[a:b].min() for a, b in zip(first, last, strict=True)])
        cycles = np.maximum(found.frequency * (found.last - found.first), 1.0)
        there, more = _drift(found.amplitude, found.frequency, least, rest)
        slides = found.share * np.minimum(cycles * there, cycles * more + 2 * there)
        if (total := float(slides.sum())) > worst.distance:
            k = int(np.argmax(slides))
            middle = 0.5 * float(found.first[k] + found.last[k])
            worst = Slip(total, float(found.frequency[k]), float(found.amplitude[k]), middle)
    return worst
