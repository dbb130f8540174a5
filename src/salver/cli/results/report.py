"""`salver report`: write a page about a run or an audit."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from salver.cli.checks.audit import Gap, Highest, Noise, OnTray, Topic, Units
from salver.cli.common import Json, of_a_run, print_json, say


def report(
    directory: Annotated[
        Path, typer.Argument(help="A run directory, as `salver plan` makes it; or a motion file, with --scenario.")
    ],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Page to write; default: DIR/report.html or FILE.html.")
    ] = None,
    scenario: OnTray = None,
    topic: Topic = None,
    units: Units = None,
    highest: Highest = 50.0,
    noise: Noise = None,
    gap: Gap = None,
    json: Json = False,
) -> None:
    """Write one self-contained page about a run: verdict, 3-D replay, margins, tubes, results.

    For a motion file it shows the audit, with the options of `salver audit`: `salver report motion.csv -s panda-cube`.

    It opens from disk in any current browser and needs no network. It shows the present results of the directory: write
    it again after `salver simulate` or `salver campaign`.

    Example: `salver report out/panda-cube`
    """
    if scenario is not None:
        from salver import scenario as scenarios
        from salver.auditing import AuditOptions, audit
        from salver.reports.pages.inline import page_of

        found = audit(directory, scenarios.load(scenario), topic, AuditOptions(highest, noise, gap), units)
        path = output or directory.with_suffix(".html")
        page_of(found, path=path)
    else:
        from salver.reports.pages.page import write_report

        of_a_run(directory)
        path = write_report(directory, output, say)
    if json:
        print_json({"page": str(path), "bytes": path.stat().st_size})
    else:
        size = path.stat().st_size
        say(f"Wrote {path} ({f'{size / 1e6:.1f} MB' if size > 1e6 else f'{size / 1e3:.0f} kB'}); open it in a browser.")
