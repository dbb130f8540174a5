"""Stacks of 3-vectors with derivatives: dual numbers for forward differentiation.

The planner needs the derivatives of sensitivities by the coefficients of the reference. With these, the formulas of
`salver.sensitivity.tray` serve both plain evaluation (no tangent) and planning.

Shapes: value (T, P, 3), tangent (T, P, 3, n_z) or None for zero; T instants, P parameters (or 1).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from salver.geometry import Array, hat


def _sum(a: Array | None, b: Array | None) -> Array | None:
    if a is None:
        return b
    return a if b is None else a + b


@dataclass(frozen=True)
class Dual:
    value: Array
    tangent: Array | None = None

    def __add__(self, other: Dual) -> Dual:
        return Dual(self.value + other.value, _sum(self.tangent, other.tangent))

    def __neg__(self) -> Dual:
        return Dual(-self.value, None if self.tangent is None else -self.tangent)

    def __sub__(self, other: Dual) -> Dual:
        if self.tangent is None or other.tangent is None:
            return self + (-other)
        return Dual(self.value - other.value, self.tangent - other.tangent)

    def after(self, step: Array) -> Dual:
        """The value after a step (n_z,), with no tangent."""
        return Dual(self.value if self.tangent is None else self.value + self.tangent @ step)

    def every(self, k: int) -> Dual:
        """Every k-th instant."""
        return Dual(self.value[::k], None if self.tangent is None else self.tangent[::k])

    def scaled(self, factor: float | Array) -> Dual:
        """The product with a constant, or with a constant (P, 1) for each parameter."""
        factor = np.asarray(factor, dtype=float)
        tangent = None if self.tangent is None else self.tangent * factor[..., None]
        return Dual(self.value * factor, tangent)

    def mapped(self, matrix: Array) -> Dual:
        """The product of constant matrices (..., 3, 3) with the vectors."""
        value = (matrix @ self.value[..., None])[..., 0]
        if self.tangent is None:
            return Dual(value)
        if matrix.ndim == 3 and self.tangent.shape[1] == 1:  # one matrix for all instants: a single product
            rows = matrix.reshape(-1, 3) @ self.tangent[:, 0]
            return Dual(value, rows.reshape(len(rows), len(matrix), 3, rows.shape[2]))
        return Dual(value, matrix @ self.tangent)

    @cached_property
    def vanishes(self) -> bool:
        """Whether the number is identically zero."""
        return self.tangent is None and not self.value.any()

    def cross(self, other: Dual) -> Dual:
        if self.vanishes or other.vanishes:  # no rotation, or the centre of mass at B
            return Dual(np.zeros(np.broadcast_shapes(self.value.shape, other.value.shape)))
        left = hat(self.value)
        value = (left @ other.value[..., None])[..., 0]
        tangent = None if other.tangent is None else left @ other.tangent
        if self.tangent is not None:
            turned = hat(-other.value) @ self.tangent
            tangent = turned if tangent is None else np.add(tangent, turned, out=turned)
        return Dual(value, tangent)


@dataclass(frozen=True)
class DualRotation:
    """R_SB (T, 1, 3, 3) and the body-frame derivative of its perturbation dtheta (T, 1, 3, n_z) or None."""

    matrix: Array
    tangent: Array | None = None

    def to_body(self, vector_S: Dual) -> Dual:
        """R^T u; a perturbation dtheta of R adds (R^T u) x dtheta."""
        turned = vector_S.mapped(np.swapaxes(self.matrix, -1, -2))
        if self.tangent is None:
            return turned
        return Dual(turned.value, _sum(turned.tangent, hat(turned.value) @ self.tangent))

    def to_world(self, vector_B: Dual) -> Dual:
        """R u; a perturbation dtheta of R adds R (dtheta x u)."""
        turned = vector_B.mapped(self.matrix)
        if self.tangent is None:
            return turned
        return Dual(turned.value, _sum(turned.tangent, self.matrix @ hat(-vector_B.value) @ self.tangent))


def joined(*parts: Dual) -> Array:
    """Values of several stacks side by side, (T, P, 3 len(parts)), broadcast over instants."""
    return np.concatenate(np.broadcast_arrays(*(part.value for part in parts)), axis=-1)
