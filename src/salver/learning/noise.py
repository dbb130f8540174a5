"""How sensors err: covariances over time, and how large they are in a log.

Errors of a channel at times d apart have the covariance

    K(d) = white^2 [d = 0] + coloured^2 k(d) + drift^2 exp(-|d| / 2 s),

with k(d) between exp(-|d| / 30 ms) and the smooth exp(-d^2 / (2 30^2 ms^2)). What is read are means over a block of
samples, and a long motion's blocks are longer than coloured noise remembers: of k it is the mean over both blocks.
Ordinary least squares takes all errors for white; its ranges then cover the truth in a few runs of a hundred. How
large white and coloured noise are, and which k, a log tells itself, by the marginal likelihood (Patterson and Thompson
1971); of a drift one run says nothing. A bias is no noise (`salver.learning.systematic`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from salver.geometry import Array

COLOUR = 0.03  # s over which coloured noise forgets
SLOW = 2.0  # s over which a drift does: so it wanders at first as a random walk
SHARES = np.geomspace(0.1, 16.0, 13)  # of what was told, tried for white and for coloured noise
FLAT = 1e-2  # of the largest eigenvalue of what is smooth: what is below is left out


@dataclass(frozen=True)
class Noise:
    """Standard deviations of one channel, in its unit. white: of a single sample. drift: by which it wanders in a
    second. smooth: the share of the smooth k."""

    white: float
    coloured: float
    drift: float
    smooth: float = 0.0

    def share(self, told: Noise, samples: int) -> float:
        """How many times larger white and coloured noise together are, in a mean over `samples`."""
        both = [n.white**2 / samples + n.coloured**2 for n in (self, told)]
        return float(np.sqrt(both[0] / both[1]))


@dataclass(frozen=True, eq=False)
class Times:
    """N times of one log, means over `samples` that end where the next begin. kinds: both k, (N, N), as size and
    vectors too; slow, (N, N): what a drift is per unit, and its square root (N, r), with what matters of it."""

    samples: int
    kinds: tuple[tuple[Array, Array, Array], ...]
    slow: tuple[Array, Array]

    @classmethod
    def of(cls, t: Array, samples: int) -> Times:
        apart, length = np.abs(t[:, None] - t[None, :]), float(np.median(np.diff(t)))
        slow = np.exp(-apart / SLOW)
        size, shapes = np.linalg.eigh(slow)
        kept = size > FLAT * size[-1]
        kinds = [_between_means(twice, apart / COLOUR, length / COLOUR) for twice in (_sharp, _smooth)]
        root = shapes[:, kept] * np.sqrt(size[kept])
        return cls(samples, tuple((k, *np.linalg.eigh(k)) for k in kinds), (slow, root))

    def covariance(self, noise: Noise) -> Array:
        """(N, N) of its errors."""
        sharp, smooth = (kind[0] for kind in self.kinds)
        out = noise.coloured**2 * ((1 - noise.smooth) * sharp + noise.smooth * smooth)
        out += noise.drift**2 * self.slow[0]
        out[np.diag_indices(len(out))] += noise.white**2 / self.samples
        return np.asarray(out)

    def found(self, told: Noise, values: Array, effects: Array, runs: int) -> Noise:
        """The noise of a channel with values (N,), the sum of so many runs': its variances, as the mean over all that
        are likely. The drift as told.

        effects (N, m): per standard deviation of everything else that may be in the values.
        """
        parts = np.hstack([effects, np.sqrt(runs) * told.drift * self.slow[1]])
        m = parts.shape[1]
        white, slower = (x.ravel() ** 2 for x in np.meshgrid(SHARES * told.white, SHARES * told.coloured))
        row, column = np.tril_indices(m + 1)
        costs = []
        for _, size, vectors in self.kinds:
            L = vectors.T @ np.column_stack([parts, values])
            weight = 1 / (runs * (white[:, None] / self.samples + slower[:, None] * np.maximum(size, 0.0)))
            inner = np.zeros((len(weight), m + 1, m + 1))  # of which the lower half is read
            inner[:, row, column] = weight @ (L[:, row] * L[:, column])
            inner[:, range(m), range(m)] += 1.0
            root = np.diagonal(np.linalg.cholesky(inner), axis1=1, axis2=2)
            # The last of them squared is what the effects leave of the values.
            costs.append(2 * np.log(root[:, :m]).sum(axis=1) - np.log(weight).sum(axis=1) + root[:, m] ** 2)
        likely = np.exp(0.5 * (np.min(costs) - np.array(costs)))
        likely /= likely.sum()
        each = likely.sum(axis=0)
        size = np.sqrt(each @ np.column_stack([white, slower]))
        return replace(told, white=float(size[0]), coloured=float(size[1]), smooth=float(likely[1].sum()))


def _between_means(twice: Callable[[Array], Array], apart: Array, length: float) -> Array:
    """Covariance of means over a length, so far apart, of what has a covariance of which `twice` is the second
    integral."""
    return np.asarray((twice(apart + length) - 2 * twice(apart) + twice(apart - length)) / length**2)


def _sharp(d: Array) -> Array:
    """Second integral of exp(-|d|)."""
    return np.asarray(np.exp(-np.abs(d)) + np.abs(d))


def _smooth(d: Array) -> Array:
    """Second integral of exp(-d^2 / 2)."""
    from scipy.special import erf

    return np.asarray(np.exp(-0.5 * d**2) + np.sqrt(0.5 * np.pi) * d * erf(np.sqrt(0.5) * d))


# Of one run; a difference of two has twice the covariance. Joint torques of a Panda are good to some 0.1 N m
# (franka_ros, issue 404); a wrist sensor with a noise of 0.05 N and 2 mN m, tared with the empty tray before each run.
TORQUE = Noise(0.057, 0.057, 0.03)
FORCE = Noise(0.035, 0.035, 0.015)
MOMENT = Noise(0.0014, 0.0014, 0.0006)
FRICTION = (0.06, 0.06)  # N m and N m s: by how much Coulomb and viscous friction of a joint change between two runs
ALL_FRICTION = 0.5  # N m and N m s: what they are; it cancels, but where two runs have not the same velocity
STILL = (0.01, 0.03, 0.1)  # rad/s around standstill over which Coulomb friction changes its sign
SMOOTHED = (0.3, 0.016)  # share and s by which smoothing at 10 Hz makes torques of a deviation wrong
