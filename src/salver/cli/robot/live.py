"""`salver live`: steer a simulated arm by hand."""

from __future__ import annotations

from typing import Annotated

import typer

from salver.cli.common import Json, named_numbers


def live(
    scenario: Annotated[str, typer.Argument(help="A ready-made scenario, or a .toml file, with an arm.")],
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port of the page; 0 for any free one.")] = 0,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", help="True value of a parameter, as mass=0.3 (SI units); repeat for several."),
    ] = None,
    browser: Annotated[bool, typer.Option(help="Open the page in a browser.")] = True,
    json: Json = False,
) -> None:
    """Steer an arm with its load by hand, in the physics engine, on a page in your browser.

    Drag the goal, steer with keys, a gamepad or two thumbs, press stop: every committed motion is verified and ends at
    rest with the load in place. Beside it the same hand moves an arm without protection. The simulation
    runs in real time, with planning in a process of its own; if the machine is too slow the page says so. Only this
    machine can open the page, which needs no network. Ctrl-C ends it. --json prints the page's address.

    Example: `salver live panda-tall-bottle`
    """
    from salver.cli.plans.studio import begun, served
    from salver.playground import World
    from salver.scenario import load
    from salver.studio.server import Studio

    true = named_numbers(set_ or [], "--set", "mass=0.3")
    World(load(scenario), true)  # says at once what cannot be
    text, place, folder, saved = begun(scenario)
    served(Studio(text, place, folder, saved=saved, live=True, true=true, port=port), browser, json)
