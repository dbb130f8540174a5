"""A scenario that is changed by hand keeps its comments, says what is wrong at its line, and takes along what follows
from a change."""

import tomllib
from itertools import pairwise

import numpy as np
import pytest

import salver as sv
from salver.errors import ScenarioError
from salver.models.arm.arm import load_arm
from salver.scenario import SCENARIO_DIR, names
from salver.studio.look import change
from salver.studio.parts import LOADS, OBSTACLES, parts, poses
from salver.studio.text import changed, checked
from studio_windows import CUBE, ROUND, shown


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


def test_a_free_heading_and_a_cylinders_height_are_shown():
    post = {"name": "post", "type": "cylinder", "radius": 0.05, "height": 0.3, "position": [0.9, 0.0, 0.15]}
    case = sv.load_scenario("panda-cube", motion__start_yaw="free", obstacles=[post])
    shown = {part["name"]: part for part in parts(case)}
    assert {x["label"]: x["value"] for x in shown["motion"]["lists"]}["heading at the start"] == "free"
    assert {x["label"]: x["value"] for x in shown["post"]["fields"]}["height"] == 0.3


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
