"""Rules for the trust region of an iteration and the penalty on violations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from salver.geometry import Array


@dataclass
class Trust:
    """Trust region and penalty.

    damping: of the proximal term; small for a start near the optimum. depth: rows further than this from their limit
    are left out, for all blocks or for each (B,). penalty: per unit of violation. largest_shrink: reduction of the
    scalar, sigma = T^2 or the margin, in one iteration; at most `shrink`: 20 % of T.
    """

    damping: float = 1.0
    depth: float | Array = 0.2
    penalty: float = 0.0
    largest_shrink: float = 0.36
    shrink: float = 0.36
    least_damping: float = 0.0

    @property
    def hopeless(self) -> bool:
        return self.damping > 1e7  # a step of 1 mrad then costs more than any duration

    def priced(self, slack: float, worth: float) -> None:
        """Adapt the penalty after a subproblem, from its slack and the sum of its multipliers, `worth`.

        The penalty is kept just above `worth`, so that the violation alone does not decide on steps.
        """
        if slack > 1e-6:
            self.penalty *= 3
        elif self.penalty > 3 * worth:
            self.penalty = max(2 * worth, 0.3 * self.penalty, 1.0)

    def dearer(self) -> bool:
        """After ending with a violation: start again with ten times the penalty; False when it would be too large."""
        if self.penalty >= 1e4 or self.hopeless:
            return False
        self.penalty, self.damping = 10 * self.penalty, 1.0
        return True

    def accepted(self, ratio: float, share: float, change: Array) -> None:
        """Adapt to an accepted step: `ratio` of actual to predicted improvement, `share` of the step taken, largest
        change (B,) of the rows of each block."""
        self.depth = np.clip(2 * change, 0.02, 0.2)  # rows that the next step may reach
        if share < 1.0:
            factor = min(1 / share, 4.0)
        else:
            factor = 0.33 if ratio > 0.9 else 0.5 if ratio > 0.6 else 2.0 if ratio < 0.3 else 1.0
        self.damping = max(self.damping * factor, self.least_damping)
        if ratio > 0.3:
            self.largest_shrink = min(1.5 * self.largest_shrink, self.shrink)

    def rejected(self) -> None:
        """Adapt to a rejected step."""
        self.damping *= 4
        self.largest_shrink *= 0.5

    def failed(self) -> None:
        """Adapt to a subproblem that could not be solved."""
        self.damping *= 10
        self.largest_shrink *= 0.5
