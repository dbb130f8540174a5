"""`salver retime`: the fastest safe timing of a given path."""

from __future__ import annotations

from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated

import typer

from salver.cli.checks.audit import Topic, Units
from salver.cli.common import ExitCode, Json, Stops, print_json, result_console, save_plans, say
from salver.cli.plans.plan import checked
from salver.cli.plans.searching import stopping
from salver.errors import ScenarioError

if TYPE_CHECKING:
    from salver.planning.plan import Plan


def retime(
    path: Annotated[
        Path,
        typer.Argument(help="A motion file (CSV, JSON, YAML, ROS bag), a CSV of postures in rad, or a run directory."),
    ],
    scenario: Annotated[
        str | None,
        typer.Option("-s", "--scenario", help="Name or .toml file; needed for a file, default: that of the run."),
    ] = None,
    out: Annotated[Path | None, typer.Option("-o", "--out", help="Run directory; default runs/NAME-retimed.")] = None,
    robust: Annotated[bool, typer.Option(help="Plan for the whole uncertain set, or only for nominal values.")] = True,
    reserve: Annotated[
        str | None,
        typer.Option(
            help="Required worst-case margin of every contact, as a share of the normal force at rest, such as 10%. "
            "Default: margin of the scenario's [contact]."
        ),
    ] = None,
    topic: Topic = None,
    units: Units = None,
    stops: Stops = False,
    json: Json = False,
) -> None:
    """Find the fastest safe timing of joint waypoints, or of the path of a motion or a plan.

    Example: `salver retime waypoints.csv --scenario panda-cube -o runs/retimed`

    Ends with 0 when the path can be run safely, with 3 when it cannot.
    """
    from salver import scenario as scenarios
    from salver.given import read_waypoints, waypoints_of
    from salver.planning.fastest.retiming import plan_retimed, plan_retimed_legs
    from salver.planning.round import MultiLegPlan, load_round
    from salver.run_directory import SCENARIO, check_free

    if scenario is None:
        if not (path / SCENARIO).is_file():
            raise ScenarioError(f"{path} is not a run directory; for a file of a motion give --scenario.")
        scenario = str(path / SCENARIO)
    chosen = scenarios.load(scenario)
    if reserve is not None:
        chosen = chosen.with_changes(contact__condition="exact", contact__margin=_share(reserve))
    directory = out if out is not None else Path("runs") / f"{chosen.name}-retimed"
    check_free(directory)
    plan: Plan | MultiLegPlan
    if chosen.legs:
        paths = [waypoints_of(leg) for leg in load_round(path).legs]
        plan = plan_retimed_legs(chosen, paths, robust=robust)
    else:
        plan = plan_retimed(chosen, read_waypoints(path, chosen, topic, units), robust=robust)
    if stops:
        plan = stopping(plan, lambda: save_plans(directory, {"plan": plan}))
    save_plans(directory, {"plan": plan})
    if json:
        print_json({"directory": directory, "plan": plan.summary()})
    else:
        for leg in plan.legs if isinstance(plan, MultiLegPlan) else [plan]:
            _tell(leg)
        if isinstance(plan, MultiLegPlan):
            result_console().print(plan.status.sentence)
        say(f"Written to {directory}; next: salver simulate {quote(str(directory))}")
    if not plan.ok:
        raise typer.Exit(ExitCode.NO_SAFE_PLAN)


def _share(reserve: str) -> float:
    try:
        share = float(reserve.removesuffix("%")) / (100 if reserve.endswith("%") else 1)
    except ValueError:
        share = -1.0
    if not 0 <= share < 1:
        raise ScenarioError(f'--reserve "{reserve}" must be a share from 0 to below 100%, such as 10% or 0.1.')
    return share


def _tell(plan: Plan) -> None:
    """Print a plan along a given path."""
    from salver.planning.fastest.retiming import PATH_TOLERANCE

    tell = result_console().print
    for sentence in (plan.status.sentence, plan.arm_status and plan.arm_status.sentence, *checked(plan)):
        if sentence is not None:
            tell(sentence)
    tell(f"No timing of this path is faster than {plan.solver['lower_bound']:.4f} s.")
    if (missed := plan.solver["waypoints_missed"]) > PATH_TOLERANCE:
        tell(f"The path misses waypoints by up to {missed:.2g} rad, because they are too many.")
