"""Reading a trajectory from a file: which format, and CSV. Formats of ROS are in `salver.auditing.ros`.

CSV, one header line, separated by commas, semicolons, tabs or blanks:

- time: `t`, `time`, `time_s`, `timestamp`, `time_from_start` (s), or `t_`, `time_`, `stamp_` with ms, us or ns;
- a tray motion: `x, y, z` (m) and `qw, qx, qy, qz`: the names say which component is which, so wxyz and xyzw
  are both read rightly. Also `p_SE_x, ..., quat_SE_w, ...`, `pose.position.x, ..., pose.orientation.w, ...`.
  `p_SB_x, ..., quat_SB_w, ...` is the motion of the object's frame B instead;
- a joint motion: the joints' own names (with or without `_position`), or `q1 ... qn`, in rad.

Other columns are left out.
"""

from __future__ import annotations

import csv
import re
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np

from salver.auditing.samples import FEWEST, Samples, joint_samples, tray_samples
from salver.errors import FileFormatError
from salver.geometry import Array

_PARTS = {"ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_TIME = {"t": 1.0, "time": 1.0, "time_s": 1.0, "timestamp": 1.0, "time_from_start": 1.0}
_TIME |= {f"{name}_{unit}": size for name in ("t", "time", "stamp") for unit, size in _PARTS.items()}
_POSITION = re.compile(r"(?:pose[._])?(?:p|pos|position)?(?:[._]?(s[eb]))?[._]?([xyz])")
_QUATERNION = re.compile(r"(?:pose[._])?(?:q|quat|quaternion|orientation)(?:[._]?(s[eb]))?[._]?([wxyz])")
_NUMBERED = re.compile(r"q_?\[?(\d+)\]?")
_POSE = ("px", "py", "pz", "qw", "qx", "qy", "qz")
JointNames = Callable[[], tuple[str, ...]]

LARGEST = 500_000_000  # bytes of a text file
_BAGS = (".bag", ".mcap", ".db3")


def no_joints() -> tuple[str, ...]:
    """For files of tray motions."""
    return ()


def read(path: str | Path, joint_names: JointNames = no_joints, topic: str | None = None) -> Samples:
    """A motion of the tray (or the object), or of the arm's joints, from a file.

    By its ending: .csv or .txt; .yaml, .yml or .json with a trajectory_msgs/JointTrajectory; a bag (.bag, .mcap,
    .db3, or a directory with metadata.yaml). joint_names: gives the arm's names, called only when they are needed to
    understand a CSV. topic: which one of a bag.
    Raises FileFormatError, one sentence for each mistake.
    """
    path = Path(path)
    if not _exists(path):
        raise FileFormatError(f"{path} does not exist; give a .csv, .yaml or .json file or a ROS bag.")
    ending = path.suffix.lower()
    if path.is_file() and path.stat().st_size > LARGEST and ending not in _BAGS:
        raise FileFormatError(f"{path} is larger than {LARGEST // 1_000_000} MB; cut it.")
    if path.is_dir() or ending in _BAGS:
        from salver.auditing.ros import read_bag

        return read_bag(path, topic)
    if topic is not None:
        raise FileFormatError(f"{path} is no bag, so it has no topic {topic}; leave --topic away.")
    if ending in (".yaml", ".yml", ".json"):
        from salver.auditing.ros import read_message

        return read_message(path)
    if ending in (".csv", ".txt", ".tsv"):
        return read_csv(path, joint_names)
    raise FileFormatError(
        f'{path} ends in "{path.suffix}"; accepted are .csv, .txt, .tsv, .yaml, .yml, .json, .bag, .mcap, .db3 and '
        "directories of ROS 2 bags."
    )


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except (OSError, ValueError):  # a name that no file has
        return False


def read_csv(path: Path, joint_names: JointNames = no_joints) -> Samples:
    """Tray or joint motion; the header decides which (a tray motion, when it has both)."""
    header, values = _table(path)
    lowered = [name.lower() for name in header]
    clocks = [(j, _TIME[name]) for j, name in enumerate(lowered) if name in _TIME]
    if len(clocks) != 1:
        raise FileFormatError(
            f"{path} has {len(clocks) or 'no'} columns of time; it needs one, named {', '.join(_TIME)}; its header is "
            f"{', '.join(header)}."
        )
    column, unit = clocks[0]
    t = values[:, column] * unit
    poses = _pose_columns(lowered)
    for frame, place in poses.items():
        if len(place) == 7:
            pose = values[:, [place[name] for name in _POSE]]
            return tray_samples(t, pose[:, :3], pose[:, 3:], "B" if frame == "sb" else "E", str(path))
    names = joint_names()
    joints = _joint_columns(header, names)
    if joints:
        return joint_samples(t, tuple(joints), values[:, list(joints.values())], None, None, str(path))
    best = max(poses.values(), key=len) if poses else {}
    missing = [name.removeprefix("p") for name in _POSE if name not in best]
    expected = f"joints {', '.join(names)} or q1 ... q{len(names)}" if names else "joints q1 ... qn"
    found = f" (no column for {missing[0]})" if best else ""
    raise FileFormatError(
        f"{path} holds neither a tray motion{found} nor a joint motion: it needs the columns x, y, z, qw, qx, qy, qz, "
        f"or {expected}; its header is {', '.join(header)}."
    )


def _pose_columns(header: list[str]) -> dict[str, dict[str, int]]:
    """frame ("", "se", "sb") -> {"px": column, ..., "qz": column}."""
    found: dict[str, dict[str, int]] = {}
    for j, name in enumerate(header):
        for letter, pattern in (("q", _QUATERNION), ("p", _POSITION)):
            match = pattern.fullmatch(name)
            if match:
                found.setdefault(match[1] or "", {}).setdefault(letter + match[2], j)
                break
    return found


def _joint_columns(header: list[str], joint_names: tuple[str, ...]) -> dict[str, int]:
    """Columns of joint positions by name: the arm's names, else numbers."""
    position = {re.sub(r"^(?:position[._]|q_)|[._]pos(?:ition)?$", "", name): j for j, name in enumerate(header)}
    named = {name: position[name] for name in joint_names if name in position}
    if named:
        return named
    numbered = [(int(m[1]), name, j) for j, name in enumerate(header) if (m := _NUMBERED.fullmatch(name.lower()))]
    return {name: j for _, name, j in sorted(numbered)}


def _table(path: Path) -> tuple[list[str], Array]:
    """Header and numbers (N, columns)."""
    try:
        with open(path, encoding="utf-8-sig") as file:
            start = next(((k, line) for k, line in enumerate(file) if line.strip() and not line.startswith("#")), None)
    except OSError as error:
        raise FileFormatError(f"{path} cannot be read ({error.strerror}).") from None
    except UnicodeDecodeError:
        raise FileFormatError(f"{path} is not a text file in UTF-8.") from None
    if start is None:
        raise FileFormatError(f"{path} is empty; the first line must name the columns.")
    skipped, first = start
    separator = next((s for s in (",", ";", "\t") if s in first), None)
    header = [name.strip().strip('"') for name in first.split(separator)]
    if all(_is_number(name) for name in header):
        raise FileFormatError(
            f"{path} has no header: its first line must name the columns, such as t, x, y, z, qw, qx, qy, qz."
        )
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of a file without rows, which is told below
            values = np.loadtxt(path, delimiter=separator, ndmin=2, skiprows=skipped + 1, encoding="utf-8-sig")
    except (ValueError, UnicodeDecodeError):
        values = np.zeros((1, 0))
    if values.size == 0 and values.shape[0] == 0:
        raise FileFormatError(f"{path} has no samples below its header; an audit needs at least {FEWEST}.")
    if values.shape[1] != len(header):
        _point_at_fault(path, skipped, separator, len(header))
        raise FileFormatError(f"{path} is not a table of numbers.")
    return header, values


def _point_at_fault(path: Path, skipped: int, separator: str | None, columns: int) -> None:
    """Raise FileFormatError that names the first line that is no row of numbers."""
    with open(path, encoding="utf-8-sig", errors="replace") as file:
        for k, line in enumerate(file, 1):
            if k <= skipped + 1 or not line.strip() or line.startswith("#"):
                continue
            cells = next(csv.reader([line], delimiter=separator)) if separator else line.split()
            if len(cells) != columns:
                raise FileFormatError(f"{path}, line {k}: {len(cells)} values, but the header names {columns} columns.")
            for cell in cells:
                if not _is_number(cell):
                    raise FileFormatError(f'{path}, line {k}: "{cell.strip()}" is not a number.')


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
