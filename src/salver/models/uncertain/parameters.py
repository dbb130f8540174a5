"""Uncertain parameters and the set they lie in: eq (8) of the paper.

The parameters a user speaks of (mass, centre of mass, inertia about it) are not the inertial parameters
phi in which the dynamics are linear: `phi_of` maps one to the other exactly, `phi_jacobian` to first order.
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
INNER_QUANTITIES = ("fill", "length", "damping")  # of what moves inside an object

SetKind = Literal["box", "ellipsoid"]


@dataclass(frozen=True)
class Parameter:
    """One parameter that may be uncertain; `name` is its name in files and commands.

    owner: the object it belongs to; "" for the tray (tilt), and for the parameters of a model of one's own.
    kind: mass, com, inertia, friction, position, fill, length, damping or tilt; whatever else, of one's own. axis: ""
    for a scalar. lone: whether its object is the only one, so that the name can leave it out."""

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
        """Place among the ten of `INERTIAL`; None for what does not act through the object's inertia."""
        return INERTIAL.index(self.quantity) if self.quantity in INERTIAL else None

    @property
    def loads(self) -> bool:
        """Whether the wrench depends on it that a rigid load needs."""
        return self.kind not in ("friction", "damping")

    @property
    def places(self) -> bool:
        """Whether it says where things are, not what they are."""
        return self.kind in ("position", "tilt")


TILT = (Parameter("", "tilt", "x"), Parameter("", "tilt", "y"))


def parameters_of(owner: str, lone: bool) -> tuple[Parameter, ...]:
    """All parameters of one object that may be uncertain."""
    return tuple(Parameter(owner, kind, axis, lone) for kind, axes in _AXES.items() for axis in axes)


def all_parameters(objects: Sequence[str]) -> tuple[Parameter, ...]:
    """All parameters of objects on a tray that may be uncertain."""
    return (*(p for owner in objects for p in parameters_of(owner, len(objects) == 1)), *TILT)


def parse(name: str, objects: Sequence[str]) -> Parameter:
    """The parameter with a name from a file or a command. Raises ValueError when these objects have none such."""
    for parameter in all_parameters(objects):
        if parameter.name == name:
            return parameter
    raise ValueError(f'there is no parameter "{name}" of {", ".join(objects)}')


@dataclass(frozen=True)
class Vibration:
    """How the tray shakes beside its motion: sinusoids up to a frequency, Hz, that shift it by up to an amplitude, m,
    in any direction, and turn it by up to `tilt`, rad, about any axis through the origin of E."""

    amplitude: float
    tilt: float
    frequency: float

    @property
    def acceleration(self) -> float:
        """m/s^2, most by which the specific force at E changes: A (2 pi f)^2, and of the weight what leans."""
        return self.amplitude * (2 * np.pi * self.frequency) ** 2 + self.tilt * float(np.linalg.norm(GRAVITY_S))

    @property
    def angular_acceleration(self) -> float:
        """rad/s^2, largest."""
        return self.tilt * (2 * np.pi * self.frequency) ** 2

    def support(self, rows: Array) -> Array:
        """(...) most that it adds to rows (..., 12) over what E feels. What its velocity does to a tray that turns is a
        quarter of a cycle late, and below a hundredth of that."""
        force, turn = (np.linalg.norm(rows[..., k : k + 3], axis=-1) for k in (0, 3))
        return np.asarray(self.acceleration * force + self.angular_acceleration * turn)

    @property
    def words(self) -> str:
        """Such as "0.02 mm at up to 20 Hz"."""
        each = ((1e3 * self.amplitude, " mm"), (np.rad2deg(self.tilt), " deg"))
        return f"{' and '.join(f'{x:.3g}{unit}' for x, unit in each if x) or '0 mm'} at up to {self.frequency:.3g} Hz"


def unshaken() -> str:
    """What is left out where nothing is said of how the tray shakes, in words."""
    usual = Vibration(2e-5, 0.0, 20.0)
    share = 100 * usual.acceleration / float(np.linalg.norm(GRAVITY_S))
    return f"vibration of the tray ({usual.words} pushes with {share:.2g} % of the weight; uncertainty.shake counts it)"


@dataclass(frozen=True)
class UncertainSet:
    """Which parameters are uncertain and how far they may lie from nominal.

    parameters: n_p of them. nominal, half_range: (n_p,) in the parameter's own unit.
    kind: "box" (eq 8: each within its range, all corners possible) or "ellipsoid" (eq 9).
    correlation: (n_p, n_p) unit-diagonal matrix, for an ellipsoid only; the identity is the paper's W.
    shake: how the tray shakes, whatever the parameters; None for not at all.
    """

    parameters: tuple[Parameter, ...]
    nominal: Array
    half_range: Array
    kind: SetKind = "box"
    correlation: Array | None = None
    shake: Vibration | None = None

    @classmethod
    def named(cls, names: Sequence[str], nominal: Array, half_range: Array) -> Self:
        """A box of parameters of a model of one's own, which only their names tell apart."""
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
        """(n_p, n_p) A with W = A A^T: parameters are nominal + A s, with s in the unit box or unit ball."""
        scale = np.diag(self.half_range)
        if self.correlation is None:
            return scale
        return scale @ np.linalg.cholesky(self.correlation)

    @property
    def spread(self) -> Array | None:
        """The factor in half-ranges (n_p, n_p): A A^T is the correlation of an ellipsoid; None for a box."""
        if self.kind == "box":
            return None
        return np.eye(self.size) if self.correlation is None else np.asarray(np.linalg.cholesky(self.correlation))

    def restricted(self, parameters: Collection[Parameter]) -> UncertainSet:
        """The same set seen in some of its parameters (projection), on a tray that does not shake."""
        keep = [i for i, parameter in enumerate(self.parameters) if parameter in parameters]
        correlation = None if self.correlation is None else self.correlation[np.ix_(keep, keep)]
        return UncertainSet(
            tuple(self.parameters[i] for i in keep), self.nominal[keep], self.half_range[keep], self.kind, correlation
        )


def support(terms: Array, spread: Array | None, axis: int = -1) -> Array:
    """Support function of the set, h(x) = max over s of x . s: the largest that `terms`, slopes by each parameter per
    half-range along an axis, can add.

    spread: None for the unit box, h = sum_k |x_k|; A (n_p, n_p) for the ellipsoid A s of the unit ball, h = |A^T x|.
    """
    if spread is None:
        return np.asarray(np.abs(terms).sum(axis=axis))
    return np.asarray(np.linalg.norm(np.moveaxis(terms, axis, -1) @ spread, axis=-1))


NOTHING = UncertainSet((), np.zeros(0), np.zeros(0))
"""The set of somebody who knows everything."""


def inertial_vector(body: RigidBody) -> Array:
    """Values (10,) of `INERTIAL` for a body: mass, com_B, inertia about the centre of mass."""
    return np.concatenate([[body.mass], body.com_B, inertia_entries(body.inertia_com)])


def phi_of(inertial: Array) -> Array:
    """Inertial parameters phi (..., 10) from values (..., 10) of `INERTIAL`, exactly."""
    mass, c = inertial[..., 0], inertial[..., 1:4]
    moment = mass[..., None] * c
    inertia_B = inertial[..., 4:] + inertia_entries(parallel_axis(mass, c))
    return np.concatenate([mass[..., None], moment, inertia_B], axis=-1)


def phi_jacobian(body: RigidBody, owner: str, parameters: Sequence[Parameter]) -> Array:
    """d phi / d p (10, n_p) at the body of `owner`, whose centre of mass is the origin of B.

    There c = 0, so a shift of the centre of mass changes m c to first order and I about B not at all.
    What is another object's or does not act through the dynamics (friction, ...) has a column of zeros.
    """
    jacobian = np.zeros((10, len(parameters)))
    for column, parameter in enumerate(parameters):
        if parameter.owner == owner and parameter.entry is not None:
            jacobian[parameter.entry, column] = body.mass if parameter.kind == "com" else 1.0
    return jacobian


def tilt_at(deviation: Mapping[Parameter, float]) -> Array:
    """(3, 3) axes of the real tray in the assumed E."""
    return exp(np.array([*(deviation.get(tilt, 0.0) for tilt in TILT), 0.0]))
