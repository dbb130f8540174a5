"""Units of a table that are not rad, m and s."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from salver.errors import SalverError
from salver.geometry import Array

PARTS = {"ms": 1e-3, "us": 1e-6, "ns": 1e-9}  # of a second
_SIZES = {
    "angle": {"rad": 1.0, "deg": float(np.deg2rad(1.0))},
    "length": {"m": 1.0, "cm": 1e-2, "mm": 1e-3},
    "time": {"s": 1.0, **PARTS},
}


@dataclass(frozen=True)
class Units:
    """Factors from a table's units to rad, m and s.

    prismatic: (n,) whether each joint of the arm is prismatic. text: the units as the user gave them, empty for SI.
    """

    angle: float = 1.0
    length: float = 1.0
    time: float = 1.0
    prismatic: tuple[bool, ...] = ()
    text: str = ""

    @classmethod
    def parse(cls, text: str | None, prismatic: Sequence[bool] = ()) -> Units:
        """The units of a list such as "deg,mm,ms"; others are SI. Raises SalverError."""
        if text is None:
            return SI
        named = [unit.strip() for unit in text.split(",")]
        found = {kind: [sizes[unit] for unit in named if unit in sizes] for kind, sizes in _SIZES.items()}
        if any(len(sizes) > 1 for sizes in found.values()) or sum(map(len, found.values())) < len(named):
            known = "; ".join(" or ".join(sizes) for sizes in _SIZES.values())
            raise SalverError(f'--units "{text}" must name at most one of each, separated by commas: {known}.')
        angle, length, time = (sizes[0] if sizes else 1.0 for sizes in found.values())
        return cls(angle, length, time, tuple(map(bool, prismatic)), ", ".join(named))

    def of_joints(self, count: int) -> Array:
        """Factors (count,) from the units of joint positions to rad or m."""
        if len(self.prismatic) != count:
            return np.full(count, self.angle)
        return np.where(self.prismatic, self.length, self.angle)

    @property
    def notes(self) -> tuple[str, ...]:
        """A sentence about the conversion; none for SI."""
        said = f"Units of the table: {self.text}; every answer and every written file is in rad, m, s."
        return (said,) if self.text else ()


SI = Units()
