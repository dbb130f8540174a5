"""From recorded poses to a motion, and what of the motion the recording cannot show.

The curve is found from below: a slow spline first, made faster where its residuals still hold anything that can be
told from white noise (`salver.auditing.noise`), until nothing is left or the samples allow no more. What is left then
is reported by frequency and amplitude (`Oscillations`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from salver.auditing.noise import CONJUGATE, RESOLVED, NoiseLevel, Oscillations, noise_level, off, product, standing_out
from salver.auditing.options import AuditOptions
from salver.auditing.spline import Fit, fit
from salver.geometry import Array, matrix_from_quat_wxyz
from salver.trajectory import MotionSamples

LEVER = 0.1  # m: what turns is judged by how it moves something so far away
FASTER = 2.0  # bandwidth over the frequency that was found: its acceleration is then met to 2 %
_PER_PERIOD = 12  # instants judged per period of the bandwidth, so 24 of what it follows: peaks are met to 0.9 %
_GROWTH = 1.7  # by which the bandwidth grows at most between two looks at the residuals
OUTER = 2  # samples at either end between which a curve bends as it likes


@dataclass(frozen=True)
class Sensor:
    """Noise of a sensor: of position (m) and orientation (rad, half the angle, in the frame that turns)."""

    position: NoiseLevel
    orientation: NoiseLevel

    @property
    def displacement(self) -> float:
        """m: standard deviation of a sample of something `LEVER` away from the frame."""
        return float(np.hypot(self.position.whole, 2 * LEVER * self.orientation.whole))


@dataclass(frozen=True)
class Reading:
    """A motion as read from samples.

    motion: at the instants to be judged. bandwidth (T,): Hz. acceleration_error (T,): m/s^2, by which the
    acceleration may be wrong by noise, and missed (T,), by which a spline so fast falls short of it. unseen: what
    stands out of the noise and is in the samples but not in the motion, as displacements in m and times in s.
    """

    motion: MotionSamples
    bandwidth: Array
    acceleration_error: Array
    missed: Array
    unseen: tuple[Oscillations, ...]


def sensor_of(t: Array, p: Array, quat_wxyz: Array) -> Sensor:
    """The noise of a recording, as its samples show it."""
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
    # Between the outermost samples a curve bends as it likes: there it is taken to bend on as two samples inside.
    for end, outside in ((0, grid < t[OUTER]), (-1, grid > t[-1 - OUTER])):
        for bend in (motion.a_S, motion.alpha_B):
            bend[outside] = bend[~outside][end]
    error = np.zeros(len(grid))
    for curve, seen, metres in ((position, sensor.position, 1.0), (turning, sensor.orientation, 2 * LEVER)):
        error = np.hypot(error, metres * options.certain * seen.whole * curve.acceleration_error(grid, 1 / rate))
        if seen.blur:  # steps last as long as the motion takes to pass one: no number of samples averages them out
            steps = options.certain * seen.step / np.sqrt(12) * curve.acceleration_error(grid, curve.spacing(grid))
            error = np.hypot(error, metres * steps)
    # Near the sampling's own limit a spline misses some of the acceleration: a quarter at the limit, by trial.
    fast = np.interp(grid, t, bandwidth)
    missed = 0.25 * np.linalg.norm(motion.a_S, axis=1) * (fast / most) ** 6
    unseen = standing_out(off(position.spline(t), p), rate, sensor.position, options.negligible, options.false_alarm)
    for found in standing_out(
        off(turning.spline(t), quat_wxyz), rate, sensor.orientation, turned, options.false_alarm
    ):  # by its place at the lever, and by the tilt of gravity
        place = 2 * (LEVER + 9.81 / (2 * np.pi * found.frequency) ** 2)
        unseen.append(replace(found, amplitude=place * found.amplitude))
    timed = (replace(x, first=t[x.first], last=t[np.minimum(x.last, len(t) - 1)]) for x in unseen if len(x.first))
    return Reading(motion, fast, error, missed, tuple(timed))


def _follow(
    t: Array, y: Array, level: NoiseLevel, rate: float, negligible: float, options: AuditOptions
) -> tuple[Fit, Array]:
    """Spline whose bandwidth (N,) is raised until its residuals are noise."""
    most, least = RESOLVED * rate, min(RESOLVED * rate, 1.5 / (t[-1] - t[0]))
    # Up to here noise leaves no error in the acceleration (0.1 m/s^2) that is worth smoothing away.
    unit = options.certain * level.whole * (2 * np.pi) ** 2 * np.sqrt(0.4 / rate)  # times f^2.5
    harmless = (0.1 / max(unit, 1e-300)) ** 0.4
    bandwidth = np.full(len(t), np.clip(min(harmless, options.usual), least, most))
    if not np.ptp(y, axis=0).any():
        bandwidth[:] = least
    while True:
        curve = fit(t, y, bandwidth)
        residual = off(curve.spline(t), y)
        wanted = _wanted(standing_out(residual, rate, level, negligible, options.false_alarm), len(t))
        raised = np.clip(FASTER * wanted, 1.2 * bandwidth, _GROWTH * bandwidth)
        raised = np.minimum(most, np.where(wanted > 0, raised, bandwidth))
        if np.all(raised <= bandwidth * (1 + 1e-9)):
            return curve, bandwidth
        bandwidth = raised


def _wanted(kinds: list[Oscillations], n: int) -> Array:
    """(n,) frequency that each sample is to follow next: that of the window in which most stands out; 0 where none."""
    first, last, frequency, excess = (
        np.concatenate([getattr(found, name) for found in kinds]) for name in ("first", "last", "frequency", "excess")
    )
    wanted = np.zeros(n)
    for k in np.argsort(-excess):
        if not wanted[first[k] : last[k]].any():
            wanted[first[k] : last[k]] = frequency[k]
    return wanted


def _instants(t: Array, bandwidth: Array) -> Array:
    """Dense enough for what is let through, both ends included."""
    fine = np.union1d(np.linspace(t[0], t[-1], 201), t)
    dense = _PER_PERIOD * np.interp(fine, t, bandwidth)
    passed = np.concatenate([[0.0], np.cumsum(0.5 * (dense[1:] + dense[:-1]) * np.diff(fine))])
    grid = np.interp(np.linspace(0, passed[-1], max(100, int(np.ceil(passed[-1]))) + 1), passed, fine)
    grid[[0, -1]] = t[[0, -1]]
    return np.unique(grid)


def _motion(t: Array, position: Fit, turning: Fit) -> MotionSamples:
    """Position and quaternion as seven numbers; the quaternion need not stay normalised.

    With Q = |Q| q: Q^-1 Q' has the vector part omega/2, and Q^-1 Q'' - (Q^-1 Q')^2 has alpha/2.
    """
    p, v, a = position(t)
    quat, rate, bend = turning(t)
    inverse = quat * CONJUGATE / np.sum(quat**2, axis=1, keepdims=True)
    spin = product(inverse, rate)
    turn = product(inverse, bend) - product(spin, spin)
    unit = quat / np.linalg.norm(quat, axis=1, keepdims=True)
    return MotionSamples(t, p, v, a, matrix_from_quat_wxyz(unit), 2 * spin[:, 1:], 2 * turn[:, 1:])
