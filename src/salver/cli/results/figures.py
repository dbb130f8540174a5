"""`salver figures`: draw the paper's figures for a run directory."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from salver.cli.common import Json, print_json, say


def figures(
    directory: Annotated[Path, typer.Argument(help="A run directory, as `salver plan` makes it.")],
    file_format: Annotated[str, typer.Option("--format", help="pdf, svg or png.")] = "pdf",
    n: Annotated[int, typer.Option("-n", min=1, help="Perturbed bodies of Figs 5 and 6.")] = 100,
    seed: Annotated[int, typer.Option(min=0, help="Seed of their draws.")] = 0,
    physics: Annotated[bool, typer.Option(help="Also Figs 7 and 8, which run the physics engine four times.")] = True,
    json: Json = False,
) -> None:
    """Write the paper's figures 3 to 8 and its tables for this run into DIR/figures.

    Vector formats, one or two columns of a paper wide, safe for every kind of colour vision.

    Example: `salver figures runs/panda-cube --format pdf`
    """
    from salver.reports.pictures.figures import write_figures

    paths = write_figures(directory, file_format, n, seed, physics, say)
    if json:
        print_json({"files": [str(path) for path in paths]})
    else:
        for path in paths:
            say(f"Wrote {path}")
