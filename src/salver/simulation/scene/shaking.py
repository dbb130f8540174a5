"""A tray that shakes, as those who stand on it feel it.

Seen from the shaking tray every body of mass m and inertia I is pushed by -m (a + alpha x c) and turned by -I alpha,
with a and alpha what the shake accelerates the tray by and c from its middle to the body. So the tray itself stays
where the arm holds it, and what stands on it moves against it as it would on one that shakes. A run has one direction
and one axis, drawn by its seed, at the highest frequency, at which a shake of a given amplitude pushes most.
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
    """shift: (3,) m, and turn: (3,) rad, amplitudes in S, with a phase (rad) each; rate: 2 pi times the frequency."""

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
        """a, with what a turned tray feels of gravity, and alpha, in S, (3,) or (T, 3), at t: s or (T,)."""
        shift, turn = (
            np.sin(self.rate * np.asarray(t) + phase)[..., None] * way
            for way, phase in zip((self.shift, self.turn), self.phases, strict=True)
        )
        return -(self.rate**2) * shift + np.cross(turn, GRAVITY_S), -(self.rate**2) * turn

    def push(self, model: Any, data: Any, ids: Indices, p_SE: Array, t: float) -> None:
        """Set the forces of an instant on bodies of the engine, whose poses in `data` are current."""
        a, alpha = self.at(t)
        push = a + np.cross(alpha, data.xipos[ids] - p_SE)
        data.xfrc_applied[ids, :3] = -model.body_mass[ids, None] * push
        if self.turn.any():
            axes = data.ximat[ids].reshape(-1, 3, 3)
            data.xfrc_applied[ids, 3:] = -np.einsum("bij,bj,bkj,k->bi", axes, model.body_inertia[ids], axes, alpha)
