"""`salver identify`: mass, centre of mass and inertia of a load from logs."""

from __future__ import annotations

from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated

import typer

from salver.cli.common import (
    Json,
    check_new_toml,
    headed,
    named_numbers,
    print_json,
    print_table,
    result_console,
    save_scenario,
    say,
)
from salver.errors import ScenarioError

if TYPE_CHECKING:
    from salver.learning import Identified, SensorBounds


def identify(
    logs: Annotated[
        list[Path], typer.Argument(help="Logs of the motion with the load on the tray: .npz, .csv or ROS bags.")
    ],
    directory: Annotated[Path, typer.Option(help="Run directory of the plan that was run.")],
    empty: Annotated[Path, typer.Option(help="A log of the same motion with the empty tray.")],
    stem: Annotated[str, typer.Option("--plan", help="Which plan of the directory.")] = "plan",
    topic: Annotated[str | None, typer.Option(help="Topic of the joints (JointState), when a bag has several.")] = None,
    bound: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=VALUE", help="Largest systematic error of a sensor, as scale=0.01."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Write the scenario with the new ranges to this .toml file.")
    ] = None,
    json: Json = False,
) -> None:
    """Identify mass, centre of mass and inertia of the load, as ranges, from joint or wrist torques.

    Logs with the load are compared with a log of the same motion with the empty tray, so the arm's own model error
    cancels. Logs are what `salver execute` writes (t, q, tau), or CSV with the columns t, q1 ... qn (rad) and tau1 ...
    taun (N m), or fx, fy, fz, tx, ty, tz at the flange (N, N m; tared with the empty tray), or ROS bags with a
    JointState that has efforts, a WrenchStamped of the flange, or both. Ranges of the scenario are narrowed, never
    widened. The centre of mass is found relative to the sensor, so the range of the object's position on the tray
    (uncertainty.position) stays. Ranges of inertia are written if the scenario has them; friction keeps its range. A
    sensor's bias, scale, cross-talk, position and delay do not average out over logs: the ranges allow for them up to
    bounds, which `--bound` sets, and logs with larger errors are refused.

    Example: `salver identify loaded.csv --directory runs/panda-tall-bottle --empty empty.csv -o learnt.toml`

    Ends with 0 when the logs were used, whatever their result.
    """
    from salver.learning import identify as learn
    from salver.learning import read_log
    from salver.learning.logs import one_load
    from salver.planning.plan import load_plan

    check_new_toml(out)
    bounds, carried = _bounds(bound or []), load_plan(directory, stem)
    one_load(carried.scenario, "identification")
    names = carried.scenario.load_arm().joint_names
    read = [read_log(path, len(names), names, topic) for path in (*logs, empty)]
    found = learn(carried, read[:-1], read[-1], bounds)
    if out is not None:
        save_scenario(found.learnt_scenario(), out)
    if json:
        print_json(summary(found))
        return
    _show(found)
    if out is not None:
        say(f"Written to {out}; next: salver plan {quote(str(out))}.")


def summary(found: Identified) -> dict[str, object]:
    """The result as a JSON object."""
    return {
        "ranges": {
            name: {"low": r.low, "high": r.high, "likely": list(r.likely), "before": list(r.before), "learnt": r.learnt}
            for name, r in found.ranges.items()
        },
        "sensors": list(found.sensors),
        "residual": found.residual,
        "not_identified": found.told,
        "shares_of_mass": found.shares,
    }


def _bounds(given: list[str]) -> SensorBounds:
    """Bounds from NAME=VALUE options."""
    from dataclasses import fields

    from salver.learning import SensorBounds

    names, values = [field.name for field in fields(SensorBounds)], named_numbers(given, "--bound", "scale=0.01")
    for name in values.keys() - names:
        raise ScenarioError(f"--bound {name} is not a bound of a sensor; known are {', '.join(names)}.")
    return SensorBounds(**values)


def _show(found: Identified) -> None:
    console, rows = result_console(), []
    for name, r in found.ranges.items():
        unit, scale = {"m": ("g", 1e3), "c": ("mm", 1e3), "i": ("kg mm^2", 1e6)}[name[0]]
        before = f"{scale * r.before[0]:.1f} to {scale * r.before[1]:.1f}"
        likely = f"{scale * r.likely[0]:.2f} to {scale * r.likely[1]:.2f}"
        rows.append((f"{name}, {unit}", likely, f"{scale * r.low:.2f}", f"{scale * r.high:.2f}", before))
    console.print(f"From {', '.join(found.sensors)} (centre of mass from the nominal one; plan with low to high):")
    print_table(("", "95 %", "low", "high", "before"), rows)
    largest = sorted(found.shares.items(), key=lambda share: -share[1])[:4]
    parts = ", ".join(f"{1e3 * x:.1f} g {name}" for name, x in largest)
    console.print(
        f"The mass is known to +-{1e3 * found.ranges['mass'].half:.1f} g, mostly {parts} (bounds: --bound NAME=VALUE)."
    )
    for sentence in found.told:
        console.print(headed("not identified", sentence))
    if found.residual > 1.5:
        console.print(f"The sensors were {found.residual:.1f} times as noisy as assumed; the ranges allow for it.")
