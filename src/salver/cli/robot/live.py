"""`salver live`: a motion steered by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from salver.cli.common import Json, print_json, say


def live(
    scenario: Annotated[str, typer.Argument(help="A ready-made scenario, or a .toml file, with an arm.")],
    port: Annotated[int, typer.Option(min=0, max=65535, help="Of the page; 0 for one that is free.")] = 0,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", help="True value of a parameter, as mass=0.3 (SI units); repeat for several."),
    ] = None,
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Run directory for a recording; an earlier one there is kept.")
    ] = Path("runs/live"),
    browser: Annotated[bool, typer.Option(help="Open the page in a browser.")] = True,
    json: Json = False,
) -> None:
    """Steer an arm with its load by hand, in the physics engine, on a page in your browser.

    Drag the goal, steer with keys, press stop: every committed motion is verified and ends at rest with the load in
    place. Switch the protection off and see the load fall. The simulation runs in real time, with planning in a process
    of its own; if the machine is too slow the page says so. Only this machine can open the page, which needs no
    network. Ctrl-C ends it. --json prints the page's address.

    Example: `salver live panda-tall-bottle`
    """
    import time
    import webbrowser

    from salver.cli.checks.simulate import true_values
    from salver.playground import World
    from salver.playground.server import Playground
    from salver.scenario import load

    world = World(load(scenario), true_values(set_ or []), keep_in=out)
    with Playground(world, port) as playground:
        if json:
            print_json({"scenario": world.scenario.name, "url": playground.url})
        else:
            say(f"salver: {world.scenario.name} is live at {playground.url} ; Ctrl-C ends it.")
        if browser:
            webbrowser.open(playground.url)
        try:
            while True:
                time.sleep(1.0)
        except KeyboardInterrupt:
            say("salver: ended.")
