"""Insides of open containers: their walls, and the modes of a liquid in them at a fill.

A container is `Round`, an upright cylinder or a cone that widens upwards, or `Rectangle`; another kind is another
`Interior`."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

import numpy as np

from salver.dynamics.liquid.axisymmetric import sloshing
from salver.geometry import GRAVITY, Array
from salver.models.load_dynamics import Modes
from salver.models.rigid_body import RigidBody
from salver.models.shapes import shapes
from salver.models.shapes.shapes import Solid

MODES = 2  # dynamic modes of each lateral axis
# Largest increase of a wall's radius per height. Further out waves of 0.05 R break in nonlinear potential flow, and the
# second mode's mass vanishes high above the liquid, where the physics engine fails.
LEANING_WALL = 0.5
TERMS = 24  # of series that converge with the fourth power or faster
TILTING = 1.3  # rise by fast tilting, relative to Omega^2 R^2 / g, in nonlinear potential flow
# A free wave in a cylinder that is 0.3 R high, by nonlinear potential flow: depth over R, kappa.
_CYLINDER_DEPTH = np.array([0.35, 0.5, 0.65, 0.8, 1.0, 1.5, 2.0])
_CYLINDER_PEAKING = np.array([3.6, 3.0, 2.2, 1.75, 1.46, 1.25, 1.22])


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


class Interior(ABC):
    """The inside of an open container with straight walls. Heights are over its bottom, m.

    round: whether its modes are those of both axes alike, so that the container turns about its axis without them.
    """

    round: ClassVar[bool]
    slope: float = 0.0

    @abstractmethod
    def half(self, height: float) -> Array:
        """R (2,), m: the radius, or half of each side, at a height."""

    @abstractmethod
    def modes(self, fill: float, density: float) -> SurfaceModes:
        """The modes at a fill, m, of a liquid of a density, kg/m^3."""

    @abstractmethod
    def outline(self, height: float) -> Array:
        """Corners (n, 2) of the wall at a height, counter-clockwise, relative to the axis, m."""

    @abstractmethod
    def solid(self, height: float) -> Solid:
        """The inside up to a height as a solid."""

    def level_rise(self, fill: float, rise: float) -> float:
        """Height at the wall by linear theory, at the radius R of the level surface, m, of a plane surface that touches
        the wall `rise` above the level.

        The wall leans out by t = `slope`, and a plane of inclination a keeps the volume of a cone if its highest point
        is (R / t) (sqrt((1 + a t) / (1 - a t)) - 1) above the level, while linear theory says a R. A free wave is less
        inclined at the wall than the plane, by kappa t times its height, and rises less: kappa R t of the first mode is
        below 0.7 up to `LEANING_WALL`."""
        share = rise * self.slope / float(self.half(fill).min())
        return rise * (2 + share) / (1 + (1 + share) ** 2)


@dataclass(frozen=True)
class Round(Interior):
    """An upright cylinder, or a cone. radius: at the bottom, m. slope: its increase per height."""

    radius: float
    slope: float = 0.0
    round: ClassVar[bool] = True

    def half(self, height: float) -> Array:
        return np.repeat(self.radius + self.slope * height, 2)

    def outline(self, height: float, corners: int = 32) -> Array:
        angle = np.linspace(0, 2 * np.pi, corners, endpoint=False)
        return np.asarray((self.radius + self.slope * height) * np.stack([np.cos(angle), np.sin(angle)], axis=1))

    def solid(self, height: float) -> Solid:
        return shapes.cone(self.radius, self.radius + self.slope * height, height)

    def modes(self, fill: float, density: float) -> SurfaceModes:
        return _round(self, fill, density)


@lru_cache(maxsize=1024)
def _round(inside: Round, fill: float, density: float) -> SurfaceModes:
    R, liquid = float(inside.half(fill)[0]), inside.solid(fill)
    found = sloshing(R, inside.slope, fill, MODES + 1)
    kappa, mass, height, rise = (x[:MODES] for x in (found.kappa, found.volume, found.height, found.rise))
    total, centre = density * liquid.volume, liquid.centroid_G[2] - 0.5 * fill
    turning = density * found.inertia - total * centre**2
    # Of a cone that of the cylinder with its surface and depth, whose free waves crest higher (docs/liquids.md).
    peaking = np.interp(fill / R, _CYLINDER_DEPTH, _CYLINDER_PEAKING)
    return SurfaceModes(
        omega=_twice(np.sqrt(GRAVITY * kappa)),
        mass=_twice(density * mass),
        height=_twice(height),
        rise=_twice(rise),
        half=np.array([R, R]),
        peaking=np.array([peaking, peaking]),
        frozen=RigidBody(total, np.array([0.0, 0.0, centre]), np.diag([turning, turning, 0.0])),
        round=True,
        following=float(np.sqrt(GRAVITY * found.kappa[MODES])),
    )


def _twice(values: Array) -> Array:
    return np.repeat(values[:, None], 2, axis=1)


@dataclass(frozen=True)
class Rectangle(Interior):
    """An upright box. x, y: its sides, m."""

    x: float
    y: float
    round: ClassVar[bool] = False

    def half(self, height: float) -> Array:
        return 0.5 * np.array([self.x, self.y])

    def outline(self, height: float) -> Array:
        return np.asarray(self.half(height) * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]))

    def solid(self, height: float) -> Solid:
        return shapes.box((self.x, self.y, height))

    def modes(self, fill: float, density: float) -> SurfaceModes:
        return _box(self.x, self.y, fill, density)


@lru_cache(maxsize=1024)
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
