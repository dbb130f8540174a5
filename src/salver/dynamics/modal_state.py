"""Modal states of load dynamics: from one motion to the next, and while the tray rests."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from salver.geometry import Array, Indices
from salver.linear_filter import at_instant, swinging_at


@dataclass(frozen=True, eq=False)
class ModalState:
    """Modal states of K cases at one instant; or at several, (T, ...); or their changes by c changes, (..., c).

    r, rate: (K, n_modes, 2) position and velocity of each moving mass, m and m/s. spin, turning: (K,) rotation of the
    body about its axis, rad and rad/s. peak: (K,) largest `ModalMotion.height` so far, m.
    """

    r: Array
    rate: Array
    spin: Array
    turning: Array
    peak: Array

    def part(self, some: slice | Indices) -> ModalState:
        """The states of some of the cases."""
        return ModalState(*(x[some] for x in vars(self).values()))

    @property
    def last(self) -> ModalState:
        """The states at the last of several instants."""
        return ModalState(*(x[-1] for x in vars(self).values()))

    def of_terms(self, count: int) -> ModalState:
        """The effect of the first `count` of c changes."""
        return ModalState(*(x[..., :count] for x in vars(self).values()))

    def at(self, t: Array, now: float) -> ModalState:
        """The states at the instant `now`, from those at nodes t (T,)."""
        swung, spun = (swinging_at(t, *pair, now) for pair in ((self.r, self.rate), (self.spin, self.turning)))
        return ModalState(*swung, *spun, at_instant(t, self.peak, now))

    def since(self, before: ModalState) -> ModalState:
        """The difference from other states."""
        return ModalState(*(x - y for x, y in zip(vars(self).values(), vars(before).values(), strict=True)))

    def later(self, t: Array, sigma: Array, kp: Array, rest: Array) -> ModalState:
        """The states t (T,) seconds later, with the tray at rest: masses swing about `rest` (shape of r) with decay
        rates sigma (1/s) and stiffnesses per mass kp (1/s^2), (K, n_modes, 2) or with a last axis of 1. The peak's
        residual decays as well."""
        after = t.reshape(-1, *(1,) * self.r.ndim)
        omega = np.sqrt(kp - sigma**2)
        fading = np.exp(-sigma * after)
        cosine, sine, away = fading * np.cos(omega * after), fading * np.sin(omega * after) / omega, self.r - rest
        r = rest + (cosine + sigma * sine) * away + sine * self.rate
        rate = (cosine - sigma * sine) * self.rate - kp * sine * away
        spin = np.broadcast_to(self.spin, (len(t), *self.spin.shape))
        slowest = sigma.reshape(len(sigma), -1).min(axis=1) / 3  # of the peak's third power
        fading = np.exp(-np.multiply.outer(t, slowest))
        peak = self.peak * fading.reshape(*fading.shape, *(1,) * (self.peak.ndim - 1))
        return ModalState(r, rate, spin, np.zeros_like(spin), peak)
