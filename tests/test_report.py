"""The report page: what it says against hand-made numbers, and how it behaves in a real browser."""

from __future__ import annotations

import base64
import io
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from browser import Browser, chromium, missing
from run_files import rewrite
from salver import scenario
from salver.errors import FileFormatError
from salver.geometry import matrix_from_quat_wxyz
from salver.models.arm import load_arm
from salver.planning.make import make_plan
from salver.planning.plan import load_plan
from salver.reports.meshes import decimate, link_meshes, merge_vertices, pack
from salver.reports.page import write_report
from salver.reports.replay import replay_scene
from salver.reports.run import Run, read_run
from salver.reports.words import asked, verdict

pytestmark = pytest.mark.slow

NO_BROWSER = missing()


@pytest.fixture(scope="module")
def plan_only(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("plan-only")
    case = scenario.load("panda-cube")
    make_plan(case, "robust").save(folder, "plan")
    make_plan(case, "baseline").save(folder, "baseline")
    return folder


@pytest.fixture(scope="module")
def full(plan_only: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run directory with a simulation of both motions and a small campaign."""
    import shutil

    from salver.campaigns import run_campaign
    from salver.simulation.physics import simulate

    folder = tmp_path_factory.mktemp("full") / "run"
    shutil.copytree(plan_only, folder)
    for stem in ("plan", "baseline"):
        simulate(load_plan(folder, stem)).save(folder, stem)
    run_campaign(folder, n=6, engine="closed-loop", jobs=1)
    return folder


def _data(page: Path) -> dict[str, Any]:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page.read_text(), re.S)
    assert found is not None
    return json.loads(found.group(1))


def _floats(text: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), "<f4").astype(float)


def test_page_is_one_file_that_names_no_other(full: Path) -> None:
    page = write_report(full)
    text = page.read_text()
    assert page == full / "report.html"
    assert page.stat().st_size < 3e6
    assert "Content-Security-Policy" in text
    assert "default-src 'none'" in text
    without_namespaces = text.replace("http://www.w3.org/2000/svg", "")
    assert not re.findall(r"https?://", without_namespaces)
    assert not re.findall(r"<(?:link|script|img)[^>]+(?:href|src)=\"(?!data:|#)", text)


def test_sections_follow_what_the_directory_has(plan_only: Path, full: Path, tmp_path: Path) -> None:
    bare = write_report(plan_only, tmp_path / "bare.html").read_text()
    rich = write_report(full, tmp_path / "rich.html").read_text()
    for text in (bare, rich):
        for key in ("replay", "margins", "forces", "sensitivity", "motion", "arm", "provenance"):
            assert f'id="{key}"' in text, key
    for key in ("simulation", "campaign"):
        assert f'id="{key}"' not in bare
        assert f'id="{key}"' in rich
    assert "6 of 6" in rich
    # All of 6 held: the exact lower limit is (0.05 / 2) ** (1 / 6) = 54.07 %.
    assert "54.1 % to 100.0 %" in rich


def test_verdict_takes_the_strongest_evidence(plan_only: Path, full: Path) -> None:
    assert verdict(read_run(plan_only)).headline.startswith("The cube is predicted to stay put")
    assert verdict(read_run(full)).headline == "The cube stayed put in all 6 perturbed runs"
    run = read_run(full)
    run.campaign["plans"]["plan"]["outcomes"] = {"holds": {"count": 2, "of": 6}, "slides": {"count": 4, "of": 6}}  # type: ignore[index]
    bad = verdict(run)
    assert (bad.level, bad.headline) == ("bad", "The cube stayed put in 2 of 6 perturbed runs")
    assert bad.detail.startswith("The others: 4 slides.")


def test_a_plan_that_failed_is_not_praised(plan_only: Path, tmp_path: Path) -> None:
    import shutil

    shutil.copytree(plan_only, tmp_path / "run")

    def fail(record: dict[str, Any]) -> None:
        record["ok"] = False
        record["verification"] |= {"ok": False, "sentence": "cube leaves its contact condition by 0.2 N at t = 0.3 s."}

    rewrite(tmp_path / "run", record=fail)
    answer = verdict(read_run(tmp_path / "run"))
    assert (answer.level, answer.headline) == ("bad", "No safe plan was found")
    assert "by 0.2 N at t = 0.3 s" in answer.detail


def test_task_in_words(plan_only: Path) -> None:
    text = asked(read_run(plan_only))
    for piece in (
        "the cube (4 × 4 × 4 cm, 256 g, friction 0.5)",
        "0.48 m far",
        "0.47 m along y",
        "2.50 s",
        "mass ±25.6 g (10 %)",
    ):
        assert piece in text


def test_text_from_files_is_escaped(plan_only: Path, tmp_path: Path) -> None:
    import shutil

    shutil.copytree(plan_only, tmp_path / "run")
    script = {"sentence": "</script><script>alert(1)</script>"}
    rewrite(tmp_path / "run", record=lambda record: record["status"].update(script))
    text = write_report(tmp_path / "run").read_text()
    assert "alert(1)" in text
    assert "<script>alert(1)" not in text


def test_replay_is_the_plan(plan_only: Path) -> None:
    """Tray, object and links in the page against forward kinematics; contact forces against Newton's law."""
    run = read_run(plan_only)
    arm = load_arm(run.scenario.arm, run.scenario.tray)  # type: ignore[arg-type]
    scene = replay_scene(run, arm)
    for variant, motion in zip(scene["variants"], run.motions, strict=True):
        frames = len(variant["t"])
        tray = _floats(variant["tray"]).reshape(frames, 7)
        objects = _floats(variant["objects"]).reshape(frames, 1, 7)
        joints = _floats(variant["joints"]).reshape(frames, arm.n + 1, 7)
        forces = _floats(variant["forces"]).reshape(frames, variant["contactCount"], 3)
        for k in (0, frames // 3, frames - 1):
            sample = int(np.argmin(np.abs(motion.t - variant["t"][k])))
            p_SE, R_SE = arm.tray_pose(motion.arrays["q"][sample])
            assert np.abs(tray[k, :3] - p_SE).max() < 2e-5
            assert np.abs(matrix_from_quat_wxyz(tray[k, 3:]) - R_SE).max() < 2e-5
            assert np.abs(objects[k, 0, :3] - motion.arrays["p_SB"][sample]).max() < 1e-6
            flange, _ = arm.link_pose(motion.arrays["q"][sample], "panda_link7")
            assert np.abs(joints[k, arm.n, :3] - flange).max() < 1e-5
            weight = run.scenario.objects[0].mass * (motion.arrays["a_S"][sample] + [0, 0, 9.81])
            assert np.abs(forces[k].sum(axis=0) - weight).max() < 1e-4
    assert np.array_equal(
        _floats(scene["variants"][0]["joints"]).reshape(frames, arm.n + 1, 7)[:, 0], [[0, 0, 0, 1, 0, 0, 0]] * frames
    )


def test_replay_of_a_simulation_shows_what_was_simulated(full: Path) -> None:
    run = read_run(full)
    arm = load_arm(run.scenario.arm, run.scenario.tray)  # type: ignore[arg-type]
    variant = replay_scene(run, arm)["variants"][0]
    record = run.plan.simulation
    assert record is not None
    assert variant["source"] == "run"
    objects = _floats(variant["objects"]).reshape(len(variant["t"]), 1, 7)
    assert np.abs(objects[-1, 0, :3] - record.arrays["p_SB"][-1, 0]).max() < 1e-6
    forces = _floats(variant["forces"]).reshape(len(variant["t"]), -1, 3)
    assert np.abs(forces[-1].sum(axis=0) - [0, 0, 0.256 * 9.81]).max() < 1e-3  # at rest: the weight


def test_meshes_keep_their_shape_when_decimated() -> None:
    arm = load_arm(scenario.load("panda-cube").arm, scenario.load("panda-cube").tray)  # type: ignore[arg-type]
    coarse, fine = link_meshes(arm), link_meshes(arm, 10**6)
    assert {m.joint for m in coarse} == set(range(8))
    for link in {m.name for m in fine}:
        few, all_ = ([m for m in meshes if m.name == link] for meshes in (coarse, fine))
        assert sum(len(m.triangles) for m in few) <= 2210 < sum(len(m.triangles) for m in all_)
        for bound in (np.min, np.max):
            a, b = (bound(np.vstack([m.vertices for m in meshes]), axis=0) for meshes in (few, all_))
            assert np.abs(a - b).max() < 1e-3
    for m in coarse:
        packed = pack(m)
        grid = np.frombuffer(base64.b64decode(packed["vertices"]), "<u2").reshape(-1, 3)
        assert np.abs(packed["low"] + grid / 65535 * packed["span"] - m.vertices).max() < 1e-5


def test_merging_vertices_by_hand() -> None:
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 0, 0], [1, 1, 0], [0, 1, 0.0]])
    vertices, triangles = merge_vertices(corners, np.array([[0, 1, 2], [3, 4, 5], [0, 3, 5]]))
    assert len(vertices) == 4
    assert len(triangles) == 2  # the third had two corners in one place
    assert {frozenset(map(tuple, vertices[t])) for t in triangles} == {
        frozenset({(0, 0, 0), (1, 0, 0), (1, 1, 0)}),
        frozenset({(0, 0, 0), (1, 1, 0), (0, 1, 0)}),
    }
    assert decimate(vertices, triangles, 10)[1] is triangles


def test_without_an_arm_the_page_still_works(tmp_path: Path) -> None:
    make_plan(scenario.load("panda-cube").with_changes(arm=None), "baseline").save(tmp_path, "plan")
    page = write_report(tmp_path)
    data = _data(page)
    assert data["replay"]["meshes"] == []
    assert 'id="arm"' not in page.read_text()


def test_a_log_of_the_arm_is_shown_like_a_simulation(plan_only: Path, tmp_path: Path) -> None:
    """With the object seen now and then by motion capture: where it was not, the tray carries it."""
    import shutil

    from salver.driver.execute import dry_run
    from salver.files import read_result
    from salver.run_directory import save_record

    shutil.copytree(plan_only, tmp_path / "run")
    dry_run(tmp_path / "run", realtime=False)
    arrays, summary = read_result(tmp_path / "run" / "execution" / "plan")
    gap = (arrays["t"] > 1.0) & (arrays["t"] < 1.5)
    for name in ("p_SB", "quat_SB_wxyz", "e_p", "e_o"):
        arrays[name][gap] = np.nan
    save_record(tmp_path / "run", "execution", "plan", arrays, summary)
    page = write_report(tmp_path / "run")
    data = _data(page)
    text = page.read_text()
    assert 'id="execution"' in text
    assert "simulated arm: holds" in text
    assert "Position error of the object" in [
        c["title"] for k, c in data["charts"].items() if k.startswith("execution")
    ]
    curve = data["charts"]["execution-0"]["series"][0]
    assert {y is None for x, y in zip(curve["x"], curve["y"], strict=True) if 1.01 < x < 1.49} == {True}
    variant = data["replay"]["variants"][0]
    poses = _floats(variant["objects"]).reshape(len(variant["t"]), 1, 7)
    assert np.all(np.isfinite(poses))
    tray = _floats(variant["tray"]).reshape(-1, 7)
    assert np.abs(np.linalg.norm(poses[:, 0, :3] - tray[:, :3], axis=1) - 0.02).max() < 1e-3


def test_other_directories_get_a_sentence(tmp_path: Path, plan_only: Path) -> None:
    with pytest.raises(FileFormatError, match=r"is no run directory: it has no plan\.npz"):
        write_report(tmp_path)
    import shutil

    shutil.copytree(plan_only, tmp_path / "run")
    (tmp_path / "run" / "plan.npz").write_bytes((plan_only / "plan.npz").read_bytes()[:5000])
    with pytest.raises(FileFormatError, match=r"plan\.npz is truncated"):
        write_report(tmp_path / "run")


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
def page(full: Path) -> Path:
    return write_report(full)


def _open(browser: Browser, page: Path) -> None:
    browser.requests()
    browser.log("browser")
    browser.open(page)
    browser.wait_for("window.salver && window.salver.state.viewer")


def test_in_a_browser_it_loads_quietly_and_asks_for_nothing(browser: Browser, page: Path, plan_only: Path) -> None:
    for shown in (write_report(plan_only), page):
        _open(browser, shown)
        charts = browser.script("return document.querySelectorAll('.plot > svg').length")
        assert charts == len(_data(shown)["charts"]) >= 12
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


def test_in_a_browser_a_chart_moves_the_time_of_all(browser: Browser, full: Path, page: Path) -> None:
    _open(browser, page)
    run = read_run(full)
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


def test_in_a_browser_it_is_legible_in_the_dark(browser: Browser, page: Path) -> None:
    _open(browser, page)
    for scheme in ("dark", "light"):
        browser.devtools("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])
        for selector in ("body", ".verdict p", ".tiles dt", "nav a", "figcaption", "svg .tick", "svg .label"):
            contrast = browser.script(CONTRAST, selector)
            assert contrast >= 4.5, f"{scheme}: {selector} has a contrast of {contrast:.2f}"  # WCAG 2.1, AA
    browser.devtools("Emulation.setEmulatedMedia", features=[])


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


def test_in_a_browser_it_prints(browser: Browser, page: Path) -> None:
    _open(browser, page)
    document = browser.pdf()
    assert document.startswith(b"%PDF")
    assert 3 <= len(re.findall(rb"/Type\s*/Page\b", document)) <= 9
    assert browser.script("return document.querySelector('.plot svg').viewBox.baseVal.width") > 450  # as before


def test_a_carried_mesh_is_drawn_as_it_is_not_as_its_hull(tmp_path: Path) -> None:
    import trimesh

    waist = [[0, 0], [0.03, 0], [0.01, 0.05], [0.03, 0.1], [0, 0.1]]
    trimesh.creation.revolve(np.array(waist), sections=32).export(tmp_path / "vase.stl")
    shape = {"type": "mesh", "file": str(tmp_path / "vase.stl")}
    item = {"name": "vase", "shape": shape, "mass": 0.3, "friction": 0.5}
    pose = {"position": [0.5, 0.0, 0.4]}
    way = {"start": pose, "goal": {"position": [0.5, 0.1, 0.4]}, "duration": 2.0}
    vase = scenario.parse({"name": "vase", "motion": way, "objects": [item]}, "vase")
    make_plan(vase).save(tmp_path / "run")
    drawn = _data(write_report(tmp_path / "run"))["replay"]["objects"][0]
    points = np.array(drawn["points"])
    radius, middle = np.hypot(points[:, 0], points[:, 1]), np.ptp(points[:, 2]) / 2 + points[:, 2].min()
    assert np.ptp(points[:, 2]) == pytest.approx(0.1, abs=1e-4)
    assert radius[np.abs(points[:, 2] - middle) < 0.002].max() == pytest.approx(0.01, abs=1e-3)  # the hull: 0.03


def test_run_gives_motions_in_order(full: Path) -> None:
    run: Run = read_run(full)
    assert [m.label for m in run.motions] == ["Robust", "Baseline"]
    assert run.motion("baseline") is run.motions[1]
    assert run.motion("other") is None
    assert np.array_equal(np.unique(run.runs["stem"]), ["baseline", "plan"])


def test_contact_curves_by_hand(plan_only: Path) -> None:
    """A level straight line: the cube needs the friction |a| / g, and its zero-moment point runs off by |a| h / g."""
    run = read_run(plan_only)
    curves, line = run.contact["baseline"], run.motions[1]
    a = np.linalg.norm(line.arrays["a_S"], axis=1)
    peak = float(a.max())
    # Round cones need |a| / g; eight inscribed edges need up to 1 / cos(22.5 degrees) more.
    assert curves.coefficient is not None
    assert peak / 9.81 <= curves.coefficient.max() * (1 + 1e-6) <= 1.09 * peak / 9.81
    assert np.array_equal(curves.friction, curves.coefficient / 0.5)
    k = int(np.argmax(a))
    t, direction = float(line.t[k]), line.arrays["a_S"][k, :2] / peak
    off = peak * 0.02 / 9.81
    distance = 0.02 - off * np.abs(direction).max()  # the base is a square of 4 cm, its sides along x and y
    assert np.interp(t, curves.t, curves.tip) == pytest.approx(distance, abs=1e-5)
    assert np.all(curves.worst <= curves.nominal + 1e-12)
    assert np.all(curves.tip_worst <= curves.tip + 1e-12)


def test_a_plan_of_another_scenario_gets_a_sentence(tmp_path: Path) -> None:
    case = scenario.load("panda-cube").with_changes(arm=None)
    make_plan(case, "baseline").save(tmp_path, "plan")
    path = tmp_path / "scenario.toml"
    path.write_text(path.read_text().replace("mass = 0.256", "mass = 0.3"))
    with pytest.raises(FileFormatError, match=r"scenario\.toml was edited since"):
        read_run(tmp_path)


def test_the_worst_case_is_the_plans_own_and_of_contact_alone(tmp_path: Path) -> None:
    """Least tilt in rad is no share of a weight, and the distance to tipping is what `salver plan` prints."""
    case = scenario.load("upright-dice").with_changes(motion__orientation="free", motion__max_tilt_deg=1.0)
    plan = make_plan(case, "baseline")
    plan.save(tmp_path, "plan")
    curves = read_run(tmp_path).contact["plan"]
    contact = [owner != "tilt limit" for owner in plan.evaluation.slack_owner]
    assert not all(contact)
    assert curves.worst == pytest.approx(plan.evaluation.slack[::2, contact].min(axis=1), abs=1e-9)
    assert curves.tip_worst.min() == pytest.approx(
        min(m.tip_over_worst.min() for m in plan.margins.interfaces), rel=0.02
    )


def test_several_objects_are_spoken_of_together(tmp_path: Path) -> None:
    case = scenario.load("upright-arch")
    make_plan(case, "baseline").save(tmp_path, "plan")
    run = read_run(tmp_path)
    assert run.load == "the 3 objects"
    assert run.contact["plan"].coefficient is None
    text = write_report(tmp_path).read_text()
    assert "friction of lintel ±0.042 (10 %)" in text
    assert len(_data(tmp_path / "report.html")["replay"]["objects"]) == 3


def test_parameters_that_hardly_matter_are_named_not_drawn(tmp_path: Path) -> None:
    """The contact forces of a level cube do not depend on its inertia: mass and centre of mass are what matters."""
    make_plan(scenario.load("panda-cube-10-parameters").with_changes(arm=None), "baseline").save(tmp_path, "plan")
    data = _data(write_report(tmp_path))
    chart = next(c for c in data["charts"].values() if "which parameter" in c["title"])
    drawn = {s["name"] for s in chart["series"]}
    assert (
        {"mass", "centre of mass x", "centre of mass y"} <= drawn <= {"mass", *(f"centre of mass {c}" for c in "xyz")}
    )
    assert "inertia xx" in chart["note"]
