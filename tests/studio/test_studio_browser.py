"""The studio in a real browser, by mouse, touch and gamepad."""

import json
import time
import tomllib
from urllib.parse import urlsplit

import numpy as np
import pytest
from typer.testing import CliRunner

from browser import chromium, missing
from salver.cli import app
from salver.cli.plans.studio import begun
from salver.scenario import SCENARIO_DIR
from salver.studio.parts import OBSTACLES
from salver.studio.server import Studio
from salver.studio.text import changed
from studio_windows import ROUND


def drag(browser, name, dx, dy):
    """By the mouse: take hold of a thing's ring and move it by so many pixels; again if it has moved under the hand, as
    it does when a headline of another length comes."""
    changed = f"salver.state.idle() && salver.state.text !== {json.dumps(browser.script('return salver.state.text'))}"
    for seconds in (5, 5, 60):
        _drag(browser, name, dx, dy)
        try:  # a browser hands moves over with its next picture, which takes a while without a graphics card
            return browser.wait_for(changed, seconds)
        except TimeoutError:
            if seconds == 60:
                raise


def _drag(browser, name, dx, dy):
    x, y = browser.script(
        """
        const box = document.getElementById("canvas").getBoundingClientRect();
        const p = salver.placeOf(salver.handles().find((part) => part.name === arguments[0]));
        let best = null;  // the point of the picture where it is
        for (let x = 1; x < box.width; x += 3) for (let y = 1; y < box.height; y += 3) {
          const off = salver.state.viewer.missed({ clientX: box.left + x, clientY: box.top + y }, p)[0];
          if (best === null || off < best[0]) best = [off, box.left + x, box.top + y];
        }
        return best.slice(1);
        """,
        name,
    )
    move = [{"type": "pointerMove", "x": int(x + k * dx), "y": int(y + k * dy), "duration": 40} for k in (0, 0.5, 1)]
    pointer = [move[0], {"type": "pointerDown", "button": 0}, *move[1:], {"type": "pointerUp", "button": 0}]
    browser.call("POST", "actions", {"actions": [{"type": "pointer", "id": "mouse", "actions": pointer}]})


def pick(browser, selector, word):
    """Choose an entry of a list."""
    browser.script(
        "const list = document.querySelector(arguments[0]);"
        "list.value = [...list.options].find((o) => o.text === arguments[1]).value;"
        "list.dispatchEvent(new Event('change'))",
        selector,
        word,
    )
    browser.wait_for("salver.state.idle()")


def opened(browser, url, more="true"):
    """The page in the present window of a browser."""
    browser.call("POST", "url", {"url": url})
    browser.wait_for(f"window.salver && salver.state.answer && salver.state.idle() && {more}", 120)


@pytest.mark.slow
@pytest.mark.skipif(missing() is not None, reason=str(missing()))
def test_in_a_browser_a_scenario_is_made_from_nothing_to_a_plan_by_mouse(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text, place, folder, _ = begun("mine.toml")
    with Studio(text, place, folder) as studio, chromium(1400, 900) as browser:
        browser.call("POST", "url", {"url": studio.url})
        browser.wait_for("window.salver && salver.state.answer && salver.state.idle()")
        browser.script("document.getElementById('follow').click()")  # this test says when it is planned
        first = tomllib.loads(browser.script("return salver.state.text"))
        line = browser.script("return salver.state.answer.line.shortest")

        drag(browser, "goal", -60, 0)
        moved = tomllib.loads(browser.script("return document.getElementById('text').value"))
        goal, was = moved["motion"]["goal"]["position"], first["motion"]["goal"]["position"]
        assert np.linalg.norm(np.subtract(goal, was)) > 0.03
        assert goal[2] == was[2]
        assert moved["motion"]["start"] == first["motion"]["start"]
        assert browser.script("return salver.state.answer.line.shortest") != line

        drag(browser, "tray", 14, 4)
        held = tomllib.loads(browser.script("return salver.state.text"))
        assert np.linalg.norm(held["tray"]["offset"]) > 0.01
        assert held["motion"] == moved["motion"]

        pick(browser, "#add", "cup of coffee")
        added = tomllib.loads(browser.script("return salver.state.text"))
        drag(browser, "cup", -12, -2)
        pick(browser, "#add", "obstacle: box")
        drag(browser, "box", 0, -40)
        made = tomllib.loads(browser.script("return salver.state.text"))
        assert made["objects"][1]["at"] != added["objects"][1]["at"]
        assert made["obstacles"][0]["position"] != OBSTACLES["box"]["position"]
        for _ in range(2):  # what was dragged, and what was added: each is one step back
            browser.click("#undo")
            browser.wait_for("salver.state.idle()")
        assert "obstacles" not in tomllib.loads(browser.script("return salver.state.text"))

        browser.script(
            "const area = document.getElementById('text'); area.value = area.value.replace('mass = 0.4', 'mass = -4');"
            "area.dispatchEvent(new Event('input'))"
        )
        browser.wait_for("salver.state.mistakes.length === 1")
        assert "mass = -4: must be" in browser.script("return document.getElementById('wrong').textContent")
        assert "objects[0].mass" in browser.script("return document.getElementById('detail').textContent")
        browser.click("#undo")
        browser.wait_for("salver.state.mistakes.length === 0")
        pick(browser, "#chosen", "cup")
        browser.click("#remove")
        browser.wait_for("salver.state.idle() && salver.state.answer.parts.every((part) => part.name !== 'cup')")

        browser.click("#plan")
        browser.wait_for("salver.state.plan", 120)
        offered = "return ['report', 'export'].map((id) => !document.getElementById(id).hidden)"
        assert browser.script(offered) == [True, True]
        browser.script(
            "const area = document.getElementById('text'); area.value += 'x = ';area.dispatchEvent(new Event('input'))"
        )
        browser.wait_for("salver.state.mistakes.length === 1")
        assert browser.script(offered) == [False, False]
        browser.click("#undo")
        browser.wait_for("salver.state.mistakes.length === 0 && salver.state.idle()")
        browser.click("#plan")
        browser.wait_for("salver.state.plan", 120)
        browser.click("#save")
        browser.wait_for("salver.state.saved === salver.state.text")
        duration = browser.script("return salver.state.plan.duration")
        browser.wait_for("!salver.state.playing")
        saved = browser.script("return salver.state.text")
        drag(browser, "goal", 0, -20)  # from the plan back to the hand
        assert browser.script("return salver.state.plan") is None
        assert browser.script("return salver.state.text") != saved
        assert [entry for entry in browser.log("browser") if entry["level"] == "SEVERE"] == []
        assert {urlsplit(url).netloc for url in browser.requests()} <= {urlsplit(studio.url).netloc, ""}
    result = CliRunner().invoke(app, ["plan", "mine.toml", "--json"])
    assert json.loads(result.stdout)["plan"]["duration"] == duration


@pytest.mark.slow
@pytest.mark.skipif(missing() is not None, reason=str(missing()))
def test_in_a_browser_two_windows_do_not_disturb_each_other(tmp_path):
    file = tmp_path / "bottle.toml"
    text = (SCENARIO_DIR / "panda-tall-bottle.toml").read_text()
    with Studio(text, file, SCENARIO_DIR) as studio, chromium(1400, 900) as browser:
        opened(browser, studio.url, "salver.state.plan")
        one = browser.call("GET", "window")
        first = browser.script("return [salver.state.text, salver.state.plan.duration]")
        other = browser.call("POST", "window/new", {"type": "tab"})["handle"]
        browser.call("POST", "window", {"handle": other})
        opened(browser, studio.url)
        drag(browser, "goal", -40, 0)
        browser.wait_for("salver.state.plan", 120)
        second = browser.script("return [salver.state.text, salver.state.plan.duration]")
        assert second[0] != first[0]
        assert second[1] != first[1]
        browser.click("#save")
        browser.wait_for("salver.state.saved === salver.state.text")
        browser.call("POST", "window", {"handle": one})
        assert browser.script("return [salver.state.text, salver.state.plan.duration]") == first
        browser.click("#save")  # it has not seen what the other one has written
        browser.wait_for("salver.state.said.includes('has changed since')")
        assert file.read_text() == second[0]


@pytest.mark.slow
@pytest.mark.skipif(missing() is not None, reason=str(missing()))
def test_in_a_browser_two_thumbs_steer_both_arms_and_the_fall_is_shown_again_slowly(tmp_path):
    text = (SCENARIO_DIR / "panda-tall-bottle.toml").read_text()
    with Studio(text, tmp_path / "it.toml", SCENARIO_DIR, live=True) as studio, chromium(820, 1180) as browser:
        browser.devtools("Emulation.setTouchEmulationEnabled", enabled=True, maxTouchPoints=2)
        opened(browser, studio.url, "salver.state.frames > 3")
        places = browser.script(
            "return [...document.querySelectorAll('.thumb')].map((pad) => { const r = pad.getBoundingClientRect();"
            "return [r.left + r.width / 2, r.top + r.height / 2, r.width]; })"
        )
        assert min(width for *_, width in places) > 100  # shown where fingers are
        (x, y, r), (u, v, _) = places
        fingers = [{"x": x, "y": y, "id": 1}, {"x": u, "y": v, "id": 2}]
        browser.devtools("Input.dispatchTouchEvent", type="touchStart", touchPoints=fingers)
        fingers[0]["x"], fingers[1]["y"] = x + 0.4 * r, v - 0.4 * r
        browser.devtools("Input.dispatchTouchEvent", type="touchMove", touchPoints=fingers)
        browser.wait_for("salver.state.live.beside[0].gone")
        browser.devtools("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])
        shown = "document.getElementById('names').textContent.includes('a quarter of its speed')"
        browser.wait_for(shown)
        times = browser.script(
            "return new Promise((done) => { const seen = [], begun = performance.now(), look = () => {"
            "seen.push([performance.now(), salver.state.time]);"
            "performance.now() - begun < 1500 ? setTimeout(look, 50) : done(seen); }; look(); })"
        )
        clock, t = np.diff(np.transpose(times))
        assert 1e3 * t[t >= 0].sum() / clock[t >= 0].sum() == pytest.approx(0.25, rel=0.3)  # drawn 30 times a second
        assert browser.script("return salver.state.live.gone") is False
        browser.click("#again")
        browser.wait_for(f"!({shown})")
        browser.script(  # no gamepad can be plugged in here: what the browser would tell of one
            "window.pad = { axes: [0.05, 0, 0, -1], buttons: [0, 0, 0].map(() => ({ pressed: false })) };"
            "navigator.getGamepads = () => [null, window.pad]"
        )
        browser.wait_for("salver.state.live.tray[2] > salver.state.answer.scene.variants[0].path[0][2] - 0.05")
        browser.script("pad.axes[3] = 0.1; pad.buttons[0].pressed = true")
        browser.wait_for("salver.state.live.stopped && salver.state.live.doing === 'resting'")
        time.sleep(0.3)  # a button that is held is one press
        assert browser.script("return salver.state.live.stopped") is True
        browser.script("pad.buttons[0].pressed = false; pad.buttons[1].pressed = true")
        browser.wait_for("!salver.state.live.stopped && salver.state.live.names[0][1] === ''")
        assert [entry for entry in browser.log("browser") if entry["level"] == "SEVERE"] == []


@pytest.mark.slow
@pytest.mark.skipif(missing() is not None, reason=str(missing()))
def test_in_a_browser_another_leg_is_chosen_and_its_goal_dragged(tmp_path):
    text = changed(ROUND, [(["tray", "size"], [0.26, 0.26])])  # with room for one more
    with Studio(text, tmp_path / "round.toml", SCENARIO_DIR) as studio, chromium(1400, 900) as browser:
        opened(browser, studio.url)
        browser.script("document.getElementById('follow').click(); designing()")
        pick(browser, "#leg", "leg 2")
        assert browser.script("return salver.state.viewer.variants[0].objects.length") == 2 * 7
        drag(browser, "goal", 30, 10)
        was, now = tomllib.loads(text)["legs"], tomllib.loads(browser.script("return salver.state.text"))["legs"]
        assert now[1]["goal"]["position"] != was[1]["goal"]["position"]
        assert (now[0], now[2]) == (was[0], was[2])
        assert browser.script("return document.getElementById('leg').value") == "1"
        pick(browser, "#add", "box")  # beside the glass too that this leg does not carry
        assert [item["name"] for item in tomllib.loads(browser.script("return salver.state.text"))["objects"]] == [
            *(item["name"] for item in tomllib.loads(text)["objects"]),
            "box",
        ]
        assert [entry for entry in browser.log("browser") if entry["level"] == "SEVERE"] == []
