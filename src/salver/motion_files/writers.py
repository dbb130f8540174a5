"""Writing a motion: which format; CSV and JSON, every number with all its digits. Formats of ROS are in
`salver.motion_files.ros_writers`."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Any

from salver.errors import SalverError
from salver.files import output_file, to_json, write_atomic
from salver.geometry import Array
from salver.motion_files.motion import MotionSeries
from salver.motion_files.readers import FORMAT, column_names
from salver.motion_files.verdict import place_for, warns

# Format to the endings of its files; a bag is a directory.
ENDINGS = {
    "csv": (".csv", ".txt"),
    "json": (".json",),
    "message": (".json",),
    "yaml": (".yaml", ".yml"),
    "moveit": (".yaml", ".yml"),
    "ros2": (),
}


def write(motion: MotionSeries, path: str | Path, form: str | None = None, *, unsafe: bool = False) -> list[Path]:
    """Write a motion; returns the files. Another file that stands at `path` is kept, numbered.

    form: one of `ENDINGS`; by default what the ending says (.json: salver's own; none: a bag). unsafe: write also a
    motion that fails its verdict, with UNSAFE in its name and first in the file. Raises SalverError; UnsafeError.
    """
    from salver.motion_files import ros_writers

    form = form_of(path, form)
    path = place_for(path, motion.verdict, unsafe)
    if form == "ros2":
        return ros_writers.write_bag(motion, Path(path))
    target = output_file(path, ENDINGS[form])
    writers = {
        "csv": write_csv,
        "json": write_json,
        "yaml": ros_writers.write_yaml,
        "moveit": ros_writers.write_robot_trajectory,
        "message": ros_writers.write_message,
    }
    return writers[form](motion, target)


def form_of(path: str | Path, like: str | None = None) -> str:
    """The format that a name asks for; where its ending leaves that open, the one that is given. Raises SalverError."""
    ending = Path(path).suffix.lower()
    matching = [form for form, endings in ENDINGS.items() if ending in endings or (not ending and form == "ros2")]
    if not matching:
        raise SalverError(f"{path} is no name for a motion: it must end in .csv, .json, .yaml, or in nothing (a bag).")
    return like if like in matching else matching[0]


def columns(motion: MotionSeries) -> dict[str, Array]:
    """Name to values (T,): t, then each component, as p_SE_x, quat_SE_w, q_panda_joint1. Units as in the docs (SI)."""
    out: dict[str, Array] = {"t": motion.t}
    for name, values in motion.known.items():
        out.update(zip(column_names(name, motion.joint_names), values.T, strict=True))
    return out


def write_csv(motion: MotionSeries, path: Path) -> list[Path]:
    """One row an instant, one column a component; headings as in `columns`, below the verdict where it warns."""
    table = columns(motion)
    text = io.StringIO()
    text.write(f"# {motion.verdict}\n" if warns(motion.verdict) else "")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(table)
    for row in zip(*(values.tolist() for values in table.values()), strict=True):
        writer.writerow([repr(float(value)) for value in row])
    return [write_atomic(path, text.getvalue(), keep=True)]


def write_json(motion: MotionSeries, path: Path) -> list[Path]:
    """Arrays by name, and where they come from."""
    document: dict[str, Any] = {
        **({"verdict": motion.verdict} if motion.verdict else {}),
        "format": FORMAT,
        **motion.about,
        "joint_names": list(motion.joint_names),
        "t": motion.t,
        **motion.known,
    }
    return [write_atomic(path, to_json(document), keep=True)]
