"""Inertial parameters of a rigid body, and its spatial inertia: eq (1) of the paper."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from salver.geometry import Array, hat

# Axes of the six entries of a symmetric matrix: of an inertia, of second moments, of products of angular velocities.
# Inertial parameters are m, m c (3), I about B (6): Pinocchio's order, see docs/conventions.md.
PAIRS = ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2))
_ROW, _COLUMN = (list(side) for side in zip(*PAIRS, strict=True))


def inertia_matrix(six: npt.ArrayLike) -> Array:
    """Symmetric matrices (..., 3, 3) from their six entries (xx, xy, yy, xz, yz, zz)."""
    six = np.asarray(six, dtype=float)
    matrix = np.empty((*six.shape[:-1], 3, 3))
    for k, (i, j) in enumerate(PAIRS):
        matrix[..., i, j] = matrix[..., j, i] = six[..., k]
    return matrix


def inertia_entries(matrix: npt.ArrayLike) -> Array:
    """The six entries (xx, xy, yy, xz, yz, zz) of symmetric matrices (..., 3, 3)."""
    return np.asarray(np.asarray(matrix, dtype=float)[..., _ROW, _COLUMN])


def parallel_axis(mass: npt.ArrayLike, c: npt.ArrayLike) -> Array:
    """Contribution (..., 3, 3) of a mass at c to the inertia about the origin: m (|c|^2 1 - c c^T)."""
    skew = hat(c)
    return -np.asarray(mass, dtype=float)[..., None, None] * (skew @ skew)


@dataclass(frozen=True)
class RigidBody:
    """Ten inertial parameters of a body, about the origin of B and in its axes.

    mass: kg. com_B: (3,) m. inertia_com: (3, 3) kg m^2 about the centre of mass, axes of B.
    """

    mass: float
    com_B: Array
    inertia_com: Array

    @property
    def phi(self) -> Array:
        """(10,) inertial parameters (m, m c, I about B)."""
        inertia_B = self.inertia_com + parallel_axis(self.mass, self.com_B)
        return np.concatenate([[self.mass], self.mass * self.com_B, inertia_entries(inertia_B)])

    @classmethod
    def from_phi(cls, phi: npt.ArrayLike) -> RigidBody:
        phi = np.asarray(phi, dtype=float)
        c = phi[1:4] / phi[0]
        return cls(float(phi[0]), c, inertia_matrix(phi[4:]) - parallel_axis(phi[0], c))


def spatial_inertia(phi: npt.ArrayLike) -> Array:
    """M_b (..., 6, 6) of inertial parameters (..., 10), for the twist (v, omega) of the origin of B, in B: eq (1)."""
    phi = np.asarray(phi, dtype=float)
    matrix = np.zeros((*phi.shape[:-1], 6, 6))
    moment = hat(phi[..., 1:4])
    matrix[..., :3, :3] = phi[..., 0, None, None] * np.eye(3)
    matrix[..., :3, 3:], matrix[..., 3:, :3] = -moment, moment
    matrix[..., 3:, 3:] = inertia_matrix(phi[..., 4:])
    return matrix
