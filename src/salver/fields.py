"""Field types that the tables of a scenario share."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Whole = Annotated[int, Field(strict=True)]
Share = Annotated[Number, Field(gt=0, le=1)]
Metres = Annotated[Number, Field(ge=1e-4, le=5)]  # m, a size
Place = Annotated[Number, Field(ge=-10, le=10)]  # m, a coordinate
Point = tuple[Place, Place, Place]
Degrees = Annotated[Number, Field(ge=-360, le=360)]
Turns = tuple[Degrees, Degrees, Degrees]
Mass = Annotated[Number, Field(ge=1e-6, le=100)]  # kg
Inertia = Annotated[Number, Field(ge=-1000, le=1000)]  # kg m^2
HalfRange = Annotated[Number, Field(ge=0, le=100)]
Scale = Annotated[Number, Field(ge=1e-6, le=1e6)]
Text = Annotated[str, Field(max_length=10_000, description="text of at most 10000 letters")]
Name = Annotated[str, Field(max_length=200, description="text of at most 200 letters")]
# A path that the operating system accepts: not too long, and without a null character.
File = Annotated[str, Field(max_length=4096, pattern=r"^[^\x00]+$", description="the path of a file")]


class Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=False)
