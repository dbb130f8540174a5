"""From recorded poses to a motion, and what of the motion the recording cannot show.

The curve is found from below: a slow spline first, made faster where its residuals still hold anything that can be
told from white noise (`salver.auditing.noise`), until nothing is left or the samples allow no more. What is left then
is told: by frequency and amplitude (`Cells`), together with what is so small that noise would hide it (`Hidden`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from salver.auditing.noise import Cells, Level, found, least, level, principal, resolution, stepped
from salver.auditing.spline import Fit, fit
from salver.geometry import Array, matrix_from_quat_wxyz
from salver.trajectory import MotionSamples

RESOLVED = 0.4  # of the sampling rate: content up to there has an acceleration that is known
NEGLIGIBLE = 0.02  # m/s^2: amplitude of an oscillation that is let be
USUAL = 12.0  # Hz: bandwidth to begin with
HARMLESS = 0.1  # m/s^2: error of the acceleration that is not worth smoothing away
LEVER = 0.1  # m: what turns is judged by how it moves something so far away
PER_PERIOD = 12  # instants judged per period of the bandwidth, so 24 of what it follows: peaks are met to 0.9 %
CHUNK, OVERLAP = 8192, 1024  # samples fitted at once
FASTER = 2.0  # bandwidth over the frequency that was found: its acceleration is then met to 2 %
_STEP = 1.7  # by which the bandwidth grows at most between two looks at the residuals
_ROUNDS = 30
_MISSED = 0.25
_OUTER = 2  # samples
_PROBES = (0.03, 0.06, 0.12, 0.25)  # of the rate: bandwidths behind which noise is looked for
_CONJUGATE = np.array([1.0, -1.0, -1.0, -1.0])
_SPREAD = 4.5  # standard deviations in `acceleration_error`: exceeded once in some 10^5 instants


@dataclass(frozen=True)
class Sensor:
    """What is known of the noise: of position (m) and orientation (rad, half the angle, in the frame that turns)."""

    position: Level
    orientation: Level

    @property
    def displacement(self) -> float:
        """m: standard deviation of a sample of something `LEVER` away from the frame."""
        return float(np.hypot(self.position.whole, 2 * LEVER * self.orientation.whole))


@dataclass(frozen=True)
class Stretch:
    """A part of a recording, or the whole.

    motion: at the instants to be judged. bandwidth (T,): Hz. acceleration_error (T,): m/s^2, by which the
    acceleration may be wrong by noise, and missed (T,), by which a spline so fast falls short of it. unseen: what
    stands out of the noise and is in the samples but not in the motion, as displacements in m and times in s.
    mirrored: the same for content whose true frequency may be the sampling rate less what it seems. louder: (T,) by
    which noise is more than the sensor's.
    """

    motion: MotionSamples
    bandwidth: Array
    acceleration_error: Array
    missed: Array
    unseen: tuple[Cells, ...]
    mirrored: tuple[Cells, ...]
    louder: Array


def sensor_of(t: Array, p: Array, quat_wxyz: Array) -> Sensor:
    """The noise of a recording, as its samples show it."""
    n = len(t)
    length = min(n, CHUNK)
    parts = [slice(s, s + length) for s in np.linspace(0, n - length, min(8, 1 + n // length)).astype(int)]
    return Sensor(
        *(_level([(t[part], y[part]) for part in parts], max(resolution(y), stepped(y))) for y in (p, quat_wxyz))
    )


def _level(parts: list[tuple[Array, Array]], step: float) -> Level:
    """The least of what is found behind any of the probes, in the middle of the parts."""
    probed = [_probed(t, y) for t, y in parts]
    if not all(probed):
        return Level.even(0.0, step)
    axes = principal(np.concatenate([residuals[-1][1] for residuals in probed]))
    sizes = np.median([_sizes(residuals, axes) for residuals in probed], axis=0)
    # What is rounded is off any smooth curve; what is smooth may still be whole multiples of something.
    off = np.concatenate([np.abs(residuals[-1][1]).max(axis=1) for residuals in probed])
    return Level(axes, sizes, step if np.mean(off > 0.05 * step) > 0.01 else 0.0)


def _probed(t: Array, y: Array) -> list[tuple[float, Array]]:
    """(cut, residuals) of fits with each of the bandwidths `_PROBES` that the samples allow."""
    rate, n = (len(t) - 1) / (t[-1] - t[0]), len(t)
    return [(cut, _residual(fit(t, y, np.full(n, cut * rate)), t, y)) for cut in _PROBES if cut >= 3 / n]


def _residual(curve: Fit, t: Array, y: Array) -> Array:
    """(N, 3) by which samples are off a curve. Quaternions: as half the rotation vector from curve to sample, in the
    frame that turns, where noise is the same whichever way it is turned (along the quaternion itself there is none)."""
    on = np.asarray(curve.spline(t))
    if y.shape[1] == 3:
        return y - on
    return _product(on * _CONJUGATE, y - on)[:, 1:]


def _sizes(residuals: list[tuple[float, Array]], axes: Array) -> Array:
    sizes, errors = [], []
    for cut, residual in residuals:
        own = residual @ axes
        top = next((probe for probe in _PROBES if probe > cut), 0.5)
        size, error = level(own, cut, max(2.0 * cut, top))
        # A few samples far off are no noise: their median is not moved by them. It errs by 1.17 / sqrt(n).
        sizes += [size, np.median(np.abs(own), axis=0) / (0.6745 * np.sqrt(1 - 2 * cut))]
        errors += [error, 1.17 / np.sqrt(len(own) * (1 - 2 * cut))]
    known = np.isfinite(errors)
    return least(np.array(sizes)[known], np.array(errors)[known])


def stretches(
    t: Array, p: Array, quat_wxyz: Array, sensor: Sensor, highest: float, jitter: float = 0.0
) -> list[Stretch]:
    """The recording in parts of at most `CHUNK` samples, each fitted with its neighbours.

    highest: Hz, above which the tray is taken not to shake; only such content can be mirrored. jitter: s, standard
    deviation of the times of the samples: noise that grows with the speed.
    """
    n = len(t)
    count = max(1, int(np.ceil(n / CHUNK)))
    edges = np.linspace(0, n, count + 1).astype(int)
    out = []
    for first, last in pairwise(edges):
        begin, end = max(0, first - OVERLAP), min(n, last + OVERLAP)
        part = slice(begin, end)
        inner = (float(t[first]), float(t[min(last, n - 1)]))
        out.append(_stretch(t[part], p[part], quat_wxyz[part], sensor, highest, inner, (begin == 0, end == n), jitter))
    return out


def _stretch(
    t: Array,
    p: Array,
    quat: Array,
    sensor: Sensor,
    highest: float,
    inner: tuple[float, float],
    ends: tuple[bool, bool],
    jitter: float,
) -> Stretch:
    rate = 1 / float(np.median(np.diff(t)))
    most = RESOLVED * rate
    louder = _louder(t, p, quat, sensor, most, jitter)
    position, bandwidth = _follow(t, p, sensor.position, rate, most, NEGLIGIBLE, ends, louder)
    turning, agile = _follow(t, quat, sensor.orientation, rate, most, NEGLIGIBLE / (2 * LEVER), ends, louder)
    unseen = _left(t, p, quat, position, turning, sensor, rate, louder)
    mirrored: tuple[Cells, ...] = ()
    clear = rate - highest
    if clear < most:
        slow = max(clear, 0.5 / (t[-1] - t[0]))
        slower = fit(t, p, np.minimum(bandwidth, slow))
        turned = fit(t, quat, np.minimum(agile, slow))
        mirrored = _left(t, p, quat, slower, turned, sensor, rate, louder)
    grid = _instants(t, np.maximum(bandwidth, agile), inner)[0 if ends[0] else 1 :]  # the first one ended a part
    motion = _motion(grid, position, turning)
    # Between the outermost samples a curve bends as it likes: there it is taken to bend on as two samples inside, place
    # and turn alike. What is at rest in one of them only is a motion that nobody made.
    for end, one_sided in ((0, grid < t[_OUTER]), (-1, grid > t[-1 - _OUTER])):
        if not (position.rest[end] and turning.rest[end]) and not one_sided.all():
            for bend in (motion.a_S, motion.alpha_B):
                bend[one_sided] = bend[~one_sided][end]
    error = np.zeros(len(grid))
    for curve, seen, metres in ((position, sensor.position, 1.0), (turning, sensor.orientation, 2 * LEVER)):
        noise = _SPREAD * seen.whole * np.interp(grid, t, louder)
        error = np.hypot(error, metres * noise * curve.acceleration_error(grid, 1 / rate, bent=True))
        if seen.blur:  # steps last as long as the motion takes to pass one: no number of samples averages them out
            steps = seen.step / np.sqrt(12) * curve.acceleration_error(grid, curve.spacing(grid), bent=True)
            error = np.hypot(error, metres * steps)
    # Near the sampling's own limit a spline misses some of the acceleration: a quarter at the limit, by trial.
    fast = np.interp(grid, t, np.maximum(bandwidth / most, agile / most))
    missed = _MISSED * np.linalg.norm(motion.a_S, axis=1) * fast**6
    return Stretch(
        motion,
        np.interp(grid, t, np.maximum(bandwidth, agile)),
        error,
        missed,
        tuple(_within(cells, t, inner) for cells in unseen),
        tuple(_within(cells, t, inner) for cells in mirrored),
        np.interp(grid, t, louder),
    )


def _follow(
    t: Array,
    y: Array,
    level: Level,
    rate: float,
    most: float,
    negligible: float,
    ends: tuple[bool, bool],
    louder: Array,
) -> tuple[Fit, Array]:
    """Spline whose bandwidth (N,) is raised until its residuals are noise."""
    n = len(t)
    if not np.ptp(y, axis=0).any():
        slowest = np.full(n, min(most, 1.5 / (t[-1] - t[0])))
        return fit(t, y, slowest, ends), slowest
    bandwidth = np.full(n, np.clip(min(_harmless(level.whole * louder.max(), rate), USUAL), 1.5 / (t[-1] - t[0]), most))
    for _ in range(_ROUNDS):
        curve = fit(t, y, bandwidth)
        kinds = found(_residual(curve, t, y) / louder[:, None], rate, level, negligible)
        wanted = _wanted(kinds[1:], n)
        raised = np.maximum(bandwidth, np.minimum(FASTER * wanted, _STEP * bandwidth))
        raised = np.minimum(most, np.where(wanted > 0, np.maximum(raised, 1.2 * bandwidth), bandwidth))
        if np.all(raised <= bandwidth * (1 + 1e-9)):
            break
        bandwidth = raised
    noticed = sum(len(cells.first) for cells in kinds)
    at_rest = [False, False]
    for end in (0, 1):
        asked = (at_rest[0] or end == 0, end == 1)
        if ends[end]:
            resting = fit(t, y, bandwidth, asked)
            kinds = found(_residual(resting, t, y) / louder[:, None], rate, level, negligible)
            if sum(len(cells.first) for cells in kinds) <= noticed:
                curve, at_rest[end] = resting, True
    return curve, bandwidth


def _harmless(noise: float, rate: float) -> float:
    """Bandwidth (Hz) up to which noise leaves no error in the acceleration that matters (`HARMLESS`)."""
    unit = noise * (2 * np.pi) ** 2 * np.sqrt(0.4 / rate)  # times f^2.5: white noise below f, twice differentiated
    return float((HARMLESS / max(_SPREAD * unit, 1e-300)) ** 0.4)


def _wanted(kinds: list[Cells], n: int) -> Array:
    """(n,) frequency that each sample is to follow next: that of the window in which most stands out; 0 where none."""
    first, last, frequency, excess = (
        np.concatenate([getattr(cells, name) for cells in kinds]) for name in ("first", "last", "frequency", "excess")
    )
    wanted = np.zeros(n)
    for k in np.argsort(-excess):
        if not wanted[first[k] : last[k]].any():
            wanted[first[k] : last[k]] = frequency[k]
    return wanted


def _left(
    t: Array, p: Array, quat: Array, position: Fit, turning: Fit, sensor: Sensor, rate: float, louder: Array
) -> tuple[Cells, ...]:
    """What stands out in the residuals, as displacements in m; of turning, at `LEVER` and by the tilt of gravity."""
    off, turned_off = _residual(position, t, p) / louder[:, None], _residual(turning, t, quat) / louder[:, None]
    cells = found(off, rate, sensor.position, NEGLIGIBLE)
    for turned in found(turned_off, rate, sensor.orientation, NEGLIGIBLE / (2 * LEVER)):
        metres = LEVER + 9.81 / (2 * np.pi * turned.frequency) ** 2
        cells.append(replace(turned, amplitude=2 * metres * turned.amplitude))
    middle = [(c.first + c.last) // 2 for c in cells]
    return tuple(replace(c, amplitude=c.amplitude * louder[k]) for c, k in zip(cells, middle, strict=True))


def _louder(t: Array, p: Array, quat: Array, sensor: Sensor, most: float, jitter: float) -> Array:
    """(N,) by which noise is more than the sensor's, where the times of the samples are uncertain by `jitter`, s."""
    if not jitter:
        return np.ones(len(t))
    calm = np.full(len(t), min(USUAL, most))
    speed = np.linalg.norm(fit(t, p, calm)(t)[1], axis=1)
    turning = 2 * np.linalg.norm(fit(t, quat, calm)(t)[1], axis=1)
    return np.sqrt(1 + (jitter / max(sensor.displacement, 1e-9)) ** 2 * (speed**2 + (LEVER * turning) ** 2))


def _within(cells: Cells, t: Array, inner: tuple[float, float]) -> Cells:
    """Cells whose middle lies inside, in s."""
    middle = 0.5 * (t[cells.first] + t[np.minimum(cells.last, len(t) - 1)]) if len(cells.first) else np.zeros(0)
    k = (middle >= inner[0]) & (middle <= inner[1])
    last = np.minimum(cells.last, len(t) - 1)
    return Cells(t[cells.first][k], t[last][k], cells.frequency[k], cells.amplitude[k], cells.excess[k], cells.share[k])


def _instants(t: Array, bandwidth: Array, inner: tuple[float, float]) -> Array:
    """Dense enough for what is let through, both ends included."""
    fine = np.union1d(np.linspace(t[0], t[-1], 201), t)
    dense = PER_PERIOD * np.interp(fine, t, bandwidth)
    passed = np.concatenate([[0.0], np.cumsum(0.5 * (dense[1:] + dense[:-1]) * np.diff(fine))])
    low, high = np.interp(inner, fine, passed)
    count = max(100, int(np.ceil(high - low)))
    grid = np.interp(np.linspace(low, high, count + 1), passed, fine)
    grid[0], grid[-1] = inner
    return np.unique(grid)


def _motion(t: Array, position: Fit, turning: Fit) -> MotionSamples:
    """Position and quaternion as seven numbers; the quaternion need not stay normalised.

    With Q = |Q| q: Q^-1 Q' has the vector part omega/2, and Q^-1 Q'' - (Q^-1 Q')^2 has alpha/2.
    """
    p, v, a = position(t)
    quat, rate, bend = turning(t)
    inverse = quat * _CONJUGATE / np.sum(quat**2, axis=1, keepdims=True)
    spin = _product(inverse, rate)
    turn = _product(inverse, bend) - _product(spin, spin)
    unit = quat / np.linalg.norm(quat, axis=1, keepdims=True)
    return MotionSamples(t, p, v, a, matrix_from_quat_wxyz(unit), 2 * spin[:, 1:], 2 * turn[:, 1:])


def _product(a: Array, b: Array) -> Array:
    """Products (N, 4) of quaternions (w, x, y, z)."""
    w = a[:, 0] * b[:, 0] - np.einsum("ij,ij->i", a[:, 1:], b[:, 1:])
    xyz = a[:, :1] * b[:, 1:] + b[:, :1] * a[:, 1:] + np.cross(a[:, 1:], b[:, 1:])
    return np.concatenate([w[:, None], xyz], axis=1)
