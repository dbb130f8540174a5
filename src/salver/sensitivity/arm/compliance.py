"""Load dynamics on a compliant arm, which deviates under parameter errors and under the reaction of load dynamics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from salver.dynamics.load_cases import LoadCase, alike
from salver.dynamics.load_response import LoadResponse
from salver.dynamics.modal_history import CaseGroups, CaseHistory, InitialState, Past, all_cases
from salver.dynamics.modal_motion import ModalMotion
from salver.dynamics.modal_state import ModalState
from salver.geometry import Array
from salver.sensitivity.arm.load import LoadChange
from salver.sensitivity.arm.tracking import Deviation, Reaction

# Iterations of modes and arm deviation: relative error of 5e-3; of 5e-4 for motions that go on from each other
# repeatedly.
ROUNDS, MORE_ROUNDS = 2, 3


@dataclass(frozen=True, eq=False)
class LoadResponses:
    """Responses of all load dynamics along a tray's motion; `alike` cases are computed together.

    together: groups of `alike` loads, and the responses of all their cases one after the other: as planned and, for a
    compliant arm, with its deviation. given: the group responses from which these were made.
    """

    together: tuple[tuple[CaseGroups, tuple[LoadResponse, ...]], ...]
    given: tuple[GroupResponse, ...] = ()

    @classmethod
    def of(
        cls,
        loads: CaseGroups,
        t: Array,
        w: Array,
        response: Deviation | None,
        past: Past | None = None,
        rounds: int | None = None,
    ) -> LoadResponses:
        """The responses along w (T, 12) at t (T,), from rest or from the states in `past`. rounds: see
        `GroupResponse.along`; by default more with a past."""
        rounds = rounds or (ROUNDS if past is None else MORE_ROUNDS)
        found, given = [], list[GroupResponse]()
        for group in _alike(loads):
            begun = InitialState() if past is None else past.begun(group)
            given.append(GroupResponse.along(group, t, w, response, begun, rounds))
            found.append((group, given[-1].responses))
        return cls(tuple(found), tuple(given))

    def along(self, t: Array, w: Array, after: LoadResponses | None = None) -> LoadResponses:
        """The responses along another motion, with the arm's deviation of this one. after: responses along the motion
        that it continues, if that differs too."""
        found = []
        for k, (group, (old, *given)) in enumerate(self.together):
            start = old.modes.start if after is None else after.together[k][1][0].modes.states.last
            planned = type(old).of(old.modes.along(all_cases(group), t, w, start))
            found.append((group, (planned, *(part.along(planned.modes) for part in given))))
        return LoadResponses(tuple(found))

    def past(self, t: Array) -> Past:
        """Initial modal state of a motion that continues this one, which was evaluated at t (T,)."""
        known = zip(self.together, self.given, strict=True)
        return Past(t, tuple(CaseHistory(group, given.states) for (group, _), given in known))

    def rested(self, t: Array) -> Past:
        """Initial modal state after a rest that lasts as long as this motion and t (T,), s, more."""
        known = zip(self.together, self.given, strict=True)
        return Past(t, tuple(CaseHistory(group, given.rested(t)) for (group, _), given in known), t[0])

    @property
    def each(self) -> dict[str, tuple[LoadResponse, ...]]:
        """The cases of each load, in parts, by the name of its body."""
        found = {}
        for group, parts in self.together:
            planned, *given = parts
            begin = 0
            for load in group:
                some = slice(begin, begin + len(load))
                first = planned.part(some)
                found[load[0].body.name] = (first, *(part.part(some, first.modes) for part in given))
                begin += len(load)
        return found


def _alike(loads: CaseGroups) -> list[CaseGroups]:
    """Groups of `alike` cases, round ones first."""
    kinds = dict.fromkeys(alike(each[0]) for each in loads if each)
    first = sorted(kinds, key=lambda kind: not kind[1])
    return [tuple(each for each in loads if each and alike(each[0]) == kind) for kind in first]


@dataclass(frozen=True, eq=False)
class GroupResponse:
    """Responses of a group of `alike` loads along a motion, in all their cases.

    planned: modes on a tray without tracking error. For a compliant arm: modes with its deviation, its reaction to
    them, and uncertain changes (K, T, 12, n_c) of the tray's motion regressor.
    """

    kind: type[LoadResponse]
    planned: ModalMotion
    begun: InitialState
    modes: ModalMotion | None = None
    reaction: Reaction | None = None
    unknown: Array | None = None

    @classmethod
    def along(
        cls,
        group: CaseGroups,
        t: Array,
        w: Array,
        response: Deviation | None,
        begun: InitialState,
        rounds: int = ROUNDS,
    ) -> GroupResponse:
        """The response along the tray's motion regressor w (T, 12) at t (T,). rounds: iterations of the arm's deviation
        under the modes' reaction and of the modes under that deviation; each changes them by an eighth of the last."""
        kind: type[LoadResponse] = group[0][0].dynamics.response
        planned = kind.motion_type.along(all_cases(group), t, w, begun.planned)
        if response is None:
            return cls(kind, planned, begun)
        felt, drift = response.felt()
        each = [of_cases(load, response.load, drift.dw) for load in group]
        known = np.concatenate([sure for sure, _ in each]) + (felt - w)
        unknown = np.zeros((*known.shape, max(free.shape[3] for _, free in each)))
        begin = 0
        for _, free in each:
            unknown[begin : begin + len(free), :, :, : free.shape[3]] = free
            begin += len(free)
        modes = planned if begun.compliant is None else planned.shifted(known, begun.compliant)
        for _ in range(rounds):
            reaction = response.reaction(modes.wrench, begun.reaction)
            modes = planned.shifted(known + reaction.w, begun.compliant)
        return cls(kind, planned, begun, modes, reaction, unknown)

    @cached_property
    def responses(self) -> tuple[LoadResponse, ...]:
        """The responses as planned, and with the arm's compliance."""
        if self.modes is None or self.reaction is None or self.unknown is None:
            return (self.kind.of(self.planned),)
        change = self.begun.change
        if change is not None:  # of fewer terms where those loads are left out that know most of them
            change = change.of_terms(self.unknown.shape[3])
        return (
            self.kind.of(self.planned),
            self.kind.compliant(self.modes, self.planned, self.reaction, self.unknown, change),
        )

    @property
    def states(self) -> InitialState:
        """All modal states at the instants of the motion."""
        if self.modes is None or self.reaction is None:
            return InitialState(self.planned.states)
        joints, change = self.reaction.joints, self.responses[1].change
        assert change is not None
        reaction = -np.stack([joints.q, joints.dq], axis=1)
        return InitialState(self.planned.states, self.modes.states, change.states, reaction)

    def rested(self, t: Array) -> InitialState:
        """All modal states t (T,) seconds after the motion, with the arm taken as at rest."""

        def later(modes: ModalMotion, states: ModalState, rest: Array) -> ModalState:
            shape = (*modes.cases.omega.shape, *(1,) * (rest.ndim - 3))
            sigma, kp = (x.reshape(shape) for x in (0.5 * modes.cases.kd, modes.stiffness))
            return states.last.later(t, sigma, kp, rest)

        planned = later(self.planned, self.planned.states, self.planned.equilibrium)
        if self.modes is None or self.reaction is None or self.unknown is None:
            return InitialState(planned)
        n, K = self.reaction.joints.missing.shape[1:]
        still, change = np.zeros((len(t), 2, n, K)), self.responses[1].change
        assert change is not None
        turned = change.angle if self.modes.cases.round else change.turning
        free = self.modes.equilibrium_by(self.unknown, turned)
        compliant = later(self.modes, self.modes.states, self.modes.equilibrium)
        return InitialState(planned, compliant, later(self.modes, change.states, free), still)


def of_cases(several: Sequence[LoadCase], load: LoadChange, dw: Array) -> tuple[Array, Array]:
    """The change of w by terms, dw (T, 12, n_c) per half-range, in K cases of a load: the part (K, T, 12) that a case
    determines, and the uncertain part (K, T, 12, n).

    A case has a value of its own, and with it a mass. Products of two other parameters are neglected: their effect is a
    hundredth of that of single ones.
    """
    half = load.uncertain.ranges
    own = {p: np.array([case.deviation[p] for case in several]) / half[p] for p in several[0].deviation if p in half}
    others = [p for p in load.uncertain.parameters if p not in own]
    sure, free = np.zeros((len(several), len(load.terms))), np.zeros((len(several), len(load.terms), len(others)))
    for k, factors in enumerate(load.terms):
        rest = [p for p in factors if p not in own]
        known = np.prod([own[p] for p in factors if p in own], axis=0)
        if not rest:
            sure[:, k] = known
        elif len(rest) == 1:
            free[:, k, others.index(rest[0])] = known
    return np.moveaxis(dw @ sure.T, 2, 0), dw @ free[:, None]
