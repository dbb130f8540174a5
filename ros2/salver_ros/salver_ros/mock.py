"""A simulated arm for ros2_control: the scenario's URDF with mock hardware that stands where the scenario begins, and
the parameters of its controllers. `python3 -m salver_ros.mock SCENARIO DIRECTORY` writes both."""

from __future__ import annotations

import sys
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from pinocchio.rpy import matrixToRpy

import salver as sv
from salver.errors import SalverError
from salver.models.arm.arm import ArmModel

TRAJECTORIES, POSITIONS = "joint_trajectory_controller", "forward_position_controller"


def robot_description(arm: ArmModel, q: np.ndarray, world: str = "world") -> str:
    """The arm's URDF below a link that is the scenario's frame S, with mock hardware at rest at q (n,)."""
    robot = ElementTree.fromstring(arm.urdf)
    children = {joint.find("child").get("link") for joint in robot.iter("joint") if joint.find("child") is not None}
    root = next(link.get("name") for link in robot.findall("link") if link.get("name") not in children)
    if root == world:  # of some URDFs, which know nothing of where their base stands
        root = f"{world}_of_the_arm"
        for element in (*robot.findall("link"), *robot.iter("parent"), *robot.iter("child")):
            key = "name" if element.tag == "link" else "link"
            element.set(key, root if element.get(key) == world else element.get(key, ""))
    for mesh in robot.iter("mesh"):
        if Path(mesh.get("filename", "")).is_absolute():
            mesh.set("filename", f"file://{mesh.get('filename')}")
    ElementTree.SubElement(robot, "link", name=world)
    base = ElementTree.SubElement(robot, "joint", name="salver_base", type="fixed")
    ElementTree.SubElement(base, "parent", link=world)
    ElementTree.SubElement(base, "child", link=str(root))
    place, turn = (" ".join(repr(float(x)) for x in row) for row in (arm.base_position, matrixToRpy(arm.R_base)))
    ElementTree.SubElement(base, "origin", xyz=place, rpy=turn)
    system = ElementTree.SubElement(robot, "ros2_control", name="salver_mock", type="system")
    hardware = ElementTree.SubElement(system, "hardware")
    ElementTree.SubElement(hardware, "plugin").text = "mock_components/GenericSystem"
    ElementTree.SubElement(hardware, "param", name="calculate_dynamics").text = "true"  # velocities too
    for name, value in zip(arm.joint_names, q, strict=True):
        joint = ElementTree.SubElement(system, "joint", name=name)
        ElementTree.SubElement(joint, "command_interface", name="position")
        state = ElementTree.SubElement(joint, "state_interface", name="position")
        ElementTree.SubElement(state, "param", name="initial_value").text = repr(float(value))
        ElementTree.SubElement(joint, "state_interface", name="velocity")
    return ElementTree.tostring(robot, encoding="unicode")


def controllers(joints: tuple[str, ...], rate: int = 500) -> str:
    """Parameters of the controller manager and of the two controllers that the node can drive, as YAML."""
    names = "".join(f"      - {joint}\n" for joint in joints)
    return (
        f"controller_manager:\n  ros__parameters:\n    update_rate: {rate}\n"
        "joint_state_broadcaster:\n  ros__parameters:\n"
        "    type: joint_state_broadcaster/JointStateBroadcaster\n"
        f"{TRAJECTORIES}:\n  ros__parameters:\n"
        "    type: joint_trajectory_controller/JointTrajectoryController\n"
        f"    joints:\n{names}"
        "    command_interfaces: [position]\n    state_interfaces: [position, velocity]\n"
        f"{POSITIONS}:\n  ros__parameters:\n"
        "    type: forward_command_controller/ForwardCommandController\n"
        f"    joints:\n{names}    interface_name: position\n"
    )


def main() -> int:
    """Write `robot.urdf` and `controllers.yaml`."""
    if len(sys.argv) != 3:
        sys.stderr.write("python3 -m salver_ros.mock SCENARIO DIRECTORY\n")
        return 2
    try:
        live = sv.Live(sys.argv[1])
        arm, folder = live.problem.arm, Path(sys.argv[2])
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "robot.urdf").write_text(robot_description(arm, live.command(0.0)[0]), encoding="utf-8")
        (folder / "controllers.yaml").write_text(controllers(arm.joint_names), encoding="utf-8")
    except (SalverError, OSError) as error:
        sys.stderr.write(f"{error}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
