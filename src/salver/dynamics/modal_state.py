"""Modal states of what moves inside loads: from one motion to the next, and while the tray rests."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from salver.geometry import Array, Indices
from salver.linear_filter import at_instant, swinging_at


@dataclass(frozen=True, eq=False)
class ModalState:
    """K cases at one instant, or what c changes make of them, (..., c); or at several, (T, ...).

    r, rate: (K, n_modes, 2) of each moving mass, m and m/s. spin, turning: (K,) of the body about its axis, rad
    and rad/s. peak: (K,) m, how far the modes have gone till then (`ModalMotion.height`).
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
        """Of states at several instants, those at the last."""
        return ModalState(*(x[-1] for x in vars(self).values()))

    def of_terms(self, count: int) -> ModalState:
        """The states that the first of c changes cause."""
        return ModalState(*(x[..., :count] for x in vars(self).values()))

    def at(self, t: Array, now: float) -> ModalState:
        """At an instant, of those at nodes t (T,)."""
        swung, spun = (swinging_at(t, *pair, now) for pair in ((self.r, self.rate), (self.spin, self.turning)))
        return ModalState(*swung, *spun, at_instant(t, self.peak, now))

    def since(self, before: ModalState) -> ModalState:
        """The states beyond other ones."""
        return ModalState(*(x - y for x, y in zip(vars(self).values(), vars(before).values(), strict=True)))

    def later(self, t: Array, sigma: Array, kp: Array, rest: Array) -> ModalState:
        """The states at T instants t (T,), s, later, with the tray at rest: of masses that swing about `rest` (like
        r) with decay rates sigma (1/s) and stiffnesses kp (1/s^2) per mass, (K, n_modes, 2) or with a last axis of
        1. What is left over of a peak dies away as well."""
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
