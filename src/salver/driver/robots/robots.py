"""Robots as the control loop drives them, and the robots that are known by name.

A robot is asked for its state and given a command, once per period; `salver.driver.execution` does both, and checks,
watchdog, gate, stops and log are the same for all. Another robot is a class with these methods and a line in `ROBOTS`;
`salver.driver.robots.positions` has most of them for one that takes joint positions.
"""

from __future__ import annotations

from dataclasses import replace
from importlib import import_module
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Protocol

from salver.errors import SalverError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from salver.control.arm import ArmState
    from salver.driver.preflight import Check
    from salver.driver.sensing import Sensed
    from salver.geometry import Array
    from salver.models.arm.arm import ArmModel
    from salver.models.arm.arm_limits import JointLimits
    from salver.scenario import Scenario
    from salver.trajectory import JointMotion

ROBOTS = {
    "simulated": "salver.driver.robots.simulated:SimulatedRobot",
    "franka": "salver.driver.robots.franka:FrankaRobot",
    "ur": "salver.driver.robots.ur:URRobot",
    "xarm": "salver.driver.robots.xarm:XArmRobot",
}  # name: module and class


Takes = Literal["torque", "position", "velocity"]


class Robot(Protocol):
    """An arm under control.

    takes: quantity of its commands for each joint: torque (N m, with gravity; an adapter subtracts what its robot
    adds), position (rad) or velocity (rad/s). period: s between two commands. lag: s by which the joints follow their
    commands. speed: the share of full speed, 0 to 1, at which the robot lets itself be moved now. limits: those of the
    robot, where the arm of a scenario may have wider ones.
    """

    takes: Takes
    period: float
    lag: float
    speed: float
    limits: JointLimits | None

    def permit(self, motion: JointMotion) -> str:
        """Why the connected robot would not follow a motion, in a sentence; "" if it would."""
        ...

    @property
    def source(self) -> str:
        """The robot's name in the log."""
        ...

    def look(self) -> ArmState:
        """The state now, without control."""
        ...

    def start(self) -> None:
        """Begin to take commands; the first `read` follows."""
        ...

    def read(self) -> tuple[ArmState, float]:
        """Wait for the next period. The state, and the time since the last read, s (0 at first)."""
        ...

    def write(self, command: Array, sensed: Sensed, *, last: bool = False) -> None:
        """Send the command (n,) for this period. sensed: the state that counts as true. last: whether the motion ends
        with it."""
        ...

    def stop(self) -> None:
        """Accept no more commands, whatever happened."""
        ...

    def move(self, motion_from: Callable[[Array], JointMotion]) -> None:
        """Follow a slow joint motion from where the arm stands, with an empty tray. Raises SalverError when it is
        interrupted; the arm has stopped then."""
        ...


class RealRobot(Robot, Protocol):
    """A robot at an address. standard: its default options, a frozen dataclass, or None."""

    standard: ClassVar[Any] = None

    @classmethod
    def connect(cls, address: str, scenario: Scenario, arm: ArmModel, realtime: bool, options: Any = None) -> Robot:
        """The robot at an address, with the scenario's tray configured. realtime: refuse a machine that cannot keep the
        period. options: instead of `standard`.

        Raises SalverError when it does not answer, MissingDependencyError without its library.
        """
        ...

    @staticmethod
    def check(scenario: Scenario, arm: ArmModel, motion: JointMotion | None = None) -> list[Check]:
        """Checks of the arm and of a motion by this robot, beyond those of every plan, before it is connected."""
        ...


def robot_class(name: str) -> Any:
    """The class of a robot. Raises SalverError for a name that is not known."""
    if name not in ROBOTS:
        raise SalverError(f'There is no robot "{name}"; known are {", ".join(ROBOTS)}.')
    module, _, cls = ROBOTS[name].partition(":")
    return getattr(import_module(module), cls)


def robot_options(name: str, values: Mapping[str, float]) -> Any:
    """The options of a robot with some numbers changed. Raises SalverError for one that it does not have."""
    standard: Any = getattr(robot_class(name), "standard", None)
    kinds = {key: type(x) for key, x in (vars(standard) if standard else {}).items() if isinstance(x, (int, float))}
    for key, value in values.items():
        if key not in kinds:
            raise SalverError(f'The robot "{name}" has no option {key}; it has {", ".join(kinds) or "none"}.')
        if not 0 < value < float("inf") or kinds[key](value) != value:
            sort = "whole number" if kinds[key] is int else "number"
            raise SalverError(f"{key} is {value:g}; it must be a {sort} above 0.")
    return replace(standard, **{key: kinds[key](value) for key, value in values.items()}) if values else standard
