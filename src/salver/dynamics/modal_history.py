"""Initial modal state of a motion that continues another one or a rest, with the arm's compliance."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from salver.dynamics.load_cases import LoadCase
from salver.dynamics.modal_state import ModalState
from salver.geometry import Array, Indices
from salver.linear_filter import swinging_at

CaseGroups = tuple[tuple[LoadCase, ...], ...]


@dataclass(frozen=True, eq=False)
class InitialState:
    """Modal states of K cases at the beginning of a motion, at rest unless given; or at T instants, (T, ...).

    planned: without the arm's compliance. compliant: with it. change: by each of n_c terms of the uncertain set.
    reaction: e and e' (2, n, K) of the arm.
    """

    planned: ModalState | None = None
    compliant: ModalState | None = None
    change: ModalState | None = None
    reaction: Array | None = None

    def at(self, t: Array, now: float, some: Indices) -> InitialState:
        """The states of some cases at the instant `now`, from states at t (T,)."""
        first, second, third = (
            x if x is None else x.at(t, now).part(some) for x in (self.planned, self.compliant, self.change)
        )
        if self.reaction is None:
            return InitialState(first, second, third)
        swung = swinging_at(t, self.reaction[:, 0], self.reaction[:, 1], now)
        return InitialState(first, second, third, np.stack(swung)[..., some])


@dataclass(frozen=True, eq=False)
class Past:
    """Modal states of all load cases along a motion, at t (T,), which another motion leaves at the instant `now`, s."""

    t: Array
    known: tuple[CaseHistory, ...]
    now: float = 0.0

    def begun(self, group: CaseGroups) -> InitialState:
        """Modal states of `alike` load cases where the motion is left."""
        history = next(each for each in self.known if group[0][0].name in each.index)
        return history.along.at(self.t, self.now, history.places(group))

    @property
    def stray(self) -> Array:
        """Largest deviation (n,) of each joint by the wrenches of load dynamics, each load in its worst case, rad; 0
        for an arm that follows exactly."""
        found: Array = np.zeros(1)
        for history in self.known:
            reaction = history.along.reaction
            if reaction is not None:
                ends = np.cumsum([len(each) for each in history.group])[:-1]
                most = np.split(np.abs(reaction[:, 0]).max(axis=0), ends, axis=1)
                found = found + sum(each.max(axis=1) for each in most)
        return found


@dataclass(frozen=True, eq=False)
class CaseHistory:
    """`InitialState` of cases at all T instants of a motion."""

    group: CaseGroups
    along: InitialState

    @cached_property
    def index(self) -> dict[tuple[str | float, ...], int]:
        return {case.name: k for k, case in enumerate(all_cases(self.group))}

    def places(self, group: CaseGroups) -> Indices:
        """Indices of a group's cases."""
        return np.array([self.index[case.name] for case in all_cases(group)])


def all_cases(group: CaseGroups) -> tuple[LoadCase, ...]:
    return tuple(case for each in group for case in each)
