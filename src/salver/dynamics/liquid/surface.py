"""The surface of a liquid along a motion: heights at the wall by linear theory, and crests with nonlinear terms."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, cast

import numpy as np

from salver.dynamics.liquid.interiors import TILTING, SurfaceModes
from salver.dynamics.liquid.liquid import LEFT_OVER, STEEPEST, Container
from salver.dynamics.load_cases import ModalCases
from salver.dynamics.modal_changes import Change, turned_each
from salver.dynamics.modal_motion import TURNING, ModalMotion, across, turned
from salver.dynamics.motion_gradients import Unknowns, at_node
from salver.geometry import GRAVITY, Array, Indices


def _stacked(name: str) -> cached_property[Array]:
    return cached_property(lambda which: np.stack([getattr(modes, name) for modes in which.modes]))


@dataclass(frozen=True, eq=False)
class SurfaceCases(ModalCases):
    """K cases of liquids. gain (K, n_modes, 2), half, peaking, rest_rise (K, 2): as in `SurfaceModes`."""

    @cached_property
    def modes(self) -> list[SurfaceModes]:
        return [cast(SurfaceModes, case.modes) for case in self.each]

    @property
    def liquid(self) -> Container:
        return cast(Container, self.each[0].dynamics)

    gain, half = _stacked("gain"), _stacked("half")
    peaking, rest_rise = _stacked("peaking"), _stacked("rest_rise")

    @cached_property
    def steepest(self) -> Array:
        """Largest free wave (K,) for which the model is valid, m."""
        return np.asarray(STEEPEST * self.half.min(axis=1))

    @cached_property
    def settled(self) -> Array:
        """(K,) m, see `Container.settled_rise`."""
        return np.array([cast(Container, case.dynamics).settled_rise(case.value) for case in self.each])

    @property
    def wide(self) -> Array:
        """The larger of `half`, (K,), m."""
        return np.asarray(self.half.max(axis=1))

    def highest(self, eta: Array) -> Array:
        """As `SurfaceModes.highest`."""
        return self.modes[0].highest(eta)

    def steepest_by(self, eta: Array) -> Array:
        """Derivative of `highest`."""
        if self.round:
            return np.asarray(eta / np.maximum(np.linalg.norm(eta, axis=-1, keepdims=True), 1e-12))
        return np.sign(eta)

    @cached_property
    def carried(self) -> tuple[Array, Array, Array]:
        n = self.omega.shape[1]
        sides = 2 * np.prod(self.half, axis=1) / (self.half**2).sum(axis=1)
        share = (8 / np.pi**2 * sides[:, None] / (2 * np.arange(n) + 1) ** 2)[:, None, :, None]  # C
        ratio = (self.omega**2 / self.omega[..., ::-1] ** 2)[:, None]
        by_other = share * (self.gain[..., ::-1] / self.gain)[:, None] * [1.0, -1.0]
        return by_other * (1 + ratio), by_other, share**2 * ratio


@dataclass(frozen=True, eq=False)
class SurfaceMotion(ModalMotion):
    """K cases of a liquid along a motion of T nodes."""

    cases_type: ClassVar[type[ModalCases]] = SurfaceCases
    cases: SurfaceCases

    @cached_property
    def eta(self) -> Array:
        """Height (K, T, 2) of the surface at the wall along both axes, by linear theory, m."""
        which = self.cases
        return np.asarray((which.gain[:, None] * self.r).sum(axis=2) - which.rest_rise[:, None] * self.slope)

    @property
    def seen(self) -> Array:
        return np.concatenate([turned(self.eta, -self.spin), self.crest[..., None]], axis=2)

    @cached_property
    def free(self) -> Array:
        """The free wave (K, T, 2): `eta` without the inclination at equilibrium, m."""
        return self.eta + self.cases.half[:, None] * self.slope

    @cached_property
    def crest(self) -> Array:
        """Height (K, T) of the highest point over the surface at rest, m, with the nonlinear terms."""
        which, turning = self.cases, self.w @ TURNING
        steep = (which.peaking[:, None] / which.half[:, None] * self.free**2).sum(axis=-1)
        return which.highest(self.eta) + steep + TILTING / GRAVITY * which.wide[:, None] ** 2 * turning

    def raised(self, by: Array | float, freer: Array | float) -> Array:
        """Crest (K, T), m, of waves that are higher by `by` (K, T), with free waves higher by at most `freer` (K, T,
        2)."""
        which = self.cases
        curve = (which.peaking / which.half)[:, None]
        return self.crest + by + (curve * freer * (2 * np.abs(self.free) + freer)).sum(axis=-1)

    def changed(self, change: Change, dw: Array) -> tuple[Array, Array, Array]:
        """Changes by dw (K or 1, T, 12, c) of the tray's motion regressor: of the heights along both axes, m, of the
        surface and of its free wave, (K, T, 2, c), and of the rise by tilting, (K, T, c)."""
        which = self.cases
        force = which.at_O[:, None] @ dw  # (K, T, 3, c)
        lateral = turned_each(force[:, :, :2], self.spin)
        slope = (lateral - self.slope[..., None] * force[:, :, 2:]) / self.upward[:, :, None, None]
        slope += across(self.slope)[..., None] * change.spun
        eta = np.einsum("kna,ktnac->ktac", which.gain, change.r) - which.rest_rise[:, None, :, None] * slope
        thrown = TILTING / GRAVITY * which.wide[:, None, None] ** 2 * (TURNING @ dw)
        return eta, eta + which.half[:, None, :, None] * slope, thrown

    @property
    def height(self) -> Array:
        """Height (K, T) of the whole surface at the wall, by linear theory, m."""
        return self.cases.highest(self.eta)

    @property
    def free_height(self) -> Array:
        """Height (K, T) of the free wave, by linear theory, m."""
        return self.cases.highest(self.free)

    @cached_property
    def tail(self) -> Array:
        """Amplitude (K, n_modes, 2) at the wall of the residual waves at the end, with the tray at rest, m."""
        return np.asarray(self.cases.gain * np.hypot(*self.ending))

    def amplitude(self, seconds: float = 0.0, more: Array | float = 0.0) -> Array:
        """Bound (K, 2) on free waves along either axis from `seconds` after the end on, with both modes in phase, m.
        more: (K,) m by which they may be higher."""
        higher = np.broadcast_to(more, len(self.r))[:, None]
        return np.asarray((self.tail * self.fading(seconds)).sum(axis=1) + higher)

    @cached_property
    def standing(self) -> Array:
        """Static height (K, 2) of the surface at the wall after the motion, on a tilted tray, m."""
        return np.asarray(self.cases.half * np.abs(self.slope[:, -1]))

    def left(self, seconds: float | None = None, more: Array | float = 0.0) -> Array:
        """Bound (K,) on crests after the end, with the tray at rest and both modes in phase, m. With `seconds`: bound
        on waves from then on, without the static height. more: (K,) m by which linear waves may be higher."""
        which, more = self.cases, np.broadcast_to(more, len(self.r))
        amplitude = self.amplitude(seconds or 0.0, more)
        highest = which.highest(amplitude + self.standing * (seconds is None))
        over = LEFT_OVER * (self.peak[1] + more) ** 3 / which.half.min(axis=1) ** 2
        return np.asarray(highest + (which.peaking / which.half * amplitude**2).sum(axis=1) + over)


def surface_by(
    waves: SurfaceMotion,
    unknowns: Unknowns,
    case: Indices,
    node: Indices,
    by_eta: Array | float = 0.0,
    by_free: Array | float = 0.0,
    thrown: Array | float = 0.0,
) -> Array:
    """Derivatives of by_eta . eta + by_free . free, (m, 2) each, plus `thrown` (m,) times the squared rate of
    tilting."""
    which = waves.cases
    both, up = np.asarray(by_eta + by_free), waves.upward[case, node]
    by_slope = (by_free * which.half[case] - both * which.rest_rise[case]) / up[:, None]
    lateral = turned(by_slope, -waves.spin[case, node])
    by_force = np.column_stack([lateral, -(by_slope * waves.slope[case, node]).sum(axis=1)])
    by_spin = up * (by_slope * across(waves.slope[case, node])).sum(axis=1) if which.round else None
    by_r = which.gain[case] * both[:, None, :]
    by_w = (by_force[:, None] @ which.at_O[case])[:, 0] + np.multiply.outer(thrown, TURNING)
    return at_node(unknowns, waves, case, node, by_r, None, by_w, by_spin)
