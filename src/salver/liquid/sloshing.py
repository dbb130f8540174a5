"""Height, steepness and effective gravity of liquids' surfaces in the worst case, with derivatives by the unknowns
of a motion (`salver.liquid.waves` has the waves)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from salver.geometry import Array, Indices
from salver.liquid.underway import Underway
from salver.liquid.wave_changes import Change, changed
from salver.liquid.wave_gradients import Unknowns, at_node, surface_by
from salver.liquid.waves import Waves
from salver.models.liquid import GRAVITY, LEANING, LEAST_WEIGHT, LEFT_OVER, STEEPEST, TILTING
from salver.sensitivity.arm.tracking import Reaction

LIGHTEST = 1 - LEAST_WEIGHT  # share of its weight that a liquid may be relieved of
LESS = STEEPEST / LEANING
LEAST_SIZE = 1e-4  # m; waves smaller than this turn as fast as they like


@dataclass(frozen=True, eq=False)
class Slosh:
    """Sloshing of K cases of a liquid along a motion of T instants.

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
        """dw: (K or 1, T, 12, n_c) change of the tray's motion regressor; start: what it made of the waves till
        then."""
        change, highest = changed(waves, dw, start), waves.cases.highest
        higher = (highest(np.moveaxis(change.eta, 2, 3)) + np.abs(change.thrown)).sum(axis=2)
        left = np.einsum("kna,knac->kca", waves.cases.gain, np.hypot(*change.ending))
        freer = np.abs(change.free).sum(axis=3)
        return cls(waves, waves.wrench, planned, reaction, change, higher, freer, highest(left).sum(axis=1))

    def along(self, planned: Waves) -> Slosh:
        """Sloshing of other planned waves, with the arm's compliance as here."""
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
        return self.waves.left(None, self.more_left)

    def left(self, seconds: float | None = None) -> Array:
        """(K,) m, see `Waves.left`, at the worst of what is uncertain."""
        return self.left_at_once if seconds is None else self.waves.left(seconds, self.more_left)

    def at(self, index: Indices) -> Slosh:
        """The wrench at some instants."""
        return replace(self, wrench=self.wrench[:, index])

    def part(self, some: slice, planned: Waves | None = None) -> Slosh:
        """Some of the cases; planned: theirs, where they are known."""
        waves = self.waves.part(some)
        if planned is None:
            planned = waves if self.planned is self.waves else self.planned.part(some)
        reaction = None if self.reaction is None else self.reaction.part(some)
        change = None if self.change is None else self.change.part(some)
        return Slosh(waves, self.wrench[some], planned, reaction, change, *self._more(some))

    def only(self, k: int) -> Slosh:
        """The surface in one case."""
        some = slice(k, k + 1)
        waves, (higher, freer, more) = self.waves.part(some), self._more(some)
        return Slosh(waves, self.wrench[some], waves, higher=higher, freer=freer, more_left=more)

    def _more(self, some: slice) -> list[Array | float]:
        return [x if np.ndim(x) == 0 else np.asarray(x)[some] for x in (self.higher, self.freer, self.more_left)]

    # Derivatives (m, c) of rows (m,), each of one case at one node, by unknowns of the motion (c,). How the arm gives
    # way is taken as given, for what it makes of the waves changes little.

    def crest_by(self, case: Indices, node: Indices, unknowns: Unknowns) -> Array:
        """Derivatives of the crest."""
        which, free = self.waves.cases, self.waves.free[case, node]
        freer = np.zeros_like(free) if self.change is None else np.asarray(self.freer)[case, node]
        by_free = 2 * which.peaking[case] / which.half[case] * (free + freer * np.sign(free))
        by_eta = which.steepest_by(self.waves.eta[case, node])
        return surface_by(
            self.planned, unknowns, case, node, by_eta, by_free, TILTING / GRAVITY * which.wide[case] ** 2
        )

    def free_by(self, case: Indices, node: Indices, unknowns: Unknowns) -> Array:
        """Derivatives of the height of the free wave, or of the whole surface."""
        waves, leans = self.waves, self._leans(case, node)
        by_free = (1 - leans) * waves.cases.steepest_by(waves.free[case, node])
        by_eta = LESS * leans * waves.cases.steepest_by(waves.eta[case, node])
        return surface_by(self.planned, unknowns, case, node, by_eta, by_free, 0.0)

    def lightness_by(self, case: Indices, node: Indices, unknowns: Unknowns) -> Array:
        """Derivatives of the share of the weight that does not press."""
        by_w = -self.waves.cases.at_O[case, 2] / GRAVITY
        return np.asarray((by_w[:, None] @ unknowns.felt[node])[:, 0])

    # Factors (m, k, c) of second derivatives of rows: what of them is convex in the waves, which are all but linear in
    # the unknowns. Their squares summed over k are the second derivative.

    def lightness_bends(self, case: Indices, node: Indices, unknowns: Unknowns) -> Array:
        """Second derivatives of the share of the weight that does not press."""
        return np.zeros((len(case), 0, unknowns.felt.shape[2]))

    def free_bends(self, case: Indices, node: Indices, unknowns: Unknowns) -> Array:
        """Second derivatives of the height of the free wave, or of the whole surface, whose direction turns."""
        leans = self._leans(case, node)[:, :, None]
        free, whole = (
            self._turns(case, node, unknowns, eta[case, node], free=eta is self.waves.free)
            for eta in (self.waves.free, self.waves.eta)
        )
        return np.asarray(np.sqrt(LESS) * leans * whole + (1 - leans) * free)

    def crest_bends(self, case: Indices, node: Indices, unknowns: Unknowns) -> Array:
        """Second derivatives of the crest: of its height, and of its part beyond linear waves."""
        which = self.waves.cases
        turns = self._turns(case, node, unknowns, self.waves.eta[case, node], free=False)
        peaking = np.sqrt(2 * which.peaking[case] / which.half[case])
        return np.concatenate([turns, self._axes(case, node, unknowns, peaking, free=True)], axis=1)

    def _leans(self, case: Indices, node: Indices) -> Array:
        """(m, 1) 1 where `free_height` is that of the whole surface, 0 where it is not."""
        whole = LESS * (self.waves.height + self.higher)
        return np.asarray((self.free_height <= whole)[case, node, None], dtype=float)

    def _turns(self, case: Indices, node: Indices, unknowns: Unknowns, eta: Array, free: bool) -> Array:
        """The part of the second derivatives by which waves eta (m, 2) turn in a round container."""
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

    def left_bends(self, case: Indices, unknowns: Unknowns, seconds: float | None = None) -> Array:
        """Second derivatives of the residual sloshing."""
        waves, which, m = self.waves, self.waves.cases, len(case)
        more = np.broadcast_to(self.more_left, len(which.each))[case]
        fading, half = waves.fading(seconds or 0.0)[case], which.half[case]
        amplitude = waves.amplitude(seconds or 0.0, self.more_left)[case]
        stands = amplitude + waves.standing[case] * (seconds is None)
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
        """Second derivatives of the residual free wave."""
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

    def left_by(self, case: Indices, unknowns: Unknowns, seconds: float | None = None) -> Array:
        """Derivatives of the residual sloshing; the tray's posture at the end is taken as given."""
        waves, which, m = self.waves, self.waves.cases, len(case)
        more = np.broadcast_to(self.more_left, len(which.each))[case]
        fading, half = waves.fading(seconds or 0.0)[case], which.half[case]
        amplitude = waves.amplitude(seconds or 0.0, self.more_left)[case]
        by_amplitude = which.steepest_by(amplitude + waves.standing[case] * (seconds is None))
        by_amplitude = by_amplitude + 2 * which.peaking[case] / half * amplitude
        ending = self._amplitude_by(case, unknowns, fading, by_amplitude)
        k, peak = waves.peak[0][case], waves.peak[1][case]
        steep = 3 * LEFT_OVER * (peak + more) ** 2 / half.min(axis=1) ** 2 * waves.peaks_now[case]
        highest = which.steepest_by(waves.eta[case, k]) * steep[:, None]
        return ending + surface_by(self.planned, unknowns, case, k, highest, np.zeros((m, 2)), 0.0)

    def free_left_by(self, case: Indices, unknowns: Unknowns) -> Array:
        """Derivatives of the residual free wave; the tray's posture at the end is taken as given."""
        by_amplitude = self.waves.cases.steepest_by(self.waves.amplitude(more=self.more_left)[case])
        return self._amplitude_by(case, unknowns, 1.0, by_amplitude)

    def _amplitude_by(self, case: Indices, unknowns: Unknowns, fading: Array | float, by_amplitude: Array) -> Array:
        """Derivatives of amplitudes at the end that count by_amplitude (m, 2)."""
        waves, which = self.waves, self.waves.cases
        last = np.full(len(case), len(waves.t) - 1)
        to_speed = np.sqrt(GRAVITY / waves.upward[case, -1])[:, None, None] / which.omega[case]
        away, speed = (x[case] for x in waves.ending)
        by_size = fading * which.gain[case] * by_amplitude[:, None] / np.maximum(np.hypot(away, speed), 1e-12)
        return at_node(unknowns, self.planned, case, last, by_size * away, by_size * speed * to_speed)
