"""What a motion does, said in one line: against figures that were put in by hand."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from salver import scenario
from salver.cli import app
from salver.errors import Status
from salver.geometry import exp
from salver.planning.extent import extent
from salver.planning.make import make_plan
from salver.scenario import Cylinder
from salver.trajectory import MotionSamples

X, Z = np.eye(3)[0], np.eye(3)[2]
AT_B = exp(np.array([0.3, -0.2, 0.7]))  # how the object lies on the tray


def turned(lean_deg: float, heading_deg: float, sign: float) -> MotionSamples:
    """A motion from a heading of 30 deg to heading_deg away from that, half way leaning; 0.2 m up and down between ends
    of which one is 0.1 m higher, at 1.5 m/s at most."""
    s = np.linspace(0.0, 1.0, 101)

    headings = np.deg2rad(30.0) + sign * np.deg2rad(heading_deg) * s
    leans = np.deg2rad(lean_deg) * np.sin(np.pi * s)
    R = np.array([exp(h * Z) @ exp(a * X) @ AT_B for h, a in zip(headings, leans, strict=True)])
    z = 0.4 + 0.1 * s + 0.2 * np.sin(2 * np.pi * s) ** 3
    none = np.zeros((101, 3))
    v = np.stack([-sign * 1.5 * np.sin(np.pi * s), 0 * s, 0 * s], axis=1)
    return MotionSamples(s, np.stack([0 * s, 0 * s, z], axis=1), v, none, R, none, none)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_lean_turn_rise_and_speed_are_those_of_the_tray_however_the_object_stands_on_it(sign: float) -> None:
    found = extent(turned(19.0, 215.0, sign), AT_B, None)
    assert np.rad2deg(found.lean) == pytest.approx(19.0, abs=1e-6)
    assert np.rad2deg(found.turn) == pytest.approx(215.0, abs=0.5), "over half a turn, and not seen by the object"
    z = turned(19.0, 215.0, sign).p_SB[:, 2]
    assert found.rise == pytest.approx(z.max() - 0.5)
    assert found.sink == pytest.approx(0.4 - z.min())
    assert min(found.rise, found.sink) > 0.1
    assert found.speed == pytest.approx(1.5)
    assert found.sentence == (
        f"The tray leans by up to 19.0 deg, turns by up to 215.0 deg, rises {found.rise:.2f} m above its ends, sinks "
        f"{found.sink:.2f} m below its ends and moves at up to 1.50 m/s."
    )


def test_the_nearest_thing_is_that_which_stands_around() -> None:
    near = {"first": "elbow", "second": "shelf", "time": 0.52, "distance": 0.0836}
    own = {"first": "wrist_1", "second": "wrist_3", "time": 0.1, "distance": 0.014}
    found = extent(turned(0.0, 0.0, 1.0), AT_B, Status("x", "", True, {"obstacle_clearance": near, "clearance": own}))
    assert found.sentence.startswith("The tray stays level, keeps its heading, rises")
    assert found.sentence.endswith("moves at up to 1.50 m/s; elbow passes shelf at 84 mm (t = 0.52 s).")
    assert extent(turned(0.0, 0.0, 1.0), AT_B, Status("x", "", True, {"clearance": own})).nearest is None


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_an_open_cup_needs_the_room_that_a_still_surface_takes_on_the_leaning_accelerated_tray(sign: float) -> None:
    """By hand: on a tray that leans by 10 deg about the direction of its acceleration of 3 m/s^2, the specific force is
    inclined by both. One that leans into its acceleration needs none."""
    lean, still = np.deg2rad(10.0), np.zeros((2, 3))
    along = exp(0.7 * Z) @ exp(sign * lean * X)
    acceleration = sign * 3.0 * along[:, 0]
    samples = MotionSamples(
        np.arange(2.0), still, still, np.tile(acceleration, (2, 1)), np.array([along @ AT_B] * 2), still, still
    )
    slope = np.hypot(3.0, 9.81 * np.sin(lean)) / (9.81 * np.cos(lean))
    found = extent(samples, AT_B, None, 0.04)
    assert found.brim == pytest.approx(0.04 * slope)
    assert found.sentence.endswith(
        ". An open cup would spill if it were filled to less than 14 mm below its brim, sloshing not counted."
    )

    into = exp(0.7 * Z) @ exp(-sign * np.arctan(3.0 / 9.81) * X)
    sideways = sign * 3.0 * exp(0.7 * Z)[:, 1]
    leaning = MotionSamples(
        np.arange(2.0), still, still, np.tile(sideways, (2, 1)), np.array([into @ AT_B] * 2), still, still
    )
    assert extent(leaning, AT_B, None, 0.04).brim == pytest.approx(0.0, abs=1e-12)
    assert extent(leaning, AT_B, None).brim is None

    drops = replace(samples, a_S=np.array([acceleration, [0.0, 0.0, -12.0]]))  # nothing holds a liquid in it then
    assert extent(drops, AT_B, None, 0.04).brim is None


def test_the_widest_cylinder_without_a_liquid_is_the_cup() -> None:
    assert make_plan(scenario.load("ur10-bottle").with_changes(arm=None)).extent.brim is not None
    assert make_plan(scenario.load("panda-cube").with_changes(arm=None)).extent.brim is None


def test_the_brim_of_a_cone_without_a_liquid_is_at_its_top() -> None:
    plan = make_plan(scenario.load("ur10-bottle").with_changes(arm=None))
    shape = plan.scenario.objects[0].shape
    assert isinstance(shape, Cylinder)
    cone = {"type": "cone", "radius": shape.radius, "top_radius": 1.5 * shape.radius, "height": shape.height}
    wider = replace(plan, scenario=plan.scenario.with_changes(objects__0__shape=cone))
    assert plan.extent.brim
    assert wider.extent.brim == pytest.approx(1.5 * plan.extent.brim)


@pytest.mark.slow
def test_plan_page_and_json_say_it_alike(tmp_path: Path) -> None:
    """Of a plan in one place: the text of the command, its JSON, plan.json and the page."""
    box = {"type": "box", "name": "shelf", "size": [0.2, 0.2, 0.2], "position": [0.0, 0.9, 0.4]}
    case = scenario.load("panda-cube-yaw").with_changes(obstacles=[box])
    plan = make_plan(case)
    assert plan.extent.nearest is not None
    plan.save(tmp_path)
    assert json.loads((tmp_path / "plan.json").read_text())["extent"]["sentence"] == plan.extent.sentence
    CliRunner().invoke(app, ["report", str(tmp_path)])
    assert plan.extent.sentence in (tmp_path / "report.html").read_text()
    said = CliRunner().invoke(app, ["plan", str(tmp_path / "scenario.toml"), "-o", str(tmp_path / "again")]).output
    assert " ".join(plan.extent.sentence.split()) in " ".join(said.split())
