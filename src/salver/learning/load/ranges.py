"""From an estimate of a load's inertial parameters to ranges of what scenarios speak of.

Mass, centre of mass c = h / m and inertia about it, I - m (|c|^2 1 - c c^T), are no linear functions of phi. What an
estimate with a covariance says of each within so many standard deviations is computed without linearising: of the
centre of mass by Fieller (1954), of the inertia with u = h - m c_0, c_0 that of the estimate, of which

    h h^T / m = m c_0 c_0^T + c_0 u^T + u c_0^T + u u^T / m

is linear but for its last term, which is bounded. Principal second moments are no less than 0 and no more than a mass
within the shape can have (the pseudo-inertia is positive semidefinite: Wensing, Kim and Slotine 2018), so that the
inertias bound each other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from salver.geometry import Array
from salver.models.rigid_body import inertia_entries, parallel_axis
from salver.models.uncertain.contents import PAIRS
from salver.models.uncertain.parameters import INERTIAL

WIDTH = 3.0  # standard deviations, of ranges that are taken for certain
LIKELY = 2.0  # and of those that hold the truth in 95 % of runs or more
LEARNT = 0.9  # of the range before: a parameter whose range is not narrower than this was not identified
NAMES = INERTIAL[:4]
_SQUARES = [k for k, (i, j) in enumerate(PAIRS) if i == j]


@dataclass(frozen=True)
class Range:
    """low, high: of a parameter of the scenario, SI units, to plan for. before: (low, high) that it had. likely: what
    holds it in 95 % of runs."""

    low: float
    high: float
    before: tuple[float, float]
    likely: tuple[float, float]

    @property
    def half(self) -> float:
        return 0.5 * (self.high - self.low)

    @property
    def middle(self) -> float:
        return 0.5 * (self.high + self.low)

    @property
    def learnt(self) -> bool:
        return self.half < LEARNT * 0.5 * (self.before[1] - self.before[0])


@dataclass(frozen=True, eq=False)
class Estimate:
    """phi (10,) of a load, in B. covariance (10, 10): of noise. systematic (10, K): by how much each systematic error,
    as large as its bound, would move it. shift (3,): m by which the centre of mass may have moved during a run."""

    phi: Array
    covariance: Array
    systematic: Array
    shift: Array

    @property
    def together(self) -> Array:
        """(10, 10) covariance of noise plus that of systematic errors as large as their bounds."""
        return np.asarray(self.covariance + self.systematic @ self.systematic.T)


def fieller(m: float, h: float, covariance: Array, width: float = WIDTH) -> tuple[float, float]:
    """Range of h / m at so many standard deviations, covariance (2, 2) of (m, h): where a quadratic is 0."""
    a = m**2 - width**2 * covariance[0, 0]
    b = m * h - width**2 * covariance[0, 1]
    c = h**2 - width**2 * covariance[1, 1]
    inner = b**2 - a * c
    if a <= 0 or inner < 0:
        return -np.inf, np.inf
    return float((b - np.sqrt(inner)) / a), float((b + np.sqrt(inner)) / a)


def mass_interval(estimate: Estimate, width: float = WIDTH) -> tuple[float, float]:
    """The mass within so many standard deviations, and any systematic errors."""
    radius = width * np.sqrt(estimate.covariance[0, 0]) + np.abs(estimate.systematic[0]).sum()
    return float(estimate.phi[0] - radius), float(estimate.phi[0] + radius)


def intervals(estimate: Estimate, width: float = WIDTH) -> tuple[Array, Array]:
    """(10,) least and largest values of `INERTIAL`, each within so many standard deviations, and any systematic
    errors: extremes of these are added."""
    phi, covariance, systematic = estimate.phi, estimate.covariance, estimate.systematic
    lightest, heaviest = mass_interval(estimate, width)
    if lightest <= 0:
        return np.append(lightest, np.full(9, -np.inf)), np.append(heaviest, np.full(9, np.inf))
    inertia, by_phi, moment = _about_com(phi)
    off = np.abs(moment @ systematic).sum(axis=1)  # of u
    com = np.array([fieller(phi[0], phi[k], covariance[np.ix_([0, k], [0, k])], width) for k in (1, 2, 3)])
    linear = width * np.sqrt(_variances(by_phi, covariance)) + np.abs(by_phi @ systematic).sum(axis=1)
    less, more = _curved(width * np.sqrt(_variances(moment, covariance)) + off, lightest)
    low = np.concatenate([[lightest], com[:, 0] - off / lightest, inertia - linear - less])
    high = np.concatenate([[heaviest], com[:, 1] + off / lightest, inertia + linear + more])
    return low, high


def slid(estimate: Estimate) -> Array:
    """(10,) by how much values of `INERTIAL` may be off in an estimate of a load that slid by up to its shift."""
    com, heaviest, shift = np.abs(estimate.phi[1:4] / estimate.phi[0]), mass_interval(estimate)[1], estimate.shift
    each = np.outer(com, shift) + np.outer(shift, com) + np.outer(shift, shift)
    entries = [np.trace(each) - each[i, i] if i == j else each[i, j] for i, j in PAIRS]
    return np.concatenate([[0.0], shift, heaviest * np.array(entries)])


def consistent(low: Array, high: Array, most: Array) -> tuple[Array, Array]:
    """Entries (6,) of an inertia within low and high of which every one fits to others: second moments s_x, s_y, s_z
    about the centre of mass, I_xx = s_y + s_z, lie between 0 and most (3,), and s_xy^2 <= s_x s_y."""
    least, largest = (x[_SQUARES] for x in (low, high))
    lower = np.maximum(0.5 * (np.sum(least) - least - largest), 0.0)  # s_x = (I_yy + I_zz - I_xx) / 2
    upper = np.minimum(0.5 * (np.sum(largest) - largest - least), most)
    upper = np.minimum(upper, [min(largest[1:]), min(largest[::2]), min(largest[:2])])  # I_yy, I_zz >= s_x
    low, high = low.copy(), high.copy()
    for k, (i, j) in enumerate(PAIRS):
        if i == j:
            others = [a for a in range(3) if a != i]
            low[k], high[k] = max(low[k], lower[others].sum()), min(high[k], upper[others].sum())
        else:
            bound = np.sqrt(max(upper[i] * upper[j], 0.0))
            low[k], high[k] = max(low[k], -bound), min(high[k], bound)
    return low, high


def _about_com(phi: Array) -> tuple[Array, Array, Array]:
    """(6,) inertia about the centre of mass of phi; (6, 10) the derivative of its linear part; (3, 10) u per phi."""
    m, com = phi[0], phi[1:4] / phi[0]
    about = inertia_entries(parallel_axis(1.0, com))
    # Twice what is linear in c and in e, for each unit vector e.
    by_moment = [inertia_entries(parallel_axis(1.0, com + e) - parallel_axis(1.0, com - e)) / 2 for e in np.eye(3)]
    by_phi = np.hstack([about[:, None], -np.column_stack(by_moment), np.eye(6)])
    return phi[4:] - m * about, by_phi, np.hstack([-com[:, None], np.eye(3), np.zeros((3, 6))])


def _curved(u: Array, lightest: float) -> tuple[Array, Array]:
    """(6,) by how much at most u u^T / m, |u_i| <= u (3,), m >= lightest, makes an inertia less, and more."""
    products = np.outer(u, u) / lightest
    less = np.array([np.trace(products) - products[i, i] if i == j else products[i, j] for i, j in PAIRS])
    more = np.array([0.0 if i == j else products[i, j] for i, j in PAIRS])
    return less, more


def _variances(rows: Array, covariance: Array) -> Array:
    return np.asarray(np.einsum("ij,jk,ik->i", rows, covariance, rows))
