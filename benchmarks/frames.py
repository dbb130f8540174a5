"""Frames a second of the studio's picture at 900 x 600, drawn by the processor: python benchmarks/frames.py [SCENARIO].

Needs Chromium and chromedriver. "nothing" is what the browser itself takes to show a page whose picture is empty.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

from browser import Browser, chromium, missing
from salver.scenario import SCENARIO_DIR
from salver.studio.server import Studio

FRAMES = """
const done = arguments[0], begun = performance.now();
let n = 0;
const step = (now) => {
  salver.state.viewer.render(salver.state.time);
  n += 1;
  if (now - begun < 4000) requestAnimationFrame(step);
  else done((1000 * (n - 1)) / (now - begun));
};
requestAnimationFrame(step);
"""
GHOST = "const box = document.getElementById('beside'); box.click()"
EMPTY = "document.getElementById('canvas').getContext('webgl2').drawElements = () => {}"


def main(name: str) -> None:
    """Print the best of three for a plan beside the straight line, for the plan alone, and for nothing."""
    reason = missing()
    if reason:
        raise SystemExit(f"No frames: {reason}.")
    text = (SCENARIO_DIR / f"{name}.toml").read_text()
    with Studio(text, Path(f"{name}.toml"), SCENARIO_DIR) as studio, chromium(1400, 900) as browser:
        browser.call("POST", "url", {"url": studio.url})
        browser.wait_for("window.salver && salver.state.plan", 300)
        browser.wait_for("!salver.state.playing", 60)
        browser.script("Object.assign(document.querySelector('.view').style, { width: '900px', height: '600px' })")
        time.sleep(1.0)
        for what, does in (("plan and straight line", ""), ("plan alone", GHOST), ("nothing", EMPTY)):
            browser.script(does)
            print(f"{name}, {what}: {max(_frames(browser) for _ in range(3)):.0f} frames a second")


def _frames(browser: Browser) -> float:
    return float(browser.call("POST", "execute/async", {"script": FRAMES, "args": []}))


if __name__ == "__main__":
    main(*sys.argv[1:] or ["panda-tall-bottle"])
