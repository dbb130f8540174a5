"""`salver retime`: the fastest safe timing of a path that is given."""

from __future__ import annotations

from pathlib import Path
from shlex import quote
from typing import Annotated

import typer

from salver.cli.common import NO_SAFE_PLAN, Json, print_json, result_console, save_plans, say


def retime(
    path: Annotated[
        Path,
        typer.Argument(help="A CSV file of joint waypoints, one posture in rad per row, or a run directory."),
    ],
    scenario: Annotated[
        str | None,
        typer.Option("-s", "--scenario", help="Name or .toml file; needed for a CSV file, else that of the run."),
    ] = None,
    out: Annotated[Path | None, typer.Option("-o", "--out", help="Run directory; default runs/NAME-retimed.")] = None,
    robust: Annotated[bool, typer.Option(help="Safe for the whole uncertain set, or only nominally.")] = True,
    json: Json = False,
) -> None:
    """Run through joint waypoints, or along the path of a plan, as fast as is safe for what is carried.

    Example: `salver retime waypoints.csv --scenario panda-cube -o runs/retimed`

    Ends with 0 when the path can be run safely, with 3 when it cannot.
    """
    from salver import scenario as scenarios
    from salver.errors import ScenarioError
    from salver.planning.fastest.retiming import plan_retimed, read_waypoints
    from salver.run_directory import check_free

    if scenario is None:
        if not path.is_dir():
            raise ScenarioError(f"{path} is not a run directory; for a file of waypoints give --scenario.")
        scenario = str(path / "scenario.toml")
    chosen = scenarios.load(scenario)
    directory = out if out is not None else Path("runs") / f"{chosen.name}-retimed"
    check_free(directory)
    plan = plan_retimed(chosen, read_waypoints(path), robust=robust)
    save_plans(directory, {"plan": plan})
    if json:
        print_json({"directory": directory, "plan": plan.summary()})
    else:
        tell = result_console().print
        tell(str(plan.status))
        tell(plan.verification.sentence)
        if plan.arm_status is not None:
            tell(str(plan.arm_status))
        tell(f"No law on this path is faster than {plan.solver['lower_bound']:.4f} s.")
        say(f"Written to {directory}; next: salver simulate {quote(str(directory))}")
    if not plan.ok:
        raise typer.Exit(NO_SAFE_PLAN)
