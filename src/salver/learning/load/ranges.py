"""Ranges of a scenario's parameters from an estimate of the inertial parameters phi.

Mass, centre of mass c = h / m and inertia about it, I - m (|c|^2 1 - c c^T), are nonlinear functions of phi. Their
ranges within a number of standard deviations are computed without linearising: that of the centre of mass by Fieller
(1954), that of the inertia with u = h - m c_0, c_0 the estimate's centre of mass, from

    h h^T / m = m c_0 c_0^T + c_0 u^T + u c_0^T + u u^T / m

which is linear except for its last term; that is bounded. Principal second moments are at least 0 and at most those
that a mass within the shape can have (the pseudo-inertia is positive semidefinite: Wensing, Kim and Slotine 2018), so
that the inertias bound each other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from salver.geometry import Array
from salver.models.rigid_body import PAIRS, inertia_entries, parallel_axis
from salver.models.uncertain.parameters import INERTIAL

WIDTH = 3.0  # standard deviations of the ranges for planning
LIKELY = 2.0  # standard deviations of ranges that contain the true value in 95 % of runs or more
LEARNT = 0.9  # a parameter counts as identified if its range is narrower than this share of the range before
NAMES = INERTIAL[:4]
_SQUARES = [k for k, (i, j) in enumerate(PAIRS) if i == j]


@dataclass(frozen=True)
class Range:
    """The range of a parameter, SI units. low, high: for planning. before: its (low, high) in the scenario. likely: the
    range that contains it in 95 % of runs."""

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
    """An estimate phi (10,) of a load, in B.

    covariance (10, 10): by noise. systematic (10, K): change of phi by each systematic error at its bound. shift (3,):
    m, largest displacement of the centre of mass during a run.
    """

    phi: Array
    covariance: Array
    systematic: Array
    shift: Array

    @property
    def together(self) -> Array:
        """Covariance (10, 10) by noise, plus that of systematic errors at their bounds."""
        return np.asarray(self.covariance + self.systematic @ self.systematic.T)


def fieller(m: float, h: float, covariance: Array, width: float = WIDTH) -> tuple[float, float]:
    """Range of h / m within `width` standard deviations, with the covariance (2, 2) of (m, h)."""
    a = m**2 - width**2 * covariance[0, 0]
    b = m * h - width**2 * covariance[0, 1]
    c = h**2 - width**2 * covariance[1, 1]
    inner = b**2 - a * c
    if a <= 0 or inner < 0:
        return -np.inf, np.inf
    return float((b - np.sqrt(inner)) / a), float((b + np.sqrt(inner)) / a)


def mass_interval(estimate: Estimate, width: float = WIDTH) -> tuple[float, float]:
    """Range of the mass within `width` standard deviations, for all systematic errors within their bounds."""
    radius = width * np.sqrt(estimate.covariance[0, 0]) + np.abs(estimate.systematic[0]).sum()
    return float(estimate.phi[0] - radius), float(estimate.phi[0] + radius)


def intervals(estimate: Estimate, width: float = WIDTH) -> tuple[Array, Array]:
    """Least and largest values (10,) of `INERTIAL`, each within `width` standard deviations, plus the extremes of the
    systematic errors."""
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
    """Largest error (10,) of `INERTIAL` because the load may have slid by up to `shift`."""
    com, heaviest, shift = np.abs(estimate.phi[1:4] / estimate.phi[0]), mass_interval(estimate)[1], estimate.shift
    each = np.outer(com, shift) + np.outer(shift, com) + np.outer(shift, shift)
    entries = [np.trace(each) - each[i, i] if i == j else each[i, j] for i, j in PAIRS]
    return np.concatenate([[0.0], shift, heaviest * np.array(entries)])


def consistent(low: Array, high: Array, most: Array) -> tuple[Array, Array]:
    """Ranges (6,) of the entries of an inertia, tightened so that they are consistent.

    The second moments s_x, s_y, s_z about the centre of mass, with I_xx = s_y + s_z, are between 0 and most (3,), and
    s_xy^2 <= s_x s_y.
    """
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
    """Inertia (6,) about the centre of mass of phi, the derivative (6, 10) of its linear part, and that (3, 10) of
    u."""
    m, com = phi[0], phi[1:4] / phi[0]
    about = inertia_entries(parallel_axis(1.0, com))
    # Twice what is linear in c and in e, for each unit vector e.
    by_moment = [inertia_entries(parallel_axis(1.0, com + e) - parallel_axis(1.0, com - e)) / 2 for e in np.eye(3)]
    by_phi = np.hstack([about[:, None], -np.column_stack(by_moment), np.eye(6)])
    return phi[4:] - m * about, by_phi, np.hstack([-com[:, None], np.eye(3), np.zeros((3, 6))])


def _curved(u: Array, lightest: float) -> tuple[Array, Array]:
    """Bounds (6,) of the decrease and the increase of an inertia by u u^T / m, for |u_i| <= u (3,), m >= lightest."""
    products = np.outer(u, u) / lightest
    less = np.array([np.trace(products) - products[i, i] if i == j else products[i, j] for i, j in PAIRS])
    more = np.array([0.0 if i == j else products[i, j] for i, j in PAIRS])
    return less, more


def _variances(rows: Array, covariance: Array) -> Array:
    return np.asarray(np.einsum("ij,jk,ik->i", rows, covariance, rows))
