"""Sloshing on a tray whose arm is compliant to the load's reaction and to that of the liquids."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from salver.geometry import Array
from salver.liquid.before import Begun, History, Parted, Past, all_cases
from salver.liquid.sloshing import Slosh
from salver.liquid.underway import Underway
from salver.liquid.wave_cases import SloshingCase
from salver.liquid.waves import Waves, along
from salver.models.uncertain.parameters import Parameter
from salver.sensitivity.arm.load import LoadChange
from salver.sensitivity.arm.tracking import Deviation, Reaction

# In which waves, and the arm that gives way to them, are known to half a hundredth; and to half a thousandth, where
# motions go on from one another again and again.
ROUNDS, MORE_ROUNDS = 2, 3


@dataclass(frozen=True, eq=False)
class Sloshing:
    """Sloshing of all liquids along a tray's motion, with the cases of each side by side.

    together: liquids that are all round or all in boxes, and of all their cases, one after the other, the waves as
    planned and, of an arm that gives way, with what it makes of them. given: what these come from.
    """

    together: tuple[tuple[Parted, tuple[Slosh, ...]], ...]
    given: tuple[Given, ...] = ()

    @classmethod
    def of(
        cls,
        liquids: Parted,
        t: Array,
        w: Array,
        response: Deviation | None,
        past: Past | None = None,
        rounds: int | None = None,
    ) -> Sloshing:
        """Along w (T, 12) at t (T,), which begins at rest, or where the past is left. rounds: see `Given.along`; more
        where there is a past unless given."""
        rounds = rounds or (ROUNDS if past is None else MORE_ROUNDS)
        found, given = [], list[Given]()
        for alike in (True, False):
            group = tuple(each for each in liquids if each and each[0].liquid.round is alike)
            if group:
                begun = Begun() if past is None else past.begun(group)
                given.append(Given.along(group, t, w, response, begun, rounds))
                found.append((group, given[-1].sloshes))
        return cls(tuple(found), tuple(given))

    def along(self, t: Array, w: Array) -> Sloshing:
        """The liquids along another motion, with the arm's compliance of this one."""
        found = []
        for group, (old, *given) in self.together:
            planned = Slosh.of(along(all_cases(group), t, w, old.waves.start))
            found.append((group, (planned, *(part.along(planned.waves) for part in given))))
        return Sloshing(tuple(found))

    def past(self, t: Array) -> Past:
        """Initial sloshing state of a motion that continues this one, which was evaluated at t (T,)."""
        known = zip(self.together, self.given, strict=True)
        return Past(t, tuple(History(group, given.underway) for (group, _), given in known))

    def rested(self, t: Array) -> Past:
        """Initial sloshing state after a rest that lasts as long as this motion and t (T,), s, more."""
        known = zip(self.together, self.given, strict=True)
        return Past(t, tuple(History(group, given.rested(t)) for (group, _), given in known), t[0])

    @property
    def each(self) -> dict[str, tuple[Slosh, ...]]:
        """By the name of its body, the cases of each liquid, in parts."""
        found = {}
        for group, parts in self.together:
            planned, *given = parts
            begin = 0
            for liquid in group:
                some = slice(begin, begin + len(liquid))
                first = planned.part(some)
                found[liquid[0].body.name] = (first, *(part.part(some, first.waves) for part in given))
                begin += len(liquid)
        return found


@dataclass(frozen=True, eq=False)
class Given:
    """All cases of a group of liquids along a motion.

    planned: waves on a tray that follows its motion exactly. Of an arm that gives way: waves with what it makes of
    that, its reaction to them, and changes (K, T, 12, n_c) of the tray's motion regressor that are uncertain.
    """

    planned: Waves
    begun: Begun
    waves: Waves | None = None
    reaction: Reaction | None = None
    unknown: Array | None = None

    @classmethod
    def along(
        cls,
        group: Parted,
        t: Array,
        w: Array,
        response: Deviation | None,
        begun: Begun,
        rounds: int = ROUNDS,
    ) -> Given:
        """Along the tray's motion regressor, w (T, 12), at t (T,). rounds: in which the arm gives way to what the waves
        push, and the waves are then others, by an eighth as much each time."""
        planned = along(all_cases(group), t, w, begun.planned)
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
        waves = planned if begun.waves is None else planned.shifted(known, begun.waves)
        for _ in range(rounds):
            reaction = response.reaction(waves.wrench, begun.reaction)
            waves = planned.shifted(known + reaction.w, begun.waves)
        return cls(planned, begun, waves, reaction, unknown)

    @property
    def sloshes(self) -> tuple[Slosh, ...]:
        """Sloshing as planned, and with the compliance of the arm."""
        if self.waves is None or self.reaction is None or self.unknown is None:
            return (Slosh.of(self.planned),)
        return Slosh.of(self.planned), Slosh.given_way(self.waves, self.planned, self.reaction, *self.changing)

    @property
    def changing(self) -> tuple[Array, Underway | None]:
        """Uncertain changes of the tray's motion regressor, and the sloshing that they have caused till then."""
        assert self.unknown is not None
        change = self.begun.change
        if change is not None:  # of fewer terms where those liquids are left out that know most of them
            change = change.of_terms(self.unknown.shape[3])
        return self.unknown, change

    @property
    def underway(self) -> Begun:
        """All of it at the instants of the motion."""
        planned = self.planned.underway()
        if self.waves is None or self.reaction is None:
            return Begun(planned)
        joints = self.reaction.joints
        reaction = -np.stack([joints.q, joints.dq], axis=1)
        return Begun(planned, self.waves.underway(), self.waves.underway(*self.changing), reaction)

    def rested(self, t: Array) -> Begun:
        """All of it t (T,), s, after the motion, the arm taken for still."""
        planned = self.planned.rested(t)
        if self.waves is None or self.reaction is None:
            return Begun(planned)
        n, K = self.reaction.joints.missing.shape[1:]
        still = np.zeros((len(t), 2, n, K))
        return Begun(planned, self.waves.rested(t), self.waves.rested(t, *self.changing), still)


def of_cases(several: Sequence[SloshingCase], load: LoadChange, dw: Array) -> tuple[Array, Array]:
    """Change of dw (T, 12, n_c), per half-range of each term of a load, at the fills of K cases: (K, T, 12) the sure
    part, and (K, T, 12, n) the uncertain part.

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
