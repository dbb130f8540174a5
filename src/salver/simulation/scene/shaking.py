"""Vibration of the tray, simulated as inertial forces on the load.

In the frame of a vibrating tray, the force -m (a + alpha x c) and the moment -I alpha act on a body of mass m and
inertia I, with a and alpha the accelerations of the vibration and c the vector from the tray's centre to the body. So
the tray stays where the arm holds it, and the load moves relative to it as on a vibrating tray. A run has one random
direction and one random axis, and the highest frequency, at which a given amplitude has the largest acceleration.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from salver.geometry import GRAVITY_S, Array, Indices

if TYPE_CHECKING:
    from salver.models.uncertain.parameters import Vibration


@dataclass(frozen=True)
class Shaking:
    """A sinusoidal vibration: amplitudes shift (3,) m and turn (3,) rad in S, phases in rad, rate in rad/s."""

    shift: Array
    turn: Array
    phases: tuple[float, float]
    rate: float

    @classmethod
    def drawn(cls, shake: Vibration, seed: int) -> Self:
        rng = np.random.default_rng([seed, 2])
        ways = rng.standard_normal((2, 3))
        shift, turn = ways / np.linalg.norm(ways, axis=1, keepdims=True)
        first, second = (2 * np.pi * rng.random(2)).tolist()
        return cls(shake.amplitude * shift, shake.tilt * turn, (first, second), 2 * np.pi * shake.frequency)

    def at(self, t: Array | float) -> tuple[Array, Array]:
        """Accelerations a (including gravity on the turned tray) and alpha in S, (3,) or (T, 3), at t, s or (T,)."""
        shift, turn = (
            np.sin(self.rate * np.asarray(t) + phase)[..., None] * way
            for way, phase in zip((self.shift, self.turn), self.phases, strict=True)
        )
        return -(self.rate**2) * shift + np.cross(turn, GRAVITY_S), -(self.rate**2) * turn

    def push(self, model: Any, data: Any, ids: Indices, p_SE: Array, t: float) -> None:
        """Set the forces at time t, s, on bodies of the engine; poses in `data` must be current."""
        a, alpha = self.at(t)
        push = a + np.cross(alpha, data.xipos[ids] - p_SE)
        data.xfrc_applied[ids, :3] = -model.body_mass[ids, None] * push
        if self.turn.any():
            axes = data.ximat[ids].reshape(-1, 3, 3)
            data.xfrc_applied[ids, 3:] = -np.einsum("bij,bj,bkj,k->bi", axes, model.body_inertia[ids], axes, alpha)
