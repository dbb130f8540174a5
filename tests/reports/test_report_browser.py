"""The report page in a real browser: loading, controls, a phone, the dark, on paper."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from browser import Browser, chromium, missing
from page_contents import data_of
from salver.files import versions
from salver.reports.pages.page import write_report
from salver.reports.run import read_run

pytestmark = pytest.mark.slow

NO_BROWSER = missing()


def _picture(browser: Browser) -> np.ndarray:
    from PIL import Image

    clip = browser.script(
        "const r = document.getElementById('canvas').getBoundingClientRect(); return [r.x, r.y, r.right, r.bottom]"
    )
    return np.asarray(Image.open(io.BytesIO(browser.screenshot())).convert("RGB").crop(clip)).astype(int)


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    if NO_BROWSER:
        pytest.skip(NO_BROWSER)
    with chromium() as made:
        yield made


@pytest.fixture(scope="module")
def page(cube_run: Path) -> Path:
    return write_report(cube_run)


def _open(browser: Browser, page: Path) -> None:
    browser.requests()
    browser.log("browser")
    browser.open(page)
    browser.wait_for("window.salver && window.salver.state.viewer")
    browser.script("salver.setPlaying(false); salver.setTime(0)")  # it begins to play by itself


def test_in_a_browser_it_loads_quietly_and_asks_for_nothing(browser: Browser, page: Path, cube_plans: Path) -> None:
    for shown in (write_report(cube_plans), page):
        _open(browser, shown)
        charts = browser.script("return document.querySelectorAll('.plot > svg').length")
        assert charts == len(data_of(shown)["charts"]) >= 12
        assert browser.log("browser") == []
        asked_for = [url for url in browser.requests() if not url.startswith("data:")]
        assert asked_for == [shown.resolve().as_uri()]
        overflow = browser.script("return document.documentElement.scrollWidth - document.documentElement.clientWidth")
        assert overflow <= 0


def test_in_a_browser_the_controls_work(browser: Browser, page: Path) -> None:
    _open(browser, page)
    start = _picture(browser)
    assert np.ptp(start, axis=(0, 1)).min() > 60  # something is drawn
    assert len(np.unique(start.reshape(-1, 3), axis=0)) > 200

    choose = (
        "const s = document.getElementById(arguments[0]); s.value = arguments[1]; s.dispatchEvent(new Event('change'))"
    )
    browser.script(choose, "speed", "0.1")  # slowly: the motion must not end before a busy machine gets to stop it
    assert browser.script("return salver.state.speed") == 0.1
    browser.click("#play")
    browser.wait_for("salver.state.time > 0.3")
    browser.click("#play")
    assert browser.script("return salver.state.playing") is False
    moved = _picture(browser)
    assert (np.abs(moved - start).max(axis=2) > 20).sum() > 500

    browser.script("const s = document.getElementById('scrub'); s.value = 1.25; s.dispatchEvent(new Event('input'))")
    assert browser.script("return salver.state.time") == pytest.approx(1.25, abs=2e-3)
    assert "1.25 s of 3.00 s" in browser.script("return document.getElementById('clock').textContent")
    middle = _picture(browser)
    for control in ("forces", "cones", "path"):
        browser.click(f"#{control}")
        changed = _picture(browser)
        assert (np.abs(changed - middle).max(axis=2) > 15).sum() > 30, control
        browser.click(f"#{control}")
        assert np.abs(_picture(browser) - middle).max() <= 8, control
    names = "return [...document.querySelectorAll('#names b')].map((b) => b.textContent)"
    assert browser.script(names) == ["Robust", "Baseline"]
    browser.script(choose, "layout", "overlay")
    assert browser.script(names) == ["Robust", "Baseline (ghost)"]
    browser.script(choose, "layout", "single")
    assert browser.script(names) == ["Robust"]
    browser.script(choose, "layout", "side")
    browser.script(choose, "camera", "close")
    assert (np.abs(_picture(browser) - middle).max(axis=2) > 20).sum() > 20000
    assert browser.log("browser") == []


def test_in_a_browser_it_begins_to_play_and_says_what_is_seen(browser: Browser, cube_run: Path, page: Path) -> None:
    browser.open(page)
    browser.wait_for("window.salver && salver.state.time > 0")
    _open(browser, page)
    said = browser.script("return [...document.querySelectorAll('#names div div')].map((d) => d.textContent)")
    assert said[0] == "planned for the ranges"
    assert "the straight line in the same time" in said
    legend = "return document.querySelector('[data-chart=margins-3]').parentNode.querySelector('.range').textContent"
    least, most = browser.script(legend).strip("( N)").replace("−", "-").split(" to ")
    floor = read_run(cube_run).plan.cone_floor.min(axis=1)
    assert [float(least), float(most)] == pytest.approx([floor.min(), floor.max()], rel=6e-3)
    said = browser.script("return [999.9, -3141.6, 0.01234, 2e4].map(shown)")
    assert said == ["1000", "−3142", "0.0123", "2.00e+4"]


@pytest.mark.parametrize(("sides", "corners"), [(6, 36), (48, 192)])
def test_in_a_browser_a_corner_is_sent_once_for_each_of_its_normals(
    browser: Browser, page: Path, sides: int, corners: int
) -> None:
    """Sharp between the sides of a hexagon, smooth around a cylinder; a processor that draws pays for each corner."""
    _open(browser, page)
    made = browser.script(
        "const n = arguments[0], turn = (i) => 2 * Math.PI * i / n;"
        "const at = (_, i) => [0.03 * Math.cos(turn(i)), 0.02 * Math.sin(turn(i))];"
        "const { corners, indices } = prism(Array.from({ length: n }, at), -0.01, 0.2);"
        "return [[...corners], [...indices]]",
        sides,
    )
    vertices, triangles = np.reshape(made[0], (-1, 6)), np.reshape(made[1], (-1, 3))
    assert (len(vertices), len(triangles)) == (corners, 2 * sides + 2 * (sides - 2))
    assert len(np.unique(vertices, axis=0)) == corners
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    across = np.cross(b[:, :3] - a[:, :3], c[:, :3] - a[:, :3])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    for corner in (a, b, c):
        np.testing.assert_allclose(np.linalg.norm(corner[:, 3:], axis=1), 1.0, atol=1e-6)
        assert np.einsum("ij,ij->i", across, corner[:, 3:]).min() > np.cos(np.deg2rad(8.0))


def test_in_a_browser_a_chart_moves_the_time_of_all(browser: Browser, cube_run: Path, page: Path) -> None:
    _open(browser, page)
    run = read_run(cube_run)
    browser.script(
        "const s = document.querySelector('[data-chart=margins-1] svg'), r = s.getBoundingClientRect();"
        "const at = {clientX: r.left + 0.5 * r.width, clientY: r.top + 9, bubbles: true};"
        "s.dispatchEvent(new PointerEvent('pointermove', at))"
    )
    t = browser.script("return salver.state.time")
    assert 1.0 < t < 1.6
    shown = browser.script(
        "return document.querySelector('[data-chart=margins-3]').parentNode.querySelector('b').textContent"
    )
    expected = float(np.interp(t, run.plan.t, run.plan.cone_floor.min(axis=1)))
    assert float(shown.split()[0]) == pytest.approx(expected, rel=6e-3)


def test_in_a_browser_it_is_usable_on_a_phone(browser: Browser, page: Path) -> None:
    browser.resize(390, 844)
    _open(browser, page)
    box = "const r = document.querySelector(arguments[0]).getBoundingClientRect(); return [r.left, r.right, r.height]"
    left, right, _ = browser.script(box, "#scrub")
    assert right - left > 300
    assert browser.script(box, "nav")[2] < 50
    one_above_the_other = browser.script(
        "return [...document.querySelectorAll('#names > div')].map((d) => d.getBoundingClientRect().top)"
    )
    assert one_above_the_other[1] - one_above_the_other[0] > 250
    browser.script("document.getElementById('canvas').scrollIntoView({block: 'end', behavior: 'instant'})")
    picture = _picture(browser)
    bluish = (picture[..., 2].astype(int) - picture[..., 0] > 12) & (picture[..., 0] < 90) & (picture[..., 0] > 20)
    assert bluish.sum() > 200  # the tray is seen,
    assert not bluish[:, [0, 1, -2, -1]].any()  # and none of it is cut off at the sides
    assert browser.script("return document.documentElement.scrollWidth") <= 390
    browser.resize(1400, 900)


# Contrast ratio of WCAG 2.1 between an element's text and the page.
CONTRAST = """
const linear = (v) => (v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
const light = (text) => {
  const [r, g, b] = text.match(/[0-9.]+/g).map((v) => linear(v / 255));
  return 0.2126 * r + 0.7152 * g + 0.0722 * b;
};
const element = document.querySelector(arguments[0]), style = getComputedStyle(element);
const text = light(element instanceof SVGElement ? style.fill : style.color);
const page = light(getComputedStyle(document.body).backgroundColor);
return (Math.max(text, page) + 0.05) / (Math.min(text, page) + 0.05);
"""


def test_in_a_browser_it_is_legible_in_the_dark(browser: Browser, page: Path) -> None:
    _open(browser, page)
    for scheme in ("dark", "light"):
        browser.devtools("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])
        for selector in ("body", ".verdict p", ".tiles dt", "nav a", "figcaption", "svg .tick", "svg .label"):
            contrast = browser.script(CONTRAST, selector)
            assert contrast >= 4.5, f"{scheme}: {selector} has a contrast of {contrast:.2f}"  # WCAG 2.1, AA
    browser.devtools("Emulation.setEmulatedMedia", features=[])


def test_in_a_browser_it_prints(browser: Browser, page: Path) -> None:
    _open(browser, page)
    shown = "const e = document.querySelector('.review'); return e.checkVisibility() ? e.innerText : ''"
    assert browser.script(shown) == ""
    browser.devtools("Emulation.setEmulatedMedia", media="print")
    review = browser.script(shown)
    browser.devtools("Emulation.setEmulatedMedia", media="")
    for part in ("mass", f"salver {versions()['salver']} on 20", "Reviewed by", "Signature", "±"):
        assert part in review, part
    document = browser.pdf()
    assert document.startswith(b"%PDF")
    assert 3 <= len(re.findall(rb"/Type\s*/Page\b", document)) <= 9
    assert browser.script("return document.querySelector('.plot svg').viewBox.baseVal.width") > 450  # as before
