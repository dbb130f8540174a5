"""Tables of a scenario for the tray, the arm, obstacles, and the physics engine."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from salver.models.arm.arm_limits import PLANNING_SHARES
from salver.models.arm.urdf import MOST_JOINTS
from salver.scenario.fields import (
    Degrees,
    File,
    Inertia,
    Metres,
    Model,
    Name,
    Number,
    Place,
    Point,
    Scale,
    Share,
    Turns,
    Whole,
)
from salver.scenario.task import unstable_when_held


class Tray(Model):
    """The tray on the flange.

    height: m, of the centre of its top surface along the flange's z. offset: m, along the flange's x and y, for a tray
    on a bracket. rpy_deg: roll, pitch, yaw of the tray in the flange's frame. inertia: kg m^2, principal moments about
    its centre of mass, along its own axes.
    """

    size: tuple[Metres, Metres] = (0.2, 0.2)
    thickness: Metres = 0.01
    height: Annotated[Number, Field(ge=-5, le=5)] = 0.05
    offset: tuple[Place, Place] = (0.0, 0.0)
    rpy_deg: Turns = (0.0, 0.0, 0.0)
    mass: Annotated[Number, Field(ge=0, le=100)] = 0.150
    inertia: tuple[Inertia, Inertia, Inertia] = (1.25e-4, 1.25e-4, 1.25e-4)

    @model_validator(mode="after")
    def _physical(self) -> Tray:
        """Raise ValueError when no body between flange and tray surface, as wide as the tray, has such an inertia."""
        low, middle, high = sorted(self.inertia)
        if low < 0 or high > (low + middle) * (1 + 1e-6):
            raise ValueError(
                f"inertia = {list(self.inertia)} kg m^2 is impossible: no value may be negative or larger than the sum "
                "of the other two"
            )
        away = max(self.thickness, *(abs(x) for x in self.p_FE))
        most = self.mass * (0.25 * (self.size[0] ** 2 + self.size[1] ** 2) + away**2)
        if high > most * (1 + 1e-6):
            raise ValueError(
                f"inertia = {list(self.inertia)} kg m^2 is too large: {self.mass:g} kg between the flange and the "
                f"tray's surface, no wider than the tray, has at most {most:.3g}"
            )
        return self

    @property
    def p_FE(self) -> tuple[float, float, float]:
        """Origin of E in the flange's frame F, m."""
        return (*self.offset, self.height)


Limit = Annotated[Number, Field(ge=1e-6, le=1e9)]
EachJoint = Annotated[
    Limit | Annotated[list[Limit], Field(max_length=MOST_JOINTS)],
    Field(description="a number at least 1e-06 and at most 1e+09, or a list of such numbers, one for each joint"),
]
Angle = Annotated[Number, Field(ge=-100, le=100)]  # rad, or m for a prismatic joint


class ArmLimits(Model):
    """Limits of the joints, one number for all or one for each: rad/s, rad/s^2, rad/s^3, N m, N m/s.

    Prismatic joints have m and N for rad and N m. These limits replace those of the maker, a URDF or a
    `joint_limits.yaml`.
    """

    velocity: EachJoint | None = None
    acceleration: EachJoint | None = None
    jerk: EachJoint | None = None
    torque: EachJoint | None = None
    torque_rate: EachJoint | None = None


class Arm(Model):
    """The arm: a known name (see `salver.models.arm.arm`) or a URDF file with the frame that carries the tray.

    package_dirs: folders of the packages whose meshes the URDF names. collisions: how links whose geometry cannot be
    read are treated: refused, replaced by capsules, or not checked.
    """

    model: File = Field(default="panda", description="a known arm, or the path of a URDF")
    flange: Name | None = None
    package_dirs: list[File] = Field(default=[], max_length=50, description="a list of folders, at most 50")
    srdf: File | None = None
    collisions: Literal["meshes", "capsules", "unchecked"] = "meshes"
    limits: ArmLimits = ArmLimits()
    joint_limits: File | None = None
    base_position: Point = (0.0, 0.0, 0.0)
    base_yaw_deg: Degrees = 0.0
    start_posture: Annotated[list[Angle], Field(max_length=MOST_JOINTS)] | None = None
    velocity_scale: Share = PLANNING_SHARES["velocity"]
    acceleration_scale: Share = PLANNING_SHARES["acceleration"]
    jerk_scale: Share = PLANNING_SHARES["jerk"]
    torque_scale: Share = PLANNING_SHARES["torque"]

    @property
    def given_limits(self) -> dict[str, float | list[float]]:
        """The limits that the table arm.limits sets."""
        return self.limits.model_dump(exclude_none=True)

    @property
    def limit_shares(self) -> dict[str, float]:
        """The share of each kind of limit (`salver.models.arm.arm_limits.LIMITS`, by key) that a plan may use."""
        return {key: getattr(self, f"{key}_scale", share) for key, share in PLANNING_SHARES.items()}


class Obstacle(Model):
    """A keep-out region in the world S. A mesh is replaced by the convex hulls of its separate pieces."""

    type: Literal["box", "sphere", "capsule", "cylinder", "mesh"]
    name: Name = "obstacle"
    position: Point
    rpy_deg: Turns = (0.0, 0.0, 0.0)
    size: tuple[Metres, Metres, Metres] | None = None
    radius: Metres | None = None
    length: Metres | None = None
    file: File | None = None
    scale: Scale = 1.0

    @model_validator(mode="after")
    def _sized(self) -> Obstacle:
        needed = {
            "box": ("size",),
            "sphere": ("radius",),
            "capsule": ("radius", "length"),
            "cylinder": ("radius", "length"),
            "mesh": ("file",),
        }[self.type]
        for key in needed:
            if getattr(self, key) is None:
                raise ValueError(f"a {self.type} needs {' and '.join(needed)}")
        return self


class Surroundings(Model):
    """The surroundings of the arm other than the obstacles: the floor.

    floor: height in S, m, of a plane below which no link, tray or load may go, except the links on which the arm
        stands; "base": the height of the arm's base; "none": no floor, as for an arm on a ceiling or a wall.
    """

    floor: Place | Literal["base", "none"] = Field(
        default="base", description='a finite number at least -10 and at most 10, "base" or "none"'
    )


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
    """Settings of the physics engine, and disturbances between controller and arm."""

    timestep: Annotated[Number, Field(ge=1e-5, le=5e-3)] = 5e-4
    command_period: Annotated[Number, Field(ge=1e-4, le=0.02)] = 1e-3
    settle_before: Settling = 0.2
    settle_after: Settling = 0.5
    position_noise: Annotated[Number, Field(ge=0, le=1)] = 0.0
    velocity_noise: Annotated[Number, Field(ge=0, le=10)] = 0.0
    delay_steps: Annotated[Whole, Field(ge=0, le=20)] = 0
    joint_friction: Friction = 0.0
    robot: RobotBehaviour = RobotBehaviour()
    feedback: Literal["joints", "object"] = "joints"

    def steps(self, duration: float) -> float:
        """Number of steps of the engine, or of the controller, in a run of a motion."""
        return (duration + self.settle_before + self.settle_after) / min(self.timestep, self.command_period)
