"""Motions in the formats of ROS: a JointTrajectory message as YAML or JSON, and bags through rosbags.

Quaternions of ROS are x, y, z, w; only this module and `ros_writers` convert them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np

from salver.errors import FileFormatError, needs
from salver.files import read_json, read_text
from salver.geometry import Array, interpolated
from salver.motion_files.motion import STOPS
from salver.motion_files.samples import FEWEST, JointSamples, Samples, TraySamples, joint_samples, tray_samples

TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
JOINT_STATE = "sensor_msgs/msg/JointState"
POSE = "geometry_msgs/msg/PoseStamped"
PATH = "nav_msgs/msg/Path"
WRENCH = "geometry_msgs/msg/WrenchStamped"
SPARSE = 0.03  # s, largest distance from a joint's sample to one of the wrist
KINDS = (TRAJECTORY, JOINT_STATE, POSE, PATH)
OBJECT = "object_path"  # end of the topic or file with an object's path, as salver once exported it
LARGEST_YAML, LARGEST_JSON = 5_000_000, 100_000_000  # bytes; YAML is read at about 0.2 MB/s
LARGEST_BAG = 2_000_000_000  # bytes
MOST_MESSAGES = 5_000_000
_NESTED = ("trajectory", "joint_trajectory", "planned_trajectory", "msg", "goal")


def read_document(path: Path) -> Any:
    """The (first) document of a YAML or JSON file."""
    json_file = path.suffix.lower() == ".json"
    most = LARGEST_JSON if json_file else LARGEST_YAML
    if path.is_file() and path.stat().st_size > most:
        other = "" if json_file else ", or JSON, which is read faster"
        raise FileFormatError(f"{path} is larger than {most // 1_000_000} MB; give a bag{other}.")
    return read_json(path) if json_file else _yaml(read_text(path), path)


def samples_of(document: Any, path: Path, as_path: bool = False) -> Samples:
    """A trajectory_msgs/JointTrajectory or a nav_msgs/Path, as `ros2 topic echo` or a script writes it."""
    message = _find_trajectory(document)
    if message is not None:
        return _from_trajectory(message["joint_names"], message["points"], str(path), as_path)
    if isinstance(document, Mapping) and _is_row(document.get("poses")):
        return _from_path(document["poses"], str(path))
    raise FileFormatError(
        f"{path} holds no JointTrajectory, which needs joint_names and points, and no Path, which needs poses."
    )


def _yaml(text: str, path: Path) -> Any:
    """The first document of a YAML text. Aliases are refused, because messages have none and they can expand without
    limit."""
    from ruamel.yaml import YAML
    from ruamel.yaml.composer import Composer, ComposerError
    from ruamel.yaml.error import YAMLError
    from ruamel.yaml.events import AliasEvent

    class NoAliases(Composer):
        def compose_node(self, parent: Any, index: Any) -> Any:
            if self.parser.check_event(AliasEvent):
                event = self.parser.peek_event()
                raise ComposerError(
                    None, None, f"it uses the alias *{event.anchor}, which messages do not have", event.start_mark
                )
            return super().compose_node(parent, index)

    loader = YAML(typ="safe", pure=True)
    loader.Composer = NoAliases
    try:
        return next(iter(loader.load_all(text)), None)
    except YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f" at line {mark.line + 1}" if mark else ""
        raise FileFormatError(
            f"{path} is not YAML: {getattr(error, 'problem', None) or 'cannot be parsed'}{where}."
        ) from None
    except (ValueError, TypeError, RecursionError, OverflowError) as error:  # beyond Python's limits
        raise FileFormatError(f"{path} is not YAML of a trajectory ({type(error).__name__}).") from None


def _find_trajectory(data: Any, depth: int = 0, deepest: int = 8) -> Mapping[str, Any] | None:
    """The JointTrajectory in a message: itself, or inside a RobotTrajectory, an action goal or a list of one; at most
    `deepest` levels down."""
    if depth > deepest:
        return None
    if isinstance(data, Mapping):
        if "joint_names" in data and "points" in data:
            return data
        candidates: Sequence[Any] = [data[key] for key in _NESTED if key in data]
    else:
        candidates = data if isinstance(data, list) else []
    return next((found for item in candidates if (found := _find_trajectory(item, depth + 1)) is not None), None)


def _from_trajectory(joint_names: Any, points: Any, source: str, as_path: bool = False) -> JointSamples:
    if not _is_row(joint_names) or not _is_row(points) or not all(isinstance(name, str | int) for name in joint_names):
        raise FileFormatError(
            f"{source}: the JointTrajectory needs a list of joint_names, which are text, and of points."
        )
    names = tuple(map(str, joint_names))
    if not names or not len(points):
        raise FileFormatError(f"{source}: the JointTrajectory has {len(names)} joint names and {len(points)} points.")
    if len(set(names)) < len(names):
        raise FileFormatError(f"{source}: the JointTrajectory names a joint twice: {', '.join(names)}.")
    try:
        t = np.array([_seconds(_get(point, "time_from_start")) for point in points], dtype=float)
    except (TypeError, ValueError, KeyError, OverflowError):
        raise FileFormatError(
            f"{source}: a point has no time_from_start in seconds, or as sec and nanosec; every point needs one."
        ) from None
    columns = {key: _column(points, key, len(names), source) for key in ("positions", "velocities", "accelerations")}
    q = columns["positions"]
    if q is None:
        raise FileFormatError(f"{source}: point 1 has no positions; every point needs {len(names)}.")
    dq = columns["velocities"]
    return joint_samples(
        t, names, q, dq, columns["accelerations"], source, commanded=dq is not None, fewest=2 if as_path else FEWEST
    )


def _column(points: Any, key: str, n: int, source: str) -> Array | None:
    """Values (N, n) of one field of the points; None if they do not have it."""
    rows = [() if (row := _get(point, key)) is None else row for point in points]
    for k, row in enumerate(rows):
        if not _is_row(row):
            raise FileFormatError(f"{source}: point {k + 1} has {key} that are not a list; there are {n} joints.")
    if all(len(row) == 0 for row in rows):
        return None
    for k, row in enumerate(rows):
        if len(row) != n:
            raise FileFormatError(f"{source}: point {k + 1} has {len(row)} {key}; there are {n} joints.")
    try:
        values = np.array(rows, dtype=float)
    except (TypeError, ValueError, OverflowError):
        values = np.zeros(0)
    if values.shape != (len(rows), n):
        raise FileFormatError(f"{source}: {key} must be numbers.")
    return values


def _is_row(value: Any) -> bool:
    return isinstance(value, list | tuple | np.ndarray)


def _get(item: Any, key: str, default: Any = None) -> Any:
    return item.get(key, default) if isinstance(item, Mapping) else getattr(item, key, default)


def _seconds(stamp: Any) -> float:
    """Seconds of a number, or of a time or duration of ROS 1 (secs, nsecs) or ROS 2 (sec, nanosec)."""
    if isinstance(stamp, int | float):
        return float(stamp)
    for whole, rest in (("sec", "nanosec"), ("secs", "nsecs")):
        if _get(stamp, whole) is not None:
            return float(_get(stamp, whole)) + 1e-9 * float(_get(stamp, rest, 0))
    raise KeyError("sec")


def read_bag(path: Path, topic: str | None = None, as_path: bool = False) -> Samples:
    """Read the only motion of a bag, or that of `topic`: JointTrajectory, JointState, PoseStamped or Path."""
    name, kind, messages = _messages(path, lambda connections: _choose(connections, topic, path))[0]
    source = f"{path}, topic {name}"
    if kind == TRAJECTORY:
        message: Any = messages[0][1]
        samples = _from_trajectory(message.joint_names, message.points, source, as_path)
        if len(messages) > 1:
            note = f"The topic has {len(messages)} trajectories; this is the first."
            samples = replace(samples, notes=(*samples.notes, note))
        return samples
    if kind == PATH:
        path_message: Any = messages[0][1]
        return _from_path(path_message.poses, source)
    return _joint_states(messages, source) if kind == JOINT_STATE else _poses(messages, source)


def read_sensed(path: Path, topic: str | None = None) -> tuple[JointSamples, Array | None]:
    """Read the joints of a bag with their efforts, and its WrenchStamped (N, 6) at their times, or None.

    topic: topic of the joints, if there are several.
    """

    def chosen(connections: Sequence[Any]) -> list[Any]:
        shown = ", ".join(f"{c.topic} ({c.msgtype})" for c in connections) or "none"
        joints = [c for c in connections if c.msgtype == JOINT_STATE and topic in (None, c.topic)]
        wrenches = [c for c in connections if c.msgtype == WRENCH]
        for kind, found, least in (("joints (JointState)", joints, 1), ("wrist (WrenchStamped)", wrenches, 0)):
            topics = {c.topic for c in found}
            if not least <= len(topics) <= 1:
                which = f"of the topic {topic}" if topic is not None else "; name one with --topic"
                raise FileFormatError(f"{path} has {len(topics)} logs of the {kind}{which}; its topics are {shown}.")
        return [*joints, *wrenches]

    found = {kind: (name, messages) for name, kind, messages in _messages(path, chosen)}
    name, messages = found[JOINT_STATE]
    samples = _joint_states(messages, f"{path}, topic {name}", efforts=True)
    if WRENCH not in found:
        return samples, None
    name, wrenches = found[WRENCH]
    t = _stamps(wrenches) - _stamps(messages)[0]
    values = np.array([[getattr(v, k) for v in (m.wrench.force, m.wrench.torque) for k in "xyz"] for _, m in wrenches])
    order = np.argsort(t, kind="stable")
    t, values = t[order], values[order]
    apart = np.abs(t[np.clip(np.searchsorted(t, samples.t), 0, len(t) - 1)] - samples.t).max()
    if apart > SPARSE:
        raise FileFormatError(
            f"{path}, topic {name}: the joints were logged up to {apart:.3g} s away from its nearest sample; at most "
            f"{SPARSE:g} s is accepted."
        )
    return samples, interpolated(t, values, samples.t)


def _messages(path: Path, chosen: Callable[[Sequence[Any]], list[Any]]) -> list[tuple[str, str, list[tuple[int, Any]]]]:
    """Topic, type and messages, with the times of their recording, of each connection of a bag that `chosen`
    selects."""
    with needs("bags", "A ROS bag"):
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore

    if (path / "scenario.toml").is_file():
        raise FileFormatError(
            f"{path} is a run directory, and a motion file is wanted; write one: salver export {quote(str(path))} "
            "--format csv -o motion.csv."
        )
    if path.is_dir() and not (path / "metadata.yaml").is_file():
        raise FileFormatError(f"{path} is a directory without metadata.yaml, so it is not a ROS 2 bag.")
    files = [file for file in path.iterdir() if file.is_file()] if path.is_dir() else [path]
    if sum(file.stat().st_size for file in files) > LARGEST_BAG:
        raise FileFormatError(
            f"{path} is larger than {LARGEST_BAG // 1_000_000} MB; cut it, or give one topic of it as CSV."
        )
    found: dict[str, tuple[str, list[tuple[int, Any]]]] = {}
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            connections = chosen(reader.connections)
            found = {connection.topic: (connection.msgtype, []) for connection in connections}
            for connection, stamp, raw in islice(reader.messages(connections=connections), MOST_MESSAGES + 1):
                found[connection.topic][1].append((stamp, reader.deserialize(raw, connection.msgtype)))
    except FileFormatError:
        raise
    except Exception as error:  # the reader of a damaged bag raises various exceptions
        reason = str(error).splitlines()[0][:200] if str(error) else type(error).__name__
        raise FileFormatError(f"{path} cannot be read as a ROS bag ({reason}).") from None
    if sum(len(messages) for _, messages in found.values()) > MOST_MESSAGES:
        raise FileFormatError(
            f"{path}, topic {' and '.join(found)} has more than {MOST_MESSAGES} messages; cut the bag."
        )
    for name, (_, messages) in found.items():
        if not messages:
            raise FileFormatError(f"{path}, topic {name} has no messages.")
    return [(name, kind, messages) for name, (kind, messages) in found.items()]


def _choose(connections: Sequence[Any], topic: str | None, path: Path) -> list[Any]:
    usable = [c for c in connections if c.msgtype in KINDS]
    shown = ", ".join(f"{c.topic} ({c.msgtype})" for c in connections) or "none"
    if topic is not None:
        chosen = [c for c in usable if c.topic == topic]
        if not chosen:
            raise FileFormatError(
                f"{path} has no motion on the topic {topic}; its topics are {shown}, and motions are "
                f"{', '.join(KINDS)}."
            )
        return chosen
    # Paths beside a joint motion are derived from it.
    usable = [c for c in usable if c.topic != STOPS]
    usable = [c for c in usable if c.msgtype != PATH] or usable
    topics = {c.topic for c in usable}
    if len(topics) != 1:
        problem = "holds no motion" if not topics else f"holds {len(topics)} motions; name one with --topic"
        raise FileFormatError(f"{path} {problem}: its topics are {shown}; motions are {', '.join(KINDS)}.")
    return usable


def _times(messages: Sequence[tuple[int, Any]]) -> Array:
    """Times since the first message, s."""
    stamps = _stamps(messages)
    return stamps - stamps[0]


def _stamps(messages: Sequence[tuple[int, Any]]) -> Array:
    """Stamps of the headers, s, or times of the recording if there are none."""
    stamps = np.array([_seconds(message.header.stamp) for _, message in messages])
    if np.all(stamps == 0):
        stamps = np.array([stamp for stamp, _ in messages]) * 1e-9
    return stamps


def _joint_states(messages: Sequence[tuple[int, Any]], source: str, efforts: bool = False) -> JointSamples:
    names = tuple(messages[0][1].name)
    # Several publishers may share the topic (arm and gripper): the rows with the names of the first are kept.
    rows = [(stamp, m) for stamp, m in messages if tuple(m.name) == names]
    if not names or len(set(names)) < len(names):
        raise FileFormatError(
            f"{source}: a JointState needs names, each once; the first has {', '.join(names) or 'none'}."
        )
    try:
        q = np.array([m.position for _, m in rows], dtype=float)
    except ValueError:
        q = np.zeros(0)
    if q.ndim != 2 or q.shape[1] != len(names):
        raise FileFormatError(f"{source}: a JointState has not one position for each of its {len(names)} names.")
    tau = None
    if efforts and any(len(m.effort) for _, m in rows):
        if {len(m.effort) for _, m in rows} != {len(names)}:
            raise FileFormatError(f"{source}: a JointState has not one effort for each of its {len(names)} names.")
        tau = np.array([m.effort for _, m in rows], dtype=float)
    return joint_samples(_times(rows), names, q, None, None, source, tau=tau)


def _poses(messages: Sequence[tuple[int, Any]], source: str) -> TraySamples:
    p = np.array([[m.pose.position.x, m.pose.position.y, m.pose.position.z] for _, m in messages])
    q = [m.pose.orientation for _, m in messages]
    quat = np.array([[x.w, x.x, x.y, x.z] for x in q])
    return tray_samples(_times(messages), p, quat, source)


def _from_path(poses: Any, source: str) -> TraySamples:
    """Samples of a nav_msgs/Path, in which every pose has a stamp."""
    if Path(source).stem.endswith(OBJECT):
        raise FileFormatError(f"{source} is the path of an object; give that of the tray.")
    rows = []
    try:
        for pose in poses:
            place, stamp = _get(pose, "pose"), _get(_get(pose, "header"), "stamp")
            p, q = _get(place, "position"), _get(place, "orientation")
            rows.append([_seconds(stamp), *(_get(p, c) for c in "xyz"), *(_get(q, c) for c in "wxyz")])
        table = np.array(rows, dtype=float).reshape(len(rows), 8)
    except (TypeError, ValueError, KeyError, OverflowError, AttributeError):
        raise FileFormatError(
            f"{source}: pose {len(rows) + 1} of the Path is not complete; each needs a stamp, a position and an "
            "orientation."
        ) from None
    if not len(table):
        raise FileFormatError(f"{source}: the Path has no poses.")
    return tray_samples(table[:, 0], table[:, 1:4], table[:, 4:], source)
