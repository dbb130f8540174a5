"""The scenario: the load, its motion, the arm, and the ranges of uncertain parameters.

A scenario is a TOML file, or the name of a ready-made one. It is checked in full before anything is
computed; each mistake is one sentence with the key, the value and what would be accepted.
"""

from salver.models.arm.tables import Arm
from salver.models.described import Obstacle, Tray
from salver.scenario.files import SCENARIO_DIR, load, names
from salver.scenario.model import Scenario, parse
from salver.scenario.objects import CarriedObject, Cone, Cylinder
from salver.scenario.task import Control, Motion, Pose

__all__ = [
    "SCENARIO_DIR",
    "Arm",
    "CarriedObject",
    "Cone",
    "Control",
    "Cylinder",
    "Motion",
    "Obstacle",
    "Pose",
    "Scenario",
    "Tray",
    "load",
    "names",
    "parse",
]
