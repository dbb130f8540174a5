"""ROS 2: a bag (mcap) with the joint trajectory and the tray's path, and these messages as YAML.

Quaternions of ROS are x, y, z, w. Times are whole nanoseconds from the start of the motion; the stamp of a message is
0, because a plan has no date.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from salver.errors import SalverError, needs
from salver.files import new_directory, write_atomic
from salver.geometry import Array
from salver.motion_files.motion import STOPS, MotionSeries
from salver.motion_files.verdict import warns

TOPICS = {
    "joint_trajectory": "trajectory_msgs/msg/JointTrajectory",
    "tray_path": "nav_msgs/msg/Path",
}
WORLD_FRAME = "world"
_BILLION = 1_000_000_000
Row = tuple[str, str, int, dict[str, Any]]  # topic, type, ns, content of a message
BAG_VERSION: Any = 8  # version of the bag's metadata, the older one that rosbags writes


def messages(motion: MotionSeries) -> dict[str, dict[str, Any]]:
    """The messages by topic, as mappings in the order of the message definitions."""
    out: dict[str, dict[str, Any]] = {}
    none = np.zeros((len(motion.ns), 0))
    given = {"positions": motion.q, "velocities": motion.dq, "accelerations": motion.ddq, "effort": motion.tau}
    if motion.joint_names:
        rows = {key: none if values is None else values for key, values in given.items()}
        out["joint_trajectory"] = {
            "header": header_of(0),
            "joint_names": list(motion.joint_names),
            "points": [
                {
                    **{key: values[k] for key, values in rows.items()},
                    "time_from_start": _time(int(ns)),
                }
                for k, ns in enumerate(motion.ns)
            ],
        }
    if motion.p_SE is not None and motion.quat_SE_wxyz is not None:
        out["tray_path"] = _path(motion, motion.p_SE, motion.quat_SE_wxyz)
    return out


def _path(motion: MotionSeries, positions: Array, quat_wxyz: Array) -> dict[str, Any]:
    poses = [
        {
            "header": header_of(int(ns)),
            "pose": {
                "position": dict(zip("xyz", map(float, p), strict=True)),
                "orientation": dict(zip("xyzw", map(float, q), strict=True)),
            },
        }
        for ns, p, q in zip(motion.ns, positions, np.roll(quat_wxyz, -1, axis=1), strict=True)
    ]
    return {"header": header_of(0), "poses": poses}


def header_of(ns: int, frame: str = WORLD_FRAME) -> dict[str, Any]:
    """A std_msgs/Header as a mapping."""
    return {"stamp": _time(ns), "frame_id": frame}


def _time(ns: int) -> dict[str, int]:
    return {"sec": ns // _BILLION, "nanosec": ns % _BILLION}


def write_bag(motion: MotionSeries, path: Path) -> list[Path]:
    """Write a rosbag2 directory with one mcap file and one message in each topic; the topic STOPS has one message for
    each stop, recorded at the instant at which the motion may be left. Raises SalverError when `path` exists."""
    rows: list[Row] = [(f"/salver/{topic}", TOPICS[topic], 0, found) for topic, found in messages(motion).items()]
    for leave, stop in motion.stops:
        message = {**messages(stop)["joint_trajectory"], "header": header_of(leave)}
        rows.append((STOPS, TOPICS["joint_trajectory"], leave, message))
    with new_directory(path, "a ROS 2 bag") as made:
        write_rows(made, rows, motion.verdict)
    return sorted(path.iterdir())


def write_rows(bag: Path, rows: Iterable[Row], verdict: str = "") -> None:
    """Write messages into a new rosbag2 directory. Raises MissingDependencyError."""
    with needs("bags", "A ROS 2 bag"):
        from rosbags.rosbag2 import StoragePlugin, Writer
        from rosbags.typesys import Stores, get_typestore

    store, connections = get_typestore(Stores.ROS2_JAZZY), dict[str, Any]()
    with Writer(bag, version=BAG_VERSION, storage_plugin=StoragePlugin.MCAP) as writer:
        if verdict:
            writer.set_custom_data("verdict", verdict)
        for topic, kind, ns, content in rows:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(connections[topic], ns, store.serialize_cdr(typed(store, kind, content), kind))


def typed(store: Any, kind: str, values: dict[str, Any]) -> Any:
    """A message of rosbags with values from a mapping; missing fields are zero or empty.

    Raises KeyError for a field that the message does not have.
    """
    members: dict[str, Any] = {}
    if unknown := values.keys() - {name for name, _ in store.fielddefs[kind][1]}:
        raise KeyError(f"{kind} has no {unknown.pop()}")
    for name, (node, detail) in store.fielddefs[kind][1]:
        value, many = values.get(name), node.name in ("ARRAY", "SEQUENCE")
        (inner_node, inner) = detail[0] if many else (node, detail)
        if inner_node.name == "NAME":
            members[name] = (
                [typed(store, inner, one) for one in value or []] if many else typed(store, inner, value or {})
            )
        elif many:
            text = inner[0] == "string"
            members[name] = list(value or []) if text else np.asarray([] if value is None else value, dtype=inner[0])
        else:
            members[name] = value if value is not None else "" if inner[0] == "string" else 0
    return store.types[kind](**members)


def write_yaml(motion: MotionSeries, path: Path) -> list[Path]:
    """Write a message as `ros2 topic pub` reads it: the joint trajectory, or the tray's path without an arm."""
    topic, message = next(iter(messages(motion).items()))
    text = _headed(motion, TOPICS[topic]) + "\n".join(_block(message, "")) + "\n"
    return [write_atomic(path, text, keep=True), *_write_stops(motion, path, lambda message: message)]


def _write_stops(motion: MotionSeries, path: Path, wrapped: Callable[[dict[str, Any]], dict[str, Any]]) -> list[Path]:
    """Write the stops to PATH with _stops before its ending: a table of times, and the trajectories by name."""
    if not motion.stops:
        return []
    table, named = [], {}
    for k, (leave, stop) in enumerate(motion.stops):
        name = f"stop_{k:02d}"
        table.append({"name": name, "leave_at": _time(leave), "rests_at": _time(leave + int(stop.ns[-1]))})
        named[name] = wrapped(messages(stop)["joint_trajectory"])
    head = _headed(motion, "Stops that keep the load. Asked to stop, leave the motion at the next leave_at")
    head += "# for the trajectory of that name; where none is left, finish the motion. Checked at full speed only.\n"
    text = head + "\n".join(_block({"table": table, **named}, "")) + "\n"
    return [write_atomic(path.with_name(f"{path.stem}_stops{path.suffix}"), text, keep=True)]


def write_robot_trajectory(motion: MotionSeries, path: Path) -> list[Path]:
    """Write a moveit_msgs/RobotTrajectory. Raises SalverError for a motion without joints."""

    def wrapped(joints: dict[str, Any]) -> dict[str, Any]:
        return {"joint_trajectory": joints, "multi_dof_joint_trajectory": _NO_OTHER_JOINTS}

    if not motion.joint_names:
        raise SalverError(f"{path} cannot be a joint trajectory: the motion is one of the tray, without joints.")
    message = wrapped(messages(motion)["joint_trajectory"])
    text = _headed(motion, "moveit_msgs/msg/RobotTrajectory") + "\n".join(_block(message, "")) + "\n"
    return [write_atomic(path, text, keep=True), *_write_stops(motion, path, wrapped)]


def _headed(motion: MotionSeries, kind: str) -> str:
    """The comments above a message: its type and the verdict on its motion, first if that is a warning."""
    lines = [f"# {text}\n" for text in (kind, motion.verdict) if text]
    return "".join(reversed(lines) if warns(motion.verdict) else lines)


_NO_OTHER_JOINTS = {"header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}, "joint_names": [], "points": []}


def _block(value: dict[str, Any], indent: str) -> list[str]:
    """YAML lines of a mapping: entries with only scalars in one line, others indented.

    A general YAML emitter would take ten times as long for a thousand points.
    """
    lines = []
    for key, item in value.items():
        if isinstance(item, list) and item and isinstance(item[0], dict):
            lines.append(f"{indent}{key}:")
            for element in item:
                first, *rest = _block(element, indent + "  ")
                lines += [f"{indent}- {first.lstrip()}", *rest]
        elif isinstance(item, dict) and any(isinstance(x, dict) for x in item.values()):
            lines += [f"{indent}{key}:", *_block(item, indent + "  ")]
        else:
            lines.append(f"{indent}{key}: {_flow(item)}")
    return lines


def _flow(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key}: {_flow(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list | np.ndarray):
        return "[" + ", ".join(_flow(item) for item in value) + "]"
    if isinstance(value, float):
        text = repr(float(value))
        # YAML 1.1, which ROS reads, parses 1e-05 as text.
        return text if "e" not in text or "." in text else text.replace("e", ".0e")
    return json.dumps(value)
