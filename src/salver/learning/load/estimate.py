"""The load and the systematic errors of its sensors, from all runs together, by generalised least squares.

Unknowns are phi, with the scenario's ranges as its prior, and every systematic error e in units of its bound, with a
standard deviation of 1 as its prior. With C = (H + P)^-1 the estimate of phi has the error -C_phi,e e besides its
noise, which is added to its ranges for |e| <= 1. The covariance of its noise is C_phi,phi - C_phi,e C_e,phi. C_phi,e is
small for an error that the runs show.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_triangular

from salver.geometry import Array, interpolated
from salver.learning.load.channels import ChannelReading
from salver.learning.load.noise import RUNS
from salver.learning.load.ranges import WIDTH, Estimate
from salver.learning.load.systematic import Felt, SensorBounds, SystematicError, torque_errors, wrist_errors
from salver.models.rigid_body import inertia_entries, parallel_axis

Key = tuple[str, int]  # an error's name, and the number of its run or -1


@dataclass(frozen=True, eq=False)
class LoadSolution:
    """The estimate of a load.

    noisiest, residual: the channel with the largest ratio of noise to assumed noise, and that ratio. denied: sentence
    about a systematic error that exceeds its bound, or None. shares: contributions of noise and of each kind of error
    to the mass's half-range, kg.
    """

    estimate: Estimate
    noisiest: str
    residual: float
    denied: str | None
    shares: dict[str, float]
    sensors: set[str]


def solve(
    runs: Sequence[Sequence[ChannelReading]], weights: Sequence[float], prior: tuple[Array, Array], bounds: SensorBounds
) -> LoadSolution:
    """Estimate the load from the readings of all runs, each with a weight."""
    phi, spread = prior
    delays = _first_delays(runs, bounds)
    for k in range(8):  # linearised about the prior, then about the estimate, until the delays settle
        errors, channels, information, pull = _normal(runs, weights, prior, phi, delays, bounds)
        known = np.diag(np.concatenate([1 / spread**2, np.ones(len(errors))]))
        covariance = np.asarray(np.linalg.inv(information + known), dtype=float)
        found = covariance @ pull
        phi, seen = prior[0] + found[:10], found[10:]
        if phi[0] <= 0:  # no valid load to linearise about
            break
        late = {e.of: x * bounds.delay for e, x in zip(errors, seen.clip(-20, 20), strict=True) if e.kind == "delay"}
        settled = all(abs(late[sensor] - delays[sensor]) < 0.01 * bounds.delay for sensor in late)
        delays = late
        if settled and k >= 2:
            break
    variance = np.diag(covariance)[10:]
    systematic = covariance[:10, 10:]
    noise = covariance[:10, :10] - systematic @ systematic.T
    shift = np.zeros(3)
    for error, value, v in zip(errors, seen, variance, strict=True):
        if error.kind == "slip":
            axis = "xy".index(error.of)
            shift[axis] = max(shift[axis], 0.5 * error.bound * min(1.0, abs(value) + WIDTH * np.sqrt(v)))
    residual, noisiest = max(channels)
    shares = defaultdict[str, float](float, {"noise": WIDTH * float(np.sqrt(noise[0, 0]))})
    for error, part in zip(errors, systematic[0], strict=True):
        shares[error.kind] += abs(float(part))
    return LoadSolution(
        Estimate(phi, noise, systematic, shift),
        noisiest,
        residual,
        _denied(errors, seen, variance),
        dict(shares),
        {name for _, name in channels},
    )


def _first_delays(runs: Sequence[Sequence[ChannelReading]], bounds: SensorBounds) -> dict[str, float]:
    """The delay of each sensor, s, from which to linearise: up to 20 bounds, that of the best least-squares load."""
    tried, left = bounds.delay * np.arange(-20.0, 21.0, 2.0), dict[str, Array]()
    for reading in (reading for readings in runs for reading in readings):
        t, wide = reading.motion.t, reading.rows.shape[2]
        square = []
        for delay in tried:
            rows = interpolated(t, reading.rows, t - delay).reshape(-1, wide)
            values = reading.values.ravel()
            square.append(np.sum((values - rows @ np.linalg.lstsq(rows, values, rcond=1e-8)[0]) ** 2))
        left[reading.sensor] = left.get(reading.sensor, np.zeros(len(tried))) + square
    return {sensor: float(tried[np.argmin(each)]) for sensor, each in left.items()}


def _normal(
    runs: Sequence[Sequence[ChannelReading]],
    weights: Sequence[float],
    prior: tuple[Array, Array],
    phi: Array,
    delays: dict[str, float],
    bounds: SensorBounds,
) -> tuple[list[SystematicError], list[tuple[float, str]], Array, Array]:
    """The systematic errors, the ratio of noise to assumed noise of each channel with its name, and the normal
    equations of phi and the errors, linearised about a load and delays of sensors, s."""
    index, errors, parts, noisier = dict[Key, int](), list[SystematicError](), [], list[tuple[float, str]]()
    slid = _slid(phi)
    for number, (readings, weight) in enumerate(zip(runs, weights, strict=True)):
        for reading in readings:
            motion, links = reading.motion, reading.links
            delay = delays[reading.sensor]
            reading = replace(reading, rows=interpolated(motion.t, reading.rows, motion.t - delay))
            felt = Felt(motion.t, motion.q, reading.rows @ phi, np.stack([reading.rows @ x for x in slid]))
            own = list(wrist_errors(bounds, felt) if links is None else torque_errors(bounds, felt, links))
            late = next(error.effect for error in own if error.kind == "delay")  # the rows include it already
            reading = replace(reading, values=reading.values + late * delay / bounds.delay)
            keys = [(error.name, number if error.run else -1) for error in own]
            for key, error in zip(keys, own, strict=True):
                if key not in index:
                    index[key] = len(errors)
                    errors.append(error)
            columns = [*range(10), *(10 + index[key] for key in keys)]
            effects = np.stack([error.effect for error in own], axis=2)
            for j, name in enumerate(reading.names):
                rows, values, times = _whitened(reading, j, effects[:, j], prior)
                parts.append((columns, weight * rows.T @ rows, weight * rows.T @ values))
                noisier.append((times, name))
    information, pull = np.zeros((10 + len(errors), 10 + len(errors))), np.zeros(10 + len(errors))
    for columns, square, values in parts:
        information[np.ix_(columns, columns)] += square
        pull[columns] += values
    return errors, noisier, information, pull


def _whitened(
    reading: ChannelReading, j: int, effects: Array, prior: tuple[Array, Array]
) -> tuple[Array, Array, float]:
    """Rows (N, 10 + K) for phi and for systematic errors in their bounds, and values (N,), whitened by the estimated
    noise of a channel, or by more if the residual is larger; and the ratio of noise to assumed noise."""
    noise, rows, nuisance, told = reading.motion.noise, reading.rows[:, j], reading.nuisance[j], reading.told[j]
    left = reading.values[:, j] - rows @ prior[0]
    here = effects[:, np.any(effects, axis=0)]
    # Systematic errors up to ten times their bounds do not count as noise.
    level = noise.found(told, left, np.hstack([3 * prior[1] * rows, nuisance, 10 * here]), RUNS)
    root = np.linalg.cholesky(RUNS * noise.covariance(level) + nuisance @ nuisance.T)
    both = solve_triangular(root, np.column_stack([left, rows, effects]), lower=True, check_finite=False)
    values, white = both[:, 0], both[:, 1:]
    solution, _, rank, _ = np.linalg.lstsq(white, values, rcond=1e-8)
    rest = values - white @ solution
    size = max(1.0, float(np.sqrt(np.sum(rest**2) / max(1, len(values) - rank))))
    return white / size, values / size, size * level.share(told, noise.samples)


def _denied(errors: Sequence[SystematicError], seen: Array, variance: Array, least: float = 4.0) -> str | None:
    """A sentence about the systematic error that exceeds its bound most, or None: by the runs alone, without its prior,
    it is m / (1 - v) +- (v / (1 - v))^.5 bounds. least: standard deviations beyond its bound from which on it is
    refused."""
    left = np.maximum(1 - variance, 1e-12)
    beyond = (np.abs(seen) / left - 1) / np.sqrt(variance / left)
    beyond[[error.kind == "filter_time" for error in errors]] = -np.inf  # smoothing of deviations has a similar effect
    worst = int(np.argmax(beyond))
    if beyond[worst] <= least:
        return None
    error, times = errors[worst], abs(seen[worst]) / left[worst]
    return (
        f"{error.name} looks {times:.1f} times as large as its bound of {error.bound:g}: that bound is wrong, "
        "something slid, the empty run is of another arm or tray, or the sensor is not where it is said to be."
    )


def _slid(phi: Array) -> Array:
    """Change (2, 10) of phi per m of slip along x and y."""
    if phi[0] <= 0:
        return np.zeros((2, 10))
    m, c = phi[0], phi[1:4] / phi[0]
    out = np.zeros((2, 10))
    for k, e in enumerate(np.eye(3)[:2]):
        out[k, 1:4] = m * e
        out[k, 4:] = inertia_entries(parallel_axis(m, c + e / 2) - parallel_axis(m, c - e / 2))
    return out
