"""`salver export`: write a plan for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from salver.cli.common import Json, Unsafe, print_json, say
from salver.errors import SalverError


def export(
    directory: Annotated[Path, typer.Argument(help="A run directory, as `salver plan` makes it.")],
    file_format: Annotated[str, typer.Option("--format", help="csv, ros2, yaml, moveit, mujoco or urscript.")],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="File to write (ros2, mujoco: new directory).")
    ] = None,
    stem: Annotated[
        str,
        typer.Option("--plan", help="Which motion: plan (all its legs), baseline or nominal; or a leg: leg1, leg2 ..."),
    ] = "plan",
    rate: Annotated[float | None, typer.Option(help="Samples per second; default: the plan's own instants.")] = None,
    pause: Annotated[float | None, typer.Option(help="Seconds at rest between the legs of a plan; default 5.")] = None,
    stop_input: Annotated[
        int, typer.Option(help="urscript: standard digital input, 0 to 7, that requests a stop when it is low.")
    ] = 0,
    unsafe: Unsafe = False,
    json: Json = False,
) -> None:
    """Write a planned motion for other programs: CSV, ROS 2 bag (mcap), ROS 2 messages as YAML
    (moveit: a RobotTrajectory), MuJoCo scene, URScript program.

    Numbers keep all their digits; times are whole nanoseconds.

    A motion that failed verification (of the plan, its check or its arm) is written only with --unsafe, with UNSAFE at
    the beginning of the file and in its name: cube-UNSAFE.csv.

    Example: `salver export runs/panda-cube --format ros2 -o cube_bag`

    Ends with 3 when the motion is unsafe and --unsafe was not given.
    """
    from salver.export import write_export
    from salver.export.motion import PAUSE
    from salver.planning.round import has_legs

    legs = stem == "plan" and has_legs(directory)
    if pause is not None and not legs:
        raise SalverError(f"--pause is for a plan of several legs; {directory}, {stem}, is one motion.")
    paths = write_export(directory, file_format, output, stem, rate, pause=pause, unsafe=unsafe, stop_input=stop_input)
    if legs:
        say(f"salver: the arm rests for {PAUSE if pause is None else pause:g} s between two legs (--pause).")
    if json:
        print_json({"files": [str(path) for path in paths]})
    else:
        meshes = [path for path in paths if path.parent.name == "meshes"]
        for path in paths:
            if path not in meshes:
                say(f"Wrote {path}")
        if meshes:
            say(f"Wrote {len(meshes)} files in {meshes[0].parent}")
