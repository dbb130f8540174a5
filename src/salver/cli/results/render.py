"""`salver render`: make a film of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from salver.cli.common import Json, print_json, say


def render(
    directory: Annotated[Path, typer.Argument(help="A run directory with a simulation (`salver simulate`).")],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Film to write: .mp4 or .gif; or .mcap.")
    ] = None,
    stem: Annotated[
        str,
        typer.Option(
            "--plan", help="plan (all its legs), baseline, nominal, or both side by side; or a leg: leg1, leg2 ..."
        ),
    ] = "both",
    rate: Annotated[float, typer.Option(help="Pictures a second.")] = 30.0,
    speed: Annotated[float, typer.Option(help="Speed of time; 0.25 is four times slower.")] = 1.0,
    width: Annotated[int, typer.Option(help="Width of each picture, pixels.")] = 960,
    height: Annotated[int, typer.Option(help="Height of each picture, pixels.")] = 720,
    json: Json = False,
) -> None:
    """Film the simulated runs of a directory, without a display.

    MuJoCo draws the pictures, which needs OpenGL; ffmpeg makes the film (not needed for a gif).
    With a name that ends in .mcap, one motion is written as a recording for Foxglove or RViz: the simulated one, or the
    planned one if it was not simulated.

    Example: `salver render runs/panda-cube -o cube.mp4`
    """
    from salver.motion_files.verdict import UNSAFE
    from salver.reports.film import write_film

    path = output if output is not None else directory / "film.mp4"
    if path.suffix.lower() == ".mcap":
        from salver.reports.pages.mcap import write_mcap

        found = write_mcap(directory, path, "plan" if stem == "both" else stem)
        if json:
            print_json({"recording": found})
        else:
            say(f"Wrote {found}: {found.stat().st_size / 1e6:.1f} MB.")
        return
    film = write_film(directory, path, stem, rate=rate, speed=speed, width=width, height=height)
    for name, verdict in film.verdicts.items():
        if verdict.startswith(UNSAFE):
            say(f"salver: {name}: {verdict}")
    if json:
        print_json({"film": film.path, "frames": film.frames, "verdicts": film.verdicts})
    else:
        say(f"Wrote {film.path}: {film.frames} pictures, {film.path.stat().st_size / 1e6:.1f} MB.")
