"""The scenario: what is carried, how, from where to where, and what is not known about it.

A scenario is a TOML file, or the name of a ready-made one. It is checked in full before anything is
computed; each mistake is one sentence with the key, the value and what would be accepted.
"""

from __future__ import annotations

import hashlib
import json
import math
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from salver.errors import ScenarioError

SCENARIO_DIR = Path(__file__).parent / "scenarios"


def _finite(x: float) -> float:
    if not math.isfinite(x):
        raise ValueError("must be a finite number")
    return x


Number = Annotated[float, AfterValidator(_finite)]
Positive = Annotated[float, Field(gt=0), AfterValidator(_finite)]
NonNegative = Annotated[float, Field(ge=0), AfterValidator(_finite)]
Vector3 = tuple[Number, Number, Number]
Metres = Annotated[float, Field(gt=0, le=5), AfterValidator(_finite)]


class Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=False)


class Pose(Model):
    """Pose of the object frame B in the world S; orientation by roll, pitch, yaw or by a quaternion."""

    position: Vector3
    rpy_deg: Vector3 | None = None
    quat_wxyz: tuple[Number, Number, Number, Number] | None = None

    @model_validator(mode="after")
    def _one_orientation(self) -> Pose:
        if self.rpy_deg is not None and self.quat_wxyz is not None:
            raise ValueError("give the orientation by rpy_deg or by quat_wxyz, not by both")
        if self.quat_wxyz is not None and abs(np.linalg.norm(self.quat_wxyz) - 1) > 1e-3:
            raise ValueError(f"quat_wxyz has norm {np.linalg.norm(self.quat_wxyz):.4g}; a rotation has norm 1")
        if max(abs(x) for x in self.position) > 10:
            raise ValueError(f"position {self.position} is over 10 m away; positions are in metres")
        return self

    @property
    def rotation(self) -> np.ndarray:
        from salver.geometry import matrix_from_quat_wxyz, matrix_from_rpy

        if self.quat_wxyz is not None:
            return matrix_from_quat_wxyz(self.quat_wxyz)
        return matrix_from_rpy(np.deg2rad(self.rpy_deg if self.rpy_deg is not None else (0.0, 0.0, 0.0)))


class Motion(Model):
    """Rest to rest from `start` to `goal`, and how the reference trajectory is parameterised."""

    start: Pose
    goal: Pose
    duration: Annotated[float, Field(gt=0, le=120), AfterValidator(_finite)] | None = None
    degree: Annotated[int, Field(ge=5, le=30)] = 9
    nodes: Annotated[int, Field(ge=11, le=2001)] = 61
    orientation: Literal["fixed", "free"] = "fixed"
    max_tilt_deg: Annotated[float, Field(gt=0, le=90)] | None = None
    goal_yaw: Literal["fixed", "free"] = "fixed"


class Box(Model):
    type: Literal["box"]
    size: tuple[Metres, Metres, Metres]


class Cylinder(Model):
    type: Literal["cylinder"]
    radius: Metres
    height: Metres
    support_points: Annotated[int, Field(ge=3, le=64)] = 8


class Prism(Model):
    type: Literal["prism"]
    polygon: Annotated[list[tuple[Number, Number]], Field(min_length=3)]
    height: Metres


class Mesh(Model):
    type: Literal["mesh"]
    file: str
    scale: Positive = 1.0


class Part(Model):
    """A piece of a composite: its shape, where its centre is, its share of the mass (kg)."""

    shape: Annotated[Box | Cylinder | Prism, Field(discriminator="type")]
    position: Vector3 = (0.0, 0.0, 0.0)
    mass: Positive


class Composite(Model):
    type: Literal["composite"]
    parts: Annotated[list[Part], Field(min_length=1)]


Shape = Annotated[Box | Cylinder | Prism | Mesh | Composite, Field(discriminator="type")]


def _relative(value: Any) -> Any:
    """ "10%" becomes {"relative": 0.1}; a number or a list stays an absolute half-range."""
    if isinstance(value, str):
        text = value.strip()
        try:
            return {"relative": float(text.removesuffix("%")) / 100} if text.endswith("%") else {"relative": text}
        except ValueError:
            raise ValueError(f'"{value}" is neither a percentage such as "10%" nor a half-range in SI units') from None
    return value


class Relative(Model):
    relative: Annotated[float, Field(ge=0, lt=1), AfterValidator(_finite)]


Range = Annotated[Relative | NonNegative, BeforeValidator(_relative)]
Range3 = Annotated[Relative | tuple[NonNegative, NonNegative, NonNegative], BeforeValidator(_relative)]
AbsoluteRange3 = tuple[NonNegative, NonNegative, NonNegative]
Range6 = Annotated[
    Relative
    | tuple[NonNegative, NonNegative, NonNegative]
    | tuple[NonNegative, NonNegative, NonNegative, NonNegative, NonNegative, NonNegative],
    BeforeValidator(_relative),
]


class Uncertainty(Model):
    """Half-ranges of what is not known exactly about an object: eq (8).

    A percentage is relative to the nominal value; a number is absolute, in SI units. `inertia` takes three
    (xx, yy, zz) or six (xx, xy, yy, xz, yz, zz) half-ranges; a percentage means the three on the diagonal.
    """

    mass: Range | None = None
    com: AbsoluteRange3 | None = None
    inertia: Range6 | None = None
    friction: Range | None = None
    position: tuple[NonNegative, NonNegative] | None = None


class CarriedObject(Model):
    """One loose object. `at` is where its shape's centre stands on the tray (or on `on`), m."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_-]*$")] = "object"
    shape: Shape
    mass: Annotated[float, Field(gt=0, le=100), AfterValidator(_finite)]
    com: Vector3 = (0.0, 0.0, 0.0)
    inertia: Vector3 | tuple[Number, Number, Number, Number, Number, Number] | None = None
    friction: Annotated[float, Field(gt=0, le=5), AfterValidator(_finite)]
    on: str | list[str] = "tray"
    at: tuple[Number, Number] = (0.0, 0.0)
    yaw_deg: Number = 0.0
    support_inset: NonNegative = 0.0
    uncertainty: Uncertainty = Uncertainty()

    @model_validator(mode="after")
    def _physical(self) -> CarriedObject:
        from salver.models import bodies

        bodies.check(self)
        return self


class UncertaintySet(Model):
    """Shape of the uncertain set, and what is uncertain beyond the objects themselves."""

    set: Literal["box", "ellipsoid"] = "box"
    tilt_deg: tuple[NonNegative, NonNegative] | None = None
    correlation: dict[str, Annotated[float, Field(gt=-1, lt=1)]] = {}


class Contact(Model):
    """Which contact condition the plan must keep, and how friction cones are linearised."""

    condition: Literal["paper", "exact"] = "paper"
    edges: Annotated[int, Field(ge=3, le=32)] = 4
    edge_phase_deg: Number = 0.0
    margin: NonNegative = 1e-3


class Control(Model):
    """Gains of the object controller, eq (19): (translation 1/s^2, rotation 1/s^2) and (1/s, 1/s)."""

    kp: tuple[Positive, Positive] = (500.0, 300.0)
    kd: tuple[Positive, Positive] = (25.0, 15.0)


class Objective(Model):
    """How the rows of the state sensitivity are weighted in the cost, eq (13)."""

    weighting: Literal["scaled", "paper", "pose"] = "scaled"


class Tray(Model):
    """The tray on the flange; its top surface is `height` above the flange, parallel to it."""

    size: tuple[Metres, Metres] = (0.2, 0.2)
    thickness: Metres = 0.01
    height: NonNegative = 0.05
    mass: NonNegative = 0.150
    inertia: Vector3 = (1.25e-4, 1.25e-4, 1.25e-4)


class Arm(Model):
    """The arm: a known name (see `salver.models.arm`) or a URDF file with the frame that carries the tray."""

    model: str = "panda"
    flange: str | None = None
    base_position: Vector3 = (0.0, 0.0, 0.0)
    base_yaw_deg: Number = 0.0
    start_posture: list[Number] | None = None
    velocity_scale: Annotated[float, Field(gt=0, le=1)] = 0.98
    acceleration_scale: Annotated[float, Field(gt=0, le=1)] = 0.95
    jerk_scale: Annotated[float, Field(gt=0, le=1)] = 0.95
    torque_scale: Annotated[float, Field(gt=0, le=1)] = 1.0


class Obstacle(Model):
    """A keep-out region in the world."""

    type: Literal["box", "sphere", "capsule"]
    name: str = "obstacle"
    position: Vector3
    rpy_deg: Vector3 = (0.0, 0.0, 0.0)
    size: tuple[Metres, Metres, Metres] | None = None
    radius: Metres | None = None
    length: Metres | None = None

    @model_validator(mode="after")
    def _sized(self) -> Obstacle:
        needed = {"box": ("size",), "sphere": ("radius",), "capsule": ("radius", "length")}[self.type]
        for key in needed:
            if getattr(self, key) is None:
                raise ValueError(f"a {self.type} needs {' and '.join(needed)}")
        return self


class Physics(Model):
    """Physics engine and what lies between controller and arm."""

    timestep: Annotated[float, Field(gt=0, le=5e-3)] = 5e-4
    command_period: Annotated[float, Field(gt=0, le=0.02)] = 1e-3
    settle_before: NonNegative = 0.2
    settle_after: NonNegative = 0.5
    position_noise: NonNegative = 0.0
    velocity_noise: NonNegative = 0.0
    delay_steps: Annotated[int, Field(ge=0, le=20)] = 0
    joint_friction: NonNegative = 0.0
    feedback: Literal["joints", "object"] = "joints"


class Scenario(Model):
    """Everything that a plan depends on. Same scenario, same seed: same plan."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")]
    summary: str = ""
    source: str = ""
    seed: Annotated[int, Field(ge=0)] = 0
    motion: Motion
    objects: Annotated[list[CarriedObject], Field(min_length=1)]
    uncertainty: UncertaintySet = UncertaintySet()
    contact: Contact = Contact()
    control: Control = Control()
    objective: Objective = Objective()
    tray: Tray = Tray()
    arm: Arm | None = None
    obstacles: list[Obstacle] = []
    physics: Physics = Physics()

    @model_validator(mode="after")
    def _consistent(self) -> Scenario:
        from salver.models import bodies

        bodies.check_arrangement(self)
        return self

    @property
    def digest(self) -> str:
        """Content hash: 12 hexadecimal digits of the resolved scenario."""
        text = json.dumps(self.model_dump(mode="json"), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:12]

    def with_changes(self, **changes: Any) -> Scenario:
        """A copy with keys replaced, named by dotted paths with `__`: `motion__duration=1.5`. Checked again."""
        data = self.model_dump(mode="json", exclude_none=True)
        for path, value in changes.items():
            *parents, last = path.split("__")
            target: Any = data
            for key in parents:
                target = target[int(key)] if key.isdigit() else target.setdefault(key, {})
            if value is None:
                target.pop(last, None)
            else:
                target[last] = value
        return parse(data, "the changed scenario")


def parse(data: dict[str, Any], where: str) -> Scenario:
    """Check a dictionary. Raises ScenarioError, one sentence for each mistake."""
    try:
        return Scenario.model_validate(data)
    except ValidationError as error:
        raise ScenarioError("\n".join(_sentence(e, where) for e in error.errors())) from None


def load(name_or_path: str | Path) -> Scenario:
    """A ready-made scenario by name, or a TOML file by path. Raises ScenarioError."""
    path = Path(name_or_path)
    if path.suffix != ".toml":
        ready_made = SCENARIO_DIR / f"{name_or_path}.toml"
        if not ready_made.is_file():
            known = ", ".join(names())
            raise ScenarioError(f'There is no ready-made scenario "{name_or_path}"; known are {known}, or give a .toml file.')
        path = ready_made
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise ScenarioError(f"{path} cannot be read ({error.strerror}); a scenario is a .toml file.") from None
    except UnicodeDecodeError:
        raise ScenarioError(f"{path} is not a text file in UTF-8; a scenario is a .toml file.") from None
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ScenarioError(f"{path} is not valid TOML: {error}.") from None
    return parse(data, str(path))


def names() -> list[str]:
    """Names of the ready-made scenarios."""
    return sorted(p.stem for p in SCENARIO_DIR.glob("*.toml"))


def _sentence(error: Any, where: str) -> str:
    """One sentence for one mistake: file, key, value, what would be accepted."""
    skip = {"box", "cylinder", "prism", "mesh", "composite", "Relative", "function-before"}
    key = ""
    for part in error["loc"]:
        if isinstance(part, int):
            key += f"[{part}]"
        elif part not in skip and "[" not in part and not part.startswith("constrained"):
            key += f".{part}" if key else part
    kind, context, value = error["type"], error.get("ctx", {}), error.get("input")
    shown = "" if isinstance(value, dict) else f" = {value!r}"
    if kind == "extra_forbidden":
        return f"{where}: unknown key {key}{_suggestion(error['loc'])}."
    if kind == "missing":
        return f"{where}: {key} is missing; it is required."
    if kind == "value_error":
        text = str(context.get("error", error["msg"]))
        return f"{where}: {key}: {text}." if key else f"{where}: {text}."
    message = error["msg"][0].lower() + error["msg"][1:]
    message = message.replace("input should be", "must be")
    return f"{where}: {key}{shown}: {message}."


def _suggestion(loc: tuple[Any, ...]) -> str:
    """Nearest valid keys for an unknown one."""
    import difflib

    model: Any = Scenario
    for part in loc[:-1]:
        if isinstance(part, str) and hasattr(model, "model_fields") and part in model.model_fields:
            model = _inner_model(model.model_fields[part].annotation)
    fields = list(getattr(model, "model_fields", {}))
    close = difflib.get_close_matches(str(loc[-1]), fields, n=1)
    if close:
        return f"; did you mean {close[0]}"
    return f"; accepted are {', '.join(fields)}" if fields else ""


def _inner_model(annotation: Any) -> Any:
    """The first model inside an annotation such as list[X] or X | None."""
    from typing import get_args

    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for arg in get_args(annotation):
        found = _inner_model(arg)
        if found is not None:
            return found
    return None
