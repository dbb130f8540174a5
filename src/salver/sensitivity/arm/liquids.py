"""What liquids do on a tray whose arm gives way: to its load as much as to their waves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from salver.geometry import Array
from salver.models.parameters import Parameter
from salver.sensitivity.arm.load import LoadChange
from salver.sensitivity.arm.tracking import Deviation, Reaction
from salver.sensitivity.filter import at_instant
from salver.sensitivity.sloshing import Slosh
from salver.sensitivity.wave_cases import Case
from salver.sensitivity.waves import Underway, Waves, along

Parted = tuple[tuple[Case, ...], ...]


@dataclass(frozen=True, eq=False)
class Sloshing:
    """What liquids do along what a tray feels: of each the cases that stand for it, all worked out side by side.

    together: liquids that are all round or all in boxes, and of all their cases, one after the other, the waves as
    planned and, of an arm that gives way, with what it makes of them.
    """

    together: tuple[tuple[Parted, tuple[Slosh, ...]], ...]

    @classmethod
    def of(cls, liquids: Parted, t: Array, w: Array, response: Deviation | None, past: Past | None = None) -> Sloshing:
        """Along w (T, 12) at t (T,), which begins at rest, or where the past is left."""
        found = []
        for alike in (True, False):
            group = tuple(each for each in liquids if each and each[0].liquid.round is alike)
            if group:
                begun = Begun() if past is None else past.begun(group)
                found.append((group, Given.along(group, t, w, response, begun).sloshes))
        return cls(tuple(found))

    def along(self, t: Array, w: Array) -> Sloshing:
        """The same liquids along another motion, with an arm that gives way as along this one."""
        found = []
        for group, (old, *given) in self.together:
            planned = Slosh.of(along(_cases(group), t, w, old.waves.start))
            found.append((group, (planned, *(part.along(planned.waves) for part in given))))
        return Sloshing(tuple(found))

    @property
    def each(self) -> dict[str, tuple[Slosh, ...]]:
        """The cases of each liquid, by the name of its body, in parts."""
        found = {}
        for group, parts in self.together:
            planned, *given = (part.prepared() for part in parts)
            begin = 0
            for liquid in group:
                some = slice(begin, begin + len(liquid))
                first = planned.part(some)
                found[liquid[0].body.name] = (first, *(part.part(some, first.waves) for part in given))
                begin += len(liquid)
        return found


@dataclass(frozen=True, eq=False)
class Begun:
    """How K cases of liquids are where a motion begins, at rest unless given: as planned; and, of an arm that gives
    way, with what it has made of that, what each of n_c terms has made of it, and e and e' (2, n, K) of the arm."""

    planned: Underway | None = None
    waves: Underway | None = None
    change: Underway | None = None
    reaction: Array | None = None


@dataclass(frozen=True, eq=False)
class Given:
    """All cases of a group of liquids along a motion.

    planned: waves on a tray that follows its motion exactly. Of an arm that gives way: waves with what it makes of
    that, its reaction to them, and changes (K, T, 12, n_c) of what the tray feels that may be or not.
    """

    planned: Waves
    begun: Begun
    waves: Waves | None = None
    reaction: Reaction | None = None
    unknown: Array | None = None

    @classmethod
    def along(cls, group: Parted, t: Array, w: Array, response: Deviation | None, begun: Begun) -> Given:
        """Along what the tray feels, w (T, 12), at t (T,)."""
        planned = along(_cases(group), t, w, begun.planned)
        if response is None:
            return cls(planned, begun)
        felt, drift = response.felt()
        each = [of_cases(liquid, response.load, drift.dw) for liquid in group]
        known = np.concatenate([sure for sure, _ in each]) + (felt - w)
        unknown = np.zeros((*known.shape, max(free.shape[3] for _, free in each)))
        begin = 0
        for _, free in each:
            unknown[begin : begin + len(free), :, :, : free.shape[3]] = free
            begin += len(free)
        # The arm gives way to what the waves push, and the waves are then others: twice round is enough.
        reaction = response.reaction(planned.wrench, begun.reaction)
        reaction = response.reaction(planned.shifted(known + reaction.w, begun.waves).wrench, begun.reaction)
        return cls(planned, begun, planned.shifted(known + reaction.w, begun.waves), reaction, unknown)

    @property
    def sloshes(self) -> tuple[Slosh, ...]:
        """As planned, and with what the arm makes of it."""
        if self.waves is None or self.reaction is None or self.unknown is None:
            return (Slosh.of(self.planned),)
        change = self.begun.change
        if change is not None:  # of fewer terms where those liquids are left out that know most of them
            change = change.of_terms(self.unknown.shape[3])
        given = Slosh.given_way(self.waves, self.planned, self.reaction, self.unknown, change)
        return Slosh.of(self.planned), given


@dataclass(frozen=True, eq=False)
class Past:
    """A motion from rest that is left at an instant, `now` (s): what the tray feels along it, w (T, 12) at t (T,), what
    the arm makes of that, and of each liquid all the cases that may be asked for."""

    t: Array
    w: Array
    response: Deviation | None
    liquids: Parted
    now: float = 0.0
    _known: dict[bool, _History] = field(default_factory=dict)

    def begun(self, group: Parted) -> Begun:
        """How liquids that are all round or all in boxes are where the motion is left."""
        alike = group[0][0].liquid.round
        if alike not in self._known:
            known = tuple(each for each in self.liquids if each[0].liquid.round is alike)
            self._known[alike] = _History.of(known, Given.along(known, self.t, self.w, self.response, Begun()))
        return self._known[alike].at(self.t, self.now, group)


@dataclass(frozen=True, eq=False)
class _History:
    """`Begun` of cases, by name, fill and damping, at all T instants of a motion; reaction (T, 2, n, K)."""

    index: dict[tuple[str, float, float], int]
    planned: Underway
    given: tuple[Underway, Underway, Array] | None

    @classmethod
    def of(cls, group: Parted, along: Given) -> _History:
        index = {_name(case): k for k, case in enumerate(_cases(group))}
        planned = along.planned.underway()
        if along.waves is None or along.reaction is None:
            return cls(index, planned, None)
        joints = along.reaction.joints
        reaction = -np.stack([joints.q, joints.dq], axis=1)
        return cls(index, planned, (along.waves.underway(), along.waves.underway(along.unknown), reaction))

    def at(self, t: Array, now: float, group: Parted) -> Begun:
        """At an instant of t (T,), of some of the cases."""
        some = np.array([self.index[_name(case)] for case in _cases(group)])
        planned = self.planned.at(t, now).part(some)
        if self.given is None:
            return Begun(planned)
        waves, change, reaction = self.given
        waves, change = (x.at(t, now).part(some) for x in (waves, change))
        return Begun(planned, waves, change, at_instant(t, reaction, now)[..., some])


def _name(case: Case) -> tuple[str, float, float]:
    return case.body.name, case.fill, case.damping


def _cases(group: Parted) -> tuple[Case, ...]:
    return tuple(case for liquid in group for case in liquid)


def of_cases(several: Sequence[Case], load: LoadChange, dw: Array) -> tuple[Array, Array]:
    """What changes dw (T, 12, n_c), per half-range of each term of a load, are at the fills of K cases: (K, T, 12) what
    is sure there, and (K, T, 12, n) what else may be.

    A case knows its own fill, and with it what that weighs. Products of two others are left out: they are a
    hundredth of what single ones do to waves.
    """
    body = several[0].body
    own, half = Parameter(body.name, "fill"), load.uncertain.ranges
    others = [p for p in load.uncertain.parameters if p != own]
    share = np.array([(case.fill - case.liquid.fill) / half[own] if own in half else 0.0 for case in several])
    sure, free = np.zeros((len(several), len(load.terms))), np.zeros((len(several), len(load.terms), len(others)))
    for k, factors in enumerate(load.terms):
        rest = [p for p in factors if p != own]
        power = share ** (len(factors) - len(rest))
        if not rest:
            sure[:, k] = power
        elif len(rest) == 1:
            free[:, k, others.index(rest[0])] = power
    return np.moveaxis(dw @ sure.T, 2, 0), dw @ free[:, None]
