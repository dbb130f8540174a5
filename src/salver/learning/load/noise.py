"""Noise of sensors: covariances over time, and their size in a log.

Errors of a channel at times d apart have the covariance

    K(d) = white^2 [d = 0] + coloured^2 exp(-|d| / colour) + drift^2 exp(-|d| / slow).

Readings are means over a block of samples; blocks of a long motion are longer than the correlation time of coloured
noise, so that its covariance is the mean over both blocks. Ordinary least squares assumes white errors, and its ranges
would contain the true values in few of a hundred runs. The sizes of white and coloured noise are estimated from the log
by the marginal likelihood (Patterson and Thompson 1971); one run does not show the drift. A bias is not noise
(`salver.learning.load.systematic`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from salver.geometry import Array

RUNS = 2  # number of runs in a difference: the loaded and the empty one


@dataclass(frozen=True)
class ChannelNoise:
    """Standard deviations of the noise of one channel in one run, in its unit. white: of a single sample. drift: of the
    change in a second."""

    white: float
    coloured: float
    drift: float

    def share(self, told: ChannelNoise, samples: int) -> float:
        """Ratio of this noise to `told`, white and coloured together, in a mean over `samples`."""
        both = [n.white**2 / samples + n.coloured**2 for n in (self, told)]
        return float(np.sqrt(both[0] / both[1]))


@dataclass(frozen=True)
class SensorNoise:
    """Assumed noise of sensors.

    White and coloured noise are estimated between a tenth and 16 times these values; drift and times are fixed.

    Attributes:
        torque, force, moment: standard deviations of joint torques (N m; about 0.1 on a Panda, franka_ros issue 404)
            and of a wrist sensor's forces (N) and moments (N m).
        colour: s, correlation time of coloured noise; 0.05 instead of 0.035 widens ranges by 7 to 10 %.
        slow: s, correlation time of a drift.
        friction: N m and N m s, change of Coulomb and viscous friction of a joint between two runs; with twice the
            value, ranges from joint torques widen.
        all_friction: N m and N m s, friction itself, which cancels except where two runs have different velocities.
        standstill: rad/s, velocities over which Coulomb friction changes its sign, which no log shows.
        unlike: relative error, and delay in s, of the arm's own torques where its motion deviates from the empty run's.
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
    """Noise of N consecutive blocks of one log, means over `samples`: unit covariances (N, N) of coloured noise and
    drift; eigenvalues and eigenvectors of the former, a square root (N, r) of the latter."""

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
        """Covariance (N, N) of a channel's noise."""
        out = noise.coloured**2 * self.coloured + noise.drift**2 * self.slow
        out[np.diag_indices(len(out))] += noise.white**2 / self.samples
        return np.asarray(out)

    def found(self, told: ChannelNoise, values: Array, effects: Array, runs: int) -> ChannelNoise:
        """The estimated noise of a channel with values (N,), the sum of the noise of `runs` runs: posterior means of
        the variances; the drift is as assumed.

        effects (N, m): other possible contributions to the values, per standard deviation.
        """
        size, vectors = self.eigen
        shares = np.geomspace(0.1, 16.0, 13)
        white, slower = (x.ravel() ** 2 for x in np.meshgrid(shares * told.white, shares * told.coloured))
        L = vectors.T @ np.column_stack([effects, np.sqrt(runs) * told.drift * self.root, values])
        m = L.shape[1] - 1
        row, column = np.tril_indices(m + 1)
        weight = 1 / (runs * (white[:, None] / self.samples + slower[:, None] * np.maximum(size, 0.0)))
        inner = np.zeros((len(weight), m + 1, m + 1))  # only the lower half is read
        inner[:, row, column] = weight @ (L[:, row] * L[:, column])
        inner[:, range(m), range(m)] += 1.0
        root = np.diagonal(np.linalg.cholesky(inner), axis1=1, axis2=2)
        # The square of the last one is the residual of the values after the effects.
        cost = 2 * np.log(root[:, :m]).sum(axis=1) - np.log(weight).sum(axis=1) + root[:, m] ** 2
        likely = np.exp(0.5 * (cost.min() - cost))
        sizes = np.sqrt(likely @ np.column_stack([white, slower]) / likely.sum())
        return replace(told, white=float(sizes[0]), coloured=float(sizes[1]))
