"""The studio: a text that is changed by hand keeps its comments, says what is wrong at its line, and is planned as the
command plans it; the page in a real browser."""

import base64
import http.client
import io
import json
import threading
import time
import tomllib
import zipfile
from itertools import pairwise
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
from typer.testing import CliRunner

import salver as sv
from browser import chromium, missing
from salver.cli import app
from salver.cli.plans.studio import begun
from salver.errors import ScenarioError
from salver.models.arm.arm import load_arm
from salver.scenario import SCENARIO_DIR, names, parse
from salver.simulation.scene.loads import true_world
from salver.studio.live_mode import LiveMode
from salver.studio.look import change, look
from salver.studio.parts import LOADS, OBSTACLES, parts, poses
from salver.studio.planner import MORE
from salver.studio.server import Studio
from salver.studio.text import changed, checked

CUBE = (SCENARIO_DIR / "panda-cube.toml").read_text()


def shown(text, **more):
    return look(text, SCENARIO_DIR, **more)


# --- the text


@pytest.mark.parametrize("name", names())
def test_a_change_keeps_all_other_lines_of_every_scenario(name):
    text = (SCENARIO_DIR / f"{name}.toml").read_text()
    want = tomllib.loads(text)
    want["motion"]["start"]["position"] = [0.1, 0.2, 0.3]
    want["objects"][0]["mass"] = 0.77
    found = changed(text, [(["motion", "start", "position"], [0.1, 0.2, 0.3]), (["objects", 0, "mass"], 0.77)])
    assert tomllib.loads(found) == want
    assert len(found.splitlines()) == len(text.splitlines())
    new = [one for one, other in zip(found.splitlines(), text.splitlines(), strict=True) if one != other]
    assert len(new) == 2
    assert changed(found, []) == found


def test_a_comment_behind_a_value_stays_and_a_key_that_goes_takes_its_line_alone():
    text = "# first\n[motion]  # a task\nduration = 1.5    # s\nnodes = 61  # many\n"
    assert changed(text, [(["motion", "duration"], 2.0)]) == text.replace("1.5", "2.0")
    assert changed(text, [(["motion", "duration"], None)]) == "# first\n[motion]  # a task\nnodes = 61  # many\n"
    assert changed(text, [(["motion", "degree"], None)]) == text


def test_objects_and_obstacles_come_and_go():
    there = CUBE
    for k, load in enumerate(LOADS.values(), 1):
        there = change(there, SCENARIO_DIR, [(["objects", k], {"name": f"load{k}", "at": [0.0, 0.0], **load})])
    for k, obstacle in enumerate(OBSTACLES.values()):
        there = change(there, SCENARIO_DIR, [(["obstacles", k], obstacle)])
    data = tomllib.loads(there)
    lines = there.splitlines()
    assert all(not above.strip() or above[0] == "#" for above, line in pairwise(lines) if line[:1] == "[")
    assert [item["shape"]["type"] for item in data["objects"][1:]] == ["box", "cylinder", "cylinder"]
    assert [item["type"] for item in data["obstacles"]] == list(OBSTACLES)
    for key in (["objects", 3], ["objects", 2], ["objects", 1], ["obstacles", 1], ["obstacles", 0]):
        there = change(there, SCENARIO_DIR, [(key, None)])
    assert tomllib.loads(there) == tomllib.loads(CUBE)


@pytest.mark.parametrize(
    ("old", "new", "line", "words"),
    [
        ("mass = 0.256", "mass = -1", "mass = -1", "objects[0].mass = -1: must be"),
        ("mass = 0.256", "mass = 0.256\nmas = 1", "mas = 1", "unknown key objects[0].mas"),
        ("friction = 0.5", "friction = ", "friction = ", "not valid TOML"),
        ('name = "cube"', 'name = "cube"\nat = [0.5, 0.0]', 'name = "cube"', "cube stands 420.0 mm over the edge"),
        ('model = "panda"', 'model = "pandy"', 'model = "pandy"', '"pandy" is not known'),
        ("friction = 0.5\n", "", 'name = "cube"', "objects[0].friction is missing"),
    ],
)
def test_what_is_wrong_is_told_at_its_line(old, new, line, words):
    text = CUBE.replace(old, new, 1)
    assert text != CUBE
    (mistake,) = shown(text)["mistakes"]
    assert words in mistake["sentence"]
    assert text.splitlines()[mistake["line"] - 1].strip() == line.strip()


def test_a_text_that_cannot_be_changed_is_refused_with_a_sentence():
    for text, key in (("a = [", ["a"]), ("a = 1", ["a", "b"]), ("a = [1]", ["a", 5])):
        with pytest.raises(ScenarioError, match="cannot be changed there"):
            change(text, SCENARIO_DIR, [(key, 1.0)])
    for key, value in (
        (["objects", 0, "at"], "left"),
        (["objects", 9, "uncertainty", "mass"], "5%"),
        (["objects", 0], None),
    ):
        with pytest.raises(ScenarioError, match="no such change"):
            change(CUBE, SCENARIO_DIR, [(key, value)])


def test_ranges_that_were_assumed_are_written_down_before_one_is_changed():
    text = CUBE.replace('[objects.uncertainty]\nmass = "10%"\n', "")
    assert "uncertainty" not in text
    before = checked(text, SCENARIO_DIR).objects[0].uncertainty
    after = checked(change(text, SCENARIO_DIR, [(["objects", 0, "uncertainty", "mass"], "25%")]), SCENARIO_DIR)
    ranges = after.objects[0].uncertainty
    assert ranges.mass.relative == 0.25
    assert (ranges.friction, ranges.com, ranges.position) == (before.friction, before.com, before.position)


# --- what goes with a change


def test_the_start_posture_follows_the_start_and_is_left_out_where_the_arm_cannot():
    moved = [0.5, -0.3, 0.45]
    scenario = checked(change(CUBE, SCENARIO_DIR, [(["motion", "start", "position"], moved)]), SCENARIO_DIR)
    arm, body = load_arm(scenario.arm, scenario.tray), scenario.payload.first
    p, _ = arm.object_pose(np.array(scenario.arm.start_posture), body.p_EB, body.R_EB)
    np.testing.assert_allclose(p, moved, atol=1e-4)
    away = change(CUBE, SCENARIO_DIR, [(["motion", "start", "position"], [2.0, 0.0, 0.4])])
    assert "start_posture" not in away
    assert "start_posture" not in change(CUBE, SCENARIO_DIR, [(["arm", "model"], "ur10")])


@pytest.mark.parametrize("against", ["", "-x"])
def test_the_first_object_moves_on_a_tray_that_stays(against):
    """Against the rim it moves along the wall alone."""

    def tray(text):
        scenario = checked(text, SCENARIO_DIR)
        first = scenario.payload.first
        return [
            np.array(pose.position) - pose.rotation @ first.R_EB.T @ first.p_EB
            for pose in (scenario.motion.start, scenario.motion.goal)
        ]

    text = (SCENARIO_DIR / "panda-cube-yaw.toml").read_text()
    if against:
        text = changed(text, [(["tray", "rim"], {"height": 0.02}), (["objects", 0, "against"], against)])
    np.testing.assert_allclose(
        tray(change(text, SCENARIO_DIR, [(["objects", 0, "at"], [0.03, -0.02])])), tray(text), atol=1e-5
    )


def test_the_flange_is_dragged_under_a_tray_that_stays_with_its_load():
    text = changed(CUBE, [(["tray", "rpy_deg"], [10.0, -20.0, 30.0])])
    held_E = [0.03, -0.02, -0.09]
    after = change(text, SCENARIO_DIR, [(["tray", "flange"], held_E)])
    scenario = checked(after, SCENARIO_DIR)
    arm, body = load_arm(scenario.arm, scenario.tray), scenario.payload.first
    np.testing.assert_allclose(-arm.R_FE.T @ arm.p_FE, held_E, atol=2e-6)
    (tray,) = (part for part in parts(scenario) if part["name"] == "tray")
    np.testing.assert_allclose(tray["handle"]["at"], held_E, atol=2e-6)
    p, _ = arm.object_pose(np.array(scenario.arm.start_posture), body.p_EB, body.R_EB)
    np.testing.assert_allclose(p, scenario.motion.start.position, atol=1e-4)  # the arm has followed
    assert tomllib.loads(after)["motion"] == tomllib.loads(text)["motion"]
    with pytest.raises(ScenarioError, match="no such change"):
        change(CUBE.replace("mass = 0.256", "mass = -1", 1), SCENARIO_DIR, [(["tray", "flange"], held_E)])


def test_the_first_object_goes_and_the_tray_stays():
    text = (SCENARIO_DIR / "panda-four-glasses.toml").read_text()
    after = change(text, SCENARIO_DIR, [(["objects", 0], None)])
    trays = []
    for scenario in (checked(text, SCENARIO_DIR), checked(after, SCENARIO_DIR)):
        trays.append(np.array(scenario.motion.goal.position) - scenario.payload.first.p_EB)  # level, heading along S
    assert [item.name for item in scenario.objects] == ["glass2", "glass3", "glass4"]
    np.testing.assert_allclose(trays[1], trays[0], atol=1e-5)


@pytest.mark.slow
def test_every_slider_of_every_scenario_puts_its_own_value_back():
    """A key that is not where the value came from would change something else, or nothing."""
    for name in ("panda-coffee", "ur5-bottle", "upright-box"):
        text = (SCENARIO_DIR / f"{name}.toml").read_text()
        before = sv.load_scenario(name)
        for part in parts(before):
            for field in part["fields"]:
                if field.get("zero") and field["value"] == 0:
                    continue
                value = field.get("whole") or (f"{field['value']}%" if field.get("percent") else field["value"])
                after = checked(changed(text, [(field["key"], value)]), SCENARIO_DIR)
                assert not isinstance(after, list), (name, field, after)
                uncertain = before.uncertain
                assert after.uncertain.names == uncertain.names, field
                np.testing.assert_allclose(after.uncertain.half_range, uncertain.half_range, rtol=1e-4)
                one, other = before.model_dump(), after.model_dump()
                for end in ("start", "goal"):  # no turn may be written down as one of 0
                    assert (
                        one["motion"][end].pop("rpy_deg") == other["motion"][end].pop("rpy_deg")
                        or "turn" in field["label"]
                    )
                for task in (one, other):
                    for item in task["objects"]:
                        item.pop("uncertainty")
                assert one == other, field


# --- what is known at once


@pytest.mark.slow
def test_the_straight_line_holds_from_its_shortest_duration_on():
    """Against the plan of the straight line itself, which has its own check."""
    from salver.planning.make import plan_baseline

    for name in ("panda-tall-bottle", "panda-coffee"):
        scenario = sv.load_scenario(name)
        line = shown((SCENARIO_DIR / f"{name}.toml").read_text())["line"]
        for factor, holds in ((0.99, False), (1.03, True)):
            duration = factor * line["shortest"]
            plan = plan_baseline(scenario.with_changes(motion__duration=duration, motion__speeds="full"))
            assert plan.ok == holds, (name, factor, plan.verification.sentence)


@pytest.mark.slow
def test_what_touches_and_what_is_out_of_reach_is_named():
    away = shown(change(CUBE, SCENARIO_DIR, [(["motion", "goal", "position"], [2.0, 0.0, 0.4])]))
    assert away["blocked"].startswith("No posture within the joint limits reaches the goal")
    goal = sv.load_scenario("panda-cube").motion.goal.position
    hit = shown(
        changed(
            CUBE, [(["obstacles", 0], {"type": "box", "name": "wall", "size": [0.1, 0.1, 0.1], "position": list(goal)})]
        )
    )
    assert "wall" in hit["blocked"]
    assert "wall" in hit["scene"]["variants"][1]["red"]
    assert hit["scene"]["variants"][0]["red"] == []
    assert shown(CUBE)["blocked"] == ""


def test_the_links_of_an_arm_are_sent_once_and_the_posture_follows():
    first = shown(CUBE)
    again = shown(CUBE, near=first["posture"], arm_drawn=first["arm"])
    assert "meshes" in first["scene"]
    assert "meshes" not in again["scene"]
    np.testing.assert_allclose(again["posture"], first["posture"], atol=1e-6)


def test_a_page_that_draws_without_a_graphics_card_gets_a_third_of_the_triangles():
    def count(**how):
        return sum(len(base64.b64decode(mesh["triangles"])) // 6 for mesh in shown(CUBE, **how)["scene"]["meshes"])

    assert 1000 < count(coarse=True) < count() / 3


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


def test_what_has_no_known_shape_is_not_said_to_touch_nothing(tmp_path):
    """A gantry without shapes, whose tray and load are clear, and a wall through its links."""
    names = ["x", "y", "z", "yaw", "pitch", "roll"]
    solid = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    links = "".join(
        f'<link name="{name}">{solid}</link><joint name="j{name}" type="{"prismatic" if k < 3 else "revolute"}">'
        f'<parent link="{(["base", *names])[k]}"/><child link="{name}"/><axis xyz="{axis}"/>'
        '<limit lower="-2" upper="2" velocity="3" effort="500"/></joint>'
        for k, (name, axis) in enumerate(
            zip(names, ["1 0 0", "0 1 0", "0 0 1", "0 0 1", "0 1 0", "1 0 0"], strict=True)
        )
    )
    (tmp_path / "gantry.urdf").write_text(f'<robot name="gantry"><link name="base"/>{links}</robot>')
    text = """
    name = "gantry"
    arm = { model = "gantry.urdf", flange = "roll", collisions = "unchecked" }
    motion = { start = { position = [0.5, -0.2, 0.5] }, goal = { position = [0.5, 0.2, 0.5] } }
    obstacles = [{ type = "box", name = "wall", size = [0.05, 1.0, 0.1], position = [0.2, 0.0, 0.4] }]
    [[objects]]
    name = "cube"
    shape = { type = "box", size = [0.05, 0.05, 0.05] }
    mass = 0.3
    friction = 0.4
    """
    level, head, detail = look(text, tmp_path)["verdict"]
    assert (level, head) == ("", "The arm reaches both ends, and nothing that is checked touches there.")
    assert "whether x, y, z, yaw, pitch and roll hit anything" in detail.split(". ")[0]


# --- the page


def asked(studio, method, path, body=None, host=None):
    place = urlsplit(studio.url)
    line = http.client.HTTPConnection(place.hostname, place.port, timeout=120)
    line.request(method, path, body, {"Host": host} if host else {})
    answer = line.getresponse()
    return answer.status, answer.read()


def say(studio, do, **more):
    status, answer = asked(studio, "POST", urlsplit(studio.url).path + "say", json.dumps({"do": do, **more}).encode())
    assert status == 200
    return json.loads(answer)


def test_the_page_is_for_who_knows_its_address_on_this_machine_alone(tmp_path):
    with Studio(CUBE, tmp_path / "cube.toml", tmp_path) as studio:
        place = urlsplit(studio.url)
        assert place.hostname == "127.0.0.1"
        status, page = asked(studio, "GET", place.path)
        assert status == 200
        assert b"http://" not in page.replace(b"http://www.w3.org", b"")
        for path, host in (
            ("/", None),
            ("/wrong/", None),
            (place.path, "evil.example:80"),
            (place.path + "report/x", None),
        ):
            assert asked(studio, "GET", path, host=host)[0] == 404
        assert asked(studio, "POST", "/wrong/say", b"{}")[0] == 404
        for wrong in (
            7,
            [],
            {},
            {"do": "dance"},
            {"do": "look", "text": CUBE, "changes": [7]},
            {"do": "look", "text": CUBE, "near": 5},
        ):
            answer = json.loads(asked(studio, "POST", place.path + "say", json.dumps(wrong).encode())[1])
            assert answer["problem"].endswith(".")
        assert "kB" in say(studio, "look", text="#" * 300_000)["problem"]
        assert asked(studio, "POST", place.path + "say", b"{")[0] == 400
        assert asked(studio, "POST", place.path + "say", b"[" * 9000)[0] == 400
        assert asked(studio, "POST", place.path + "say", b"x" * 500_000)[0] == 413


def test_a_file_that_somebody_else_has_changed_is_not_written_over(tmp_path):
    file = tmp_path / "cube.toml"
    with Studio(CUBE, file, tmp_path) as studio:
        one, other = CUBE + "\n# one", CUBE + "\n# other"
        assert say(studio, "save", text=CUBE)["saved"] == str(file)
        assert say(studio, "save", text=one, over=CUBE)["saved"]
        for over in (CUBE, None):  # another window, which has not seen that
            assert "has changed" in say(studio, "save", text=other, over=over)["problem"]
        assert file.read_text() == one
        assert say(studio, "save", text=one)["saved"]  # it says what it would say
        file.write_bytes(b"\xff\xfe")
        assert "has changed" in say(studio, "save", text=other, over=one)["problem"]
        file.write_text(one)
        file.chmod(0o444)
        assert "may not be written" in say(studio, "save", text=other, over=one)["problem"]
        assert file.read_text() == one


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
def test_the_live_mode_of_a_window_is_its_own_and_ends_when_nobody_watches_it(tmp_path):
    with Studio(CUBE, tmp_path / "cube.toml", SCENARIO_DIR, true={"mass": 0.25}) as studio:
        assert "Line" in say(studio, "live", text=CUBE.replace("mass = 0.256", "mass = -1", 1), window="one")["problem"]
        assert "There is no message" in say(studio, "hand", window="one", say={"stop": True})["problem"]
        frame = say(studio, "live", text=CUBE, window="one")["frame"]
        assert frame["verdict"][1] == "The arm rests."
        assert not say(studio, "hand", window="one", say={"goto": [9, 9]})["ok"]
        place = urlsplit(studio.url)
        line = http.client.HTTPConnection(place.hostname, place.port, timeout=60)
        line.request("GET", place.path + "frames/one")
        answer = line.getresponse()
        first = json.loads(answer.readline().removeprefix(b"data: "))
        assert say(studio, "hand", window="one", say={"twist": [0.0, 0.1, 0.0, 0.0]})["ok"]
        assert asked(studio, "GET", place.path + "frames/two")[0] == 404
        for _ in range(40):
            frame = json.loads(answer.readline().removeprefix(b"data: ")) if answer.readline() else frame
        assert frame["t"] > first["t"]
        answer.close()
        line.close()
        end = time.monotonic() + 60
        while studio.lives:
            assert time.monotonic() < end
            time.sleep(0.05)


@pytest.mark.slow
def test_the_same_hand_keeps_the_load_of_one_arm_and_loses_that_of_the_other(tmp_path):
    live = LiveMode(sv.load_scenario("panda-tall-bottle"), {"com_z": 0.003}, tmp_path)
    try:
        frame = live.frame()
        assert [(title, line) for title, line, _ in frame["names"]] == [("salver", ""), ("without protection", "")]
        for k in range(80):
            assert live.say({"twist": [0.0, 0.4 * (-1) ** (k // 10), 0.0, 0.0]}).ok  # to and fro
            for _ in range(round(0.02 / live.world.period)):
                live.world.advance()
            time.sleep(0.01)  # for the planner
            frame = live.frame()
            if frame["beside"][0]["gone"]:
                break
        (kept, lost), (beside,) = frame["names"], frame["beside"]
        since = live.world.t - live._moved
        assert kept[1] == f"In place for {since:.1f} s."
        assert beside["load"][0]["became"] == "fallen"
        assert lost[1] == f"The bottle has fallen over, lost {since:.1f} s after the hand's first move."
        assert "a what-if" in lost[2]
        assert "lost 1 ×" in lost[2]
        assert beside["t"] + live._later == pytest.approx(live.world.t, abs=2 * live.world.period)
        assert live.say({"again": True}).ok
        again = live.frame()
        assert [line for _, line, _ in again["names"]] == ["", ""]
        assert "lost 1 ×" in again["names"][1][2]  # the score goes on
        np.testing.assert_allclose(again["beside"][0]["tray"], again["tray"], atol=1e-3)
        assert live.say({"beside": False}).ok
        assert live.frame()["beside"] == []
    finally:
        live.close()


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


ROUND = (SCENARIO_DIR / "waiters-round.toml").read_text()


def test_each_leg_is_shown_with_the_load_that_it_carries():
    for k, carried in enumerate((["glass1", "glass2", "glass3"], ["glass2", "glass3"], ["glass3"])):
        seen = shown(ROUND, leg=k)
        assert seen["legs"] == [3, k]
        assert [item["name"] for item in seen["scene"]["objects"]] == carried
        start, goal, *_ = seen["parts"]
        assert start["key"] == (["legs", k - 1, "goal"] if k else ["motion", "start"])
        assert goal["key"] == ["legs", k, "goal"]
        held = [part["name"] for part in seen["parts"] if part["key"][0] == "objects" and "handle" in part]
        assert held == carried
        assert "does not hold below" in seen["line"]["sentence"]
    assert shown(ROUND, leg=9)["legs"] == [3, 2]  # another window has taken legs away
    assert shown(CUBE, leg=2)["legs"] == [0, 0]


def test_via_poses_are_dragged_and_all_poses_follow_the_first_object_on_a_tray_that_stays():
    via = [{"position": [0.5, -0.1, 0.5]}, {"position": [0.48, 0.0, 0.55]}]
    text = changed(CUBE, [(["motion", "duration"], None), (["motion", "through"], via), (["plan"], None)])
    names_of = [part["name"] for part in parts(checked(text, SCENARIO_DIR)) if part["key"][0] == "motion"]
    assert names_of == ["start", "via 1", "via 2", "goal", "motion"]
    for before in (text, ROUND):
        was = poses(checked(before, SCENARIO_DIR))
        at = checked(before, SCENARIO_DIR).objects[0].at
        after = change(before, SCENARIO_DIR, [(["objects", 0, "at"], np.add(at, [0.012, -0.007]).tolist())])
        now = poses(checked(after, SCENARIO_DIR))
        assert len(was) == len(now) == 4
        for (_, key, one), (_, other_key, other) in zip(was, now, strict=True):
            assert key == other_key
            R_SE = one.rotation @ checked(before, SCENARIO_DIR).bodies[0].R_EB.T
            np.testing.assert_allclose(np.subtract(other.position, one.position), R_SE @ [0.012, -0.007, 0], atol=2e-6)


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


def test_the_command_says_what_it_cannot_begin_with(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text, place, _, saved = begun("bottle.toml")
    assert (place, saved) == (Path("bottle.toml"), False)
    assert parse(tomllib.loads(text), "it").name == "bottle"
    assert begun("panda-cube")[:2] == (CUBE, Path("panda-cube.toml"))
    (tmp_path / "broken.toml").write_text("a = [")
    assert begun("broken.toml")[0] == "a = ["  # the page shows what is wrong
    with pytest.raises(ScenarioError, match="did you mean panda-cube"):
        begun("panda-cubee")
    (tmp_path / "odd.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(ScenarioError, match="UTF-8"):
        begun("odd.toml")
    (tmp_path / "big.toml").write_bytes(b"# " * 5_000_000)
    with pytest.raises(ScenarioError, match="is larger than 200 kB"):
        begun("big.toml")


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


def opened(browser, url, more="true"):
    """The page in the present window of a browser."""
    browser.call("POST", "url", {"url": url})
    browser.wait_for(f"window.salver && salver.state.answer && salver.state.idle() && {more}", 120)


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
    with Studio(ROUND, tmp_path / "round.toml", SCENARIO_DIR) as studio, chromium(1400, 900) as browser:
        opened(browser, studio.url)
        browser.script("document.getElementById('follow').click(); designing()")
        pick(browser, "#leg", "leg 2")
        assert browser.script("return salver.state.viewer.variants[0].objects.length") == 2 * 7
        drag(browser, "goal", 30, 10)
        was, now = tomllib.loads(ROUND)["legs"], tomllib.loads(browser.script("return salver.state.text"))["legs"]
        assert now[1]["goal"]["position"] != was[1]["goal"]["position"]
        assert (now[0], now[2]) == (was[0], was[2])
        assert browser.script("return document.getElementById('leg').value") == "1"
        assert [entry for entry in browser.log("browser") if entry["level"] == "SEVERE"] == []
