"""Dynamics of a liquid or a pendulum inside a body: moving masses, described by modes.

O is the origin of the dynamics, z the body's axis (up), f the specific force at O and f_S that at the height
(0, 0, z_n) of a mass. The displacement r_n (2,) of mass n across the axis obeys

    r_n'' + 2 zeta omega_n r_n' + (omega_n^2 / g) f_z r_n = -f_S,

and the body needs at O, in addition to its wrench with the masses fixed,

    sum of m_n { force r_n''; moment (0, 0, z_n) x r_n'' + r_n x f }.

This is exact to first order for a mass on a light rod of length g / omega_n^2 whose pivot accelerates, tilts and
rotates. A sloshing mode obeys the same equations.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from salver.geometry import GRAVITY, Array
from salver.models.rigid_body import RigidBody
from salver.models.shapes.shapes import Solid

APART = 0.12  # largest relative step in frequency between the values that represent a range
LEAST_WEIGHT = 0.2  # least specific force along the axis, as a share of g; with less the masses do not swing back
THICKEST = 0.1  # largest damping, as a share of critical, for which the modes are valid


@dataclass(frozen=True, eq=False)
class Modes:
    """Moving masses. Arrays (n_modes, 2) are for each mode and axis, x or y.

    omega: rad/s. mass: kg. height: m, z_n of each mass over O. frozen: the liquid or pendulum at rest, as a rigid body
    about O. round: whether a rotation about z leaves the masses behind. following: rad/s, the lowest frequency of the
    modes that are taken to follow quasi-statically; infinite if there are none.
    """

    omega: Array
    mass: Array
    height: Array
    frozen: RigidBody
    round: bool
    following: float

    @property
    def length(self) -> Array:
        """Lengths (n_modes, 2) of pendulums with these frequencies, m."""
        return np.asarray(GRAVITY / self.omega**2)

    @cached_property
    def pendulums(self) -> tuple[tuple[Rod, ...], ...]:
        """Each mode as one or two rods; the first hangs in the body, the second on the first.

        Along each axis a mode has the moments m_n L_n and m_n L_n^2 about a hinge at z_n + L_n, with L_n its length. If
        both axes are equal, it is a spherical pendulum. A box of liquid has different masses, heights and lengths along
        its sides: a rod that swings along one axis carries the hinge of the mass that swings along the other, and a
        mass for the remaining moments."""
        first = 0 if self.length[0, 0] > self.length[0, 1] else 1
        return tuple(_pendulum(first, *mode) for mode in zip(self.mass, self.height, self.length, strict=True))

    @property
    def still(self) -> RigidBody:
        """The part that does not move, about O, when the modes are `pendulums`; zero if everything moves.

        Its inertia need not be that of a solid, for example for a long box of liquid under a lid."""
        mass, height = np.array([(rod.mass, rod.height) for rods in self.pendulums for rod in rods]).T
        left = self.frozen.mass - float(mass.sum())
        if left <= 0.0:
            return RigidBody(0.0, np.zeros(3), np.zeros((3, 3)))
        z = (self.frozen.mass * self.frozen.com_B[2] - float(mass @ height)) / left
        about_O = np.diag(self.frozen.inertia_com)[:2] + self.frozen.mass * self.frozen.com_B[2] ** 2
        lateral = about_O - mass @ height**2 - left * z**2
        return RigidBody(left, np.array([0.0, 0.0, z]), np.diag([*lateral, self.frozen.inertia_com[2, 2]]))


@dataclass(frozen=True)
class Rod:
    """A point mass, kg, on a light rod, with hinges at its pivot that swing along the body's axes `along` (0 or 1).

    height, pivot: m over O, at rest.
    """

    mass: float
    height: float
    pivot: float
    along: tuple[int, ...]


def _pendulum(first: int, mass: Array, height: Array, length: Array, square: float = 1e-6) -> tuple[Rod, ...]:
    """The rods of a mode with these values by axis; first: the axis with the longer pendulum. square: relative
    difference below which both axes count as equal."""
    second, pivot = 1 - first, height + length
    lever = pivot[first] - height[second]
    # Moments about its hinge that the first rod needs besides those of the mass that hangs on it.
    moment = mass[first] * length[first] - mass[second] * lever
    inertia = mass[first] * length[first] ** 2 - mass[second] * lever**2
    if inertia < square * mass[first] * length[first] ** 2:
        return (Rod(float(mass[second]), float(height[second]), float(pivot[second]), (first, second)),)
    carries = Rod(float(moment**2 / inertia), float(pivot[first] - inertia / moment), float(pivot[first]), (first,))
    return carries, Rod(float(mass[second]), float(height[second]), float(pivot[second]), (second,))


Colour = tuple[float, float, float]


class Drawn(ABC):
    """Drawing of the liquid or pendulum in a body, in B. beyond: s, when it first crossed its edge, or None.

    edge_colours: of the edge until then, and from then on.
    """

    edge_colours: ClassVar[tuple[Colour, Colour]] = (0.42, 0.47, 0.53), (0.89, 0.07, 0.04)
    beyond: float | None

    @property
    @abstractmethod
    def colour(self) -> Colour: ...

    @property
    @abstractmethod
    def edge_B(self) -> Array:
        """Corners (n, 3) of the closed line that it must not cross, m."""

    @abstractmethod
    def triangles_B(self, k: int) -> Array:
        """Its triangles (n_triangles, 3, 3) at sample k, m, counter-clockwise from outside."""

    @abstractmethod
    def page(self, keep: Array) -> dict[str, Any]:
        """Data of the drawing for the replay of a page, at some samples."""

    def edge_colour(self, t: float) -> Colour:
        """Colour of the edge at time t, s."""
        return self.edge_colours[int(self.beyond is not None and t >= self.beyond)]


class LoadDynamics(ABC):
    """The dynamics of a liquid or a pendulum inside a body.

    quantity: kind of its uncertain parameter besides damping, in m ("fill"). noun: its name ("liquid"). measure: name
    of its displacement ("wave"). outcome: name of its failure, "spills" or "swings". damping: least and largest, as
    shares of critical.
    """

    quantity: ClassVar[str]
    noun: ClassVar[str]
    measure: ClassVar[str] = "swing"
    outcome: ClassVar[str] = "swings"
    chart: ClassVar[tuple[str, str, str]] = ("Swing of", "aside, mm", "room")  # title, axis, edge
    damping: tuple[float, float]

    @property
    def value(self) -> float:
        """Nominal value of the quantity, m."""
        return float(getattr(self, self.quantity))

    @property
    @abstractmethod
    def response(self) -> type[Any]:
        """Its subclass of `salver.dynamics.load_response.LoadResponse`."""

    @abstractmethod
    def modes(self, value: float) -> Modes:
        """Its moving masses at a value of the quantity, m. Raises ValueError for an impossible value."""

    @abstractmethod
    def origin(self, base: float, value: float) -> float:
        """Height of O, m, when the base of the body is at height `base`, m."""

    @abstractmethod
    def room(self, value: float) -> float:
        """Largest allowed displacement, m, compared with the size in `seen`; infinite without a limit."""

    def at_rest(self, value: float, slope: Array) -> Array:
        """Position (T, 2) of `seen`, m, at rest under a specific force with slope (T, 2), f / f_z."""
        hung = np.repeat(-slope[:, None], len(self.modes(value).omega), axis=1)
        return self.seen(value, hung, slope, np.zeros(len(slope)))[:, :2]

    def extent(self, value: float, places: Array) -> Array:
        """Distance (T,), m, from the axis of positions (T, 2) as `seen` returns them."""
        return np.asarray(np.linalg.norm(places, axis=-1))

    def away(self, value: float, places: Array, slope: Array) -> Array:
        """Displacement (T,), m, of positions (T, 2) from those at rest under a slope (T, 2), f / f_z."""
        return self.extent(value, places - self.at_rest(value, slope))

    @abstractmethod
    def seen(self, value: float, incline: Array, slope: Array, turning: Array) -> Array:
        """Record (T, 3) of a run in the physics engine, m: position along x and y, and its size, as limited by `edge`.

        incline (T, n_modes, 2): slopes of the rods, r_n over their length. slope (T, 2): f / f_z. turning (T,): squared
        angular velocity across the axis, 1/s^2.
        """

    @abstractmethod
    def drawn(self, body: Any, value: float, seen: Array, beyond: float | None) -> Drawn:
        """Its drawing in a body at positions (T, 2) as in `seen`. beyond: s, when it first crossed its edge."""

    @property
    def open(self) -> bool:
        """Whether the body that contains the dynamics is open at the top."""
        return False

    def edge(self, value: float) -> float:
        """Size in `seen`, m, above which a run counts as failed (`outcome`)."""
        return self.room(value)

    def check_value(self, owner: str, value: float) -> None:
        """Raise ValueError, one sentence, for an impossible value; owner: name of the body."""
        if value <= 0:
            raise ValueError(f"{self.quantity} of {owner} = {value:g} m; it must be above 0.")

    def shell(self, solid: Solid) -> tuple[Array, Array]:
        """Centre of mass (3,) from the solid's centroid, and inertia (3, 3) about it per mass, of its container."""
        return np.zeros(3), solid.unit_inertia

    def unmodelled(self, owner: str) -> str:
        """Parts of its motion that are not modelled, in words; owner: name of the body."""
        return ""

    @property
    def event(self) -> str:
        """Key in the summary of a run for the time of `outcome`."""
        return f"first_{self.outcome.removesuffix('s')}"

    @property
    def peak(self) -> str:
        """Key in the summary of a run for the largest size."""
        return f"peak_{self.measure}"

    @property
    def nominal_damping(self) -> float:
        return 0.5 * sum(self.damping)

    def cases(self, least: float, most: float, apart: float = APART) -> list[tuple[float, float]]:
        """Pairs (value, damping) that represent all values from `least` to `most`, m, at both ends of the damping.

        Values are equally spaced in frequency, in relative steps of at most `apart`, so that every phase of a mode is
        near that of a represented one.
        """
        low, high = sorted(float(self.modes(value).omega[0].min()) for value in (least, most))
        count = 1 if most - least < 1e-9 else 2 + int((high / low - 1) / apart)
        values = self._at_frequencies(least, most, np.linspace(low, high, count)) if count > 1 else [least]
        return [(value, damping) for value in values for damping in dict.fromkeys(self.damping)]

    def _at_frequencies(self, least: float, most: float, wanted: Array) -> list[float]:
        values = np.linspace(least, most, 201)
        omega = np.array([self.modes(float(value)).omega[0].min() for value in values])
        order = np.argsort(omega)
        found = [float(np.interp(w, omega[order], values[order])) for w in wanted]
        return [least, *sorted(found)[1:-1], most]
