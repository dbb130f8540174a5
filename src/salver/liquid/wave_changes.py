"""First-order effect of changes of the tray's motion regressor on the waves of a liquid and on its wrench."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from salver.geometry import Array, Indices
from salver.liquid.underway import Underway
from salver.liquid.waves import TURNING, Waves, across, turned
from salver.models.liquid import GRAVITY, TILTING


@dataclass(frozen=True, eq=False)
class Change:
    """First-order effect of c changes of the tray's motion regressor on waves.

    eta, free: (K, T, 2, c) of the waves' heights along both axes, m. thrown: (K, T, c) of what tilting throws up, m.
    wrench: (K, T, 6, c) at E. ending: of each mode, (K, n_modes, 2, c) of its place and of its speed over its
    frequency, m.
    """

    eta: Array
    free: Array
    thrown: Array
    wrench: Array
    ending: tuple[Array, Array]

    def part(self, some: slice | Indices) -> Change:
        """The effect in some of the cases."""
        ending = self.ending[0][some], self.ending[1][some]
        return Change(self.eta[some], self.free[some], self.thrown[some], self.wrench[some], ending)


def changed(waves: Waves, dw: Array, start: Underway | None = None) -> Change:
    """To first order, by changes dw (K or 1, T, 12, c) of the tray's motion regressor, before the motion too. start:
    what they have made of the waves till then, where these do not begin at rest."""
    which, spun = waves.cases, waves.spun(dw, start)
    r, rate, second = waves.pushed(dw, before=True, start=start, spun=spun)
    spun = spun[:, :, None] * waves.cases.round  # (K or 1, T, 1, c)
    force = which.at_O[:, None] @ dw  # (K, T, 3, c)
    lateral = turned_each(force[:, :, :2], waves.spin)
    slope = (lateral - waves.slope[..., None] * force[:, :, 2:]) / waves.upward[:, :, None, None]
    slope += across(waves.slope)[..., None] * spun
    eta = np.einsum("kna,ktnac->ktac", which.gain, r) - which.rest_rise[:, None, :, None] * slope
    ending = r[:, -1], rate[:, -1] / which.omega[..., None]

    def weighed(x: Array, dx: Array, mass: Array) -> tuple[Array, Array]:
        """Sums over the modes in the container's axes, (K, T, 2, 1), and their changes (K, T, 2, c)."""
        own = turned((mass[:, None] * x).sum(axis=2), -waves.spin)
        moved = np.einsum("kna,ktnac->ktac", mass, dx)
        return own[..., None], turned_each(moved, -waves.spin) - across(own)[..., None] * spun

    pushed = weighed(waves.second, second, which.mass)[1]
    tilted = weighed(waves.second, second, which.mass * which.height)[1]
    hung, hangs = weighed(waves.r, r, which.mass)
    f = waves.force[..., None]
    K, T, n, _, c = r.shape
    out = np.zeros((K, T, 6, c))
    out[:, :, :2] = pushed
    by_r, by_rate, by_second = (which.rising[:, None] * x for x in (waves.second, 2 * waves.rate, waves.r))
    for by, dx in ((by_r, r), (by_rate, rate), (by_second, second)):
        out[:, :, 2] += (by.reshape(K, T, 1, 2 * n) @ dx.reshape(K, T, 2 * n, c))[:, :, 0]
    out[:, :, 3] = hangs[:, :, 1] * f[:, :, 2] + hung[:, :, 1] * force[:, :, 2] - tilted[:, :, 1]
    out[:, :, 4] = tilted[:, :, 0] - hangs[:, :, 0] * f[:, :, 2] - hung[:, :, 0] * force[:, :, 2]
    out[:, :, 5] = hangs[:, :, 0] * f[:, :, 1] - hangs[:, :, 1] * f[:, :, 0]
    out[:, :, 5] += hung[:, :, 0] * force[:, :, 1] - hung[:, :, 1] * force[:, :, 0]
    thrown = TILTING / GRAVITY * which.wide[:, None, None] ** 2 * (TURNING @ dw)
    wrench = which.to_E[:, None] @ out
    return Change(eta, eta + which.half[:, None, :, None] * slope, thrown, wrench, ending)


def turned_each(x: Array, angle: Array) -> Array:
    """c vectors (..., 2, c) turned by angles (...), rad."""
    c, s, x, y = np.cos(angle)[..., None], np.sin(angle)[..., None], x[..., 0, :], x[..., 1, :]
    return np.stack([c * x - s * y, s * x + c * y], axis=-2)
