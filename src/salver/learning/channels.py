"""What sensors say of a load: the loaded run less the empty one, channel by channel, with its errors' covariance."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from salver.errors import FileFormatError
from salver.geometry import Array
from salver.learning import noise
from salver.learning.logs import Log
from salver.learning.systematic import Felt, SensorBounds, SystematicError, torque_errors, wrist_errors

RUNS = 2  # of which a difference is
BEYOND = 10.0  # times its bound, up to which a systematic error is not taken for noise


@dataclass(frozen=True, eq=False)
class State:
    """Of a log at N instants: tau and wrench beyond what an arm with an empty tray would read, which is model and tray;
    and what a load adds per unit of phi. links (k, N, n): what joint torques need for each link."""

    t: Array
    samples: int
    q: Array
    dq: Array
    tau: Array | None
    wrench: Array | None
    model: Array
    tray: Array
    to_tau: Array | None
    to_wrench: Array
    links: Array | None

    @cached_property
    def times(self) -> noise.Times:
        return noise.Times.of(self.t, self.samples)


@dataclass(frozen=True, eq=False)
class Reading:
    """A sensor of m channels at N instants: values (N, m) that the load makes, rows (N, m, 10) per unit of phi.

    names, told (m): of each channel, and its noise as far as known beforehand. nuisance (m): (N, .) other effects, per
    standard deviation. links: as in `State`, of joint torques.
    """

    names: tuple[str, ...]
    values: Array
    rows: Array
    told: tuple[noise.Noise, ...]
    nuisance: tuple[Array, ...]
    state: State
    links: Array | None = None

    def channels(self, bounds: SensorBounds, at: Load, spread: Array) -> tuple[list[SystematicError], list[Channel]]:
        """Linearised about a load and a delay: systematic errors, and channels whose values are what is left."""
        state = self.state
        own = "joint torques" if self.links is not None else "wrist"
        delay = at.delays.get(own, 0.0)
        rows = _later(state.t, self.rows, delay)
        felt = Felt(state.t, state.q, rows @ at.phi, np.stack([rows @ slid for slid in at.slid]))
        made = wrist_errors(bounds, felt) if self.links is None else torque_errors(bounds, felt, self.links)
        errors = list(made)
        effects = np.stack([error.effect for error in errors], axis=2)
        left = self.values - rows @ at.known
        late = next(k for k, error in enumerate(errors) if error.kind == "delay")
        left = left + effects[:, :, late] * delay / bounds.delay  # which the rows have already
        found = []
        for j, name in enumerate(self.names):
            own_effects = effects[:, j]
            here = own_effects[:, np.any(own_effects, axis=0)]
            parts = np.hstack([3 * spread * rows[:, j], self.nuisance[j], BEYOND * here])
            size = state.times.found(self.told[j], left[:, j], parts, RUNS)
            found.append(
                Channel.of(
                    name, left[:, j], np.hstack([rows[:, j], own_effects]), self.nuisance[j], state, self.told[j], size
                )
            )
        return errors, found


@dataclass(frozen=True, eq=False)
class Load:
    """About which readings are linearised: known and phi (10,) before and by now, slid (2, 10): by how much phi changes
    per m along x and y. delays: s of each sensor."""

    known: Array
    phi: Array
    slid: Array
    delays: dict[str, float]


@dataclass(frozen=True, eq=False)
class Channel:
    """values (N,) and rows (N, 10 + K), per unit of phi and of systematic errors per bound, whitened. residual: by how
    much it is noisier than told."""

    name: str
    values: Array
    rows: Array
    residual: float

    @classmethod
    def of(
        cls,
        name: str,
        values: Array,
        rows: Array,
        nuisance: Array,
        state: State,
        told: noise.Noise,
        found: noise.Noise,
    ) -> Channel:
        """With the noise that was found, or more where more is left of the values than it explains."""
        from scipy.linalg import solve_triangular

        root = np.linalg.cholesky(RUNS * state.times.covariance(found) + nuisance @ nuisance.T)
        both = solve_triangular(root, np.column_stack([values, rows]), lower=True, check_finite=False)
        left, white = both[:, 0], both[:, 1:]
        solution, _, rank, _ = np.linalg.lstsq(white, left, rcond=1e-8)
        rest = left - white @ solution
        size = max(1.0, float(np.sqrt(np.sum(rest**2) / max(1, len(left) - rank))))
        return cls(name, left / size, white / size, size * found.share(told, state.samples))


def differences(state: State, without: State, log: Log, empty: Log) -> list[Reading]:
    """What every sensor says more than along the empty run."""
    found: list[Reading] = []

    def at(values: Array) -> Array:
        """(N, m) of the empty run at the loaded run's instants."""
        return np.stack([np.interp(state.t, without.t, column) for column in values.T], axis=1)

    if state.tau is not None and state.to_tau is not None and without.tau is not None:
        before, n = at(without.dq), state.tau.shape[1]
        coulomb, viscous = noise.FRICTION
        nuisance = []
        unlike = state.model - at(without.model)
        for here, there, own in zip(state.dq.T, before.T, unlike.T, strict=True):
            changed = [coulomb * np.tanh(here / noise.STILL[1]), viscous * here]
            other = [np.tanh(here / still) - np.tanh(there / still) for still in noise.STILL]
            friction = np.column_stack([*changed, *(noise.ALL_FRICTION * x for x in (*other, here - there))])
            nuisance.append(np.hstack([friction, _unlike(state.t, own)]))
        names = ("joint torques",) * n
        found.append(
            Reading(
                names,
                state.tau - at(without.tau),
                state.to_tau,
                (noise.TORQUE,) * n,
                tuple(nuisance),
                state,
                state.links,
            )
        )
    if state.wrench is not None and without.wrench is not None:
        names = ("wrist forces",) * 3 + ("wrist torques",) * 3
        kinds = (noise.FORCE,) * 3 + (noise.MOMENT,) * 3
        nuisance = [_unlike(state.t, column) for column in (state.tray - at(without.tray)).T]
        found.append(
            Reading(
                names,
                state.wrench - at(without.wrench),
                state.to_wrench,
                kinds,
                tuple(nuisance),
                state,
            )
        )
    if not found:
        raise FileFormatError(
            f"{log.source} and {empty.source} share no sensor; both must hold tau, or both wrench_F (fx to tz)."
        )
    return found


def _unlike(t: Array, own: Array) -> Array:
    """(N, 3) by how much what arm and tray themselves need otherwise than in the empty run (N,) may be wrong: in size
    and in time, as deviations from the plan are smoothed."""
    share, time = noise.SMOOTHED
    rate = np.gradient(own, t)
    return np.column_stack([share * own, time * rate, time**2 * np.gradient(rate, t)])


def _later(t: Array, rows: Array, delay: float) -> Array:
    """Rows (N, ...) at times that are earlier by a delay."""
    if not delay:
        return rows
    flat = rows.reshape(len(t), -1)
    return np.stack([np.interp(t - delay, t, column) for column in flat.T], axis=1).reshape(rows.shape)
