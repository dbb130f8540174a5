"""The scenario: what is carried, how, from where to where, and what is not known about it.

A scenario is a TOML file, or the name of a ready-made one. It is checked in full before anything is
computed; each mistake is one sentence with the key, the value and what would be accepted.
"""

from __future__ import annotations

import hashlib
import json
import tomllib
from collections.abc import Mapping
from copy import deepcopy
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, ValidationError, model_validator

from salver.display import Shown
from salver.errors import ScenarioError
from salver.models.arm_limits import PLANNING_SHARES
from salver.models.urdf import MOST_JOINTS
from salver.scenario.fields import (
    Degrees,
    File,
    Inertia,
    Metres,
    Model,
    Name,
    Number,
    Point,
    Scale,
    Share,
    Text,
    Turns,
    Whole,
)  # fmt: skip
from salver.scenario.objects import (
    Box,
    CarriedObject,
    Composite,
    Cylinder,
    Mesh,
    Part,
    Prism,
    Uncertainty,
    UncertaintySet,
)
from salver.validation import sentences

if TYPE_CHECKING:
    from salver.models.payload import Payload

__all__ = [
    "SCENARIO_DIR", "Arm", "ArmLimits", "Box", "CarriedObject", "Composite", "Contact", "Control", "Cylinder", "Mesh",
    "Motion", "Objective", "Obstacle", "Part", "Physics", "Pose", "Prism", "Scenario", "Tray", "Uncertainty",
    "UncertaintySet", "load", "names", "parse",
]  # fmt: skip

SCENARIO_DIR = Path(__file__).parent.parent / "scenarios"
MOST_COEFFICIENTS = 256  # of the friction cones of one object
MOST_VALUES = 5e7  # numbers in the largest array of a plan: 0.4 GB
CHECKED = 10  # instants of the check for each node
MOST_STEPS = 1e6  # of the engine in one run: minutes
LONGEST = 5.0  # s that a motion is taken to last where its duration is left open
LONGEST_TEXT = 1_000_000  # bytes of a scenario file


class Pose(Model):
    """Pose of the object frame B in the world S; orientation by roll, pitch, yaw or by a quaternion."""

    position: Point
    rpy_deg: Turns | None = None
    quat_wxyz: tuple[Number, Number, Number, Number] | None = None

    @model_validator(mode="after")
    def _one_orientation(self) -> Pose:
        if self.rpy_deg is not None and self.quat_wxyz is not None:
            raise ValueError("give the orientation by rpy_deg or by quat_wxyz, not by both")
        if self.quat_wxyz is not None and abs(np.linalg.norm(self.quat_wxyz) - 1) > 1e-3:
            raise ValueError(f"quat_wxyz has norm {np.linalg.norm(self.quat_wxyz):.4g}; a rotation has norm 1")
        return self

    @cached_property
    def rotation(self) -> np.ndarray:
        from salver.geometry import matrix_from_quat_wxyz, matrix_from_rpy

        if self.quat_wxyz is not None:
            return matrix_from_quat_wxyz(self.quat_wxyz)
        return matrix_from_rpy(np.deg2rad(self.rpy_deg if self.rpy_deg is not None else (0.0, 0.0, 0.0)))


class Motion(Model):
    """Rest to rest from `start` to `goal`, and how the reference trajectory is parameterised."""

    start: Pose
    goal: Pose
    duration: Annotated[Number, Field(ge=0.01, le=120)] | None = None
    degree: Annotated[Whole, Field(ge=5, le=30)] = 9
    nodes: Annotated[Whole, Field(ge=11, le=2001)] = 61
    orientation: Literal["fixed", "free"] | None = None
    max_tilt_deg: Annotated[Number, Field(gt=0, le=90)] | None = None
    goal_yaw: Literal["fixed", "free"] = "fixed"

    @property
    def may_turn(self) -> bool:
        """Whether the tray may tilt and turn on the way; unless it is said, only the fastest motion may."""
        return self.duration is None if self.orientation is None else self.orientation == "free"


class Contact(Model):
    """Which contact condition the plan must keep, and how friction cones are linearised.

    margin: what the condition must keep over its tube, in N of a cone coefficient (paper), or as a share of the
    normal force at rest (exact).
    """

    condition: Literal["paper", "exact"] = "paper"
    edges: Annotated[Whole, Field(ge=3, le=32)] = 4
    edge_phase_deg: Degrees = 0.0
    margin: Annotated[Number, Field(ge=0, le=1000)] = 1e-3


Stiffness = Annotated[Number, Field(ge=1e-3, le=1e5)]  # 1/s^2
Damping = Annotated[Number, Field(ge=1e-3, le=1e3)]  # 1/s


class Control(Model):
    """Gains of the object controller, eq (19): (translation 1/s^2, rotation 1/s^2) and (1/s, 1/s)."""

    kp: tuple[Stiffness, Stiffness] = (500.0, 300.0)
    kd: tuple[Damping, Damping] = (25.0, 15.0)

    def check_held(self, period: float) -> None:
        """Raise ValueError when the error dynamics grow because each command is held for a period (s)."""
        for kp, kd in zip(self.kp, self.kd, strict=True):
            # Over one period e'' is what the gains made of e and e' at its beginning.
            step = np.array(
                [[1 - 0.5 * kp * period**2, period - 0.5 * kd * period**2], [-kp * period, 1 - kd * period]]
            )
            if np.abs(np.linalg.eigvals(step)).max() >= 1:
                raise ValueError(
                    f"control.kp = {kp:g} 1/s^2 with control.kd = {kd:g} 1/s is unstable when commands are held for "
                    f"physics.command_period = {period:g} s; give smaller gains, or kd nearer to 2 sqrt(kp)"
                )


class Objective(Model):
    """How the rows of the state sensitivity are weighted in the cost, eq (13)."""

    weighting: Literal["scaled", "paper", "pose"] = "scaled"


class Tray(Model):
    """The tray on the flange; its top surface is `height` above the flange, parallel to it."""

    size: tuple[Metres, Metres] = (0.2, 0.2)
    thickness: Metres = 0.01
    height: Annotated[Number, Field(ge=0, le=5)] = 0.05
    mass: Annotated[Number, Field(ge=0, le=100)] = 0.150
    inertia: tuple[Inertia, Inertia, Inertia] = (1.25e-4, 1.25e-4, 1.25e-4)

    @model_validator(mode="after")
    def _physical(self) -> Tray:
        """The inertia of a body between the flange and the tray's surface, no wider than the tray."""
        low, middle, high = sorted(self.inertia)
        if low < 0 or high > (low + middle) * (1 + 1e-6):
            raise ValueError(
                f"inertia = {list(self.inertia)} kg m^2 is that of no body: none may be negative, none larger than the "
                "sum of the other two"
            )
        most = self.mass * (0.25 * (self.size[0] ** 2 + self.size[1] ** 2) + max(self.height, self.thickness) ** 2)
        if high > most * (1 + 1e-6):
            raise ValueError(
                f"inertia = {list(self.inertia)} kg m^2 is too large: {self.mass:g} kg between the flange and the "
                f"tray's surface, no wider than the tray, have at most {most:.3g}"
            )
        return self


Limit = Annotated[Number, Field(ge=1e-6, le=1e9)]
EachJoint = Annotated[
    Limit | Annotated[list[Limit], Field(max_length=MOST_JOINTS)],
    Field(description="a number at least 1e-06 and at most 1e+09, or a list of such numbers, one for each joint"),
]
Angle = Annotated[Number, Field(ge=-100, le=100)]  # rad, or m for a joint that slides


class ArmLimits(Model):
    """Limits of the joints, one number for all or one for each: rad/s, rad/s^2, rad/s^3, N m, N m/s (m, N for a joint
    that slides). They go before what the maker, a URDF or a `joint_limits.yaml` says."""

    velocity: EachJoint | None = None
    acceleration: EachJoint | None = None
    jerk: EachJoint | None = None
    torque: EachJoint | None = None
    torque_rate: EachJoint | None = None


class Arm(Model):
    """The arm: a known name (see `salver.models.arm`) or a URDF file with the frame that carries the tray.

    package_dirs: where the packages are whose meshes the URDF names. collisions: what to do about links whose geometry
    cannot be read: refuse, fit capsules to them, or leave them unchecked.
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
    def limit_shares(self) -> dict[str, float]:
        """The share of each kind of limit (`salver.models.arm_limits.LIMITS`, by key) that a plan may use."""
        return {key: getattr(self, f"{key}_scale", share) for key, share in PLANNING_SHARES.items()}


class Obstacle(Model):
    """A keep-out region in the world. A mesh counts as the convex hulls of its separate pieces."""

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


Settling = Annotated[Number, Field(ge=0, le=60)]  # s


class Physics(Model):
    """Physics engine and what lies between controller and arm."""

    timestep: Annotated[Number, Field(ge=1e-5, le=5e-3)] = 5e-4
    command_period: Annotated[Number, Field(ge=1e-4, le=0.02)] = 1e-3
    settle_before: Settling = 0.2
    settle_after: Settling = 0.5
    position_noise: Annotated[Number, Field(ge=0, le=1)] = 0.0
    velocity_noise: Annotated[Number, Field(ge=0, le=10)] = 0.0
    delay_steps: Annotated[Whole, Field(ge=0, le=20)] = 0
    joint_friction: Annotated[Number, Field(ge=0, le=1000)] = 0.0
    feedback: Literal["joints", "object"] = "joints"

    def steps(self, duration: float) -> float:
        """How many steps of the engine, or of the controller, a run of a motion takes."""
        return (duration + self.settle_before + self.settle_after) / min(self.timestep, self.command_period)


class Scenario(Shown, Model):
    """Everything that a plan depends on. Same scenario, same seed: same plan."""

    name: Annotated[
        str,
        Field(
            pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$",
            max_length=64,
            description="letters, digits, points, - and _, a letter or digit first, at most 64",
        ),
    ]
    summary: Text = ""
    source: Text = ""
    seed: Annotated[Whole, Field(ge=0, le=2**63 - 1)] = 0
    motion: Motion
    objects: Annotated[list[CarriedObject], Field(min_length=1, max_length=20)]
    uncertainty: UncertaintySet = UncertaintySet()
    contact: Contact = Contact()
    control: Control = Control()
    objective: Objective = Objective()
    tray: Tray = Tray()
    arm: Arm | None = None
    obstacles: list[Obstacle] = Field(default=[], max_length=100)
    physics: Physics = Physics()

    def facts(self) -> dict[str, str]:
        """What a notebook shows of it."""
        motion = self.motion
        distance = float(np.linalg.norm(np.subtract(motion.goal.position, motion.start.position)))
        uncertain = self.payload.uncertain
        return {
            "name": self.name,
            "carried": ", ".join(f"{o.name} {o.mass:g} kg, friction {o.friction:g}" for o in self.objects),
            "arm": Path(self.arm.model).stem if self.arm else "none",
            "way": f"{distance:.3g} m in {f'{motion.duration:g} s' if motion.duration else 'the shortest safe time'}",
            "uncertain": ", ".join(
                f"{name} ±{half:.3g}" for name, half in zip(uncertain.names, uncertain.half_range, strict=True)
            )
            or "nothing",
            "summary": self.summary,
        }

    @model_validator(mode="after")
    def _consistent(self) -> Scenario:
        self._bounded()
        self.payload.check()
        for key, pose in (("start", self.motion.start), ("goal", self.motion.goal)):
            tilt = np.rad2deg(np.arccos(np.clip(pose.rotation[2, 2], -1, 1)))
            for item in self.objects:
                least = item.least_friction
                holds = np.rad2deg(np.arctan(least))
                if tilt > holds + 1e-6:
                    raise ValueError(
                        f"motion.{key} tilts the tray by {tilt:.4g} deg, where {item.name} slides already at rest; "
                        f"with its least friction of {least:.4g} at most {holds:.4g} deg hold"
                    )
        return self

    def _bounded(self) -> None:
        """Raise ValueError when plans of this would take more memory or time than a machine has."""
        for item, body in zip(self.objects, self.payload.bodies, strict=True):
            count = body.contacts.count * self.contact.edges
            if count > MOST_COEFFICIENTS:
                raise ValueError(
                    f"{item.name} has {body.contacts.count} contact points with contact.edges = {self.contact.edges} "
                    f"each, which makes {count} cone coefficients; at most {MOST_COEFFICIENTS} are accepted"
                )
            values = CHECKED * self.motion.nodes * count * (2 + self.payload.uncertain.size)
            if values > MOST_VALUES:
                raise ValueError(
                    f"motion.nodes = {self.motion.nodes} with {count} cone coefficients and "
                    f"{self.payload.uncertain.size} uncertain parameters makes {values:.2g} numbers; at most "
                    f"{MOST_VALUES:.2g} are accepted: give fewer nodes or contact.edges"
                )
        if self.arm is not None:
            self.control.check_held(self.physics.command_period)
        steps = self.physics.steps(self.motion.duration or LONGEST)
        if steps > MOST_STEPS:
            raise ValueError(
                f"physics.timestep = {self.physics.timestep:g} s makes {steps:.2g} steps of a run; at most "
                f"{MOST_STEPS:.2g} are accepted: give a longer one, or a shorter motion"
            )

    @cached_property
    def payload(self) -> Payload:
        """What is carried, as mechanics see it: bodies, who touches whom, what is uncertain."""
        from salver.models.bodies import bodies
        from salver.models.payload import Payload

        loose = [item.loose() for item in self.objects]
        standing = bodies(loose, self.contact.edges, float(np.deg2rad(self.contact.edge_phase_deg)))
        return Payload(standing, self.uncertainty.around(self.objects, loose), 0.5 * np.array(self.tray.size))

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """Pydantic's, without what was made of the old values. It checks nothing: prefer `with_changes`."""
        copy = super().model_copy(update=update, deep=deep)
        copy.__dict__.pop("payload", None)
        return copy

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
                target[last] = deepcopy(value)  # a later path may lead into it
        return parse(data, "the changed scenario")


def parse(data: dict[str, Any], where: str) -> Scenario:
    """Check a dictionary. Raises ScenarioError, one sentence for each mistake."""
    try:
        return Scenario.model_validate(data)
    except ValidationError as error:
        raise ScenarioError("\n".join(sentences(error, Scenario, data, where))) from None


def load(name_or_path: str | Path) -> Scenario:
    """A ready-made scenario by name, or a TOML file by path. Raises ScenarioError."""
    path = Path(name_or_path)
    if path.suffix != ".toml":
        ready_made = SCENARIO_DIR / f"{name_or_path}.toml"
        if not ready_made.is_file():
            known = ", ".join(names())
            raise ScenarioError(
                f'There is no ready-made scenario "{name_or_path}"; known are {known}, or give a .toml file.'
            )
        path = ready_made
    try:
        if path.stat().st_size > LONGEST_TEXT:
            raise ScenarioError(f"{path} is larger than {LONGEST_TEXT // 1000} kB; a scenario is a .toml file.")
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise ScenarioError(f"{path} is not a text file in UTF-8; a scenario is a .toml file.") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ScenarioError(f"{path} cannot be read ({reason}); a scenario is a .toml file.") from None
    try:
        data = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # TOMLDecodeError, and numbers and nesting beyond Python's
        raise ScenarioError(f"{path} is not valid TOML: {error}.") from None
    _find_files(data, path.parent)
    return parse(data, str(path))


def _find_files(data: dict[str, Any], folder: Path) -> None:
    """Files that a scenario names are looked for beside it; from here on their paths are absolute."""

    def tables(value: Any) -> list[dict[str, Any]]:
        return [item for item in (value if isinstance(value, list) else [value]) if isinstance(item, dict)]

    def resolved(value: Any) -> Any:
        try:
            return str((folder / value).resolve()) if isinstance(value, str) else value
        except (OSError, RuntimeError, ValueError):  # a circle of links, a letter that no path has
            return value

    for arm in tables(data.get("arm")):
        if str(arm.get("model")).endswith((".urdf", ".xml", ".xacro")):
            arm["model"] = resolved(arm["model"])
        for key in ("srdf", "joint_limits"):
            if key in arm:
                arm[key] = resolved(arm[key])
        if isinstance(arm.get("package_dirs"), list):
            arm["package_dirs"] = [resolved(item) for item in arm["package_dirs"]]
    for item in tables(data.get("objects")):
        for shape in tables(item.get("shape")):
            if "file" in shape:
                shape["file"] = resolved(shape["file"])
    for obstacle in tables(data.get("obstacles")):
        if "file" in obstacle:
            obstacle["file"] = resolved(obstacle["file"])


def names() -> list[str]:
    """Names of the ready-made scenarios."""
    return sorted(p.stem for p in SCENARIO_DIR.glob("*.toml"))
