"""Height, steepness and effective gravity of liquids' surfaces in the worst case, with derivatives by the unknowns
of a motion (`salver.dynamics.liquid.surface` has the surface)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, ClassVar, Self

import numpy as np

from salver.dynamics.liquid.drawn_surface import DrawnSurface
from salver.dynamics.liquid.interiors import TILTING
from salver.dynamics.liquid.liquid import LEANING, LEFT_OVER, STEEPEST, Container
from salver.dynamics.liquid.spills import HIGH, STEEP, Spill
from salver.dynamics.liquid.surface import SurfaceMotion, surface_by
from salver.dynamics.load_limits import LIGHT, LoadLimit, of_end
from salver.dynamics.load_response import LoadResponse, slacks
from salver.dynamics.modal_changes import Change
from salver.dynamics.modal_motion import ModalMotion
from salver.dynamics.motion_gradients import Unknowns
from salver.geometry import GRAVITY, Array, Indices
from salver.models.load_dynamics import Drawn

LESS = STEEPEST / LEANING


@dataclass(frozen=True, eq=False)
class SloshingResponse(LoadResponse):
    """Sloshing of K cases of a liquid along a motion of T instants.

    higher: (K, T) m, by which uncertainty may raise the crest, without the effect of a steeper free wave; freer:
    (K, T, 2) m, by which it may raise the free wave; more_left: (K,) m, by which it may raise residual waves.
    """

    motion_type: ClassVar[type[ModalMotion]] = SurfaceMotion
    more: ClassVar[tuple[str, ...]] = ("higher", "more_left", "freer")

    modes: SurfaceMotion
    planned: SurfaceMotion
    freer: Array | float = 0.0

    @classmethod
    def widened(cls, modes: ModalMotion, change: Change, dw: Array) -> dict[str, Array]:
        assert isinstance(modes, SurfaceMotion)
        (eta, free, thrown), highest = modes.changed(change, dw), modes.cases.highest
        left = np.einsum("kna,knac->kca", modes.cases.gain, np.hypot(*change.ending))
        return {
            "higher": (highest(np.moveaxis(eta, 2, 3)) + np.abs(thrown)).sum(axis=2),
            "freer": np.abs(free).sum(axis=3),
            "more_left": highest(left).sum(axis=1),
        }

    def unsure(self, away: Array, inclined: Array) -> Self:
        which = self.modes.cases
        height = (which.gain[:, None] * away).sum(axis=2)
        higher = height + which.rest_rise[:, None] * inclined
        freer = height + np.abs(which.half - which.rest_rise)[:, None] * inclined
        summed = higher[..., 0] if which.round else higher.sum(axis=2)
        more = (which.gain * away[:, -1]).sum(axis=1)
        left = more[:, 0] if which.round else more.sum(axis=1)
        return replace(self, higher=summed, freer=freer, more_left=left)

    def limits(self) -> list[LoadLimit]:
        """Limits during the motion and after it: free waves and apparent weight stay within the validity of the model,
        the crest below the brim of an open container, and residual waves below `settled` if that is given."""
        which = self.modes.cases
        liquid = which.liquid
        found = [
            LoadLimit("steepness", self.free_height, which.steepest, self.free_by, STEEP),
            self.weight_limit,
            LoadLimit("steepness left", self.free_left[:, None], which.steepest, of_end(self.free_left_by), STEEP),
        ]
        if np.isfinite(which.room).all():
            found.append(LoadLimit("waves", self.crest, which.room, self.crest_by, HIGH))
        for name, most, seconds in (
            ("waves left", which.room, None),
            ("settled waves", which.settled, liquid.within),
        ):
            if np.isfinite(most).all():
                by = of_end(partial(self.left_by, seconds=seconds))
                found.append(LoadLimit(name, self.left(seconds)[:, None], most, by, HIGH))
        return found

    @classmethod
    def verdict(cls, name: str, parts: Sequence[Self]) -> Spill:
        which = [part.modes.cases for part in parts]
        liquid, room = which[0].liquid, np.concatenate([x.room for x in which])
        crest, rest = (np.concatenate(x) for x in ([p.crest for p in parts], [p.left() for p in parts]))
        left, after = room[:, None] - crest, room - rest
        settled = min(float((p.modes.cases.settled - p.left(liquid.within)).min()) for p in parts)
        steep, light, below = (
            np.concatenate([slacks(part, group) for part in parts]).min(axis=0) for group in (STEEP, LIGHT, HIGH)
        )
        slack = np.minimum(np.minimum(steep, light), below)
        kept = {HIGH: float(below.min()), STEEP: 1 - float((1 - steep).max()), LIGHT: 1 - float((1 - light).max())}
        dry = left.min(axis=0), float(after.min())
        t = parts[0].modes.t
        return Spill(name, liquid, t, slack, kept, crest.max(axis=0), *dry, 1 - steep, 1 - light, settled)

    @cached_property
    def crest(self) -> Array:
        """Crest (K, T) in the worst case, m."""
        return self.modes.raised(self.higher, self.freer)

    @cached_property
    def free_height(self) -> Array:
        """Height (K, T) of the free wave in the worst case, m; or of the whole surface, scaled by the ratio of their
        limits, where that is closer to the limit of validity."""
        free = self.modes.free_height + self.modes.cases.highest(self.freer + np.zeros((1, 1, 2)))
        return np.maximum(free, LESS * (self.modes.height + self.higher))

    @cached_property
    def free_left(self) -> Array:
        """Bound (K,) on free waves after the motion in the worst case, m."""
        return self.modes.cases.highest(self.modes.amplitude(more=self.more_left))

    def left(self, seconds: float | None = None) -> Array:
        """`SurfaceMotion.left` (K,) in the worst case, m."""
        return self.modes.left(seconds, self.more_left)

    # Derivatives (m, c) of rows (m,), each for one case and node, by unknowns of the motion (c,). Changes of the arm's
    # response are neglected. Where loads are uncertain, some derivatives were off by more than half.

    def crest_by(self, case: Indices, node: Indices, unknowns: Unknowns) -> Array:
        """Derivatives of the crest."""
        which, free = self.modes.cases, self.modes.free[case, node]
        freer = np.zeros_like(free) if self.change is None else np.asarray(self.freer)[case, node]
        by_free = 2 * which.peaking[case] / which.half[case] * (free + freer * np.sign(free))
        by_eta = which.steepest_by(self.modes.eta[case, node])
        return surface_by(
            self.planned, unknowns, case, node, by_eta, by_free, TILTING / GRAVITY * which.wide[case] ** 2
        )

    def free_by(self, case: Indices, node: Indices, unknowns: Unknowns) -> Array:
        """Derivatives of the height of the free wave, or of the whole surface."""
        waves, leans = self.modes, self._leans(case, node)
        by_free = (1 - leans) * waves.cases.steepest_by(waves.free[case, node])
        by_eta = LESS * leans * waves.cases.steepest_by(waves.eta[case, node])
        return surface_by(self.planned, unknowns, case, node, by_eta, by_free)

    def _leans(self, case: Indices, node: Indices) -> Array:
        """(m, 1) 1 where the limit on the whole surface (not that on free waves) gives `free_height`, else 0."""
        whole = LESS * (self.modes.height + self.higher)
        return np.asarray((self.free_height <= whole)[case, node, None], dtype=float)

    def left_by(self, case: Indices, unknowns: Unknowns, seconds: float | None = None) -> Array:
        """Derivatives of the residual sloshing, for a fixed final posture of the tray."""
        waves, which = self.modes, self.modes.cases
        more = np.broadcast_to(self.more_left, len(which.each))[case]
        fading, half = waves.fading(seconds or 0.0)[case], which.half[case]
        amplitude = waves.amplitude(seconds or 0.0, self.more_left)[case]
        by_amplitude = which.steepest_by(amplitude + waves.standing[case] * (seconds is None))
        by_amplitude = by_amplitude + 2 * which.peaking[case] / half * amplitude
        ending = self._amplitude_by(case, unknowns, fading, by_amplitude)
        k, peak = waves.peak[0][case], waves.peak[1][case]
        steep = 3 * LEFT_OVER * (peak + more) ** 2 / half.min(axis=1) ** 2 * waves.peaks_now[case]
        highest = which.steepest_by(waves.eta[case, k]) * steep[:, None]
        return ending + surface_by(self.planned, unknowns, case, k, highest)

    def free_left_by(self, case: Indices, unknowns: Unknowns) -> Array:
        """Derivatives of the residual free wave, for a fixed final posture of the tray."""
        by_amplitude = self.modes.cases.steepest_by(self.modes.amplitude(more=self.more_left)[case])
        return self._amplitude_by(case, unknowns, 1.0, by_amplitude)

    def _amplitude_by(self, case: Indices, unknowns: Unknowns, fading: Array | float, by_amplitude: Array) -> Array:
        """Derivatives of a function of the final amplitudes with derivatives by_amplitude (m, 2)."""
        away, speed = (x[case] for x in self.modes.ending)
        by_size = fading * self.modes.cases.gain[case] * by_amplitude[:, None]
        by_size = by_size / np.maximum(np.hypot(away, speed), 1e-12)
        return self.ending_by(case, unknowns, by_size * away, by_size * speed)


@dataclass(frozen=True)
class Liquid(Container):
    """A liquid that sloshes in its container."""

    @property
    def response(self) -> type[SloshingResponse]:
        return SloshingResponse

    def drawn(self, body: Any, value: float, seen: Array, beyond: float | None) -> Drawn:
        return DrawnSurface.of_heights(body, value, seen, beyond)
