"""Interfaces that the models require of arm, tray and obstacles; the tables of a scenario implement them.

Units and frames are those of the scenario file (docs/scenario-file.md).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol


class TrayDescription(Protocol):
    """A plate at a pose in the flange's frame."""

    @property
    def size(self) -> tuple[float, float]: ...
    @property
    def thickness(self) -> float: ...
    @property
    def p_FE(self) -> tuple[float, float, float]: ...
    @property
    def rpy_deg(self) -> tuple[float, float, float]: ...
    @property
    def mass(self) -> float: ...
    @property
    def inertia(self) -> tuple[float, float, float]: ...


class ArmDescription(Protocol):
    """An arm by name or URDF, with its base pose, limits and collision settings."""

    @property
    def model(self) -> str: ...
    @property
    def flange(self) -> str | None: ...
    @property
    def package_dirs(self) -> Sequence[str]: ...
    @property
    def srdf(self) -> str | None: ...
    @property
    def joint_limits(self) -> str | None: ...
    @property
    def collisions(self) -> str: ...
    @property
    def base_position(self) -> tuple[float, float, float]: ...
    @property
    def base_yaw_deg(self) -> float: ...
    @property
    def given_limits(self) -> Mapping[str, float | Sequence[float]]: ...
    @property
    def limit_shares(self) -> Mapping[str, float]: ...


class ObstacleDescription(Protocol):
    """A fixed shape in the world; its type determines which of its sizes are given."""

    @property
    def name(self) -> str: ...
    @property
    def type(self) -> str: ...
    @property
    def position(self) -> tuple[float, float, float]: ...
    @property
    def rpy_deg(self) -> tuple[float, float, float]: ...
    @property
    def size(self) -> tuple[float, float, float] | None: ...
    @property
    def radius(self) -> float | None: ...
    @property
    def length(self) -> float | None: ...
    @property
    def file(self) -> str | None: ...
    @property
    def scale(self) -> float: ...


@dataclass(frozen=True)
class Floor:
    """The half-space below a height in the world, m, as an obstacle; clear: m, clearance that plans keep from it."""

    height: float
    clear: float = 0.01
    name: str = "floor"
    type: str = "floor"
    rpy_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    size: None = None
    radius: None = None
    length: None = None
    file: None = None
    scale: float = 1.0

    @property
    def position(self) -> tuple[float, float, float]:
        """A point of its surface, m."""
        return (0.0, 0.0, self.height)
