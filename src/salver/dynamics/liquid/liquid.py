"""A liquid in an open container: its sloshing modes, inertia, and height at the wall.

Linear potential flow in a container with straight walls (Ibrahim, Liquid Sloshing Dynamics, 2005; Dodge, The New
Dynamic Behavior of Liquids in Moving Containers, 2000). The first two modes of each lateral axis are dynamic, the
others quasi-static; the rest of the liquid moves as under a lid. With O the centre of the surface at rest, z up the
container's axis, f the specific force at O and f_S that at a mode's height (0, 0, z_n), the position r_n (2,) of its
mass obeys the equation of `salver.models.load_dynamics`, and along either axis the surface at the wall is

    eta = sum gamma_n r_n - (R - sum b_n) f / f_z,        gamma_n = b_n omega_n^2 / g

above its height at rest. R is the radius or half the side, b_n the coefficient of mode n in an inclined surface
(`salver.dynamics.liquid.interiors` has them). Walls that lean out let it rise further than that
(`Interior.level_rise`).

Beyond linear theory a free wave of amplitude a has a crest of a + kappa a^2 / R (`SurfaceModes.peaking`), and tilting
the container at a rate Omega raises the liquid by about Omega^2 R^2 / g; both are included in the height that must stay
below the brim. Valid for free waves up to 0.3 R in liquids at least R / 2 deep, not for swirling waves."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from salver.dynamics.liquid.interiors import Interior, SurfaceModes
from salver.geometry import GRAVITY, Array
from salver.models.load_dynamics import LoadDynamics
from salver.models.rigid_body import RigidBody
from salver.models.shapes.shapes import Solid

SHALLOWEST = 0.5  # least depth over R: shallower waves steepen and break, which the modes do not describe
STEEPEST = 0.3  # largest amplitude of a free wave over R that was validated (docs/liquids.md)
# Largest height of the whole surface at the wall over R, its inclination included. Beyond it the linear model is wrong:
# with 0.5 a random load spills in the physics engine (docs/liquids.md, `--only leaning`).
LEANING = 0.45
LEFT_OVER = 1.8  # residual waves beyond linear theory, relative to peak^3 / R^2, in nonlinear flow


@dataclass(frozen=True)
class Fluid:
    """A liquid: density, kg/m^3, and kinematic viscosity, m^2/s, at room temperature (coffee: hot)."""

    density: float
    viscosity: float


FLUIDS = {"water": Fluid(998.0, 1.0e-6), "coffee": Fluid(975.0, 4.0e-7), "oil": Fluid(915.0, 8.0e-5)}


@dataclass(frozen=True)
class Container(LoadDynamics):
    """A liquid in a container, and its limits: a `Liquid` without its response and picture.
    inside: its walls. floor: height of its bottom over the object's base, m. fill, brim: heights over that bottom, m.
    density: kg/m^3. damping: least and largest damping ratio. margin: distance that must be left below the brim, m.
    highest: largest wave allowed, whatever the brim, m. sealed: whether it has a lid. settled, within: height, m, that
    no wave exceeds from `within` seconds after the motion.
    """

    inside: Interior
    floor: float
    fill: float
    brim: float
    density: float
    damping: tuple[float, float]
    margin: float = 0.0
    highest: float = np.inf
    sealed: bool = False
    settled: float = np.inf
    within: float = 0.0
    name: str = field(default="liquid", compare=False)
    quantity: ClassVar[str] = "fill"
    noun: ClassVar[str] = "liquid"
    measure: ClassVar[str] = "wave"
    outcome: ClassVar[str] = "spills"
    chart: ClassVar[tuple[str, str, str]] = ("Highest point of", "over its level at rest, mm", "brim, fullest")

    def origin(self, base: float, value: float) -> float:
        """Height of the centre of the still surface, m."""
        return base + self.floor + value

    def unmodelled(self, owner: str) -> str:
        """Parts of the liquid's motion that are not modelled, in words; owner: name of the container."""
        return f"swirling or breaking waves in {owner}"

    def room(self, value: float) -> float:
        """Height over the level at rest to which waves may rise at a fill, by linear theory, m."""
        return self._risen(value, min(self.brim - value - self.margin, self.highest))

    def settled_rise(self, value: float) -> float:
        """`settled` at a fill, by linear theory, m."""
        return np.inf if np.isinf(self.settled) else self.inside.level_rise(value, self.settled)

    def _risen(self, value: float, rise: float) -> float:
        return np.inf if self.sealed else self.inside.level_rise(value, rise)

    @property
    def open(self) -> bool:
        return not self.sealed

    def edge(self, value: float) -> float:
        """Distance from the surface at rest to the brim, as a height by linear theory, m; infinite under a lid."""
        return self._risen(value, self.brim - value)

    def extent(self, value: float, places: Array) -> Array:
        return self.modes(value).highest(places)

    def seen(self, value: float, incline: Array, slope: Array, turning: Array) -> Array:
        """Heights (T, 3) over the level at rest, m: at the wall along x and y, and of the highest point."""
        modes = self.modes(value)
        eta = np.einsum("na,tna->ta", modes.rise, incline) - modes.rest_rise * slope
        return np.column_stack([eta, modes.crest(eta, slope, turning)])

    def check_value(self, owner: str, value: float) -> None:
        if not 0 < value <= self.brim:
            raise ValueError(
                f"fill of {owner} = {value:g} m; it must be above 0 and at most its brim, {self.brim:g} m."
            )

    def shell(self, solid: Solid) -> tuple[Array, Array]:
        return hollow(solid, self)

    def modes(self, value: float) -> SurfaceModes:
        """The modes at a fill. Raises ValueError for a fill of 0."""
        if value <= 0:
            raise ValueError(f"fill = {value:g} m; it must be above 0")
        return self.inside.modes(value, self.density)


def damping_of(R: float, fill: float, viscosity: float) -> float:
    """Damping ratio of the first mode by the boundary layers of a clean container (Dodge 2000, from Stephens and
    others): an upright cylinder, as which others count. R: radius of the surface, or half its shorter side, m."""
    depth = 1.84 * fill / R
    shallow = 0.318 / np.sinh(depth) * (1 + (1 - fill / R) / np.cosh(depth))
    return float(0.79 * np.sqrt(viscosity / np.sqrt(GRAVITY * R**3)) * (1 + shallow))


def damping_range(clean: float, factor: float = 2.0, dirty: float = 0.03) -> tuple[float, float]:
    """Least and largest damping ratio where that in a clean container is `clean`, which is known to within a factor.

    dirty: the largest is at least this: a dirty surface and the contact line at the wall damp small waves of water too.
    """
    return clean / factor, max(factor * clean, dirty)


def hollow(solid: Solid, liquid: Container) -> tuple[Array, Array]:
    """Centre of mass (3,) of a uniform container, from the centre of the solid that it is cut out of, m, and its
    inertia about it per mass (3, 3), m^2."""
    inside, outer = liquid.inside.solid(liquid.brim), solid.volume
    at = inside.centroid_G - solid.centroid_G + np.array([0.0, 0.0, 0.5 * liquid.floor])
    phi = RigidBody(outer, np.zeros(3), outer * solid.unit_inertia).phi
    phi -= RigidBody(inside.volume, at, inside.volume * inside.unit_inertia).phi
    whole = RigidBody.from_phi(phi / (outer - inside.volume))
    return whole.com_B, whole.inertia_com
