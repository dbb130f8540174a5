"""What the page shows of a text at once, before anything is planned."""

import base64

import numpy as np
import pytest

import salver as sv
from salver.scenario import SCENARIO_DIR
from salver.studio.look import change, look
from salver.studio.text import changed
from studio_windows import CUBE, ROUND, shown


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
