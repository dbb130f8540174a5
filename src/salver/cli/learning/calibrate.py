"""`salver calibrate`: what is measured once, before anything is carried."""

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
        float | None, typer.Option(help="Friction that the test is to prove; the more, the steeper it is.")
    ] = None,
    short: Annotated[
        bool,
        typer.Option("--short", help="A short tilt instead, on which no load of the ranges moves by more than 20 mm."),
    ] = False,
    log: Annotated[
        Path | None, typer.Option(help="What the joints did, from rest to rest; without it, the plan.")
    ] = None,
    held: Annotated[float | None, typer.Option(help="Until when (s) the load surely did not slide.")] = None,
    slid: Annotated[float | None, typer.Option(help="By when (s) the load surely had begun to slide.")] = None,
    moved: Annotated[
        float | None, typer.Option(help="By how much (m) the load was seen to have moved on a short tilt.")
    ] = None,
    level: Annotated[
        float | None,
        typer.Option(
            min=0.0, max=5.0, help="By how much (deg) the robot's base may lean; 0.5 unless given, on short tilts 0.1."
        ),
    ] = None,
    scenario: Annotated[
        str | None, typer.Option(help="The scenario whose friction is to be narrowed; without it, the plan's own.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Run directory of the test, or .toml file with what was learnt.")
    ] = None,
    json: Json = False,
) -> None:
    """Friction of a load on the tray, as a range, by a slow tilt.

    From a scenario it plans the test: where the motion starts the tray tilts slowly and back, so far that a load which
    does not slide has at least the friction --shows. The load cannot tip, whatever its ranges; it may slide: have a
    hand near. Carry the test out and give its run directory: without further options the load did not slide. A run of
    any plan without a slip proves some friction; a load that slid in the test has at most the friction needed there.

    A `--short` tilt is as steep as the least friction of the ranges allows, so that the load moves by 20 mm at most.
    Its displacement (against a mark, to 1 mm) gives a lower bound of friction, and the next tilt is steeper.

    Example: `salver calibrate friction panda-cube --shows 0.4 -o runs/tilt`

    Ends with 0 when there is a test, or a range.
    """
    if (Path(source) / "scenario.toml").is_file():
        _read(Path(source), log, {"held": held, "slid": slid, "moved": moved}, level, scenario, out, json)
    else:
        named = {"log": log, "held": held, "slid": slid, "moved": moved, "scenario": scenario}
        for name, value in named.items():
            if value is not None:
                raise ScenarioError(f"--{name} needs the run directory of a plan; {source} is none.")
        _plan(source, shows, short, level, out, json)


def _plan(source: str, shows: float | None, short: bool, level: float | None, out: Path | None, json: bool) -> None:
    from salver import scenario as scenarios
    from salver.learning.friction.tilts import short_tilt, tilt_test

    if (shows is None) != short or out is None:
        raise ScenarioError("To plan the test, give --shows FRICTION or --short, and --out DIRECTORY.")
    check_no_plan(out)
    known = scenarios.load(source)
    plan = short_tilt(known, level=level) if shows is None else tilt_test(known, shows, level)
    save_test_motion(plan, out, f"salver execute {out}, then salver calibrate friction {out}", json)


def _read(
    directory: Path,
    log: Path | None,
    seen: dict[str, float | None],
    level: float | None,
    scenario: str | None,
    out: Path | None,
    json: bool,
) -> None:
    from salver import scenario as scenarios
    from salver.learning.friction.friction import friction
    from salver.learning.tracking.executed import read_joints
    from salver.models.arm.arm import load_arm
    from salver.planning.plan import load_plan

    check_new_toml(out)
    plan = load_plan(directory)
    if log is not None and plan.scenario.arm is None:
        raise ScenarioError(f"{plan.scenario.name} has no arm; friction is shown by an arm that carries the load.")
    arm = None if log is None or plan.scenario.arm is None else load_arm(plan.scenario.arm, plan.scenario.tray)
    samples = None if log is None or arm is None else read_joints(log, arm)
    found = friction(plan, samples, held=seen["held"], slid=seen["slid"], moved=seen["moved"], level=level)
    if out is not None:
        save_scenario(found.learnt_scenario(None if scenario is None else scenarios.load(scenario)), out)
    if json:
        print_json({"low": found.low, "high": found.high, "sentences": list(found.sentences)})
        return
    for sentence in found.sentences or ("Nothing of friction is shown by this run.",):
        result_console().print(sentence)
    if out is not None:
        say(f"Written to {out}; next: salver plan {quote(str(out))}.")
