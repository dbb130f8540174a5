"""How sensors err: covariances over time, and how large they are in a log.

Errors of a channel at times d apart have the covariance

    K(d) = white^2 [d = 0] + coloured^2 k(d) + bias^2 + drift^2 exp(-d^2 / (2 0.8^2 s^2)),

with k(d) = exp(-|d| / 30 ms), or the smooth exp(-d^2 / (2 30^2 ms^2)). Ordinary least squares takes them all for white;
its ranges then cover the truth in a few runs of a hundred. How large white and coloured noise are, and which k, a log
tells itself, by the marginal likelihood (Patterson and Thompson 1971); of a bias and a drift one run says nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from salver.geometry import Array

COLOUR = 0.03  # s over which coloured noise forgets
SLOW = 0.8  # s over which a drift moves
SHARES = np.geomspace(0.1, 16.0, 10)  # of what was told, tried for white and for coloured noise
LIKELY = 2.0  # twice the logarithm of a likelihood, by which noise may be less likely than the likeliest and be taken
FLAT = 1e-6  # of the largest eigenvalue of what is smooth: what is below is left out


@dataclass(frozen=True)
class Noise:
    """Standard deviations of one channel, in its unit. white: of a single sample. smooth: which k."""

    white: float
    coloured: float
    bias: float
    drift: float
    smooth: bool = False

    def covariance(self, t: Array, samples: int) -> Array:
        """(N, N) of means over `samples` samples each, around times t (N,)."""
        apart = np.abs(t[:, None] - t[None, :])
        slow = self.drift**2 * np.exp(-0.5 * (apart / SLOW) ** 2)
        out = self.coloured**2 * coloured(apart, self.smooth) + self.bias**2 + slow
        out[np.diag_indices(len(t))] += self.white**2 / samples
        return np.asarray(out)

    def share(self, told: Noise, samples: int) -> float:
        """How many times larger white and coloured noise together are, in a mean over `samples`."""
        both = [n.white**2 / samples + n.coloured**2 for n in (self, told)]
        return float(np.sqrt(both[0] / both[1]))


def coloured(apart: Array, smooth: bool) -> Array:
    """k of times s apart."""
    return np.asarray(np.exp(-0.5 * (apart / COLOUR) ** 2) if smooth else np.exp(-np.abs(apart) / COLOUR))


@dataclass(frozen=True, eq=False)
class Times:
    """N times of one log, means over `samples`, prepared for `found`. kinds: k = vectors diag(size) vectors^T for both
    k; slow (N, r): square root of what a drift is per unit."""

    samples: int
    kinds: tuple[tuple[Array, Array], ...]
    slow: Array

    @classmethod
    def of(cls, t: Array, samples: int) -> Times:
        apart = t[:, None] - t[None, :]
        kinds = tuple(np.linalg.eigh(coloured(apart, smooth)) for smooth in (False, True))
        size, shapes = np.linalg.eigh(np.exp(-0.5 * (apart / SLOW) ** 2))
        kept = size > FLAT * size[-1]
        return cls(samples, kinds, shapes[:, kept] * np.sqrt(size[kept]))

    def found(self, told: Noise, values: Array, effects: Array, runs: int) -> Noise:
        """The noise of a channel with values (N,), the sum of so many runs': the most that is about as likely as any.

        effects (N, m): per standard deviation of everything else that may be in the values. Bias and drift as told.
        """
        ones = np.ones((len(values), 1))
        parts = np.hstack([effects, np.sqrt(runs) * told.bias * ones, np.sqrt(runs) * told.drift * self.slow])
        white, slower = (x.ravel() for x in np.meshgrid(SHARES * told.white, SHARES * told.coloured))
        costs = []
        for size, vectors in self.kinds:
            y, L = vectors.T @ values, vectors.T @ parts
            # (tried, N)
            weight = 1 / (runs * (white[:, None] ** 2 / self.samples + slower[:, None] ** 2 * np.maximum(size, 0.0)))
            m = L.shape[1]
            inner = np.zeros((len(weight), m, m))
            row, column = np.triu_indices(m)
            inner[:, row, column] = inner[:, column, row] = weight @ (L[:, row] * L[:, column])
            inner += np.eye(m)
            pulled = weight @ (L * y[:, None])
            fit = np.sum(pulled * np.linalg.solve(inner, pulled[..., None])[..., 0], axis=1)
            costs.append(np.linalg.slogdet(inner)[1] - np.log(weight).sum(axis=1) + weight @ y**2 - fit)
        most = np.where(np.array(costs) < np.min(costs) + LIKELY, slower, -1.0)
        smooth, best = np.unravel_index(np.argmax(most), most.shape)
        return replace(told, white=float(white[best]), coloured=float(slower[best]), smooth=bool(smooth))


# Of one run; a difference of two has twice the covariance. Joint torques of a Panda are good to some 0.1 N m
# (franka_ros, issue 404); a wrist sensor with a noise of 0.05 N and 2 mN m, tared with the empty tray before each run.
TORQUE = Noise(0.057, 0.057, 0.15, 0.03)
FORCE = Noise(0.035, 0.035, 0.015, 0.015)
MOMENT = Noise(0.0014, 0.0014, 0.0006, 0.0006)
FRICTION = (0.06, 0.06)  # N m and N m s: by how much Coulomb and viscous friction of a joint change between two runs
ALL_FRICTION = 0.5  # N m and N m s: what they are; it cancels, but where two runs have not the same velocity
STILL = (0.01, 0.03, 0.1)  # rad/s around standstill over which Coulomb friction changes its sign
