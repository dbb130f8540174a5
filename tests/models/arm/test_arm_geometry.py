"""The shapes of an arm, its tray and its load, by hand: where they are, how far apart, how fast that may change."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from salver import scenario
from salver.models.arm.arm import ArmModel, load_arm
from salver.models.arm.arm_geometry import ArmGeometry, arm_geometry
from salver.models.shapes.surfaces import surface

CRANE = """<robot name="crane">
  <link name="base"><collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision></link>
  <link name="mast"/>
  <link name="hook"><collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision></link>
  <joint name="turn" type="revolute"><parent link="base"/><child link="mast"/><axis xyz="0 0 1"/>
    <limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
  <joint name="reach" type="prismatic"><parent link="mast"/><child link="hook"/><axis xyz="1 0 0"/>
    <limit lower="0" upper="1" effort="1" velocity="1"/></joint>
</robot>"""


def crane(tmp_path: Path, tray: scenario.Tray, **keys: object) -> ArmModel:
    path = tmp_path / "crane.urdf"
    path.write_text(CRANE)
    return load_arm(scenario.Arm(model=str(path), flange="hook", **keys), tray)


def test_clearance_by_hand(tmp_path: Path) -> None:
    """Two cubes of 0.1 m, 0.3 m apart between centres: 0.2 m; turned by 45 degrees one shows its edge,
    0.1 sqrt(2) / 2 from its centre. The tray, 0.5 m above the hook, is 0.445 m above the base's top."""
    tray = scenario.Tray(height=0.5, thickness=0.01, size=(0.2, 0.2))
    parts = arm_geometry(crane(tmp_path, tray, base_position=(1, 2, 3), base_rpy_deg=(0, 0, 20)))
    assert parts.names == ("base", "hook", "tray")
    assert parts.pairs == ((0, 1), (0, 2))
    q = np.array([[0.0, 0.3], [np.pi / 4, 0.3], [0.0, 0.06]])
    towards_edge = 0.3 - 0.05 - 0.05 * np.sqrt(2)
    assert parts.clearance(q)[:2, 0] == pytest.approx([0.2, towards_edge], abs=1e-6)
    assert parts.clearance(q)[2] == pytest.approx([-0.04, 0.44], abs=1e-6)
    touch = parts.first_touch(q)
    assert touch is not None
    assert (touch.first, touch.second, touch.index) == ("base", "hook", 2)
    assert parts.near(q[:2], 0.3).pairs == ((0, 1),)


def test_clearance_of_obstacles_by_hand(tmp_path: Path) -> None:
    """A ball, a lying capsule and a turned box above the base: 1 m less what each is thick, less half the cube."""
    arm = crane(tmp_path, scenario.Tray(height=0.5))
    around = [
        scenario.Obstacle(type="sphere", radius=0.1, position=(0.5, 0, 1)),
        scenario.Obstacle(type="capsule", radius=0.1, length=0.4, position=(0.5, 0, -1), rpy_deg=(0, 90, 0)),
        scenario.Obstacle(type="box", size=(0.2, 0.2, 2.0), position=(0.5, 1.3, 0), rpy_deg=(90, 0, 0)),
    ]
    parts = arm_geometry(arm, [], around)
    hook = [k for k, (i, _) in enumerate(parts.pairs) if parts.names[i] == "hook"]
    distances = parts.clearance(np.array([[0.0, 0.5]]))[0, hook]
    assert distances == pytest.approx([0.85, 0.85, 0.25], abs=1e-6)


def test_a_load_is_the_box_around_it_where_it_stands(tmp_path: Path) -> None:
    """Turned by 25 degrees, on the tray, and its centre of mass is not its middle: its eight corners by hand."""
    tray, angle = scenario.Tray(height=0.5, thickness=0.01), np.deg2rad(25.0)
    item = {"name": "box", "shape": {"type": "box", "size": [0.08, 0.06, 0.2]}, "mass": 0.5, "friction": 0.4}
    ends = {"start": {"position": [0, 0, 0]}, "goal": {"position": [1, 0, 0]}, "duration": 1.0}
    placed = {**item, "at": [0.03, -0.02], "yaw_deg": 25.0, "com": [0.004, 0.003, -0.02]}
    made = scenario.parse({"name": "test", "motion": ends, "objects": [placed]}, "test")
    arm = crane(tmp_path, tray)
    parts = arm_geometry(arm, made.payload.bodies)
    box = parts.model.geometryObjects[parts.names.index("box")]
    tray_F = arm.pin_model.frames[arm.tray_id].placement
    seen = tray_F.actInv(box.placement)
    corners = surface(box.geometry, seen)[0]
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    flat = np.array([[0.03, -0.02] + turn @ [x, y] for x in (-0.04, 0.04) for y in (-0.03, 0.03)])
    expected = [[*xy, z] for xy in flat for z in (0.0, 0.2)]
    assert len(corners) == 8
    assert all(np.abs(corners - corner).max(axis=1).min() < 1e-9 for corner in expected)


def test_levers_are_the_farthest_that_a_joint_moves_anything(tmp_path: Path) -> None:
    """Of the crane by hand: the hook's corner is half a diagonal from its middle, which is out by as much as it slides;
    the tray's middle is 0.495 m above that."""
    tray = scenario.Tray(height=0.5, thickness=0.01, size=(0.2, 0.2))
    parts = arm_geometry(crane(tmp_path, tray))
    assert parts.pairs == ((0, 1), (0, 2))
    levers = parts.levers(np.array([[0.0, 0.3], [1.0, 0.8]]))
    assert levers[0] == pytest.approx([0.8 + 0.05 * np.sqrt(3), 1.0])
    assert levers[1] == pytest.approx([0.8 + 0.495 + np.sqrt(0.1**2 + 0.1**2 + 0.005**2), 1.0])


def _with_balls(q: np.ndarray) -> ArmGeometry:
    """A UR5 and balls of 5 mm, 2 cm from three corners of its tray in a posture."""
    arm = load_arm(scenario.Arm(model="ur5"), scenario.Tray())
    p, R = arm.tray_pose(q)
    half = 0.5 * np.array(scenario.Tray().size)
    at = [p + R @ [sx * half[0], sy * half[1], 0.025] for sx, sy in ((1, 1), (1, -1), (-1, 1))]
    balls = [
        scenario.Obstacle(type="sphere", name=f"ball{k}", radius=0.005, position=tuple(x)) for k, x in enumerate(at)
    ]
    return arm_geometry(arm, [], balls)


def test_no_distance_changes_faster_than_its_levers_say() -> None:
    q = np.array([0.4, -1.2, 1.5, -0.3, 1.6, 0.3])
    parts, step = _with_balls(q), 1e-3
    levers = parts.levers(q[None])
    moved = np.concatenate([q + step * np.eye(6), q - step * np.eye(6)])
    changed = np.abs(parts.clearance(moved) - parts.clearance(q[None]))
    assert np.all(changed <= step * np.tile(levers.T, (2, 1)) + 2e-6)  # Coal's own tolerance is 1e-6


@pytest.mark.parametrize("path", [[0.8], [-0.8, 0.8, -0.8], [-0.8, -0.8, 0.8, -0.8, -0.8]])
def test_from_one_side_to_the_other_is_a_long_way(path: list[float]) -> None:
    """Joints that go from where they are to as much on the other side: what was far there is near here."""
    here = np.array([0.8, -1.2, 1.5, -0.3, 1.6, 0.0])
    parts = _with_balls(here)
    q = np.outer(path, here) / 0.8
    parts.clearance(-q, 0.06)  # what is remembered when as many are asked for again
    for known in (parts, parts.apart()):
        exact, bounded = parts.clearance(q), known.clearance(q, 0.06)
        near, ball = exact < 0.06, [parts.names[j].startswith("ball") for _, j in parts.pairs]
        assert near[:, ball].any(axis=1).tolist() == [x > 0 for x in path]
        assert np.abs(bounded - exact)[near].max() < 2e-6


def test_pairs_come_near_whatever_was_asked_for_before():
    """On random ways, one after the other, of as many postures and of others: the pairs that are within it."""
    parts = _with_balls(np.array([0.8, -1.2, 1.5, -0.3, 1.6, 0.0]))
    rng = np.random.default_rng(2)
    for k in range(40):
        first = rng.uniform(-1.5, 1.5, 6)
        ways = np.linspace(0, 1, int(rng.integers(2, 40)) if k % 2 else 20)[:, None] * rng.normal(size=6)
        exact = parts.clearance(first + ways)
        found = parts.near(first + ways, 0.06)
        assert found.pairs == tuple(parts.pairs[i] for i in np.flatnonzero(exact.min(axis=0) < 0.06))
        within = exact[:, exact.min(axis=0) < 0.06]
        assert np.abs(found.clearance(first + ways, 0.06) - within)[within < 0.06].max(initial=0.0) < 2e-6


def test_each_pair_alone_comes_near_where_it_does():
    """Ways through the middle, with postures that mirror one another, of one pair at a time and none known before."""
    parts = _with_balls(np.array([0.8, -1.2, 1.5, -0.3, 1.6, 0.0]))
    rng = np.random.default_rng(4)
    for k in range(60):
        way = np.linspace(-1, 1, int(rng.integers(2, 30)))[:, None] * rng.uniform(0.2, 1.6, 6)
        exact = parts.clearance(way)
        pair = int(rng.integers(len(parts.pairs))) if k % 2 else int(np.argmin(exact.min(axis=0)))
        within = exact[:, pair].min() + rng.choice([-0.01, 0.01])
        assert bool(parts.only([pair]).near(way, within).pairs) == bool(exact[:, pair].min() < within)


def test_how_fast_a_distance_changes_by_hand(tmp_path: Path) -> None:
    """Between the face of the hook and a corner of the base, along the boom: reach - .05 - .05 (cos + sin) of the turn.
    Of one posture or of another, in whichever order."""
    parts = arm_geometry(crane(tmp_path, scenario.Tray(height=0.5)))
    q = np.array([[0.1, 0.3], [0.2, 0.4]])
    for nodes in ([1], [0], [1, 0, 1]):
        slopes, turn = parts.clearance_gradient(q, np.array(nodes), np.zeros(len(nodes), dtype=int)), q[nodes, 0]
        assert slopes[:, 0] == pytest.approx(0.05 * (np.sin(turn) - np.cos(turn)), abs=1e-6)
        assert slopes[:, 1] == pytest.approx(1.0, abs=1e-6)
