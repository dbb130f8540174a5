"""The report page: what it says, against hand-made numbers."""

from __future__ import annotations

import re
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from page_contents import data_of
from rewritten_runs import rewrite
from salver import scenario
from salver.errors import FileFormatError
from salver.models.arm.arm_limits import LIMITS
from salver.models.uncertain.parameters import Parameter
from salver.planning.make import make_plan
from salver.reports.pages.page import write_report
from salver.reports.pages.sections import build, tiles
from salver.reports.pages.words import asked, verdict
from salver.reports.parameters import half_range
from salver.reports.run import ReportedRun, read_run
from salver.reports.tables import arm_usage

pytestmark = pytest.mark.slow


def test_page_is_one_file_that_names_no_other(cube_run: Path) -> None:
    page = write_report(cube_run)
    text = page.read_text()
    assert page == cube_run / "report.html"
    assert page.stat().st_size < 3e6
    assert "Content-Security-Policy" in text
    assert "default-src 'none'" in text
    without_namespaces = text.replace("http://www.w3.org/2000/svg", "")
    assert not re.findall(r"https?://", without_namespaces)
    assert not re.findall(r"<(?:link|script|img)[^>]+(?:href|src)=\"(?!data:|#)", text)


def test_sections_follow_what_the_directory_has(cube_plans: Path, cube_run: Path, tmp_path: Path) -> None:
    bare = write_report(cube_plans, tmp_path / "bare.html").read_text()
    rich = write_report(cube_run, tmp_path / "rich.html").read_text()
    for text in (bare, rich):
        for key in ("replay", "margins", "forces", "sensitivity", "motion", "arm", "provenance"):
            assert f'id="{key}"' in text, key
    for key in ("simulation", "campaign"):
        assert f'id="{key}"' not in bare
        assert f'id="{key}"' in rich
    assert "6 of 6" in rich
    # All of 6 held: the exact lower limit is (0.05 / 2) ** (1 / 6) = 54.07 %.
    assert "54.1 % to 100.0 %" in rich


def test_without_the_engine_a_campaign_is_noted_and_the_rest_shown(
    cube_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "arro3.io", None)
    said: list[str] = []
    text = write_report(cube_run, tmp_path / "page.html", say=said.append).read_text()
    assert 'id="simulation"' in text
    assert 'id="campaign"' not in text
    assert [one.endswith("needs arro3, which is not installed; install it with: pip install 'salver[engine]'.")
            for one in said] == [True]  # fmt: skip


def test_verdict_takes_the_strongest_evidence(cube_plans: Path, cube_run: Path) -> None:
    assert verdict(read_run(cube_plans)).headline.startswith("The cube is predicted to stay put")
    assert verdict(read_run(cube_run)).headline == "The cube stayed put in all 6 perturbed runs"
    run = read_run(cube_run)
    run.campaign["plans"]["plan"]["outcomes"] = {"holds": {"count": 2, "of": 6}, "slides": {"count": 4, "of": 6}}  # type: ignore[index]
    bad = verdict(run)
    assert (bad.level, bad.headline) == ("bad", "The cube stayed put in 2 of 6 perturbed runs")
    assert bad.detail.startswith("The others: 4 slides.")


def test_a_plan_that_failed_is_not_praised(cube_plans: Path, tmp_path: Path) -> None:
    shutil.copytree(cube_plans, tmp_path / "run")

    def fail(record: dict[str, Any]) -> None:
        record |= {"ok": False, "verdict": "UNSAFE: cube leaves its contact condition by 0.2 N at t = 0.3 s."}

    rewrite(tmp_path / "run", record=fail)
    answer = verdict(read_run(tmp_path / "run"))
    assert (answer.level, answer.headline) == ("bad", "No safe plan was found")
    assert answer.detail == "cube leaves its contact condition by 0.2 N at t = 0.3 s."


def test_task_in_words(cube_plans: Path) -> None:
    text = asked(read_run(cube_plans))
    for piece in (
        "the cube (4 × 4 × 4 cm, 256 g, friction 0.5)",
        "0.48 m far",
        "0.47 m along y",
        "2.50 s",
        "mass ±25.6 g (10 %)",
    ):
        assert piece in text


def test_text_from_files_is_escaped(cube_plans: Path, tmp_path: Path) -> None:
    shutil.copytree(cube_plans, tmp_path / "run")
    script = {"sentence": "</script><script>alert(1)</script>"}
    rewrite(tmp_path / "run", record=lambda record: record["status"].update(script))
    text = write_report(tmp_path / "run").read_text()
    assert "alert(1)" in text
    assert "<script>alert(1)" not in text


def test_without_an_arm_the_page_still_works(tmp_path: Path) -> None:
    make_plan(scenario.load("panda-cube").with_changes(arm=None), "baseline").save(tmp_path, "plan")
    page = write_report(tmp_path)
    data = data_of(page)
    assert data["replay"]["meshes"] == []
    assert 'id="arm"' not in page.read_text()


def test_other_directories_get_a_sentence(tmp_path: Path, cube_plans: Path) -> None:
    with pytest.raises(FileFormatError, match=r"is not a run directory: it holds no scenario\.toml"):
        write_report(tmp_path)
    shutil.copytree(cube_plans, tmp_path / "run")
    (tmp_path / "run" / "plan.npz").write_bytes((cube_plans / "plan.npz").read_bytes()[:5000])
    with pytest.raises(FileFormatError, match=r"plan\.npz is truncated"):
        write_report(tmp_path / "run")


def test_run_gives_motions_in_order(cube_run: Path) -> None:
    run: ReportedRun = read_run(cube_run)
    assert [m.label for m in run.motions] == ["Robust", "Baseline"]
    assert run.motion("baseline") is run.motions[1]
    assert run.motion("other") is None
    assert np.array_equal(np.unique(run.runs["stem"]), ["baseline", "plan"])


def test_contact_curves_by_hand(cube_plans: Path) -> None:
    """A level straight line: the cube needs the friction |a| / g, and its zero-moment point runs off by |a| h / g."""
    run = read_run(cube_plans)
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


def test_room_below_a_brim_is_no_share_of_a_weight(tmp_path: Path) -> None:
    """Fast and sticky: it spills, and nothing slides."""
    case = scenario.load("panda-coffee").with_changes(
        arm=None, objects__0__friction=2.0, motion__duration=0.9, contact__condition="exact"
    )
    plan = make_plan(case, "baseline")
    plan.save(tmp_path, "plan")
    brim = plan.evaluation.slack[:, [owner.startswith("liquid in") for owner in plan.evaluation.slack_owner]]
    assert brim.min() < 0  # of the room
    run = read_run(tmp_path)
    left = run.contact["plan"].worst.min()
    assert left > 0
    assert "Stops on the path" not in build(run, None).html  # nothing is known of them with a liquid
    assert plan.left == pytest.approx(left, rel=0.02)
    assert plan.facts()["left in the worst case"] == f"{100 * plan.left:.3g} % of the weight"


def test_the_share_of_instants_from_which_a_stop_keeps_the_load(cube_plans: Path) -> None:
    run = read_run(cube_plans)
    for curves in run.contact.values():
        known = curves.braking
        assert known is not None
        known.margin[:] = np.where(np.isfinite(known.margin), -1.0, np.nan)
        known.margin[0, 0] = 1.0  # one instant is left of 40
    specs = {spec["title"]: spec for spec in build(run, None).specs.values()}
    assert max(specs["Stops on the path"]["series"][0]["y"]) == pytest.approx(100 / 40, rel=0.05)


def test_a_share_is_told_of_what_has_a_zero() -> None:
    com, mass = (Parameter("cup", kind, axis) for kind, axis in (("com", "z"), ("mass", "")))
    assert half_range(com, 7.5e-4, 3e-3) == "3 mm"
    assert half_range(mass, 0.25, 0.025) == "25 g (10 %)"


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


def test_several_objects_are_spoken_of_together(arch: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(arch, tmp_path / "run"))
    run = read_run(folder)
    assert run.load == "the 3 objects"
    assert run.contact["plan"].coefficient is None
    text = write_report(folder).read_text()
    assert "friction of lintel ±0.042 (10 %)" in text
    assert len(data_of(folder / "report.html")["replay"]["objects"]) == 3


def test_parameters_that_hardly_matter_are_named_not_drawn(tmp_path: Path) -> None:
    """The contact forces of a level cube do not depend on its inertia: mass and centre of mass are what matters."""
    make_plan(scenario.load("panda-cube-10-parameters").with_changes(arm=None), "baseline").save(tmp_path, "plan")
    data = data_of(write_report(tmp_path))
    chart = next(c for c in data["charts"].values() if "which parameter" in c["title"])
    drawn = {s["name"] for s in chart["series"]}
    assert (
        {"mass", "centre of mass x", "centre of mass y"} <= drawn <= {"mass", *(f"centre of mass {c}" for c in "xyz")}
    )
    assert "inertia xx" in chart["note"]


def test_distributions_of_perturbed_runs_end_at_the_largest_value(cube_run: Path) -> None:
    run = read_run(cube_run)
    charts = [spec for key, spec in build(run, None).specs.items() if key.startswith("campaign")]
    columns = {"Largest slip in each run": "peak_slip", "Largest position error in each run": "e_p_peak"}
    assert [chart["title"] for chart in charts] == list(columns)
    for chart in charts:
        for curve, stem in zip(chart["series"], ("plan", "baseline"), strict=True):
            largest = run.runs[columns[chart["title"]]][run.runs["stem"] == stem].astype(float).max()
            factor = 1e6 if "µm" in chart["x"] else 1e3
            assert curve["x"][-1] == pytest.approx(factor * largest, rel=1e-4)
            assert curve["y"] == pytest.approx([100 * k / 6 for k in range(1, 7)], rel=1e-4)


def test_peaks_of_a_run_are_those_until_an_object_is_lost(cube_run: Path) -> None:
    run = read_run(cube_run)
    record = run.plan.simulation
    record.arrays["slip"] = np.where(record.t[:, None] > 1.0, 0.4, record.arrays["slip"])
    record.summary["objects"] = [{"name": "cube", "peak_slip": 0.0123}, {"name": "die", "peak_slip": 0.002}]
    assert ("Slip in simulation", "12.3 mm") in {tile[:2] for tile in tiles(run)}
    assert ">12.30<" in build(run, None).html
    record.summary["objects"] = []  # no object was seen
    assert ("Slip in simulation", "400 mm") in {tile[:2] for tile in tiles(run)}


def test_the_table_of_limits_has_what_the_verdict_on_the_arm_has(cube_run: Path) -> None:
    run = read_run(cube_run)
    arm = run.scenario.load_arm()
    usage = arm_usage(run.plan, arm)
    peaks = {key: found for key, found in run.plan.summary["arm"]["details"].items() if key in usage}
    assert set(peaks) == set(usage) == {kind.key for kind in LIMITS}
    for key, peak in peaks.items():
        part = getattr(arm.planning_limits, key, 1.0) / getattr(arm.limits, key, 1.0)
        share = (part * np.ones(arm.n))[arm.joint_names.index(peak["joint"])] * peak["share"]
        assert usage[key].max() == pytest.approx(share, rel=0.05), key
