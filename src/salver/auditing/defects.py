"""Defects of a recording by logger, sensor or software, found in the samples and repaired if that is sound.

In this order: a wrong unit, the end of a sensor's range, repeated samples, jitter of the clock, two sources that take
turns, spikes and jumps, one column in another unit. They are searched for in the channels as they are in the file: a
pose, or joint positions.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.ndimage import median_filter

from salver.auditing.noise import dead_band, of_one_size, resolution
from salver.auditing.options import AuditOptions
from salver.auditing.recorded import LEVER
from salver.geometry import Array
from salver.motion_files.samples import JointSamples, Samples

REACH = 0.5  # m, lever arm with which rotations of a joint are converted to displacements


@dataclass(frozen=True)
class Defect:
    """A defect of a recording.

    code, clause: what it is, in words with its size. doubtful: whether it excludes the verdict "holds". systematic:
    whether it could explain a violation.
    """

    code: str
    clause: str
    doubtful: bool = True
    systematic: bool = False


@dataclass(frozen=True)
class Channels:
    """The channels of a recording.

    t (N,): s. y (N, m): as in the file. metres (m,): approximate displacement of the tray per unit of each channel, m.
    step: resolution of the samples, m. pose: whether y is a position and a quaternion.
    """

    t: Array
    y: Array
    metres: Array
    step: float
    pose: bool = True
    defects: tuple[Defect, ...] = ()

    @property
    def scaled(self) -> Array:
        """The channels (N, m) as displacements, m."""
        return self.y * self.metres

    def having(self, *defects: Defect, **changes: Any) -> Channels:
        return replace(self, defects=(*self.defects, *defects), **changes)


def channels_of(samples: Samples) -> Channels:
    """The channels of a recording as they are in the file."""
    if isinstance(samples, JointSamples):
        metres = np.full(samples.q.shape[1], REACH)
        return Channels(samples.t, samples.q, metres, REACH * resolution(samples.q), pose=False)
    metres = np.array([1.0, 1.0, 1.0, *[2 * LEVER] * 4])
    return Channels(samples.t, np.hstack([samples.p, samples.quat_wxyz]), metres, resolution(samples.p))


def repaired(channels: Channels, options: AuditOptions, fewest: int = 16) -> Channels:
    """The repaired samples, with the defects that were found. fewest: number of samples in which defects show."""
    if not np.ptp(channels.y, axis=0).any():
        return channels
    known = (
        _in_metres,
        _in_range,
        _without_repeats,
        _with_even_clock,
        _of_one_sensor,
        _without_breaks,
        _in_one_unit,
    )
    for step in known:
        if len(channels.t) >= fewest:
            channels = step(channels, options)
    return channels


def _in_metres(channels: Channels, options: AuditOptions) -> Channels:
    """Add a defect if positions cannot be in metres."""
    far = float(np.abs(channels.y[:, :3]).max())
    if not channels.pose or options.nearest < far < options.furthest:
        return channels
    clause = f"the tray is up to {far:.2g} m from the origin: positions must be in m"
    return channels.having(Defect("unit", clause, systematic=True))


def _in_range(channels: Channels, options: AuditOptions) -> Channels:
    """Add a defect if a column comes to its largest or smallest value at speed, and stays there for three samples while
    others move: an axis that comes to rest slows down before."""
    least = 4 * max(channels.step, dead_band(channels.scaled))
    moving = np.asarray(np.any(np.diff(channels.y, axis=0), axis=1))
    for column in np.hstack([channels.scaled, -channels.scaled]).T:
        ends, moved = column == column.max(), np.abs(np.diff(column))
        there = ends[2:-2] & ends[3:-1] & ends[4:] & ~ends[1:-3]
        reached = np.flatnonzero(there & moving[2:-1] & moving[3:])  # two samples before this one
        if len(reached) and moved[reached].max() > max(least, options.stopping * np.quantile(moved, 0.99)):
            clause = f"a column stays at its extreme for {np.count_nonzero(ends)} samples, and comes to it at speed"
            return channels.having(Defect("range", f"{clause}: the sensor's range ends there", systematic=True))
    return channels


# Repeated samples ---------------------------------------------------------------------------------------------


def _without_repeats(channels: Channels, options: AuditOptions) -> Channels:
    """The samples without those that repeat the one before during the motion."""
    t, y = channels.t, channels.y
    moved = np.abs(np.diff(y, axis=0))
    begins = np.flatnonzero(np.append(True, moved.any(axis=1)))  # of runs of equal samples
    length = np.diff(np.append(begins, len(t)))
    if len(begins) < 3 or length.max() == 1:
        return channels
    far = np.append(np.linalg.norm(moved * channels.metres, axis=1), 0.0)
    held = np.mean(length[1:-1] > 1) > 0.5
    if held and of_one_size(far[far > 0]) and np.ptp(np.quantile(length[1:-1], (0.1, 0.9))) > 1:
        return channels  # occasional moves of one size are the resolution of the sensor
    catch_up = far[np.append(begins[1:], len(t)) - 1]  # displacement at the end of each run of equal samples
    passed = np.concatenate([[0.0], np.cumsum(far)])
    low, high = np.maximum(begins - 2 * length, 0), np.minimum(begins + 3 * length, len(t) - 1)
    usual = (passed[high] - passed[low]) / np.maximum(high - low, 1)
    # At rest the next displacement is as small as those after it; a resolution or dead band gives single steps.
    least = 4 * max(channels.step, dead_band(channels.scaled))
    stale = (length > 1) & (catch_up > 0.2 * length * usual) & (catch_up > least)
    if not stale.any():
        return channels
    typical = float(np.median(length[stale]))
    if held:  # along the whole recording
        stale |= (length > 1) & (length <= typical + 1)
    repeats = np.arange(len(t)) - np.repeat(begins, length)
    each = float(np.mean(length[stale])) if held else 1.0  # of a rest as many a second are kept as of the motion
    keep = (repeats == 0) | (~np.repeat(stale, length) & (repeats % each < 1))
    count = int(np.count_nonzero(~keep))
    clause = f"{100 * count / len(t):.2g} % of the samples ({count}) repeat the one before while the tray moves: stale"
    if held:
        rate = 1 / float(np.median(np.diff(t[begins])))
        clause = f"samples are held: {typical:.0f} at a time are alike, and {rate:.3g} a second are new"
    return channels.having(Defect("stale", clause, doubtful=False), t=t[keep], y=y[keep])


# The clock ----------------------------------------------------------------------------------------------------


def off_cubic(t: Array, y: Array, normal: bool = False) -> Array:
    """Deviations (N - 4, m) of samples from the cubic through their two neighbours on each side.

    normal: divide by the standard deviation for unit noise, which depends on the spacing of the neighbours.
    """
    places = [t[k : len(t) - 4 + k] - t[2:-2] for k in (0, 1, 3, 4)]
    values = [y[k : len(t) - 4 + k] for k in (0, 1, 3, 4)]
    cubic, gain = np.zeros_like(y[2:-2]), np.ones((len(t) - 4, 1))
    for i, own in enumerate(places):
        others = [x for j, x in enumerate(places) if j != i]
        weight = np.prod([-x / (own - x) for x in others], axis=0)
        cubic += weight[:, None] * values[i]
        gain += weight[:, None] ** 2
    return np.asarray((y[2:-2] - cubic) / (np.sqrt(gain) if normal else 1.0))


def _with_even_clock(channels: Channels, options: AuditOptions) -> Channels:
    """The samples at even times, if they fit these better than the given times."""
    t, y = channels.t, channels.scaled
    index, step = np.arange(len(t)), np.diff(t)
    usual = float(np.median(step))
    if max(np.abs(step - usual)) < 1e-3 * usual:
        return channels
    grids = [np.asarray(np.polyval(np.polyfit(index, t, 1), index))]
    single = np.round(step / usual) == 1  # no sample is missing; the median may be rounded, or no step
    for period in (step[single].mean() if single.any() else usual, (t[-1] - t[0]) / (len(t) - 1)):
        line = np.array([period, t[0]])
        for _ in range(3):
            missing = np.round((t - line[1]) / line[0]) - index
            count = index + np.minimum.accumulate(missing[::-1])[::-1]  # a stamp may be late, and comes no sooner
            line = np.polyfit(count, t, 1)
        grids.append(np.asarray(np.polyval(line, count)))
    speed = np.linalg.norm(np.gradient(y, axis=0), axis=1)[2:-2]
    fast = speed >= 0.5 * np.quantile(speed, 0.95)

    def rough(at: Array) -> float:
        return float(np.mean(np.linalg.norm(off_cubic(at, y, normal=True), axis=1)[fast]))

    least = min(rough(grid) for grid in grids)
    if least > 0.97 * rough(t) or rough(t) < 2 * channels.step:
        return channels
    best = min((grid for grid in grids if rough(grid) <= 1.5 * least), key=lambda grid: float(np.std(grid - t)))
    late = t - best
    size = float(np.std(late - np.median(late)))
    if size < 1e-3 * usual:
        return channels
    clause = f"time stamps jitter by {1e3 * size:.2g} ms (up to {1e3 * np.abs(late).max():.2g} ms)"
    defect = Defect("clock", f"{clause}, and the samples are even: they are judged at even times", doubtful=False)
    return channels.having(defect, t=best)


# Samples of another source -------------------------------------------------------------------------


def _of_one_sensor(channels: Channels, options: AuditOptions) -> Channels:
    """Add a defect if every other sample lies to one side, as of two sensors that take turns: neighbours deviate to
    opposite sides over four samples. Noise does so over two, and a vibration at almost half the sampling rate."""
    away = off_cubic(channels.t, channels.scaled)
    square = float(np.sum(away**2))
    odd, even = (float(np.sum(away[k:] * away[:-k])) for k in (3, 4))
    size = float(np.sqrt(square / len(away)))
    if not (even > options.alternating * square and odd < -options.alternating * square and size > 4 * channels.step):
        return channels
    clause = f"every other sample lies {1e3 * size:.2g} mm beside those between: two sources take turns in the file"
    return channels.having(Defect("alternating", clause, systematic=True))


def _in_one_unit(channels: Channels, options: AuditOptions) -> Channels:
    """Add a defect if white noise shows that one column has another unit."""
    y = channels.y[:, :3] if channels.pose else channels.y
    away = off_cubic(channels.t, y)
    square = np.sum(away**2, axis=0) + 1e-300
    beside = [np.sum(away[k:] * away[:-k], axis=0) / square for k in (1, 2)]
    white = (np.abs(beside[0] + 0.8) < 0.15) & (np.abs(beside[1] - 0.4) < 0.15)  # as the differences of white noise
    noise = np.sqrt(square[white] / len(away))
    if white.any() and noise.max() > options.uneven * noise.min():
        clause = f"one column is {noise.max() / noise.min():.0f} times as noisy as another: its unit is another"
        return channels.having(Defect("unit", clause, systematic=True))
    return channels


# Spikes and jumps ---------------------------------------------------------------------------------------------


def _without_breaks(channels: Channels, options: AuditOptions) -> Channels:
    """The samples without spikes, and with jumps subtracted from all later samples."""
    t, y, n = channels.t, channels.scaled.copy(), len(channels.t)
    size = np.linalg.norm(off_cubic(t, y), axis=1)
    least = options.break_off * (median_filter(size, 25, mode="nearest") + np.median(size)) + 4 * channels.step + 1e-12
    breaks: dict[str, dict[int, float]] = {"spike": {}, "jump": {}}
    looked = np.zeros(len(size), dtype=bool)
    while sum(map(len, breaks.values())) < 0.1 * n:
        excess = np.where(looked, 0.0, size / least)
        k = int(np.argmax(excess))
        if excess[k] < 1:
            break
        looked[k] = True
        if found := _explained(t, y, k + 2, least[k]):
            kind, at, step = found
            y[at : at + 1 if kind == "spike" else None] -= step
            breaks[kind][at] = 1e3 * float(np.linalg.norm(step))
            around = slice(max(at - 6, 0), min(at + 6, n - 4))
            size[around] = np.linalg.norm(off_cubic(t, y)[around], axis=1)
    defects = []
    for kind, sizes in breaks.items():
        if not sizes:
            continue
        k = max(sizes, key=sizes.__getitem__)
        many = f" ({len(sizes)} such places)" if len(sizes) > 1 else ""
        clause = (
            f"the sample at {t[k]:.3f} s lies {sizes[k]:.3g} mm off its neighbours on both sides{many}; the rest is "
            "judged without it: take it out of the file if the sensor erred"
            if kind == "spike"
            else f"the position jumps by {sizes[k]:.3g} mm from {t[k - 1]:.3f} s to {t[k]:.3f} s{many}"
        )
        defects.append(Defect(kind, clause, systematic=kind == "jump" or len(sizes) > 1))
    keep = np.setdiff1d(np.arange(n), list(breaks["spike"]))
    return channels.having(*defects, t=t[keep], y=(y / channels.metres)[keep])


def _explained(t: Array, y: Array, k: int, least: float) -> tuple[str, int, Array] | None:
    """Kind, sample and size (m) of a spike or a jump that explains the deviations around sample k; None if neither
    does."""
    low, high = max(k - 7, 0), min(k + 8, len(t))
    at, index = t[low:high], np.arange(low, high)
    before = off_cubic(at, y[low:high])
    core = slice(max(k - low - 5, 0), k - low + 2)  # of `before`, three samples to either side
    best: tuple[float, str, int, Array] | None = None
    for first in range(max(k - 2, low + 2), min(k + 3, high - 2)):
        for kind, shape in (("spike", index == first), ("jump", index >= first)):
            pattern = off_cubic(at, shape[:, None].astype(float))[core]
            step = np.asarray(np.linalg.lstsq(pattern, before[core], rcond=None)[0])[0]
            left = float(np.linalg.norm(before[core] - pattern * step, axis=1).max())
            if best is None or left < best[0]:
                best = left, kind, first, step
    most = float(np.linalg.norm(before[core], axis=1).max())
    return best[1:] if best is not None and best[0] < max(0.15 * most, 0.5 * least) else None
