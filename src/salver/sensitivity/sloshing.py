"""What the waves of liquids ask of their containers, at the worst of all that is uncertain: to stay below the brim, and
to be held against the wrench of the slosh (`salver.sensitivity.waves` has the waves)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from salver.geometry import Array
from salver.models.contact_rows import ContactRows
from salver.models.parameters import NOTHING, UncertainSet
from salver.models.payload import Payload
from salver.sensitivity.waves import VERDICT_APART, Waves, along, cases

Indices = npt.NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Slosh:
    """What one case of a liquid does along a motion of T instants.

    wrench: (T, 6) of `Waves`. reaction: (T, 12) by which what the tray feels changes because the arm gives way to it.
    spread: (T, 6, n_c) change of the wrench per half-range of each term of what is uncertain. higher: (T,) m, by which
    the crest may be higher for all these, but for what a steeper free wave makes of it; freer: (T, 2) m, by which that
    may be higher; more_left: what is left at the end.
    """

    waves: Waves
    wrench: Array
    reaction: Array | None = None
    spread: Array | None = None
    higher: Array | float = 0.0
    freer: Array | float = 0.0
    more_left: float = 0.0

    @classmethod
    def of(cls, waves: Waves, reaction: Array | None = None, dw: Array | None = None) -> Slosh:
        """dw: (T, 12, n_c) change of what the tray feels."""
        if dw is None:
            return cls(waves, waves.wrench, reaction)
        change, modes = waves.changed(dw), waves.case.modes
        higher = (modes.highest(np.moveaxis(change.eta, 1, 2)) + np.abs(change.thrown)).sum(axis=1)
        more = float(modes.highest(change.left.T).sum())
        return cls(waves, waves.wrench, reaction, change.wrench, higher, np.abs(change.free).sum(axis=2), more)

    @property
    def crest(self) -> Array:
        """(T,) m, at the worst of what is uncertain."""
        return self.waves.raised(self.higher, self.freer)

    @property
    def free_height(self) -> Array:
        """(T,) m of the free wave, at the worst of what is uncertain."""
        return self.waves.free_height + self.waves.case.modes.highest(self.freer + np.zeros((1, 2)))

    def left(self, seconds: float = 0.0) -> float:
        """m, see `Waves.left`, at the worst of what is uncertain."""
        return self.waves.left(seconds, self.more_left)

    def at(self, index: Indices) -> Slosh:
        """The wrench at some instants."""
        return replace(self, wrench=self.wrench[index])


@dataclass(frozen=True, eq=False)
class Sloshed:
    """What liquids add to contact rows (T, n): each at its worst case. worst: by liquid, (T, n) which case that is."""

    rows: ContactRows
    liquids: list[tuple[int | None, tuple[Slosh, ...]]]
    values: Array
    worst: list[Array]

    @classmethod
    def of(cls, rows: ContactRows, sloshing: Mapping[str, tuple[Slosh, ...]]) -> Sloshed:
        """sloshing: the cases of each liquid, by the name of its body."""
        index = {body.name: j for j, body in enumerate(rows.network.bodies)}
        total, chosen, liquids = np.zeros((1, 1)), [], []
        for name, sloshes in sloshing.items():
            j = index.get(name)
            each = np.array([_added(case, rows, j) for case in sloshes])
            worst = np.argmax(each, axis=0)
            total = total + np.take_along_axis(each, worst[None], axis=0)[0]
            chosen.append(worst)
            liquids.append((j, sloshes))
        return cls(rows, liquids, total, chosen)

    def history(self, node: Indices, row: Indices) -> tuple[Array, Array]:
        """Derivatives of rows at nodes (m,) by w at all nodes (m, T, 12), and by log T at fixed w (m,).

        How the arm gives way is taken as given.
        """
        waves = self.liquids[0][1][0].waves
        by_w, by_duration = np.zeros((len(node), *waves.w.shape)), np.zeros(len(node))
        for (j, sloshes), worst in zip(self.liquids, self.worst, strict=True):
            for k, case in enumerate(sloshes):
                mine = np.flatnonzero(worst[node, row] == k)
                if j is not None and len(mine):
                    found = case.waves.wrench_by(node[mine], self.rows.wrench[j][row[mine]])
                    by_w[mine] += found[0]
                    by_duration[mine] += found[1]
        return by_w, by_duration


def _added(case: Slosh, rows: ContactRows, j: int | None) -> Array:
    """(T, n); j: which body of the network the liquid is in, None for one that stands elsewhere."""
    added = np.zeros((len(case.wrench), len(rows.nominal)))
    if case.reaction is not None:  # of whatever stands on the tray: the arm gives way under all
        added += case.reaction @ rows.nominal.T
    if j is not None:
        added += case.wrench @ rows.wrench[j].T
        if case.spread is not None:
            added += np.abs(np.einsum("ni,tic->tnc", rows.wrench[j], case.spread, optimize=True)).sum(axis=2)
    return added


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
            body.name: tuple(Slosh.of(x) for x in along(cases(body, uncertain, VERDICT_APART), self.t, self.w))
            for body in self.payload.liquids
        }

    def _thinned(self, found: Mapping[str, tuple[Slosh, ...]]) -> dict[str, tuple[Slosh, ...]]:
        assert self.kept is not None
        return {name: tuple(case.at(self.kept) for case in each) for name, each in found.items()}

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
    after: the same for good after the motion. steep: (T,) free wave over the largest for which the model is valid.
    settled: m that waves are lower than wanted, some time after the motion; infinite if nothing is wanted.
    slack: (T,) the least of these as shares of what is allowed.
    """

    name: str
    t: Array
    crest: Array
    left: Array
    after: float
    steep: Array
    settled: float
    slack: Array

    @classmethod
    def of(cls, name: str, each: Sequence[Slosh]) -> Spill:
        waves = [case.waves for case in each]
        liquid = waves[0].case.liquid
        crest, room = np.array([x.crest for x in each]), np.array([x.case.room for x in waves])
        left, after = room[:, None] - crest, room - np.array([x.left() for x in each])
        steep = np.max([x.free_height / x.waves.case.steepest for x in each], axis=0)
        settled = min(liquid.settled - x.left(liquid.within) for x in each)
        slack = 1 - steep
        if np.isfinite(room).all():
            slack = np.minimum(slack, (left / room[:, None]).min(axis=0))
            slack[-1] = min(slack[-1], float((after / room).min()))
        if np.isfinite(settled):
            slack[-1] = min(slack[-1], settled / liquid.settled)
        return cls(
            name, waves[0].t, crest.max(axis=0), left.min(axis=0), float(after.min()), steep, float(settled), slack
        )
