"""How near the liquids of a payload come to their brims along what its tray feels: what they must keep, and the verdict
on them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from salver.geometry import Array, Indices
from salver.liquid.sloshing import LIGHTEST, Slosh
from salver.liquid.wave_cases import VERDICT_APART, cases
from salver.liquid.wave_gradients import Unknowns
from salver.liquid.waves import along
from salver.models.payload import Payload
from salver.models.uncertain.parameters import NOTHING, UncertainSet


@dataclass(frozen=True, eq=False)
class Liquids:
    """All liquids of a payload along what its tray feels, w (T, 12) at t (T,), by body: at their nominal fill and
    damping, and at all cases. whole, kept: of which motion these are some instants, and which."""

    payload: Payload
    t: Array
    w: Array
    whole: Liquids | None = None
    kept: Indices | None = None

    @classmethod
    def along(cls, payload: Payload, t: Array, w: Array) -> Liquids | None:
        """A motion that begins at rest. None without a liquid."""
        return cls(payload, t, w) if payload.liquids else None

    @cached_property
    def nominal(self) -> Mapping[str, tuple[Slosh, ...]]:
        return self._found(NOTHING) if self.whole is None else self._thinned(self.whole.nominal)

    @cached_property
    def worst(self) -> Mapping[str, tuple[Slosh, ...]]:
        return self._found(self.payload.uncertain) if self.whole is None else self._thinned(self.whole.worst)

    def _found(self, uncertain: UncertainSet) -> dict[str, tuple[Slosh, ...]]:
        return {
            body.name: (Slosh.of(along(cases(body, uncertain, VERDICT_APART), self.t, self.w)),)
            for body in self.payload.liquids
        }

    def _thinned(self, found: Mapping[str, tuple[Slosh, ...]]) -> dict[str, tuple[Slosh, ...]]:
        assert self.kept is not None
        return {name: tuple(part.at(self.kept) for part in parts) for name, parts in found.items()}

    def at(self, index: Indices) -> Liquids:
        """Of the wrenches those at some instants; what becomes of the surface stays that of the whole motion."""
        whole, kept = (self, index) if self.whole is None or self.kept is None else (self.whole, self.kept[index])
        return replace(self, whole=whole, kept=kept)

    def only(self, payload: Payload) -> Liquids:
        """The same with another uncertain set."""
        return replace(self, payload=payload, whole=None if self.whole is None else self.whole.only(payload))

    def spills(self, worst: bool) -> list[Spill]:
        """What each liquid comes to."""
        return [Spill.of(name, each) for name, each in (self.worst if worst else self.nominal).items()]


STEEP, LIGHT = ("steepness", "steepness left"), ("effective gravity",)
HIGH = "waves", "waves left", "settled waves"


@dataclass(frozen=True, eq=False)
class SloshingLimit:
    """One thing that a liquid may not exceed in any of K cases: values (K, T), or (K, 1) of what is left after the
    motion, are to be no larger than `most` (K,). by, bends: first derivatives, and factors of second ones, of values
    (m,) of cases at nodes, as of `Slosh`.
    """

    name: str
    values: Array
    most: Array
    by: Callable[[Indices, Indices, Unknowns], Array]
    bends: Callable[[Indices, Indices, Unknowns], Array]

    def left(self, instants: int) -> Array:
        """(K, T) of what is allowed the shares that are left, at so many instants; infinite where nothing is asked."""
        left = np.full((len(self.most), instants), np.inf)
        left[:, -self.values.shape[1] :] = 1 - self.values / self.most[:, None]
        return left


def limits(part: Slosh) -> list[SloshingLimit]:
    """All that a liquid must keep: no free wave is steeper than the model is valid for, during the motion or after it,
    and as much of the weight presses on its surface; in an open container it stays below the brim; and it settles, if
    that is asked for."""
    which = part.waves.cases
    liquid, light = which.liquid, np.full(len(which.each), LIGHTEST)
    free_left = part.free_left[:, None], which.steepest, _of_end(part.free_left_by), _of_end(part.free_left_bends)
    found = [
        SloshingLimit(STEEP[0], part.free_height, which.steepest, part.free_by, part.free_bends),
        SloshingLimit(LIGHT[0], part.lightness, light, part.lightness_by, part.lightness_bends),
        SloshingLimit(STEEP[1], *free_left),
    ]
    if np.isfinite(which.room).all():
        found.append(SloshingLimit(HIGH[0], part.crest, which.room, part.crest_by, part.crest_bends))
    for name, most, seconds in (
        (HIGH[1], which.room, None),
        (HIGH[2], np.full(len(light), liquid.settled), liquid.within),
    ):
        if np.isfinite(most).all():
            by, bends = (_of_end(partial(of, seconds=seconds)) for of in (part.left_by, part.left_bends))
            found.append(SloshingLimit(name, part.left(seconds)[:, None], most, by, bends))
    return found


def _of_end(derivative: Callable[[Indices, Unknowns], Array]) -> Callable[[Indices, Indices, Unknowns], Array]:
    return lambda case, node, unknowns: derivative(case, unknowns)


def slacks(part: Slosh, names: Collection[str] = (*STEEP, *LIGHT, *HIGH)) -> Array:
    """(K, T) the least of what each case leaves of some limits, as shares of what is allowed; infinite without any."""
    count = len(part.waves.t)
    none = np.full((len(part.wrench), count), np.inf)
    return np.min([none, *(limit.left(count) for limit in limits(part) if limit.name in names)], axis=0)


@dataclass(frozen=True, eq=False)
class Spill:
    """How near one liquid comes to its brim, at its worst case.

    crest: (T,) m, the highest of all cases. left: (T,) m of room over it, least of all cases; infinite under a lid.
    after: the same for good after the motion. steep: (T,) free wave over the largest for which the model is valid, at
    the end of all that are left. light: (T,) share of its weight that does not press, over the largest for which it is.
    settled: m that waves are lower than wanted, some time after the motion; infinite if nothing is wanted. slack: (T,)
    the least of these as shares of what is allowed. below: the least of left, after and settled, as such a share.
    """

    name: str
    t: Array
    crest: Array
    left: Array
    after: float
    steep: Array
    light: Array
    settled: float
    slack: Array
    below: float

    @classmethod
    def of(cls, name: str, parts: Sequence[Slosh]) -> Spill:
        waves = parts[0].waves
        which = [part.waves.cases for part in parts]
        liquid, room = which[0].liquid, np.concatenate([x.room for x in which])
        crest, rest = (np.concatenate(x) for x in ([p.crest for p in parts], [p.left() for p in parts]))
        left, after = room[:, None] - crest, room - rest
        settled = liquid.settled - max(float(p.left(liquid.within).max()) for p in parts)
        dry = left.min(axis=0), float(after.min())
        steep, light, below = (
            np.concatenate([slacks(part, names) for part in parts]).min(axis=0) for names in (STEEP, LIGHT, HIGH)
        )
        slack = np.minimum(np.minimum(steep, light), below)
        return cls(
            name, waves.t, crest.max(axis=0), *dry, 1 - steep, 1 - light, float(settled), slack, float(below.min())
        )

    def kept(self) -> dict[str, float]:
        """The least that is left of each thing that is allowed, in words, as a share of it."""
        return {
            "what they may reach": self.below,
            "the steepness to which they are known": 1 - float(self.steep.max()),
            "the weight that may be taken from them": 1 - float(self.light.max()),
        }
