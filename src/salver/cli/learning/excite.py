"""`salver excite`: a safe motion that shows what the load is."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from salver.cli.common import Json, check_no_plan, save_test_motion


def excite(
    scenario: Annotated[str, typer.Argument(help="Name of a ready-made scenario, or a .toml file.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="Run directory to write.")],
    duration: Annotated[float, typer.Option(help="Of the motion, s.")] = 2.0,
    json: Json = False,
) -> None:
    """Plan an excitation trajectory: a safe motion whose logs show most of the load, for salver identify.

    The motion begins and ends where the scenario's motion starts, takes the given time and is safe for the scenario's
    ranges. It is the one from which a wrist sensor tells mass and centre of mass best (D-optimal; a local optimum).
    Carry it out with the empty tray and with the load.

    Example: `salver excite panda-tall-bottle --duration 2 -o runs/shown`

    Ends with 0 when there is such a motion, with 2 when none was found.
    """
    from salver import scenario as scenarios
    from salver.learning.load.excite import plan_excite

    check_no_plan(out)
    plan = plan_excite(scenarios.load(scenario), duration)
    save_test_motion(plan, out, f"salver execute {out}, empty and loaded, then salver identify", json)
