"""The last check of a command before it goes to an arm."""

from __future__ import annotations

from typing import Any

import numpy as np

from salver.geometry import Array


class Gate:
    """Passes finite commands only, limited in value and rate.

    A joint with a command that is not finite keeps the last one. closed: how often that happened. cut: how often a
    limit was applied.
    """

    def __init__(self, least: Array, most: Array, rate: Array, period: float, start: Array) -> None:
        """least, most: (n,) limits of the command, N m, rad or rad/s. rate: (n,) limit of its change per second; all
        infinite without a limit. start: (n,) the present command."""
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
