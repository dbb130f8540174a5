"""True loads of one run: the scenario's objects with true instead of nominal parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from numbers import Real
from typing import Any

import numpy as np

from salver.errors import ScenarioError
from salver.geometry import Array, exp
from salver.models.bodies import TRAY, Body
from salver.models.load_dynamics import THICKEST, Drawn, LoadDynamics, Modes
from salver.models.rigid_body import RigidBody, inertia_matrix
from salver.models.shapes.polygons import intersection
from salver.models.shapes.shapes import Solid
from salver.models.uncertain.parameters import (
    INNER_QUANTITIES,
    RIM,
    TILT,
    Parameter,
    UncertainSet,
    all_parameters,
    inertial_vector,
)
from salver.scenario import CarriedObject, Scenario
from salver.scenario.objects import smooth

LEAST_MOMENT = 1e-14  # kg m^2; MuJoCo treats less as zero
ON_A_LINE = 1e-3  # share of the largest principal moment that replaces a zero one; with 1e-6 contacts are unstable
WALL_OPACITY = 0.25  # of an object with a liquid or a pendulum, where it is drawn
ROUND_POINTS = 24  # support points of a round base: the inscribed polygon is at most 0.9 % inside the circle


@dataclass(frozen=True)
class Load:
    """One loose object with its true parameters.

    inertial: true inertial parameters in B, whose origin is the *nominal* centre of mass (docs/conventions.md), without
    its liquid or pendulum. value, damping: of the liquid or pendulum, m and share of critical; None without one.
    friction: Coulomb coefficient with all its supports. p_EB, R_EB: pose at the start.
    supports: name of each support ("tray" or an object) -> (k, 3) points of its base that rest on it, in B.
    outline_B: (n, 3) all those points, at which slip, lift and tip are measured.
    nominal: the body that the planner uses.
    """

    name: str
    solid: Solid
    shape: object
    com_G: Array
    inertial: RigidBody
    friction: float
    p_EB: Array
    R_EB: Array
    supports: Mapping[str, Array]
    nominal: Body
    value: float | None = None
    damping: float | None = None

    @cached_property
    def modes(self) -> Modes:
        """Modes of its liquid or pendulum."""
        return self.inner.modes(self.inner_value)

    @property
    def inner(self) -> LoadDynamics:
        """The dynamics of its liquid or pendulum."""
        assert self.nominal.inner is not None
        return self.nominal.inner

    @property
    def inner_value(self) -> float:
        """True fill height or pendulum length, m."""
        assert self.value is not None
        return self.value

    @property
    def edge(self) -> float:
        """`LoadDynamics.edge`, m; NaN without a liquid or pendulum."""
        return np.nan if self.value is None else self.inner.edge(self.value)

    def drawn(self, seen: Array, beyond: float | None) -> Drawn:
        """Drawing of its liquid or pendulum, see `LoadDynamics.drawn`."""
        return self.inner.drawn(self.nominal, self.inner_value, seen, beyond)

    @cached_property
    def still(self) -> RigidBody:
        """The part of it that does not slosh or swing, in B.

        For a long box of liquid in a very light container the model gives it a negative principal moment, which is
        replaced by a small positive one.
        """
        if self.value is None:
            return self.inertial
        rest = self.modes.still
        rest = RigidBody(rest.mass, rest.com_B + self.origin_B, rest.inertia_com)
        still = RigidBody.from_phi(self.inertial.phi + rest.phi)
        principal, axes = np.linalg.eigh(still.inertia_com)
        if principal[0] >= ON_A_LINE * principal[2]:
            return still
        return replace(still, inertia_com=(axes * np.maximum(principal, ON_A_LINE * principal[2])) @ axes.T)

    @property
    def origin_B(self) -> Array:
        """Origin (3,) of the dynamics of its liquid or pendulum, in B, m."""
        return self.nominal.inner_origin_B(self.inner_value)

    @property
    def outline_B(self) -> Array:
        return np.concatenate(list(self.supports.values()))

    @property
    def base_centre_B(self) -> Array:
        """Centre (3,) of the base, in B, m."""
        return np.array([0.0, 0.0, self.solid.base_z]) - self.com_G


@dataclass(frozen=True)
class TrueWorld:
    """The true loads in the scenario's order, and tilt: (3,) rotation vector of the real tray in the assumed E, rad.
    rim_friction: Coulomb coefficient of the tray's rim."""

    loads: tuple[Load, ...]
    tilt: Array
    rim_friction: float = 0.0

    @property
    def R_tilt(self) -> Array:
        """Rotation (3, 3) of the real tray in the assumed E."""
        return exp(self.tilt)


def true_world(scenario: Scenario, parameters: Mapping[str, float] | None = None) -> TrueWorld:
    """The true loads of a scenario, with some parameters not nominal.

    parameters: true values by name (docs/conventions.md), in SI units; with several objects, names have the prefix
    `object.`. Raises ScenarioError for an unknown name, an impossible value, or an object beside its supports.
    """
    loads: list[Load] = []
    true = by_parameter(scenario, parameters or {})
    for item, nominal in zip(scenario.objects, scenario.payload.bodies, strict=True):
        loads.append(_load(item, nominal, true, scenario, loads))
    tilt = np.array([*(true.get(tilt, 0.0) for tilt in TILT), 0.0])
    rim = scenario.tray.rim
    if rim is None and RIM in true:
        raise ScenarioError(f"friction_rim = {true[RIM]:g}: the tray of {scenario.name} has no rim; give tray.rim.")
    return TrueWorld(tuple(loads), tilt, true.get(RIM, rim.friction if rim else 0.0))


def by_parameter(scenario: Scenario, values: Mapping[str, Any]) -> dict[Parameter, float]:
    """True values by parameter instead of by name. Raises ScenarioError for an unknown name, or for no number."""
    known = {parameter.name: parameter for parameter in all_parameters([item.name for item in scenario.objects])}
    for name, value in values.items():
        if name not in known:
            names = list(known)
            shown = ", ".join(names if len(names) < 40 else [*names[:13], "...", *names[-2:]])
            raise ScenarioError(f'There is no parameter "{name}" in {scenario.name}; known are {shown}.')
        if not isinstance(value, Real) or not np.isfinite(float(value)):
            raise ScenarioError(f"Parameter {name} = {value!r}; it must be a finite number.")
    return {known[name]: float(value) for name, value in values.items()}


def outside(uncertain: UncertainSet, parameters: Mapping[str, float]) -> dict[str, tuple[float, float] | None]:
    """The values outside the uncertain set of a plan: name to its range, or to None if it was assumed to be exact.

    For a point outside an ellipsoid these are all values that have a range.
    """
    place = {name: uncertain.names.index(name) for name in parameters if name in uncertain.names}
    off = np.zeros(uncertain.size)
    for name, k in place.items():
        off[k] = (parameters[name] - uncertain.nominal[k]) / uncertain.half_range[k]
    if uncertain.spread is not None:
        off[:] = np.linalg.norm(np.linalg.solve(uncertain.spread, off))
    low, high = uncertain.nominal - uncertain.half_range, uncertain.nominal + uncertain.half_range
    return {
        name: (float(low[place[name]]), float(high[place[name]])) if name in place else None
        for name in parameters
        if name not in place or abs(off[place[name]]) > 1 + 1e-9
    }


def _load(
    item: CarriedObject, nominal: Body, true: Mapping[Parameter, float], scenario: Scenario, below: list[Load]
) -> Load:
    shape = item.shape
    loose = item.loose(smooth(shape, ROUND_POINTS))
    solid, inertial = loose.solid, inertial_vector(loose.own)
    for parameter, value in true.items():
        if parameter.owner == item.name and parameter.entry is not None:
            inertial[parameter.entry] = value
    body = _wide_enough(RigidBody(float(inertial[0]), inertial[1:4], inertia_matrix(inertial[4:])))
    friction = true.get(Parameter(item.name, "friction"), item.friction)
    _check(item.name, body, friction)
    p_EB = nominal.place_at(true)
    supports = _supports(nominal, solid, p_EB, scenario, below)
    inner_value, damping = _inside(nominal, true)
    return Load(
        item.name,
        solid,
        shape,
        nominal.com_G,
        body,
        friction,
        p_EB,
        nominal.R_EB,
        supports,
        nominal,
        inner_value,
        damping,
    )


def _wide_enough(body: RigidBody) -> RigidBody:
    """The body with a small moment of inertia instead of a zero one, which the engine cannot handle.

    The worst contents may be masses on a line, with no moment about it.
    """
    principal = np.linalg.eigvalsh(body.inertia_com)
    if not -1e-9 * principal[2] <= principal[0] < LEAST_MOMENT:
        return body
    return replace(body, inertia_com=body.inertia_com + ON_A_LINE * principal[2] * np.eye(3))


def _inside(body: Body, true: Mapping[Parameter, float]) -> tuple[float | None, float | None]:
    """Fill height or pendulum length and damping of a body, or None. Raises ScenarioError for impossible values."""
    inner, own = body.inner, () if body.inner is None else (body.inner.quantity, "damping")
    for kind in INNER_QUANTITIES:
        if (key := Parameter(body.name, kind)) in true and kind not in own:
            raise ScenarioError(f"{kind} of {body.name} = {true[key]:g}: it contains nothing that has a {kind}.")
    if inner is None:
        return None, None
    value = true.get(Parameter(body.name, inner.quantity), inner.value)
    damping = true.get(Parameter(body.name, "damping"), inner.nominal_damping)
    try:
        inner.check_value(body.name, value)
    except ValueError as error:
        raise ScenarioError(str(error)) from error
    if not 0 <= damping <= 2 * THICKEST:
        raise ScenarioError(f"damping of {body.name} = {damping:g} of critical; it must be from 0 to {2 * THICKEST:g}.")
    return value, damping


def _check(name: str, body: RigidBody, friction: float) -> None:
    if body.mass <= 0:
        raise ScenarioError(f"mass of {name} = {body.mass:g} kg; it must be positive.")
    if friction <= 0:
        raise ScenarioError(f"friction of {name} = {friction:g}; it must be positive.")
    principal = np.linalg.eigvalsh(body.inertia_com)
    if principal[0] < LEAST_MOMENT or principal[2] > (principal[0] + principal[1]) * (1 + 1e-9):
        raise ScenarioError(
            f"inertia of {name} has principal moments {', '.join(f'{x:.3g}' for x in principal)} kg m^2; all must be "
            f"at least {LEAST_MOMENT:g} and none larger than the sum of the other two."
        )


def _supports(body: Body, solid: Solid, p_EB: Array, scenario: Scenario, below: list[Load]) -> dict[str, Array]:
    """Corners of the overlap of the object's base with each support, in B."""
    R_EB = body.R_EB
    base_z = solid.base_z - body.com_G[2]
    base_B = np.column_stack([solid.base_polygon - body.com_G[:2], np.full(len(solid.base_polygon), base_z)])
    base_E = (p_EB + base_B @ R_EB.T)[:, :2]
    supports: dict[str, Array] = {}
    for name in body.on:
        if name == TRAY:
            half = 0.5 * np.array(scenario.tray.size)
            surface = half * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
        else:
            lower = next(load for load in below if load.name == name)
            top_B = lower.solid.top_polygon - lower.com_G[:2]
            surface = (lower.p_EB + np.column_stack([top_B, np.zeros(len(top_B))]) @ lower.R_EB.T)[:, :2]
        overlap = intersection(base_E, surface)
        if len(overlap) >= 3:
            points = np.column_stack([overlap - p_EB[:2], np.zeros(len(overlap))]) @ R_EB
            points[:, 2] = base_z
            supports[name] = points
    if not supports:
        raise ScenarioError(f"{body.name} stands beside {' and '.join(body.on)}; its base must overlap with it.")
    return supports
