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
from collections.abc import Iterator
from contextlib import contextmanager
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
SMOOTH = 2  # pixels that are drawn for one of the picture, along each axis: software draws no smooth edges
# Without a graphics card the studio draws fewer triangles; its pictures have all that a user with one sees.
WITH_CARD = "WebGL2RenderingContext.prototype.getParameter = () => 'a graphics card'"
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
    """The bottle as it is designed, with the list of loads; in the engine; behind an obstacle; its mass impossible."""
    text = (scenario.SCENARIO_DIR / f"{SCENARIO}.toml").read_text()
    wall = {"type": "box", "name": "shelf", "size": [0.3, 0.06, 0.3], "position": [0.45, 0.12, 0.45]}
    with _page(text) as browser:
        browser.script("document.getElementById('follow').click(); designing()")
        browser.click("#add")
        time.sleep(1.0)
        _photograph(browser, "studio-add.png", None)
    with _page(text) as browser:
        browser.wait_for("salver.state.plan", 120)
        browser.click("#run")
        browser.wait_for("salver.state.said.startsWith('In the engine')", 120)
        browser.script("salver.halt(); salver.setTime(0.83)")
        _photograph(browser, "studio.png", None)
    with _page(changed(text, [(["obstacles", 0], wall)])) as browser:
        _photograph(browser, "studio-blocked.png", None)
    with _page(text) as browser:
        browser.script(
            "const area = document.getElementById('text'); area.value = area.value.replace('0.256', '-0.256');"
            "area.dispatchEvent(new Event('input'))"
        )
        browser.wait_for("salver.state.mistakes.length")
        time.sleep(0.5)
        _photograph(browser, "studio-mistake.png", None)


@contextmanager
def _page(text: str, width: int = 1500, height: int = 980, live: bool = False) -> Iterator[Browser]:
    """The studio's page with a text."""
    with (
        Studio(text, Path("bottle.toml"), scenario.SCENARIO_DIR, live=live) as studio,
        chromium(width, height) as browser,
    ):
        browser.resize(width, height, SMOOTH)
        browser.devtools("Page.addScriptToEvaluateOnNewDocument", source=WITH_CARD)
        if width < 1000:
            browser.devtools("Emulation.setTouchEmulationEnabled", enabled=True, maxTouchPoints=2)
        browser.call("POST", "url", {"url": studio.url})
        begun = f"salver.state.frames >= {int(live)}"
        browser.wait_for(f"window.salver && salver.state.answer && salver.state.idle() && {begun}", 120)
        time.sleep(0.5)
        yield browser


def _live() -> None:
    """The same hand has moved both arms, and one has lost its bottle; both at rest on a touch screen."""
    text = (scenario.SCENARIO_DIR / f"{SCENARIO}.toml").read_text()
    with _page(text, 1280, 930, live=True) as browser:
        browser.script("hand({ goto: [0.45, 0.15, 0.5] })")
        browser.wait_for(
            "fall && fall.to && salver.state.time > fall.t + 0.15 && salver.state.time < fall.t + 0.3", 120
        )
        browser.script("source.close()")
        time.sleep(1.0)
        _photograph(browser, "live.png", None)
    with _page(text, 820, 1100, live=True) as browser:
        browser.wait_for("salver.state.frames > 30")
        _photograph(browser, "live-touch.png", None)


def _report() -> None:
    with tempfile.TemporaryDirectory() as name:
        directory = Path(name) / SCENARIO
        for stem, robust in (("plan", True), ("nominal", False)):
            sv.fastest(SCENARIO, robust=robust).save(directory, stem)
            sv.simulate(sv.load_plan(directory, stem), parameters={"com_z": 0.005}).save(directory, stem)
        page = write_report(directory)
        with chromium(1280, 860) as browser:
            browser.resize(1280, 860, SMOOTH)
            browser.open(page)
            browser.wait_for("window.salver && window.salver.state.viewer")
            _photograph(browser, "report-top.png", FALLING)
            for control in ("forces", "cones"):  # not by mouse, whose place on the page shows a hint
                browser.script("document.getElementById(arguments[0]).click()", control)
            browser.script(SET, "camera", "close")
            browser.script(SET, "layout", "single")
            _photograph(browser, "report-contact.png", 0.3, section="replay")


def _photograph(browser: Browser, name: str, time: float | None, section: str | None = None) -> None:
    if time is not None:
        browser.script("salver.setPlaying(false); salver.setTime(arguments[0])", time)
    if section:
        browser.script("document.getElementById(arguments[0]).scrollIntoView({behavior: 'instant'})", section)
    picture = Image.open(io.BytesIO(browser.screenshot())).convert("RGB").reduce(SMOOTH)
    # Median cut gives a thin ring the colour of something larger.
    picture.quantize(256, Image.Quantize.MAXCOVERAGE, kmeans=2, dither=Image.Dither.NONE).save(
        HERE / "images" / name, optimize=True
    )


if __name__ == "__main__":
    main()
