"""Controllers of the arm in a run: salver's own, or a model of a robot's internal one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from salver.control.arm import ArmController, PositionController, controller_for
from salver.errors import ScenarioError
from salver.geometry import Array
from salver.models.arm.arm import ArmModel
from salver.models.bodies import Body
from salver.models.rigid_body import RigidBody
from salver.scenario import Scenario
from salver.trajectory import JointMotion, Reference


def each_joint(values: float | Sequence[float], arm: ArmModel, key: str) -> Array:
    """One value for each joint (n,), from one number or a list. Raises ScenarioError for a list of another length."""
    given = np.asarray(values, dtype=float)
    if given.ndim and len(given) != arm.n:
        raise ScenarioError(
            f"{key} has {len(given)} values; {arm.name} has {arm.n} joints: give one number, or {arm.n}."
        )
    return np.broadcast_to(given, (arm.n,)).copy()


def believed(scenario: Scenario) -> tuple[Body, ...]:
    """The load as it is configured in the robot: the first object is heavier by `physics.robot.payload_error`."""
    first, *others = scenario.payload.bodies
    error, nominal = scenario.physics.robot.payload_error, first.inertial
    if error == 0:
        return (first, *others)
    mass = nominal.mass + error
    if mass < 0:
        raise ScenarioError(
            f"physics.robot.payload_error = {error:g} kg makes the mass of {first.name}, {nominal.mass:g} kg, "
            f"negative; it must be at least {-nominal.mass:g} kg."
        )
    share = mass / nominal.mass
    return (replace(first, inertial=RigidBody(mass, nominal.com_B, share * nominal.inertia_com)), *others)


def robot_for(
    scenario: Scenario,
    joint: JointMotion,
    reference: Reference | None,
    arm: ArmModel,
    space: Literal["object", "joint"] = "object",
) -> ArmController:
    """The controller of a scenario's robot (`physics.robot`) for a joint motion.

    space: whether salver's own controller closes its loop on the object or on the joints; a position-controlled robot
    always closes it on the joints.
    """
    robot = scenario.physics.robot
    if robot.control == "torque":
        return controller_for(scenario, joint, reference, arm=arm, space=space, bodies=believed(scenario))
    rate = 2 * np.pi * each_joint(robot.bandwidth, arm, "physics.robot.bandwidth")
    damping = each_joint(robot.damping, arm, "physics.robot.damping")
    period = scenario.physics.command_period
    return PositionController(arm, believed(scenario), joint, rate, damping, robot.delay, period=period)
