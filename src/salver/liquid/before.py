"""Initial sloshing state of a motion that continues another one or a rest, with the arm's compliance."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from salver.geometry import Array, Indices
from salver.liquid.underway import Underway
from salver.liquid.wave_cases import SloshingCase
from salver.sensitivity.filter import swinging_at

Parted = tuple[tuple[SloshingCase, ...], ...]


@dataclass(frozen=True, eq=False)
class Begun:
    """Modal states of K cases of liquids at the beginning of a motion, at rest unless given: as planned; with the
    arm's compliance, that of each of n_c terms, and e and e' (2, n, K) of the arm. Or all of this at T instants, (T,
    ...)."""

    planned: Underway | None = None
    waves: Underway | None = None
    change: Underway | None = None
    reaction: Array | None = None

    def at(self, t: Array, now: float, some: Indices) -> Begun:
        """Some of the cases at an instant, of all at t (T,)."""
        first, second, third = (
            x if x is None else x.at(t, now).part(some) for x in (self.planned, self.waves, self.change)
        )
        if self.reaction is None:
            return Begun(first, second, third)
        swung = swinging_at(t, self.reaction[:, 0], self.reaction[:, 1], now)
        return Begun(first, second, third, np.stack(swung)[..., some])


@dataclass(frozen=True, eq=False)
class Past:
    """Modal states of liquids along a motion that is left at an instant, `now` (s): at its t (T,), for all cases, of
    round containers and of boxes."""

    t: Array
    known: tuple[History, ...]
    now: float = 0.0

    def begun(self, group: Parted) -> Begun:
        """Modal states of liquids, all round or all in boxes, where the motion is left."""
        history = next(each for each in self.known if _name(group[0][0]) in each.index)
        return history.along.at(self.t, self.now, history.places(group))

    @property
    def stray(self) -> Array:
        """(n,) rad, the most by which each joint gives way to what liquids push, each at its worst case; 0 for an arm
        that follows exactly."""
        found: Array = np.zeros(1)
        for history in self.known:
            reaction = history.along.reaction
            if reaction is not None:
                ends = np.cumsum([len(liquid) for liquid in history.group])[:-1]
                most = np.split(np.abs(reaction[:, 0]).max(axis=0), ends, axis=1)
                found = found + sum(each.max(axis=1) for each in most)
        return found


@dataclass(frozen=True, eq=False)
class History:
    """`Begun` of cases, by name, fill and damping, at all T instants of a motion."""

    group: Parted
    along: Begun

    @property
    def round(self) -> bool:
        """Whether they are in round containers, or else in boxes."""
        return self.group[0][0].liquid.round

    @cached_property
    def index(self) -> dict[tuple[str, float, float], int]:
        return {_name(case): k for k, case in enumerate(all_cases(self.group))}

    def places(self, group: Parted) -> Indices:
        """Indices of a group's cases."""
        return np.array([self.index[_name(case)] for case in all_cases(group)])


def _name(case: SloshingCase) -> tuple[str, float, float]:
    return case.body.name, case.fill, case.damping


def all_cases(group: Parted) -> tuple[SloshingCase, ...]:
    return tuple(case for liquid in group for case in liquid)
