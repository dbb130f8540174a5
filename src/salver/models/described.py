"""Tables of a scenario for the tray, obstacles, keep-in box and floor. Units and frames: docs/scenario-file.md."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from salver.fields import File, Inertia, Metres, Model, Name, Number, Place, Point, Scale, Turns
from salver.geometry import Array, matrix_from_rpy

RoomEdge = Annotated[Number, Field(ge=1e-4, le=20)]  # m: a base drives between places from -10 to 10 m
SIDES = {"-x": (-1, 0), "+x": (1, 0), "-y": (0, -1), "+y": (0, 1)}  # of the tray: the way out, along x and y of E


class Rim(Model):
    """Upright walls around the tray's surface.

    height: m, above the surface. friction: of the walls in the physics engine; plans rely on their push alone.
    thickness: m.
    """

    height: Metres
    friction: Annotated[Number, Field(ge=0, le=5)] = 0.0
    thickness: Metres = 0.003


class Tray(Model):
    """The tray on the flange.

    size: m, of the surface on which objects stand; the walls of a rim stand outside it. height: m, of the centre of its
    top surface along the flange's z. offset: m, along the flange's x and y, for a tray on a bracket. rpy_deg: roll,
    pitch, yaw of the tray in the flange's frame. inertia: kg m^2, principal moments about its centre of mass, along its
    own axes.
    """

    size: tuple[Metres, Metres] = (0.2, 0.2)
    thickness: Metres = 0.01
    height: Annotated[Number, Field(ge=-5, le=5)] = 0.05
    offset: tuple[Place, Place] = (0.0, 0.0)
    rpy_deg: Turns = (0.0, 0.0, 0.0)
    mass: Annotated[Number, Field(ge=0, le=100)] = 0.150
    inertia: tuple[Inertia, Inertia, Inertia] = (1.25e-4, 1.25e-4, 1.25e-4)
    rim: Rim | None = None

    @model_validator(mode="after")
    def _physical(self) -> Tray:
        """Raise ValueError when no body between flange and tray surface, as wide as the tray, has such an inertia."""
        low, middle, high = sorted(self.inertia)
        if low < 0 or high > (low + middle) * (1 + 1e-6):
            raise ValueError(
                f"inertia = {list(self.inertia)} kg m^2 is impossible: no value may be negative or larger than the sum "
                "of the other two"
            )
        x, y, _ = self.outer
        away = max(self.thickness, *(abs(x) for x in self.p_FE)) + self.rim_height
        most = self.mass * (0.25 * (x**2 + y**2) + away**2)
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

    @property
    def R_FE(self) -> Array:
        """Orientation (3, 3) of E in the flange's frame F."""
        return matrix_from_rpy(np.deg2rad(self.rpy_deg))

    @property
    def rim_height(self) -> float:
        """Height of the rim above the surface, m; 0 without one."""
        return self.rim.height if self.rim else 0.0

    @property
    def outer(self) -> tuple[float, float, float]:
        """Size, m, along x, y, z of E of the box around the tray with its rim."""
        wall = 2 * self.rim.thickness if self.rim else 0.0
        return self.size[0] + wall, self.size[1] + wall, self.thickness + self.rim_height

    @property
    def boxes(self) -> list[tuple[Point, Point]]:
        """Centre in E and size, m, of the boxes it is made of: the plate, then the walls of the rim as in `SIDES`."""
        (x, y, _), found = self.outer, [((0.0, 0.0, -0.5 * self.thickness), (*self.outer[:2], self.thickness))]
        if self.rim:
            half, z = 0.5 * self.rim.thickness, 0.5 * self.rim.height
            for a, b in SIDES.values():
                size = (self.rim.thickness if a else x, self.rim.thickness if b else y, self.rim.height)
                found.append(((a * (0.5 * x - half), b * (0.5 * y - half), z), size))
        return found


class Obstacle(Model):
    """A keep-out region in the world S. A mesh is replaced by the convex hulls of its separate pieces. length: m, of a
    capsule, between the centres of its round ends."""

    type: Literal["box", "sphere", "capsule", "cylinder", "mesh"]
    name: Name = "obstacle"
    position: Point
    rpy_deg: Turns = (0.0, 0.0, 0.0)
    size: tuple[Metres, Metres, Metres] | None = None
    radius: Metres | None = None
    length: Metres | None = None
    height: Metres | None = None
    file: File | None = None
    scale: Scale = 1.0

    @model_validator(mode="after")
    def _sized(self) -> Obstacle:
        needed = {
            "box": ("size",),
            "sphere": ("radius",),
            "capsule": ("radius", "length"),
            "cylinder": ("radius", "height"),
            "mesh": ("file",),
        }[self.type]
        for key in ("size", "radius", "length", "height", "file"):
            given = getattr(self, key) is not None
            if key in needed and not given:
                raise ValueError(f"a {self.type} needs {' and '.join(needed)}")
            if given and key not in needed:
                raise ValueError(f"a {self.type} has {' and '.join(needed)}; leave out {key}")
        return self


@dataclass(frozen=True)
class Wall:
    """The half-space behind a plane, as an obstacle. point: of the plane, m in S; inwards: its normal away from the
    obstacle, in S."""

    point: Point
    inwards: Point
    name: ClassVar[str] = "keep-in box"


@dataclass(frozen=True)
class Floor(Wall):
    """The half-space below a plane. clear: m, clearance that plans keep from it."""

    clear: ClassVar[float] = 0.01
    name: ClassVar[str] = "floor"


class KeepIn(Model):
    """A box in the world S that the moving links, the tray and the load must not leave.

    position: m, of its centre; rpy_deg: its roll, pitch, yaw; size: m, along its axes.
    """

    position: Point
    rpy_deg: Turns = (0.0, 0.0, 0.0)
    size: tuple[RoomEdge, RoomEdge, RoomEdge]

    @property
    def walls(self) -> tuple[Wall, ...]:
        """Its six faces, as obstacles."""
        R, centre = matrix_from_rpy(np.deg2rad(self.rpy_deg)), np.array(self.position)
        outwards = [side * R[:, k] for k in range(3) for side in (-1.0, 1.0)]
        halves = np.repeat(0.5 * np.array(self.size), 2)
        return tuple(
            Wall(tuple((centre + half * out).tolist()), tuple((-out).tolist()))
            for half, out in zip(halves, outwards, strict=True)
        )
