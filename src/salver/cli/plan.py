"""`salver plan`: from a scenario to a run directory."""

from __future__ import annotations

from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated

import typer

from salver.cli.common import NO_SAFE_PLAN, Json, print_json, result_console, say

if TYPE_CHECKING:
    from salver.planning.plan import Plan


def plan(
    scenario: Annotated[
        str, typer.Argument(help="Name of a ready-made scenario (see `salver scenarios`) or a .toml file.")
    ],
    out: Annotated[Path | None, typer.Option("-o", "--out", help="Run directory; default runs/NAME.")] = None,
    fastest: Annotated[bool, typer.Option("--fastest", help="Find the shortest duration that is safe.")] = False,
    duration: Annotated[float | None, typer.Option(help="Duration in s, instead of the scenario's.")] = None,
    arm: Annotated[bool, typer.Option(help="Follow the plan with the scenario's arm, when it has one.")] = True,
    json: Json = False,
) -> None:
    """Plan a motion that keeps the object on the tray, and the straight line beside it.

    Example: `salver plan panda-cube -o runs/cube`

    Ends with 0 when the plan is safe and the arm can follow it, with 3 when there is no such plan.
    """
    from salver import scenario as scenarios
    from salver.planning.make import plan_pair

    chosen = scenarios.load(scenario)
    if duration is not None:
        chosen = chosen.with_changes(motion__duration=duration)
    found, baseline = plan_pair(chosen, "fastest" if fastest else "robust", arm)
    directory = found.save(out if out is not None else Path("runs") / chosen.name)
    baseline.save(directory, "baseline")
    if json:
        print_json({"directory": directory, "plan": found.summary(), "baseline": baseline.summary()})
    else:
        show(found, baseline)
        quoted = quote(str(directory))
        simulate = f"salver simulate {quoted}, or " if found.joint is not None or chosen.arm is None else ""
        say(f"Written to {directory}; next: {simulate}salver report {quoted}")
    if not found.ok:
        raise typer.Exit(NO_SAFE_PLAN)


def show(plan: Plan, baseline: Plan) -> None:
    """The plan and its baseline for a person, on standard output."""
    from rich.table import Table

    console = result_console()
    scenario = plan.scenario
    console.print(f"[bold]{scenario.name}[/bold]: {scenario.summary}" if scenario.summary else scenario.name)
    uncertain = ", ".join(
        f"{name} ±{half:.3g}" for name, half in zip(plan.uncertain.names, plan.uncertain.half_range, strict=True)
    )
    console.print(
        f"Uncertain ({plan.uncertain.kind}, SI units): {uncertain or 'nothing'}; duration {plan.duration:.4g} s"
    )
    table = Table(box=None, padding=(0, 3, 0, 0))
    table.add_column("")
    for item in (plan, baseline):
        table.add_column(item.method, justify="right")
    lines = {
        "sensitivity cost, eq (13)": lambda p: f"{p.cost:.4g}",
        "least cone coefficient, nominal": lambda p: f"{1e3 * p.cone_coefficients.min():.1f} mN",
        "least cone coefficient, in its tube": lambda p: f"{1e3 * (p.cone_coefficients - p.cone_radius).min():.1f} mN",
        "exact margin of the weight, worst case": lambda p: f"{100 * p.margins.exact_worst.min():.1f} %",
        "friction needed / sure, worst case": _friction,
        "distance to tipping, worst case": lambda p: (
            f"{1e3 * min(m.tip_over_worst.min() for m in p.margins.interfaces):.1f} mm"
        ),
        "contact condition kept everywhere": lambda p: "yes" if p.verification.violation == 0 else "NO",
        "arm can follow": lambda p: "-" if p.arm_status is None else "yes" if p.arm_status.ok else "NO",
    }
    for label, value in lines.items():
        table.add_row(label, value(plan), value(baseline))
    console.print(table)
    for item in (plan, baseline):
        console.print(f"[bold]{item.method}[/bold]: {item.status}")
        if item.arm_status is not None:
            console.print(f"  arm: {item.arm_status}")
    console.print(plan.verification.sentence)
    if plan.solver:
        seconds = 1e3 * float(plan.solver["seconds"])
        console.print(f"Solved in {seconds:.1f} ms by {plan.solver['name']}.")


def _friction(plan: Plan) -> str:
    """Of the interface that needs most of what it surely has."""
    tight = max(plan.margins.interfaces, key=lambda m: m.friction_needed_worst / m.least_friction)
    return f"{tight.friction_needed_worst:.3f} / {tight.least_friction:.3f}"
