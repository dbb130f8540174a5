"""Derivatives of what the waves of a liquid do, by what the tray felt at all earlier times: the transposed filter.

Rows are functions of the waves of one case at one node, (m,) of them: `case` says which, `node` when. Each answer is
their derivative (m, T, 12) by w at all nodes, and (m,) by log T of the duration at fixed w. All rows go through the
filters of all cases in one solve.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from salver.geometry import Array
from salver.models.liquid import GRAVITY, LEFT_OVER, TILTING
from salver.models.tray_motion import N_MOTION
from salver.sensitivity.waves import TURNING, Indices, Waves, across, turned

Pulled = tuple[Array, Array]


def crest_by(waves: Waves, case: Indices, node: Indices) -> Pulled:
    """Of the crest."""
    which = waves.cases
    by_free = 2 * which.peaking[case] / which.half[case] * waves.free[case, node]
    thrown = TILTING / GRAVITY * which.wide**2
    return _surface_by(waves, case, node, which.steepest_by(waves.eta[case, node]), by_free, thrown)


def free_by(waves: Waves, case: Indices, node: Indices) -> Pulled:
    """Of the height of the free wave."""
    steepest = waves.cases.steepest_by(waves.free[case, node])
    return _surface_by(waves, case, node, np.zeros((len(node), 2)), steepest, 0.0)


def left_by(waves: Waves, case: Indices, seconds: float = 0.0) -> Pulled:
    """Of `Waves.left`, of some cases; the tray's posture at the end is taken as given."""
    which, last = waves.cases, np.full(len(case), len(waves.t) - 1)
    fading, gain, half = waves.fading(seconds)[case], which.gain[case], which.half[case]
    amplitude = (waves.tail[case] * fading).sum(axis=1)
    slope = which.steepest_by(amplitude + half * np.abs(waves.slope[case, -1]))
    by_tail = fading * gain * (slope + 2 * which.peaking[case] / half * amplitude)[:, None]
    away, speed = (x[case] for x in waves.ending)
    size = np.maximum(np.hypot(away, speed), 1e-12)
    to_speed = np.sqrt(GRAVITY / waves.upward[case, -1])[:, None, None] / which.omega[case]
    nothing = np.zeros((len(case), N_MOTION))
    by_w, by_duration = _back(
        waves, case, last, by_tail * away / size, by_tail * speed / size * to_speed, nothing, nothing[:, 0]
    )
    k, peak = (x[case] for x in waves.peak)
    steepest = which.steepest_by(waves.eta[case, k])
    more, longer = _surface_by(waves, case, k, steepest, np.zeros((len(case), 2)), 0.0)
    steep = 3 * LEFT_OVER * peak**2 / half.min(axis=1) ** 2
    return by_w + steep[:, None, None] * more, by_duration + steep * longer


def wrench_by(waves: Waves, case: Indices, node: Indices, weight: Array) -> Pulled:
    """Of weight (m, 6) . wrench."""
    which, force, spin = waves.cases, waves.force[case, node], waves.spin[case, node]
    r, second = (turned(x[case, node], -spin[:, None]) for x in (waves.r, waves.second))
    mass, height = which.mass[case], which.height[case]
    weight = (weight[:, None] @ which.to_E[case])[:, 0]
    tilting = weight[:, [4, 3]] * [1.0, -1.0]  # what turns along x is a moment about y
    by_second = mass * (weight[:, None, :2] + height * tilting[:, None])
    hanging = -tilting * force[:, 2:] + weight[:, 5:] * force[:, [1, 0]] * [1.0, -1.0]
    stiff = which.omega[case] ** 2 / GRAVITY
    by_hung = mass * hanging[:, None]
    by_spin = -(by_second * across(second) + by_hung * across(r)).sum(axis=(1, 2))
    hung = (mass * r).sum(axis=1)
    by_force = np.column_stack([-weight[:, 5] * hung[:, 1], weight[:, 5] * hung[:, 0], -(tilting * hung).sum(axis=1)])
    by_force[:, 2] -= (by_second * stiff * r).sum(axis=(1, 2))
    by_w = (by_force[:, None] @ which.at_O[case])[:, 0] - np.einsum("mna,mnak->mk", by_second, which.at_mode[case])
    by_second = turned(by_second, spin[:, None])
    by_r = turned(by_hung, spin[:, None]) - stiff * waves.upward[case, node, None, None] * by_second
    by_spin -= (by_second * across(waves.at_modes[case, node])).sum(axis=(1, 2))
    return _back(waves, case, node, by_r, -which.kd[case] * by_second, by_w, by_spin)


def _surface_by(waves: Waves, case: Indices, node: Indices, by_eta: Array, by_free: Array, thrown: float) -> Pulled:
    which = waves.cases
    both, up = by_eta + by_free, waves.upward[case, node]
    by_slope = (by_free * which.half[case] - both * which.rest_rise[case]) / up[:, None]
    lateral = turned(by_slope, -waves.spin[case, node])
    by_force = np.column_stack([lateral, -(by_slope * waves.slope[case, node]).sum(axis=1)])
    by_spin = up * (by_slope * across(waves.slope[case, node])).sum(axis=1)
    by_r = which.gain[case] * both[:, None, :]
    by_w = (by_force[:, None] @ which.at_O[case])[:, 0] + thrown * TURNING
    return _back(waves, case, node, by_r, np.zeros_like(by_r), by_w, by_spin)


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


def _back(
    waves: Waves, case: Indices, node: Indices, by_r: Array, by_rate: Array, by_w: Array, by_spin: Array
) -> Pulled:
    """From derivatives (m, n_modes, 2) by r and r', (m, 12) by w itself and (m,) by the spin, at the rows' own
    nodes."""
    which, rows = waves.cases, _Columns.of(case)
    P, T, n, M = len(rows.present), len(waves.t), by_r.shape[1], rows.count
    x, rate = np.zeros((2, P, T, n, 2, M))
    x[rows.at, node, :, :, rows.column], rate[rows.at, node, :, :, rows.column] = by_r, by_rate
    some = waves.filters.only((rows.present,))
    axes = waves.filters.gain.shape[2]

    def by_filter(values: Array) -> Array:
        return np.ascontiguousarray(values.reshape(P, T, n, axes, -1).transpose(0, 2, 3, 1, 4))

    driven = some.gradient(by_filter(x), by_filter(rate))  # (P, n, axes, T, 2 M / axes)
    driven = driven.reshape(P, n, axes, T, 2 // axes, M).transpose(0, 5, 3, 1, 2, 4).reshape(P, M, T, n, 2)
    spin, at_modes = waves.spin[rows.present, None], waves.at_modes[rows.present, None]
    at_mode = which.at_mode[rows.present].reshape(P, 2 * n, N_MOTION)
    out = -(turned(driven, -spin[..., None]).reshape(P, M * T, 2 * n) @ at_mode).reshape(P, M, T, N_MOTION)
    stiff = (which.omega[:, None] ** 2 / GRAVITY * waves.r)[rows.present, None]
    out -= (driven * stiff).sum(axis=(3, 4))[..., None] * which.at_O[rows.present, None, None, 2]
    if which.round:
        spun = -(driven * across(at_modes)).sum(axis=(3, 4))
        spun[rows.at, rows.column, node] += by_spin
        flat = spun.reshape(P * M, T).T
        out[..., 5] += waves.turning.gradient(flat, np.zeros_like(flat)).T.reshape(P, M, T)
    found = out[rows.at, rows.column]
    found[np.arange(len(case)), node] += by_w
    slower = sum(
        (by * x[case, node]).sum(axis=(1, 2)) for by, x in zip((by_r, by_rate), waves.slower, strict=True)
    )
    return found, slower + 2 * waves.spin[case, node] * by_spin
