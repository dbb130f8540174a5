"""`salver tradeoff`: the shortest safe duration over the size of the uncertainty."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from salver.cli.common import (
    NO_SAFE_PLAN,
    Json,
    ScenarioName,
    headed,
    numbers,
    print_json,
    print_table,
    result_console,
    say,
)
from salver.cli.progress import step
from salver.errors import ScenarioError

if TYPE_CHECKING:
    from salver.planning.fastest.tradeoff import TradeoffPoint


def tradeoff(
    scenario: ScenarioName,
    out: Annotated[Path | None, typer.Option("-o", "--out", help="Directory; default runs/NAME-tradeoff.")] = None,
    scales: Annotated[
        str, typer.Option(help="Sizes of the uncertainty, in multiples of the scenario's, separated by commas.")
    ] = "0,0.25,0.5,0.75,1,1.25,1.5,2",
    file_format: Annotated[str, typer.Option("--format", help="Format of the figure: pdf, svg or png.")] = "svg",
    json: Json = False,
) -> None:
    """Find the shortest safe duration for increasing uncertainty, as a table and a figure.

    The scenario needs an arm. At 1 times its uncertainty the result is that of `salver plan --fastest`: the duration is
    free, and the tray may tilt unless motion.orientation is "fixed".

    Example: `salver tradeoff panda-cube --scales 0,0.5,1,2`

    Ends with 0 when at least the smallest uncertainty has a safe motion, with 3 otherwise.
    """
    from salver import scenario as scenarios
    from salver.files import provenance
    from salver.planning.fastest.tradeoff import TradeoffTask
    from salver.planning.fastest.tradeoff import tradeoff as curve
    from salver.reports.pictures.figures import check_format

    wanted = _scales(scales)
    check_format(file_format)
    chosen = scenarios.load(scenario)
    asked, points = TradeoffTask.of(chosen), []
    if not json:
        say(asked.sentence)
    for point in curve(chosen, wanted):
        points.append(point)
        step(len(points), len(wanted))
        if not json:
            say(f"{point.scale:g} times the uncertainty: {point.status}")
    directory = out if out is not None else Path("runs") / f"{chosen.name}-tradeoff"
    found = {"asked": asked.sentence, "points": [point.record() for point in points]}
    _write(directory, {**found, "provenance": provenance(chosen)}, points, file_format)
    if json:
        print_json({"directory": directory, **found})
    else:
        show(chosen.name, points)
        say(f"Written to {directory}")
    if not any(point.status.ok for point in points):
        raise typer.Exit(NO_SAFE_PLAN)


def _scales(text: str) -> list[float]:
    scales = numbers(text)
    if not all(0 <= scale <= 100 for scale in scales) or not 0 < len(scales) <= 100:
        raise ScenarioError(f'--scales = "{text[:80]}" must be at most 100 numbers from 0 to 100, separated by commas.')
    return scales


def _write(directory: Path, document: dict[str, Any], points: list[TradeoffPoint], file_format: str) -> None:
    """Write the points, and a figure of those at which a motion was found."""
    from salver.files import to_json, write_atomic
    from salver.reports.pictures.figures import render, tradeoff_curve
    from salver.reports.style import paper_style

    write_atomic(directory / "tradeoff.json", to_json(document), keep=True)
    if solved := [point for point in points if point.status.ok]:
        with paper_style():
            picture = render(tradeoff_curve(solved), file_format)
        write_atomic(directory / f"tradeoff.{file_format}", picture, keep=True)


def show(name: str, points: list[TradeoffPoint]) -> None:
    """Print the curve as a table."""
    first = points[0].duration
    rows = [
        (
            f"{point.scale:g} x",
            f"{point.duration:.3f} s",
            f"{100 * (point.duration / first - 1):.1f} %",
            f"{point.friction_needed:.3f}",
            f"{100 * point.margin:.1f} % of the weight",
        )
        if point.status.ok
        else (f"{point.scale:g} x", "none", "", "", "")
        for point in points
    ]
    result_console().print(headed(name, "fastest safe motion over the size of the uncertainty"))
    print_table(("uncertainty", "duration", "longer by", "friction needed", "nominal margin"), rows)
