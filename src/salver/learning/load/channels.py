"""Sensor channels of a load: readings of the loaded run minus those of the empty one."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from salver.errors import FileFormatError
from salver.geometry import Array, interpolated
from salver.learning.load.noise import BlockNoise, ChannelNoise, SensorNoise
from salver.learning.logs import Log


@dataclass(frozen=True, eq=False)
class SensedMotion:
    """A log at N instants: torques and wrench minus those of the model of arm and empty tray, and their derivatives by
    phi of a load. links (k, N, n): torques that each link needs."""

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
    def noise(self) -> BlockNoise:
        return BlockNoise.of(self.t, self.samples)


@dataclass(frozen=True, eq=False)
class ChannelReading:
    """A sensor with m channels at N instants: values (N, m) caused by the load, rows (N, m, 10) per unit of phi.

    names, told: name and assumed noise of each channel. nuisance: other effects on each channel (N, .), per standard
    deviation. links: as in `SensedMotion`, for joint torques.
    """

    names: tuple[str, ...]
    values: Array
    rows: Array
    told: tuple[ChannelNoise, ...]
    nuisance: tuple[Array, ...]
    motion: SensedMotion
    links: Array | None = None

    @property
    def sensor(self) -> str:
        return "wrist" if self.links is None else "joint torques"


def differences(motion: SensedMotion, without: SensedMotion, log: Log, empty: Log) -> list[ChannelReading]:
    """Readings of every sensor minus those of the empty run."""
    found, sensors = list[ChannelReading](), SensorNoise()

    def more(values: Array, before: Array) -> Array:
        """Values (N, m) minus those of the empty run at the loaded run's instants."""
        return np.asarray(values - interpolated(without.t, before, motion.t))

    def unlike(own: Array) -> Array:
        """Possible errors (N, 3) of the arm's and tray's own contribution to a channel beyond the empty run's (N,), in
        size and in time, because deviations from the plan are smoothed."""
        (share, time), rate = sensors.unlike, np.gradient(own, motion.t)
        return np.column_stack([share * own, time * rate, time**2 * np.gradient(rate, motion.t)])

    if motion.tau is not None and motion.to_tau is not None and without.tau is not None:
        (coulomb, viscous), dq, n = sensors.friction, motion.dq, motion.tau.shape[1]
        changed = [coulomb * np.tanh(dq / 0.03), viscous * dq]
        other = [more(np.tanh(dq / v), np.tanh(without.dq / v)) for v in sensors.standstill]
        of_each = np.stack([*changed, *(sensors.all_friction * x for x in (*other, more(dq, without.dq)))])
        own = more(motion.model, without.model)
        nuisance = tuple(np.hstack([of_each[:, :, j].T, unlike(own[:, j])]) for j in range(n))
        names, told = ("joint torques",) * n, (sensors.torque,) * n
        values = more(motion.tau, without.tau)
        found.append(ChannelReading(names, values, motion.to_tau, told, nuisance, motion, motion.links))
    if motion.wrench is not None and without.wrench is not None:
        names = ("wrist forces",) * 3 + ("wrist torques",) * 3
        told = (sensors.force,) * 3 + (sensors.moment,) * 3
        nuisance = tuple(map(unlike, more(motion.tray, without.tray).T))
        values = more(motion.wrench, without.wrench)
        found.append(ChannelReading(names, values, motion.to_wrench, told, nuisance, motion))
    if not found:
        raise FileFormatError(
            f"{log.source} and {empty.source} share no sensor; both must hold tau, or both wrench_F (fx to tz)."
        )
    return found
