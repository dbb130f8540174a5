"""Uncertain parameters and their set: eq (8) of the paper.

Users give mass, centre of mass and the inertia about it, whereas the dynamics are linear in the inertial parameters
phi: `phi_of` maps the former to phi exactly, `phi_jacobian` to first order.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal, Self

import numpy as np

from salver.geometry import GRAVITY_S, Array, exp
from salver.models.rigid_body import RigidBody, inertia_entries, parallel_axis

INERTIAL = ("mass", "com_x", "com_y", "com_z", *(f"inertia_{s}" for s in ("xx", "xy", "yy", "xz", "yz", "zz")))
_AXES = {
    "mass": ("",),
    "com": ("x", "y", "z"),
    "inertia": ("xx", "xy", "yy", "xz", "yz", "zz"),
    "friction": ("",),
    "position": ("x", "y"),
    "fill": ("",),
    "length": ("",),
    "damping": ("",),
}
INNER_QUANTITIES = ("fill", "length", "damping")  # parameters of a liquid or a pendulum

SetKind = Literal["box", "ellipsoid"]


@dataclass(frozen=True)
class Parameter:
    """One parameter that may be uncertain; `name` is its name in files and commands.

    owner: name of the object; "" for the tray (tilt, friction of its rim) and for parameters of a user-defined model.
    kind: mass, com, inertia, friction, position, fill, length, damping or tilt; or any name in a user-defined model.
    axis: "" for a scalar. lone: whether its object is the only one, so that `name` has no prefix."""

    owner: str
    kind: str
    axis: str = ""
    lone: bool = field(default=False, compare=False)

    @property
    def quantity(self) -> str:
        """The name without its owner: "mass", "com_x"."""
        return f"{self.kind}_{self.axis}" if self.axis else self.kind

    @cached_property
    def name(self) -> str:
        """Such as "cup1.com_x"; "com_x" when there is one object, "tilt_x" of the tray."""
        return self.quantity if self.lone or not self.owner else f"{self.owner}.{self.quantity}"

    @cached_property
    def entry(self) -> int | None:
        """Index in `INERTIAL`; None for a parameter that is not in it."""
        return INERTIAL.index(self.quantity) if self.quantity in INERTIAL else None

    @property
    def loads(self) -> bool:
        """Whether the wrench that a rigid load needs depends on it."""
        return self.kind not in ("friction", "damping")

    @property
    def places(self) -> bool:
        """Whether the parameter is a position or a tilt."""
        return self.kind in ("position", "tilt")


TILT = (Parameter("", "tilt", "x"), Parameter("", "tilt", "y"))
RIM = Parameter("", "friction", "rim")


def parameters_of(owner: str, lone: bool) -> tuple[Parameter, ...]:
    """All parameters of one object that can be uncertain."""
    return tuple(Parameter(owner, kind, axis, lone) for kind, axes in _AXES.items() for axis in axes)


def all_parameters(objects: Sequence[str]) -> tuple[Parameter, ...]:
    """All parameters of the objects and the tray that can be uncertain."""
    return (*(p for owner in objects for p in parameters_of(owner, len(objects) == 1)), RIM, *TILT)


def parse(name: str, objects: Sequence[str]) -> Parameter:
    """The parameter with a name from a file or a command. Raises ValueError when the objects have no such parameter."""
    for parameter in all_parameters(objects):
        if parameter.name == name:
            return parameter
    raise ValueError(f'there is no parameter "{name}" of {", ".join(objects)}')


@dataclass(frozen=True)
class Vibration:
    """Vibration of the tray on top of its motion: sinusoids up to `frequency`, Hz, with displacements up to
    `amplitude`, m, in any direction, and rotations up to `tilt`, rad, about any axis through the origin of E."""

    amplitude: float
    tilt: float
    frequency: float

    @property
    def acceleration(self) -> float:
        """Largest change of the specific force at E, m/s^2: A (2 pi f)^2, plus gravity on the rotated tray."""
        return self.amplitude * (2 * np.pi * self.frequency) ** 2 + self.tilt * float(np.linalg.norm(GRAVITY_S))

    @property
    def angular_acceleration(self) -> float:
        """Largest angular acceleration, rad/s^2."""
        return self.tilt * (2 * np.pi * self.frequency) ** 2

    def support(self, rows: Array) -> Array:
        """Largest change (...) of row . w for rows (..., 12), with w the motion regressor of E.

        Products of its angular velocity with that of the tray are neglected: they lag by a quarter of a cycle, and are
        below a hundredth of it.
        """
        force, turn = (np.linalg.norm(rows[..., k : k + 3], axis=-1) for k in (0, 3))
        return np.asarray(self.acceleration * force + self.angular_acceleration * turn)

    def covers(self, other: Vibration) -> bool:
        """Whether another vibration accelerates the tray no more than this one may."""
        return other.acceleration <= self.acceleration and other.angular_acceleration <= self.angular_acceleration

    @property
    def words(self) -> str:
        """Such as "0.02 mm at up to 20 Hz"."""
        each = ((1e3 * self.amplitude, " mm"), (np.rad2deg(self.tilt), " deg"))
        return f"{' and '.join(f'{x:.3g}{unit}' for x, unit in each if x) or '0 mm'} at up to {self.frequency:.3g} Hz"


def unshaken() -> str:
    """The note that vibration of the tray is not checked, for scenarios without uncertainty.shake."""
    usual = Vibration(2e-5, 0.0, 20.0)
    share = 100 * usual.acceleration / float(np.linalg.norm(GRAVITY_S))
    return f"vibration of the tray ({usual.words} pushes with {share:.2g} % of the weight; uncertainty.shake counts it)"


@dataclass(frozen=True)
class UncertainSet:
    """The set of uncertain parameters.

    parameters: n_p of them. nominal, half_range: (n_p,) in SI units.
    kind: "box" (eq 8: each within its range, all corners possible) or "ellipsoid" (eq 9).
    correlation: (n_p, n_p) matrix with unit diagonal, for an ellipsoid only; the identity is the paper's W.
    shake: vibration of the tray, independent of the parameters; None for no vibration.
    """

    parameters: tuple[Parameter, ...]
    nominal: Array
    half_range: Array
    kind: SetKind = "box"
    correlation: Array | None = None
    shake: Vibration | None = None

    @classmethod
    def named(cls, names: Sequence[str], nominal: Array, half_range: Array) -> Self:
        """A box of parameters with any names, for a user-defined model."""
        return cls(tuple(Parameter("", name) for name in names), nominal, half_range)

    @property
    def size(self) -> int:
        return len(self.parameters)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(p.name for p in self.parameters)

    @property
    def ranges(self) -> dict[Parameter, float]:
        """Half-range of each parameter."""
        return dict(zip(self.parameters, self.half_range.tolist(), strict=True))

    @property
    def factor(self) -> Array:
        """A (n_p, n_p) with W = A A^T: parameters are nominal + A s, with s in the unit box or unit ball."""
        scale = np.diag(self.half_range)
        if self.correlation is None:
            return scale
        return scale @ np.linalg.cholesky(self.correlation)

    @property
    def spread(self) -> Array | None:
        """`factor` in half-ranges (n_p, n_p): A A^T is the correlation of an ellipsoid; None for a box."""
        if self.kind == "box":
            return None
        return np.eye(self.size) if self.correlation is None else np.asarray(np.linalg.cholesky(self.correlation))

    def restricted(self, parameters: Collection[Parameter]) -> UncertainSet:
        """The projection of the set to some of its parameters, without vibration of the tray."""
        keep = [i for i, parameter in enumerate(self.parameters) if parameter in parameters]
        correlation = None if self.correlation is None else self.correlation[np.ix_(keep, keep)]
        return UncertainSet(
            tuple(self.parameters[i] for i in keep), self.nominal[keep], self.half_range[keep], self.kind, correlation
        )


def support(terms: Array, spread: Array | None, axis: int = -1) -> Array:
    """Support function of the uncertain set, h(x) = max over s of x . s, for `terms` x along an axis.

    terms: derivatives by each parameter, per half-range. spread: None for the unit box, h = sum_k |x_k|; A (n_p, n_p)
    for the ellipsoid A s with s in the unit ball, h = |A^T x|.
    """
    if spread is None:
        return np.asarray(np.abs(terms).sum(axis=axis))
    return np.asarray(np.linalg.norm(np.moveaxis(terms, axis, -1) @ spread, axis=-1))


NOTHING = UncertainSet((), np.zeros(0), np.zeros(0))
"""The set without uncertain parameters."""


def inertial_vector(body: RigidBody) -> Array:
    """Values (10,) of `INERTIAL` for a body: mass, com_B, inertia about the centre of mass."""
    return np.concatenate([[body.mass], body.com_B, inertia_entries(body.inertia_com)])


def phi_of(inertial: Array) -> Array:
    """Exact inertial parameters phi (..., 10) from values (..., 10) of `INERTIAL`."""
    mass, c = inertial[..., 0], inertial[..., 1:4]
    moment = mass[..., None] * c
    inertia_B = inertial[..., 4:] + inertia_entries(parallel_axis(mass, c))
    return np.concatenate([mass[..., None], moment, inertia_B], axis=-1)


def phi_jacobian(body: RigidBody, owner: str, parameters: Sequence[Parameter]) -> Array:
    """d phi / d p (10, n_p) of a body named `owner`, whose centre of mass is the origin of B.

    There c = 0, so that a shift of the centre of mass changes m c to first order, and I about B only to second order.
    Parameters of other objects, and those that do not act through phi (friction, ...), have columns of zeros.
    """
    jacobian = np.zeros((10, len(parameters)))
    for column, parameter in enumerate(parameters):
        if parameter.owner == owner and parameter.entry is not None:
            jacobian[parameter.entry, column] = body.mass if parameter.kind == "com" else 1.0
    return jacobian


def tilt_at(deviation: Mapping[Parameter, float]) -> Array:
    """Rotation (3, 3) of the real tray in the assumed E, at a deviation of the uncertain parameters."""
    return exp(np.array([*(deviation.get(tilt, 0.0) for tilt in TILT), 0.0]))
