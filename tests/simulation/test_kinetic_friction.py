"""Kinetic friction in the engine: what slips a little runs away, what does not slip is not affected."""

from __future__ import annotations

import numpy as np
import pytest

from salver.geometry import exp
from salver.scenario import Scenario, load
from salver.simulation.physics import simulate_tray
from salver.simulation.scene.engine import mujoco
from salver.simulation.scene.sliding import Sliding
from salver.trajectory import min_jerk_line

G, FRICTION = 9.81, 0.5
LIMIT = np.arctan(FRICTION)


def cube(share: float) -> Scenario:
    return load("panda-cube").with_changes(physics__kinetic_friction=share, physics__settle_after=0.3)


def moved(length: float, share: float, tilt: float):
    """A tray that leans by `tilt`, rad, about y, and makes a line across and down of 0.4 s; the cube's true friction
    is 0.5."""
    way = exp(np.array([0.0, 0.0, 0.3])) @ [length, 0.0, 0.0]
    line = min_jerk_line(0.4, np.zeros(3), way, np.eye(3), np.eye(3))
    return simulate_tray(line, cube(share), {"friction": FRICTION, "tilt_y": tilt})


def test_a_sliding_cube_accelerates_by_its_kinetic_friction() -> None:
    angle = np.arctan(0.2) + np.deg2rad(1.0)
    line = min_jerk_line(0.4, np.zeros(3), np.zeros(3), np.eye(3), np.eye(3))
    found = simulate_tray(line, cube(0.6), {"friction": 0.2, "tilt_y": angle})
    t, way = found.t, found.slip[:, 0]
    late = (way > 5e-3) & (way < 0.05)  # later it rocks
    bend = 2 * np.polyfit(t[late], way[late], 2)[0]
    assert bend == pytest.approx(G * (np.sin(angle) - 0.6 * 0.2 * np.cos(angle)), rel=0.03)


def test_a_cube_that_slips_a_little_runs_away_when_it_slides_more_easily() -> None:
    """One degree below the friction angle, a push that moves it by less than the engine counts as a slip."""
    little, more = (moved(0.006, share, LIMIT - np.deg2rad(1.0)) for share in (1.0, 0.7))
    assert little.outcome == "holds"
    assert 2e-5 < little.slip.max() < 5e-4
    assert more.outcome in ("slides", "tips")
    assert more.slip.max() > 100 * little.slip.max()


def test_a_cube_that_never_slips_is_not_affected() -> None:
    one, other = (moved(0.005, share, LIMIT - np.deg2rad(2.0)) for share in (1.0, 0.3))
    assert one.outcome == "holds"
    assert np.array_equal(one.slip, other.slip)


TURNTABLE = """
<mujoco>
  <worldbody>
    <body name="table" pos="0.3 0.2 0"><freejoint/><geom name="table" type="box" size=".2 .2 .01" mass="1"/></body>
    <body name="box" pos="0.4 0.25 0.02"><freejoint/><geom name="box" type="box" size=".03 .02 .01" mass="1"/></body>
  </worldbody>
  <contact><pair geom1="box" geom2="table" friction="0.5 0.5 0.01 0.001 0.001"/></contact>
</mujoco>
"""


@pytest.mark.parametrize(("turned_along", "friction"), [(True, 0.5), (False, 0.3)])
def test_a_box_that_a_turntable_takes_along_does_not_slide(turned_along: bool, friction: float) -> None:
    model = mujoco.MjModel.from_xml_string(TURNTABLE)
    data, turn = mujoco.MjData(model), np.array([0.0, 0.0, 1.5])
    data.qvel[3:6] = turn
    if turned_along:
        data.qvel[6:9], data.qvel[9:12] = np.cross(turn, [0.1, 0.05, 0.02]), turn
    mujoco.mj_forward(model, data)
    assert data.ncon == 4
    Sliding.of(model, 0.6).apply(model, data)
    assert model.pair_friction[0, 0] == pytest.approx(friction)


@pytest.mark.parametrize("corner", [(0.03, 0.02), (-0.03, 0.02), (-0.03, -0.02), (0.03, -0.02)])
def test_a_box_that_turns_about_one_corner_slides_at_the_others(corner: tuple[float, float]) -> None:
    """One pair of geoms has four contacts; their order does not matter."""
    model = mujoco.MjModel.from_xml_string(TURNTABLE)
    data, turn = mujoco.MjData(model), np.array([0.0, 0.0, 1.5])
    data.qvel[6:9], data.qvel[9:12] = -np.cross(turn, [*corner, 0.0]), turn
    mujoco.mj_forward(model, data)
    assert data.ncon == 4
    Sliding.of(model, 0.6).apply(model, data)
    assert model.pair_friction[0, 0] == pytest.approx(0.3)
