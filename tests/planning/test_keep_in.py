"""The keep-in box: links, tray and load stay inside, in plans and live; distances are those worked out by hand."""

import coal
import numpy as np
import pinocchio as pin
import pytest

import salver as sv
from live_runs import PATIENCE, drive, in_turn, said
from salver.errors import ScenarioError, UnreachableError
from salver.geometry import matrix_from_rpy
from salver.live import Live
from salver.planning.fastest import transport_problem

CEILING = 0.615  # m; the fastest motion without it reaches 0.629 m with link 4
ROOM = {"position": (0.1, 0.0, CEILING - 0.6), "size": (2.0, 2.0, 1.2)}


def corners(parts, q):
    """Corners (N, 3), m in S, of everything that moves, by name, in a posture."""
    pin.updateGeometryPlacements(parts.arm.pin_model, parts.arm.data, parts.model, parts.data, q)
    found = {}
    for k, part in enumerate(parts.model.geometryObjects):
        if part.parentJoint == 0:
            continue
        if isinstance(part.geometry, coal.Box):
            half = np.asarray(part.geometry.halfSide).ravel()
            points = np.stack(np.meshgrid(*([-x, x] for x in half)), axis=-1).reshape(-1, 3)
        else:
            points = np.asarray(part.geometry.points())
        placed = parts.data.oMg[k]
        found[f"{parts.names[k]} {k}"] = points @ placed.rotation.T + placed.translation
    return found


def highest(scenario, postures):
    parts = transport_problem(scenario).keep_out.parts
    return max(points[:, 2].max() for q in postures for points in corners(parts, q).values())


@pytest.fixture(scope="module")
def room(cube):
    return cube.with_changes(motion__duration=None, surroundings__keep_in=ROOM)


def test_distances_are_those_of_the_corners_from_the_faces_of_a_turned_box(cube):
    turns, position, size = (10.0, -5.0, 25.0), (0.1, 0.05, 0.3), (2.0, 1.9, 1.8)
    box = {"position": position, "size": size, "rpy_deg": turns}
    parts = transport_problem(cube.with_changes(surroundings__keep_in=box)).keep_out.parts
    problem = transport_problem(cube)
    q, R = problem.start.q + 0.1, matrix_from_rpy(np.deg2rad(turns))
    away = {}
    for (i, j), distance in zip(parts.pairs, parts.clearance(q[None])[0], strict=True):
        if parts.names[j] == "keep-in box":
            away.setdefault(f"{parts.names[i]} {i}", []).append(distance)
    assert len(away) >= 8
    for name, points in corners(problem.keep_out.parts, q).items():
        inside = 0.5 * np.array(size) - np.abs((points - position) @ R)
        if name in away:
            assert min(away[name]) == pytest.approx(inside.min(), abs=1e-6)


def test_the_fastest_motion_stays_inside(cube, room):
    free, kept = (sv.fastest(scenario) for scenario in (cube.with_changes(motion__duration=None), room))
    postures = [plan.joint.sample(np.linspace(0.0, plan.duration, 40))[0] for plan in (free, kept)]
    assert highest(cube, postures[0]) > CEILING + 0.01
    assert kept.ok
    assert highest(cube, postures[1]) < CEILING - 0.004
    assert "the keep-in box and the floor" in kept.verdict


def test_a_plan_without_the_arm_says_that_it_did_not_look_at_the_box(cube):
    said = [
        sv.plan(cube.with_changes(surroundings=around), arm=False).unchecked
        for around in ({"floor": "none"}, {"floor": "none", "keep_in": ROOM})
    ]
    assert [any("hits an obstacle" in each for each in one) for one in said] == [False, True]


def test_live_motions_stay_inside(cube, room):
    up = said(lambda t: np.array([0.0, 0.1, 0.5]), 0.8)
    reached = {}
    for name, scenario in (("free", cube), ("room", room)):
        live = Live(scenario, lead=0.02)
        q = in_turn(drive(live, 0.8, up), drive(live, 0.6, begins=0.8)).q
        reached[name] = highest(cube, q[::40])
    assert reached["free"] > CEILING + 0.02
    assert CEILING - 0.03 < reached["room"] < CEILING - 0.004


def test_a_goal_outside_is_not_gone_to(room):
    live = Live(room, lead=0.1)
    live.goto((0.5, 0.0, CEILING + 0.1))
    for _ in range(6):
        live.plan(PATIENCE)
    assert live.committed.at_rest
    assert live.state.requests[-1].outcome == "dropped"


def test_another_box_is_believed_while_the_arm_rests(cube, room):
    live = Live(cube, lead=0.1)
    assert live.load(room)
    live.goto((0.5, 0.0, CEILING + 0.1))
    for _ in range(6):
        live.plan(PATIENCE)
    assert live.committed.at_rest
    low = {"position": (0.1, 0.0, -0.2), "size": (2.0, 2.0, 1.2)}
    assert "keep-in box" in live.load(room.with_changes(surroundings__keep_in=low)).sentence


def test_a_pose_outside_and_links_that_cannot_be_inside_are_said(cube):
    def said_of(**box):
        return sv.fastest(cube.with_changes(motion__duration=None, surroundings__keep_in=box))

    with pytest.raises(UnreachableError, match="At the goal the tray is outside the keep-in box"):
        said_of(position=(0.3, -0.35, 0.4), size=(1.4, 1.0, 1.2))
    with pytest.raises(UnreachableError, match="In the start posture panda_link5 is not inside the keep-in box"):
        said_of(position=(0.3, 0.0, 0.4), size=(1.4, 0.6, 1.2))
    with pytest.raises(ScenarioError, match="panda_link1 is outside the keep-in box in every posture"):
        said_of(position=(0.5, 0.0, 0.5), size=(0.6, 1.5, 1.0))
