"""The motion of recorded poses, and the oscillations that it does not include.

A spline is fitted with a low bandwidth first, which is raised where its residuals differ from white noise
(`salver.auditing.noise`), until no difference is left or the sampling limits it. Remaining oscillations are reported by
frequency and amplitude (`Oscillations`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from salver.auditing.noise import CONJUGATE, RESOLVED, NoiseLevel, Oscillations, noise_level, off, product, standing_out
from salver.auditing.options import AuditOptions
from salver.auditing.spline import Fit, fit
from salver.geometry import Array, matrix_from_quat_wxyz
from salver.trajectory import MotionSamples

LEVER = 0.1  # m, lever arm with which rotations are converted to displacements
FASTER = 2.0  # ratio of bandwidth to the frequency to be followed; its acceleration is then accurate to 2 %
OUTER = 2  # samples at each end between which the acceleration of the curve is not determined


@dataclass(frozen=True)
class Sensor:
    """Noise of a sensor: position (m) and orientation (rad, half the angle, in the rotating frame)."""

    position: NoiseLevel
    orientation: NoiseLevel

    @property
    def displacement(self) -> float:
        """Standard deviation of the position of a point at a distance `LEVER` from the frame, m."""
        return float(np.hypot(self.position.whole, 2 * LEVER * self.orientation.whole))


@dataclass(frozen=True)
class Reading:
    """A motion estimated from samples.

    motion: at the judged instants. bandwidth (T,): Hz. acceleration_error (T,): m/s^2, bound of the error by noise.
    missed (T,): m/s^2, acceleration that a spline of this bandwidth cannot follow. unseen: oscillations above the noise
    that the motion does not include, as displacements in m and times in s.
    """

    motion: MotionSamples
    bandwidth: Array
    acceleration_error: Array
    missed: Array
    unseen: tuple[Oscillations, ...]


def sensor_of(t: Array, p: Array, quat_wxyz: Array) -> Sensor:
    """The noise of a recording, estimated from its samples."""
    return Sensor(noise_level(t, p), noise_level(t, quat_wxyz))


def read_motion(t: Array, p: Array, quat_wxyz: Array, sensor: Sensor, options: AuditOptions) -> Reading:
    """The motion of a recording of poses at times t (N,)."""
    rate = 1 / float(np.median(np.diff(t)))
    most, turned = RESOLVED * rate, options.negligible / (2 * LEVER)
    position, bandwidth = _follow(t, p, sensor.position, rate, options.negligible, options)
    turning, agile = _follow(t, quat_wxyz, sensor.orientation, rate, turned, options)
    bandwidth = np.maximum(bandwidth, agile)
    grid = _instants(t, bandwidth)
    motion = _motion(grid, position, turning)
    # Between the outermost samples the acceleration is not determined; that two samples inside is used instead.
    for end, outside in ((0, grid < t[OUTER]), (-1, grid > t[-1 - OUTER])):
        for bend in (motion.a_S, motion.alpha_B):
            bend[outside] = bend[~outside][end]
    error = np.zeros(len(grid))
    for curve, seen, metres in ((position, sensor.position, 1.0), (turning, sensor.orientation, 2 * LEVER)):
        error = np.hypot(error, metres * options.certain * seen.whole * curve.acceleration_error(grid, 1 / rate))
        if seen.blur:  # more samples do not average out the steps of the resolution
            steps = options.certain * seen.step / np.sqrt(12) * curve.acceleration_error(grid, curve.spacing(grid))
            error = np.hypot(error, metres * steps)
    # Near the limit of the sampling a spline misses some of the acceleration: a quarter at the limit, by experiment.
    fast = np.interp(grid, t, bandwidth)
    missed = 0.25 * np.linalg.norm(motion.a_S, axis=1) * (fast / most) ** 6
    unseen = standing_out(off(position.spline(t), p), rate, sensor.position, options.negligible, options.false_alarm)
    for found in standing_out(
        off(turning.spline(t), quat_wxyz), rate, sensor.orientation, turned, options.false_alarm
    ):  # by displacement at the lever, and by the tilt of gravity
        place = 2 * (LEVER + 9.81 / (2 * np.pi * found.frequency) ** 2)
        unseen.append(replace(found, amplitude=place * found.amplitude))
    timed = (replace(x, first=t[x.first], last=t[np.minimum(x.last, len(t) - 1)]) for x in unseen if len(x.first))
    return Reading(motion, fast, error, missed, tuple(timed))


def _follow(
    t: Array, y: Array, level: NoiseLevel, rate: float, negligible: float, options: AuditOptions, growth: float = 1.7
) -> tuple[Fit, Array]:
    """A spline, and its bandwidth (N,), raised until the residuals are noise, by up to `growth` in an iteration."""
    most, least = RESOLVED * rate, min(RESOLVED * rate, 1.5 / (t[-1] - t[0]))
    # Up to this bandwidth noise causes a negligible error of the acceleration (0.1 m/s^2).
    unit = options.certain * level.whole * (2 * np.pi) ** 2 * np.sqrt(0.4 / rate)  # times f^2.5
    harmless = (0.1 / max(unit, 1e-300)) ** 0.4
    bandwidth = np.full(len(t), np.clip(min(harmless, options.usual), least, most))
    if not np.ptp(y, axis=0).any():
        bandwidth[:] = least
    while True:
        curve = fit(t, y, bandwidth)
        residual = off(curve.spline(t), y)
        wanted = _wanted(standing_out(residual, rate, level, negligible, options.false_alarm), len(t))
        raised = np.clip(FASTER * wanted, 1.2 * bandwidth, growth * bandwidth)
        raised = np.minimum(most, np.where(wanted > 0, raised, bandwidth))
        if np.all(raised <= bandwidth * (1 + 1e-9)):
            return curve, bandwidth
        bandwidth = raised


def _wanted(kinds: list[Oscillations], n: int) -> Array:
    """Frequency (n,) that the spline must follow next at each sample: that of the largest excess there; 0 if none."""
    first, last, frequency, excess = (
        np.concatenate([getattr(found, name) for found in kinds]) for name in ("first", "last", "frequency", "excess")
    )
    wanted = np.zeros(n)
    for k in np.argsort(-excess):
        if not wanted[first[k] : last[k]].any():
            wanted[first[k] : last[k]] = frequency[k]
    return wanted


def _instants(t: Array, bandwidth: Array, per_period: int = 12) -> Array:
    """Instants that are dense enough for the bandwidth, including both ends; with 12 in each of its periods peaks are
    accurate to 0.9 %."""
    fine = np.union1d(np.linspace(t[0], t[-1], 201), t)
    dense = per_period * np.interp(fine, t, bandwidth)
    passed = np.concatenate([[0.0], np.cumsum(0.5 * (dense[1:] + dense[:-1]) * np.diff(fine))])
    grid = np.interp(np.linspace(0, passed[-1], max(100, int(np.ceil(passed[-1]))) + 1), passed, fine)
    grid[[0, -1]] = t[[0, -1]]
    return np.unique(grid)


def _motion(t: Array, position: Fit, turning: Fit) -> MotionSamples:
    """The motion of fitted position and quaternion; the quaternion Q need not be normalised.

    With Q = |Q| q: Q^-1 Q' has the vector part omega/2, and Q^-1 Q'' - (Q^-1 Q')^2 has alpha/2.
    """
    p, v, a = position(t)
    quat, rate, bend = turning(t)
    inverse = quat * CONJUGATE / np.sum(quat**2, axis=1, keepdims=True)
    spin = product(inverse, rate)
    turn = product(inverse, bend) - product(spin, spin)
    unit = quat / np.linalg.norm(quat, axis=1, keepdims=True)
    return MotionSamples(t, p, v, a, matrix_from_quat_wxyz(unit), 2 * spin[:, 1:], 2 * turn[:, 1:])
