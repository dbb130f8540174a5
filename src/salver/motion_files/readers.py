"""Reading of motion files: choice of the format, tables (CSV, or columns in memory).
`salver.motion_files.ros_readers` reads formats of ROS.

CSV, one header line, separated by commas, semicolons, tabs or blanks (decimal commas where commas do not separate):

- time: `t`, `time`, `time_s`, `timestamp`, `time_from_start` (s), or `t_`, `time_`, `stamp_` with ms, us or ns;
- a tray motion: `x, y, z` (m) and `qw, qx, qy, qz`, in any order. Also `p_SE_x, ..., quat_SE_w, ...`,
  `pose.position.x, ..., pose.orientation.w, ...`;
- a joint motion: the joints' names (with or without `_position`, or `q_` before), or `q1 ... qn`, `J1 ... Jn`,
  `A1 ... An`, in rad. It counts as a recording, not as a command.

Other columns are ignored. Other units: `salver.motion_files.units`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from salver.errors import FileFormatError
from salver.files import load_npz, read_text
from salver.geometry import Array
from salver.motion_files.samples import (
    FEWEST,
    NUMBERED,
    JointSamples,
    Samples,
    joint_samples,
    reordered,
    tray_samples,
)
from salver.motion_files.units import PARTS, SI, Units
from salver.motion_files.verdict import verdict_in

_TIME: dict[str, float | None] = dict.fromkeys(("t", "time", "timestamp", "time_from_start"))  # None: `--units`
_TIME |= {"time_s": 1.0, **{f"{name}_{unit}": size for name in ("t", "time", "stamp") for unit, size in PARTS.items()}}
_POSITION = re.compile(r"(?:pose[._])?(?:p|pos|position)?(?:[._]?(se))?[._]?([xyz])")
_QUATERNION = re.compile(r"(?:pose[._])?(?:q|quat|quaternion|orientation)(?:[._]?(se))?[._]?([wxyz])")
_OF_OBJECT = re.compile(r"(?:p|quat)_SB_[wxyz]", re.I)  # in tables of `salver export`
_POSE = ("px", "py", "pz", "qw", "qx", "qy", "qz")
JointNames = Callable[[], tuple[str, ...]]

LARGEST = 500_000_000  # bytes of a text file
BAGS = (".bag", ".mcap", ".db3")
TABLES = (".csv", ".txt", ".tsv")


def no_joints() -> tuple[str, ...]:
    """No joint names: the default for files of tray motions."""
    return ()


def read(
    path: str | Path,
    joint_names: JointNames = no_joints,
    topic: str | None = None,
    as_path: bool = False,
    units: Units = SI,
) -> Samples:
    """Read a motion of the tray, of the object, or of the arm's joints from a file.

    Args:
        path: .csv or .txt; .npz with t and q, as `salver execute` and `salver simulate` log joints; .yaml, .yml or
            .json with a trajectory_msgs/JointTrajectory (also in a MoveIt RobotTrajectory) or a nav_msgs/Path; a bag
            (.bag, .mcap, .db3, or a directory with metadata.yaml).
        joint_names: returns the arm's joint names; called only if a table needs them.
        topic: topic of a bag.
        as_path: only the path matters, not the time: joints are preferred to the tray, and two samples suffice.
        units: units of a table.

    Raises:
        FileFormatError: one sentence for each mistake.
    """
    path = Path(path)
    if not _exists(path):
        raise FileFormatError(f"{path} does not exist; give a .csv, .yaml or .json file or a ROS bag.")
    found = _read(path, joint_names, topic, as_path, units)
    return replace(found, verdict=verdict_in(path))


def _read(path: Path, joint_names: JointNames, topic: str | None, as_path: bool, units: Units) -> Samples:
    """`read`, without the verdict in the file."""
    ending = path.suffix.lower()
    if units.text and ending not in TABLES:
        raise FileFormatError(
            f"{path} is not a table ({', '.join(TABLES)}), so it is in rad, m and s; leave --units out."
        )
    if path.is_file() and path.stat().st_size > LARGEST and ending not in BAGS:
        raise FileFormatError(f"{path} is larger than {LARGEST // 1_000_000} MB; cut it.")
    if path.is_dir() or ending in BAGS:
        from salver.motion_files.ros_readers import read_bag

        return replace(read_bag(path, topic, as_path), form="ros2")
    if topic is not None:
        raise FileFormatError(f"{path} is not a bag, so it has no topic {topic}; leave --topic out.")
    if ending in (".yaml", ".yml", ".json"):
        from salver.motion_files.ros_readers import read_document, samples_of

        return replace(samples_of(read_document(path), path, as_path), form="message")
    if ending == ".npz":
        return _of_arrays(path)
    if ending in TABLES:
        return of_table(*read_table(path), str(path), joint_names, as_path, units)
    raise FileFormatError(
        f'{path} ends in "{path.suffix}"; accepted are .csv, .txt, .tsv, .yaml, .yml, .json, .bag, .mcap, .db3 and '
        "directories of ROS 2 bags."
    )


def _of_arrays(path: Path) -> JointSamples:
    found = load_npz(path, ("t", "q"))
    t, q = found["t"], found["q"]
    if t.ndim != 1 or q.ndim != 2 or q.shape[0] != len(t) or not q.shape[1] or not len(t):
        raise FileFormatError(
            f"{path}: t has the shape {t.shape} and q {q.shape}; a log of joints has (K,) and (K, n)."
        )
    names = tuple(f"q{k + 1}" for k in range(q.shape[1]))
    return replace(joint_samples(t, names, q.astype(float), None, None, str(path)), form="npz")


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except (OSError, ValueError):  # an invalid file name
        return False


def of_columns(
    columns: Mapping[str, Any], joint_names: JointNames = no_joints, as_path: bool = False, units: Units = SI
) -> Samples:
    """A motion from columns by name: a mapping of arrays, or a pandas DataFrame, whose index is the time if no column
    is. Arguments: as in `read`. Raises FileFormatError."""
    source = f"the {type(columns).__name__}"
    if not hasattr(columns, "keys"):
        raise FileFormatError(f"{source} is not a motion; give a file, a mapping of columns by name, or a DataFrame.")
    header = [str(name) for name in columns]
    parts = [columns[name] for name in columns]
    index = getattr(columns, "index", None)
    if index is not None and not any(name.lower() in _TIME for name in header):
        header, parts = ["t", *header], [index, *parts]
    try:
        table = np.column_stack([np.asarray(part, dtype=float) for part in parts])
    except (TypeError, ValueError):
        raise FileFormatError(f"{source} must have columns of numbers of one length; it has {header}.") from None
    return of_table(header, table, source, joint_names, as_path, units)


def of_table(
    header: list[str],
    values: Array,
    source: str,
    joint_names: JointNames = no_joints,
    as_path: bool = False,
    units: Units = SI,
) -> Samples:
    """A motion of tray or joints, depending on the header. With both, the tray's motion; with `as_path`, the
    joints'."""
    lowered = [name.lower() for name in header]
    for j, name in enumerate(lowered):
        first = lowered.index(name)
        if not np.array_equal(values[:, first], values[:, j], equal_nan=True):
            raise FileFormatError(
                f'{source} has two columns "{header[j]}", {first + 1}. and {j + 1}., that differ; name each once.'
            )
    clocks = [(j, _TIME[name]) for j, name in enumerate(lowered) if name in _TIME]
    if len(clocks) != 1:
        raise FileFormatError(
            f"{source} has {len(clocks) or 'no'} columns of time; it needs one, named {', '.join(_TIME)}; its "
            f"header is {', '.join(header)}."
        )
    column, unit = clocks[0]
    t = values[:, column] * (units.time if unit is None else unit)
    place = _pose_columns(lowered)
    whole = len(place) == len(_POSE)
    names = joint_names() if as_path or not whole else ()
    joints = _joint_columns(header, names) if as_path or not whole else {}
    if whole and not joints:
        pose = values[:, [place[name] for name in _POSE]]
        tray = tray_samples(t, units.length * pose[:, :3], pose[:, 3:], source)
        unknown = ", ".join(name for name in header if names and "joint" in name.lower())
        said = f"The columns {unknown} are not used: the arm's joints are {', '.join(names)}."
        return replace(tray, notes=(*units.notes, *tray.notes, *([said] if unknown else [])))
    if joints:
        q = values[:, list(joints.values())] * units.of_joints(len(joints))
        arm = joint_samples(t, tuple(joints), q, None, None, source, fewest=2 if as_path else FEWEST)
        return replace(arm, notes=units.notes + arm.notes)
    if not place and any(map(_OF_OBJECT.fullmatch, header)):
        raise FileFormatError(f"{source} is the motion of an object (p_SB, quat_SB); give that of the tray.")
    missing = [name.removeprefix("p") for name in _POSE if name not in place]
    expected = f"joints {', '.join(names)} or q1 ... q{len(names)}" if names else "joints q1 ... qn"
    found = f" (no column for {missing[0]})" if place else ""
    raise FileFormatError(
        f"{source} holds neither a tray motion{found} nor a joint motion: it needs the columns x, y, z, qw, qx, qy, "
        f"qz, or {expected}; its header is {', '.join(header)}."
    )


def _pose_columns(header: list[str]) -> dict[str, int]:
    """Columns of the tray's pose: {"px": column, ..., "qz": column}. Columns that name its frame E come before others,
    which may be of another point."""
    found: dict[str, int] = {}
    for j, name in enumerate(header):
        for letter, pattern in (("q", _QUATERNION), ("p", _POSITION)):
            match = pattern.fullmatch(name)
            if match:
                if match[1] or letter + match[2] not in found:
                    found[letter + match[2]] = j
                break
    return found


def _joint_columns(header: list[str], joint_names: tuple[str, ...]) -> dict[str, int]:
    """Columns of joint positions: those with the arm's names, else numbered ones, else those named as positions."""
    position = {re.sub(r"^(?:position[._]|q_)|[._]pos(?:ition)?$", "", name): j for j, name in enumerate(header)}
    named = {name: position[name] for name in joint_names if name in position}
    if named:
        return named
    found = [(NUMBERED.fullmatch(name), j) for j, name in enumerate(header)]
    numbered = [(match[2].lower(), int(match[3]), match[1], j) for match, j in found if match]
    if numbered or joint_names:
        letter = max((each[0] for each in numbered), default="")  # q1 before j1 before a1
        return {name: j for each, _, name, j in sorted(numbered) if each == letter}
    poses = (_POSITION, _QUATERNION)
    return {
        name: j
        for name, j in position.items()
        if name != header[j] and not any(pattern.fullmatch(header[j].lower()) for pattern in poses)
    }


def read_path(path: Path, joint_names: tuple[str, ...], topic: str | None = None, units: Units = SI) -> Array:
    """Joint positions (K, n), rad, in the order of `joint_names`, from a motion file or from a table of postures.

    A table of postures has a posture in each row and no times; a heading names its columns. Raises FileFormatError.
    """
    if path.suffix.lower() in TABLES and _exists(path):
        header, values = read_table(path, headless=True)
        if not any(name.lower() in _TIME for name in header):
            count = values.shape[1]
            wrong = next((word for word in header if not _is_number(word)), None)
            if any(_is_number(word) for word in header):  # a posture with a mistake, not a heading
                raise FileFormatError(
                    f'{path}, line 1: "{wrong}" is not a number; each row must be {len(joint_names)} joint angles, rad.'
                )
            if header:
                columns = _joint_columns(header, joint_names)
                if set(columns) != set(joint_names) and len(columns) != len(joint_names):
                    raise FileFormatError(
                        f"{path} is not a table of postures: its heading must name the joints {', '.join(joint_names)} "
                        f"or q1 ... q{len(joint_names)}; it is {', '.join(header)}."
                    )
                wanted = joint_names if set(columns) == set(joint_names) else tuple(columns)
                values = values[:, [columns[name] for name in wanted]]
            elif count != len(joint_names):
                raise FileFormatError(
                    f"{path} has {count} columns; a posture has {len(joint_names)} joint angles, rad."
                )
            bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
            if len(bad):
                raise FileFormatError(f"{path}: posture {bad[0] + 1} has an angle that is not a finite number.")
            return values * units.of_joints(values.shape[1])
    samples = read(path, lambda: joint_names, topic, as_path=True, units=units)
    if not isinstance(samples, JointSamples):
        raise FileFormatError(f"{path} is a motion of the tray; a path of the arm needs joint positions.")
    return reordered(samples, joint_names).q


def read_table(path: Path, headless: bool = False) -> tuple[list[str], Array]:
    """Read the header and the numbers (N, columns) of a table. headless: accept a table without a header."""
    rows = read_text(path).split("\n")
    lines = [(k, x) for k, x in enumerate(rows, 1) if x.strip() and not x.startswith("#")]
    if not lines:
        raise FileFormatError(f"{path} is empty; the first line must name the columns.")
    first = lines[0][1]
    separator = next((s for s in (";", ",", "\t") if s in first), None)
    header = [name.strip().strip('"') for name in first.split(separator)]
    columns = len(header)
    if not all(_is_number(name.replace(",", ".")) for name in header):
        lines = lines[1:]
    elif headless:
        header = []
    else:
        raise FileFormatError(
            f"{path} has no header: its first line must name the columns, such as t, x, y, z, qw, qx, qy, qz."
        )
    if not lines:
        raise FileFormatError(f"{path} has no samples below its header; an audit needs at least {FEWEST}.")
    commas, points = (any(mark in line for _, line in lines) for mark in ",.")
    if separator != "," and commas and not points:  # decimal commas; with points, commas could separate thousands
        lines = [(k, line.replace(",", ".")) for k, line in lines]
    try:
        values = np.loadtxt([line for _, line in lines], delimiter=separator, ndmin=2)
    except ValueError:
        values = np.zeros((1, 0))
    if values.shape[1] != columns:
        raise FileFormatError(_fault(path, lines, separator, columns))
    return header, values


def _fault(path: Path, lines: list[tuple[int, str]], separator: str | None, columns: int) -> str:
    """A sentence about the first of the numbered lines that is not a row of numbers."""
    for k, line in lines:
        cells = line.split(separator)
        if len(cells) != columns:
            return f"{path}, line {k}: {len(cells)} values, but the header names {columns} columns."
        for cell in cells:
            if not _is_number(cell):
                rule = "; decimal commas are read where no number has a point" if "," in cell else ""
                return f'{path}, line {k}: "{cell.strip()}" is not a number{rule}.'
    return f"{path} is not a table of numbers."


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
