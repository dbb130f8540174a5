"""`salver excite`: plan a safe excitation trajectory for the load."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from salver.cli.common import Json, check_no_plan, save_test_motion


def excite(
    scenario: Annotated[str, typer.Argument(help="Name of a ready-made scenario, or a .toml file.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="Run directory to write.")],
    duration: Annotated[float, typer.Option(help="Duration of the motion, s.")] = 2.0,
    json: Json = False,
) -> None:
    """Plan an excitation trajectory: a safe motion whose logs identify the load best, for salver identify.

    The motion begins and ends at the scenario's start pose, takes the given time and is safe for the scenario's
    ranges. It is D-optimal for mass and centre of mass from a wrist sensor (a local optimum).
    Run it with the empty tray and with the load.

    Example: `salver excite panda-tall-bottle --duration 2 -o runs/shown`

    Ends with 0 when a motion was found, with 2 when none was found.
    """
    from salver import scenario as scenarios
    from salver.learning.load.excite import plan_excite

    check_no_plan(out)
    plan = plan_excite(scenarios.load(scenario), duration)
    save_test_motion(plan, out, f"salver execute {out}, empty and loaded, then salver identify", json)
