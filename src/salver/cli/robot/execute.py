"""`salver execute`: run a plan on an arm."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from salver.cli.common import ExitCode, Json, named_numbers, print_json, result_console, say
from salver.driver.robots.robots import ROBOTS
from salver.errors import SalverError

if TYPE_CHECKING:
    from collections.abc import Callable

    from salver.driver.execute import Execution
    from salver.driver.execution import Watchdog
    from salver.driver.preflight import Check


def execute(
    directory: Annotated[
        Path, typer.Argument(help="A run directory, as `salver plan` makes it; with --live, a scenario or its run.")
    ],
    robot: Annotated[str, typer.Option(help=f"Which arm: {', '.join(ROBOTS)}.")] = "franka",
    address: Annotated[str | None, typer.Option(help="Network address of the arm's control interface.")] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="The simulated arm, in real time.")] = False,
    stem: Annotated[
        str,
        typer.Option("--plan", help="Which motion: plan (all its legs), baseline or nominal; or a leg: leg1, leg2 ..."),
    ] = "plan",
    watchdog: Annotated[float, typer.Option(help="Stop when a joint is this far from its reference, rad.")] = 0.05,
    move_to_start: Annotated[
        bool, typer.Option("--move-to-start", help="First go slowly to the start posture, with an empty tray.")
    ] = False,
    realtime: Annotated[
        bool, typer.Option(help="Refuse a kernel without real-time priority (a dry run: keep real time).")
    ] = True,
    full_speed_only: Annotated[
        bool,
        typer.Option("--full-speed-only", help="Send also a plan that does not keep its load when it is run slower."),
    ] = False,
    live: Annotated[
        str | None,
        typer.Option(help="Do what these lines say while it moves: a file of timed requests, or - for standard input."),
    ] = None,
    out: Annotated[
        Path, typer.Option("--out", "-o", help="With --live: run directory for what was commanded, and the log.")
    ] = Path("runs/live"),
    longest: Annotated[float, typer.Option(help="With --live: the run ends at rest within this time, s.")] = 120.0,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", help="An option of the robot, as lag=0.05 of an xarm; repeat for several."),
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask before the arm moves.")] = False,
    json: Json = False,
) -> None:
    """Run a plan on an arm, with checks before, a watchdog during, and a log after.

    First `--dry-run` (or `--robot simulated`): the same loop on the simulated arm, which shows how well this machine
    keeps 1 kHz. The log goes to DIR/execution; `salver report DIR` shows it. Ctrl-C stops the arm: the load stays if
    the plan has stops (`salver plan --stops`), otherwise it may fall.

    With --live, requests are planned while the arm moves: each motion is verified before it is committed, and ends at
    rest with the load in place. The commanded motion is kept as a plan.

    A plan of several legs runs leg by leg, with a question before each and a log of each; the run ends after a leg that
    fails.

    Ends with 0 when the motion ran to its end, with 1 when it did not or every request was refused.

    Example: `salver execute runs/panda-cube --dry-run`
    """
    from salver.driver.execute import run_plan
    from salver.driver.execution import Watchdog
    from salver.driver.robots.robots import robot_options
    from salver.run_directory import scenario_of
    from salver.scenario import load

    changed = robot_options(robot, named_numbers(set_ or [], "--set", "lag=0.05"))
    robot = "simulated" if dry_run else robot
    simulated = robot == "simulated"
    confirm = _warned if simulated else _assent(yes, json)
    if not 0 < watchdog < 1:
        raise SalverError(f"--watchdog is {watchdog:g} rad; it must be above 0 and below 1.")
    if not 0 < longest < float("inf"):
        raise SalverError(f"--longest is {longest:g} s; it must be a number above 0.")
    done: list[dict[str, Any]] = []
    if live is not None:
        if move_to_start or full_speed_only or stem != "plan":
            raise SalverError("--live goes with none of --move-to-start, --full-speed-only and --plan.")
        result = _told(
            directory, live, out, robot, address, Watchdog(watchdog), realtime, yes, confirm, longest, changed
        )
    else:
        legs = load(scenario_of(directory)).legs if stem == "plan" else []
        if legs and yes and not simulated:
            raise SalverError(
                "--yes cannot tell when the tray is ready for the next leg: leave it out, or name a leg with --plan."
            )
        for k in range(max(1, len(legs))):
            if k:
                if not json:
                    _tell(result)
                say(f"salver: leg {k} is done, then {legs[k - 1].handling}; leg {k + 1} follows.")
            result = run_plan(
                directory,
                robot,
                _given(robot, address),
                f"leg{k + 1}" if legs else stem,
                Watchdog(watchdog),
                move_to_start=move_to_start and not k,
                realtime=realtime,
                full_speed_only=full_speed_only,
                confirm=confirm,
                options=changed,
            )
            done.append({"log": result.path, **result.summary})
            if not result.achieved:
                break
    if json:
        print_json({"legs": done} if len(done) > 1 else {"log": result.path, **result.summary})
    else:
        _tell(result)
    if not result.achieved:
        raise typer.Exit(ExitCode.NOT_ACHIEVED)


def _told(
    scenario: Path,
    lines: str,
    out: Path,
    robot: str,
    address: str | None,
    watchdog: Watchdog,
    realtime: bool,
    yes: bool,
    confirm: Callable[[list[Check]], bool],
    longest: float,
    robot_options: Any,
) -> Execution:
    """Run a live motion by the lines of a script."""
    import sys

    from salver.driver.live import LiveRunOptions, run_live
    from salver.files import read_text
    from salver.run_directory import SCENARIO
    from salver.scenario import load

    case = load(str(scenario / SCENARIO if (scenario / SCENARIO).is_file() else scenario))
    listen = lines == "-"
    wishes = sys.stdin.buffer if listen else read_text(lines).splitlines()
    source, there = "standard input" if listen else lines, _given(robot, address)
    if listen and robot != "simulated" and not yes:
        raise SalverError(
            "With --live - requests come from standard input, so nobody can be asked there; give --yes to let the "
            "arm move."
        )
    return run_live(
        case, wishes, out, robot, there, watchdog,
        realtime=realtime, source=source, listen=listen, confirm=confirm, options=LiveRunOptions(longest=longest),
        robot_options=robot_options,
    )  # fmt: skip


def _given(robot: str, address: str | None) -> str:
    if robot == "simulated":
        return ""
    if address is None:
        raise SalverError("Give the arm's --address, as in --address 172.16.0.2, or try --dry-run first.")
    return address


def _warned(checks: list[Check]) -> bool:
    """Warnings before the simulated arm moves."""
    for check in checks:
        if not check.ok:
            say(f"salver: {check.sentence}")
    return True


def _assent(yes: bool, json: bool) -> Any:
    def ask(checks: list[Check]) -> bool:
        for check in checks:
            say(f"  {'ok ' if check.ok else 'NO '} {check.name}: {check.sentence}")
        if yes:
            return True
        if json:
            raise SalverError("With --json nothing can be asked; give --yes to let the arm move.")
        return typer.confirm("The arm will move. Is its way clear, and a hand on the stop?", err=True)

    return ask


def _tell(result: Execution) -> None:
    summary, clock = result.summary, result.summary.get("timing", {})
    tell = result_console().print
    for check in result.checks:
        tell(f"  {'ok ' if check.ok else 'NO '} {check.name}: {check.sentence}")
    simulated = "realtime" in summary
    if "jitter_median" in clock:
        kept = (
            f", {clock['missed']} missed{'' if simulated else ' by the clock of the robot'}, "
            f"{100 * clock['late']:.3g} % late by over half a period on this machine; "
            f"jitter {1e6 * clock['jitter_median']:.0f} us at the median, {1e6 * clock['jitter_p999']:.0f} us at "
            f"99.9 %, {1e3 * clock['jitter_max']:.2f} ms at most"
        )
        tell(
            f"{summary['source']}: {clock['periods']} periods of {1e3 * clock['period']:g} ms"
            f"{kept if summary.get('realtime', True) else ''}; controller {1e6 * clock['step_median']:.0f} us at the "
            "median."
        )
    if simulated and clock.get("missed"):
        tell(
            "This machine missed those periods, not an arm: it was too busy for the loop. Run it again when nothing "
            "else runs, or with --no-realtime, in which the simulated arm waits."
        )
    if summary.get("e_p_peak") is not None and summary.get("e_o_peak") is not None:
        tell(f"Largest e_p {1e3 * summary['e_p_peak']:.3f} mm, e_o {1e3 * summary['e_o_peak']:.3f} mrad.")
    tell(f"Stopped: {summary['stopped']}" if summary["stopped"] else f"Ran to its end; outcome: {summary['outcome']}.")
    if summary["bridged"]:
        tell(f"Implausible readings, replaced by what was commanded: {summary['bridged']}.")
    if summary["load_kept_in_stop"] is False:
        tell("The arm did not stop by a motion that is safe for the load: the load may have moved or fallen.")
    elif summary["load_kept_in_stop"]:
        tell("A planned stop brought the arm to rest, always within the deviation for which that is safe for the load.")
    requests = summary.get("requests", {})
    if any(requests.values()):
        tell("Requests: " + ", ".join(f"{count} {what}" for what, count in requests.items()) + ".")
    for note in summary.get("wishes", ()):
        if not str(note["answer"]).startswith("Accepted"):
            tell(f"At {note['t']:.2f} s: {note['answer']}")
    for key in ("load", "unjudged", "log_elsewhere"):
        if summary.get(key):
            tell(str(summary[key]))
    tell(f"Log: {result.path}")
