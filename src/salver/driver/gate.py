"""The last thing a torque passes on its way to an arm."""

from __future__ import annotations

from typing import Any

import numpy as np

from salver.geometry import Array


class TorqueGate:
    """Lets out numbers only, within the limits of torque and of its rate, whatever comes in.

    Where no number comes in, the joint keeps the torque it had. closed: how often that was so. cut: how often
    limits were asked to be overstepped.
    """

    def __init__(self, limit: Array, rate: Array, period: float, start: Array) -> None:
        """limit, rate: (n,) N m, N m/s; infinite where there is none. start: (n,) N m, the torque that acts now."""
        self._limit, self._step = limit, rate * period
        self._sent = np.clip(np.where(np.isfinite(start), start, 0.0), -limit, limit)
        self.closed = self.cut = 0

    def __call__(self, torque: Any) -> Array:
        """The torque (n,) that may be sent in this period."""
        try:
            wanted = np.array(torque, dtype=float)
        except (TypeError, ValueError):
            wanted = np.full_like(self._sent, np.nan)
        if wanted.shape != self._sent.shape:
            wanted = np.full_like(self._sent, np.nan)
        good = np.isfinite(wanted)
        if not good.all():
            self.closed += 1
            wanted = np.where(good, wanted, self._sent)
        least = np.maximum(self._sent - self._step, -self._limit)
        most = np.minimum(self._sent + self._step, self._limit)
        sent = np.minimum(np.maximum(wanted, least), most)
        self.cut += bool((sent != wanted).any())
        self._sent = sent
        return sent.copy()
