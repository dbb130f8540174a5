"""Tables of a scenario for the objects and their uncertainty, and their conversion to rigid bodies."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from salver.dynamics.liquid.interiors import Interior, Rectangle, Round
from salver.fields import (
    Degrees,
    File,
    HalfRange,
    Inertia,
    Mass,
    Metres,
    Model,
    Number,
    Place,
    Point,
    Scale,
    Whole,
)  # fmt: skip
from salver.models.bodies import LooseObject, check
from salver.models.described import Tray
from salver.models.rigid_body import RigidBody, inertia_matrix
from salver.models.shapes import shapes
from salver.models.shapes.shapes import Solid
from salver.models.uncertain.contents import inertia_ranges
from salver.models.uncertain.parameters import (
    RIM,
    TILT,
    Parameter,
    UncertainSet,
    Vibration,
    inertial_vector,
    parameters_of,
)
from salver.scenario.inner import InnerDynamics
from salver.scenario.liquid import LiquidIn
from salver.scenario.pendulum import PendulumIn


class Box(Model):
    type: Literal["box"]
    size: tuple[Metres, Metres, Metres]

    def solid(self) -> Solid:
        return shapes.box(self.size)

    @property
    def outside(self) -> Interior:
        return Rectangle(*self.size[:2])


class Cylinder(Model):
    type: Literal["cylinder"]
    radius: Metres
    height: Metres
    support_points: Annotated[Whole, Field(ge=3, le=64)] = 8

    def solid(self) -> Solid:
        return shapes.cylinder(self.radius, self.height, self.support_points)

    @property
    def outside(self) -> Interior:
        return Round(self.radius)


class Cone(Model):
    """An upright truncated cone, such as a paper cup. radius: of its base. top_radius: larger or smaller than that."""

    type: Literal["cone"]
    radius: Metres
    top_radius: Metres
    height: Metres
    support_points: Annotated[Whole, Field(ge=3, le=64)] = 8

    def solid(self) -> Solid:
        return shapes.cone(self.radius, self.top_radius, self.height, self.support_points)

    @property
    def outside(self) -> Interior:
        return Round(self.radius, (self.top_radius - self.radius) / self.height)


class Prism(Model):
    type: Literal["prism"]
    polygon: Annotated[list[tuple[Place, Place]], Field(min_length=3, max_length=64)]
    height: Metres

    @model_validator(mode="after")
    def _convex(self) -> Prism:
        corners = np.array(self.polygon)
        edges = np.roll(corners, -1, axis=0) - corners
        after = np.roll(edges, -1, axis=0)
        turns = np.arctan2(edges[:, 0] * after[:, 1] - edges[:, 1] * after[:, 0], np.sum(edges * after, axis=1))
        # Turning left at every corner, once around in total: convex, without repeated corners.
        if turns.min() <= 1e-9 or abs(turns.sum() - 2 * np.pi) > 1e-6:
            raise ValueError("polygon must go once round a convex outline, counter-clockwise, without repeated corners")
        if np.abs(corners).max() > 5:
            raise ValueError(f"polygon reaches {np.abs(corners).max():g} m from its origin; its corners are in metres")
        return self

    def solid(self) -> Solid:
        return shapes.prism(np.array(self.polygon), self.height)


class Mesh(Model):
    type: Literal["mesh"]
    file: File
    scale: Scale = 1.0

    def solid(self) -> Solid:
        return shapes.mesh(self.file, self.scale)


class Part(Model):
    """A piece of a composite: its shape, the position of its centre (m), its mass (kg; only ratios matter)."""

    shape: Annotated[Box | Cylinder | Cone | Prism, Field(discriminator="type")]
    position: Point = (0.0, 0.0, 0.0)
    mass: Mass


class Composite(Model):
    type: Literal["composite"]
    parts: Annotated[list[Part], Field(min_length=1, max_length=50)]

    def solid(self) -> Solid:
        return shapes.composite([(part.shape.solid(), np.array(part.position), part.mass) for part in self.parts])


Shape = Annotated[Box | Cylinder | Cone | Prism | Mesh | Composite, Field(discriminator="type")]


def smooth(shape: Shape, corners: int) -> Solid:
    """The solid of a shape; a round one has a base with so many corners."""
    finer = {"support_points": corners}
    return shape.model_copy(update=finer).solid() if isinstance(shape, Cylinder | Cone) else shape.solid()


def _relative(value: Any) -> Any:
    """ "10%" becomes {"relative": 0.1}; a number or a list stays an absolute half-range."""
    if isinstance(value, str):
        text = value.strip()
        try:
            if not text.endswith("%"):
                raise ValueError
            return {"relative": float(text.removesuffix("%")) / 100}
        except ValueError:
            raise ValueError(f'"{value}" is not a percentage; write "10%", or a half-range in SI units') from None
    return value


class Relative(Model):
    relative: Annotated[Number, Field(ge=0, lt=1)]


_EITHER = 'a percentage below 100 % such as "10%", or {} in SI units, at least 0 and at most 100'
_Percentage = Annotated[str, Field(pattern=r"^[0-9.eE+-]+ *%$")]  # for the JSON schema that editors use
Range = Annotated[
    Relative | HalfRange,
    BeforeValidator(_relative, json_schema_input_type=_Percentage | Relative | HalfRange),
    Field(description=_EITHER.format("a half-range")),
]
AbsoluteRange3 = tuple[HalfRange, HalfRange, HalfRange]
_Inertia = (
    Relative
    | tuple[HalfRange, HalfRange, HalfRange]
    | tuple[HalfRange, HalfRange, HalfRange, HalfRange, HalfRange, HalfRange]
)
Range6 = Annotated[
    _Inertia,
    BeforeValidator(_relative, json_schema_input_type=_Percentage | _Inertia),
    Field(description=_EITHER.format("three or six half-ranges")),
]


class Uncertainty(Model):
    """Half-ranges of an object's uncertain parameters: eq (8).

    A percentage is relative to the nominal value; a number is absolute, in SI units. `inertia` takes three
    (xx, yy, zz) or six (xx, xy, yy, xz, yz, zz) half-ranges; a percentage applies to the three on the diagonal.
    For an object with a liquid or a pendulum, mass, com and inertia are those of the container alone; `fill` is the
    liquid's height, `length` the pendulum's length.
    contents = "any" allows every distribution of the mass inside the shape that has this mass and centre of mass.
    """

    mass: Range | None = None
    com: AbsoluteRange3 | None = None
    inertia: Range6 | None = None
    friction: Range | None = None
    position: tuple[HalfRange, HalfRange] | None = None
    fill: Range | None = None
    length: Range | None = None
    contents: Literal["known", "any"] = "known"

    @model_validator(mode="after")
    def _one_inertia(self) -> Uncertainty:
        if self.contents == "any" and self.inertia is not None:
            raise ValueError('contents = "any" allows every inertia that the shape can have; leave inertia out')
        return self

    def ranges(self, item: LooseObject, lone: bool) -> Iterator[tuple[Parameter, float, float]]:
        """The uncertain parameters of an object, each with its nominal value and its half-range, above 0.

        lone: whether it is the only object, so that its parameters need no prefix.
        """
        inertial, inner = inertial_vector(item.own), item.inner
        half = {
            "mass": [_absolute(self.mass, inertial[0])],
            "com": self.com,
            "inertia": _inertia_ranges(self.inertia, inertial[4:]),
            "friction": [_absolute(self.friction, item.friction)],
            "position": [0.0 if pushed else x for x, pushed in zip(self.position or (), item.pushed, strict=False)],
        }
        if item.any_contents:
            points = item.solid.bounding_points_G - item.com_G
            heaviest = item.inertial.mass + _absolute(self.mass, inertial[0])
            half["inertia"] = inertia_ranges(points, np.array(self.com or 3 * [0.0]), heaviest, inertial[4:]).tolist()
        others = {"friction": item.friction}
        if inner is not None:
            others |= {inner.quantity: inner.value, "damping": inner.nominal_damping}
            half |= {
                inner.quantity: [_absolute(getattr(self, inner.quantity), inner.value)],
                "damping": [inner.damping[1] - inner.nominal_damping],
            }
        for kind in half:
            own = [p for p in parameters_of(item.name, lone) if p.kind == kind]
            for parameter, value in zip(own, half[kind] or (), strict=False):
                entry = parameter.entry
                nominal = others.get(kind, 0.0 if entry is None else float(inertial[entry]))
                if value > 0:
                    yield parameter, nominal, value


def _exact(value: Any) -> Any:
    """Convert "none" to a table without ranges: everything is known exactly."""
    return {} if value == "none" else value


def assumed(shape: Shape, on: str | list[str], inner: InnerDynamics | None) -> Uncertainty:
    """The ranges that are assumed for an object whose scenario gives none (docs/scenario-file.md has the reasons).

    Friction 15 %; mass 10 %; centre of mass 3 mm to the sides, at most a tenth of the width, and 5 % of the height;
    position on the tray 2 mm; fill height 10 %, at most half of the distance to the brim. With a liquid or pendulum the
    position is exact: a range multiplies the cases that a plan must consider by four.
    """
    try:
        solid = shape.solid()
    except ValueError:  # a mesh that cannot be read; the validation of the object reports it
        return Uncertainty()
    aside = min(0.003, 0.1 * float(np.ptp(solid.outline_polygon, axis=0).min()))
    found: dict[str, Any] = {"friction": "15%", "mass": "10%", "com": (aside, aside, 0.05 * solid.height)}
    if inner is not None:
        found[inner.quantity] = inner.assumed
    elif on == "tray":
        found["position"] = (0.002, 0.002)
    return Uncertainty(**found)


Side = Literal["-x", "+x", "-y", "+y"]


class CarriedObject(Model):
    """One loose object.

    at: m, position of its shape's centre from the tray's centre, even if it stands `on` another object.
    against: sides of the tray at which it is pushed against the rim: there `at` follows from its shape.
    With a `liquid` or a `pendulum` in it, mass, com and inertia are those of the container alone.
    """

    name: Annotated[
        str,
        Field(
            pattern=r"^[A-Za-z][A-Za-z0-9_-]*$",
            max_length=64,
            description="letters a to z, digits, - and _, a letter first, at most 64",
        ),
    ] = "object"
    shape: Shape
    mass: Mass
    com: Point = (0.0, 0.0, 0.0)
    inertia: tuple[Inertia, Inertia, Inertia] | tuple[Inertia, Inertia, Inertia, Inertia, Inertia, Inertia] | None = (
        None
    )
    friction: Annotated[Number, Field(ge=1e-6, le=5)]
    on: str | Annotated[list[str], Field(min_length=1, max_length=20)] = Field(
        default="tray", description='"tray", the name of an object listed before, or a list of these'
    )
    at: tuple[Place, Place] = (0.0, 0.0)
    against: Side | Annotated[list[Side], Field(min_length=1, max_length=2)] | None = Field(
        default=None, description='"-x", "+x", "-y" or "+y", or a list of two of these'
    )
    yaw_deg: Degrees = 0.0
    support_inset: Annotated[Number, Field(ge=0, le=5)] = 0.0
    liquid: LiquidIn | None = None
    pendulum: PendulumIn | None = None
    uncertainty: Annotated[
        Uncertainty, BeforeValidator(_exact, json_schema_input_type=Uncertainty | Literal["none"])
    ] = Field(
        default_factory=lambda data: assumed(data["shape"], data["on"], data["liquid"] or data["pendulum"]),
        description=f'a table with the keys {", ".join(Uncertainty.model_fields)}, or "none"',
    )

    @model_validator(mode="after")
    def _physical(self) -> CarriedObject:
        self._check_inner()
        self._check_against()
        loose = self.loose()
        check(loose)
        away = loose.solid.bounding_points_G - loose.solid.centroid_G - self.com
        # Four times the inertia of the whole mass in the furthest corner; the paper's own value is 1.1 times that.
        most = 4 * self.mass * float(np.sum(away**2, axis=1).max())
        stated = [x for key in (self.inertia, self.uncertainty.inertia) if isinstance(key, tuple) for x in key]
        if max(map(abs, stated), default=0.0) > most * (1 + 1e-6):
            raise ValueError(
                f"inertia of {self.name} = {max(map(abs, stated)):g} kg m^2 (nominal or half-range) is too large for "
                f"{self.mass:g} kg of this shape: at most {most:.3g}, four times that of the whole mass in the "
                "furthest corner"
            )
        for key in ("mass", "friction"):
            nominal, half = getattr(self, key), getattr(self.uncertainty, key)
            if isinstance(half, float) and half >= nominal:
                raise ValueError(
                    f"uncertainty.{key} = {half:g} is not below {key} = {nominal:g}, so that {key} could be zero; give "
                    "less"
                )
        return self

    def loose(self, solid: Solid | None = None) -> LooseObject:
        """The object as a `LooseObject`. An inertia that is not given is that of the uniform solid.

        solid: replaces the shape's own, for example with a finer polygon for a round base.
        """
        solid = self.shape.solid() if solid is None else solid
        inner = None if self.inner is None else self.inner.dynamics(solid.height)
        com, unit = np.asarray(self.com), solid.unit_inertia
        if inner is not None:
            shell_com, unit = inner.shell(solid)
            com = com + shell_com
        if self.inertia is None:
            inertia = self.mass * unit
        elif len(self.inertia) == 3:
            inertia = np.diag(self.inertia)
        else:
            inertia = inertia_matrix(self.inertia)
        whole, empty = RigidBody(self.mass, np.zeros(3), inertia), None
        if inner is not None:
            frozen = inner.modes(inner.value).frozen
            origin = np.array([0.0, 0.0, inner.origin(solid.base_z, inner.value)]) - solid.centroid_G
            phi = RigidBody(self.mass, com, inertia).phi
            phi += RigidBody(frozen.mass, frozen.com_B + origin, frozen.inertia_com).phi
            whole = RigidBody.from_phi(phi)
            empty = RigidBody(self.mass, com - whole.com_B, inertia)
            com, whole = whole.com_B, RigidBody(whole.mass, np.zeros(3), whole.inertia_com)
        return LooseObject(
            self.name,
            solid,
            whole,
            com,
            self.friction,
            (self.on,) if isinstance(self.on, str) else tuple(self.on),
            self.at,
            float(np.deg2rad(self.yaw_deg)),
            self.support_inset,
            self.uncertainty.contents == "any",
            inner,
            empty,
            self.sides,
        )

    @property
    def inner(self) -> InnerDynamics | None:
        """The table of its liquid or pendulum; None without one."""
        return self.liquid or self.pendulum

    @property
    def sides(self) -> tuple[str, ...]:
        """Names of the sides of the rim against which the object is pushed."""
        return (self.against,) if isinstance(self.against, str) else tuple(self.against or ())

    def _check_against(self) -> None:
        """Raise ValueError when an object cannot be pushed against these sides of a rim."""
        if not self.sides:
            return
        if len({side[1] for side in self.sides}) < len(self.sides):
            raise ValueError(f"against = {list(self.sides)} of {self.name}: give one side along x and one along y")
        if self.on != "tray":
            raise ValueError(f'{self.name} stands on {self.on}; against is only for objects on = "tray"')
        if not isinstance(self.shape, Box | Cylinder | Prism):
            raise ValueError(
                f"against of {self.name}: only a box, a cylinder or a prism has upright sides, not a {self.shape.type}"
            )

    def _check_inner(self) -> None:
        """Raise ValueError when its liquid or pendulum does not fit into it, or contradicts another key."""
        inner = self.inner
        for table in (LiquidIn, PendulumIn):
            if getattr(self.uncertainty, table.quantity) is not None and not isinstance(inner, table):
                raise ValueError(
                    f"uncertainty.{table.quantity} of {self.name} needs a {table.noun}: add [objects.{table.noun}], or "
                    "leave it out"
                )
        if self.liquid is not None and self.pendulum is not None:
            raise ValueError(f"{self.name} has a liquid and a pendulum; give one of the two")
        if inner is None:
            return
        noun, shape = inner.noun, self.shape
        if self.uncertainty.contents == "any":
            raise ValueError(f'{noun} of {self.name}: contents = "any" does not work with a {noun}; leave one out')
        if not isinstance(shape, Box | Cylinder | Cone):
            raise ValueError(f"{noun} of {self.name}: a cylinder, a cone or a box can hold one, not a {shape.type}")
        half_range = _absolute(getattr(self.uncertainty, inner.quantity), inner.value)
        inner.check(self.name, shape.outside, shape.solid().height, half_range)


Tilt = Annotated[Number, Field(ge=0, le=45)]  # degrees


class Shake(Model):
    """Vibration of the tray on top of its motion: up to `amplitude`, m, in any direction, and up to `tilt_deg` about
    any axis through its centre, at up to `frequency`, Hz."""

    amplitude: Annotated[Number, Field(ge=0, le=0.05)] = 0.0
    tilt_deg: Annotated[Number, Field(ge=0, le=5)] = 0.0
    frequency: Annotated[Number, Field(gt=0, le=200)]

    @property
    def vibration(self) -> Vibration:
        return Vibration(self.amplitude, float(np.deg2rad(self.tilt_deg)), self.frequency)


class UncertaintySet(Model):
    """Shape of the uncertain set, and the uncertainty of the tray: its tilt, its vibration, the friction of its rim."""

    set: Literal["box", "ellipsoid"] = "box"
    tilt_deg: tuple[Tilt, Tilt] | None = None
    shake: Shake | None = None
    friction_rim: Range | None = None
    correlation: dict[str, Annotated[Number, Field(gt=-1, lt=1)]] = Field(
        default={}, max_length=1000, description='numbers between -1 and 1 under keys such as "mass,com_x"'
    )

    def around(self, objects: list[CarriedObject], loose: list[LooseObject], tray: Tray) -> UncertainSet:
        """All uncertain parameters, in the order of the objects and then of the tray: eq (8).

        Raises ValueError when the correlation matrix is not positive definite or names a parameter without a range.
        """
        lone = len(objects) == 1
        found = [r for item, it in zip(objects, loose, strict=True) for r in item.uncertainty.ranges(it, lone)]
        for parameter, degrees in zip(TILT, self.tilt_deg or (), strict=False):
            if degrees > 0:
                found.append((parameter, 0.0, float(np.deg2rad(degrees))))
        if self.friction_rim is not None and tray.rim is None:
            raise ValueError("uncertainty.friction_rim is given, and the tray has no rim; give tray.rim a height")
        rim = 0.0 if tray.rim is None else tray.rim.friction
        if (half_rim := _absolute(self.friction_rim, rim)) > rim:
            raise ValueError(f"uncertainty.friction_rim = {half_rim:g} is above tray.rim.friction = {rim:g}; give less")
        if half_rim > 0:
            found.append((RIM, rim, half_rim))
        parameters, nominal, half = zip(*found, strict=True) if found else ((), (), ())
        correlation = self._matrix([p.name for p in parameters])
        shake = None if self.shake is None else self.shake.vibration
        return UncertainSet(parameters, np.array(nominal), np.array(half), self.set, correlation, shake)

    def _matrix(self, names: list[str]) -> np.ndarray | None:
        """Correlation matrix (n_p, n_p) of the parameters `names`; None if none is given."""
        if not self.correlation:
            return None
        matrix = np.eye(len(names))
        given: dict[frozenset[str], str] = {}
        for key, value in self.correlation.items():
            parts = [part.strip() for part in key.split(",")]
            pair = frozenset(parts)
            if len(parts) == 2 and len(pair) == 1:
                raise ValueError(
                    f'uncertainty.correlation has the key "{key}"; it must name two different parameters: a parameter '
                    "is fully correlated with itself"
                )
            if pair in given:
                raise ValueError(
                    f'uncertainty.correlation has "{given[pair]}" and "{key}", which is the same pair; give it once'
                )
            given[pair] = key
            if len(parts) != 2 or any(part not in names for part in parts):
                raise ValueError(
                    f'uncertainty.correlation has the key "{key}"; it must name two uncertain parameters, as in '
                    f'"mass,com_x"; uncertain here are {", ".join(names) or "none"}'
                )
            i, j = (names.index(part) for part in parts)
            matrix[i, j] = matrix[j, i] = value
        if self.set == "box":
            raise ValueError('uncertainty.correlation needs set = "ellipsoid"; a box has no correlation')
        if np.linalg.eigvalsh(matrix)[0] <= 0:
            raise ValueError("uncertainty.correlation is not positive definite; no distribution has it")
        return matrix


def _absolute(value: float | Relative | None, nominal: float) -> float:
    if value is None:
        return 0.0
    return value if isinstance(value, float) else value.relative * abs(nominal)


def _inertia_ranges(value: Relative | tuple[float, ...] | None, nominal: np.ndarray) -> list[float]:
    """Half-ranges of the six entries of the inertia; three values are those of the diagonal."""
    if value is None:
        return []
    half, diagonal = np.zeros(6), [0, 2, 5]
    if isinstance(value, Relative):
        half[diagonal] = value.relative * nominal[diagonal]
    else:
        half[diagonal if len(value) == 3 else slice(None)] = value
    return half.tolist()
