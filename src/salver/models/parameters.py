"""Named uncertain parameters and the set they lie in: eq (8) of the paper.

The parameters a user speaks of (mass, centre of mass, inertia about it) are not the inertial parameters
phi in which the dynamics are linear: `phi_of` maps one to the other exactly, `phi_jacobian` to first order.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from salver.geometry import Array
from salver.models.rigid_body import RigidBody, inertia_entries, parallel_axis

COM = ("com_x", "com_y", "com_z")
INERTIA = tuple(f"inertia_{s}" for s in ("xx", "xy", "yy", "xz", "yz", "zz"))
INERTIAL = ("mass", *COM, *INERTIA)
OTHER = ("friction", "position_x", "position_y", "tilt_x", "tilt_y")
NAMES = (*INERTIAL, *OTHER)

SetKind = Literal["box", "ellipsoid"]


@dataclass(frozen=True)
class UncertainSet:
    """Which parameters are uncertain and how far they may lie from nominal.

    names: n_p names, of `NAMES`, with an `object.` prefix when there are several objects.
    nominal, half_range: (n_p,) in the parameter's own unit.
    kind: "box" (eq 8: each within its range, all corners possible) or "ellipsoid" (eq 9).
    correlation: (n_p, n_p) unit-diagonal matrix, for an ellipsoid only; the identity is the paper's W.
    """

    names: tuple[str, ...]
    nominal: Array
    half_range: Array
    kind: SetKind = "box"
    correlation: Array | None = None

    @property
    def size(self) -> int:
        return len(self.names)

    @property
    def factor(self) -> Array:
        """(n_p, n_p) A with W = A A^T: parameters are nominal + A s, with s in the unit box or unit ball."""
        scale = np.diag(self.half_range)
        if self.correlation is None:
            return scale
        return scale @ np.linalg.cholesky(self.correlation)

    def restricted(self, names: tuple[str, ...]) -> UncertainSet:
        """The same set seen in some of its parameters (projection)."""
        keep = [i for i, name in enumerate(self.names) if name in names]
        correlation = None if self.correlation is None else self.correlation[np.ix_(keep, keep)]
        return UncertainSet(
            tuple(self.names[i] for i in keep), self.nominal[keep], self.half_range[keep], self.kind, correlation
        )


def inertial_vector(body: RigidBody) -> Array:
    """(10,) the values of `INERTIAL` for a body: mass, com_B, inertia about the centre of mass."""
    return np.concatenate([[body.mass], body.com_B, inertia_entries(body.inertia_com)])


def phi_of(inertial: Array) -> Array:
    """phi (..., 10) of values (..., 10) of `INERTIAL`, exactly."""
    mass, c = inertial[..., 0], inertial[..., 1:4]
    moment = mass[..., None] * c
    inertia_B = inertial[..., 4:] + inertia_entries(parallel_axis(mass, c))
    return np.concatenate([mass[..., None], moment, inertia_B], axis=-1)


def phi_jacobian(body: RigidBody, names: tuple[str, ...]) -> Array:
    """d phi / d p (10, n_p) at a body whose centre of mass is the origin of B; names of `INERTIAL`.

    There c = 0, so a shift of the centre of mass changes m c to first order and I about B not at all.
    Other names (friction, ...) do not act through the dynamics: their column is zero.
    """
    jacobian = np.zeros((10, len(names)))
    for column, name in enumerate(names):
        if name in INERTIAL:
            row = INERTIAL.index(name)
            jacobian[row, column] = body.mass if name in COM else 1.0
    return jacobian
