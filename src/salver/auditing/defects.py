"""What a logger, a sensor or software has made of a motion: found in the samples, named with its size, and removed
where that is sound.

In order: the unit, samples that repeat the one before, the clock, and places where the samples break off. All of it is
looked for in the channels as they stand in the file: a pose, or joint positions.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.ndimage import median_filter

from salver.auditing.noise import resolution, stepped
from salver.auditing.recorded import LEVER
from salver.auditing.spline import fit
from salver.geometry import Array
from salver.motion_files.samples import JointSamples, Samples

NEAREST, FURTHEST = 2e-3, 20.0  # m from the origin: beyond these positions are in another unit
FASTEST = 10.0  # m/s
REACH = 0.5  # m: a joint that turns moves the tray as something so far away
BAND = 0.25  # of the sampling rate: what is faster than this is taken for noise while the clock is looked at
_FLAT = 0.4  # spectral flatness, above which residuals are noise: 0.56 of white noise, less of anything regular
INDEPENDENT = 16  # values of noise, with fewer of which it is not told from a motion
HELD = 0.5  # share of samples that are repeated, above which they are held all along
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
    step: m, resolution of the samples. pose: whether y is place and quaternion. jitter: s, standard deviation of the
    times at which the samples were taken, beyond `t`. shown: Hz, above which a filter has taken away everything."""

    t: Array
    y: Array
    metres: Array
    step: float
    pose: bool = True
    jitter: float = 0.0
    shown: float = np.inf
    defects: tuple[Defect, ...] = field(default=())

    @property
    def scaled(self) -> Array:
        """(N, m) m."""
        return self.y * self.metres

    def having(self, *defects: Defect, **changes: Any) -> Channels:
        return replace(self, defects=(*self.defects, *defects), **changes)


def channels_of(samples: Samples) -> Channels:
    """What a recording holds, as it stands in the file."""
    if isinstance(samples, JointSamples):
        metres = np.full(samples.q.shape[1], REACH)
        return Channels(samples.t, samples.q, metres, REACH * resolution(samples.q), pose=False)
    metres = np.array([1.0, 1.0, 1.0, *[2 * LEVER] * 4])
    return Channels(samples.t, np.hstack([samples.p, samples.quat_wxyz]), metres, resolution(samples.p))


def repaired(channels: Channels) -> Channels:
    """The samples that are worth judging, with what was found in them."""
    if len(channels.t) < _FEW or not np.ptp(channels.y, axis=0).any():
        return channels
    for step in (
        _in_metres,
        _without_repeats,
        _with_steps,
        _with_clock_set_back,
        _with_even_clock,
        _without_breaks,
        _with_jitter,
        _without_empty_band,
    ):
        if len(channels.t) >= _FEW:
            channels = step(channels)
    return channels


def _in_metres(channels: Channels) -> Channels:
    """Whether a pose is one of a tray on an arm."""
    if not channels.pose:
        return channels
    p = channels.y[:, :3]
    far = float(np.abs(p).max())
    speed = np.linalg.norm(median_filter(np.gradient(p, channels.t, axis=0), (9, 1), mode="nearest"), axis=1).max()
    if NEAREST < far < FURTHEST and speed < FASTEST:
        return channels
    clause = f"the tray is up to {far:.2g} m from the origin and moves at up to {speed:.2g} m/s: positions must be in m"
    return channels.having(Defect("unit", clause, systematic=True))


# Samples that are no news -------------------------------------------------------------------------------------


def _without_repeats(channels: Channels) -> Channels:
    """Of samples that stand still while the motion goes on, the first alone."""
    t, y = channels.t, channels.y
    moved = np.abs(np.diff(y, axis=0))
    begins = np.flatnonzero(np.append(True, moved.any(axis=1)))  # of runs of equal samples
    length = np.diff(np.append(begins, len(t)))
    if len(begins) < 3 or length.max() == 1:
        return channels
    far = np.append(np.linalg.norm(moved * channels.metres, axis=1), 0.0)
    held = np.mean(length[1:-1] > 1) > HELD
    alike = np.quantile(far[far > 0], 0.1) > 0.3 * np.median(far[far > 0])
    if held and alike and np.ptp(np.quantile(length[1:-1], (0.1, 0.9))) > 1:
        return channels  # moves of one size, now and then, are steps of the sensor
    catch_up = far[np.append(begins[1:], len(t)) - 1]  # the move that ends each run
    passed = np.concatenate([[0.0], np.cumsum(far)])
    low, high = np.maximum(begins - 2 * length, 0), np.minimum(begins + 3 * length, len(t) - 1)
    usual = (passed[high] - passed[low]) / np.maximum(high - low, 1)
    # At rest the next move is as small as those after it; a sensor's resolution is passed step by step.
    stale = (length > 1) & (catch_up > 0.2 * length * usual) & (catch_up > 4 * channels.step)
    before = far[max(begins[-1] - 6, 0) : begins[-1]]  # no tray stops from one sample to the next
    stale[-1] = length[-1] > 1 and before[-1] > max(0.5 * np.median(before), 4 * channels.step)
    if not stale.any():
        return channels
    typical = float(np.median(length[stale]))
    if held:  # all along, also where it turns
        stale |= (length > 1) & (length <= typical + 1)
    count = int((length[stale] - 1).sum())
    keep = np.ones(len(t), dtype=bool)
    for begin, run in zip(begins[stale], length[stale], strict=True):
        keep[begin + 1 : begin + run] = False
    if held:
        rate = 1 / float(np.median(np.diff(t[begins])))
        clause = f"samples are held: {typical:.0f} at a time are alike, and {rate:.3g} a second are new"
    else:
        clause = (
            f"{100 * count / len(t):.2g} % of the samples ({count}) repeat the one before while the tray moves: stale"
        )
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


def _with_clock_set_back(channels: Channels) -> Channels:
    """Gaps of the times over which the samples go on as if there were none."""
    t, y, n = channels.t.copy(), channels.scaled, len(channels.t)
    usual = float(np.median(np.diff(t)))
    found = []
    for k in np.flatnonzero(np.diff(t) > 1.5 * usual):
        near, move = slice(max(k - 7, 0), k + 9), t[k + 1] - t[k] - usual
        closed = t[near] - move * (np.arange(n)[near] > k)
        left = [_off_polynomial(at, y[near]) for at in (t[near], closed)]
        if left[1] < 0.7 * left[0] and left[0] > 2 * channels.step:
            found.append((float(t[k + 1]), float(move)))
            t[k + 1 :] -= move
    if not found:
        return channels
    more = f" ({len(found)} times)" if len(found) > 1 else ""
    clause = f"the clock was set by {1e3 * found[0][1]:.3g} ms at {found[0][0]:.3f} s{more}, and is set back"
    return channels.having(Defect("clock", clause, doubtful=False), t=t)


def _off_polynomial(t: Array, y: Array) -> float:
    """Root mean square of what a parabola through all leaves of y (N, m): a cubic could bend inside a gap."""
    design = np.vander((t - t[0]) / np.ptp(t), 3)
    return float(np.sqrt(np.mean((y - design @ np.linalg.lstsq(design, y, rcond=None)[0]) ** 2)))


def _with_even_clock(channels: Channels) -> Channels:
    """Even times where the samples fit them better than the times that are given."""
    t, y = channels.t, channels.scaled
    index, step = np.arange(len(t)), np.diff(t)
    usual = float(np.median(step))
    if max(np.abs(step - usual)) < 1e-3 * usual:
        return channels
    grids = [t[0] + index * usual, np.polyval(np.polyfit(index, t, 1), index)]
    for period in (usual, (t[-1] - t[0]) / (len(t) - 1)):  # with samples missing
        line = np.array([period, t[0]])
        for _ in range(3):
            count = index + np.maximum.accumulate(np.round((t - line[1]) / line[0]) - index)
            line = np.polyfit(count, t, 1)
        grids.append(np.polyval(line, count))
    speed = np.linalg.norm(np.gradient(y, axis=0), axis=1)[2:-2]
    fast = speed >= 0.5 * np.quantile(speed, 0.95)

    def rough(at: Array) -> float:
        return float(np.mean(np.linalg.norm(off_cubic(at, y, normal=True), axis=1)[fast]))

    least = min(rough(grid) for grid in grids)
    if least > 0.97 * rough(t) or rough(t) < 2 * channels.step:
        return channels
    best = min((grid for grid in grids if rough(grid) <= 1.5 * least), key=lambda grid: float(np.std(grid - t)))
    off = t - best
    size = float(np.std(off - np.median(off)))
    if size < 1e-3 * usual:
        return channels
    clause = f"time stamps jitter by {1e3 * size:.2g} ms (up to {1e3 * np.abs(off).max():.2g} ms)"
    defect = Defect("clock", f"{clause}, and the samples are even: they are judged at even times", doubtful=False)
    return channels.having(defect, t=best)


def _with_steps(channels: Channels) -> Channels:
    y = channels.scaled[:, :3] if channels.pose else channels.scaled
    return replace(channels, step=max(channels.step, stepped(y)))


def _with_jitter(channels: Channels) -> Channels:
    """Errors that grow with the speed are those of the times at which the samples were taken."""
    t, y, n = channels.t, channels.scaled, len(channels.t)
    rate = 1 / float(np.median(np.diff(t)))
    curve = fit(t, y, np.full(n, BAND * rate))
    _, velocity, _ = curve(t)
    speed = np.linalg.norm(velocity, axis=1)
    along = np.einsum("ij,ij->i", y - curve.spline(t), velocity) / np.maximum(speed, 1e-12)
    order = np.argsort(speed)
    slow, fast = order[: n // 3], order[-(n // 3) :]
    if np.mean(speed[fast] ** 2) < 3 * np.mean(speed[slow] ** 2):
        return channels
    there, here = (np.median(along[k] ** 2) / 0.455 for k in (fast, slow))  # variances of noise
    jitter = float(np.sqrt(max(there - here, 0.0) / np.median(speed[fast] ** 2) / (1 - 2 * BAND)))
    normal = along / np.sqrt(here + (jitter * speed) ** 2 * (1 - 2 * BAND) + 1e-300)
    power = np.abs(np.fft.rfft(np.clip(normal, -4, 4) * np.hanning(n))) ** 2
    power = power[int(1.2 * BAND * n) : -1]
    flat = np.exp(np.mean(np.log(power + 1e-300))) / max(power.mean(), 1e-300)
    if there < 4 * max(here, channels.step**2) or flat < _FLAT or not 5e-3 < jitter * rate < 0.3:
        return channels
    clause = (
        f"the samples were taken up to {3e3 * jitter:.2g} ms before or after their times (standard deviation "
        f"{1e3 * jitter:.2g} ms): at {speed.max():.2g} m/s that is {1e3 * jitter * speed.max():.2g} mm"
    )
    return channels.having(Defect("jitter", clause, doubtful=False), jitter=jitter)


# Where the samples break off ----------------------------------------------------------------------------------


def _without_breaks(channels: Channels) -> Channels:
    """Single samples that are off are left out; what all that follow are off by is taken from them."""
    t, y, n = channels.t, channels.scaled.copy(), len(channels.t)
    velocity = median_filter(np.gradient(y, t, axis=0), (9, 1), mode="nearest")
    off = off_cubic(t, y)
    size = np.linalg.norm(off, axis=1)
    least = 8 * median_filter(size, 25, mode="nearest") + 7 * np.median(size) + 4 * channels.step + 1e-12
    spikes: dict[int, Array] = {}
    jumps: dict[int, Array] = {}
    looked = np.zeros(len(size), dtype=bool)
    while True:
        excess = np.where(looked, 0.0, np.linalg.norm(off, axis=1) / least)
        k = int(np.argmax(excess))
        if excess[k] < 1:
            break
        found = _explained(t, y, k + 2, least[k])
        if found is None:
            looked[k] = True
            continue
        kind, at, steps = found
        for j, step in zip(range(at, at + len(steps)), steps, strict=True):
            if kind == "jump":
                jumps[j] = step
                y[j:] -= step
            else:
                spikes[j] = step
                y[j] -= step
        around = slice(max(at - 6, 0), min(at + 6, n - 4))
        off[around] = off_cubic(t, y)[around]
        looked[max(at - 1, 0) : at] = True
    defects = []
    systematic = len(spikes) + len(jumps) > max(MANY, 0.002 * n)
    if spikes:
        k = min(spikes)
        more = f" ({len(spikes)} such samples)" if len(spikes) > 1 else ""
        clause = (
            f"the sample at {t[k]:.3f} s lies {1e3 * np.linalg.norm(spikes[k]):.3g} mm off its neighbours on both sides"
            f"{more}; the rest is judged without it: take it out of the file if the sensor erred"
        )
        defects.append(Defect("spike", clause, systematic=systematic))
    if jumps:
        defects.append(_jumped(t, jumps, velocity, systematic))
    keep = np.setdiff1d(np.arange(n), list(spikes))
    return channels.having(*defects, t=t[keep], y=(y / channels.metres)[keep])


def _jumped(t: Array, jumps: dict[int, Array], velocity: Array, systematic: bool) -> Defect:
    """Jumps along the way are samples that are missing from a clock that does not show it."""
    step = float(np.median(np.diff(t)))
    lost = 0
    for k, jump in jumps.items():
        speed = float(np.linalg.norm(velocity[k]))
        count = float(jump @ velocity[k]) / max(speed**2 * step, 1e-300)
        straight = abs(float(jump @ velocity[k])) > 0.95 * speed * float(np.linalg.norm(jump))
        lost += straight and count > 0.5 and abs(count - round(count)) < 0.25
    worst = max(jumps, key=lambda k: float(np.linalg.norm(jumps[k])))
    if len(jumps) > MANY and lost > 0.5 * len(jumps):
        clause = f"samples are missing at {len(jumps)} places, first after {t[min(jumps)]:.3f} s, which the times hide"
        return Defect("lost", clause, systematic=systematic)
    more = f" ({len(jumps)} such jumps)" if len(jumps) > 1 else ""
    clause = (
        f"the position jumps by {1e3 * float(np.linalg.norm(jumps[worst])):.3g} mm from {t[max(worst - 1, 0)]:.3f} s "
        f"to {t[worst]:.3f} s{more}"
    )
    return Defect("jump", clause, systematic=systematic)


def _explained(t: Array, y: Array, k: int, least: float) -> tuple[str, int, Array] | None:
    """Kind, sample and size (1 or 2, m) of what makes the samples around k lie on cubics again: one or two samples that
    are off, or a jump; None if nothing does."""
    low, high = max(k - 7, 0), min(k + 8, len(t))
    at = t[low:high]
    before = off_cubic(at, y[low:high])
    core = slice(max(k - low - 5, 0), k - low + 2)  # of `before`, three samples to either side
    index = np.arange(low, high)
    best: tuple[float, str, int, Array] | None = None
    for kind, count in (("spike", 1), ("jump", 1), ("spike", 2)):
        for first in range(max(k - 2, low + 2), min(k + 3, high - 2)):
            shape = index[:, None] == first + np.arange(count) if kind == "spike" else (index >= first)[:, None]
            pattern = off_cubic(at, shape.astype(float))[core]
            steps = np.asarray(np.linalg.lstsq(pattern, before[core], rcond=None)[0])
            left = float(np.linalg.norm(before[core] - pattern @ steps, axis=1).max())
            left *= count * count  # two explain more by chance
            if best is None or left < best[0]:
                best = left, kind, first, steps
    assert best is not None
    most = float(np.linalg.norm(before[core], axis=1).max())
    return best[1:] if best[0] < max(0.15 * most, 0.5 * least) else None


# What a filter took away --------------------------------------------------------------------------------------


def _without_empty_band(channels: Channels) -> Channels:
    """As many samples as what a filter let through has to say, so that its noise is white again."""
    cut, n = _shown(channels), len(channels.t)
    if np.isinf(cut):
        return channels
    every = max(1, min(int((n - 1) / (channels.t[-1] - channels.t[0]) / (2 * cut)), n // 32))
    keep = np.unique(np.append(np.arange(0, n, every), n - 1))
    return replace(channels, t=channels.t[keep], y=channels.y[keep], shown=cut)


def _shown(channels: Channels) -> float:
    """Hz, above which a filter has taken away everything, noise too; infinite where the samples do not show one.

    Noise of a sensor is white. Where a motion has faded and what is left is as strong over an octave and then vanishes,
    that was noise, and a filter has ended it: a motion alone fades steadily. Noise is there at all times, also while
    the arm rests.
    """
    t, n = channels.t, len(channels.t)
    rate, duration = 1 / float(np.median(np.diff(t))), float(t[-1] - t[0])
    edges = np.arange(np.log2(2.5 / duration), np.log2(0.45 * rate), 0.5)
    if len(edges) < 7:
        return np.inf
    found = np.inf
    groups = (slice(0, 3), slice(3, 7)) if channels.y.shape[1] == 7 and channels.pose else (slice(None),)
    for group in groups:
        y = channels.y[:, group]
        y = y[:, np.ptp(y, axis=0) > 0]
        if y.shape[1] < 2:
            continue
        axes = np.linalg.eigh(np.cov(y.T))[1]
        for axis in (axes.T[0], axes.T[-1]):
            own = (y @ axis)[:, None]
            curves = [fit(t, own, np.full(n, 2.0**edge)).spline(t)[:, 0] for edge in edges]
            width = 2.0 ** edges[1:] - 2.0 ** edges[:-1]
            power = np.array([_usual(b - a) for a, b in pairwise(curves)]) / width
            end, faded = _end(power, 2.0 ** edges[1:], resolution(channels.y[:, group]) ** 2, rate)
            if np.isinf(end) or not (faded or 2 * end * duration > INDEPENDENT):
                continue
            noise = float(power[2.0 ** edges[1:] <= end].min() * end)
            if _lasting(t, own[:, 0], noise):
                found = min(found, end)
    return found


def _lasting(t: Array, own: Array, power: float) -> bool:
    """Whether samples move by more than a tenth of noise of a power at all times. What was computed stands still where
    the arm rests."""
    for now, part in zip(np.array_split(t, 8), np.array_split(own, 8), strict=True):
        if np.var(part - np.polyval(np.polyfit(now - now[0], part, 1), now - now[0])) < 0.01 * power:
            return False
    return True


def _usual(band: Array) -> float:
    """Power at most times."""
    return float(np.median([np.mean(part**2) for part in np.array_split(band, 8)]))


def _end(power: Array, frequency: Array, step: float, rate: float) -> tuple[float, bool]:
    """Hz at which noise ends, and whether a motion has faded before it began, of a density of power (K,) up to
    frequency (K,); step: square of the resolution."""
    least = step / (6 * rate) + 1e-19  # of a nanometre at 10 Hz
    if power[-1] > 5 * least and power[-1] > 0.4 * power[-5]:  # white to the end
        return np.inf, False
    for k in range(len(power) - 3):
        flat = min(power[k + 1], power[k + 2]) > power[k] / 8
        level = float(np.max(power[k : k + 3]))
        gone = np.flatnonzero(power[k + 3 :] < level / 30)
        steady = flat and level > 30 * least and level * frequency[k] > 0.25 * step
        if steady and len(gone) and np.all(power[k + 3 + gone[0] :] < level / 10):
            faded = k > 0 and bool(power[:k].max() > 30 * level)
            return float(frequency[np.flatnonzero(power > level / 4)[-1]]), faded
    return np.inf, False
