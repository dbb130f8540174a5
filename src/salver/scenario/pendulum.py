"""A pendulum inside an object: the table [objects.pendulum]."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, ClassVar

import numpy as np
from pydantic import Field

from salver.fields import Mass, Metres, Number
from salver.scenario.inner import InnerDynamics

if TYPE_CHECKING:
    from salver.dynamics.liquid.interiors import Interior
    from salver.dynamics.pendulum import Pendulum

Damped = Annotated[Number, Field(ge=0, le=0.2)]  # share of critical damping


class PendulumIn(InnerDynamics):
    """A mass on a light rod that hangs in an object and swings in every direction, up to `widest_deg` from the axis.

    pivot: m, height of the pivot over the object's base, on the object's axis. length: m, of the rod.
    """

    quantity: ClassVar[str] = "length"
    noun: ClassVar[str] = "pendulum"

    mass: Mass
    length: Metres
    pivot: Metres
    widest_deg: Annotated[Number, Field(gt=0, le=30)] = 25.0
    damping: tuple[Damped, Damped] = (0.0, 0.02)

    @property
    def assumed(self) -> float:
        """Half-range of the length, m: 2 %."""
        return 0.02 * self.length

    def check(self, name: str, outside: Interior, height: float, half_range: float) -> None:
        if self.pivot > height:
            raise ValueError(f"pendulum of {name}: pivot = {self.pivot:g} m; {name} is only {height:g} m high")
        longest, least = self.length + half_range, min(float(outside.half(z).min()) for z in (0.0, height))
        if half_range >= self.length or longest > self.pivot:
            raise ValueError(
                f"pendulum of {name}: length = {self.length:g} m, uncertain by {half_range:g} m; it must be above 0 "
                f"and at most its pivot, {self.pivot:g} m"
            )
        if longest * np.sin(np.deg2rad(self.widest_deg)) > least:
            raise ValueError(
                f"pendulum of {name}: with widest_deg = {self.widest_deg:g} it leaves {name}, whose side is "
                f"{least:g} m from the axis; give less"
            )
        if self.damping[0] > self.damping[1]:
            raise ValueError(f"pendulum.damping = {list(self.damping)}; give the smaller share of critical first")

    def dynamics(self, height: float) -> Pendulum:
        from salver.dynamics.pendulum import Pendulum

        return Pendulum(self.mass, self.length, self.pivot, float(np.deg2rad(self.widest_deg)), self.damping)
