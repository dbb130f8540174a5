"""Tables of a scenario for the arm and the limits of its joints."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from salver.fields import Degrees, File, Metres, Model, Name, Number, Place, Point, Share, Turns
from salver.geometry import Array, matrix_from_rpy
from salver.models.arm.arm_limits import PLANNING_SHARES
from salver.models.arm.urdf import MOST_JOINTS

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


class MobileBase(Model):
    """A base that drives on the floor and carries the arm (`salver.models.arm.mobile_base`).

    size: m, length, width and height of its body, from the floor; or radius and height of a round one. mass: kg.
    x, y, yaw_deg: from where to where its frame may go, m and degrees. limits: of its joints x, y, yaw, for all or one
    for each: m/s and rad/s, and so on. sideways: velocity across its heading, m/s, at which a differential base still
    counts as rolling: a numerical tolerance. mount, mount_rpy_deg: pose of the URDF's root in the base's frame, m and
    degrees; on the middle of its top by default.
    """

    kind: Literal["omnidirectional", "differential"]
    size: tuple[Metres, Metres, Metres] | None = None
    radius: Metres | None = None
    height: Metres | None = None
    mass: Annotated[Number, Field(ge=0.1, le=1e4)]
    x: tuple[Place, Place]
    y: tuple[Place, Place]
    yaw_deg: tuple[Degrees, Degrees] = (-180.0, 180.0)
    limits: ArmLimits = ArmLimits()
    sideways: Annotated[Number, Field(ge=0.002, le=1)] = 0.005
    mount: Point | None = None
    mount_rpy_deg: Turns = (0.0, 0.0, 0.0)

    @model_validator(mode="after")
    def _sized(self) -> MobileBase:
        if (self.size is None) == (self.radius is None) or (self.radius is None) != (self.height is None):
            raise ValueError("its body needs size = [length, width, height], or radius and height for a round one")
        for key, (low, high) in (("x", self.x), ("y", self.y), ("yaw_deg", self.yaw_deg)):
            if low >= high:
                raise ValueError(f"{key} = [{low:g}, {high:g}] is no range; its first number must be below its second")
        return self

    @property
    def top(self) -> float:
        """Height of its body, m."""
        return self.size[2] if self.size else self.height or 0.0

    @property
    def yaw(self) -> tuple[float, float]:
        """From where to where its heading may go, rad."""
        return float(np.deg2rad(self.yaw_deg[0])), float(np.deg2rad(self.yaw_deg[1]))


class Arm(Model):
    """The arm: a known name (see `salver.models.arm.arm`) or a URDF or MJCF file with the frame that carries the tray.

    package_dirs: folders of the packages whose meshes the URDF names. collisions: how links whose geometry cannot be
    read are treated: refused, replaced by capsules, or not checked. base_position, base_rpy_deg: pose of the URDF's
    root in S; an arm that hangs from a ceiling has a roll of 180. base: one that drives, whose frame is there when its
    joints are at 0; they come before those of the URDF, in start_posture too.
    """

    model: File = Field(default="panda", description="a known arm, or the path of a URDF or MJCF")
    flange: Name | None = None
    package_dirs: list[File] = Field(default=[], max_length=50, description="a list of folders, at most 50")
    srdf: File | None = None
    collisions: Literal["meshes", "capsules", "unchecked"] = "meshes"
    limits: ArmLimits = ArmLimits()
    joint_limits: File | None = None
    base_position: Point = (0.0, 0.0, 0.0)
    base_rpy_deg: Turns = (0.0, 0.0, 0.0)
    base: MobileBase | None = None
    start_posture: Annotated[list[Angle], Field(max_length=MOST_JOINTS)] | None = None
    velocity_scale: Share = PLANNING_SHARES["velocity"]
    acceleration_scale: Share = PLANNING_SHARES["acceleration"]
    jerk_scale: Share = PLANNING_SHARES["jerk"]
    torque_scale: Share = PLANNING_SHARES["torque"]

    @property
    def R_base(self) -> Array:
        """(3, 3) orientation of the URDF's root in S."""
        return matrix_from_rpy(np.deg2rad(self.base_rpy_deg))

    @property
    def limit_shares(self) -> dict[str, float]:
        """The share of each kind of limit (`salver.models.arm.arm_limits.LIMITS`, by key) that a plan may use."""
        return {key: getattr(self, f"{key}_scale", share) for key, share in PLANNING_SHARES.items()}
