"""What moves inside a carried body: a liquid, a pendulum. Its moving masses as modes, and what the body is asked of it.

With O the origin of its frame, z up the body's axis, f the specific force at O and f_S that at a mass's own height
(0, 0, z_n), the place r_n (2,) of mass n across the axis obeys

    r_n'' + 2 zeta omega_n r_n' + (omega_n^2 / g) f_z r_n = -f_S,

and the body must give at O, beside what it would need if nothing moved,

    sum of m_n { force r_n''; moment (0, 0, z_n) x r_n'' + r_n x f }.

Exact to first order for a mass on a light rod of length g / omega_n^2, whatever its pivot does: it accelerates, tilts
or turns. A sloshing mode obeys the same equations.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from salver.geometry import Array
from salver.models.rigid_body import RigidBody
from salver.models.shapes.shapes import Solid

GRAVITY = 9.81  # m/s^2
APART = 0.12  # of frequency, between the values that stand for all of a range
LEAST_WEIGHT = 0.2  # of g that must pull on the masses: with less they do not swing back
THICKEST = 0.1  # of critical damping, to which these modes are known
SQUARE = 1e-6  # share of a mode by which those along both axes differ: less is none


@dataclass(frozen=True, eq=False)
class Modes:
    """Moving masses. Arrays (n_modes, 2): mode, axis x or y.

    omega rad/s. mass kg. height m, z_n of each from O. frozen: all that may move as if it did not, about O. round:
    whether what turns about z does not take the masses along. following: rad/s, the lowest mode of those that follow as
    if at rest; infinite without any.
    """

    omega: Array
    mass: Array
    height: Array
    frozen: RigidBody
    round: bool
    following: float

    @property
    def length(self) -> Array:
        """(n_modes, 2) of pendulums with these frequencies, m."""
        return np.asarray(GRAVITY / self.omega**2)

    @cached_property
    def pendulums(self) -> tuple[tuple[Rod, ...], ...]:
        """Each mode as rods, the first hung in the body, each other in the one before it.

        Along either axis a mode is what has m_n L_n and m_n L_n^2 about a hinge at z_n + L_n, L_n its length. Where
        both axes are alike that is its mass on a spherical pendulum. A box of liquid has other masses, heights and
        lengths along the one side than along the other: there a rod that swings along the longer one carries the hinge
        of the mass that swings along the shorter one, and what it lacks itself."""
        first = 0 if self.length[0, 0] > self.length[0, 1] else 1
        return tuple(_pendulum(first, *mode) for mode in zip(self.mass, self.height, self.length, strict=True))

    @property
    def still(self) -> RigidBody:
        """What is left without the moving masses, about O: when they hang as pendulums. Not always what a solid could
        be: of a long box of liquid under a lid little turns, and its masses hang far apart. Of no mass where all of it
        moves."""
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
    """A point mass, kg, on a light rod that swings on hinges at its pivot: along the body's axes `along` (0, 1), in
    that order. height, pivot: m over O, at rest."""

    mass: float
    height: float
    pivot: float
    along: tuple[int, ...]


def _pendulum(first: int, mass: Array, height: Array, length: Array) -> tuple[Rod, ...]:
    """A mode of which these are by axis; first: the axis along which more of it moves."""
    second, pivot = 1 - first, height + length
    lever = pivot[first] - height[second]
    # What the first rod still lacks about its hinge, when the other mass hangs on it.
    moment = mass[first] * length[first] - mass[second] * lever
    inertia = mass[first] * length[first] ** 2 - mass[second] * lever**2
    if inertia < SQUARE * mass[first] * length[first] ** 2:
        return (Rod(float(mass[second]), float(height[second]), float(pivot[second]), (first, second)),)
    carries = Rod(float(moment**2 / inertia), float(pivot[first] - inertia / moment), float(pivot[first]), (first,))
    return carries, Rod(float(mass[second]), float(height[second]), float(pivot[second]), (second,))


Colour = tuple[float, float, float]
EDGE_COLOUR: Colour = (0.42, 0.47, 0.53)
BEYOND_COLOUR: Colour = (0.89, 0.07, 0.04)


class Drawn(ABC):
    """What moves inside a body as pictures show it, in the body's frame B. beyond: s, when it first went too far."""

    beyond: float | None

    @property
    @abstractmethod
    def colour(self) -> Colour: ...

    @property
    @abstractmethod
    def edge_B(self) -> Array:
        """(n, 3) corners of the closed line that it must not cross."""

    @abstractmethod
    def triangles_B(self, k: int) -> Array:
        """(n_triangles, 3, 3) of it at sample k, counter-clockwise from outside."""

    @abstractmethod
    def page(self, keep: Array) -> dict[str, Any]:
        """What the replay of the page draws, at some samples."""

    def edge_colour(self, t: float) -> Colour:
        """Of the line at time t, s."""
        return BEYOND_COLOUR if self.beyond is not None and t >= self.beyond else EDGE_COLOUR


class LoadDynamics(ABC):
    """What moves inside a body.

    quantity: the kind of its uncertain parameter beside damping ("fill"), in m. noun, measure: what it is and what of
    it is measured, in words ("liquid", "wave"). outcome: what it does that moves too far, "spills" or "swings".
    damping: least and most, of critical."""

    quantity: ClassVar[str]
    noun: ClassVar[str]
    measure: ClassVar[str] = "swing"
    outcome: ClassVar[str] = "swings"
    chart: ClassVar[tuple[str, str, str]] = ("Swing of", "aside, mm", "room")  # title, axis, edge
    damping: tuple[float, float]

    @property
    @abstractmethod
    def value(self) -> float:
        """Nominal value of the quantity, m."""

    @property
    @abstractmethod
    def response(self) -> type[Any]:
        """The kind of `salver.dynamics.load_response.LoadResponse` that it has."""

    @abstractmethod
    def modes(self, value: float) -> Modes:
        """Its moving masses at a value of the quantity. Raises ValueError for one that cannot be."""

    @abstractmethod
    def origin(self, base: float, value: float) -> float:
        """Height of O where the base of the body is at a height, m."""

    @abstractmethod
    def room(self, value: float) -> float:
        """m to which it may move: its size in `seen`; infinite for as far as it likes."""

    def at_rest(self, value: float, slope: Array) -> Array:
        """(T, 2) m, where `seen` has it at rest under a slope (T, 2), f / f_z."""
        hung = np.repeat(-slope[:, None], len(self.modes(value).omega), axis=1)
        return self.seen(value, hung, slope, np.zeros(len(slope)))[:, :2]

    def extent(self, value: float, places: Array) -> Array:
        """(T,) m of places (T, 2) as of `seen`."""
        return np.asarray(np.linalg.norm(places, axis=-1))

    def away(self, value: float, places: Array, slope: Array) -> Array:
        """(T,) m by which it is away at places (T, 2) from where it would be at rest under a slope (T, 2), f / f_z."""
        return self.extent(value, places - self.at_rest(value, slope))

    @abstractmethod
    def seen(self, value: float, incline: Array, slope: Array, turning: Array) -> Array:
        """(T, 3) m, what is recorded of a run in the physics engine: a place along x and y, and its size, that of
        `edge`.

        incline (T, n_modes, 2): of the rods, r_n over their length. slope (T, 2): f / f_z. turning (T,): Omega^2 across
        the axis, 1/s^2.
        """

    @abstractmethod
    def drawn(self, body: Any, value: float, seen: Array, beyond: float | None) -> Drawn:
        """As pictures show it in a body at places (T, 2) as of `seen`. beyond: s, when it first was over its edge."""

    @property
    def open(self) -> bool:
        """Whether its body has no top."""
        return False

    def edge(self, value: float) -> float:
        """m, the size in `seen` beyond which what it must not do has happened (`outcome`)."""
        return self.room(value)

    def check_value(self, owner: str, value: float) -> None:
        """Raise ValueError for a value that cannot be, in one sentence; owner: name of the body."""
        if value <= 0:
            raise ValueError(f"{self.quantity} of {owner} = {value:g} m; it must be above 0.")

    def shell(self, solid: Solid) -> tuple[Array, Array]:
        """(3,) centre of mass of the uniform body that it moves in, from the centre of its solid, and (3, 3) inertia
        about that, per mass."""
        return np.zeros(3), solid.unit_inertia

    def unmodelled(self, owner: str) -> str:
        """Parts of its motion that are not modelled, in words; owner: name of the body."""
        return ""

    @property
    def event(self) -> str:
        """Key of the time of `outcome` in the summary of a run."""
        return f"first_{self.outcome.removesuffix('s')}"

    @property
    def peak(self) -> str:
        """Key of the largest size in the summary of a run."""
        return f"peak_{self.measure}"

    @property
    def nominal_damping(self) -> float:
        return 0.5 * sum(self.damping)

    def cases(self, least: float, most: float, apart: float = APART) -> list[tuple[float, float]]:
        """(value, damping) that stand for all between `least` and `most` m: equally spaced in frequency, at most
        `apart` of it, so that the phase of no mode is far from a known one, and both ends of the damping."""
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
