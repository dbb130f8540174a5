"""Defects of recordings: what loggers, sensors and software make of a motion before an audit reads it.

Each defect takes a recorder (the true motion, its sensor and its rate) and returns time stamps and channels as they
stand in the file. `LISTED` were looked at while the audit was made; `HELD_OUT`, `LATER` and `FOURTH` were not.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import signal
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from audit_recordings import Motion
from salver.geometry import exp, quat_wxyz_from_matrix

Samples = tuple[np.ndarray, np.ndarray]  # t (N,) s, channels (N, 7): pose with quaternion wxyz, or joints


@dataclass(frozen=True)
class Recorder:
    """A sensor with white noise (m at the tray), at `rate` Hz."""

    rng: Any
    motion: Motion
    rate: float
    noise: float

    @property
    def t(self) -> np.ndarray:
        return np.arange(int(self.motion.duration * self.rate) + 1) / self.rate

    def at(self, t: np.ndarray) -> np.ndarray:
        """(N, 7) channels at the times t."""
        t = np.clip(t, 0, self.motion.duration)
        if self.motion.arm is not None:
            return self.motion.joints(t) + self.motion.deviation(self.noise) * self.rng.standard_normal((len(t), 7))
        s = self.motion.tray(t)
        p = s.p_SB + self.noise * self.rng.standard_normal(s.p_SB.shape)
        quat = quat_wxyz_from_matrix(s.R_SB @ exp(2 * self.noise * self.rng.standard_normal(s.p_SB.shape)))
        quat *= np.sign(quat[:, :1])
        return np.column_stack([p, quat])

    def noisier(self, noise: float) -> Recorder:
        return replace(self, noise=max(self.noise, noise))

    def uniform(self, low: float, high: float) -> float:
        """A draw, uniform in the logarithm."""
        return float(np.exp(self.rng.uniform(np.log(low), np.log(high))))


# Listed -------------------------------------------------------------------------------------------------------


def jittering_stamps(r: Recorder) -> Samples:
    """Samples are even, the times at which they arrive are not."""
    jitter = r.uniform(5e-5, 6e-4) * r.rng.standard_normal(len(r.t))
    return np.maximum.accumulate(r.t + np.clip(jitter, -0.45 / r.rate, 0.45 / r.rate)), r.at(r.t)


def jittering_samples(r: Recorder) -> Samples:
    """Stamps are even, the times of the samples are not."""
    return r.t, r.at(r.t + r.uniform(5e-5, 6e-4) * r.rng.standard_normal(len(r.t)))


def held(r: Recorder) -> Samples:
    """100 Hz written at 1 kHz."""
    every = int(r.rng.choice([2, 4, 5, 10]))
    slow = r.at(r.t[::every])
    return r.t, np.repeat(slow, every, axis=0)[: len(r.t)]


def doubled(r: Recorder) -> Samples:
    """Every sample stands there twice, at a time of its own."""
    y = r.at(r.t)
    t = np.column_stack([r.t, r.t + r.rng.uniform(0.05, 0.5) / r.rate]).ravel()
    return t, np.repeat(y, 2, axis=0)


def stale(r: Recorder) -> Samples:
    """5 % of the samples repeat the one before."""
    y = r.at(r.t)
    share = r.rng.uniform(0.01, 0.2)
    for k in np.flatnonzero(r.rng.random(len(y)) < share):
        y[k] = y[max(k - 1, 0)]
    return r.t, y


def quantised(r: Recorder) -> Samples:
    """Encoders of 12 to 14 bits, or a pose in tenths of a millimetre; the shake hardly a step."""
    y = r.at(r.t)
    step = 2 * np.pi / 2 ** r.rng.integers(12, 15) if r.motion.arm is not None else r.uniform(1e-4, 1e-3)
    y = np.round(y / step) * step
    return r.t, y if r.motion.arm is not None else _unit(y)


def spike_on_uneven_clock(r: Recorder) -> Samples:
    t = r.t + np.r_[0, 0.3 / r.rate * r.rng.uniform(-1, 1, len(r.t) - 2), 0]
    y = r.at(t)
    y[r.rng.integers(5, len(y) - 5), r.rng.integers(3)] += r.uniform(1e-3, 0.5)
    return t, y


def zero_phase(r: Recorder) -> Samples:
    """As motion capture software smooths: Butterworth, forwards and backwards."""
    y = r.noisier(1e-5).at(r.t)
    cut = r.uniform(4, 12)
    return r.t, _unit_of(r, signal.sosfiltfilt(_low(r, 2, cut), y, axis=0))


def causal(r: Recorder) -> Samples:
    y = r.noisier(1e-5).at(r.t)
    sos = _low(r, int(r.rng.integers(1, 5)), r.uniform(8, 18))
    return r.t, _unit_of(r, signal.sosfilt(sos, y - y[0], axis=0) + y[0])


def kilometres(r: Recorder) -> Samples:
    return _scaled(r, 1e-3)


def millimetres(r: Recorder) -> Samples:
    return _scaled(r, 1e3)


# Held out -----------------------------------------------------------------------------------------------------


def interpolated(r: Recorder) -> Samples:
    """Straight lines between samples of a slower sensor."""
    every = int(r.rng.choice([4, 5, 10]))
    y = r.at(r.t[::every])
    return r.t, _unit_of(r, np.column_stack([np.interp(r.t, r.t[::every], c) for c in y.T]))


def moving_average(r: Recorder) -> Samples:
    width = max(3, round(r.rate * r.uniform(0.03, 0.12)))
    y = r.noisier(1e-5).at(r.t)
    padded = np.pad(y, ((width // 2, width - 1 - width // 2), (0, 0)), mode="edge")
    return r.t, _unit_of(r, np.column_stack([np.convolve(c, np.ones(width) / width, "valid") for c in padded.T]))


def exponential(r: Recorder) -> Samples:
    """y += alpha (new - y)."""
    y = r.noisier(1e-5).at(r.t)
    alpha = 1 - np.exp(-2 * np.pi * r.uniform(3, 12) / r.rate)
    return r.t, _unit_of(r, signal.lfilter([alpha], [1, alpha - 1], y - y[0], axis=0) + y[0])


def savitzky_golay(r: Recorder) -> Samples:
    width = 2 * round(r.rate * r.uniform(0.05, 0.15) / 2) + 1
    return r.t, _unit_of(r, signal.savgol_filter(r.noisier(1e-5).at(r.t), max(width, 5), 3, axis=0))


def median_filtered(r: Recorder) -> Samples:
    width = 2 * round(r.rate * r.uniform(0.03, 0.1) / 2) + 1
    return r.t, _unit_of(r, signal.medfilt(r.noisier(1e-5).at(r.t), (max(width, 3), 1)))


def rounded_stamps(r: Recorder) -> Samples:
    """Stamps in whole milliseconds, or in tens of them."""
    unit = float(r.rng.choice([1e-3, 4e-3, 1e-2]))
    return np.round(r.t / unit) * unit, r.at(r.t)


def bursts(r: Recorder) -> Samples:
    """Samples arrive together, several at a time, and are stamped then."""
    every = int(r.rng.integers(2, 9))
    k = np.arange(len(r.t))
    arrival = r.t[np.minimum((k // every + 1) * every, len(k) - 1)] + 2e-5 * (k % every)
    return np.maximum.accumulate(arrival), r.at(r.t)


def lost(r: Recorder) -> Samples:
    """Samples are lost, and the rest numbered through."""
    keep = r.rng.random(len(r.t)) > r.rng.uniform(0.01, 0.1)
    return r.t[: keep.sum()], r.at(r.t[keep])


def clock_step(r: Recorder) -> Samples:
    """The clock is set forward, once."""
    return r.t + r.uniform(3e-3, 0.1) * (np.arange(len(r.t)) > r.rng.integers(5, len(r.t) - 5)), r.at(r.t)


def offset(r: Recorder) -> Samples:
    """Motion capture begins anew somewhere else."""
    y = r.at(r.t)
    y[r.rng.integers(5, len(y) - 5) :, :3] += r.uniform(5e-4, 3e-2) * r.rng.standard_normal(3)
    return r.t, y


def wrong_marker(r: Recorder) -> Samples:
    """Off for some samples, and back."""
    y = r.at(r.t)
    k, count = r.rng.integers(5, len(y) - 30), r.rng.integers(2, 25)
    y[k : k + count, :3] += r.uniform(1e-3, 5e-2) * r.rng.standard_normal(3)
    return r.t, y


def heavy_tails(r: Recorder) -> Samples:
    y = r.at(r.t)
    noise = 1e-5 * r.rng.standard_t(2.0, size=y.shape)
    return r.t, _unit_of(r, y + noise)


def deadband(r: Recorder) -> Samples:
    """A value is written anew once it has changed by so much."""
    y, least = r.at(r.t), r.uniform(1e-5, 1e-3)
    for column in y.T:
        last = column[0]
        for k in range(len(column)):
            last = column[k] if abs(column[k] - last) > least else last
            column[k] = last
    return r.t, _unit_of(r, y)


def frozen(r: Recorder) -> Samples:
    """The sensor stands still for a while and goes on where it should be."""
    y = r.at(r.t)
    k, count = r.rng.integers(5, len(y) // 2), max(3, round(r.rate * r.uniform(0.01, 0.3)))
    y[k : k + count] = y[k]
    return r.t, y


def swapped(r: Recorder) -> Samples:
    """Neighbours in the wrong order, their stamps in the right one."""
    y = r.at(r.t)
    for k in np.flatnonzero(r.rng.random(len(y) - 1) < r.rng.uniform(0.005, 0.05)):
        y[[k, k + 1]] = y[[k + 1, k]]
    return r.t, y


def centimetres(r: Recorder) -> Samples:
    return _scaled(r, 1e2)


def resampled(r: Recorder) -> Samples:
    """A cubic through samples of a slower sensor."""
    every = int(r.rng.choice([5, 10, 20]))
    t = r.t[::every]
    y = CubicSpline(t, r.at(t), axis=0)(np.minimum(r.t, t[-1]))
    return r.t, _unit_of(r, y)


def single_precision(r: Recorder) -> Samples:
    """Times of the day in s, in single precision: steps of 4 ms."""
    return np.float32(40_000.0 + r.t).astype(float), r.at(r.t)


# A third set, made after the audit recognised those above -------------------------------------------------------


def restamped(r: Recorder) -> Samples:
    """Packets of samples are dropped, and the rest is stamped evenly."""
    keep, n = np.ones(len(r.t), dtype=bool), len(r.t)
    for k in r.rng.integers(5, n - 5, r.rng.integers(1, 6)):
        keep[k : k + r.rng.integers(2, 15)] = False
    return r.t[: keep.sum()], r.at(r.t[keep])


def two_clocks(r: Recorder) -> Samples:
    """Position and orientation, or half the joints, by clocks that drift apart by up to 1 %."""
    y, late = r.at(r.t), r.at(r.t * (1 + r.uniform(1e-4, 1e-2)) + r.uniform(1e-4, 5e-3))
    return r.t, np.column_stack([y[:, :3], late[:, 3:]])


def one_unit_wrong(r: Recorder) -> Samples:
    """One column in degrees, or in cm or mm."""
    y, factor = r.at(r.t), np.rad2deg(1) if r.motion.arm is not None else r.rng.choice([1e2, 1e3])
    y[:, r.rng.integers(7 if r.motion.arm is not None else 3)] *= factor
    return r.t, y


def signs_flipped(r: Recorder) -> Samples:
    """Quaternions q and -q, at random."""
    y = r.at(r.t)
    y[:, 3:] *= r.rng.choice([-1.0, 1.0], (len(y), 1))
    return r.t, y


def w_last(r: Recorder) -> Samples:
    """Quaternions x, y, z, w under the names w, x, y, z; the tray's heading is any."""
    return r.t, _turned(r, r.at(r.t))[:, [0, 1, 2, 4, 5, 6, 3]]


def transposed(r: Recorder) -> Samples:
    """The inverse of each rotation; the tray's heading is any."""
    return r.t, _turned(r, r.at(r.t)) * [1, 1, 1, 1, -1, -1, -1]


def y_up(r: Recorder) -> Samples:
    """Axes of a motion capture system, whose second one is up."""
    y = r.at(r.t)
    w, x, a, b = np.sqrt(0.5) * y[:, 3:].T
    return r.t, np.column_stack([y[:, [0, 2]], -y[:, 1], w + x, x - w, a + b, b - a])


def wrapped(r: Recorder) -> Samples:
    """Straight lines between Euler angles, or joints, of a slower sensor, which wrap at 180 degrees."""
    every = int(r.rng.choice([1, 2, 5]))
    slow = r.t[::every]
    y, turn = r.at(slow), Rotation.from_euler("z", np.pi - r.rng.uniform(-0.05, 0.05))
    if r.motion.arm is not None:
        joint = r.rng.integers(7)
        y[:, joint] -= 2 * np.pi * (y[:, joint] > np.median(y[:, joint]))
        return r.t, _lines(r.t, slow, y)
    angles = (turn * Rotation.from_quat(y[:, 3:], scalar_first=True)).as_euler("ZYX")
    back = Rotation.from_euler("ZYX", _lines(r.t, slow, angles)).as_quat(scalar_first=True)
    return r.t, np.column_stack([_lines(r.t, slow, y[:, :3]), back])


def joints_in_another_order(r: Recorder) -> Samples:
    y = r.at(r.t)
    first = r.rng.integers(6)
    y[:, [first, first + 1]] = y[:, [first + 1, first]]
    return r.t, y


def filled_gaps(r: Recorder) -> Samples:
    """Gaps of 50 to 400 ms, filled by a cubic through what is left."""
    y, keep = r.noisier(1e-5).at(r.t), np.ones(len(r.t), dtype=bool)
    for k in r.rng.integers(5, len(y) - 5, r.rng.integers(1, 4)):
        keep[k : k + round(r.rate * r.uniform(0.05, 0.4))] = False
    keep[[0, 1, -2, -1]] = True
    return r.t, _unit_of(r, CubicSpline(r.t[keep], y[keep], axis=0)(r.t))


def begun(r: Recorder) -> Samples:
    """Begins while the tray moves."""
    keep = r.t > r.rng.uniform(0.1, 0.6) * r.t[-1]
    return r.t[keep], r.at(r.t[keep])


def resampled_by_lines(r: Recorder) -> Samples:
    """Straight lines between samples at another rate, no multiple."""
    slow = np.arange(0, r.motion.duration, 1 / min(r.rate / r.rng.uniform(1.1, 6), 300.0))
    return r.t, _unit_of(r, _lines(r.t, slow, r.at(slow)))


def two_publishers(r: Recorder) -> Samples:
    """Every other sample is from a second sensor, which is late and has an offset."""
    y, other = r.at(r.t), r.at(r.t - r.uniform(1e-3, 2e-2))
    other[:, :3] += r.uniform(1e-5, 1e-3) * r.rng.standard_normal(3)
    y[1::2] = other[1::2]
    return r.t, _unit_of(r, y)


def extrapolated(r: Recorder) -> Samples:
    """Lost samples are replaced by going on at the last speed."""
    y, k = r.at(r.t), 2
    while k < len(y):
        count = 1 if r.rng.random() > 0.03 else int(r.rng.integers(2, 8))
        for i in range(k, min(k + count - 1, len(y))):
            y[i] = 2 * y[i - 1] - y[i - 2]
        k += count
    return r.t, _unit_of(r, y)


# A fourth set, made after the audit recognised all of those -----------------------------------------------------


def nearest_frame(r: Recorder) -> Samples:
    """A camera's frames at another rate: each sample is the latest frame, which stays for one or two samples."""
    period = 1 / (r.rate * r.rng.uniform(0.3, 0.9))
    return r.t, r.at(np.floor(r.t / period) * period)


def zeros(r: Recorder) -> Samples:
    """Where tracking is lost the file has zeros, and a unit quaternion."""
    y = r.at(r.t)
    for k in r.rng.integers(5, len(y) - 5, r.rng.integers(1, 6)):
        lost = slice(k, k + int(r.rng.integers(1, 6)))
        y[lost] = 0.0
        if r.motion.arm is None:
            y[lost, 3] = 1.0
    return r.t, y


def clipped(r: Recorder) -> Samples:
    """A channel ends at a bound of the sensor's range."""
    y = r.at(r.t)
    column = int(np.argmax(np.ptp(y[:, : 3 if r.motion.arm is None else 7], axis=0)))
    bound = np.quantile(y[:, column], r.rng.uniform(0.6, 0.95))
    y[:, column] = np.minimum(y[:, column], bound)
    return r.t, y


def backlash(r: Recorder) -> Samples:
    """An encoder behind gears with play: it follows once the play is used up."""
    y, play = r.at(r.t), r.uniform(1e-5, 1e-3)
    for column in y[:, : 3 if r.motion.arm is None else 7].T:
        last = column[0]
        for k in range(len(column)):
            last = column[k] = np.clip(last, column[k] - play / 2, column[k] + play / 2)
    return r.t, y


def half_precision(r: Recorder) -> Samples:
    """Values in 16 bits: steps of 0.5 mm at 0.5 m to 1 m, of 0.25 mm below."""
    return r.t, _unit_of(r, np.float16(r.at(r.t)).astype(float))


def simplified(r: Recorder) -> Samples:
    """Samples that a straight line between others meets to some hundredths of a millimetre are left out, as databases
    of measurements do."""
    y, within, keep, k = r.at(r.t), r.uniform(1e-5, 2e-4), [0], 1
    while k < len(y):
        first = keep[-1]
        share = ((r.t[first : k + 1] - r.t[first]) / (r.t[k] - r.t[first]))[:, None]
        off = np.abs(y[first : k + 1] - y[first] - share * (y[k] - y[first])).max()
        if off > within and k - first > 1:
            keep.append(k - 1)
        else:
            k += 1
    kept = np.union1d(keep, len(y) - 1)
    return r.t[kept], y[kept]


def tracked(r: Recorder) -> Samples:
    """An alpha-beta filter, which expects a constant speed and overshoots where it changes."""
    y, out = r.noisier(1e-5).at(r.t), []
    alpha = r.rng.uniform(0.1, 0.5)
    beta, at, rate = alpha**2 / (2 - alpha), y[0], 0 * y[0]
    for new in y:
        at = at + rate / r.rate
        off = new - at
        at, rate = at + alpha * off, rate + beta * off * r.rate
        out.append(at)
    return r.t, _unit_of(r, np.array(out))


def rate_doubled(r: Recorder) -> Samples:
    """Half of the samples are the mean of those beside them."""
    y = r.at(r.t)
    y[1:-1:2] = 0.5 * (y[0:-2:2] + y[2::2])
    return r.t, _unit_of(r, y)


def _lines(t: np.ndarray, slow: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.column_stack([np.interp(t, slow, c) for c in y.T])


def _turned(r: Recorder, y: np.ndarray) -> np.ndarray:
    """Poses with the world turned by some heading."""
    turn = Rotation.from_euler("z", r.rng.uniform(-np.pi, np.pi))
    quat = (turn * Rotation.from_quat(y[:, 3:], scalar_first=True)).as_quat(scalar_first=True)
    return np.column_stack([turn.apply(y[:, :3]), quat])


def _scaled(r: Recorder, factor: float) -> Samples:
    y = r.at(r.t)
    y[:, : 3 if r.motion.arm is None else 7] *= factor
    return r.t, y


def _low(r: Recorder, order: int, cut: float) -> Any:
    return signal.butter(order, min(cut, 0.3 * r.rate), fs=r.rate, output="sos")


def _unit_of(r: Recorder, y: np.ndarray) -> np.ndarray:
    return y if r.motion.arm is not None else _unit(y)


def _unit(y: np.ndarray) -> np.ndarray:
    quat = y[:, 3:]
    return np.column_stack([y[:, :3], quat / np.linalg.norm(quat, axis=1, keepdims=True)])


LISTED: tuple[Callable[[Recorder], Samples], ...] = (
    jittering_stamps, jittering_samples, held, doubled, stale, quantised, spike_on_uneven_clock, zero_phase, causal,
    kilometres, millimetres,
)  # fmt: skip
HELD_OUT: tuple[Callable[[Recorder], Samples], ...] = (
    interpolated, moving_average, exponential, savitzky_golay, median_filtered, rounded_stamps, bursts, lost,
    clock_step, offset, wrong_marker, heavy_tails, deadband, frozen, swapped, centimetres, resampled, single_precision,
)  # fmt: skip
LATER: tuple[Callable[[Recorder], Samples], ...] = (
    restamped, two_clocks, one_unit_wrong, signs_flipped, w_last, transposed, y_up, wrapped, joints_in_another_order,
    filled_gaps, begun, resampled_by_lines, two_publishers, extrapolated,
)  # fmt: skip
FOURTH: tuple[Callable[[Recorder], Samples], ...] = (
    nearest_frame, zeros, clipped, backlash, half_precision, simplified, tracked, rate_doubled,
)  # fmt: skip
POSES_ONLY = {
    "kilometres", "millimetres", "centimetres", "offset", "wrong_marker",
    "signs_flipped", "w_last", "transposed", "y_up",
}  # fmt: skip
JOINTS_ONLY = {"joints_in_another_order"}
DEFECTS = {defect.__name__: defect for defect in (*LISTED, *HELD_OUT, *LATER, *FOURTH)}


def record(rng: Any, motion: Motion, defect: str, folder: Path) -> tuple[Path, float, float]:
    """A file with that defect, and its rate and noise."""
    rate = float(np.round(np.exp(rng.uniform(np.log(120), np.log(1000))), 1))
    noise = 0.0 if rng.random() < 0.2 else float(10 ** rng.uniform(-6.5, -4))
    t, y = DEFECTS[defect](Recorder(rng, motion, rate, noise))
    names = ["x", "y", "z", "qw", "qx", "qy", "qz"]
    if motion.arm is not None:
        names = [f"panda_joint{i}" for i in range(1, 8)]
    path, digits = folder / "motion.csv", int(rng.choice([6, 7, 9]))
    if defect == "kilometres":
        digits = 9
    np.savetxt(
        path, np.column_stack([t, y]), delimiter=",", header=",".join(["t", *names]), comments="",
        fmt=["%.9f", *[f"%.{digits}f"] * 7],
    )  # fmt: skip
    return path, rate, noise
