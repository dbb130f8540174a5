"""The scenario: the load, its motion, the arm, and the ranges of uncertain parameters.

A scenario is a TOML file, or the name of a ready-made one. It is checked in full before anything is
computed; each mistake is one sentence with the key, the value and what would be accepted.
"""

from salver.models.arm.tables import Arm, ArmLimits, MobileBase
from salver.models.described import Obstacle, Rim, Tray
from salver.scenario.cell import Physics, RobotBehaviour, Surroundings
from salver.scenario.files import SCENARIO_DIR, load, names
from salver.scenario.legs import Leg
from salver.scenario.liquid import LiquidIn
from salver.scenario.model import Scenario, parse
from salver.scenario.objects import (
    Box,
    CarriedObject,
    Composite,
    Cone,
    Cylinder,
    Mesh,
    Part,
    Prism,
    Shake,
    Uncertainty,
    UncertaintySet,
)
from salver.scenario.pendulum import PendulumIn
from salver.scenario.task import Contact, Control, Motion, Planning, Pose, SensitivityWeighting

__all__ = [
    "SCENARIO_DIR",
    "Arm",
    "ArmLimits",
    "Box",
    "CarriedObject",
    "Composite",
    "Cone",
    "Contact",
    "Control",
    "Cylinder",
    "Leg",
    "LiquidIn",
    "Mesh",
    "MobileBase",
    "Motion",
    "Obstacle",
    "Part",
    "PendulumIn",
    "Physics",
    "Planning",
    "Pose",
    "Prism",
    "Rim",
    "RobotBehaviour",
    "Scenario",
    "SensitivityWeighting",
    "Shake",
    "Surroundings",
    "Tray",
    "Uncertainty",
    "UncertaintySet",
    "load",
    "names",
    "parse",
]  # fmt: skip
