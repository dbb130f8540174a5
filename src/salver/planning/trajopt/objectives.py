"""Objectives: the duration, or, at a given duration, the contact margin.

An objective is a function of a motion's coefficients (size, m) and of one scalar: the duration where it is free, the
margin where that is maximised, or none. Users can add subclasses of `Objective`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from salver.geometry import Array
from salver.planning.trajopt.constraints.constraints import Block, ContactConstraint
from salver.planning.trajopt.constraints.load_limits import LoadConstraint
from salver.planning.trajopt.curves import Curve


class Scalar(Enum):
    """The scalar unknown of a programme: the relative change of T^2, the margin, or none."""

    DURATION = "duration"
    MARGIN = "margin"
    NONE = "none"


@dataclass(frozen=True)
class Point:
    """Variables of a programme: coefficients (size, m), duration in s, and the margin of the counted constraints."""

    coefficients: Array
    duration: float
    margin: float = 0.0


@dataclass(frozen=True)
class QuadraticModel:
    """A quadratic model of an objective.

    slope: gradient (size m,) by the coefficients. by_scalar: derivative by the scalar. curvature: Hessian
    (size m, size m) by the coefficients; None for 0.
    """

    slope: Array
    by_scalar: float = 0.0
    curvature: Array | None = None


class Objective(ABC):
    """An objective. scalar: the variable beside the coefficients. sought: adjective for the motion, such as "shortest".
    counts(block): whether the margin is required of a block's rows."""

    scalar: Scalar = Scalar.NONE
    sought: str = "best"

    @abstractmethod
    def value(self, curve: Curve, at: Point) -> float:
        """Value of the objective."""

    @abstractmethod
    def model(self, curve: Curve, at: Point) -> QuadraticModel:
        """Quadratic model of the objective at a point."""

    def expected(self, curve: Curve, at: Point, value: float, step: Array) -> float:
        """Value after a step (size m + 1,) of coefficients and scalar from a point with `value`, by the model."""
        model, move = self.model(curve, at), step[:-1]
        bent = 0.0 if model.curvature is None else 0.5 * float(move @ model.curvature @ move)
        return value + float(model.slope @ move) + model.by_scalar * float(step[-1]) + bent

    def scale(self, at: Point, value: float) -> float:
        """Scale of the objective, in its unit, to which tolerances are relative."""
        return abs(value)

    def counts(self, block: Block) -> bool:
        return False

    def demanded(self, blocks: Sequence[Block], margin: float) -> tuple[Block, ...]:
        """The blocks, with the margin added to the rows of those that count."""
        if not margin:
            return tuple(blocks)
        return tuple(replace(b, values=b.values + margin) if self.counts(b) else b for b in blocks)


class LeastSquares(Objective):
    """A sum of squared residuals in units of `unit`, with the Gauss-Newton model. The unit must be of the size of the
    sum: tolerances and the penalty on violations assume values of about 1."""

    unit: float

    @abstractmethod
    def residual(self, coefficients: Array, derivatives: bool) -> tuple[Array, Array]:
        """Residuals (r,), and their Jacobian (r, size m) by the coefficients, or (r, 0) without derivatives."""

    def value(self, curve: Curve, at: Point) -> float:
        return float(np.sum(np.square(self.residual(at.coefficients, False)[0] / np.sqrt(self.unit))))

    def model(self, curve: Curve, at: Point) -> QuadraticModel:
        residual, jacobian = (x / np.sqrt(self.unit) for x in self.residual(at.coefficients, True))
        return QuadraticModel(2 * residual @ jacobian, 0.0, 2 * jacobian.T @ jacobian)


@dataclass(frozen=True)
class Duration(Objective):
    """The duration T, s."""

    scalar = Scalar.DURATION
    sought = "shortest"

    def value(self, curve: Curve, at: Point) -> float:
        return at.duration

    def expected(self, curve: Curve, at: Point, value: float, step: Array) -> float:
        return at.duration * float(np.sqrt(1 + step[-1]))

    def model(self, curve: Curve, at: Point) -> QuadraticModel:
        return QuadraticModel(np.zeros(at.coefficients.size), 0.5 * at.duration)


@dataclass(frozen=True)
class LeastMargin(Objective):
    """The least margin, which is maximised at a given T: of contact rows as a share of the weight, and of load dynamics
    as a share of their room."""

    scalar = Scalar.MARGIN

    def value(self, curve: Curve, at: Point) -> float:
        return -at.margin

    def scale(self, at: Point, value: float) -> float:
        return 0.1  # of the weight

    def model(self, curve: Curve, at: Point) -> QuadraticModel:
        return QuadraticModel(np.zeros(at.coefficients.size), -1.0)

    def counts(self, block: Block) -> bool:
        return isinstance(block.of, ContactConstraint | LoadConstraint)
