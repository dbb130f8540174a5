"""Representative cases (value and damping) of a load's inner dynamics in their ranges."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import product
from typing import Self

import numpy as np

from salver.geometry import GRAVITY, Array
from salver.models.bodies import Body
from salver.models.interfaces import to_tray
from salver.models.load_dynamics import APART, LoadDynamics, Modes
from salver.models.tray_motion import frame_map
from salver.models.uncertain.parameters import Parameter, UncertainSet

VERDICT_APART = 0.02  # relative step of frequency between the cases of a verdict


@dataclass(frozen=True, eq=False)
class LoadCase:
    """A body's inner dynamics with one value (m) of its quantity and one damping ratio.

    aside: m, where the body stands, from its nominal position along x and y of the tray."""

    body: Body
    value: float
    damping: float
    aside: tuple[float, ...] = (0.0, 0.0)

    @property
    def dynamics(self) -> LoadDynamics:
        assert self.body.inner is not None
        return self.body.inner

    @property
    def modes(self) -> Modes:
        return self.dynamics.modes(self.value)

    @property
    def deviation(self) -> dict[Parameter, float]:
        """Deviation from nominal of the uncertain parameters that the case determines: quantity and position."""
        places = (Parameter(self.body.name, "position", axis) for axis in "xy")
        own = Parameter(self.body.name, self.dynamics.quantity)
        return {own: self.value - self.dynamics.value} | dict(zip(places, self.aside, strict=True))

    @property
    def name(self) -> tuple[str | float, ...]:
        """Unique key of the case within a payload."""
        return self.body.name, self.value, self.damping, *self.aside


@dataclass(frozen=True, eq=False)
class ModalCases:
    """K cases, of one or more bodies with `alike` dynamics, as arrays.

    at_O (K, 3, 12), at_mode (K, n_modes, 2, 12): maps from the tray's motion regressor w to the specific force at O,
    and to the lateral one at each mode. to_E (K, 6, 6): map from a wrench at O to that at E, in E; of a body beside its
    position at an E that is moved as far, where contact rows of a body that stands alone are the same. omega, kd, mass,
    height (K, n_modes, 2): as in `Modes`.
    """

    each: tuple[LoadCase, ...]
    at_O: Array
    at_mode: Array
    to_E: Array
    omega: Array
    kd: Array
    mass: Array
    height: Array

    @classmethod
    @lru_cache(maxsize=64)
    def of(cls, each: tuple[LoadCase, ...]) -> Self:
        modes = [case.modes for case in each]
        at_O, at_mode, to_E = [], [], []
        for case, own in zip(each, modes, strict=True):
            body = case.body
            O_E = body.p_EB + body.R_EB @ body.inner_origin_B(case.value)
            to_E.append(to_tray(O_E, body.R_EB))
            O_E = O_E + np.array([*case.aside, 0.0])
            at_O.append(frame_map(O_E, body.R_EB)[:3])
            maps = [[frame_map(O_E + z * body.R_EB[:, 2], body.R_EB) for z in heights] for heights in own.height]
            at_mode.append(np.array([[x[0], y[1]] for x, y in maps]))
        damping = np.array([case.damping for case in each])
        omega = np.stack([m.omega for m in modes])
        return cls(
            each,
            np.stack(at_O),
            np.stack(at_mode),
            np.stack(to_E),
            omega,
            2 * damping[:, None, None] * omega,
            np.stack([m.mass for m in modes]),
            np.stack([m.height for m in modes]),
        )

    @cached_property
    def round(self) -> bool:
        return self.each[0].modes.round

    @cached_property
    def room(self) -> Array:
        """(K,) m, see `LoadDynamics.room`."""
        return np.array([case.dynamics.room(case.value) for case in self.each])

    @cached_property
    def rising(self) -> Array:
        """Factors (K, n_modes, 2), kg/m: times half the square of a mass's displacement they give its potential energy
        divided by g, kg m."""
        return np.asarray(self.mass * self.omega**2 / GRAVITY)

    @cached_property
    def carried(self) -> tuple[Array, Array, Array]:
        """Forces per mass (K, 1, n_modes, 2) by a body that rotates about z and drags its masses along, per rad/s,
        rad/s^2 and (rad/s)^2: see `ModalMotion.walls`. Not used for `round` ones."""
        raise NotImplementedError


def alike(case: LoadCase) -> tuple[type, bool]:
    """Key of the cases that can be computed together: kind of dynamics, and whether round."""
    return type(case.dynamics), case.modes.round


def load_cases(body: Body, uncertain: UncertainSet, apart: float = APART) -> tuple[LoadCase, ...]:
    """Representative cases of a body's inner dynamics for an uncertain set; none without inner dynamics.

    With an uncertain position each is a case at every corner of its range. The drive of the modes is affine in the
    position, and limits and contact rows are convex in the modes, so that none of them is larger between the corners
    (docs/liquids.md, "Place on the tray", has the proof and what it neglects)."""
    inner = body.inner
    if inner is None:
        return ()
    half = uncertain.ranges
    away = half.get(Parameter(body.name, inner.quantity), 0.0)
    found = inner.cases(inner.value - away, inner.value + away, apart)
    if Parameter(body.name, "damping") not in half:
        found = [(value, inner.nominal_damping) for value in dict.fromkeys(value for value, _ in found)]
    ends = [(-h, h) if (h := half.get(Parameter(body.name, "position", axis))) else (0.0,) for axis in "xy"]
    return tuple(LoadCase(body, *each, aside) for aside in product(*ends) for each in found)
