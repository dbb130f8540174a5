"""`salver learn`: carry a load carefully, identify it, carry it faster."""

from __future__ import annotations

from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from salver.cli.common import ExitCode, Json, check_new_toml, print_json, print_table, save_scenario, say

if TYPE_CHECKING:
    from salver.learning.trips import Trip


def learn(
    scenario: Annotated[str, typer.Argument(help="Name of a ready-made scenario, or a .toml file.")],
    trips: Annotated[int, typer.Option(min=1, max=50, help="How often the load is carried.")] = 6,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the hidden true load and of the sensor noise.")] = 0,
    sensor: Annotated[
        Literal["wrist", "torques"], typer.Option(help="Sensor of the arm: a wrist sensor, or joint torques.")
    ] = "wrist",
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Write the scenario with the learnt ranges to this .toml file.")
    ] = None,
    json: Json = False,
) -> None:
    """Carry a load with wide ranges carefully, learn its parameters, and carry it ever faster.

    Each trip is the fastest safe motion for the ranges so far. A hidden load is carried in the physics engine, and the
    readings of the arm's sensors narrow the ranges for the next trip. Between the first trip and the second the arm
    makes an excitation trajectory. See `salver excite` and `salver identify` for real arms, and `salver calibrate` for
    friction, which trips do not show.

    Example: `salver learn panda-tall-bottle --trips 6 -o learnt.toml`

    Ends with 0 when the load stayed on every trip, with 3 when it did not or when no safe motion was found.
    """
    from salver import scenario as scenarios
    from salver.learning.trips import trips as carried

    check_new_toml(out)
    made: list[Trip] = []
    for trip in carried(scenarios.load(scenario), trips, seed, sensor):
        made.append(trip)
        say(f"Trip {trip.number} of {trips}: {trip.plan.duration:.3f} s, {trip.outcome}. {trip.told}".rstrip())
        if trip.excitation is not None:
            say(f"An excitation trajectory of {trip.excitation.plan.duration:g} s: {trip.excitation.outcome}.")
        if out is not None and trip.learnt is not None:
            save_scenario(trip.known, out)
    if json:
        print_json([_record(trip) for trip in made])
    else:
        _show(made)
    if out is not None and out.exists():
        say(f"Written to {out}; next: salver plan {quote(str(out))} --fastest.")
    if any(trip.lost for trip in made):
        raise typer.Exit(ExitCode.NO_SAFE_PLAN)


def _record(trip: Trip) -> dict[str, Any]:
    ranges = {} if trip.learnt is None else trip.learnt.ranges
    return {
        "trip": trip.number,
        "duration": trip.plan.duration,
        "outcome": trip.outcome,
        "margin_worst_case": trip.margin,
        "plan_of_the_trip_before": trip.kept,
        "learnt": {name: [r.low, r.high] for name, r in ranges.items()},
        "excitation": None if trip.excitation is None else trip.excitation.outcome,
        "told": trip.told,
    }


def _show(made: list[Trip]) -> None:
    titles = ("trip", "duration", "load", "margin", "mass after, g", "centre of mass after, +- mm")
    rows = []
    for trip in made:
        learnt = trip.learnt
        mass = half = "-"
        if learnt is not None:
            heavy = learnt.ranges["mass"]
            mass = f"{1e3 * heavy.low:.1f} to {1e3 * heavy.high:.1f}"
            half = ", ".join(f"{1e3 * learnt.ranges[f'com_{a}'].half:.2f}" for a in "xyz")
        duration, margin = f"{trip.plan.duration:.3f} s", f"{100 * trip.margin:.1f} %"
        rows.append((str(trip.number), duration, trip.outcome, margin, mass, half))
    print_table(titles, rows)
