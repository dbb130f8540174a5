"""First-order effect of changes of the tray's motion regressor on load dynamics and their wrench."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from salver.dynamics.modal_motion import ModalMotion, across, turned
from salver.dynamics.modal_state import ModalState
from salver.geometry import Array, Indices


@dataclass(frozen=True, eq=False)
class Change:
    """First-order effect of c changes of the tray's motion regressor on the modes.

    r, rate: (K, T, n_modes, 2, c) m and m/s, of each mass's place and speed. angle, turning: (K or 1, T, c) rad and
    rad/s, of the body about its axis. spun: (K or 1, T, 1, c) rad, of `ModalMotion.spin`. wrench: (K, T, 6, c) at E.
    ending: of each mode, (K, n_modes, 2, c) of its place and of its speed over its frequency, m.
    """

    r: Array
    rate: Array
    angle: Array
    turning: Array
    spun: Array
    wrench: Array
    ending: tuple[Array, Array]

    def part(self, some: slice | Indices) -> Change:
        """The effect in some of the cases."""
        ending = self.ending[0][some], self.ending[1][some]
        angle, turning, spun = (x if len(x) == 1 else x[some] for x in (self.angle, self.turning, self.spun))
        return Change(self.r[some], self.rate[some], angle, turning, spun, self.wrench[some], ending)

    @property
    def states(self) -> ModalState:
        """Changes of the modal states at each node, (T, K, ..., c)."""
        K, T, *_, c = self.r.shape
        turned = (np.broadcast_to(x, (K, T, c)) for x in (self.angle, self.turning))
        return ModalState(*(x.swapaxes(0, 1) for x in (self.r, self.rate, *turned, np.zeros((K, T, c)))))


def changed(modes: ModalMotion, dw: Array, start: ModalState | None = None) -> Change:
    """The first-order effect of changes dw (K or 1, T, 12, c) of the tray's motion regressor, which exist before the
    motion too. start: their effect on the modes up to then, if these do not begin at rest."""
    which, (angle, turning) = modes.cases, modes.turned_by(dw, start)
    spun = angle if which.round else turning
    r, rate, second = modes.pushed(dw, before=True, start=start, spun=spun)
    spun = spun[:, :, None] * modes.cases.round  # (K or 1, T, 1, c)
    force = which.at_O[:, None] @ dw  # (K, T, 3, c)
    ending = r[:, -1], rate[:, -1] / which.omega[..., None]

    def weighed(x: Array, dx: Array, mass: Array) -> tuple[Array, Array]:
        """Sums over the modes in the body's axes, (K, T, 2, 1), and their changes (K, T, 2, c)."""
        own = turned((mass[:, None] * x).sum(axis=2), -modes.spin)
        moved = np.einsum("kna,ktnac->ktac", mass, dx)
        return own[..., None], turned_each(moved, -modes.spin) - across(own)[..., None] * spun

    pushed = weighed(modes.second, second, which.mass)[1]
    tilted = weighed(modes.second, second, which.mass * which.height)[1]
    hung, hangs = weighed(modes.r, r, which.mass)
    f = modes.force[..., None]
    K, T, n, _, c = r.shape
    out = np.zeros((K, T, 6, c))
    out[:, :, :2] = pushed
    by_r, by_rate, by_second = (which.rising[:, None] * x for x in (modes.second, 2 * modes.rate, modes.r))
    for by, dx in ((by_r, r), (by_rate, rate), (by_second, second)):
        out[:, :, 2] += (by.reshape(K, T, 1, 2 * n) @ dx.reshape(K, T, 2 * n, c))[:, :, 0]
    out[:, :, 3] = hangs[:, :, 1] * f[:, :, 2] + hung[:, :, 1] * force[:, :, 2] - tilted[:, :, 1]
    out[:, :, 4] = tilted[:, :, 0] - hangs[:, :, 0] * f[:, :, 2] - hung[:, :, 0] * force[:, :, 2]
    out[:, :, 5] = hangs[:, :, 0] * f[:, :, 1] - hangs[:, :, 1] * f[:, :, 0]
    out[:, :, 5] += hung[:, :, 0] * force[:, :, 1] - hung[:, :, 1] * force[:, :, 0]
    return Change(r, rate, angle, turning, spun, which.to_E[:, None] @ out, ending)


def turned_each(x: Array, angle: Array) -> Array:
    """c vectors (..., 2, c) turned by angles (...), rad."""
    c, s, x, y = np.cos(angle)[..., None], np.sin(angle)[..., None], x[..., 0, :], x[..., 1, :]
    return np.stack([c * x - s * y, s * x + c * y], axis=-2)
