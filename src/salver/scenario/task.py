"""Tables of a scenario for the task: start and goal, parameterisation, contact condition, gains, cost."""

from __future__ import annotations

from functools import cached_property
from typing import Annotated, Literal

import numpy as np
from pydantic import ConfigDict, Field, field_validator, model_validator

from salver.fields import Degrees, Model, Number, Point, Turns, Whole
from salver.geometry import matrix_from_quat_wxyz, matrix_from_rpy


class Pose(Model):
    """Pose of the object frame B in the world S; orientation by roll, pitch, yaw or by a quaternion."""

    position: Point
    rpy_deg: Turns | None = None
    quat_wxyz: tuple[Number, Number, Number, Number] | None = None

    @model_validator(mode="after")
    def _one_orientation(self) -> Pose:
        if self.rpy_deg is not None and self.quat_wxyz is not None:
            raise ValueError("give the orientation by rpy_deg or by quat_wxyz, not by both")
        if self.quat_wxyz is not None and abs(np.linalg.norm(self.quat_wxyz) - 1) > 1e-3:
            raise ValueError(f"quat_wxyz has norm {np.linalg.norm(self.quat_wxyz):.4g}; a rotation has norm 1")
        return self

    @cached_property
    def rotation(self) -> np.ndarray:
        if self.quat_wxyz is not None:
            return matrix_from_quat_wxyz(self.quat_wxyz)
        return matrix_from_rpy(np.deg2rad(self.rpy_deg if self.rpy_deg is not None else (0.0, 0.0, 0.0)))

    def same_as(self, other: Pose) -> bool:
        """Whether two poses are equal, up to rounding."""
        near = np.allclose(self.position, other.position, rtol=0, atol=1e-6)
        return near and np.allclose(self.rotation, other.rotation, rtol=0, atol=1e-6)


class Motion(Model):
    """The motion from rest at `start` to rest at `goal`, and the parameterisation of the reference trajectory.

    With legs, `goal` is that of the last leg and may be left out.
    speeds: "any": the plan must hold at every constant speed factor from 0 to 1, and at factors that change by up to
        speed_rate, 1/s. "full": it must hold at full speed only.
    start_yaw: "free": the tray may begin with any heading, in motions of an arm.
    """

    model_config = ConfigDict(json_schema_extra=lambda schema: schema["required"].remove("goal"))
    start: Pose
    goal: Pose
    through: list[Pose] = Field(default=[], max_length=10)
    duration: Annotated[Number, Field(ge=0.01, le=120)] | None = None
    degree: Annotated[Whole, Field(ge=5, le=30)] = 9
    nodes: Annotated[Whole, Field(ge=11, le=2001)] = 61
    orientation: Literal["fixed", "free"] | None = None
    max_tilt_deg: Annotated[Number, Field(gt=0, le=90)] | None = None
    goal_yaw: Literal["fixed", "free"] = "fixed"
    start_yaw: Literal["fixed", "free"] | None = None
    speeds: Literal["any", "full"] = "any"
    speed_rate: Annotated[Number, Field(ge=0, le=10)] = 0.25

    @property
    def may_turn(self) -> bool:
        """Whether the tray may tilt and turn on the way; by default only if no duration is given."""
        return self.duration is None if self.orientation is None else self.orientation == "free"


class Contact(Model):
    """The contact condition of the plan, and the linearisation of friction cones.

    margin: required margin of the condition beyond its tube: N of a cone coefficient (paper), or a share of the normal
    force at rest (exact).
    """

    condition: Literal["paper", "exact"] = "paper"
    edges: Annotated[Whole, Field(ge=3, le=32)] = 4
    edge_phase_deg: Degrees = 0.0
    margin: Annotated[Number, Field(ge=0, le=1000)] = 1e-3


def unstable_when_held(kp: float, kd: float, period: float) -> bool:
    """Whether e'' + kd e' + kp e = 0 is unstable under a zero-order hold of its control for a period (s)."""
    # Over one period e'' has the value that the gains give at its beginning.
    step = np.array([[1 - 0.5 * kp * period**2, period - 0.5 * kd * period**2], [-kp * period, 1 - kd * period]])
    return bool(np.abs(np.linalg.eigvals(step)).max() >= 1)


Stiffness = Annotated[Number, Field(ge=1e-3, le=1e5)]  # 1/s^2
Damping = Annotated[Number, Field(ge=1e-3, le=1e3)]  # 1/s


class Control(Model):
    """Gains of the object controller, eq (19): (translation 1/s^2, rotation 1/s^2) and (1/s, 1/s)."""

    kp: tuple[Stiffness, Stiffness] = (500.0, 300.0)
    kd: tuple[Damping, Damping] = (25.0, 15.0)

    def check_held(self, period: float) -> None:
        """Raise ValueError when the error dynamics are unstable because each command is held for a period (s)."""
        for kp, kd in zip(self.kp, self.kd, strict=True):
            if unstable_when_held(kp, kd, period):
                raise ValueError(
                    f"control.kp = {kp:g} 1/s^2 with control.kd = {kd:g} 1/s is unstable when commands are held for "
                    f"physics.command_period = {period:g} s; give smaller gains, or kd nearer to 2 sqrt(kp)"
                )


class Planning(Model):
    """The planning method. By default it is "safest" if motion.duration is given, else "fastest"."""

    method: Literal["robust", "fastest", "safest", "least-sensitive"] | None = None


class SensitivityWeighting(Model):
    """Weights of the rows of the state sensitivity in the cost, eq (13).

    weighting: a weighting by its name (salver.planning.object.cost.CostWeights), or four weights, of the deviations of
    position, rotation, velocity and angular rate, or twelve, of their axes x, y, z.
    """

    weighting: Literal["scaled", "paper", "pose"] | tuple[Annotated[Number, Field(ge=0, le=1e6)], ...] = Field(
        default="scaled",
        description='"scaled", "paper" or "pose", or four or twelve weights, each at least 0 and at most 1000000',
    )

    @field_validator("weighting")
    @classmethod
    def _counts(cls, given: str | tuple[float, ...]) -> str | tuple[float, ...]:
        if not isinstance(given, str) and (len(given) not in (4, 12) or not any(given)):
            raise ValueError(f"it has {len(given)} weights; write four or twelve, at least one of them positive")
        return given
