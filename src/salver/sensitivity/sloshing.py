"""What the waves of liquids ask of their containers, at the worst of all that is uncertain: to stay below the brim, and
to be held against the wrench of the slosh (`salver.sensitivity.waves` has the waves)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from salver.geometry import Array
from salver.models.contact_rows import ContactRows
from salver.models.liquid import GRAVITY, LEFT_OVER, TILTING
from salver.models.parameters import NOTHING, UncertainSet
from salver.models.payload import Payload
from salver.models.tray_motion import N_MOTION
from salver.sensitivity.arm.tracking import Deviation
from salver.sensitivity.wave_gradients import Pulled, at_node, surface_by, wrench_by, wrenches_by
from salver.sensitivity.waves import VERDICT_APART, Change, Indices, Waves, along, cases


@dataclass(frozen=True, eq=False)
class Slosh:
    """What K cases of a liquid do along a motion of T instants.

    wrench: (K, T, 6) of `Waves`. giving: how the arm gives way, None for one that follows exactly; the rest is what
    comes of that. reaction: (K, T, 12) by which what the tray feels changes. change: of the waves, per half-range of
    each of n_c terms of what is uncertain. higher: (K, T) m, by which the crest may be higher for all these, but for
    what a steeper free wave makes of it; freer: (K, T, 2) m, by which that may be higher; more_left: (K,) m, what is
    left at the end.
    """

    waves: Waves
    wrench: Array
    giving: Deviation | None = None
    reaction: Array | None = None
    change: Change | None = None
    higher: Array | float = 0.0
    freer: Array | float = 0.0
    more_left: Array | float = 0.0

    @classmethod
    def of(cls, waves: Waves) -> Slosh:
        """On a tray that follows its motion exactly."""
        return cls(waves, waves.wrench)

    @classmethod
    def given_way(cls, waves: Waves, giving: Deviation, reaction: Array, dw: Array) -> Slosh:
        """dw: (T, 12, n_c) change of what the tray feels."""
        change, highest = waves.changed(dw), waves.cases.highest
        higher = (highest(np.moveaxis(change.eta, 2, 3)) + np.abs(change.thrown)).sum(axis=2)
        more = highest(np.moveaxis(change.left, 1, 2)).sum(axis=1)
        freer = np.abs(change.free).sum(axis=3)
        return cls(waves, waves.wrench, giving, reaction, change, higher, freer, more)

    @property
    def crest(self) -> Array:
        """(K, T) m, at the worst of what is uncertain."""
        return self.waves.raised(self.higher, self.freer)

    @property
    def free_height(self) -> Array:
        """(K, T) m of the free wave, at the worst of what is uncertain."""
        return self.waves.free_height + self.waves.cases.highest(self.freer + np.zeros((1, 1, 2)))

    def left(self, seconds: float = 0.0) -> Array:
        """(K,) m, see `Waves.left`, at the worst of what is uncertain."""
        return self.waves.left(seconds, self.more_left)

    def at(self, index: Indices) -> Slosh:
        """The wrench at some instants."""
        return replace(self, wrench=self.wrench[:, index])

    def only(self, k: int) -> Slosh:
        """What becomes of the surface in one case."""
        some = [k]
        higher, freer, more = (
            x if np.ndim(x) == 0 else np.asarray(x)[some] for x in (self.higher, self.freer, self.more_left)
        )
        return Slosh(self.waves.only(k), self.wrench[some], higher=higher, freer=freer, more_left=more)

    # Derivatives of rows (m,), as in `wave_gradients` ---------------------------------------------------------------

    def crest_by(self, case: Indices, node: Indices) -> Pulled:
        """Of the crest."""
        waves, which = self.waves, self.waves.cases
        curve, free = which.peaking[case] / which.half[case], waves.free[case, node]
        freer = np.zeros_like(free) if self.change is None else np.asarray(self.freer)[case, node]
        by_free = 2 * curve * (free + freer * np.sign(free))
        found = surface_by(
            waves, case, node, which.steepest_by(waves.eta[case, node]), by_free, TILTING / GRAVITY * which.wide**2
        )
        if self.change is None:
            return found
        each = np.moveaxis(self.change.eta[case, node], 1, 2)  # (m, n_c, 2)
        sign = np.sign(np.moveaxis(self.change.free[case, node], 1, 2))
        share = which.steepest_by(each) + (2 * curve * (np.abs(free) + freer))[:, None] * sign
        return self._given_way(case, found, _along(share, which.steepest_by(waves.eta[case, node]) + by_free))

    def free_by(self, case: Indices, node: Indices) -> Pulled:
        """Of the height of the free wave."""
        which, free = self.waves.cases, self.waves.free[case, node]
        found = surface_by(self.waves, case, node, np.zeros((len(node), 2)), which.steepest_by(free), 0.0)
        if self.change is None:
            return found
        freer = which.steepest_by(np.asarray(self.freer)[case, node])
        share = freer[:, None] * np.sign(np.moveaxis(self.change.free[case, node], 1, 2))
        return self._given_way(case, found, _along(share, which.steepest_by(free)))

    def left_by(self, case: Indices, seconds: float = 0.0) -> Pulled:
        """Of what is left; the tray's posture at the end is taken as given."""
        waves, which, m = self.waves, self.waves.cases, len(case)
        last, more = np.full(m, len(waves.t) - 1), np.broadcast_to(self.more_left, len(which.each))[case]
        fading, half = waves.fading(seconds)[case], which.half[case]
        amplitude = (waves.tail[case] * fading).sum(axis=1) + more[:, None]
        by_amplitude = which.steepest_by(amplitude + half * np.abs(waves.slope[case, -1]))
        by_amplitude = by_amplitude + 2 * which.peaking[case] / half * amplitude
        to_speed = np.sqrt(GRAVITY / waves.upward[case, -1])[:, None, None] / which.omega[case]
        away, speed = (x[case] for x in waves.ending)
        by_size = fading * which.gain[case] * by_amplitude[:, None] / np.maximum(np.hypot(away, speed), 1e-12)
        nothing = np.zeros((m, N_MOTION))
        ending = at_node(waves, case, last, by_size * away, by_size * speed * to_speed, nothing, nothing[:, 0])
        k, peak = waves.peak[0][case], waves.peak[1][case]
        steep = 3 * LEFT_OVER * (peak + more) ** 2 / half.min(axis=1) ** 2
        steepest = which.steepest_by(waves.eta[case, k])
        before = surface_by(waves, case, k, steepest, np.zeros((m, 2)), 0.0)
        found = (ending[0] + steep[:, None, None] * before[0], ending[1] + steep * before[1])
        if self.change is None:
            return found
        change = np.stack(self.change.ending, axis=1)[case]  # (m, 2, n_modes, 2, n_c): r and r' / omega
        each = np.moveaxis(which.steepest_by(np.moveaxis(self.change.left[case], 1, 2)), 1, 2)  # (m, 2, n_c)
        share = which.gain[case][:, None, :, :, None] * each[:, None, None] * change
        share /= np.maximum(np.linalg.norm(change, axis=1, keepdims=True), 1e-12)
        share *= (by_amplitude.sum(axis=1) + steep)[:, None, None, None, None]
        own = np.stack([by_size * away, by_size * speed * to_speed * which.omega[case]], axis=1)
        counted = np.swapaxes(share.reshape(m, -1, share.shape[-1]), 1, 2)
        return self._given_way(case, found, _along(counted, own.reshape(m, -1)))

    def _given_way(self, case: Indices, found: Pulled, share: Array) -> Pulled:
        """With how the arm gives way: to the waves, once round, and to what is uncertain of its load, of which the
        rows feel `share` (m, n_c) times as much as they feel of what is planned."""
        assert self.giving is not None
        by_wrench = self.giving.reaction_by(found[0])
        by_w = found[0] + wrenches_by(self.waves, case, by_wrench) + self.giving.wrong_load_by(by_wrench, share)
        return by_w, found[1]


def _along(changes: Array, own: Array) -> Array:
    """(m, n_c) share that changes (m, n_c, d) have along derivatives (m, d) by the same quantities: what lies across
    those is left out of derivatives, for waves run mostly one way."""
    return np.asarray((changes @ own[:, :, None])[..., 0] / np.maximum((own**2).sum(axis=1), 1e-12)[:, None])


@dataclass(frozen=True, eq=False)
class Sloshed:
    """What liquids add to contact rows (T, n): each at its worst case. worst: by liquid, (T, n) which case that is, of
    all parts of it, one after the other."""

    rows: ContactRows
    liquids: list[tuple[int | None, tuple[Slosh, ...]]]
    values: Array
    worst: list[Indices]

    @classmethod
    def of(cls, rows: ContactRows, sloshing: Mapping[str, tuple[Slosh, ...]]) -> Sloshed:
        """sloshing: the cases of each liquid, in parts, by the name of its body."""
        index = {body.name: j for j, body in enumerate(rows.network.bodies)}
        total, chosen, liquids = np.zeros((1, 1)), list[Indices](), []
        for name, sloshes in sloshing.items():
            j = index.get(name)
            each = (added for part in sloshes for added in _added(part, rows, j))
            most = next(each)
            worst = np.zeros(most.shape, dtype=np.intp)
            for k, added in enumerate(each, start=1):
                more = added > most
                most[more], worst[more] = added[more], k
            total = total + most
            chosen.append(worst)
            liquids.append((j, sloshes))
        return cls(rows, liquids, total, chosen)

    def history(self, node: Indices, row: Indices) -> tuple[Array, Array]:
        """Derivatives of rows at nodes (m,) by w at all nodes (m, T, 12), and by log T at fixed w (m,).

        How the arm gives way is taken as given.
        """
        waves = self.liquids[0][1][0].waves
        by_w, by_duration = np.zeros((len(node), *waves.w.shape[1:])), np.zeros(len(node))
        for (j, sloshes), worst in zip(self.liquids, self.worst, strict=True):
            if j is None:
                continue
            for part, case, mine in of_parts(sloshes, worst[node, row]):
                found = wrench_by(part.waves, case, node[mine], self.rows.wrench[j][row[mine]])
                by_w[mine] += found[0]
                by_duration[mine] += found[1]
        return by_w, by_duration


def of_parts(sloshes: Sequence[Slosh], which: Indices) -> Iterator[tuple[Slosh, Indices, Indices]]:
    """Cases counted through all parts (m,), part by part: the part, which of its cases, and where in `which`."""
    before = 0
    for part in sloshes:
        count = len(part.wrench)
        mine = np.flatnonzero((which >= before) & (which < before + count))
        if len(mine):
            yield part, which[mine] - before, mine
        before += count


def _added(part: Slosh, rows: ContactRows, j: int | None) -> Iterator[Array]:
    """(T, n) of each case; j: which body of the network the liquid is in, None for one that stands elsewhere."""
    for k, wrench in enumerate(part.wrench):
        added = np.zeros((len(wrench), len(rows.nominal)))
        if part.reaction is not None:  # of whatever stands on the tray: the arm gives way under all
            added += part.reaction[k] @ rows.nominal.T
        if j is not None:
            added += wrench @ rows.wrench[j].T
            if part.change is not None:
                spread = np.ascontiguousarray(np.moveaxis(part.change.wrench[k], 2, 1))  # (T, n_c, 6)
                added += np.abs(spread @ rows.wrench[j].T).sum(axis=1)
        yield added


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
    def of(cls, name: str, parts: Sequence[Slosh]) -> Spill:
        waves = parts[0].waves
        which = [part.waves.cases for part in parts]
        liquid, room = which[0].liquid, np.concatenate([x.room for x in which])
        crest, rest = (np.concatenate(x) for x in ([p.crest for p in parts], [p.left() for p in parts]))
        left, after = room[:, None] - crest, room - rest
        steep = np.concatenate([p.free_height / p.waves.cases.steepest[:, None] for p in parts]).max(axis=0)
        settled = liquid.settled - max(float(p.left(liquid.within).max()) for p in parts)
        slack = 1 - steep
        if np.isfinite(room).all():
            slack = np.minimum(slack, (left / room[:, None]).min(axis=0))
            slack[-1] = min(slack[-1], float((after / room).min()))
        if np.isfinite(settled):
            slack[-1] = min(slack[-1], settled / liquid.settled)
        return cls(name, waves.t, crest.max(axis=0), left.min(axis=0), float(after.min()), steep, float(settled), slack)
