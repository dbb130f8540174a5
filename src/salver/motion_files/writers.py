"""Writing of motion files: choice of the format; CSV, with all digits of every number.
`salver.motion_files.ros_writers` writes formats of ROS."""

from __future__ import annotations

import csv
import io
from pathlib import Path

from salver.errors import SalverError
from salver.files import output_file, write_atomic
from salver.geometry import Array
from salver.motion_files.motion import OF_JOINTS, QUANTITIES, MotionSeries
from salver.motion_files.verdict import place_for, warns

# File endings by format; a bag is a directory.
ENDINGS = {
    "csv": (".csv", ".txt"),
    "yaml": (".yaml", ".yml"),
    "moveit": (".yaml", ".yml"),
    "ros2": (),
}


def write(motion: MotionSeries, path: str | Path, form: str | None = None, *, unsafe: bool = False) -> list[Path]:
    """Write a motion; returns the files. An existing file at `path` is kept, numbered.

    form: one of `ENDINGS`; default: by the file's ending (none: a bag). unsafe: also write a
    motion that failed verification, marked with UNSAFE in its name and at its beginning. Raises SalverError,
    UnsafeError.
    """
    from salver.motion_files import ros_writers

    form = form_of(path) if form is None else form
    path = place_for(path, motion.verdict, unsafe)
    if form == "ros2":
        return ros_writers.write_bag(motion, Path(path))
    target = output_file(path, ENDINGS[form])
    writers = {
        "csv": write_csv,
        "yaml": ros_writers.write_yaml,
        "moveit": ros_writers.write_robot_trajectory,
    }
    return writers[form](motion, target)


def form_of(path: str | Path) -> str:
    """The format of a file by its ending. Raises SalverError."""
    ending = Path(path).suffix.lower()
    for form, endings in ENDINGS.items():
        if ending in endings or (not ending and form == "ros2"):
            return form
    raise SalverError(f"{path} is not a name for a motion: it must end in .csv, .yaml, or in nothing (a bag).")


def columns(motion: MotionSeries) -> dict[str, Array]:
    """Columns (T,) by name: t, then each component, such as p_SE_x, quat_SE_w, q_panda_joint1, in SI units."""
    out: dict[str, Array] = {"t": motion.t}
    for name in QUANTITIES:
        values = getattr(motion, name)
        if values is not None and values.shape[1]:
            parts = motion.joint_names if name in OF_JOINTS else "wxyz" if name.startswith("quat") else "xyz"
            out |= {f"{name.removesuffix('_wxyz')}_{part}": x for part, x in zip(parts, values.T, strict=True)}
    return out


def write_csv(motion: MotionSeries, path: Path) -> list[Path]:
    """Write a row for each instant and a column for each component, headings as in `columns`, below a warning if there
    is one."""
    table = columns(motion)
    text = io.StringIO()
    text.write(f"# {motion.verdict}\n" if warns(motion.verdict) else "")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(table)
    for row in zip(*(values.tolist() for values in table.values()), strict=True):
        writer.writerow([repr(float(value)) for value in row])
    return [write_atomic(path, text.getvalue(), keep=True)]
