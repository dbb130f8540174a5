"""`salver studio`: edit a task on a page in the browser."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from salver.cli.common import Json, print_json, say

if TYPE_CHECKING:
    from salver.studio.server import Studio


def studio(
    scenario: Annotated[
        str | None,
        typer.Argument(help="A .toml file, which may be new, or a ready-made scenario to begin with; or nothing."),
    ] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port of the page; 0 for any free one.")] = 0,
    browser: Annotated[bool, typer.Option(help="Open the page in a browser.")] = True,
    json: Json = False,
) -> None:
    """Design a task on a page in your browser, and see its margin change.

    Drag start, goal, objects and obstacles, set masses and ranges with sliders, or edit the text: each is a change of
    the scenario's file. The page shows at once whether the arm reaches start and goal, what collides, and in which time
    a straight line holds; then the fastest safe motion is planned and played. `salver plan` of the saved file finds the
    same motion. Only this machine can open the page, which needs no network. Ctrl-C ends it. --json prints its address.

    Example: `salver studio panda-cube`
    """
    from salver.studio.server import Studio

    text, place, folder, saved = begun(scenario)
    served(Studio(text, place, folder, saved=saved, port=port), browser, json)


def served(studio: Studio, browser: bool, json: bool) -> None:
    """Serve the page until Ctrl-C."""
    import time
    import webbrowser

    with studio as page:
        if json:
            print_json({"file": page.place, "url": page.url})
        else:
            say(f"salver: the studio is at {page.url} and saves in {page.place}; Ctrl-C ends it.")
        if browser:
            webbrowser.open(page.url)
        try:
            while True:
                time.sleep(1.0)
        except KeyboardInterrupt:
            say("salver: ended.")


def begun(scenario: str | None) -> tuple[str, Path, Path, bool]:
    """The initial text, the file in which it is saved, the folder of the files that it names, whether it is saved.

    A file may have mistakes, which the page shows; a ready-made scenario is saved in the working directory.
    """
    from salver.cli.plans.new import usual
    from salver.errors import ScenarioError
    from salver.scenario.files import SCENARIO_DIR, load, text_of
    from salver.studio.text import LONGEST

    place = Path(scenario or "scenario.toml")
    if place.suffix != ".toml":
        load(place)  # raises, with the names of the ready-made scenarios
        ready_made = SCENARIO_DIR / f"{scenario}.toml"
        if not ready_made.is_file():
            raise ScenarioError(f"{scenario} is a run directory; give a .toml file, or a ready-made scenario.")
        return ready_made.read_text(encoding="utf-8"), Path(ready_made.name), SCENARIO_DIR, False
    if not place.exists():
        return usual(place.stem), place, place.parent, False
    return text_of(place, LONGEST), place, place.parent, True
