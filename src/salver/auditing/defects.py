"""Damage of a recording by logger, sensor or software: found in the samples, named with its size, and removed where
that is sound.

In order: the unit, samples that repeat the one before, the clock, and places where the samples break off. All of it is
looked for in the channels as they stand in the file: a pose, or joint positions.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.ndimage import median_filter

from salver.auditing.noise import resolution
from salver.auditing.options import AuditOptions
from salver.auditing.recorded import LEVER
from salver.geometry import Array
from salver.motion_files.samples import JointSamples, Samples

REACH = 0.5  # m: a joint that turns moves the tray as something so far away
MANY = 3  # spikes or jumps, of which more are a habit of the recorder
_FEW = 16  # samples, below which nothing is looked for


@dataclass(frozen=True)
class Defect:
    """code, and clause: what it is, with its size. doubtful: whether it forbids to say that everything holds.
    systematic: whether it may explain a violation."""

    code: str
    clause: str
    doubtful: bool = True
    systematic: bool = False


@dataclass(frozen=True)
class Channels:
    """t (N,) s, y (N, m) as in the file. metres: (m,) how far something on the tray moves for each unit, roughly.
    step: m, resolution of the samples. pose: whether y is place and quaternion."""

    t: Array
    y: Array
    metres: Array
    step: float
    pose: bool = True
    defects: tuple[Defect, ...] = ()

    @property
    def scaled(self) -> Array:
        """(N, m) m."""
        return self.y * self.metres

    def having(self, *defects: Defect, **changes: Any) -> Channels:
        return replace(self, defects=(*self.defects, *defects), **changes)


def channels_of(samples: Samples) -> Channels:
    """The channels of a recording as they stand in the file."""
    if isinstance(samples, JointSamples):
        metres = np.full(samples.q.shape[1], REACH)
        return Channels(samples.t, samples.q, metres, REACH * resolution(samples.q), pose=False)
    metres = np.array([1.0, 1.0, 1.0, *[2 * LEVER] * 4])
    return Channels(samples.t, np.hstack([samples.p, samples.quat_wxyz]), metres, resolution(samples.p))


def repaired(channels: Channels, options: AuditOptions) -> Channels:
    """The samples that are worth judging, with what was found in them."""
    if not np.ptp(channels.y, axis=0).any():
        return channels
    for step in (_in_metres, _without_repeats, _with_even_clock, _without_breaks):
        if len(channels.t) >= _FEW:
            channels = step(channels, options)
    return channels


def _in_metres(channels: Channels, options: AuditOptions) -> Channels:
    """Whether a pose is one of a tray on an arm."""
    far = float(np.abs(channels.y[:, :3]).max())
    if not channels.pose or options.nearest < far < options.furthest:
        return channels
    return channels.having(
        Defect("unit", f"the tray is up to {far:.2g} m from the origin: positions must be in m", systematic=True)
    )


# Samples that are no news -------------------------------------------------------------------------------------


def _without_repeats(channels: Channels, options: AuditOptions) -> Channels:
    """Samples without those that repeat the one before while the motion goes on."""
    t, y = channels.t, channels.y
    moved = np.abs(np.diff(y, axis=0))
    begins = np.flatnonzero(np.append(True, moved.any(axis=1)))  # of runs of equal samples
    length = np.diff(np.append(begins, len(t)))
    if len(begins) < 3 or length.max() == 1:
        return channels
    far = np.append(np.linalg.norm(moved * channels.metres, axis=1), 0.0)
    held = np.mean(length[1:-1] > 1) > 0.5
    alike = np.quantile(far[far > 0], 0.1) > 0.3 * np.median(far[far > 0])
    if held and alike and np.ptp(np.quantile(length[1:-1], (0.1, 0.9))) > 1:
        return channels  # moves of one size, now and then, are steps of the sensor
    catch_up = far[np.append(begins[1:], len(t)) - 1]  # the move that ends each run
    passed = np.concatenate([[0.0], np.cumsum(far)])
    low, high = np.maximum(begins - 2 * length, 0), np.minimum(begins + 3 * length, len(t) - 1)
    usual = (passed[high] - passed[low]) / np.maximum(high - low, 1)
    # At rest the next move is as small as those after it; a sensor's resolution is passed step by step.
    stale = (length > 1) & (catch_up > 0.2 * length * usual) & (catch_up > 4 * channels.step)
    if not stale.any():
        return channels
    typical = float(np.median(length[stale]))
    if held:  # all along, also where it turns
        stale |= (length > 1) & (length <= typical + 1)
    new = np.zeros(len(t), dtype=bool)
    new[begins] = True
    keep = new | ~np.repeat(stale, length)
    count = int(np.count_nonzero(~keep))
    clause = f"{100 * count / len(t):.2g} % of the samples ({count}) repeat the one before while the tray moves: stale"
    if held:
        rate = 1 / float(np.median(np.diff(t[begins])))
        clause = f"samples are held: {typical:.0f} at a time are alike, and {rate:.3g} a second are new"
    return channels.having(Defect("stale", clause, doubtful=False), t=t[keep], y=y[keep])


# The clock ----------------------------------------------------------------------------------------------------


def off_cubic(t: Array, y: Array, normal: bool = False) -> Array:
    """(N - 4, m) by which samples are off the cubic through the two neighbours on each side; `normal`: over what noise
    makes of that, which is more where the neighbours are uneven."""
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
    """Even times where the samples fit them better than the times that are given."""
    t, y = channels.t, channels.scaled
    index, step = np.arange(len(t)), np.diff(t)
    usual = float(np.median(step))
    if max(np.abs(step - usual)) < 1e-3 * usual:
        return channels
    grids = [np.asarray(np.polyval(np.polyfit(index, t, 1), index))]
    for period in (usual, (t[-1] - t[0]) / (len(t) - 1)):  # with samples missing
        line = np.array([period, t[0]])
        for _ in range(3):
            count = index + np.maximum.accumulate(np.round((t - line[1]) / line[0]) - index)
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


# Where the samples break off ----------------------------------------------------------------------------------


def _without_breaks(channels: Channels, options: AuditOptions) -> Channels:
    """Single samples that are off are left out; what all that follow are off by is taken from them."""
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
        defects.append(Defect(kind, clause, systematic=sum(map(len, breaks.values())) > MANY))
    keep = np.setdiff1d(np.arange(n), list(breaks["spike"]))
    return channels.having(*defects, t=t[keep], y=(y / channels.metres)[keep])


def _explained(t: Array, y: Array, k: int, least: float) -> tuple[str, int, Array] | None:
    """Kind, sample and size (m) of what makes the samples around k lie on cubics again: one that is off, or a jump;
    None if neither does."""
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
