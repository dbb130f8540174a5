"""Cases of fill and damping that stand for all liquids in the ranges."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from salver.geometry import Array
from salver.models.bodies import Body
from salver.models.interfaces import to_tray
from salver.models.liquid import APART, GRAVITY, STEEPEST, Liquid, Modes
from salver.models.tray_motion import frame_map
from salver.models.uncertain.parameters import Parameter, UncertainSet

VERDICT_APART = 0.02  # of frequency, between the fills at which a verdict looks


@dataclass(frozen=True, eq=False)
class SloshingCase:
    """The liquid of one body at one fill (m) and damping (of critical). softer: share of its frequencies by which high
    waves are slower than small ones."""

    body: Body
    fill: float
    damping: float
    softer: float = 0.0

    @property
    def liquid(self) -> Liquid:
        assert self.body.liquid is not None
        return self.body.liquid

    @property
    def modes(self) -> Modes:
        return self.liquid.modes(self.fill)

    @property
    def room(self) -> float:
        """m to which the surface may rise."""
        return self.liquid.room(self.fill)


@dataclass(frozen=True, eq=False)
class Cases:
    """K cases of liquids, of one or more bodies that are all round or all boxes, as arrays.

    at_O (K, 3, 12), at_mode (K, n_modes, 2, 12): w of the tray's E to the specific force at the centre of the surface,
    and the lateral one at each mode. to_E (K, 6, 6): wrench at O to that at E, in E. omega, kd, mass, height, gain
    (K, n_modes, 2), half, peaking, rest_rise (K, 2): as in `Modes`. damping, room, steepest (K,): the last is the
    largest free wave for which the model is valid, m.
    """

    each: tuple[SloshingCase, ...]
    at_O: Array
    at_mode: Array
    to_E: Array
    omega: Array
    kd: Array
    mass: Array
    height: Array
    gain: Array
    half: Array
    peaking: Array
    rest_rise: Array
    damping: Array
    room: Array
    steepest: Array

    @classmethod
    @lru_cache(maxsize=64)
    def of(cls, each: tuple[SloshingCase, ...]) -> Cases:
        modes = [case.modes for case in each]
        at_O, at_mode, to_E = [], [], []
        for case, own in zip(each, modes, strict=True):
            body = case.body
            O_E = body.p_EB + body.R_EB @ body.surface_B(case.fill)
            at_O.append(frame_map(O_E, body.R_EB)[:3])
            maps = [[frame_map(O_E + z * body.R_EB[:, 2], body.R_EB) for z in heights] for heights in own.height]
            at_mode.append(np.array([[x[0], y[1]] for x, y in maps]))
            to_E.append(to_tray(O_E, body.R_EB))
        damping = np.array([case.damping for case in each])
        omega = np.stack([m.omega * (1 - case.softer) for case, m in zip(each, modes, strict=True)])
        half = np.stack([m.half for m in modes])
        return cls(
            each,
            np.stack(at_O),
            np.stack(at_mode),
            np.stack(to_E),
            omega,
            2 * damping[:, None, None] * omega,
            np.stack([m.mass for m in modes]),
            np.stack([m.height for m in modes]),
            np.stack([m.gain for m in modes]),
            half,
            np.stack([m.peaking for m in modes]),
            np.stack([m.rest_rise for m in modes]),
            damping,
            np.array([case.room for case in each]),
            STEEPEST * half.min(axis=1),
        )

    @property
    def liquid(self) -> Liquid:
        return self.each[0].liquid

    @property
    def round(self) -> bool:
        return self.liquid.round

    @cached_property
    def rising(self) -> Array:
        """(K, n_modes, 2) kg/m: half the square of a mass's place, times this, is what its wave lifts, kg m: its energy
        over g."""
        return np.asarray(self.mass * self.omega**2 / GRAVITY)

    @property
    def wide(self) -> Array:
        """(K,) m, the larger of `half`."""
        return np.asarray(self.half.max(axis=1))

    def highest(self, eta: Array) -> Array:
        """As `Modes.highest`."""
        return self.each[0].modes.highest(eta)

    def steepest_by(self, eta: Array) -> Array:
        """Derivative of `highest`."""
        if self.round:
            return np.asarray(eta / np.maximum(np.linalg.norm(eta, axis=-1, keepdims=True), 1e-12))
        return np.sign(eta)


def cases(body: Body, uncertain: UncertainSet, apart: float = APART) -> tuple[SloshingCase, ...]:
    """Fills and dampings of a body's liquid that stand for all of an uncertain set; none without a liquid."""
    liquid = body.liquid
    if liquid is None:
        return ()
    half = uncertain.ranges
    fill = half.get(Parameter(body.name, "fill"), 0.0)
    found = liquid.cases(liquid.fill - fill, liquid.fill + fill, apart)
    if Parameter(body.name, "damping") not in half:
        found = [(h, liquid.nominal_damping) for h in dict.fromkeys(h for h, _ in found)]
    return tuple(SloshingCase(body, *each) for each in found)
