"""What the waves of liquids ask of their containers, at the worst of all that is uncertain: to stay below the brim, and
to be held against the wrench of the slosh (`salver.sensitivity.waves` has the waves)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce

import numpy as np

from salver.geometry import Array
from salver.models.contact_rows import ContactRows
from salver.models.liquid import GRAVITY, LEANING, LEAST_WEIGHT, LEFT_OVER, STEEPEST, TILTING
from salver.models.parameters import NOTHING, UncertainSet
from salver.models.payload import Payload
from salver.models.worst_case import ALL, Some
from salver.sensitivity.arm.tracking import Reaction
from salver.sensitivity.wave_cases import VERDICT_APART, cases
from salver.sensitivity.wave_gradients import Unknowns, at_node, surface_by, wrench_by
from salver.sensitivity.waves import Change, Indices, Underway, Waves, along

LIGHTEST = 1 - LEAST_WEIGHT  # share of its weight that a liquid may be relieved of
_OF_SURFACE = "crest", "free_height", "lightness", "free_left", "left_at_once"
LESS = STEEPEST / LEANING
LEAST_SIZE = 1e-4  # m; waves smaller than this turn as fast as they like


@dataclass(frozen=True, eq=False)
class Slosh:
    """What K cases of a liquid do along a motion of T instants.

    wrench: (K, T, 6) of `Waves`. planned: the waves on a tray that follows its motion exactly; the rest is what comes
    of an arm that gives way. reaction: how it does that. change: of the waves, per
    half-range of each of n_c terms of what is uncertain. higher: (K, T) m, by which the crest may be higher for all
    these, but for what a steeper free wave makes of it; freer: (K, T, 2) m, by which that may be higher; more_left:
    (K,) m, what is left at the end.
    """

    waves: Waves
    wrench: Array
    planned: Waves
    reaction: Reaction | None = None
    change: Change | None = None
    higher: Array | float = 0.0
    freer: Array | float = 0.0
    more_left: Array | float = 0.0

    @classmethod
    def of(cls, waves: Waves) -> Slosh:
        """On a tray that follows its motion exactly."""
        return cls(waves, waves.wrench, waves)

    @classmethod
    def given_way(
        cls, waves: Waves, planned: Waves, reaction: Reaction, dw: Array, start: Underway | None = None
    ) -> Slosh:
        """dw: (K or 1, T, 12, n_c) change of what the tray feels; start: what it made of the waves till then."""
        change, highest = waves.changed(dw, start), waves.cases.highest
        higher = (highest(np.moveaxis(change.eta, 2, 3)) + np.abs(change.thrown)).sum(axis=2)
        left = np.einsum("kna,knac->kca", waves.cases.gain, np.hypot(*change.ending))
        freer = np.abs(change.free).sum(axis=3)
        return cls(waves, waves.wrench, planned, reaction, change, higher, freer, highest(left).sum(axis=1))

    def along(self, planned: Waves) -> Slosh:
        """Of other waves that are planned, with an arm that gives way as here."""
        waves = planned.shifted(self.waves.w - self.planned.w, self.waves.start)
        return replace(self, waves=waves, wrench=waves.wrench, planned=planned)

    @cached_property
    def crest(self) -> Array:
        """(K, T) m, at the worst of what is uncertain."""
        return self.waves.raised(self.higher, self.freer)

    @cached_property
    def free_height(self) -> Array:
        """(K, T) m of the free wave, at the worst of what is uncertain; or of the whole surface, times what it may lean
        less for its height, where that is nearer to what is known."""
        free = self.waves.free_height + self.waves.cases.highest(self.freer + np.zeros((1, 1, 2)))
        return np.maximum(free, LESS * (self.waves.height + self.higher))

    @cached_property
    def lightness(self) -> Array:
        """(K, T) share of its weight that does not press on the surface."""
        return np.asarray(1 - self.waves.force[..., 2] / GRAVITY)

    @cached_property
    def free_left(self) -> Array:
        """(K,) m, no free wave is higher after the motion, at the worst of what is uncertain."""
        return self.waves.cases.highest(self.waves.amplitude(more=self.more_left))

    @cached_property
    def left_at_once(self) -> Array:
        """(K,) m, see `left`."""
        return self.waves.left(0.0, self.more_left)

    def left(self, seconds: float = 0.0) -> Array:
        """(K,) m, see `Waves.left`, at the worst of what is uncertain."""
        return self.waves.left(seconds, self.more_left) if seconds else self.left_at_once

    def prepared(self) -> Slosh:
        """With all of it known that becomes of the surface, side by side for all cases: parts need not work it out."""
        for name in _OF_SURFACE:
            getattr(self, name)
        return self

    def at(self, index: Indices) -> Slosh:
        """The wrench at some instants."""
        return replace(self, wrench=self.wrench[:, index])

    def continued(self, each: Callable[[list[Array]], list[Array]]) -> Slosh:
        """The same at more instants, for rows that are looked at but not linearised; each: from (T, ...) to these."""
        found = {"wrench": self.wrench} | {name: getattr(self, name) for name in ("crest", "free_height", "lightness")}
        found |= {} if self.change is None else {"change": self.change.wrench}
        by_time = each([x.swapaxes(0, 1) for x in found.values()])
        found = {name: x.swapaxes(0, 1) for name, x in zip(found, by_time, strict=True)}
        change = None if self.change is None else replace(self.change, wrench=found.pop("change"))
        reaction = None if self.reaction is None else self.reaction.continued(each)
        made = replace(self, wrench=found.pop("wrench"), change=change, reaction=reaction)
        vars(made).update(found, free_left=self.free_left, left_at_once=self.left_at_once)
        return made

    def part(self, some: slice, planned: Waves | None = None) -> Slosh:
        """Some of the cases; planned: theirs, where they are known."""
        waves = self.waves.part(some)
        if planned is None:
            planned = waves if self.planned is self.waves else self.planned.part(some)
        reaction = None if self.reaction is None else self.reaction.part(some)
        change = None if self.change is None else self.change.part(some)
        return self._known_to(Slosh(waves, self.wrench[some], planned, reaction, change, *self._more(some)), some)

    def only(self, k: int) -> Slosh:
        """What becomes of the surface in one case."""
        some = slice(k, k + 1)
        waves, (higher, freer, more) = self.waves.part(some), self._more(some)
        found = Slosh(waves, self.wrench[some], waves, higher=higher, freer=freer, more_left=more)
        return self._known_to(found, some)

    def _known_to(self, part: Slosh, some: slice) -> Slosh:
        """A part, with what is known of it already."""
        vars(part).update({name: vars(self)[name][some] for name in _OF_SURFACE if name in vars(self)})
        return part

    def _more(self, some: slice) -> list[Array | float]:
        return [x if np.ndim(x) == 0 else np.asarray(x)[some] for x in (self.higher, self.freer, self.more_left)]

    # Derivatives (m, c) of rows (m,), each of one case at one node, by unknowns of the motion (c,). How the arm gives
    # way is taken as given, for what it makes of the waves changes little.

    def crest_by(self, case: Indices, node: Indices, unknowns: Unknowns) -> Array:
        """Of the crest."""
        which, free = self.waves.cases, self.waves.free[case, node]
        freer = np.zeros_like(free) if self.change is None else np.asarray(self.freer)[case, node]
        by_free = 2 * which.peaking[case] / which.half[case] * (free + freer * np.sign(free))
        by_eta = which.steepest_by(self.waves.eta[case, node])
        return surface_by(
            self.planned, unknowns, case, node, by_eta, by_free, TILTING / GRAVITY * which.wide[case] ** 2
        )

    def free_by(self, case: Indices, node: Indices, unknowns: Unknowns) -> Array:
        """Of the height of the free wave, or of the whole surface."""
        waves, leans = self.waves, self._leans(case, node)
        by_free = (1 - leans) * waves.cases.steepest_by(waves.free[case, node])
        by_eta = LESS * leans * waves.cases.steepest_by(waves.eta[case, node])
        return surface_by(self.planned, unknowns, case, node, by_eta, by_free, 0.0)

    def lightness_by(self, case: Indices, node: Indices, unknowns: Unknowns) -> Array:
        """Of the share of the weight that does not press."""
        by_w = -self.waves.cases.at_O[case, 2] / GRAVITY
        return np.asarray((by_w[:, None] @ unknowns.felt[node])[:, 0])

    # Factors (m, k, c) of second derivatives of rows: what of them is convex in the waves, which are all but linear in
    # the unknowns. Their squares summed over k are the second derivative.

    def lightness_bends(self, case: Indices, node: Indices, unknowns: Unknowns) -> Array:
        """Of the share of the weight that does not press."""
        return np.zeros((len(case), 0, unknowns.felt.shape[2]))

    def free_bends(self, case: Indices, node: Indices, unknowns: Unknowns) -> Array:
        """Of the height of the free wave, or of the whole surface, whose direction turns."""
        leans = self._leans(case, node)[:, :, None]
        free, whole = (
            self._turns(case, node, unknowns, eta[case, node], free=eta is self.waves.free)
            for eta in (self.waves.free, self.waves.eta)
        )
        return np.asarray(np.sqrt(LESS) * leans * whole + (1 - leans) * free)

    def crest_bends(self, case: Indices, node: Indices, unknowns: Unknowns) -> Array:
        """Of the crest: of its height, and of what it has beyond linear waves."""
        which = self.waves.cases
        turns = self._turns(case, node, unknowns, self.waves.eta[case, node], free=False)
        peaking = np.sqrt(2 * which.peaking[case] / which.half[case])
        return np.concatenate([turns, self._axes(case, node, unknowns, peaking, free=True)], axis=1)

    def _leans(self, case: Indices, node: Indices) -> Array:
        """(m, 1) 1 where `free_height` is that of the whole surface, 0 where it is not."""
        whole = LESS * (self.waves.height + self.higher)
        return np.asarray((self.free_height <= whole)[case, node, None], dtype=float)

    def _turns(self, case: Indices, node: Indices, unknowns: Unknowns, eta: Array, free: bool) -> Array:
        """Of the size of waves eta (m, 2), in a round container."""
        if not self.waves.cases.round:
            return np.zeros((len(case), 0, unknowns.felt.shape[2]))
        size = np.maximum(np.linalg.norm(eta, axis=1), LEAST_SIZE)[:, None]
        aside = np.stack([-eta[:, 1], eta[:, 0]], axis=1) / size**1.5
        nothing = np.zeros_like(aside)
        by = (nothing, aside) if free else (aside, nothing)
        return surface_by(self.planned, unknowns, case, node, *by, 0.0)[:, None]

    def _axes(self, case: Indices, node: Indices, unknowns: Unknowns, weight: Array, free: bool) -> Array:
        """Of waves along both axes, times weights (m, 2)."""
        both = []
        for axis in range(2):
            by = np.zeros_like(weight)
            by[:, axis] = weight[:, axis]
            pair = (np.zeros_like(by), by) if free else (by, np.zeros_like(by))
            both.append(surface_by(self.planned, unknowns, case, node, *pair, 0.0))
        return np.stack(both, axis=1)

    def left_bends(self, case: Indices, unknowns: Unknowns, seconds: float = 0.0) -> Array:
        """Of what is left."""
        waves, which, m = self.waves, self.waves.cases, len(case)
        more = np.broadcast_to(self.more_left, len(which.each))[case]
        fading, half = waves.fading(seconds)[case], which.half[case]
        amplitude = waves.amplitude(seconds, self.more_left)[case]
        stands = amplitude + half * np.abs(waves.slope[case, -1])
        by_amplitude = which.steepest_by(stands) + 2 * which.peaking[case] / half * amplitude
        found, larger = self._amplitude_bends(case, unknowns, fading, stands, by_amplitude)
        peaking = np.sqrt(2 * which.peaking[case] / half)
        found += [peaking[:, axis, None] * larger[axis] for axis in range(2)]
        k, peak = waves.peak[0][case], waves.peak[1][case]
        drifted = LEFT_OVER * (peak + more) / half.min(axis=1) ** 2
        drifted = drifted * waves.peaks_now[case]
        highest = which.steepest_by(waves.eta[case, k]) * np.sqrt(6 * drifted)[:, None]
        found.append(surface_by(self.planned, unknowns, case, k, highest, np.zeros((m, 2)), 0.0))
        turns = np.sqrt(3 * drifted * (peak + more))[:, None, None]
        return np.concatenate(
            [np.stack(found, axis=1), turns * self._turns(case, k, unknowns, waves.eta[case, k], free=False)], axis=1
        )

    def free_left_bends(self, case: Indices, unknowns: Unknowns) -> Array:
        """Of the free wave that is left."""
        amplitude = self.waves.amplitude(more=self.more_left)[case]
        by_amplitude = self.waves.cases.steepest_by(amplitude)
        return np.stack(self._amplitude_bends(case, unknowns, 1.0, amplitude, by_amplitude)[0], axis=1)

    def _amplitude_bends(
        self, case: Indices, unknowns: Unknowns, fading: Array | float, stands: Array, by_amplitude: Array
    ) -> tuple[list[Array], list[Array]]:
        """Of amplitudes that count by_amplitude (m, 2) and stand (m, 2) high: each mode's place and speed at the end
        may turn into one another, and both axes. Then how they grow (m, c), along both axes."""
        waves, which = self.waves, self.waves.cases
        last = np.full(len(case), len(waves.t) - 1)
        to_speed = np.sqrt(GRAVITY / waves.upward[case, -1])[:, None, None] / which.omega[case]
        away, speed = (x[case] for x in waves.ending)
        size = np.maximum(np.hypot(away, speed), LEAST_SIZE)
        gain = fading * which.gain[case]
        turning = np.sqrt(gain * np.maximum(by_amplitude, 0.0)[:, None] / size) / size
        found = []
        for mode in range(away.shape[1]):
            for axis in range(2):
                one = np.zeros_like(away)
                one[:, mode, axis] = turning[:, mode, axis]
                found.append(at_node(unknowns, self.planned, case, last, -one * speed, one * away * to_speed))
        larger = []
        for axis in range(2):
            one = np.zeros_like(away)
            one[:, :, axis] = gain[:, :, axis] / size[:, :, axis]
            larger.append(at_node(unknowns, self.planned, case, last, one * away, one * speed * to_speed))
        if which.round:
            height = np.maximum(np.linalg.norm(stands, axis=1), LEAST_SIZE)[:, None]
            aside = stands[:, ::-1] * [-1.0, 1.0] / height**1.5
            found.append(aside[:, :1] * larger[0] + aside[:, 1:] * larger[1])
        return found, larger

    def left_by(self, case: Indices, unknowns: Unknowns, seconds: float = 0.0) -> Array:
        """Of what is left; the tray's posture at the end is taken as given."""
        waves, which, m = self.waves, self.waves.cases, len(case)
        more = np.broadcast_to(self.more_left, len(which.each))[case]
        fading, half = waves.fading(seconds)[case], which.half[case]
        amplitude = waves.amplitude(seconds, self.more_left)[case]
        by_amplitude = which.steepest_by(amplitude + half * np.abs(waves.slope[case, -1]))
        by_amplitude = by_amplitude + 2 * which.peaking[case] / half * amplitude
        ending = self._amplitude_by(case, unknowns, fading, by_amplitude)
        k, peak = waves.peak[0][case], waves.peak[1][case]
        steep = 3 * LEFT_OVER * (peak + more) ** 2 / half.min(axis=1) ** 2 * waves.peaks_now[case]
        highest = which.steepest_by(waves.eta[case, k]) * steep[:, None]
        return ending + surface_by(self.planned, unknowns, case, k, highest, np.zeros((m, 2)), 0.0)

    def free_left_by(self, case: Indices, unknowns: Unknowns) -> Array:
        """Of the free wave that is left; the tray's posture at the end is taken as given."""
        by_amplitude = self.waves.cases.steepest_by(self.waves.amplitude(more=self.more_left)[case])
        return self._amplitude_by(case, unknowns, 1.0, by_amplitude)

    def _amplitude_by(self, case: Indices, unknowns: Unknowns, fading: Array | float, by_amplitude: Array) -> Array:
        """Of amplitudes at the end that count by_amplitude (m, 2)."""
        waves, which = self.waves, self.waves.cases
        last = np.full(len(case), len(waves.t) - 1)
        to_speed = np.sqrt(GRAVITY / waves.upward[case, -1])[:, None, None] / which.omega[case]
        away, speed = (x[case] for x in waves.ending)
        by_size = fading * which.gain[case] * by_amplitude[:, None] / np.maximum(np.hypot(away, speed), 1e-12)
        return at_node(unknowns, self.planned, case, last, by_size * away, by_size * speed * to_speed)


@dataclass(frozen=True, eq=False)
class Sloshed:
    """What liquids add to contact rows (T, n): each at its worst case. liquids: of each that is held by one of the
    rows' bodies which one, its parts, and what these add, (K, T, n) in their cases."""

    rows: ContactRows
    liquids: list[tuple[int, tuple[Slosh, ...], list[Array]]]
    values: Array

    @classmethod
    def of(cls, rows: ContactRows, sloshing: Mapping[str, tuple[Slosh, ...]]) -> Sloshed:
        """sloshing: the cases of each liquid, in parts, by the name of its body."""
        total, liquids = np.zeros((1, 1)), []
        for j, sloshes, added in _each_added(rows, sloshing):
            total = total + _most(added)
            if j is not None:
                liquids.append((j, sloshes, added))
        return cls(rows, liquids, total)

    def history(self, node: Indices, row: Indices, unknowns: Unknowns) -> Array:
        """(m, c) derivatives of what liquids add to rows at nodes (m,), by unknowns of the motion.

        How the arm gives way is taken as given.
        """
        found = np.zeros((len(node), unknowns.felt.shape[2]))
        for j, sloshes, added in self.liquids:
            worst = np.concatenate([part[:, node, row] for part in added]).argmax(axis=0)
            for part, case, mine in of_parts(sloshes, worst):
                found[mine] += wrench_by(part.planned, unknowns, case, node[mine], self.rows.wrench[j][row[mine]])
        return found


def given_way(sloshing: Mapping[str, tuple[Slosh, ...]], what: Callable[[Reaction], Array]) -> Array:
    """(T, m) most by which the slosh of all liquids changes something of the arm that carries them, `what` (T, m, K) of
    each reaction: each liquid at its worst case."""
    each = [[what(x.reaction) for x in parts if x.reaction is not None] for parts in sloshing.values()]
    most = [reduce(np.maximum, [np.abs(x).max(axis=-1) for x in parts]) for parts in each if parts]
    return sum(most, np.zeros((1, 1)))


def of_parts(sloshes: Sequence[Slosh], which: Indices) -> Iterator[tuple[Slosh, Indices, Indices]]:
    """Cases counted through all parts (m,), part by part: the part, which of its cases, and where in `which`."""
    before = 0
    for part in sloshes:
        count = len(part.wrench)
        mine = np.flatnonzero((which >= before) & (which < before + count))
        if len(mine):
            yield part, which[mine] - before, mine
        before += count


def most_added(
    rows: ContactRows, sloshing: Mapping[str, tuple[Slosh, ...]], at: Some, some: Some, coarsely: bool
) -> Array:
    """What liquids add to some rows at some instants, (T, n), each at its worst case. coarsely: no less than that."""
    return sum((_most(added) for _, _, added in _each_added(rows, sloshing, at, some, coarsely)), np.zeros((1, 1)))


def _most(added: list[Array]) -> Array:
    """(T, n) of all cases of all parts."""
    return np.asarray(reduce(np.maximum, [part.max(axis=0) for part in added]))


def _each_added(
    rows: ContactRows,
    sloshing: Mapping[str, tuple[Slosh, ...]],
    at: Some = ALL,
    some: Some = ALL,
    coarsely: bool = False,
) -> Iterator[tuple[int | None, tuple[Slosh, ...], list[Array]]]:
    """Of each liquid the body of the network that it is in, None for one that stands elsewhere, its parts, and what
    each adds to some rows at some instants, (K, T, n) in its cases, or 0 (1, 1, 1)."""
    index = {body.name: j for j, body in enumerate(rows.network.bodies)}
    for name, sloshes in sloshing.items():
        j = index.get(name)
        held = None if j is None else rows.wrench[j][some].T
        yield j, sloshes, [_added(part, rows.nominal[some].T, held, at, coarsely) for part in sloshes]


def _added(part: Slosh, nominal: Array, held: Array | None, at: Some, coarsely: bool) -> Array:
    """Of a part to rows nominal (12, n), and held (6, n) of the wrench that its container must give."""
    added = np.zeros((1, 1, 1))
    if part.reaction is not None:  # of whatever stands on the tray: the arm gives way under all
        added = part.reaction.w[:, at] @ nominal
    if held is not None:
        added = added + part.wrench[:, at] @ held
        if part.change is not None and coarsely:
            added += np.abs(part.change.wrench[:, at]).sum(axis=3) @ np.abs(held)
        elif part.change is not None:
            swings = np.swapaxes(part.change.wrench[:, at], 2, 3)
            swung = (swings.reshape(-1, 6) @ held).reshape(*swings.shape[:3], held.shape[1])  # (K, T, n_c, n)
            added += np.abs(swung, out=swung).sum(axis=2)
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
