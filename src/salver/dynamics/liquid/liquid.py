"""A liquid in an open container: its sloshing modes, inertia, and height at the wall.

Linear potential flow in an upright container (Ibrahim, Liquid Sloshing Dynamics, 2005; Dodge, The New Dynamic Behavior
of Liquids in Moving Containers, 2000). The first two modes of each lateral axis are dynamic, the others quasi-static;
the rest of the liquid moves as under a lid. With O the centre of the surface at rest, z up the container's axis, f the
specific force at O and f_S that at a mode's height (0, 0, z_n), the position r_n (2,) of its mass obeys the equation of
`salver.models.load_dynamics`, and along either axis the surface at the wall is

    eta = sum gamma_n r_n - (R - sum b_n) f / f_z,        gamma_n = b_n omega_n^2 / g

above its height at rest. R is the radius or half the side, b_n the coefficient of mode n in an inclined surface.

Beyond linear theory a free wave of amplitude a has a crest of a + kappa a^2 / R (`SurfaceModes.peaking`), and tilting
the container at a rate Omega raises the liquid by about Omega^2 R^2 / g; both are included in the height that must stay
below the brim. Valid for free waves up to 0.3 R in liquids at least R / 2 deep, not for swirling waves."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from typing import ClassVar

import numpy as np

from salver.geometry import GRAVITY, Array
from salver.models.load_dynamics import LoadDynamics, Modes
from salver.models.rigid_body import RigidBody
from salver.models.shapes import shapes
from salver.models.shapes.shapes import Solid

MODES = 2  # dynamic modes of each lateral axis
TERMS = 24  # of series that converge with the fourth power or faster
SHALLOWEST = 0.5  # least depth over R: shallower waves steepen and break, which the modes do not describe
STEEPEST = 0.3  # largest amplitude of a free wave over R that was validated (docs/liquids.md)
# Largest height of the whole surface at the wall over R, its inclination included. Beyond it the linear model is wrong:
# with 0.5 a random load spills in the physics engine (docs/liquids.md, `--only leaning`).
LEANING = 0.45
LEFT_OVER = 1.8  # residual waves beyond linear theory, relative to peak^3 / R^2, in nonlinear flow
TILTING = 1.3  # rise by fast tilting, relative to Omega^2 R^2 / g, in nonlinear potential flow
_ROOTS = np.array([1.8411837813, 5.3314427735, 8.5363163663, 11.7060049026])  # of J1'
# A free wave in a cylinder that is 0.3 R high, by nonlinear potential flow: depth over R, kappa.
_CYLINDER_DEPTH = np.array([0.35, 0.5, 0.65, 0.8, 1.0, 1.5, 2.0])
_CYLINDER_PEAKING = np.array([3.6, 3.0, 2.2, 1.75, 1.46, 1.25, 1.22])


@dataclass(frozen=True)
class Fluid:
    """A liquid: density, kg/m^3, and kinematic viscosity, m^2/s, at room temperature (coffee: hot)."""

    density: float
    viscosity: float


FLUIDS = {"water": Fluid(998.0, 1.0e-6), "coffee": Fluid(975.0, 4.0e-7), "oil": Fluid(915.0, 8.0e-5)}


@dataclass(frozen=True, eq=False)
class SurfaceModes(Modes):
    """The modes of one container at one fill. Arrays (n_modes, 2): mode, axis x or y; (2,): axis.

    rise: b_n, m. half (2,): R of each axis, m. peaking (2,): kappa. round: whether the container is a cylinder; in a
    box the highest point is a corner.
    """

    rise: Array
    half: Array
    peaking: Array

    @property
    def gain(self) -> Array:
        """gamma_n (n_modes, 2): height of the wave at the wall per displacement of the mass."""
        return self.rise / self.length

    @property
    def rest_rise(self) -> Array:
        """R - sum b_n (2,), m: part of the quasi-static modes in an inclined surface."""
        return np.asarray(self.half - self.rise.sum(axis=0))

    def highest(self, eta: Array) -> Array:
        """Highest point (...) around the wall of a surface with heights eta (..., 2) along x and y."""
        if self.round:
            return np.asarray(np.linalg.norm(eta, axis=-1))
        return np.asarray(np.abs(eta).sum(axis=-1))

    def crest(self, eta: Array, slope: Array, turning: Array) -> Array:
        """Height (...) of the highest point over the surface at rest, m, with the nonlinear terms.

        eta (..., 2): heights by linear theory, m. slope (..., 2): f / f_z. turning (...): Omega^2 of tilting, 1/s^2.
        """
        free = eta + self.half * slope
        steep = (self.peaking / self.half * free**2).sum(axis=-1)
        return self.highest(eta) + steep + TILTING / GRAVITY * float(self.half.max()) ** 2 * turning


@dataclass(frozen=True)
class Container(LoadDynamics):
    """A liquid in a container, and its limits: a `Liquid` without its response and picture.

    size: inner (radius,) of an upright cylinder, or (x, y) of an upright box, m. floor: height of its bottom over the
    object's base, m. fill, brim: heights over that bottom, m. density: kg/m^3. damping: least and largest damping
    ratio. margin: distance that must be left below the brim, m. highest: largest wave allowed, whatever the brim, m.
    sealed: whether it has a lid. settled, within: height, m, that no wave exceeds from `within` seconds after the
    motion.
    """

    size: tuple[float] | tuple[float, float]
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

    @property
    def round(self) -> bool:
        return len(self.size) == 1

    @property
    def half(self) -> Array:
        """Radius, or half of each side, (2,), m."""
        return np.repeat(self.size, 2) if self.round else 0.5 * np.array(self.size)

    def unmodelled(self, owner: str) -> str:
        """Parts of the liquid's motion that are not modelled, in words; owner: name of the container."""
        return f"swirling or breaking waves in {owner}"

    def room(self, value: float) -> float:
        """Height over the level at rest to which waves may rise at a fill, m."""
        return np.inf if self.sealed else min(self.brim - value - self.margin, self.highest)

    @property
    def open(self) -> bool:
        return not self.sealed

    def edge(self, value: float) -> float:
        """Distance from the surface at rest to the brim, m; infinite under a lid."""
        return np.inf if self.sealed else self.brim - value

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
        return _modes(self.size, value, self.density)


def damping_of(size: tuple[float, ...], fill: float, viscosity: float) -> float:
    """Damping ratio of the first mode by the boundary layers of a clean container (Dodge 2000, from Stephens and
    others; a box counts as a cylinder with half its shorter side as radius)."""
    R = size[0] if len(size) == 1 else 0.5 * min(size)
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
    inside = shapes.cylinder(liquid.size[0], liquid.brim) if liquid.round else shapes.box((*liquid.size, liquid.brim))
    corners = solid.base_polygon
    sides = 2 * (np.full(2, np.linalg.norm(corners, axis=1).max()) if liquid.round else corners.max(axis=0))
    outer = float(np.prod(sides)) * solid.height
    inner = float(np.prod(2 * liquid.half)) * liquid.brim  # of either, pi / 4 of it when round
    phi = RigidBody(outer, np.zeros(3), outer * solid.unit_inertia).phi
    phi -= RigidBody(inner, np.array([0.0, 0.0, 0.5 * liquid.floor]), inner * inside.unit_inertia).phi
    whole = RigidBody.from_phi(phi / (outer - inner))
    return whole.com_B, whole.inertia_com


@lru_cache(maxsize=1024)
def _modes(size: tuple[float, ...], fill: float, density: float) -> SurfaceModes:
    return _cylinder(size[0], fill, density) if len(size) == 1 else _box(size[0], size[1], fill, density)


def _cylinder(R: float, h: float, density: float) -> SurfaceModes:
    xi, total, after = _ROOTS[:MODES], density * np.pi * R**2 * h, _ROOTS[MODES]
    tanh = np.tanh(xi * h / R)
    mass = total * 2 * R * tanh / (xi * h * (xi**2 - 1))
    height = -(2 * R / xi) * np.tanh(xi * h / (2 * R))
    every = _all_roots()
    turning = R**2 / 4 + h**2 / 12 - R**2
    turning += (16 * R**3 / h) * float(np.sum(np.tanh(every * h / (2 * R)) / (every**3 * (every**2 - 1))))
    kappa = float(np.interp(h / R, _CYLINDER_DEPTH, _CYLINDER_PEAKING))
    return SurfaceModes(
        omega=_twice(np.sqrt(GRAVITY * xi * tanh / R)),
        mass=_twice(mass),
        height=_twice(height),
        rise=_twice(2 * R / (xi**2 - 1)),
        half=np.array([R, R]),
        peaking=np.array([kappa, kappa]),
        frozen=RigidBody(total, np.array([0.0, 0.0, -0.5 * h]), np.diag([total * turning, total * turning, 0.0])),
        round=True,
        following=float(np.sqrt(GRAVITY * after / R * np.tanh(after * h / R))),
    )


def _box(x: float, y: float, h: float, density: float) -> SurfaceModes:
    sides, total = np.array([x, y]), density * x * y * h
    k = (2 * np.arange(1, MODES + 1)[:, None] - 1) * np.pi / sides
    tanh = np.tanh(k * h)
    # Inertia under a lid, about the centre: Graham and Rodriguez, J. Applied Mechanics 19 (1952) 381.
    odd = 2 * np.arange(1, TERMS + 1) - 1.0
    ratio = h / sides
    series = np.sum(np.tanh(0.5 * odd[:, None] * np.pi * ratio) / odd[:, None] ** 5, axis=0)
    turning = (sides**2 + h**2) / 12 - sides**2 / 3 + 64 / np.pi**5 * sides**3 / h * series
    after = (2 * MODES + 1) * np.pi / sides.max()
    steep = np.tanh(np.pi * h / sides)  # a standing wave to second order: Tadjbakhsh and Keller, JFM 8 (1960) 442
    return SurfaceModes(
        omega=np.sqrt(GRAVITY * k * tanh),
        mass=total * 8 * tanh / (k**3 * sides**2 * h),
        height=-(2 / k) * np.tanh(0.5 * k * h),
        rise=4 / (sides * k**2),
        half=0.5 * sides,
        peaking=np.pi / 16 * (steep + 3 / steep**3),
        frozen=RigidBody(
            total,
            np.array([0.0, 0.0, -0.5 * h]),
            np.diag([total * turning[1], total * turning[0], total * _about_axis(x, y)]),
        ),
        round=False,
        following=float(np.sqrt(GRAVITY * after * np.tanh(after * h))),
    )


def _about_axis(x: float, y: float) -> float:
    """Inertia of a box of liquid about its vertical axis, per mass, m^2: the same series, with the other two sides."""
    odd = 2 * np.arange(1, TERMS + 1) - 1.0
    series = float(np.sum(np.tanh(0.5 * odd * np.pi * y / x) / odd**5))
    return (x**2 + y**2) / 12 - x**2 / 3 + 64 / np.pi**5 * x**3 / y * series


def _twice(values: Array) -> Array:
    return np.repeat(values[:, None], 2, axis=1)


@lru_cache(maxsize=1)
def _all_roots() -> Array:
    from scipy.special import jnp_zeros

    return np.asarray(jnp_zeros(1, TERMS), dtype=float)
