"""`salver plan`: plan a motion for a scenario and write a run directory."""

from __future__ import annotations

from contextlib import nullcontext
from enum import StrEnum
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated

import typer

from salver.cli.common import (
    ExitCode,
    Json,
    ScenarioName,
    Stops,
    headed,
    print_json,
    print_table,
    result_console,
    save_plans,
    say,
)
from salver.cli.plans.searching import searching, stopping
from salver.wording import millimetres, number

if TYPE_CHECKING:
    from collections.abc import Callable

    from salver.planning.fastest import FastestOptions
    from salver.planning.plan import Plan
    from salver.planning.round import MultiLegPlan
    from salver.scenario import Scenario


class Effort(StrEnum):
    """The names in `salver.planning.fastest.EFFORTS`, repeated here because importing that loads solvers."""

    QUICK = "quick"
    NORMAL = "normal"
    THOROUGH = "thorough"


def plan(
    scenario: ScenarioName,
    out: Annotated[Path | None, typer.Option("-o", "--out", help="Run directory; default runs/NAME.")] = None,
    fastest: Annotated[bool, typer.Option("--fastest", help="Find the shortest duration that is safe.")] = False,
    safest: Annotated[
        bool,
        typer.Option(
            "--safest",
            help="Find the motion with the largest worst-case margin in the given duration, clear of obstacles and "
            "within the arm's limits.",
        ),
    ] = False,
    least_sensitive: Annotated[
        bool,
        typer.Option(
            "--least-sensitive",
            help="Find the motion whose closed loop is least sensitive to parameter errors in the given duration (what "
            "the paper minimises), clear of obstacles and within the arm's limits.",
        ),
    ] = False,
    robust: Annotated[
        bool,
        typer.Option(
            "--robust",
            help="Find the paper's motion: as --least-sensitive, but for the object alone, whether or not the arm can "
            "follow it.",
        ),
    ] = False,
    beside: Annotated[
        str | None,
        typer.Option(
            help="Motion to compare it with: baseline (the straight line in the same time; the default), or nominal "
            "(the fastest motion for nominal parameters). A task of several legs has no comparison.",
        ),
    ] = None,
    duration: Annotated[float | None, typer.Option(help="Duration in s, instead of the scenario's.")] = None,
    arm: Annotated[bool, typer.Option(help="Follow the plan with the scenario's arm, when it has one.")] = True,
    stops: Stops = False,
    force: Annotated[
        bool, typer.Option("--force", help="Replace the plans of another scenario too; they are kept in earlier/.")
    ] = False,
    effort: Annotated[
        Effort | None,
        typer.Option(
            help="Effort of the search for a fastest, safest or least sensitive plan, in initial guesses and "
            "iterations; default normal. It gives the same plan on any machine.",
        ),
    ] = None,
    time_limit: Annotated[
        float | None,
        typer.Option(min=0.0, help="End that search after this time, s, with the best plan so far; default: none."),
    ] = None,
    json: Json = False,
) -> None:
    """Plan a motion that keeps the object on the tray, and another one to compare it with.

    Without an option the method is the scenario's plan.method; by default the safest motion in its duration, or the
    fastest if it has no duration.

    Earlier plans of the same scenario, also before it was edited, are moved to earlier/ with their results.

    Example: `salver plan panda-cube -o runs/cube`

    Ends with 0 when the plan is safe and the arm can follow it, with 3 when no such plan was found, which does not
    prove that there is none. Ctrl-C ends the search for a fastest plan with the best found so far, which is written
    with a status that says so; Ctrl-C once more ends the command.
    """
    from salver import scenario as scenarios

    chosen = scenarios.load(scenario)
    if duration is not None:
        chosen = chosen.with_changes(motion__duration=duration)
    asked = {"fastest": fastest, "safest": safest, "least-sensitive": least_sensitive, "robust": robust}
    method = _method(chosen, arm, [name for name, wanted in asked.items() if wanted])
    if method == "robust" and beside != "nominal" and (effort is not None or time_limit is not None):
        raise typer.BadParameter(
            "--effort and --time-limit are for the searches of --fastest, --safest and --least-sensitive."
        )
    directory = out if out is not None else Path("runs") / chosen.name
    options = None  # the normal ones, without importing the search
    if effort is not None:
        from salver.planning.fastest import EFFORTS

        options = EFFORTS[effort]
    if chosen.legs:
        if beside is not None or not arm:
            raise typer.BadParameter("--beside and --no-arm are not for a task of several legs; leave them out.")
        if method != "fastest" and chosen.motion.duration is None:
            raise typer.BadParameter(f"--{method} is not for a task of several legs: it is planned as fast as is safe.")
    plans = _planned(chosen, method, arm, beside or "baseline", directory, force, options, time_limit)
    if stops:
        plans["plan"] = stopping(plans["plan"], lambda: save_plans(directory, plans, force))
    save_plans(directory, plans, force)
    if json:
        print_json({"directory": directory, **{stem: made.summary() for stem, made in plans.items()}})
    else:
        _tell(directory, plans)
    if not plans["plan"].ok:
        raise typer.Exit(ExitCode.NO_SAFE_PLAN)


def _method(scenario: Scenario, arm: bool, asked: list[str]) -> str:
    """The planning method, from the options or the scenario."""
    from salver.planning.make import method_of

    if len(asked) > 1:
        raise typer.BadParameter(
            "--fastest, --safest, --least-sensitive and --robust are alternatives: give one of them."
        )
    method = asked[0] if asked else method_of(scenario, arm)
    return "fastest" if method == "robust" and scenario.motion.duration is None else method


def _planned(
    scenario: Scenario,
    method: str,
    arm: bool,
    beside: str,
    directory: Path,
    force: bool,
    options: FastestOptions | None,
    time_limit: float | None,
) -> dict[str, Plan | MultiLegPlan]:
    """By name: the plan, and the plan that it is compared with; a task of several legs has none."""
    from salver.planning.make import plan_pair
    from salver.planning.plan_files import check_place
    from salver.run_directory import check_free

    if method == "fastest" or scenario.legs:  # the scenario to be saved, with its duration, is known after planning
        check_free(directory)
    else:
        check_place(scenario, directory, edited=True, force=force)
    with searching(time_limit) if method != "robust" or beside == "nominal" else nullcontext() as search:
        if scenario.legs:
            from salver.planning.fastest.legs import plan_legs

            return {"plan": plan_legs(scenario, options=options, watch=search)}
        found, other = plan_pair(scenario, method, arm, beside, options=options, watch=search)
    return {"plan": found, beside: other}


def _tell(directory: Path, plans: dict[str, Plan | MultiLegPlan]) -> None:
    """Print the plans, and the next commands."""
    from salver.planning.plan import Plan

    found, quoted = plans["plan"], quote(str(directory))
    commands = [f"salver simulate {quoted}", f"salver report {quoted}"]
    if isinstance(found, Plan):
        beside = next(stem for stem in plans if stem != "plan")
        other = plans[beside]
        assert isinstance(other, Plan)
        show(found, other, beside)
        runs = found.joint is not None or found.scenario.arm is None
        commands = commands if runs else commands[1:]
    else:
        _show_legs(found)
        commands = commands[:1]
    say(f"Written to {directory}; next: {', or '.join(commands)}")


def _show_legs(plan: MultiLegPlan) -> None:
    """Print a plan of several legs."""
    console = result_console()
    _head(plan)
    _print_columns({f"leg {k}": leg for k, leg in enumerate(plan.legs, 1)})
    console.print(f"Not checked: {'; '.join(plan.unchecked)}.")
    console.print(headed("all", plan.status))
    for k, leg in enumerate(plan.legs, 1):
        console.print(headed(f"leg {k}", leg.status))
        for sentence in (f"arm: {leg.arm_status}", leg.speeds.sentence, *checked(leg)):
            console.print(f"  {sentence}")
    console.print(_solved(plan))


def _head(plan: Plan | MultiLegPlan) -> None:
    """Print the task and the warnings about it."""
    console, scenario = result_console(), plan.scenario
    console.print(headed(scenario.name, scenario.summary) if scenario.summary else scenario.name)
    for sentence in plan.warnings:
        console.print(headed("Warning", sentence))


def checked(plan: Plan) -> list[str]:
    """The sentences of a plan's check, of the room that it takes, and of its stops."""
    return [plan.verification.sentence, plan.extent.sentence] + ([plan.stops.sentence] if plan.stops else [])


def _solved(plan: Plan | MultiLegPlan) -> str:
    return f"Solved in {float(plan.solver['seconds']):.3f} s by {plan.solver['name']}."


def _print_columns(plans: dict[str, Plan]) -> None:
    """Print plans side by side, each under its name."""
    first, *others = plans.values()
    lines: dict[str, Callable[[Plan], str]] = {}
    if any(other.scenario.objects != first.scenario.objects for other in others):
        lines["on the tray"] = lambda p: ", ".join(item.name for item in p.scenario.objects)
    lines |= {"duration": lambda p: f"{p.duration:.4g} s", "sensitivity cost, eq (13)": lambda p: f"{p.cost:.4g}"}
    if first.scenario.contact.condition == "paper":
        lines |= {
            "least cone coefficient, nominal": lambda p: f"{1e3 * p.cone_coefficients.min():.1f} mN",
            "least cone coefficient, in its tube": lambda p: (
                f"{1e3 * (p.cone_coefficients - p.cone_radius).min():.1f} mN"
            ),
        }
    lines |= {
        "exact margin of the weight, worst case": lambda p: f"{100 * p.left:.1f} %",
        "friction needed / sure, worst case": _friction,
        "distance to tipping, worst case": lambda p: millimetres(
            min(m.tip_over_worst.min() for m in p.margins.interfaces)
        ),
    }
    if any(plan.scenario.payload.dynamic for plan in plans.values()):
        lines["room inside the load, worst case"] = _room
    lines |= {
        "contact condition kept everywhere": lambda p: "yes" if p.verification.violation == 0 else "NO",
        "arm can follow, as far as checked": lambda p: (
            "-" if p.arm_status is None else "yes" if p.arm_status.ok else "NO"
        ),
    }
    print_table(("", *plans), ((label, *map(value, plans.values())) for label, value in lines.items()))


def show(plan: Plan, other: Plan, beside: str) -> None:
    """Print the plan beside the plan that it is compared with."""
    console = result_console()
    _head(plan)
    uncertain = ", ".join(
        f"{name} ±{half:.3g}" for name, half in zip(plan.uncertain.names, plan.uncertain.half_range, strict=True)
    )
    console.print(f"Uncertain ({plan.uncertain.kind}, SI units): {uncertain or 'nothing'}")
    console.print(plan.speeds.sentence)
    names = (plan.method, beside)
    _print_columns(dict(zip(names, (plan, other), strict=True)))
    # The arm's own sentence says what is not checked of it.
    blind = plan.unchecked if plan.arm_status is None else (*plan.scenario.payload.unmodelled, *plan.unshaken)
    if blind:
        console.print(f"Not checked: {'; '.join(blind)}.")
    for name, item in zip(names, (plan, other), strict=True):
        console.print(headed(name, item.status))
        if item.arm_status is not None:
            console.print(f"  arm: {item.arm_status}")
    if plan.method == "robust" and plan.status.ok and plan.arm_status is not None and not plan.arm_status.ok:
        console.print("This plan is for the object alone; --least-sensitive plans the same within the arm's limits.")
    for sentence in checked(plan):
        console.print(sentence)
    if plan.solver:
        console.print(_solved(plan))


def _room(plan: Plan) -> str:
    """Remaining room of the load's liquid or pendulum, during the motion and after it, in words."""
    rooms = (each.room for each in plan.margins.load_verdicts(worst=True))
    return millimetres(min(rooms, default=float("inf")), "no edge")


def _friction(plan: Plan) -> str:
    """Friction needed and least friction of the interface that uses the largest share of it, in words."""
    tight = max(plan.margins.interfaces, key=lambda m: m.friction_needed_worst / m.least_friction)
    return f"{number(tight.friction_needed_worst, 3, otherwise='none suffices')} / {tight.least_friction:.3f}"
