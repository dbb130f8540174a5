"""`salver retime`: the fastest safe timing of a given path, or a motion stretched in time."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated

import typer

from salver.cli.checks.audit import Gap, Highest, Noise, Topic, Units
from salver.cli.common import ExitCode, Json, Stops, Unsafe, print_json, result_console, save_plans, say
from salver.cli.plans.plan import checked
from salver.cli.plans.searching import stopping
from salver.errors import ScenarioError, UnsafeError

if TYPE_CHECKING:
    from salver.auditing import AuditOptions
    from salver.motion_files import Samples
    from salver.planning.plan import Plan
    from salver.scenario import Scenario


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
    pace: Annotated[
        str | None,
        typer.Option(
            help="Only stretch the motion in time, by this factor; least: the least factor at which it holds. No run "
            "directory is made."
        ),
    ] = None,
    write: Annotated[
        Path | None,
        typer.Option(
            help="Write the motion to this file too; its ending gives the format (.csv, .json, .yaml; none: ROS bag). "
            "Default with --pace: beside PATH, in its format."
        ),
    ] = None,
    topic: Topic = None,
    units: Units = None,
    highest: Highest = 50.0,
    noise: Noise = None,
    gap: Gap = None,
    stops: Stops = False,
    unsafe: Unsafe = False,
    json: Json = False,
) -> None:
    """Find the fastest safe timing of joint waypoints, or of the path of a motion or a plan.

    --pace only stretches a motion of the joints or of the tray in time, and audits the result (--highest, --noise,
    --gap: see `salver audit`).

    Example: `salver retime waypoints.csv --scenario panda-cube -o runs/retimed`

    Ends with 0 when the path can be run safely, with 3 when it cannot; its file (--write, --pace) is then written
    with --unsafe only.
    """
    from salver import scenario as scenarios
    from salver.export.motion import read_motion
    from salver.given import read_waypoints, waypoints_of
    from salver.motion_files import form_of
    from salver.motion_files import write as write_motion
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
    if write is not None:
        form_of(write)  # raises before anything is computed
    if pace is not None:
        if out is not None or stops or reserve is not None:
            raise typer.BadParameter(
                "--pace only scales the time and makes no run directory: leave -o, --stops and --reserve out; --write "
                "names its file."
            )
        from salver.auditing import AuditOptions, read_for

        _at_pace(
            read_for(chosen, path, topic, joints_first=True, units=units),
            chosen,
            pace,
            write or _beside(path),
            json,
            unsafe,
            AuditOptions(highest, noise, gap),
        )
        return
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
    if write is not None:
        for file in write_motion(read_motion(directory), write, unsafe=unsafe):
            say(f"Wrote {file}")
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


def _beside(path: Path) -> Path:
    """Default output file: motion-paced.csv for motion.csv; a directory for a ROS bag."""
    ending = "" if path.is_dir() or path.suffix.lower() in (".bag", ".mcap", ".db3") else path.suffix
    return path.with_name(f"{path.stem}-paced{'.csv' if ending.lower() == '.tsv' else ending}")


def _at_pace(
    samples: Samples,
    scenario: Scenario,
    pace: str,
    target: Path,
    json: bool,
    unsafe: bool,
    options: AuditOptions,
) -> None:
    """Write the motion stretched in time, and print its audit."""
    from salver.given import at_pace
    from salver.motion_files import JointSamples, MotionSeries, form_of, write

    try:
        factor = None if pace == "least" else float(pace)
    except ValueError:
        raise ScenarioError(f'--pace "{pace}" must be a number, as 0.9, or the word least.') from None
    found = at_pace(samples, scenario, factor, options)
    files, refused = [], None
    try:
        files = write(
            replace(MotionSeries.of(found.samples), verdict=found.verdict), target, samples.form, unsafe=unsafe
        )
    except UnsafeError as error:
        refused = error
    duration = float(found.samples.t[-1])
    if json:
        summary = found.audit.summary()
        print_json(
            {
                "files": [str(file) for file in files],
                "factor": found.factor,
                "duration": duration,
                "ok": found.ok,
                "verdict": found.verdict,
                "unchecked": found.unchecked,
                "too_fast": found.too_fast,
                "audit": summary,
            }
        )
    else:
        tell = result_console().print
        tell(f"Not checked: {found.unchecked}.")
        tell(f"In {found.factor:.3f} of the time, {duration:.3f} s: {found.audit.worst.sentence}")
        if found.too_fast is not None:
            tell(f"The arm cannot follow: {found.too_fast}.")
        for sentence in [*found.samples.notes, *(f"Wrote {file}" for file in files)]:
            say(sentence)
        if files and isinstance(found.samples, JointSamples) and found.samples.commanded and form_of(target) == "csv":
            say(
                "The verdict is for a command; salver audit would read this table as a recording, and not use its "
                "velocities to interpolate."
            )
    if refused is not None:
        raise refused
    if not found.ok:
        raise typer.Exit(ExitCode.NO_SAFE_PLAN)
