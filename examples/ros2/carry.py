"""Send a planned motion to a ROS 2 controller: a node for `ros2_control`'s joint_trajectory_controller.

    salver export runs/cube --format yaml -o cube.yaml
    ros2 launch carry.launch.py motion:=$PWD/cube.yaml controller:=joint_trajectory_controller

or, without the launch file, `python3 carry.py --ros-args -p motion:=cube.yaml`. It needs what ROS 2 brings (rclpy,
control_msgs, PyYAML), and neither NumPy nor salver. It waits for /joint_states, refuses unless the arm rests where the
motion begins, sends the motion as one goal of control_msgs/action/FollowJointTrajectory, and says how it ended.

**The node itself has never been run**: there was no ROS 2 where it was written. What the tests run is everything above
`main`: the file is read, the start compared, the goal filled, against message types of rosbags.

A controller follows late and smooths. Record a run with the load strapped to the tray, and let `salver track` tell what
that costs, before anything stands loose.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from typing import Any

NEAR = 0.01  # rad by which a joint may be away from the start
AT_REST = 0.01  # rad/s


def read_motion(path: str) -> dict[str, Any]:
    """The message of `salver export --format yaml` as a mapping. Raises ValueError, one sentence."""
    import yaml

    try:
        with open(path, encoding="utf-8") as file:
            message = yaml.load(file, getattr(yaml, "CSafeLoader", yaml.SafeLoader))
        names, points = message["joint_names"], message["points"]
        widths = {len(point["positions"]) for point in points}
        times = [point["time_from_start"]["sec"] + 1e-9 * point["time_from_start"]["nanosec"] for point in points]
        numbers = [float(x) for point in points for key in ("positions", "velocities") for x in point[key]]
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {error.strerror}.") from None
    except (yaml.YAMLError, KeyError, TypeError, ValueError):
        raise ValueError(f"{path} is no joint trajectory; write one with salver export --format yaml.") from None
    later = all(a < b for a, b in zip(times, times[1:]))  # noqa: B905, RUF007 (ROS 2 Humble has Python 3.10)
    if widths != {len(names)} or len(points) < 2 or not later or not all(map(math.isfinite, numbers)):
        raise ValueError(f"{path} is no motion: its points must be numbers for each joint, at times that grow.")
    return dict(message)


def not_at_start(
    motion: Mapping[str, Any], names: Sequence[str], positions: Sequence[float], velocities: Sequence[float]
) -> str:
    """Why a motion may not begin with joints that are read in any order (rad, rad/s); empty when it may."""
    for name, wanted in zip(motion["joint_names"], motion["points"][0]["positions"]):  # noqa: B905
        if name not in names:
            return f"/joint_states does not know {name}; it knows {', '.join(names)}."
        k = list(names).index(name)
        if not abs(positions[k] - wanted) <= NEAR:
            return f"{name} is at {positions[k]:.3f} rad, the motion begins at {wanted:.3f}; move it there first."
        if k < len(velocities) and not abs(velocities[k]) <= AT_REST:
            return f"{name} still moves at {velocities[k]:.3f} rad/s; the motion begins at rest."
    return ""


def trajectory(motion: Mapping[str, Any], types: Any) -> Any:
    """The motion as a trajectory_msgs/msg/JointTrajectory.

    types: has JointTrajectory, JointTrajectoryPoint and Duration. The effort is left out: a controller that does not
    command effort may refuse points that have some.
    """
    points = [
        types.JointTrajectoryPoint(
            positions=[float(x) for x in point["positions"]],
            velocities=[float(x) for x in point["velocities"]],
            accelerations=[float(x) for x in point["accelerations"]],
            time_from_start=types.Duration(**point["time_from_start"]),
        )
        for point in motion["points"]
    ]
    return types.JointTrajectory(joint_names=list(motion["joint_names"]), points=points)


def main() -> int:
    """The node. 0 when the controller says that the motion was carried out, 1 otherwise."""
    from types import SimpleNamespace

    import rclpy
    from builtin_interfaces.msg import Duration
    from control_msgs.action import FollowJointTrajectory
    from rclpy.action import ActionClient
    from sensor_msgs.msg import JointState
    from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

    types = SimpleNamespace(
        Duration=Duration, JointTrajectory=JointTrajectory, JointTrajectoryPoint=JointTrajectoryPoint
    )
    rclpy.init()
    node = rclpy.create_node("salver_carry")
    log = node.get_logger()
    try:
        path = node.declare_parameter("motion", "motion.yaml").value
        controller = node.declare_parameter("controller", "joint_trajectory_controller").value
        motion = read_motion(path)
        seen: list[Any] = []
        node.create_subscription(JointState, "joint_states", seen.append, 10)
        log.info("waiting for joint_states")
        while not seen:
            rclpy.spin_once(node, timeout_sec=0.1)
        now = seen[-1]
        refusal = not_at_start(motion, now.name, now.position, now.velocity)
        if refusal:
            log.error(refusal)
            return 1
        client = ActionClient(node, FollowJointTrajectory, f"{controller}/follow_joint_trajectory")
        if not client.wait_for_server(timeout_sec=5.0):
            log.error(f"There is no action server {controller}/follow_joint_trajectory.")
            return 1
        sent = client.send_goal_async(FollowJointTrajectory.Goal(trajectory=trajectory(motion, types)))
        rclpy.spin_until_future_complete(node, sent)
        if not sent.result().accepted:
            log.error(f"{controller} refuses the motion.")
            return 1
        done = sent.result().get_result_async()
        rclpy.spin_until_future_complete(node, done)
        result = done.result().result
        if result.error_code != FollowJointTrajectory.Result.SUCCESSFUL:
            log.error(f"{controller} ended the motion with {result.error_code}: {result.error_string}")
            return 1
        log.info("The motion was carried out.")
        return 0
    except ValueError as error:
        log.error(str(error))
        return 1
    finally:
        node.destroy_node()
        rclpy.shutdown()


if __name__ == "__main__":
    sys.exit(main())
