"""What sensors say of a load: the loaded run less the empty one, channel by channel, with its errors' covariance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from salver.errors import FileFormatError
from salver.geometry import Array
from salver.learning import noise
from salver.learning.logs import Log

RUNS = 2  # of which a difference is


@dataclass(frozen=True, eq=False)
class State:
    """Of a log at N instants: what an arm without load would read, and what a load adds per unit of phi."""

    t: Array
    samples: int
    dq: Array
    tau: Array | None
    wrench: Array | None
    model: Array
    to_tau: Array | None
    to_wrench: Array

    @cached_property
    def times(self) -> noise.Times:
        return noise.Times.of(self.t, self.samples)


@dataclass(frozen=True, eq=False)
class Reading:
    """One sensor at N instants: values (N,) beyond what the prior's load makes, rows (N, 10) per unit of phi.

    told: its noise, as far as known beforehand. nuisance (N, m): other effects, per standard deviation.
    """

    name: str
    values: Array
    rows: Array
    told: noise.Noise
    nuisance: Array


@dataclass(frozen=True, eq=False)
class Channel:
    """A reading with the lower root (N, N) of its errors' covariance. residual: by how much it is noisier than told."""

    name: str
    values: Array
    rows: Array
    root: Array
    residual: float

    @classmethod
    def of(cls, reading: Reading, state: State, found: noise.Noise) -> Channel:
        """With that noise, or more where more is left of the values than it explains. One that is noisier than was told
        is taken to drift as much more."""
        larger = max(1.0, found.share(reading.told, 1))
        found = replace(found, bias=larger * found.bias, drift=larger * found.drift)
        covariance = RUNS * state.times.covariance(found) + reading.nuisance @ reading.nuisance.T
        made = cls(reading.name, reading.values, reading.rows, np.asarray(np.linalg.cholesky(covariance)), 1.0)
        white, left = made.white
        left = left - white @ np.linalg.lstsq(white, left, rcond=1e-8)[0]
        size = max(1.0, float(np.sqrt(np.sum(left**2) / max(1, len(left) - 10))))
        return replace(made, root=size * made.root, residual=size * found.share(reading.told, state.samples))

    @cached_property
    def white(self) -> tuple[Array, Array]:
        """Whitened rows (N, 10) and values (N,)."""
        return self._whitened(self.root, slice(None))

    def half(self, second: bool) -> tuple[Array, Array]:
        """Whitened rows and values of half of the instants, as if there were no others."""
        middle = len(self.values) // 2
        if not second:
            return self._whitened(self.root[:middle, :middle], slice(middle))
        below = self.root[middle:]
        return self._whitened(np.asarray(np.linalg.cholesky(below @ below.T)), slice(middle, None))

    def _whitened(self, root: Array, part: slice) -> tuple[Array, Array]:
        from scipy.linalg import solve_triangular

        both = np.column_stack([self.values[part], self.rows[part]])
        both = solve_triangular(root, both, lower=True, check_finite=False)
        return both[:, 1:], both[:, 0]


def differences(state: State, without: State, log: Log, empty: Log, prior: tuple[Array, Array]) -> list[Channel]:
    """What every sensor says more than along the empty run."""
    found: list[Reading] = []
    (phi_0, spread), nothing = prior, np.zeros((len(state.t), 0))

    def at(values: Array) -> Array:
        """(N, m) of the empty run at the loaded run's instants."""
        return np.stack([np.interp(state.t, without.t, column) for column in values.T], axis=1)

    def add(name: str, values: Array, rows: Array, told: noise.Noise, nuisance: Array) -> None:
        found.append(Reading(name, values - rows @ phi_0, rows, told, nuisance))

    if state.tau is not None and state.to_tau is not None and without.tau is not None:
        difference, before = state.tau - at(without.tau), at(without.dq)
        coulomb, viscous = noise.FRICTION
        for j in range(difference.shape[1]):
            here, there = state.dq[:, j], before[:, j]
            changed = [coulomb * np.tanh(here / noise.STILL[1]), viscous * here]
            other = [np.tanh(here / still) - np.tanh(there / still) for still in noise.STILL]
            nuisance = np.column_stack([*changed, *(noise.ALL_FRICTION * x for x in (*other, here - there))])
            add("joint torques", difference[:, j], state.to_tau[:, j], noise.TORQUE, nuisance)
    if state.wrench is not None and without.wrench is not None:
        difference = state.wrench - at(without.wrench)
        for j in range(6):
            told, name = (noise.FORCE, "wrist forces") if j < 3 else (noise.MOMENT, "wrist torques")
            add(name, difference[:, j], state.to_wrench[:, j], told, nothing)
    if not found:
        raise FileFormatError(
            f"{log.source} and {empty.source} share no sensor; both must hold tau, or both wrench_F (fx to tz)."
        )
    return _weighed(found, state, spread)


def _weighed(readings: Sequence[Reading], state: State, spread: Array) -> list[Channel]:
    """The noise of each is looked for in what the load, as the others show it if they err as told, does not explain."""
    shown = []
    for reading in readings:
        white, left = Channel.of(reading, state, reading.told).white
        shown.append(white.T @ np.column_stack([white, left]))
    channels = []
    for reading, own in zip(readings, shown, strict=True):
        others = np.sum(shown, axis=0) - own
        covariance = np.linalg.inv(np.diag(1 / (3 * spread) ** 2) + others[:, :10])
        root = np.linalg.cholesky(0.5 * (covariance + covariance.T))
        left = reading.values - reading.rows @ (covariance @ others[:, 10])
        effects = np.hstack([reading.rows @ root, reading.nuisance])
        channels.append(Channel.of(reading, state, state.times.found(reading.told, left, effects, RUNS)))
    return channels
