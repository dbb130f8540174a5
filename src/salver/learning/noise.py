"""How sensors err: covariances over time, and whitening by them.

Errors of a channel at times d apart have the covariance

    K(d) = white^2 [d = 0] + coloured^2 exp(-|d| / 30 ms) + bias^2 + drift^2 exp(-d^2 / (2 0.8^2 s^2)).

Ordinary least squares takes them all for white; its ranges then cover the truth in a few runs of a hundred.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from salver.geometry import Array

COLOUR = 0.03  # s over which coloured noise forgets
SLOW = 0.8  # s over which a drift moves


@dataclass(frozen=True)
class Noise:
    """Standard deviations of one channel, in its unit. white: of a single sample."""

    white: float
    coloured: float
    bias: float
    drift: float

    def covariance(self, t: Array, samples: int) -> Array:
        """(N, N) of means over `samples` samples each, around times t (N,)."""
        apart = np.abs(t[:, None] - t[None, :])
        slow = self.drift**2 * np.exp(-0.5 * (apart / SLOW) ** 2)
        out = self.coloured**2 * np.exp(-apart / COLOUR) + self.bias**2 + slow
        out[np.diag_indices(len(t))] += self.white**2 / samples
        return np.asarray(out)


# Of one run; a difference of two has twice the covariance. Joint torques of a Panda are good to some 0.1 N m
# (franka_ros, issue 404); a wrist sensor with a noise of 0.05 N and 2 mN m, tared with the empty tray before each run.
TORQUE = Noise(0.057, 0.057, 0.15, 0.03)
FORCE = Noise(0.035, 0.035, 0.015, 0.015)
MOMENT = Noise(0.0014, 0.0014, 0.0006, 0.0006)
FRICTION = (0.06, 0.06)  # N m and N m s: by how much Coulomb and viscous friction of a joint change between two runs
STILL = 0.03  # rad/s around standstill over which Coulomb friction changes its sign
