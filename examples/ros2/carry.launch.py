"""ros2 launch carry.launch.py motion:=/path/of/cube.yaml controller:=joint_trajectory_controller

Never run: there was no ROS 2 where it was written. See carry.py beside it.
"""

import sys
from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess
from launch.substitutions import LaunchConfiguration


def generate_launch_description() -> LaunchDescription:
    """The node, with the motion and the controller by name."""
    given = {"motion": "motion.yaml", "controller": "joint_trajectory_controller"}
    parameters = [part for name in given for part in ("-p", [f"{name}:=", LaunchConfiguration(name)])]
    node = ExecuteProcess(
        cmd=[sys.executable, str(Path(__file__).with_name("carry.py")), "--ros-args", *parameters], output="screen"
    )
    return LaunchDescription(
        [*(DeclareLaunchArgument(name, default_value=value) for name, value in given.items()), node]
    )
