"""What in samples is noise, and what is motion: residuals are noise only as long as they cannot be told from white.

Noise is what a sensor adds to every sample anew: white, and the same all along the recording. Its size is the least
that any band of frequencies holds, at most times of the recording; whatever rises above that, in any window of time
and any band, is motion (`found`), however small it is against the whole.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.special import chdtri

from salver.geometry import Array

FALSE_ALARM = 0.005  # probability, for one stretch of samples, that noise is taken for motion
SMALLEST = 8  # samples of the shortest window that has frequencies
_RISE = 1.5  # of the power in a whole octave, above which it is not white
_CORRELATION = 1.94  # neighbouring frequencies of a Hann window are not independent: 1 + 2 (4/9 + 1/36)
_OVERLAPPING = 1.4  # segments that overlap by half are not independent either
_FEWEST_LEVELS = 6  # different values before they are taken for steps of a resolution
_FEWEST_MOVES = 3
_STILL = 0.2  # share of moves after which values stand still, above which they change by steps
_FEWEST_BINS = 12  # for a median that is right to a fifth
_SEGMENT = 256  # samples over which the power of noise is told


@dataclass(frozen=True)
class Level:
    """Size of what cannot be seen, of samples with d components.

    axes: (d, d), orthogonal; noise along its columns is independent, with standard deviations sizes (d,): those of a
    tray that joints move differ. step: of the sensor's resolution.
    """

    axes: Array
    sizes: Array
    step: float = 0.0

    @classmethod
    def even(cls, noise: float, step: float = 0.0, d: int = 3) -> Level:
        """The same in all components."""
        return cls(np.eye(d), np.full(d, noise), step)

    @property
    def whole(self) -> float:
        """Standard deviation along the axis where it is largest, with that of rounding, step / sqrt(12)."""
        return max(float(self.sizes.max()), self.step / np.sqrt(12))

    @property
    def blur(self) -> float:
        """Amplitude under which rounding shows nothing: of the first harmonic of steps that noise does not smooth."""
        return 0.64 * self.step if self.sizes.max() < 0.5 * self.step else 0.0

    @property
    def variances(self) -> Array:
        """(d,) along the axes, with those of rounding."""
        return np.maximum(self.sizes, self.step / np.sqrt(12)) ** 2


@dataclass(frozen=True)
class Cells:
    """Windows of time in which a frequency stands out of the noise; arrays (n,), or empty.

    first, last: samples (last excluded). frequency: Hz. amplitude: in the unit of the samples. excess: of the power
    over what noise reaches. share: of the windows of this length that overlap, so that sums do not count twice.
    """

    first: npt.NDArray[Any]
    last: npt.NDArray[Any]
    frequency: Array
    amplitude: Array
    excess: Array
    share: Array


def resolution(y: Array) -> float:
    """Step between values (N, d) that are all multiples of one: what the sensor or the file rounds to; 0 if none."""
    steps = []
    for column in y[: 1 << 14].T:
        values = np.unique(column)
        gaps, changes = np.diff(values), int(np.count_nonzero(np.diff(column)))
        few = changes < 2 * len(values) and len(values) < _FEWEST_LEVELS  # that it does not come back to
        if len(values) < 2 or few or gaps.min() <= 1e-12 * (1 + np.abs(values).max()):
            continue
        step = float(gaps.min())
        off = (values - values[0]) / step
        step *= float(off[-1] / np.round(off[-1]))
        off = (values - values[0]) / step
        moves = np.unique(np.round(np.abs(np.diff(column)) / step))
        # At constant speed all values are multiples of something; what is rounded moves by different numbers of steps.
        if np.abs(off - np.round(off)).max() < 0.05 and (len(moves) > 1 or len(values) < _FEWEST_LEVELS):
            steps.append(step)
    return min(steps, default=0.0)


def stepped(y: Array) -> float:
    """Least usual move of values (N, d), together or one by one, that stand still between their moves; 0 if they do
    not."""
    found = 0.0
    moves = np.diff(y, axis=0)
    for size in (np.linalg.norm(moves, axis=1), *np.abs(moves).T):
        after = size[1:][size[:-1] > 0]
        if len(after) >= _FEWEST_MOVES and np.mean(after == 0) > _STILL:
            found = max(found, float(np.quantile(size[size > 0], 0.25)))
    return found


def principal(residual: Array) -> Array:
    """(d, d) axes along which residuals (N, d) are independent of one another; the tenth that is largest left out."""
    size = np.linalg.norm(residual, axis=1)
    usual = residual[size <= np.quantile(size, 0.9)]
    return np.asarray(np.linalg.eigh(usual.T @ usual)[1])


def level(residual: Array, cut: float, top: float = 0.5) -> tuple[Array, float]:
    """Standard deviations (d,) of noise in residuals (N, d) of a fit that lets through what is slower than `cut`
    (cycles a sample), and by how much of themselves they may err (standard deviation): from the power between that and
    `top`, at the median of frequencies and of times. Both infinite where the samples are too few."""
    n = len(residual)
    length = min(n, _SEGMENT)
    starts = np.linspace(0, n - length, max(1, min(64, 2 * (n // length) - 1))).astype(int)
    window = np.hanning(length + 2)[1:-1]
    power = np.array(
        [np.abs(np.fft.rfft(residual[s : s + length] * window[:, None], axis=0)) ** 2 for s in starts]
    ) / np.sum(window**2)
    frequency = np.fft.rfftfreq(length)
    chosen = (frequency > 1.2 * cut) & (frequency < top - 1 / length)
    count = chosen.sum() * len(starts)
    if count < _FEWEST_BINS:
        return np.full(residual.shape[1], np.inf), np.inf
    sizes = np.sqrt(np.median(np.median(power[:, chosen], axis=1), axis=0) / np.log(2))
    # The median of n powers of noise errs by 1 / (ln 2 sqrt(n)), their root by half of that.
    return np.asarray(sizes), 0.72 * np.sqrt(_CORRELATION * _OVERLAPPING / count)


def least(sizes: Array, errors: Array) -> Array:
    """(d,) of estimates (m, d) of noise, each uncertain by a share (m,), the least that is surely less than the others,
    with those that differ from it by chance only: the least of many that err is less than any is in truth."""
    sure = np.argmin(sizes * (1 + 2 * errors[:, None]), axis=0)
    chosen = np.take_along_axis(sizes, sure[None], axis=0)
    alike = np.abs(sizes - chosen) <= 3 * np.hypot(errors[:, None], errors[sure]) * chosen
    weight = np.where(alike & np.isfinite(sizes), 1 / errors[:, None] ** 2, 0.0)
    finite = np.where(np.isfinite(sizes), sizes, 0.0)
    return np.asarray(np.sqrt(np.sum(weight * finite**2, axis=0) / weight.sum(axis=0)))


def found(residual: Array, rate: float, level: Level, negligible: Array | float) -> list[Cells]:
    """What stands out of the noise in residuals (N, d), for every length of windows from the shortest.

    negligible: of accelerations, unit/s^2, in amplitude: an oscillation below it is let be.
    """
    n = len(residual)
    lengths = [SMALLEST << k for k in range(32) if SMALLEST << k < n] + [n]
    probability = FALSE_ALARM / (len(lengths) * 4 * n)
    out = [_single(residual, rate, level, negligible, probability)]
    free = len(level.sizes)
    quantile = chdtri(2 * free, probability) / 2
    residual = residual @ level.axes
    for length in lengths:
        hop = max(1, length // 3)
        starts = np.append(np.arange(0, n - length, hop), n - length)
        window = np.hanning(length + 2)[1:-1]
        frames = np.lib.stride_tricks.sliding_window_view(residual, length, axis=0)[starts]
        each = np.abs(np.fft.rfft(frames * window, axis=2)[:, :, 1 : (length + 1) // 2]) ** 2
        power = each.sum(axis=1)
        frequency = rate * np.arange(1, power.shape[1] + 1) / length
        own = level.variances[:, None] * np.sum(window**2)
        least = (negligible / (2 * np.pi * frequency) ** 2 + level.blur) ** 2 * window.sum() ** 2 / 4
        normal = np.sum(each / (own + least / quantile), axis=1)  # one a component, for noise alone
        alone = normal / quantile
        peak = np.argmax(alone, axis=1)
        amplitude = 2 * np.sqrt(power[np.arange(len(starts)), peak]) / window.sum()
        excess = alone[np.arange(len(starts)), peak]
        highest = frequency[peak]
        low = 1
        while 2 * low < len(frequency):  # octaves
            band = slice(low, 2 * low)
            freedom = 2 * free * low / _CORRELATION
            usual = max(chdtri(freedom, probability) / freedom, _RISE) * low * free
            pooled = normal[:, band].sum(axis=1) / usual
            more = (pooled > 1) & (excess < 1)
            amplitude = np.where(more, 2 * np.sqrt(power[:, band].sum(axis=1)) / window.sum(), amplitude)
            highest = np.where(more, frequency[min(2 * low, len(frequency)) - 1], highest)
            excess = np.where(more, pooled, excess)
            low *= 2
        k = np.flatnonzero(excess > 1)
        share = np.full(len(k), min(1.0, hop / length))
        out.append(Cells(starts[k], starts[k] + length, highest[k], amplitude[k], excess[k], share))
    return out


def _single(residual: Array, rate: float, level: Level, negligible: Array | float, probability: float) -> Cells:
    size = np.linalg.norm(residual, axis=1)
    least = level.whole * np.sqrt(chdtri(len(level.sizes), probability))
    excess = size / (least + level.blur + negligible / (np.pi * rate) ** 2 + 1e-300)
    k = np.flatnonzero(excess > 1)
    return Cells(k, k + 1, np.full(len(k), 0.5 * rate), size[k], excess[k], np.ones(len(k)))
