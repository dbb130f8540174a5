"""Derivatives of what the waves of a liquid do, by what the tray felt at all earlier times: the transposed filter.

Rows (m,) are functions of the waves of one case, `case`, at one node, `node`, or at all. Each answer is their
derivative (m, T, 12) by w at all nodes, and (m,) by log T of the duration at fixed w. All rows go through the filters
of all cases in one solve.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from salver.geometry import Array
from salver.models.liquid import GRAVITY
from salver.models.tray_motion import N_MOTION
from salver.sensitivity.waves import TURNING, Indices, Waves, across, turned

Pulled = tuple[Array, Array]


def surface_by(waves: Waves, case: Indices, node: Indices, by_eta: Array, by_free: Array, thrown: float) -> Pulled:
    """Of by_eta . eta + by_free . free, (m, 2) each, and `thrown` times the square of the rate of tilting."""
    which = waves.cases
    both, up = by_eta + by_free, waves.upward[case, node]
    by_slope = (by_free * which.half[case] - both * which.rest_rise[case]) / up[:, None]
    lateral = turned(by_slope, -waves.spin[case, node])
    by_force = np.column_stack([lateral, -(by_slope * waves.slope[case, node]).sum(axis=1)])
    by_spin = up * (by_slope * across(waves.slope[case, node])).sum(axis=1)
    by_r = which.gain[case] * both[:, None, :]
    by_w = (by_force[:, None] @ which.at_O[case])[:, 0] + thrown * TURNING
    return at_node(waves, case, node, by_r, np.zeros_like(by_r), by_w, by_spin)


def wrench_by(waves: Waves, case: Indices, node: Indices, weight: Array) -> Pulled:
    """Of weight (m, 6) . wrench at a node."""
    return at_node(waves, case, node, *_wrench_by(waves, case, (case, node), weight))


def wrenches_by(waves: Waves, case: Indices, weight: Array) -> Array:
    """(m, T, 12) of weight (m, T, 6) . wrench, summed over all nodes; by w alone."""
    return pulled(waves, case, *_wrench_by(waves, case, (case,), weight))


def _wrench_by(waves: Waves, case: Indices, at: tuple[Indices, ...], weight: Array) -> tuple[Array, ...]:
    """Derivatives of weight (m, ..., 6) . wrench by r, r', w and the spin, all (m, ...) at the same nodes."""
    which = waves.cases
    over = (slice(None), *(None,) * (weight.ndim - 2))

    def own(values: Array) -> Array:
        """Of each row's case."""
        return np.asarray(values[case][over])

    force, spin = waves.force[at], waves.spin[at]
    r, second = (turned(x[at], -spin[..., None]) for x in (waves.r, waves.second))
    mass = own(which.mass)
    weight = (weight[..., None, :] @ own(which.to_E))[..., 0, :]
    tilting = weight[..., [4, 3]] * [1.0, -1.0]  # what turns along x is a moment about y
    by_second = mass * (weight[..., None, :2] + own(which.height) * tilting[..., None, :])
    hanging = -tilting * force[..., 2:] + weight[..., 5:] * force[..., [1, 0]] * [1.0, -1.0]
    stiff = own(which.omega) ** 2 / GRAVITY
    by_hung = mass * hanging[..., None, :]
    by_spin = -(by_second * across(second) + by_hung * across(r)).sum(axis=(-2, -1))
    hung = (mass * r).sum(axis=-2)
    by_up = -(tilting * hung).sum(axis=-1) - (by_second * stiff * r).sum(axis=(-2, -1))
    by_force = np.stack([-weight[..., 5] * hung[..., 1], weight[..., 5] * hung[..., 0], by_up], axis=-1)
    by_w = (by_force[..., None, :] @ own(which.at_O))[..., 0, :]
    flat = own(which.at_mode).reshape(*by_w.shape[:1], *(1,) * (weight.ndim - 2), -1, N_MOTION)
    by_w -= (by_second.reshape(*by_w.shape[:-1], 1, -1) @ flat)[..., 0, :]
    by_second = turned(by_second, spin[..., None])
    by_r = turned(by_hung, spin[..., None]) - stiff * waves.upward[at][..., None, None] * by_second
    by_spin -= (by_second * across(waves.at_modes[at])).sum(axis=(-2, -1))
    return by_r, -own(which.kd) * by_second, by_w, by_spin


def at_node(
    waves: Waves, case: Indices, node: Indices, by_r: Array, by_rate: Array, by_w: Array, by_spin: Array
) -> Pulled:
    """From derivatives (m, n_modes, 2) by r and r', (m, 12) by w itself and (m,) by the spin, at the rows' own
    nodes."""
    m, T, row = len(case), len(waves.t), np.arange(len(case))

    def spread(values: Array) -> Array:
        out = np.zeros((m, T, *values.shape[1:]))
        out[row, node] = values
        return out

    found = pulled(waves, case, *(spread(x) for x in (by_r, by_rate, by_w, by_spin)))
    slower = [(by * x[case, node]).sum(axis=(1, 2)) for by, x in zip((by_r, by_rate), waves.slower, strict=True)]
    return found, slower[0] + slower[1] + 2 * waves.spin[case, node] * by_spin


def pulled(waves: Waves, case: Indices, by_r: Array, by_rate: Array, by_w: Array, by_spin: Array) -> Array:
    """(m, T, 12) by w, of derivatives (m, T, n_modes, 2) by r and r', (m, T, 12) by w itself and (m, T) by the spin."""
    which, rows = waves.cases, _Columns.of(case)
    P, T, n, M = len(rows.present), len(waves.t), by_r.shape[2], rows.count
    some, axes = waves.filters.only((rows.present,)), waves.filters.gain.shape[2]

    def by_filter(values: Array) -> Array:
        """(m, T, n_modes, 2) to (P, n_modes, axes, T, 2 M / axes)."""
        out = np.zeros((P, M, T, n, axes, 2 // axes))
        out[rows.at, rows.column] = values.reshape(-1, T, n, axes, 2 // axes)
        return out.transpose(0, 3, 4, 2, 5, 1).reshape(P, n, axes, T, -1)

    driven = some.gradient(by_filter(by_r), by_filter(by_rate))
    driven = driven.reshape(P, n, axes, T, 2 // axes, M).transpose(0, 5, 3, 1, 2, 4).reshape(P, M, T, n, 2)
    spin, at_modes = waves.spin[rows.present, None], waves.at_modes[rows.present, None]
    at_mode = which.at_mode[rows.present].reshape(P, 2 * n, N_MOTION)
    lateral = driven if not which.round else turned(driven, -spin[..., None])
    out = -(lateral.reshape(P, M * T, 2 * n) @ at_mode).reshape(P, M, T, N_MOTION)
    stiff = (which.omega[:, None] ** 2 / GRAVITY * waves.r)[rows.present, None]
    out -= (driven * stiff).sum(axis=(3, 4))[..., None] * which.at_O[rows.present, None, None, 2]
    if which.round:
        spun = -(driven * across(at_modes)).sum(axis=(3, 4))
        spun[rows.at, rows.column] += by_spin
        flat = spun.reshape(P * M, T).T
        out[..., 5] += waves.turning.gradient(flat, np.zeros_like(flat)).T.reshape(P, M, T)
    return np.asarray(out[rows.at, rows.column] + by_w)


@dataclass(frozen=True)
class _Columns:
    """Rows (m,) as columns of their cases: present (P,) which cases have any, at (m,) which of these, column (m,) in
    it, of `count`."""

    present: Indices
    at: Indices
    column: Indices
    count: int

    @classmethod
    def of(cls, case: Indices) -> _Columns:
        present, at, counts = np.unique(case, return_inverse=True, return_counts=True)
        order, column = np.argsort(at, kind="stable"), np.empty(len(case), dtype=np.intp)
        column[order] = np.arange(len(case)) - np.repeat(np.cumsum(counts) - counts, counts)
        return cls(present, at, column, int(counts.max(initial=0)))
