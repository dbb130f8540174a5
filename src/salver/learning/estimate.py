"""The load and the systematic errors of its sensors, from all runs at once, by generalised least squares.

Unknowns are phi, with the scenario's ranges as its prior, and every systematic error e in units of its bound, with a
standard deviation of 1 as its prior. With C = (H + P)^-1 the estimate of phi errs by -C_phi,e e besides its noise: so
much is added to its ranges for |e| <= 1. The covariance of its noise is C_phi,phi - C_phi,e C_e,phi. Of an error that
the runs show, C_phi,e is small.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from salver.geometry import Array
from salver.learning.channels import Channel, Load, Reading
from salver.learning.ranges import WIDTH, Estimate
from salver.learning.systematic import SensorBounds, SystematicError
from salver.models.rigid_body import inertia_entries, parallel_axis

ROUNDS = 3  # of linearisation: about the prior, then about what was found
SEEN = 4.0  # standard deviations beyond its bound at which a systematic error is taken to be there

Key = tuple[str, int]  # an error's name, and the number of its run or -1


@dataclass(frozen=True, eq=False)
class Solution:
    """noisiest, residual: the channel that is most noisier than was told, by how many times. denied: which systematic
    error is surely beyond its bound. shares: kg of the mass's half-range by noise and by each kind of error."""

    estimate: Estimate
    noisiest: str
    residual: float
    denied: str | None
    shares: dict[str, float]
    sensors: set[str]


def solve(
    runs: Sequence[Sequence[Reading]], weights: Sequence[float], prior: tuple[Array, Array], bounds: SensorBounds
) -> Solution:
    """From what sensors felt in each run, which weighs so much."""
    phi, spread = prior
    delays = dict[str, float]()
    for _ in range(ROUNDS):
        at = Load(prior[0], phi, _slid(phi), delays)
        errors, channels, information, pull = _normal(runs, weights, at, spread, bounds)
        covariance = np.asarray(
            np.linalg.inv(information + np.diag(np.concatenate([1 / spread**2, np.ones(len(errors))]))), dtype=float
        )
        found = covariance @ pull
        phi, seen = prior[0] + found[:10], found[10:]
        if phi[0] <= 0:  # nothing to linearise about
            break
        delays = {
            e.of: float(np.clip(x, -5, 5)) * bounds.delay
            for e, x in zip(errors, seen, strict=True)
            if e.kind == "delay"
        }
    variance = np.diag(covariance)[10:]
    systematic = covariance[:10, 10:]
    noise = covariance[:10, :10] - systematic @ systematic.T
    shift = np.zeros(3)
    for error, value, v in zip(errors, seen, variance, strict=True):
        if error.kind == "slip":
            axis = "xy".index(error.of)
            shift[axis] = max(shift[axis], 0.5 * error.bound * min(1.0, abs(value) + WIDTH * np.sqrt(v)))
    worst = max(channels, key=lambda channel: channel.residual)
    shares = defaultdict[str, float](float, {"noise": WIDTH * float(np.sqrt(noise[0, 0]))})
    for error, part in zip(errors, systematic[0], strict=True):
        shares[error.kind] += abs(float(part))
    return Solution(
        Estimate(phi, noise, systematic, shift),
        worst.name,
        worst.residual,
        _denied(errors, seen, variance),
        dict(shares),
        {channel.name for channel in channels},
    )


def _normal(
    runs: Sequence[Sequence[Reading]], weights: Sequence[float], at: Load, spread: Array, bounds: SensorBounds
) -> tuple[list[SystematicError], list[Channel], Array, Array]:
    """Systematic errors, channels, and the normal equations of phi and these."""
    index, errors, parts, used = dict[Key, int](), list[SystematicError](), [], list[Channel]()
    for number, (readings, weight) in enumerate(zip(runs, weights, strict=True)):
        for reading in readings:
            own, channels = reading.channels(bounds, at, spread)
            for error in own:
                key = error.name, number if error.run else -1
                if key not in index:
                    index[key] = len(errors)
                    errors.append(error)
            columns = [*range(10), *(10 + index[e.name, number if e.run else -1] for e in own)]
            rows = np.vstack([channel.rows for channel in channels])
            values = np.concatenate([channel.values for channel in channels])
            parts.append((columns, weight * rows.T @ rows, weight * rows.T @ values))
            used += channels
    information, pull = np.zeros((10 + len(errors), 10 + len(errors))), np.zeros(10 + len(errors))
    for columns, square, values in parts:
        information[np.ix_(columns, columns)] += square
        pull[columns] += values
    return errors, used, information, pull


def _denied(errors: Sequence[SystematicError], seen: Array, variance: Array) -> str | None:
    """What is said of the error that is furthest beyond its bound, if it surely is: by the runs alone, without the
    prior of its own, it is m / (1 - v) +- (v / (1 - v))^.5 bounds."""
    left = np.maximum(1 - variance, 1e-12)
    beyond = (np.abs(seen) / left - 1) / np.sqrt(variance / left)
    beyond[[error.kind == "filter_time" for error in errors]] = -np.inf  # deviations that are smoothed look like it
    worst = int(np.argmax(beyond))
    if beyond[worst] <= SEEN:
        return None
    error, times = errors[worst], abs(seen[worst]) / left[worst]
    return (
        f"{error.name} looks {times:.1f} times as large as its bound of {error.bound:g}: that bound is wrong, "
        "something slid, the empty run is of another arm or tray, or the sensor is not where it is said to be."
    )


def _slid(phi: Array) -> Array:
    """(2, 10) by how much phi changes per m along x and y."""
    if phi[0] <= 0:
        return np.zeros((2, 10))
    m, c = phi[0], phi[1:4] / phi[0]
    out = np.zeros((2, 10))
    for k, e in enumerate(np.eye(3)[:2]):
        out[k, 1:4] = m * e
        out[k, 4:] = inertia_entries(parallel_axis(m, c + e / 2) - parallel_axis(m, c - e / 2))
    return out
