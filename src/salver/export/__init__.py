"""Plans for other programs: CSV, ROS 2, MuJoCo, URScript."""

from __future__ import annotations

from pathlib import Path

from salver.errors import SalverError
from salver.files import output_file, write_atomic
from salver.motion_files.verdict import place_for

FORMATS = {
    "csv": ".csv", "ros2": "_bag", "yaml": ".yaml", "moveit": ".yaml", "mujoco": "_mujoco",
    "urscript": ".script",
}  # fmt: skip


def write_export(
    directory: str | Path,
    file_format: str,
    path: str | Path | None = None,
    stem: str = "plan",
    rate: float | None = None,
    *,
    pause: float | None = None,
    unsafe: bool = False,
    stop_input: int = 0,
) -> list[Path]:
    """Write the motion `stem` of a run directory in a format; returns the files. By default DIR/export/STEM + ending.

    rate: samples per second, the plan's own instants when None (urscript: its controller's). pause: s at rest between
    two legs of a plan of several (5 when None). Another file that stands there is kept, numbered. unsafe: write also a
    motion that fails its verdict (plan, check, arm), with UNSAFE in its name and first in the file. stop_input: of
    urscript, the standard digital input, 0 to 7, that stops a plan with stops. Raises UnsafeError for a motion that
    fails its verdict without it, SalverError for an unknown format, an arm or a rate that a format is not for, or a
    place that is taken, FileFormatError for a directory without such a plan.
    """
    if file_format not in FORMATS:
        raise SalverError(f'There is no export format "{file_format}"; known are {", ".join(FORMATS)}.')
    target = Path(path) if path is not None else Path(directory) / "export" / f"{stem}{FORMATS[file_format]}"
    if file_format == "mujoco":
        from salver.export.mujoco import write_scene

        return write_scene(directory, target, stem, unsafe=unsafe)
    from salver.export.motion import PAUSE, read_motion

    pause = PAUSE if pause is None else pause
    if file_format == "urscript":
        from salver.export import urscript
        from salver.models.arm.known_arms import CB3_ARMS
        from salver.planning.round import load

        arm = load(directory, stem).scenario.arm
        if rate is None:  # that of the arm's controller
            rate = urscript.RATES[-1 if arm is not None and arm.model in CB3_ARMS else 0]
        motion = read_motion(directory, stem, rate, pause)
        if stop_input not in range(8):
            raise SalverError(f"The stop's digital input is {stop_input}; it must be 0 to 7.")
        text, target = urscript.program(motion, rate, stop_input), place_for(target, motion.verdict, unsafe)
        return [write_atomic(output_file(target, (".script",)), text, keep=True)]
    from salver.motion_files import ENDINGS, write

    if endings := ENDINGS[file_format]:
        target = output_file(target if target.suffix else target.with_suffix(endings[0]), endings)
    return write(read_motion(directory, stem, rate, pause), target, file_format, unsafe=unsafe)
