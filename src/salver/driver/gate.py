"""The last check of a command before it goes to an arm."""

from __future__ import annotations

from typing import Any

import numpy as np

from salver.geometry import Array


class Gate:
    """Passes finite numbers only, within the limits of a command and of its rate.

    Where no number comes in, the joint keeps the command it had. closed: how often that was so. cut: how often
    limits were asked to be overstepped.
    """

    def __init__(self, least: Array, most: Array, rate: Array, period: float, start: Array) -> None:
        """least, most: (n,) of the command, N m, rad or rad/s. rate: (n,) of its change per second. Infinite where
        there is none. start: (n,), the command that acts now."""
        self._least, self._most, self._step = least, most, rate * period
        self._sent = np.clip(np.where(np.isfinite(start), start, 0.0), least, most)
        self.closed = self.cut = 0

    def __call__(self, command: Any) -> Array:
        """The command (n,) that may be sent in this period."""
        try:
            wanted = np.array(command, dtype=float)
        except (TypeError, ValueError):
            wanted = np.full_like(self._sent, np.nan)
        if wanted.shape != self._sent.shape:
            wanted = np.full_like(self._sent, np.nan)
        good = np.isfinite(wanted)
        if not good.all():
            self.closed += 1
            wanted = np.where(good, wanted, self._sent)
        least = np.maximum(self._sent - self._step, self._least)
        most = np.minimum(self._sent + self._step, self._most)
        sent = np.minimum(np.maximum(wanted, least), most)
        self.cut += bool((sent != wanted).any())
        self._sent = sent
        return sent.copy()
