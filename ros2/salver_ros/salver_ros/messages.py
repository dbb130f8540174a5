"""Messages of ROS as plain data, and back: mappings that `rosidl_runtime_py.set_message_fields` fills a message with.

What is read may be a message of rclpy or of rosbags. Quaternions of ROS are x, y, z, w.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from salver_ros.carrier import Trajectory

BILLION = 1_000_000_000
TRIANGLE_LIST = 11  # of visualization_msgs/msg/Marker
FEATURES = ("positions", "velocities", "accelerations")


def time_of(seconds: float) -> dict[str, int]:
    """A builtin_interfaces Time or Duration."""
    ns = round(seconds * 1e9)
    return {"sec": ns // BILLION, "nanosec": ns % BILLION}


def seconds_of(stamp: Any) -> float:
    """Of a Time or a Duration."""
    return float(stamp.sec + 1e-9 * stamp.nanosec)


def trajectory_message(motion: Trajectory) -> dict[str, Any]:
    """A trajectory_msgs/msg/JointTrajectory that begins at a time of the clock, or on arrival where that is 0.

    Without effort: controllers that command none refuse points that have some.
    """
    rows = zip(motion.t, motion.q, motion.dq, motion.ddq, strict=True)
    points = [
        {**{name: x.tolist() for name, x in zip(FEATURES, row[1:], strict=True)}, "time_from_start": time_of(row[0])}
        for row in rows
    ]
    header = {"stamp": time_of(motion.begins), "frame_id": ""}
    return {"header": header, "joint_names": list(motion.names), "points": points}


def trajectory_of(message: Any) -> Trajectory:
    """Of a trajectory_msgs/msg/JointTrajectory. Raises ValueError, one sentence."""
    names, points = tuple(message.joint_names), message.points
    if len(points) < 2:
        raise ValueError(f"The trajectory has {len(points)} points; it must have two or more.")
    columns = []
    for name in FEATURES:
        widths = {len(getattr(point, name)) for point in points}
        if widths not in ({len(names)}, {0}) or (name == "positions" and widths != {len(names)}):
            raise ValueError(f"The trajectory's {name} must be {len(names)} numbers in each point, one for each joint.")
        columns.append(np.array([list(getattr(point, name)) for point in points], dtype=float))
    t = np.array([seconds_of(point.time_from_start) for point in points])
    return Trajectory(names, seconds_of(message.header.stamp), t, *columns)


def state_message(level: int, sentence: str, facts: dict[str, str], name: str) -> dict[str, Any]:
    """A diagnostic_msgs/msg/DiagnosticStatus, but for its level, a byte that rclpy wants as bytes."""
    values = [{"key": key, "value": value} for key, value in facts.items()]
    return {"level": bytes([level]), "name": f"salver: {name}", "message": sentence, "values": values}


def marker_messages(markers: list[dict[str, Any]], flange: str) -> dict[str, Any]:
    """A visualization_msgs/msg/MarkerArray that moves with the flange's frame."""
    one = {"x": 1.0, "y": 1.0, "z": 1.0}
    return {
        "markers": [
            {
                "header": {"stamp": time_of(0.0), "frame_id": flange},
                "ns": marker["name"],
                "type": TRIANGLE_LIST,
                "scale": one,
                "color": {**dict(zip("rgb", marker["colour"], strict=True)), "a": 1.0},
                "frame_locked": True,
                "points": [dict(zip("xyz", map(float, point), strict=True)) for point in marker["points"]],
            }
            for marker in markers
        ]
    }
