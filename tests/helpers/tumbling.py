"""A motion from rest to rest that turns about changing axes, with rates in closed form."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from numpy.polynomial import Polynomial

from salver.geometry import Array, exp
from salver.trajectory import MotionSamples

STEP = Polynomial([0, 0, 0, 10, -15, 6])
HUMP = 64 * Polynomial([0, 0, 0, 1]) * Polynomial([1, -1]) ** 3  # 0 at both ends with two derivatives, 1 halfway


@dataclass(frozen=True)
class Tumbling:
    """R = R_start Exp(step turn) Exp(hump tumble), p = p_start + step (p_goal - p_start) + hump sway."""

    duration: float
    p_start: Array
    p_goal: Array
    turn: Array
    tumble: Array
    sway: Array = field(default_factory=lambda: np.zeros(3))
    R_start: Array = field(default_factory=lambda: np.eye(3))

    def sample(self, t: npt.ArrayLike) -> MotionSamples:
        t = np.atleast_1d(np.asarray(t, dtype=float))
        u = np.clip(t / self.duration, 0, 1)
        (s, ds, dds), (h, dh, ddh) = (
            [(p.deriv(k) if k else p)(u)[:, None] / self.duration**k for k in range(3)] for p in (STEP, HUMP)
        )
        way, first, second = self.p_goal - self.p_start, exp(s * self.turn), exp(h * self.tumble)

        def seen(x: Array) -> Array:  # after the second rotation
            return np.einsum("tji,tj->ti", second, x)

        own, carried = dh * self.tumble, seen(ds * self.turn)
        return MotionSamples(
            t,
            self.p_start + s * way + h * self.sway,
            ds * way + dh * self.sway,
            dds * way + ddh * self.sway,
            self.R_start @ first @ second,
            carried + own,
            seen(dds * self.turn) - np.cross(own, carried) + ddh * self.tumble,
        )


def tumbling(duration: float, seed: int = 3) -> Tumbling:
    """A random one, over some metres and turns of some 80 degrees: in 1 s, far from what any tray does."""
    start, goal, sway, turn, tumble = np.random.default_rng(seed).normal(size=(5, 3))
    return Tumbling(duration, start, goal, 0.8 * turn, 0.8 * tumble, 2 * sway, exp([0.4, -0.3, 1.0]))
