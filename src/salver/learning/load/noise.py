"""Noise of sensors: covariances over time, and their size in a log.

Errors of a channel at times d apart have the covariance

    K(d) = white^2 [d = 0] + coloured^2 exp(-|d| / colour) + drift^2 exp(-|d| / slow).

What is read are means over a block of samples, and a long motion's blocks are longer than coloured noise remembers: its
covariance is the mean over both blocks. Ordinary least squares takes all errors for white; its ranges then cover the
truth in a few runs of a hundred. How large white and coloured noise are, a log tells itself, by the marginal likelihood
(Patterson and Thompson 1971); of a drift one run says nothing. A bias is no noise (`salver.learning.load.systematic`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from salver.geometry import Array

RUNS = 2  # of which a difference is: the loaded one less the empty one


@dataclass(frozen=True)
class ChannelNoise:
    """Standard deviations of one channel in one run, in its unit. white: of a single sample. drift: by which it wanders
    in a second."""

    white: float
    coloured: float
    drift: float

    def share(self, told: ChannelNoise, samples: int) -> float:
        """Ratio of this noise to `told`, white and coloured together, in a mean over `samples`."""
        both = [n.white**2 / samples + n.coloured**2 for n in (self, told)]
        return float(np.sqrt(both[0] / both[1]))


@dataclass(frozen=True)
class SensorNoise:
    """Prior knowledge of sensors' noise.

    White and coloured noise are looked for between a tenth and 16 times as much; drift and times are taken as they
    are.

    Attributes:
        torque, force, moment: of joint torques (N m: some 0.1 on a Panda, franka_ros issue 404) and of a wrist sensor.
        colour: s after which coloured noise is forgotten; 0.05 instead of 0.035 widens ranges by 7 to 10 %.
        slow: s after which a drift is.
        friction: N m and N m s, by how much Coulomb and viscous friction of a joint change between two runs; doubled,
            ranges by joint torques widen.
        all_friction: N m and N m s, what they are; it cancels, but where two runs have not the same velocity.
        standstill: rad/s around which Coulomb friction changes its sign, which no log tells.
        unlike: share and s, by which the arm's own torques are wrong where its motion deviates from the empty run's.
    """

    torque: ChannelNoise = ChannelNoise(0.057, 0.057, 0.03)
    force: ChannelNoise = ChannelNoise(0.035, 0.035, 0.015)
    moment: ChannelNoise = ChannelNoise(0.0014, 0.0014, 0.0006)
    colour: float = 0.035
    slow: float = 2.0
    friction: tuple[float, float] = (0.06, 0.06)
    all_friction: float = 0.5
    standstill: tuple[float, ...] = (0.01, 0.03, 0.1)
    unlike: tuple[float, float] = (0.3, 0.016)


@dataclass(frozen=True, eq=False)
class BlockNoise:
    """Noise of N blocks of one log, means over `samples` that end where the next begin: covariances (N, N) of
    coloured noise and drift per unit; sizes and vectors of the former, the square root (N, r) of the latter."""

    samples: int
    coloured: Array
    eigen: tuple[Array, Array]
    slow: Array
    root: Array

    @classmethod
    def of(cls, t: Array, samples: int, sensors: SensorNoise | None = None) -> BlockNoise:
        sensors = sensors or SensorNoise()
        apart, length = np.abs(t[:, None] - t[None, :]) / sensors.colour, np.median(np.diff(t)) / sensors.colour
        slow = np.exp(-apart * sensors.colour / sensors.slow)
        size, shapes = np.linalg.eigh(slow)
        kept = size > 0.01 * size[-1]
        # Second differences of the second integral of exp(-|d|): the mean over two blocks.
        parts = [np.exp(-np.abs(d)) + np.abs(d) for d in (apart + length, apart, apart - length)]
        coloured = np.asarray((parts[0] - 2 * parts[1] + parts[2]) / length**2)
        values, vectors = np.linalg.eigh(coloured)
        return cls(samples, coloured, (values, vectors), slow, shapes[:, kept] * np.sqrt(size[kept]))

    def covariance(self, noise: ChannelNoise) -> Array:
        """(N, N) of its errors."""
        out = noise.coloured**2 * self.coloured + noise.drift**2 * self.slow
        out[np.diag_indices(len(out))] += noise.white**2 / self.samples
        return np.asarray(out)

    def found(self, told: ChannelNoise, values: Array, effects: Array, runs: int) -> ChannelNoise:
        """The noise of a channel with values (N,), the sum of so many runs': its variances, as the mean over all that
        are likely. The drift as told.

        effects (N, m): per standard deviation of everything else that may be in the values.
        """
        size, vectors = self.eigen
        shares = np.geomspace(0.1, 16.0, 13)
        white, slower = (x.ravel() ** 2 for x in np.meshgrid(shares * told.white, shares * told.coloured))
        L = vectors.T @ np.column_stack([effects, np.sqrt(runs) * told.drift * self.root, values])
        m = L.shape[1] - 1
        row, column = np.tril_indices(m + 1)
        weight = 1 / (runs * (white[:, None] / self.samples + slower[:, None] * np.maximum(size, 0.0)))
        inner = np.zeros((len(weight), m + 1, m + 1))  # of which the lower half is read
        inner[:, row, column] = weight @ (L[:, row] * L[:, column])
        inner[:, range(m), range(m)] += 1.0
        root = np.diagonal(np.linalg.cholesky(inner), axis1=1, axis2=2)
        # The last of them squared is what the effects leave of the values.
        cost = 2 * np.log(root[:, :m]).sum(axis=1) - np.log(weight).sum(axis=1) + root[:, m] ** 2
        likely = np.exp(0.5 * (cost.min() - cost))
        sizes = np.sqrt(likely @ np.column_stack([white, slower]) / likely.sum())
        return replace(told, white=float(sizes[0]), coloured=float(sizes[1]))
