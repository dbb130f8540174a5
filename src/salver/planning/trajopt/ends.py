"""Boundary conditions of a motion: at rest in a pose, in a given posture (at rest or moving), or anywhere at rest.

An end provides the error of a posture with its Jacobian, and the allowed posture nearest to a given one.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field

import numpy as np

from salver.geometry import Array
from salver.models.arm.arm import ArmModel
from salver.models.arm.arm_limits import JointLimits
from salver.planning.postures import INSIDE, REACHED, PoseTarget, posture_at


class End(ABC):
    """A boundary condition as the optimiser uses it. given: whether it fixes the posture."""

    given = False

    def residual(self, arm: ArmModel, q: Array) -> tuple[Array, Array]:
        """Error (k,) of a posture q (n,), and its Jacobian J (k, n): a step dq must satisfy J dq = error."""
        return np.zeros(0), np.zeros((0, arm.n))

    @abstractmethod
    def nearest(self, arm: ArmModel, limits: JointLimits, q: Array, iterations: int = 60) -> Array | None:
        """An allowed posture (n,) within the limits near q (n,); None when none was found."""


@dataclass(frozen=True, eq=False)
class AtPose(End):
    """The boundary condition of rest, with the load at a pose."""

    target: PoseTarget

    def residual(self, arm: ArmModel, q: Array) -> tuple[Array, Array]:
        return self.target.residual(arm, q)

    def nearest(self, arm: ArmModel, limits: JointLimits, q: Array, iterations: int = 60) -> Array | None:
        found, size = posture_at(arm, self.target, q, limits=limits, iterations=iterations)
        return found if size < REACHED else None


@dataclass(frozen=True, eq=False)
class AtPosture(End):
    """In a posture q (n,), rad, with velocity dq, rad/s, and acceleration ddq, rad/s^2: at rest unless given.

    Only a start may be moving.
    """

    q: Array
    dq: Array = field(default_factory=lambda: np.zeros(0))
    ddq: Array = field(default_factory=lambda: np.zeros(0))
    given = True

    @property
    def moving(self) -> bool:
        return bool(np.any(self.dq) or np.any(self.ddq))

    @property
    def rates(self) -> Array:
        """Velocity and acceleration, (2, n)."""
        return np.stack([x if len(x) else np.zeros(len(self.q)) for x in (self.dq, self.ddq)])

    def nearest(self, arm: ArmModel, limits: JointLimits, q: Array, iterations: int = 60) -> Array | None:
        return self.q


@dataclass(frozen=True)
class Anywhere(End):
    """At rest in any posture: a stop."""

    def nearest(self, arm: ArmModel, limits: JointLimits, q: Array, iterations: int = 60) -> Array | None:
        return np.clip(q, limits.q_min + INSIDE, limits.q_max - INSIDE)
