"""A simulated arm whose sensors have systematic errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from salver.geometry import Array, interpolated
from salver.learning.load.sensors import heavier
from salver.planning.plan import Plan
from sensed_arm import SensedArm

LEVER = 0.05  # m, ratio of the ranges of moments and forces of a wrist sensor


@dataclass(frozen=True)
class Defects:
    """Systematic errors of a sensor: sizes, each with a random sign in every channel.

    In all runs: scale: share. cross_talk: share of every other channel, through `LEVER` between forces and torques.
    position (m), tilt (rad): of a wrist sensor from the flange, about each axis. delay: s. bandwidth: Hz of a
    first-order filter. With the load only: force_bias, moment_bias, torque_bias: N, N m, N m. cable: N, change of the
    pull of a hose with the posture. links: relative change of the links' masses. seed: seed of the signs.
    """

    force_bias: float = 0.0
    moment_bias: float = 0.0
    torque_bias: float = 0.0
    scale: float = 0.0
    cross_talk: float = 0.0
    position: float = 0.0
    tilt: float = 0.0
    delay: float = 0.0
    bandwidth: float = np.inf
    cable: float = 0.0
    links: float = 0.0
    seed: int = 0

    def late(self, t: Array, values: Array) -> Array:
        """Values (K, m) at times (K,), delayed and filtered."""
        if self.delay:
            values = interpolated(t, values, t - self.delay)
        if np.isfinite(self.bandwidth):
            from scipy.signal import lfilter

            pole = np.exp(-2 * np.pi * self.bandwidth * np.median(np.diff(t)))
            values = values[0] + lfilter([1 - pole], [1, -pole], values - values[0], axis=0)
        return values


class WrongArm(SensedArm):
    """A `SensedArm` with systematic errors of its sensors."""

    def __init__(self, plan: Plan, seed: int, *given: Any, defects: Defects, **named: Any) -> None:
        super().__init__(plan, seed, *given, **named)
        self.defects, self.other = defects, self.model.copy()
        self.signs = np.random.default_rng([defects.seed, 1]).choice([-1.0, 1.0], (12, 12))
        heavier(self.other, {k: 1 + defects.links * self.signs[11, k] for k in range(1, self.model.njoints - 1)})

    def sensed(self, t: Array, q: Array, tau: Array, wrench: Array, loaded: bool) -> tuple[Array, Array]:
        from scipy.spatial.transform import Rotation

        d, signs = self.defects, self.signs
        turn = Rotation.from_rotvec(d.tilt * signs[0, :3])
        force, moment = wrench[:, :3], wrench[:, 3:] - np.cross(d.position * signs[1, :3], wrench[:, :3])
        wrench = np.hstack([turn.inv().apply(force), turn.inv().apply(moment)])
        unit = np.array([1.0] * 3 + [LEVER] * 3)
        mixed = np.diag(1 + d.scale * signs[2, :6]) + d.cross_talk * (signs[3:9, :6] * (1 - np.eye(6)))
        wrench = d.late(t, wrench @ (unit[:, None] * mixed / unit).T)
        tau = d.late(t, tau * (1 + d.scale * signs[9, : self.arm.n]))
        if loaded:
            bent = np.linalg.norm(q - q[0], axis=1)
            pull = d.cable * (1 - np.cos(np.pi * bent / bent.max())) / 2
            bias = np.array([d.force_bias] * 3 + [d.moment_bias] * 3)
            wrench = wrench + signs[10, :6] * (bias + unit * pull[:, None])
            tau = tau + d.torque_bias * signs[10, 6:][np.arange(self.arm.n) % 6]
        return tau, wrench
