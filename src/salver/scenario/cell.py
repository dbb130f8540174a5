"""Tables of a scenario for the surroundings, the simulated robot and the physics engine."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from salver.fields import Model, Number, Place, Whole
from salver.models.arm.tables import EachJoint
from salver.models.arm.urdf import MOST_JOINTS
from salver.models.described import KeepIn
from salver.scenario.task import unstable_when_held


class Surroundings(Model):
    """The surroundings of the arm other than the obstacles: the floor, and a box that it must not leave.

    floor: height in S, m, of a plane below which no link, tray or load may go, except the links on which the arm
        stands; "base": the height of the arm's base; "none": no floor, as for an arm on a ceiling or a wall.
    keep_in: the box.
    """

    floor: Place | Literal["base", "none"] = Field(
        default="base", description='a finite number at least -10 and at most 10, "base" or "none"'
    )
    keep_in: KeepIn | None = None


Settling = Annotated[Number, Field(ge=0, le=60)]  # s
_JointFriction = Annotated[Number, Field(ge=0, le=1000)]
Friction = Annotated[
    _JointFriction | Annotated[list[_JointFriction], Field(max_length=MOST_JOINTS)],
    Field(description="a number at least 0 and at most 1000, or a list of such numbers, one for each joint"),
]


class RobotBehaviour(Model):
    """How the simulated robot follows its command.

    control: "torque": salver's own controller. "position": the robot's internal controller, modelled as a second-order
        lag of each joint with this bandwidth (Hz, natural frequency) and damping (share of critical), both one number
        or one for each joint, and a delay (s).
    payload_error: kg by which the payload mass configured in the robot exceeds the nominal load.
    """

    control: Literal["torque", "position"] = "torque"
    bandwidth: EachJoint = 12.0
    damping: EachJoint = 0.7
    delay: Annotated[Number, Field(ge=0, le=0.2)] = 0.0
    payload_error: Annotated[Number, Field(ge=-100, le=100)] = 0.0

    def check_held(self, period: float) -> None:
        """Raise ValueError when the robot's loop is unstable because each torque is held for a period (s)."""
        if self.control == "torque":
            return
        rates = [x if isinstance(x, list) else [x] for x in (self.bandwidth, self.damping)]
        count = max(map(len, rates))
        for hertz, damping in zip(*(x * (count if len(x) == 1 else 1) for x in rates), strict=False):
            rate = 2 * np.pi * hertz
            if unstable_when_held(rate**2, 2 * damping * rate, period):
                raise ValueError(
                    f"physics.robot.bandwidth = {hertz:g} Hz with damping = {damping:g} is unstable when commands are "
                    f"held for physics.command_period = {period:g} s; give a smaller one"
                )


class Physics(Model):
    """Settings of the physics engine, and disturbances between controller and arm.

    kinetic_friction: friction of contacts that slide, as a share of `objects.friction`, which is the static one.
    """

    timestep: Annotated[Number, Field(ge=1e-5, le=5e-3)] = 5e-4
    command_period: Annotated[Number, Field(ge=1e-4, le=0.02)] = 1e-3
    settle_before: Settling = 0.2
    settle_after: Settling = 0.5
    position_noise: Annotated[Number, Field(ge=0, le=1)] = 0.0
    velocity_noise: Annotated[Number, Field(ge=0, le=10)] = 0.0
    delay_steps: Annotated[Whole, Field(ge=0, le=20)] = 0
    joint_friction: Friction = 0.0
    kinetic_friction: Annotated[Number, Field(gt=0, le=1)] = 1.0
    robot: RobotBehaviour = RobotBehaviour()
    feedback: Literal["joints", "object"] = "joints"

    def steps(self, duration: float | None, usual: float = 5.0) -> float:
        """Number of steps of the engine, or of the controller, in a run of a motion; `usual`: its duration if that is
        not given, s."""
        return ((duration or usual) + self.settle_before + self.settle_after) / min(self.timestep, self.command_period)
