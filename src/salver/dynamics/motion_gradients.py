"""Derivatives of load dynamics by the unknowns of a motion.

Row i is a function of the modes of case `case[i]` at node `node[i]`. For m rows and c unknowns results are (m, c).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from salver.dynamics.modal_motion import ModalMotion, across, turned
from salver.geometry import GRAVITY, Array, Indices
from salver.linear_filter import LinearFilter
from salver.models.tray_motion import N_MOTION


@dataclass(frozen=True, eq=False)
class Swings:
    """Derivatives of modes by c unknowns: moved (K, T, n_modes, 2, c) of r and of r' with a fixed duration, the
    rotation spun (K or 1, T, c), and the derivative of log T, stretch (c,)."""

    modes: ModalMotion
    moved: Sequence[Array]
    spun: Array
    stretch: Array

    def at(self, order: int, case: Indices, node: Indices) -> Array:
        """Derivatives (m, n_modes, 2, c) of r (order 0) or r' (order 1)."""
        found = self.moved[order][case, node]
        for c in np.flatnonzero(self.stretch):
            found[..., c] += self.modes.slower[order][case, node] * self.stretch[c]
        return np.asarray(found)

    def spun_at(self, case: Indices, node: Indices) -> Array:
        """Derivatives (m, c) of the spin."""
        slower = self.modes.spun_slower
        found = np.broadcast_to(self.spun, (*slower.shape, len(self.stretch)))[case, node]
        for c in np.flatnonzero(self.stretch):
            found[:, c] += slower[case, node] * self.stretch[c]
        return np.asarray(found)


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Unknowns (c,) of a motion: felt (T, 12, c), derivatives of the tray's motion regressor at fixed shares of the
    duration; stretch (c,), derivatives of log T, None for zero."""

    felt: Array
    stretch: Array | None = None
    _known: dict[int, tuple[ModalMotion, Swings]] = field(default_factory=dict)
    _spun: dict[tuple[LinearFilter, bool], Array] = field(default_factory=dict)

    def of(self, modes: ModalMotion) -> Swings:
        """Derivatives of modes, computed once."""
        if id(modes) not in self._known:
            self._known[id(modes)] = modes, self._swings(modes)
        return self._known[id(modes)][1]

    def after(self, pairs: Sequence[tuple[ModalMotion, ModalMotion]]) -> Unknowns:
        """Derivatives for the modes in the rest after the motion, each paired with those of the motion. Changes of the
        tray's final posture are neglected."""
        count = self.felt.shape[2]
        found = Unknowns(np.zeros((len(pairs[0][0].t), N_MOTION, count)))
        for rest, motion in pairs:
            swings, every = self.of(motion), np.arange(len(motion.r))
            last = np.full_like(every, len(motion.t) - 1)
            begun = [swings.at(order, every, last) for order in range(2)]
            moved = rest.respond(np.zeros((*rest.r.shape, count)), *begun)
            spun = swings.spun_at(every, last)[:, None] * rest.cases.round
            found._known[id(rest)] = rest, Swings(rest, moved, spun, np.zeros(count))
        return found

    def _swings(self, modes: ModalMotion) -> Swings:
        key = modes.turning, modes.cases.round
        if key not in self._spun:
            self._spun[key] = modes.spun(self.felt[None])
        stretch = np.zeros(self.felt.shape[2]) if self.stretch is None else self.stretch
        moved = modes.pushed(self.felt[None], before=True, spun=self._spun[key])
        return Swings(modes, moved, self._spun[key], stretch)


def wrench_by(modes: ModalMotion, unknowns: Unknowns, case: Indices, node: Indices, weight: Array) -> Array:
    """Derivatives of weight (m, 6) . wrench."""
    which, m = modes.cases, len(case)
    force, spin = modes.force[case, node], modes.spin[case, node]
    r, second = (turned(x[case, node], -spin[:, None]) for x in (modes.r, modes.second))
    mass = which.mass[case]
    weight = (weight[:, None] @ which.to_E[case])[:, 0]
    tilting = weight[:, [4, 3]] * [1.0, -1.0]  # a torque about y acts on motion along x
    rising = which.rising[case] * weight[:, 2, None, None]
    by_second = mass * (weight[:, None, :2] + which.height[case] * tilting[:, None]) + rising * r
    hanging = -tilting * force[:, 2:] + weight[:, 5:] * force[:, [1, 0]] * [1.0, -1.0]
    stiff = which.omega[case] ** 2 / GRAVITY
    by_hung = mass * hanging[:, None] + rising * second
    by_spin = -(by_second * across(second) + by_hung * across(r)).sum(axis=(1, 2))
    hung = (mass * r).sum(axis=1)
    by_up = -(tilting * hung).sum(axis=1) - (by_second * stiff * r).sum(axis=(1, 2))
    by_force = np.stack([-weight[:, 5] * hung[:, 1], weight[:, 5] * hung[:, 0], by_up], axis=1)
    by_w = (by_force[:, None] @ which.at_O[case])[:, 0]
    by_w -= (by_second.reshape(m, 1, -1) @ which.at_mode[case].reshape(m, -1, N_MOTION))[:, 0]
    by_second = turned(by_second, spin[:, None])
    by_r = turned(by_hung, spin[:, None]) - stiff * modes.upward[case, node, None, None] * by_second
    by_rate = 2 * rising * modes.rate[case, node] - which.kd[case] * by_second
    if which.round:
        by_spin -= (by_second * across(modes.at_modes[case, node])).sum(axis=(1, 2))
    else:
        by_turn, by_faster = modes.pushed_by_turning
        by_spin = (by_second * by_turn[case, node]).sum(axis=(1, 2))
        by_w[:, 5] += (by_second * by_faster[case, node]).sum(axis=(1, 2))
        if modes.walls is not None:
            other_rate, other, own = (by_second * x[case, node] for x in modes.walls)
            by_rate, by_r = by_rate + other_rate[..., ::-1], by_r + other[..., ::-1] + own
    return at_node(unknowns, modes, case, node, by_r, by_rate, by_w, by_spin)


def at_node(
    unknowns: Unknowns,
    modes: ModalMotion,
    case: Indices,
    node: Indices,
    by_r: Array,
    by_rate: Array | None = None,
    by_w: Array | None = None,
    by_spin: Array | None = None,
) -> Array:
    """Chain rule from derivatives of rows by r and r' (m, n_modes, 2), by w (m, 12) and by `ModalMotion.spun` (m,),
    each at the row's node."""
    swings = unknowns.of(modes)

    def read(by: Array, order: int) -> Array:
        m = len(case)
        return np.asarray((by.reshape(m, 1, -1) @ swings.at(order, case, node).reshape(m, by[0].size, -1))[:, 0])

    found = read(by_r, 0)
    if by_rate is not None:
        found += read(by_rate, 1)
    if by_w is not None:
        found += (by_w[:, None] @ unknowns.felt[node])[:, 0]
    if by_spin is not None:
        found += by_spin[:, None] * swings.spun_at(case, node)
    return found
