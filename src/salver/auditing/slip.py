"""How far a load could slide by what a recording does not show.

A shake of amplitude A and frequency f on top of a motion that leaves the reserve r (m/s^2, what would still be borne in
any direction) slides a load only while A (2 pi f)^2 > r, and then by 2 pi A (1 - r / a)^2 a cycle at most: the sliding
block of Newmark (Effects of earthquakes on dams and embankments, Geotechnique 15, 1965) under a sine, to a quarter
(the bound is checked by `tests/test_audit_slip.py`). So what is too small to be seen is judged by what it could do.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from salver.auditing.motion import Recording
from salver.auditing.noise import Cells
from salver.auditing.recorded import LEVER
from salver.geometry import Array

NOTICED = 5e-4  # m: below it the engine does not count a slip either (salver.simulation.outcome.Thresholds)
HIDDEN = 2e-3  # m: what noise may hide at the worst, by a shake just too small to be found, when it harms most
SEEN = 7.0  # standard deviations, over a window, of a shake that is always found
_GRID = 0.01  # s
_MOST = 20_000
_FREQUENCIES = 16


@dataclass(frozen=True)
class Slip:
    """The furthest slide (m) by a shake of `frequency` (Hz) and `amplitude` (m) around `time` (s)."""

    distance: float
    frequency: float
    amplitude: float
    time: float


def per_cycle(amplitude: Array, frequency: Array, reserve: Array) -> Array:
    """Bound of the slide in one cycle to the one side, m; reserve: that to this side, m/s^2."""
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.clip(reserve / (amplitude * (2 * np.pi * frequency) ** 2), 0, 1)
    return np.asarray(np.where(amplitude > 0, 2 * np.pi * amplitude * (1 - share) ** 2, 0.0))


def slide(t: Array, reserve: Array) -> float:
    """How far the motion itself slides a load, m: Newmark's block, which gains speed while the reserve is negative and
    loses it after. All to one side."""
    speed = moved = 0.0
    step = np.diff(t)
    if not (reserve < 0).any():
        return 0.0
    for k in range(int(np.argmax(reserve < 0)), len(step)):
        if speed > 0 or reserve[k] < 0:
            speed = max(0.0, speed - step[k] * float(reserve[k]))
            moved += speed * step[k]
    return moved


def _drift(amplitude: Array, frequency: Array, reserve: Array, rest: float) -> tuple[Array, Array]:
    """(to the one side, more to the one side than back) in one cycle, m. What is missing of the reserve at rest on the
    one side is to spare on the other."""
    there = per_cycle(amplitude, frequency, reserve)
    back = per_cycle(amplitude, frequency, 2 * rest - reserve)
    return there, np.maximum(there - back, 0.0)


def hidden(t: Array, reserve: Array, rest: float, recording: Recording) -> tuple[Slip, float]:
    """By a shake that noise or the sensor's resolution hides, of any frequency up to `recording.highest` and as long as
    it stays hidden: over a longer window less of it is. And the frequency up to which that is less than `HIDDEN`, Hz.

    reserve: (T,) m/s^2 at times t. rest: the same at rest on a level tray.
    """
    grid = max(_GRID, (t[-1] - t[0]) / _MOST)
    edges = np.arange(t[0], t[-1] + grid, grid)
    least = np.full(max(1, len(edges) - 1), np.inf)
    np.minimum.at(least, np.clip(((t - t[0]) / grid).astype(int), 0, len(least) - 1), reserve)
    empty = np.flatnonzero(np.isinf(least))
    least[empty] = np.interp(edges[empty], t, reserve)
    louder = np.interp(edges[:-1] + 0.5 * grid, t, np.broadcast_to(recording.louder, t.shape))[: len(least)]
    noise = recording.sensor.displacement * louder
    blur = np.hypot(recording.sensor.position.blur, 2 * LEVER * recording.sensor.orientation.blur)
    worst, harmless = Slip(0.0, recording.highest, 0.0, float(t[0])), 0.0
    for frequency in np.geomspace(min(1.0, recording.highest), recording.highest, _FREQUENCIES):
        cycles = 1.0
        while True:
            amplitude = np.maximum(SEEN * noise * np.sqrt(2 * frequency / (recording.rate * cycles)), blur)
            window = max(1, min(len(least), round(cycles / frequency / grid)))
            there, more = _drift(amplitude, np.array(frequency), least, rest)
            passed = np.cumsum(np.pad(np.stack([there, more]), ((0, 0), (1, 0))), axis=1)
            sides = (passed[:, window:] - passed[:, :-window]) * cycles / window
            # It settles within two cycles to what drifts away.
            over = np.minimum(sides[0], sides[1] + sides[0] * min(1.0, 2 / cycles))
            k = int(np.argmax(over))
            if over[k] > worst.distance:
                middle = float(edges[k] + 0.5 * window * grid)
                worst = Slip(float(over[k]), float(frequency), float(amplitude[k + window // 2]), middle)
            if cycles / frequency > t[-1] - t[0]:
                break
            cycles *= 2
        if worst.distance <= HIDDEN:
            harmless = float(frequency)
    return worst, harmless


def left_over(t: Array, reserve: Array, rest: float, kinds: tuple[Cells, ...], mirror: float | None = None) -> Slip:
    """By what stands out of the noise and is not in the motion: each window by its strongest frequency.

    mirror: the sampling rate, where the true frequency may be the rate less what it seems.
    """
    worst = Slip(0.0, 0.0, 0.0, float(t[0]))
    for cells in kinds:
        frequency = cells.frequency if mirror is None else np.maximum(cells.frequency, mirror - cells.frequency)
        first = np.clip(np.searchsorted(t, cells.first) - 1, 0, len(t) - 1)
        last = np.clip(np.searchsorted(t, cells.last) + 1, first + 1, len(t))
        least = np.array([reserve[a:b].min() for a, b in zip(first, last, strict=True)])
        cycles = np.maximum(frequency * (cells.last - cells.first), 1.0)
        there, more = _drift(cells.amplitude, frequency, least, rest)
        slides = cells.share * np.minimum(cycles * there, cycles * more + 2 * there)
        total = float(slides.sum())
        if total > worst.distance:
            k = int(np.argmax(slides))
            worst = Slip(
                total,
                float(frequency[k]),
                float(cells.amplitude[k]),
                float(0.5 * (cells.first[k] + cells.last[k])),
            )
    return worst
