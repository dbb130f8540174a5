"""`salver calibrate`: measure the friction of a load by tilting the tray."""

from __future__ import annotations

from pathlib import Path
from shlex import quote
from typing import Annotated, Literal

import typer

from salver.cli.common import (
    Json,
    check_new_toml,
    check_no_plan,
    print_json,
    result_console,
    save_scenario,
    save_test_motion,
    say,
)
from salver.errors import ScenarioError


def calibrate(
    what: Annotated[Literal["friction"], typer.Argument(help="What is measured.")],
    source: Annotated[str, typer.Argument(help="A scenario, to plan the test; or a run directory, to read its run.")],
    shows: Annotated[
        float | None, typer.Option(help="Friction that the test is to prove; a larger one needs a steeper tilt.")
    ] = None,
    log: Annotated[Path | None, typer.Option(help="Log of the joints, from rest to rest; default: as planned.")] = None,
    held: Annotated[float | None, typer.Option(help="Time, s, until which the load certainly did not slide.")] = None,
    slid: Annotated[float | None, typer.Option(help="Time, s, at which the load certainly had begun to slide.")] = None,
    level: Annotated[
        float | None,
        typer.Option(min=0.0, max=5.0, help="Largest tilt error of the robot's base, deg; default 0.5."),
    ] = None,
    scenario: Annotated[
        str | None, typer.Option(help="The scenario whose friction is to be narrowed; default: the plan's.")
    ] = None,
    against: Annotated[
        Path | None,
        typer.Option(help="Run directory of a plan that is to be safe: does it press harder than the test?"),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Run directory of the test, or .toml file for the new ranges.")
    ] = None,
    json: Json = False,
) -> None:
    """Measure the friction of a load on the tray, as a range, by a slow tilt.

    From a scenario it plans the test: at the start pose the tray tilts slowly and back, so far that a load that does
    not slide has at least the friction --shows. No load in the ranges can tip, but it may slide: keep a hand near it.
    Run the test and give its run directory; without further options it means that the load did not slide. A run of any
    plan without slip proves some friction; a load that slid in the test has at most the friction needed there. The
    output says under which force and pressure, and of a plan (--against) whether it presses harder.

    Example: `salver calibrate friction panda-cube --shows 0.4 -o runs/tilt`

    Ends with 0 when a test was planned or a range was found.
    """
    from salver import scenario as scenarios
    from salver.learning.friction.friction import friction
    from salver.learning.friction.tilts import tilt_test
    from salver.learning.logs import one_load
    from salver.learning.tracking.executed import read_joints
    from salver.planning.plan import load_plan

    if not (Path(source) / "scenario.toml").is_file():
        for name, value in {"log": log, "held": held, "slid": slid, "scenario": scenario, "against": against}.items():
            if value is not None:
                raise ScenarioError(f"--{name} needs the run directory of a plan; {source} is not one.")
        if shows is None or out is None:
            raise ScenarioError("To plan the test, give --shows FRICTION and --out DIRECTORY.")
        check_no_plan(out)
        test = tilt_test(scenarios.load(source), shows, level)
        save_test_motion(test, out, f"salver execute {out}, then salver calibrate friction {out}", json)
        return
    check_new_toml(out)
    plan = load_plan(source)
    one_load(plan.scenario, "a friction test")
    samples = None if log is None else read_joints(log, plan.scenario.load_arm())
    found = friction(plan, samples, held=held, slid=slid, level=level)
    pressing = () if against is None else (found.against(load_plan(against)),)
    if out is not None:
        save_scenario(found.learnt_scenario(None if scenario is None else scenarios.load(scenario)), out)
    if json:
        print_json(
            {"low": found.low, "high": found.high, "force": found.force, "sentences": [*found.sentences, *pressing]}
        )
        return
    for sentence in (*(found.sentences or ("This run does not narrow the friction.",)), *pressing):
        result_console().print(sentence)
    if found.sentences and against is None:
        say("Whether a plan presses harder is said with --against, its run directory.")
    if out is not None:
        say(f"Written to {out}; next: salver plan {quote(str(out))}.")
