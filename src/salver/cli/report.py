"""`salver report`: the page, and with it the figures."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from salver.cli.common import Json, print_json, say


def report(
    directory: Annotated[Path, typer.Argument(help="A run directory, as `salver plan` makes it.")],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Where to write it; DIR/report.html by default.")
    ] = None,
    json: Json = False,
) -> None:
    """Write one self-contained page about a run: verdict, 3-D replay, margins, tubes, results.

    It opens from disk in any current browser and needs no network. It shows what the directory has: run it again
    after `salver simulate` or `salver campaign`.

    Example: `salver report out/panda-cube`
    """
    from salver.reports.page import write_report

    path = write_report(directory, output, say)
    if json:
        print_json({"page": str(path), "bytes": path.stat().st_size})
    else:
        say(f"Wrote {path} ({path.stat().st_size / 1e6:.1f} MB); open it in a browser.")
