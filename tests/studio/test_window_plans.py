"""The plan of a window is the one of the command; what the buttons do with it, and the process that does it."""

import io
import json
import threading
import time
import zipfile
from pathlib import Path
from types import SimpleNamespace
from urllib.parse import urlsplit

import numpy as np
import pytest
from typer.testing import CliRunner

import salver as sv
from salver.cli import app
from salver.scenario import SCENARIO_DIR, names
from salver.simulation.scene.loads import true_world
from salver.studio.look import change
from salver.studio.planner import MORE
from salver.studio.server import Studio
from salver.studio.text import changed
from salver.studio.words import planned
from studio_windows import CUBE, ROUND, asked, say, shown


@pytest.mark.slow
def test_what_the_page_says_first_is_said_by_salver_and_begins_with_what_was_not_checked(tmp_path):
    mistake = CUBE.replace("mass = 0.256", "mass = -1", 1)
    level, head, detail = shown(CUBE)["verdict"]
    assert (level, head) == ("", "The arm reaches both ends, and nothing that is checked touches there.")
    assert detail.startswith("Not checked: anything around the arm but the floor; ")
    away = shown(change(CUBE, SCENARIO_DIR, [(["motion", "goal", "position"], [2.0, 0.0, 0.4])]))
    assert away["verdict"][:2] == ("bad", "Nothing can be planned here yet.")
    assert away["verdict"][2].startswith(away["blocked"])
    wrong = shown(mistake)
    line = mistake.splitlines().index("mass = -1") + 1
    assert wrong["verdict"] == ("bad", f"Line {line} says what cannot be.", wrong["mistakes"][0]["sentence"])
    with Studio(CUBE, tmp_path / "cube.toml", SCENARIO_DIR) as studio:
        level, head, detail = say(studio, "plan", text=CUBE, window="one")["verdict"]
        assert (level, head) == ("", "2.500 s, safe in the worst case of what is checked.")
        assert detail.startswith("Not checked: anything around the arm")
        path = urlsplit(studio.url).path
        assert say(studio, "look", text=CUBE, window="one")["mistakes"] == []
        assert asked(studio, "GET", path + "csv/one")[0] == 200
        assert say(studio, "look", text=mistake, window="one")["mistakes"]  # the plan is of a text that is no more
        assert asked(studio, "GET", path + "csv/one")[0] == asked(studio, "GET", path + "report/one")[0] == 404
        assert "plan first" in say(studio, "run", window="one")["problem"]


@pytest.mark.slow
def test_the_plan_of_a_window_is_the_commands_and_another_window_has_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = change(CUBE, SCENARIO_DIR, [(["motion", "duration"], None), (["objects", 0, "friction"], 0.45)])
    with Studio(text, Path("cube.toml"), tmp_path) as studio:
        here = say(studio, "plan", text=text, window="one")
        assert here["ok"], here
        assert here["legs"][0]["end"] == pytest.approx(here["duration"], abs=1e-5)
        assert say(studio, "save", text=text)["saved"]
        other = say(studio, "plan", text=changed(text, [(["motion", "goal", "position", 1], 0.0)]), window="two")
        assert other["duration"] < here["duration"]
        seen = say(studio, "run", window="one")
        assert "the plan: holds" in seen["sentence"]
        assert here["duration"] < seen["legs"][0]["end"]
        assert {variant["source"] for variant in seen["legs"][0]["variants"]} == {"run"}
        assert "plan first" in say(studio, "run", window="three")["problem"]
        for window, duration in (("one", here["duration"]), ("two", other["duration"])):
            status, page = asked(studio, "GET", urlsplit(studio.url).path + f"report/{window}")
            assert (status, f"{duration:.3g}" in page.decode()) == (200, True)
        csv = asked(studio, "GET", urlsplit(studio.url).path + "csv/one")[1].decode()
        assert float(csv.splitlines()[-1].split(",")[0]) == pytest.approx(here["duration"], abs=1e-6)
    result = CliRunner().invoke(app, ["plan", "cube.toml", "--json"])
    assert json.loads(result.stdout)["plan"]["duration"] == here["duration"]


@pytest.mark.slow
def test_stops_campaign_and_exports_are_those_of_the_plan_of_a_window(tmp_path):
    text = (SCENARIO_DIR / "panda-tall-bottle.toml").read_text()
    with Studio(text, tmp_path / "it.toml", SCENARIO_DIR) as studio:
        assert "plan first" in say(studio, "stops", window="one")["problem"]
        found = say(studio, "plan", text=text, window="one")
        assert found["ok"], found
        seen = say(studio, "stops", window="one")
        assert "It can be stopped at any time within" in seen["sentence"]
        assert seen["sentence"].endswith("Runs from before are of the plan without stops, and are not counted.")
        assert [variant["key"] for variant in seen["legs"][0]["variants"]] == ["plan", "baseline"]
        assert "the plan: holds" in say(studio, "run", window="one")["sentence"]
        _, directory = studio._plans["one"]
        assert MORE["campaign"](directory, n=2)["sentence"].startswith(
            "2 runs in the engine, drawn from the ranges: the pl"
        )
        path = urlsplit(studio.url).path
        page = asked(studio, "GET", f"{path}report/one")[1].decode()
        assert "2 of 2" in page
        assert "by one of" in page
        assert b"arms of Universal Robots" in asked(studio, "GET", f"{path}urscript/one")[1]
        bag = zipfile.ZipFile(io.BytesIO(asked(studio, "GET", f"{path}ros2/one")[1]))
        assert "motion_bag/metadata.yaml" in bag.namelist()
        assert asked(studio, "GET", f"{path}docx/one")[0] == 404


@pytest.mark.slow
def test_a_task_of_several_legs_is_planned_run_and_reported_in_a_window(tmp_path):
    with Studio(ROUND, tmp_path / "round.toml", SCENARIO_DIR) as studio:
        found = say(studio, "plan", text=ROUND, window="one")
        assert found["ok"], found
        assert sum(leg["end"] for leg in found["legs"]) == pytest.approx(found["duration"], abs=1e-4)
        assert found["verdict"][2].startswith("Not checked: what happens at the stops while objects are taken off")
        seen = say(studio, "run", window="one")
        assert seen["sentence"].endswith("leg 1: holds; leg 2: holds; leg 3: holds.")
        path = urlsplit(studio.url).path + "report/one/report"
        links = asked(studio, "GET", f"{path}.html")[1].decode()
        for k in (1, 2, 3):
            assert f"report-leg{k}.html" in links
            assert asked(studio, "GET", f"{path}-leg{k}.html")[0] == 200
        assert asked(studio, "GET", f"{path}-leg4.html")[0] == 404
        assert asked(studio, "GET", f"{path}-leg1.html/../plan.json")[0] == 404


@pytest.mark.slow
def test_a_plan_that_is_no_motion_of_the_arm_is_told_and_not_played(tmp_path):
    text = changed(CUBE, [(["motion", "duration"], 0.4)])
    with Studio(text, tmp_path / "cube.toml", tmp_path) as studio:
        found = say(studio, "plan", text=text, window="one")
        assert (found["ok"], [variant["key"] for variant in found["legs"][0]["variants"]]) == (False, ["baseline"])
        level, head, detail = found["verdict"]
        assert (level, head) == ("bad", "No safe motion was found.")
        assert "No reference of this degree and duration is safe" in detail
        assert detail.endswith("Shown is the straight line.")
        page = urlsplit(studio.url).path
        assert b"is not written as if it were safe" in asked(studio, "GET", page + "csv/one")[1]


@pytest.mark.parametrize("name", ["panda-coffee", "panda-tall-bottle"])
def test_the_edge_that_is_run_lies_within_the_ranges(name):
    from salver.studio.planner import _edge

    uncertain = sv.load_scenario(name).uncertain
    found = _edge(uncertain)
    assert found["friction"] == pytest.approx(uncertain.nominal[uncertain.names.index("friction")] * 0.9)
    away = (np.array(list(found.values())) - uncertain.nominal) / uncertain.half_range
    assert np.abs(away).max() == pytest.approx(1.0)
    assert {name for name, x in zip(found, away, strict=True) if x < 0} <= {"friction", "damping"}


@pytest.mark.parametrize("name", names())
def test_a_body_can_have_the_values_of_the_edge_that_is_run(name):
    from salver.studio.planner import _edge

    scenario = sv.load_scenario(name)
    for leg in scenario.each_leg:
        true_world(leg, _edge(leg.uncertain))


@pytest.mark.slow
def test_a_newer_task_ends_the_one_before(tmp_path):
    coffee, found = (SCENARIO_DIR / "panda-coffee.toml").read_text(), []
    with Studio(CUBE, tmp_path / "cube.toml", tmp_path) as studio:
        slow = threading.Thread(target=lambda: found.append(say(studio, "plan", text=coffee, window="one")))
        slow.start()
        time.sleep(1.0)
        assert say(studio, "plan", text=CUBE, window="one")["ok"] is not None
        slow.join(60)
    assert found == [{"ended": True}]


@pytest.mark.slow
def test_a_process_that_plans_may_die_and_another_one_goes_on(tmp_path):
    with Studio(CUBE, tmp_path / "cube.toml", tmp_path) as studio:
        assert say(studio, "plan", text=CUBE, window="one")["duration"] == 2.5
        studio._planners["one"]._running[0].kill()
        studio._planners["one"]._running[0].wait()
        assert say(studio, "plan", text=CUBE, window="one")["duration"] == 2.5
        found = []
        coffee = (SCENARIO_DIR / "panda-coffee.toml").read_text()
        slow = threading.Thread(target=lambda: found.append(say(studio, "plan", text=coffee, window="one")))
        slow.start()
        time.sleep(0.5)
        studio._planners["one"]._running[0].kill()
        slow.join(60)
        assert "died" in found[0]["sentence"]


@pytest.mark.parametrize(("every", "kept"), [((True, True), ""), ((True, False), " at full speed")])
def test_legs_of_which_one_holds_at_full_speed_only_are_said_to_hold_at_full_speed(every, kept):
    legs = [SimpleNamespace(arm_status=None, speeds=SimpleNamespace(every=one)) for one in every]
    status = SimpleNamespace(sentence="Found.")
    plan = SimpleNamespace(ok=True, duration=1.25, unchecked=(), status=status, legs=legs)
    assert planned(plan, []) == ("", f"1.250 s, safe in the worst case{kept}.", "Found.")
