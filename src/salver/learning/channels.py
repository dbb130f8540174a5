"""What sensors say of a load: the loaded run less the empty one, channel by channel, with its errors' covariance."""

from __future__ import annotations

from dataclasses import dataclass
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
    to_tau: Array
    to_wrench: Array

    @cached_property
    def times(self) -> noise.Times:
        return noise.Times.of(self.t, self.samples)


@dataclass(frozen=True, eq=False)
class Channel:
    """One sensor at N instants: values (N,) beyond what the prior's load makes, rows (N, 10) per unit of phi, their
    covariance (N, N). residual: by how much it is noisier than was told."""

    name: str
    values: Array
    rows: Array
    covariance: Array
    residual: float

    @classmethod
    def of(
        cls, name: str, values: Array, rows: Array, told: noise.Noise, nuisance: Array, state: State, spread: Array
    ) -> Channel:
        """nuisance (N, m): other effects, per standard deviation. spread (10,): of phi. The noise is found."""
        found = state.times.found(told, values, np.hstack([rows * spread, nuisance]), RUNS)
        covariance = RUNS * found.covariance(state.t, state.samples) + nuisance @ nuisance.T
        made = cls(name, values, rows, covariance, 1.0)
        white, left = made.white(slice(None))
        left = left - white @ np.linalg.lstsq(white, left, rcond=1e-8)[0]
        size = max(1.0, float(np.sqrt(np.sum(left**2) / max(1, len(left) - 10))))
        residual = size * found.share(told, state.samples)
        return cls(name, values, rows, size**2 * covariance, residual)

    def white(self, part: slice) -> tuple[Array, Array]:
        """Whitened rows and values of some of the instants."""
        root = np.linalg.cholesky(self.covariance[part, part])
        both = np.linalg.solve(root, np.column_stack([self.values[part], self.rows[part]]))
        return both[:, 1:], both[:, 0]


def differences(state: State, without: State, log: Log, empty: Log, prior: tuple[Array, Array]) -> list[Channel]:
    """What every sensor says more than along the empty run."""
    found: list[Channel] = []
    (phi_0, spread), nothing = prior, np.zeros((len(state.t), 0))

    def at(values: Array) -> Array:
        """(N, m) of the empty run at the loaded run's instants."""
        return np.stack([np.interp(state.t, without.t, column) for column in values.T], axis=1)

    def add(name: str, values: Array, rows: Array, told: noise.Noise, nuisance: Array) -> None:
        found.append(Channel.of(name, values - rows @ phi_0, rows, told, nuisance, state, 3 * spread))

    if state.tau is not None and without.tau is not None:
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
    return found
