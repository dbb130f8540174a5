"""Plans for other programs: CSV, JSON, ROS 2, MuJoCo."""

from __future__ import annotations

from pathlib import Path

from salver.errors import SalverError
from salver.files import output_file

FORMATS = {"csv": ".csv", "json": ".json", "ros2": "_bag", "yaml": ".yaml", "moveit": ".yaml", "mujoco": "_mujoco"}


def write_export(
    directory: str | Path,
    file_format: str,
    path: str | Path | None = None,
    stem: str = "plan",
    rate: float | None = None,
) -> list[Path]:
    """Write the motion `stem` of a run directory in a format; returns the files. By default DIR/export/STEM + ending.

    rate: samples per second, the plan's own instants when None. Another file that stands there is kept, numbered.
    Raises SalverError for an unknown format or a place that is taken, FileFormatError for a directory without such
    a plan.
    """
    if file_format not in FORMATS:
        raise SalverError(f'There is no export format "{file_format}"; known are {", ".join(FORMATS)}.')
    target = Path(path) if path is not None else Path(directory) / "export" / f"{stem}{FORMATS[file_format]}"
    if file_format == "mujoco":
        from salver.export.mujoco import write_scene

        return write_scene(directory, target, stem)
    from salver.export.motion import read_motion
    from salver.motion_files import ENDINGS, write

    if ENDINGS[file_format]:
        target = output_file(target, ENDINGS[file_format])
    return write(read_motion(directory, stem, rate), target, file_format)
