"""`salver plan`: from a scenario to a run directory."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from enum import StrEnum
from functools import partial
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated

import typer

from salver.cli.common import NO_SAFE_PLAN, Json, Stops, headed, print_json, result_console, save_plans, say
from salver.cli.progress import step
from salver.cli.searching import searching
from salver.cli.watch import watched

if TYPE_CHECKING:
    from collections.abc import Callable

    from salver.planning.fastest import FastestOptions
    from salver.planning.plan import Plan
    from salver.planning.round import Round
    from salver.scenario import Scenario


class Effort(StrEnum):
    """The names in `salver.planning.fastest.EFFORTS`, which loads solvers."""

    QUICK = "quick"
    NORMAL = "normal"
    THOROUGH = "thorough"


def plan(
    scenario: Annotated[
        str, typer.Argument(help="Name of a ready-made scenario (see `salver scenarios`) or a .toml file.")
    ],
    out: Annotated[Path | None, typer.Option("-o", "--out", help="Run directory; default runs/NAME.")] = None,
    fastest: Annotated[bool, typer.Option("--fastest", help="Find the shortest duration that is safe.")] = False,
    safest: Annotated[
        bool,
        typer.Option(
            "--safest",
            help="Find the motion that keeps the load furthest from its edge in the given duration, clear of obstacles "
            "and within the arm's limits.",
        ),
    ] = False,
    least_sensitive: Annotated[
        bool,
        typer.Option(
            "--least-sensitive",
            help="Find the motion along which the closed loop reacts least to wrong parameters in the given duration "
            "(what the paper minimises), clear of obstacles and within the arm's limits.",
        ),
    ] = False,
    beside: Annotated[
        str | None,
        typer.Option(
            help="What to compare it with: baseline (the straight line in the same time; the default), or nominal (the "
            "fastest motion for someone who believes the nominal values). A task of several legs is compared with "
            "nothing.",
        ),
    ] = None,
    duration: Annotated[float | None, typer.Option(help="Duration in s, instead of the scenario's.")] = None,
    arm: Annotated[bool, typer.Option(help="Follow the plan with the scenario's arm, when it has one.")] = True,
    stops: Stops = False,
    force: Annotated[
        bool, typer.Option("--force", help="Replace the plans of another scenario too; they are kept in earlier/.")
    ] = False,
    watch: Annotated[
        bool, typer.Option("--watch", help="Plan again, and write the page, whenever the .toml file is saved.")
    ] = False,
    effort: Annotated[
        Effort | None,
        typer.Option(
            help="How much the search for a fastest, safest or least sensitive plan tries, in starts and iterations; "
            "default normal. The same effort gives the same plan on any machine.",
        ),
    ] = None,
    time_limit: Annotated[
        float | None,
        typer.Option(min=0.0, help="End that search after so many seconds, with the best so far; none by default."),
    ] = None,
    json: Json = False,
) -> None:
    """Plan a motion that keeps the object on the tray, and another one beside it to compare it with.

    Plans of the same scenario, as it was before it was edited, are replaced: they move to earlier/ with their results.

    Example: `salver plan panda-cube -o runs/cube`

    Ends with 0 when the plan is safe and the arm can follow it, with 3 when no such plan was found, which does not
    prove that there is none. Ctrl-C ends the search for a fastest plan with the best found so far, which is written
    with a status that says so; Ctrl-C once more ends the command.
    """
    from salver import scenario as scenarios
    from salver.planning.make import plan_pair
    from salver.planning.plan_files import check_place
    from salver.run_directory import check_free

    if watch:
        again = partial(
            plan,
            scenario,
            out,
            fastest=fastest,
            safest=safest,
            least_sensitive=least_sensitive,
            beside=beside,
            duration=duration,
            arm=arm,
            stops=stops,
            force=force,
            effort=effort,
            time_limit=time_limit,
            json=json,
        )
        watched(Path(scenario), again, lambda: out if out is not None else Path("runs") / scenarios.load(scenario).name)
        return
    chosen = scenarios.load(scenario)
    if duration is not None:
        chosen = chosen.with_changes(motion__duration=duration)
    asked = {"fastest": fastest, "safest": safest, "least-sensitive": least_sensitive}
    methods = [name for name, wanted in asked.items() if wanted]
    if len(methods) > 1:
        raise typer.BadParameter("--fastest, --safest and --least-sensitive are three questions: give one of them.")
    method = methods[0] if methods else "fastest" if chosen.motion.duration is None else "robust"
    if method == "robust" and (effort is not None or time_limit is not None):
        raise typer.BadParameter(
            "--effort and --time-limit are for the searches of --fastest, --safest and --least-sensitive."
        )
    directory = out if out is not None else Path("runs") / chosen.name
    if chosen.legs:
        if beside is not None or not arm:
            raise typer.BadParameter("--beside and --no-arm are not for a task of several legs; leave them out.")
        if least_sensitive:
            raise typer.BadParameter("--least-sensitive is not for a task of several legs; ask for --safest.")
        _plan_legs(chosen, directory, safest, stops, force, options_of(effort), time_limit, json)
        return
    beside = beside or "baseline"
    if method == "fastest":  # the scenario that is saved is known when the plan is
        check_free(directory)
    else:
        check_place(chosen, directory, edited=True, force=force)
    searches = method != "robust" or beside == "nominal"
    with searching(time_limit) if searches else nullcontext() as search:
        options = options_of(effort) if searches else None
        found, other = plan_pair(chosen, method, arm, beside, options=options, watch=search)
    if stops and found.ok:
        from salver.planning.stops import with_stops

        found = with_stops(found, lambda done, total: step(done, total, "stops"))
    save_plans(directory, {"plan": found, beside: other}, force)
    if json:
        print_json({"directory": directory, "plan": found.summary(), beside: other.summary()})
    else:
        show(found, other, beside)
        quoted = quote(str(directory))
        simulate = f"salver simulate {quoted}, or " if found.joint is not None or chosen.arm is None else ""
        say(f"Written to {directory}; next: {simulate}salver report {quoted}")
    if not found.ok:
        raise typer.Exit(NO_SAFE_PLAN)


def _plan_legs(
    scenario: Scenario,
    directory: Path,
    safest: bool,
    stops: bool,
    force: bool,
    options: FastestOptions,
    time_limit: float | None,
    json: bool,
) -> None:
    """The plan of a task of several legs."""
    from salver.planning.fastest.legs import plan_legs
    from salver.planning.fastest.safest import plan_safest_legs
    from salver.planning.stops import with_stops
    from salver.run_directory import check_free

    check_free(directory)
    with searching(time_limit) as search:
        found = (plan_safest_legs if safest else plan_legs)(scenario, options=options, watch=search)
    if stops and found.ok:
        found = replace(found, legs=tuple(with_stops(leg) for leg in found.legs))
    save_plans(directory, {"plan": found}, force)
    if json:
        print_json({"directory": directory, "plan": found.summary()})
    else:
        _show_legs(found)
        say(f"Written to {directory}; next: salver simulate {quote(str(directory))}")
    if not found.ok:
        raise typer.Exit(NO_SAFE_PLAN)


def _show_legs(plan: Round) -> None:
    """A plan of several legs for a person, on standard output."""
    from rich.table import Table

    console, scenario = result_console(), plan.scenario
    console.print(headed(scenario.name, scenario.summary) if scenario.summary else scenario.name)
    table = Table(box=None, padding=(0, 3, 0, 0))
    for column in ("leg", "on the tray", "then", "duration", "left, worst case", "friction needed / sure", "arm"):
        table.add_column(column)
    for k, (leg, asked) in enumerate(zip(plan.legs, scenario.legs, strict=True), 1):
        table.add_row(
            str(k),
            ", ".join(item.name for item in leg.scenario.objects),
            ", ".join([*(f"- {name}" for name in asked.taken), *(f"+ {name}" for name in asked.added)]),
            f"{leg.duration:.4g} s",
            f"{100 * leg.margins.exact_worst.min():.1f} %",
            _friction(leg),
            "yes" if leg.arm_status is not None and leg.arm_status.ok else "NO",
        )
    console.print(table)
    console.print(f"Not checked: {'; '.join(plan.unchecked)}.")
    console.print(headed("all", plan.status))
    for k, leg in enumerate(plan.legs, 1):
        console.print(headed(f"leg {k}", leg.status))
        console.print(f"  arm: {leg.arm_status}")
        console.print(f"  {leg.verification.sentence}")
        if leg.stops is not None:
            console.print(f"  {leg.stops.sentence}")
    console.print(f"Solved in {1e3 * float(plan.solver['seconds']):.1f} ms by {plan.solver['name']}.")


def options_of(effort: Effort | None) -> FastestOptions:
    """The options of the search for an effort; None is the normal one."""
    from salver.planning.fastest import EFFORTS

    return EFFORTS[effort or Effort.NORMAL]


def show(plan: Plan, other: Plan, beside: str) -> None:
    """The plan and what it is compared with, for a person, on standard output."""
    from rich.table import Table

    console = result_console()
    scenario = plan.scenario
    console.print(headed(scenario.name, scenario.summary) if scenario.summary else scenario.name)
    uncertain = ", ".join(
        f"{name} ±{half:.3g}" for name, half in zip(plan.uncertain.names, plan.uncertain.half_range, strict=True)
    )
    console.print(
        f"Uncertain ({plan.uncertain.kind}, SI units): {uncertain or 'nothing'}; duration {plan.duration:.4g} s"
    )
    table = Table(box=None, padding=(0, 3, 0, 0))
    table.add_column("")
    names = (plan.method, beside)
    for name in names:
        table.add_column(name, justify="right")
    lines: dict[str, Callable[[Plan], str]] = {"sensitivity cost, eq (13)": lambda p: f"{p.cost:.4g}"}
    if scenario.contact.condition == "paper":
        lines |= {
            "least cone coefficient, nominal": lambda p: f"{1e3 * p.cone_coefficients.min():.1f} mN",
            "least cone coefficient, in its tube": lambda p: (
                f"{1e3 * (p.cone_coefficients - p.cone_radius).min():.1f} mN"
            ),
        }
    lines |= {
        "exact margin of the weight, worst case": lambda p: f"{100 * p.margins.exact_worst.min():.1f} %",
        "friction needed / sure, worst case": _friction,
        "distance to tipping, worst case": lambda p: (
            f"{1e3 * min(m.tip_over_worst.min() for m in p.margins.interfaces):.1f} mm"
        ),
        "contact condition kept everywhere": lambda p: "yes" if p.verification.violation == 0 else "NO",
        "arm can follow, as far as checked": lambda p: (
            "-" if p.arm_status is None else "yes" if p.arm_status.ok else "NO"
        ),
    }
    for label, value in lines.items():
        table.add_row(label, value(plan), value(other))
    console.print(table)
    # What is not checked of the arm, its own sentence says.
    blind = plan.unchecked if plan.arm_status is None else plan.scenario.payload.unmodelled
    if blind:
        console.print(f"Not checked: {'; '.join(blind)}.")
    for name, item in zip(names, (plan, other), strict=True):
        console.print(headed(name, item.status))
        if item.arm_status is not None:
            console.print(f"  arm: {item.arm_status}")
    if plan.method == "robust" and plan.status.ok and plan.arm_status is not None and not plan.arm_status.ok:
        console.print("This plan is of the object alone; --least-sensitive seeks the same within the arm's limits.")
    console.print(plan.verification.sentence)
    if plan.stops is not None:
        console.print(plan.stops.sentence)
    if plan.solver:
        seconds = 1e3 * float(plan.solver["seconds"])
        console.print(f"Solved in {seconds:.1f} ms by {plan.solver['name']}.")


def _friction(plan: Plan) -> str:
    """Of the interface that needs most of what it surely has."""
    tight = max(plan.margins.interfaces, key=lambda m: m.friction_needed_worst / m.least_friction)
    needed = tight.friction_needed_worst
    return f"{f'{needed:.3f}' if needed < float('inf') else 'none suffices'} / {tight.least_friction:.3f}"
