"""Derivatives of what moves inside loads by the unknowns of a motion.

Rows (m,) are functions of the modes of one case, `case`, at one node, `node`; c unknowns change what drives the modes.
Each answer is (m, c).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from salver.dynamics.modal_motion import ModalMotion, across, turned
from salver.geometry import Array, Indices, Mask
from salver.linear_filter import LinearFilter
from salver.models.load_dynamics import GRAVITY
from salver.models.tray_motion import N_MOTION


@dataclass(frozen=True, eq=False)
class Swings:
    """Derivatives of modes by c unknowns: of their masses by their drive, as `ModalMotion.swung` has it, of rotation by
    spun (K or 1, T, c), and of both by the growth of log T, stretch (c,).

    Places and speeds are computed at the nodes at which rows read them: near the edge there are few.
    """

    modes: ModalMotion
    moving: Array
    spun: Array
    stretch: Array
    _known: dict[int, tuple[Mask, Array]] = field(default_factory=dict)

    def at(self, order: int, case: Indices, node: Indices) -> Array:
        """(m, n_modes, 2, c) of r (order 0) or r' (1)."""
        if order not in self._known:
            shape = (*self.modes.r.shape, len(self.stretch))
            self._known[order] = np.zeros(shape[1], dtype=bool), np.empty(shape)
        known, found = self._known[order]
        new = np.zeros_like(known)
        new[node] = True
        new &= ~known
        if new.any():
            swung = self.modes.swinging(order, np.flatnonzero(new), self.moving)
            for c in np.flatnonzero(self.stretch):
                swung[..., c] += self.modes.slower[order][:, new] * self.stretch[c]
            found[:, new] = swung
            known |= new
        return np.asarray(found[case, node])

    def spun_at(self, case: Indices, node: Indices) -> Array:
        """(m, c) of the spin."""
        slower = self.modes.spun_slower
        found = np.broadcast_to(self.spun, (*slower.shape, len(self.stretch)))[case, node]
        for c in np.flatnonzero(self.stretch):
            found[:, c] += slower[case, node] * self.stretch[c]
        return np.asarray(found)


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Ways (c,) in which a motion can change: felt (T, 12, c), what the tray then feels in each share of the time;
    stretch (c,), by how much log T grows, None for not at all."""

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
        """The same of modes at rest, each with those of the motion before it; the tray's posture is taken as given."""
        count = self.felt.shape[2]
        found = Unknowns(np.zeros((len(pairs[0][0].t), N_MOTION, count)))
        for rest, motion in pairs:
            swings, every = self.of(motion), np.arange(len(motion.r))
            last = np.full_like(every, len(motion.t) - 1)
            moving = rest.begun_by(*(swings.at(order, every, last) for order in range(2)))
            spun = swings.spun_at(every, last)[:, None] * rest.cases.round
            found._known[id(rest)] = rest, Swings(rest, moving, spun, np.zeros(count))
        return found

    def _swings(self, modes: ModalMotion) -> Swings:
        key = modes.turning, modes.cases.round
        if key not in self._spun:
            self._spun[key] = modes.spun(self.felt[None])
        stretch = np.zeros(self.felt.shape[2]) if self.stretch is None else self.stretch
        return Swings(modes, modes.swung(self.felt[None], self._spun[key]), self._spun[key], stretch)


def wrench_by(modes: ModalMotion, unknowns: Unknowns, case: Indices, node: Indices, weight: Array) -> Array:
    """Of weight (m, 6) . wrench."""
    which, m = modes.cases, len(case)
    force, spin = modes.force[case, node], modes.spin[case, node]
    r, second = (turned(x[case, node], -spin[:, None]) for x in (modes.r, modes.second))
    mass = which.mass[case]
    weight = (weight[:, None] @ which.to_E[case])[:, 0]
    tilting = weight[:, [4, 3]] * [1.0, -1.0]  # what turns along x is a moment about y
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
    """From derivatives (m, n_modes, 2) by r and r', (m, 12) by w itself and (m,) by `ModalMotion.spun`, at the rows'
    own nodes."""
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
