"""Makes the pictures of the report page, the studio and its live mode: python docs/make_screenshots.py
[report | live | studio]. Needs Chromium and chromedriver.

The report is of a tall bottle whose centre of mass is 5 mm higher than its controller knows: it stays with the motion
planned for its ranges and falls with the one planned for nominal values.
"""

from __future__ import annotations

import io
import sys
import tempfile
import time
from pathlib import Path

from PIL import Image

import salver as sv
from salver import scenario
from salver.reports.pages.page import write_report
from salver.studio.server import Studio
from salver.studio.text import changed

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent / "tests" / "helpers"))
from browser import Browser, chromium, missing  # noqa: E402

SCENARIO = "panda-tall-bottle"
FALLING = 0.95  # s
SET = "const e = document.getElementById(arguments[0]); e.value = arguments[1]; e.dispatchEvent(new Event('change'))"


def main() -> None:
    reason = missing()
    if reason:
        raise SystemExit(f"No pictures: {reason}.")
    asked = sys.argv[1:] or ["report", "live", "studio"]
    if "report" in asked:
        _report()
    if "live" in asked:
        _live()
    if "studio" in asked:
        _studio()


def _studio() -> None:
    """The bottle in the engine; an obstacle in its way; a mass that cannot be."""
    text = (scenario.SCENARIO_DIR / f"{SCENARIO}.toml").read_text()
    wall = {"type": "box", "name": "shelf", "size": [0.3, 0.06, 0.3], "position": [0.45, 0.12, 0.45]}
    texts = {
        "studio.png": text,
        "studio-blocked.png": changed(text, [(["obstacles", 0], wall)]),
        "studio-mistake.png": text,
    }
    for name, shown in texts.items():
        with Studio(shown, Path("bottle.toml"), scenario.SCENARIO_DIR) as studio, chromium(1500, 960) as browser:
            browser.call("POST", "url", {"url": studio.url})
            if name == "studio.png":
                browser.wait_for("window.salver && salver.state.plan", 120)
                browser.click("#run")
                browser.wait_for("salver.state.said.startsWith('In the engine')", 120)
                browser.script("salver.halt(); salver.setTime(0.83)")
            else:
                browser.wait_for("window.salver && salver.state.looks > 0")
            if name == "studio-mistake.png":
                browser.script(
                    "const area = document.getElementById('text'); area.value = area.value.replace('0.256', '-0.256');"
                    "area.dispatchEvent(new Event('input'))"
                )
                browser.wait_for("salver.state.mistakes.length")
            time.sleep(0.5)
            _photograph(browser, name, None)


def _live() -> None:
    """The bottle half way to a goal."""
    text = (scenario.SCENARIO_DIR / f"{SCENARIO}.toml").read_text()
    with (
        Studio(text, Path("bottle.toml"), scenario.SCENARIO_DIR, live=True) as studio,
        chromium(1280, 860) as browser,
    ):
        browser.call("POST", "url", {"url": studio.url})
        browser.wait_for("window.salver && salver.state.frames > 3")
        (live,) = studio.lives.values()
        world = live.world
        world.say({"goto": [0.45, 0.15, 0.5]})
        while world.frame()["speed"] < 0.5:
            time.sleep(0.01)
        with world._lock:  # the world stands still for its picture
            time.sleep(0.5)
            _photograph(browser, "live.png", None)


def _report() -> None:
    with tempfile.TemporaryDirectory() as name:
        directory = Path(name) / SCENARIO
        for stem, robust in (("plan", True), ("nominal", False)):
            sv.fastest(SCENARIO, robust=robust).save(directory, stem)
            sv.simulate(sv.load_plan(directory, stem), parameters={"com_z": 0.005}).save(directory, stem)
        page = write_report(directory)
        with chromium(1280, 860) as browser:
            browser.open(page)
            browser.wait_for("window.salver && window.salver.state.viewer")
            _photograph(browser, "report-top.png", FALLING)
            for control in ("forces", "cones"):
                browser.click(f"#{control}")
            browser.script(SET, "camera", "close")
            browser.script(SET, "layout", "single")
            _photograph(browser, "report-contact.png", 0.3, section="replay")


def _photograph(browser: Browser, name: str, time: float | None, section: str | None = None) -> None:
    if time is not None:
        browser.script("salver.setPlaying(false); salver.setTime(arguments[0])", time)
    if section:
        browser.script("document.getElementById(arguments[0]).scrollIntoView({behavior: 'instant'})", section)
    picture = Image.open(io.BytesIO(browser.screenshot())).convert("RGB")
    picture.quantize(256, Image.Quantize.MAXCOVERAGE).save(HERE / "images" / name, optimize=True)


if __name__ == "__main__":
    main()
