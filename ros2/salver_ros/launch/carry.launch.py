"""ros2 launch salver_ros carry.launch.py scenario:=panda-cube mock:=true

With mock:=false the arm, its ros2_control and its controller are up already, and only the node starts.
"""

import subprocess
import tempfile
from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

ARGUMENTS = {
    "scenario": ("panda-cube", "a ready-made scenario, or the path of a .toml file"),
    "mock": ("true", "a simulated arm (mock_components) with its controllers"),
    "output": ("action", "action, topic (joint trajectories) or position (a stream)"),
    "controller": ("", "name of the controller; empty: the mock arm's for that output"),
    "heartbeat": ("0.0", "s without ~/heartbeat after which the arm is stopped; 0: none is expected"),
    "rviz": ("false", "start RViz"),
}


def nodes(context):
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    mocked = "forward_position_controller" if given["output"] == "position" else "joint_trajectory_controller"
    controller = given["controller"] or mocked
    parameters = {
        "scenario": given["scenario"], "output": given["output"], "controller": controller,
        "heartbeat": float(given["heartbeat"]),
    }  # fmt: skip
    found = [Node(package="salver_ros", executable="carry", name="salver", parameters=[parameters], output="screen")]
    if given["mock"] == "true":
        folder = Path(tempfile.mkdtemp(prefix="salver-"))  # python3 of the path: that of the environment with salver
        subprocess.run(["python3", "-m", "salver_ros.mock", given["scenario"], str(folder)], check=True)
        urdf = ParameterValue((folder / "robot.urdf").read_text(encoding="utf-8"), value_type=str)
        control = str(folder / "controllers.yaml")
        found += [
            Node(package="controller_manager", executable="ros2_control_node", parameters=[control], output="screen"),
            Node(
                package="robot_state_publisher",
                executable="robot_state_publisher",
                parameters=[{"robot_description": urdf}],
            ),
            Node(
                package="controller_manager",
                executable="spawner",
                arguments=["joint_state_broadcaster", controller, "--param-file", control],
            ),
        ]
    if given["rviz"] == "true":
        found.append(Node(package="rviz2", executable="rviz2"))
    return found


def generate_launch_description():
    declared = [DeclareLaunchArgument(k, default_value=v, description=d) for k, (v, d) in ARGUMENTS.items()]
    return LaunchDescription([*declared, OpaqueFunction(function=nodes)])
