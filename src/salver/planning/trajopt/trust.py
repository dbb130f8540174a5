"""Trust region of an iteration, and the penalty of a violation: rules and numbers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from salver.geometry import Array

SHRINK = 0.36  # of sigma = T^2 in one iteration at most: 20 % of T


@dataclass
class Trust:
    """damping: of the proximal term; small for a start that is near the optimum. depth: rows further than this from
    their edge are left out, for all blocks or for each (B,). penalty: of a unit of violation. largest_shrink: of the
    scalar in one iteration.
    """

    damping: float = 1.0
    depth: float | Array = 0.2
    penalty: float = 0.0
    largest_shrink: float = SHRINK
    least_damping: float = 0.0

    @property
    def hopeless(self) -> bool:
        return self.damping > 1e7  # where a step of 1 mrad costs more than any duration

    def priced(self, slack: float, worth: float) -> None:
        """After a programme: `slack` it left, `worth` of a unit of violation to it.

        The penalty is kept just above that worth, so that steps are not judged by the violation alone.
        """
        if slack > 1e-6:
            self.penalty *= 3
        elif self.penalty > 3 * worth:
            self.penalty = max(2 * worth, 0.3 * self.penalty, 1.0)

    def dearer(self) -> bool:
        """After an end with a violation: begin again with ten times its price; False when that is too much."""
        if self.penalty >= 1e4 or self.hopeless:
            return False
        self.penalty, self.damping = 10 * self.penalty, 1.0
        return True

    def accepted(self, ratio: float, share: float, change: Array) -> None:
        """After a step that brought `ratio` of what was hoped for, of which a `share` was taken, and which changed
        rows of each block by `change` (B,) at most."""
        self.depth = np.clip(2 * change, 0.02, 0.2)  # what the next step may reach
        if share < 1.0:
            factor = min(1 / share, 4.0)
        else:
            factor = 0.33 if ratio > 0.9 else 0.5 if ratio > 0.6 else 2.0 if ratio < 0.3 else 1.0
        self.damping = max(self.damping * factor, self.least_damping)
        if ratio > 0.3:
            self.largest_shrink = min(1.5 * self.largest_shrink, SHRINK)

    def rejected(self) -> None:
        """After a step that was of no use."""
        self.damping *= 4
        self.largest_shrink *= 0.5

    def failed(self) -> None:
        """After a programme that could not be solved."""
        self.damping *= 10
        self.largest_shrink *= 0.5
