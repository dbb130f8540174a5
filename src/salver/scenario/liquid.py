"""An open container's liquid: the table [objects.liquid]."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from salver.dynamics.liquid.interiors import LEANING_WALL, Interior, Rectangle, Round
from salver.dynamics.liquid.liquid import FLUIDS, SHALLOWEST, damping_of, damping_range
from salver.fields import Metres, Number
from salver.models.load_dynamics import THICKEST
from salver.scenario.inner import InnerDynamics

if TYPE_CHECKING:
    from salver.dynamics.liquid.sloshing import Liquid

Damped = Annotated[Number, Field(ge=0, le=1)]  # share of critical damping


class LiquidIn(InnerDynamics):
    """A liquid in an upright cylinder (`radius`), a cone (also `brim_radius`) or a box (`size`), inside measures in m.

    radius: at the bottom. brim_radius: at the brim, at least `radius`; without it the wall is upright. fill, brim:
    heights over the inside bottom, m; the brim is the top of the object. kind: gives the density and viscosity that are
    left out.
    """

    quantity: ClassVar[str] = "fill"
    noun: ClassVar[str] = "liquid"

    kind: Literal["water", "coffee", "oil"] = "water"
    radius: Metres | None = None
    brim_radius: Metres | None = None
    size: tuple[Metres, Metres] | None = None
    fill: Metres
    brim: Metres
    density: Annotated[Number, Field(ge=100, le=20_000)] | None = None
    viscosity: Annotated[Number, Field(ge=0, le=10)] | None = None
    damping: tuple[Damped, Damped] | None = None
    margin: Annotated[Number, Field(ge=0, le=1)] = 0.001
    highest_wave: Annotated[Number, Field(gt=0, le=1)] | None = None
    settled_wave: Annotated[Number, Field(gt=0, le=1)] | None = None
    settled_within: Annotated[Number, Field(ge=0, le=600)] = 0.0
    sealed: Annotated[bool, Field(description="true or false")] = False

    @model_validator(mode="after")
    def _possible(self) -> LiquidIn:
        if (self.radius is None) == (self.size is None) or (self.size is not None and self.brim_radius is not None):
            raise ValueError(
                "liquid needs the inside of its container: radius of a cylinder, radius and brim_radius of a cone, or "
                "size of a box"
            )
        if self.radius is not None and self.brim_radius is not None and self.brim_radius < self.radius:
            raise ValueError(
                f"liquid.brim_radius = {self.brim_radius:g} m; it must be at least liquid.radius, which is that of the "
                "bottom: nothing is known of waves in a container that narrows upwards"
            )
        if self.settled_within > 0 and self.settled_wave is None:
            raise ValueError(
                f"liquid.settled_within = {self.settled_within:g} s needs settled_wave, the wave height in m that is "
                "allowed from then on; give it, or leave settled_within out"
            )
        if self.damping is not None and self.damping[0] > self.damping[1]:
            raise ValueError(f"liquid.damping = {list(self.damping)}; give the smaller share of critical damping first")
        least, most = self._damping_range
        damping = f"liquid.damping = {list(self.damping or ())} of critical"
        if self.damping is None:
            damping = (
                f"liquid has a viscosity of {self._viscosity:g} m^2/s, damping {least:.2g} to {most:.2g} of critical"
            )
        if least > THICKEST:
            raise ValueError(
                f"{damping}: too viscous for the sloshing model; leave out [objects.liquid] and add its mass to the "
                f"object, or give a damping whose first value is at most {THICKEST:g}"
            )
        if most > 2 * THICKEST:
            raise ValueError(f"{damping}; the sloshing model is valid up to {2 * THICKEST:g}: give at most that")
        return self

    @property
    def inside(self) -> Interior:
        if self.radius is None:
            assert self.size is not None
            return Rectangle(*self.size)
        return Round(self.radius, (0.0 if self.brim_radius is None else self.brim_radius - self.radius) / self.brim)

    @property
    def _viscosity(self) -> float:
        return FLUIDS[self.kind].viscosity if self.viscosity is None else self.viscosity

    @property
    def _damping_range(self) -> tuple[float, float]:
        """Least and largest damping, share of critical."""
        return self.damping or damping_range(damping_of(self._half(self.fill), self.fill, self._viscosity))

    def _half(self, fill: float) -> float:
        """Radius of the surface, or half its shorter side, m."""
        return float(self.inside.half(fill).min())

    @property
    def assumed(self) -> float:
        """Half-range of the fill height, m: 10 %, at most half of the distance to the brim."""
        return min(0.1 * self.fill, 0.5 * (self.brim - self.fill))

    def check(self, name: str, outside: Interior, height: float, half_range: float) -> None:
        here = f"liquid of {name}"
        if outside.round != self.inside.round:
            raise ValueError(
                f"{here}: the liquid in a cylinder or cone needs an inside radius, the liquid in a box an inside size"
            )
        if self.brim > height:
            raise ValueError(f"{here}: brim = {self.brim:g} m over the bottom; {name} is only {height:g} m high")
        for where, inner, outer in (
            ("bottom", self.inside.half(0.0), outside.half(height - self.brim)),
            ("brim", self.inside.half(self.brim), outside.half(height)),
        ):
            if np.any(inner >= outer):
                raise ValueError(
                    f"{here}: at its {where} it is {(2 * inner).tolist()} m wide inside and {(2 * outer).tolist()} m "
                    "outside, along x and y; the inside must be smaller"
                )
        if half_range >= self.fill:
            raise ValueError(f"uncertainty.fill of {name} = {half_range:g} m must be less than fill = {self.fill:g} m")
        least, most = self.fill - half_range, self.fill + half_range
        if most + self.margin >= self.brim:
            raise ValueError(
                f"{here}: filled up to {most:g} m, with a margin of {self.margin:g} m, it stands above the brim at "
                f"{self.brim:g} m; give less fill, a smaller uncertainty.fill or a higher brim"
            )
        half = float(self.inside.half(least).max())
        if least < SHALLOWEST * half:
            raise ValueError(
                f"{here}: {least:g} m deep in a container {2 * half:g} m wide is too shallow for this model, which is "
                f"valid from {SHALLOWEST * half:g} m on; in shallower ones waves break"
            )
        if self.inside.slope > LEANING_WALL:
            raise ValueError(
                f"{here}: the wall leans out by {np.rad2deg(np.arctan(self.inside.slope)):.3g} deg, so far that a wave "
                "would rise along it in ways that the model does not have; give a steeper wall, of at most "
                f"{np.rad2deg(np.arctan(LEANING_WALL)):.3g} deg"
            )

    def dynamics(self, height: float) -> Liquid:
        from salver.dynamics.liquid.sloshing import Liquid

        known = FLUIDS[self.kind]
        return Liquid(
            inside=self.inside,
            floor=height - self.brim,
            fill=self.fill,
            brim=self.brim,
            density=known.density if self.density is None else self.density,
            damping=self._damping_range,
            margin=self.margin,
            highest=np.inf if self.highest_wave is None else self.highest_wave,
            sealed=self.sealed,
            settled=np.inf if self.settled_wave is None else self.settled_wave,
            within=self.settled_within,
            name=self.kind,
        )
