"""Separation of noise and motion in samples, by frequency.

Noise of a sensor is independent in each sample: white and stationary. Its size is the least power that any frequency
band has at most times; everything above that, in any time window and at any frequency, is motion (`standing_out`). If
the noise ends at a frequency, the samples were filtered.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.special import chdtri
from scipy.stats import median_abs_deviation

from salver.auditing.spline import fit
from salver.geometry import Array

RESOLVED = 0.4  # share of the sampling rate up to which accelerations are resolved
CONJUGATE = np.array([1.0, -1.0, -1.0, -1.0])  # times a quaternion: its conjugate


@dataclass(frozen=True)
class NoiseLevel:
    """Noise of samples. size: standard deviation of the noisiest component. step: resolution."""

    size: float
    step: float = 0.0

    @property
    def whole(self) -> float:
        """Standard deviation including rounding, step / sqrt(12)."""
        return max(self.size, self.step / 12**0.5)

    @property
    def blur(self) -> float:
        """Amplitude below which rounding hides motion: the first harmonic of steps that noise does not smooth."""
        return 0.64 * self.step if self.size < 0.5 * self.step else 0.0


@dataclass(frozen=True)
class Oscillations:
    """Time windows in which a frequency exceeds the noise; arrays (n,), possibly empty.

    first, last: indices of samples (last excluded). frequency: Hz. amplitude: in the unit of the samples. excess: power
    over the threshold for noise. share: weight of the window among overlapping ones, so that sums do not count twice.
    """

    first: npt.NDArray[Any]
    last: npt.NDArray[Any]
    frequency: Array
    amplitude: Array
    excess: Array
    share: Array


@dataclass(frozen=True)
class Spectrum:
    """Power of samples (N, d) in half-octave bands, as the standard deviation of white noise with that power.

    edges: (K,) Hz, lower edges of all bands except the first. sizes: (K, d), exceeded only at few times. power:
    (K, 8, d), squared sizes in eighths of the recording. errors: (K,), relative random errors of the sizes.
    """

    edges: Array
    sizes: Array
    power: Array
    errors: Array

    @classmethod
    def of(cls, t: Array, y: Array) -> Spectrum:
        """The spectrum of samples y (N, d), or of quaternions (N, 4) as half the rotation vector in the rotating frame,
        in which noise does not depend on the orientation."""
        n, duration = len(t), float(t[-1] - t[0])
        top, low = RESOLVED * (n - 1) / duration, max(2.5 / duration, 1.0)
        edges = top * 2.0 ** (-0.5 * np.arange(max(1, int(2 * np.log2(top / low))), -1, -1))
        curves = [fit(t, y, np.full(n, edge)) for edge in edges]
        share = np.diff([*(len(curve.spline.c) for curve in curves), n]) / n  # shares of the degrees of freedom
        values = [*(np.asarray(curve.spline(t)) for curve in curves), y]
        bands = [off(lower, upper) for lower, upper in pairwise(values)]
        axes = _principal(bands[-1])
        bands = [band @ axes / np.sqrt(max(free, 1e-9)) for band, free in zip(bands, share, strict=True)]
        power = [[np.mean(part**2, axis=0) for part in np.array_split(band, 8)] for band in bands]
        sizes = median_abs_deviation(bands, axis=1, scale="normal")
        return cls(
            np.asarray(edges), np.asarray(sizes), np.array(power), np.asarray(1.17 / np.sqrt(np.maximum(n * share, 1)))
        )

    @property
    def noise(self) -> float:
        """Noise level of the noisiest axis: the mean (r.m.s., weighted) of the least size and all sizes that differ
        from it only by chance, because the least of several estimates alone would be too small."""
        sure = np.argmin(self.sizes * (1 + 2 * self.errors[:, None]), axis=0)
        chosen = np.take_along_axis(self.sizes, sure[None], axis=0)
        alike = np.abs(self.sizes - chosen) <= 3 * np.hypot(self.errors[:, None], self.errors[sure]) * chosen
        weight = np.where(alike, 1 / self.errors[:, None] ** 2, 0.0)
        return float(np.sqrt(np.sum(weight * self.sizes**2, axis=0) / weight.sum(axis=0)).max())


def off(curve: Array, y: Array) -> Array:
    """Residuals (N, d) of samples from a curve; for quaternions half the rotation vector (N, 3)."""
    return product(curve * CONJUGATE, y - curve)[:, 1:] if y.shape[1] == 4 else y - curve


def product(a: Array, b: Array) -> Array:
    """Products (N, 4) of quaternions (w, x, y, z)."""
    w = a[:, 0] * b[:, 0] - np.einsum("ij,ij->i", a[:, 1:], b[:, 1:])
    xyz = a[:, :1] * b[:, 1:] + b[:, :1] * a[:, 1:] + np.cross(a[:, 1:], b[:, 1:])
    return np.concatenate([w[:, None], xyz], axis=1)


def _principal(residual: Array) -> Array:
    """Principal axes (d, d) of residuals (N, d), without the largest tenth of them."""
    size = np.linalg.norm(residual, axis=1)
    usual = residual[size <= np.quantile(size, 0.9)]
    return np.asarray(np.linalg.eigh(usual.T @ usual)[1])


def noise_level(t: Array, y: Array) -> NoiseLevel:
    """Noise and resolution of samples y (N, 3), or quaternions (N, 4), at times t (N,)."""
    found, step = Spectrum.of(t, y), resolution(y)
    # Rounded samples deviate from every smooth curve; smooth ones may be multiples of a step by chance.
    return NoiseLevel(found.noise, max(dead_band(y), step if np.sqrt(found.power[-1].max()) > 0.05 * step else 0.0))


def of_one_size(moves: Array) -> bool:
    """Whether moves (N,) > 0 from sample to sample are of one size, as a resolution or a dead band makes them; those of
    a motion become small wherever it turns."""
    return bool(np.quantile(moves, 0.1) > 0.3 * np.median(moves))


def dead_band(y: Array, fewest: int = 6) -> float:
    """Dead band of a logger in values (N, d), which writes a value anew once it has changed by so much: it hides
    smaller motion as a resolution does. The largest of all columns; 0 if there is none.

    fewest: least number of moves after a repeated value that show it.
    """
    found = [0.0]
    for moves in np.abs(np.diff(y, axis=0)).T:
        changes = np.flatnonzero(moves)
        after = moves[changes[1:]][np.diff(changes) > 1]  # at speed a value may change by more
        if len(after) >= fewest and of_one_size(after) and moves[changes].min() > 0.3 * np.median(after):
            found.append(float(np.quantile(after, 0.1)))
    return max(found)


def resolution(y: Array) -> float:
    """Resolution of values (N, d): the step of which all are multiples; 0 if there is none."""
    steps = []
    for column in y[: 1 << 14].T:
        values, moves = np.unique(column), np.abs(np.diff(column))
        few = np.count_nonzero(moves) < 2 * len(values)  # most values occur once
        if len(values) < 2 or (few and len(values) < 6):
            continue
        step = float(np.diff(values).min())
        if step <= 1e-12 * (1 + np.abs(values).max()):
            continue
        whole = (values - values[0]) / step
        step *= float(whole[-1] / np.round(whole[-1]))
        whole = (values - values[0]) / step
        # At constant speed all values are multiples of a step; rounded values differ by different numbers of steps.
        if np.abs(whole - np.round(whole)).max() < 0.05 and len(np.unique(np.round(moves / step))) > 1:
            steps.append(step)
    return min(steps, default=0.0)


def filtered_at(t: Array, y: Array, drop: float, fewest: int) -> float:
    """Cut-off frequency, Hz, of a filter that has removed noise and vibration of samples y (N, d); infinite if no
    filter is visible.

    drop: factor by which the power falls at the cut-off. fewest: least number of samples for a separation of noise and
    motion; the filtered signal must have half as many degrees of freedom. Judged along the axis that moves least: noise
    is equally strong over an octave and a half at all times, and then ends at all times, whereas motion changes over
    time or is in a narrow band.
    """
    y = y[:, np.ptp(y, axis=0) > 0]
    if y.shape[1] < 2:
        return np.inf
    own = y @ np.linalg.eigh(np.cov(y.T))[1][:, :1]
    found = Spectrum.of(t, own)
    power = found.power[:, :, 0]
    # Noise is never constant; computed samples are, when the arm rests.
    calmest = min(float(np.ptp(part)) for part in np.array_split(own, np.clip(len(t) // 8, 1, 32)))
    usual, rounding = np.median(power, axis=1), resolution(y) ** 2 / 3 + 1e-20
    for k in range(len(usual) - 3):
        three, times = usual[k : k + 3], power[k : k + 3].mean(axis=0)
        level = float(np.median(three))
        gone = np.flatnonzero(usual[k + 3 :] < level / drop) + k + 3
        if not len(gone) or not np.all(usual[gone[0] :] < level / drop) or three.max() < rounding:
            continue
        even = three.max() < 8 * three.min() and np.median(times) < 5 * times.min() and calmest > 1e-3 * level**0.5
        if even and usual[gone[0]] < 30 * power[gone[0]].min():
            end = float(found.edges[np.flatnonzero(usual[:-1] > level / 4)[-1]])
            return end if 4 * found.edges[gone[0] - 1] * (t[-1] - t[0]) >= fewest else np.inf
    return np.inf


def standing_out(
    residual: Array, rate: float, level: NoiseLevel, negligible: float, false_alarm: float, shortest: int = 8
) -> list[Oscillations]:
    """Oscillations in residuals (N, d) above the noise, in windows of all lengths from the shortest.

    negligible: amplitude of accelerations, unit/s^2, below which an oscillation is ignored. false_alarm: probability
    that noise alone gives an oscillation. shortest: samples of the shortest window.
    """
    n, d = residual.shape
    lengths = [shortest << k for k in range(11) if shortest << k < n] + [min(n, shortest << 11)]
    quantile = chdtri(2 * d, false_alarm / (len(lengths) * 4 * n)) / 2
    out = []
    for length in lengths:
        hop = max(1, length // 3)
        starts = np.append(np.arange(0, n - length, hop), n - length)
        window = np.hanning(length + 2)[1:-1]
        gain = 0.5 * window.sum()
        frames = np.lib.stride_tricks.sliding_window_view(residual, length, axis=0)[starts]
        power = np.sum(np.abs(np.fft.rfft(frames * window, axis=2)[:, :, 1 : (length + 1) // 2]) ** 2, axis=1)
        frequency = rate * np.arange(1, power.shape[1] + 1) / length
        least = (gain * (negligible / (2 * np.pi * frequency) ** 2 + level.blur)) ** 2
        excess = power / (level.whole**2 * quantile * np.sum(window**2) + least + 1e-300)
        peak = np.argmax(excess, axis=1)
        k = np.flatnonzero(excess[np.arange(len(starts)), peak] > 1)
        amplitude = np.sqrt(power[k, peak[k]]) / gain
        share = np.full(len(k), min(1.0, hop / length))
        first = starts[k]
        out.append(Oscillations(first, first + length, frequency[peak[k]], amplitude, excess[k, peak[k]], share))
    return out
