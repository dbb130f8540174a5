"""How near the liquids of a payload come to their brims along what its tray feels: the verdict on them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from salver.geometry import Array, Indices
from salver.models.parameters import NOTHING, UncertainSet
from salver.models.payload import Payload
from salver.sensitivity.sloshing import LIGHTEST, Slosh
from salver.sensitivity.wave_cases import VERDICT_APART, cases
from salver.sensitivity.waves import along


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
        steep, light = (np.concatenate(x).max(axis=0) for x in zip(*(_unmodelled(part) for part in parts), strict=True))
        dry = left.min(axis=0), float(after.min())
        slack = np.concatenate([slacks(part) for part in parts]).min(axis=0)
        below = min(float(_below(part).min()) for part in parts)
        return cls(name, waves.t, crest.max(axis=0), *dry, steep, light, float(settled), slack, below)

    def kept(self) -> dict[str, float]:
        """The least that is left of each thing that is allowed, in words, as a share of it."""
        return {
            "what they may reach": self.below,
            "the steepness to which they are known": 1 - float(self.steep.max()),
            "the weight that may be taken from them": 1 - float(self.light.max()),
        }


def _unmodelled(part: Slosh) -> tuple[Array, Array]:
    """(K, T) free wave over the largest for which the model is valid, at the end of all that are left, and share of the
    weight that does not press, over the largest for which it is."""
    steepest = part.waves.cases.steepest
    steep = part.free_height / steepest[:, None]
    steep[:, -1] = part.free_left / steepest  # not lower than there
    return steep, part.lightness / LIGHTEST


def slacks(part: Slosh) -> Array:
    """(K, T) the least of what each case leaves, as shares of what is allowed."""
    return np.asarray(np.minimum(1 - np.maximum(*_unmodelled(part)), _below(part)))


def _below(part: Slosh) -> Array:
    """(K, T) the same of heights alone; infinite where any is allowed."""
    which = part.waves.cases
    liquid, room = which.liquid, which.room
    slack = np.full(part.crest.shape, np.inf)
    if np.isfinite(room).all():
        slack = 1 - part.crest / room[:, None]
        slack[:, -1] = np.minimum(slack[:, -1], 1 - part.left() / room)
    if np.isfinite(liquid.settled):
        slack[:, -1] = np.minimum(slack[:, -1], 1 - part.left(liquid.within) / liquid.settled)
    return slack
