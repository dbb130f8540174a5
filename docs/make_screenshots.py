"""Makes the pictures of the report page and the playground: python docs/make_screenshots.py [report | live]. Needs
Chromium and chromedriver.

Plans, simulates and reports the scenario SCENARIO afresh, opens the page in a headless browser and photographs it.
"""

from __future__ import annotations

import io
import sys
import tempfile
from pathlib import Path

from PIL import Image

from salver import scenario
from salver.planning.make import plan_pair
from salver.planning.plan import load_plan
from salver.playground import World
from salver.playground.server import Playground
from salver.reports.page import write_report
from salver.simulation.physics import simulate

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent / "tests"))
from browser import Browser, chromium, missing  # noqa: E402

SCENARIO = "ur10-bottle"
SET = "const e = document.getElementById(arguments[0]); e.value = arguments[1]; e.dispatchEvent(new Event('change'))"


def main() -> None:
    reason = missing()
    if reason:
        raise SystemExit(f"No pictures: {reason}.")
    asked = sys.argv[1:] or ["report", "live"]
    if "report" in asked:
        _report()
    if "live" in asked:
        _live()


def _live() -> None:
    """The bottle half way to a goal."""
    world = World(scenario.load("panda-tall-bottle"))
    with Playground(world) as playground, chromium(1280, 860) as browser:
        browser.call("POST", "url", {"url": playground.url})
        browser.wait_for("window.salver && salver.state.frames > 3")
        world.say({"goto": [0.45, 0.15, 0.5]})
        browser.wait_for("salver.state.frame.speed > 0.5")
        _photograph(browser, "live.png", None)


def _report() -> None:
    with tempfile.TemporaryDirectory() as name:
        directory = Path(name) / SCENARIO
        plan, baseline = plan_pair(scenario.load(SCENARIO))
        plan.save(directory)
        baseline.save(directory, "baseline")
        for stem in ("plan", "baseline"):
            simulate(load_plan(directory, stem)).save(directory, stem)
        page = write_report(directory)
        with chromium(1280, 860) as browser:
            browser.open(page)
            browser.wait_for("window.salver && window.salver.state.viewer")
            _photograph(browser, "report-top.png", 0.0)
            for control in ("forces", "cones"):
                browser.click(f"#{control}")
            browser.script(SET, "camera", "close")
            browser.script(SET, "layout", "single")
            _photograph(browser, "report-contact.png", 0.3, section="replay")
            _photograph(browser, "report-margins.png", 0.3, section="margins")


def _photograph(browser: Browser, name: str, time: float | None, section: str | None = None) -> None:
    if time is not None:
        browser.script("salver.setTime(arguments[0])", time)
    if section:
        browser.script("document.getElementById(arguments[0]).scrollIntoView({behavior: 'instant'})", section)
    picture = Image.open(io.BytesIO(browser.screenshot())).convert("RGB")
    picture.quantize(200).save(HERE / "images" / name, optimize=True)


if __name__ == "__main__":
    main()
