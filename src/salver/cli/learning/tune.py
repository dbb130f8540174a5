"""`salver tune`: correct a robot's command, add margin for the remaining error, or refuse the robot."""

from __future__ import annotations

from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, Any

import typer

from salver.cli.checks.audit import Topic
from salver.cli.common import NO_SAFE_PLAN, Json, check_no_plan, headed, print_json, print_table, result_console, say
from salver.cli.learning.track import record, unseen, verdict
from salver.errors import ScenarioError

if TYPE_CHECKING:
    from salver.learning.tracking.tune import TuningRun


def tune(
    directory: Annotated[Path, typer.Argument(help="Run directory of the plan that the robot is to follow.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="Run directory to write: the plan with its command.")],
    log: Annotated[
        Path | None,
        typer.Option(help="Log of your robot's joints on this plan; default: the simulated robot."),
    ] = None,
    stem: Annotated[str, typer.Option(help="Which plan of the directory.")] = "plan",
    topic: Topic = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the encoder noise in the engine.")] = 0,
    json: Json = False,
) -> None:
    """Correct a robot's command so that it follows the plan, add margin for the remaining error, or refuse the robot.

    Without --log the robot is that of the scenario's [physics] in the physics engine, with the nominal load strapped to
    its tray. Each run's tracking error is added to the command, as long as that helps; then contact.margin is raised by
    the remaining excess and the motion is planned again. A robot that needs too much margin is refused. With --log one
    such step is made from a log of your robot, which ran the plan of DIRECTORY with the load strapped to the tray:
    write the new command with `salver export`, run it, and tune OUT again with its log, until it is done.

    Example: `salver tune runs/panda-tall-bottle -o runs/tuned`

    Ends with 0 when the executed motion holds for every load in the ranges, with 3 otherwise.
    """
    from salver.learning.tracking.executed import read_joints
    from salver.learning.tracking.tune import engine_robot, step
    from salver.learning.tracking.tune import tune as rounds
    from salver.models.arm.arm import load_arm
    from salver.planning.plan import load_plan
    from salver.planning.plan_files import check_place

    plan = load_plan(directory, stem)
    check_no_plan(out, stem)
    check_place(plan.scenario, out)
    if log is None:
        made = []
        for done in rounds(plan, lambda told: engine_robot(told, seed)):
            made.append(done)
            say(f"TuningRun {done.number}: {done.plan.duration:.3f} s. {verdict(done.tracking)} {done.sentence}")
    else:
        if plan.scenario.arm is None:
            raise ScenarioError(f"{plan.scenario.name} has no arm; salver tune corrects commands of joints.")
        made = [step(plan, read_joints(log, load_arm(plan.scenario.arm, plan.scenario.tray), topic))]
    last = made[-1]
    if last.next != "refused":
        assert last.then is not None
        last.then.save(out, stem)
    if json:
        print_json([_record(done) for done in made])
    else:
        _show(made, plan.duration)
    if last.next != "refused":
        more = "" if last.next == "done" else f" Next: salver export {quote(str(out))}, run it, and tune again."
        say(f"Written to {out}.{more}")
    if last.next != "done":
        raise typer.Exit(NO_SAFE_PLAN)


def _record(done: TuningRun) -> dict[str, Any]:
    return {
        "round": done.number,
        "duration": done.plan.duration,
        "margin": done.plan.scenario.contact.margin,
        "next": done.next,
        "sentence": done.sentence,
        **record(done.tracking),
    }


def _show(made: list[TuningRun], first: float) -> None:
    console = result_console()
    console.print(headed("not checked", f"{unseen(made[-1].tracking)}; runs that differ from each other."))
    rows = [
        (
            str(done.number),
            f"{done.plan.duration:.3f} s",
            f"{100 * seen.row:+.2f} +- {100 * seen.uncertainty:.2f} %",
            f"{100 * seen.planned:+.2f} %",
            f"{1e3 * (seen.done.shift - made[0].tracking.done.shift):+.1f} ms",
            done.next,
        )
        for done in made
        for seen in [done.tracking]
    ]
    print_table(("round", "duration", "worst row", "of the plan", "late by", "then"), rows, left=("then",))
    last = made[-1]
    price = f" Price: {100 * (last.plan.duration / first - 1):+.1f} % of the duration." if last.next == "done" else ""
    console.print(headed("result", last.sentence + price))
