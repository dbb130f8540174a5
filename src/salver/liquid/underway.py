"""Modal states of waves: from one motion to the next, and while the tray rests."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from salver.geometry import Array, Indices
from salver.sensitivity.filter import at_instant, swinging_at


@dataclass(frozen=True, eq=False)
class Underway:
    """Waves of K cases at one instant, or what c changes make of them, (..., c); or at several, (T, ...).

    r, rate: (K, n_modes, 2) of each moving mass, m and m/s. spin, turning: (K,) of the container about its axis, rad
    and rad/s. peak: (K,) m, how high the linear wave has been till then.
    """

    r: Array
    rate: Array
    spin: Array
    turning: Array
    peak: Array

    def part(self, some: slice | Indices) -> Underway:
        """The states of some of the cases."""
        return Underway(*(x[some] for x in vars(self).values()))

    def of_terms(self, count: int) -> Underway:
        """The states that the first of c changes cause."""
        return Underway(*(x[..., :count] for x in vars(self).values()))

    def at(self, t: Array, now: float) -> Underway:
        """At an instant, of those at nodes t (T,)."""
        swung, spun = (swinging_at(t, *pair, now) for pair in ((self.r, self.rate), (self.spin, self.turning)))
        return Underway(*swung, *spun, at_instant(t, self.peak, now))

    def since(self, before: Underway) -> Underway:
        """The states beyond other ones."""
        return Underway(*(x - y for x, y in zip(vars(self).values(), vars(before).values(), strict=True)))

    def later(self, t: Array, sigma: Array, kp: Array, rest: Array) -> Underway:
        """The states at T instants t (T,), s, later, with the tray at rest: of masses that swing about `rest` (like
        r) with decay rates sigma (1/s) and stiffnesses kp (1/s^2) per mass, (K, n_modes, 2) or with a last axis of
        1. What is left over of a peak is a wave too, and dies away as one."""
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
        return Underway(r, rate, spin, np.zeros_like(spin), peak)
