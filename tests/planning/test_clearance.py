"""What comes near the arm: between samples too, obstacles of every shape, ends where nothing can stand."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from arm_motions import REST, turn
from salver import scenario
from salver.errors import ScenarioError, UnreachableError
from salver.models.arm.arm import load_arm
from salver.models.arm.arm_geometry import arm_geometry
from salver.models.shapes.obstacle_shapes import obstacle_shapes
from salver.models.shapes.surfaces import surface
from salver.planning.fastest import FastestOptions, fastest, transport_problem
from salver.planning.follow.clearance import sweep
from salver.planning.follow.limits import verdict
from salver.planning.make import make_plan
from salver.planning.seeds.around import FreeSpace
from salver.planning.seeds.blocked import why_blocked, why_roundabout, why_touching, why_unreached
from salver.planning.seeds.starts import Ends, _stray_at_rest, ends, guess, room
from salver.planning.trajopt.ends import AtPose
from salver.planning.trajopt.watch import Watch
from salver.reports.pages import charts
from salver.reports.pages.meshes import obstacle_meshes
from salver.reports.run import read_run
from salver.simulation.scene.loads import true_world
from salver.simulation.scene.scene import build
from salver.trajectory import JointMotion

TRAY = scenario.Tray()


# ---- between samples ------------------------------------------------------------------------------------------


def test_nothing_passes_between_two_instants() -> None:
    """A thin wall that the tray goes through within a hundredth of a turn, far from any of the first instants."""
    arm = load_arm(scenario.Arm(model="ur5"), scenario.Tray())
    motion = turn(REST, 0, 2.0)
    middle = arm.tray_pose(motion.sample([0.4871])[0][0])[0]
    yaw = float(np.rad2deg(motion.sample([0.4871])[0][0, 0]))
    wall = scenario.Obstacle(
        type="box", name="foil", size=(0.02, 0.001, 0.02), position=tuple(middle), rpy_deg=(0, 0, yaw)
    )
    found = sweep(arm_geometry(arm, [], [wall]), motion)
    assert found.touch is not None
    assert {found.touch.first, found.touch.second} & {"foil"}
    assert not verdict(arm, motion, parts=arm_geometry(arm, [], [wall])).ok


def test_there_and_back_between_two_instants_is_seen() -> None:
    """A tray that touches a post with its edge and is back before the next of the first instants, which are 32 apart:
    two equal distances say no more than that it went against the post for half of its way. Behind it there is something
    nearer, so that what comes no nearer than that is of no interest."""
    arm = load_arm(scenario.Arm(model="ur5"), TRAY)
    stretched = np.array([0.0, -0.1, 0.1, 0.0, 0.1, 0.0])  # so that the bound on its way is nearly the way
    t, q = np.array([0.0, 16, 16.5, 17, 32]) / 32, np.tile(stretched, (5, 1))
    q[2, 0] += 0.1
    motion = JointMotion(t, q, np.zeros_like(q), np.zeros_like(q))
    (here, R_here), (there, R) = arm.tray_pose(stretched), arm.tray_pose(q[2])
    ahead = (there - here) / np.linalg.norm(there - here)
    half = 0.5 * np.array([*TRAY.size, TRAY.thickness])
    corner, behind = (
        place + turn @ (side * half * np.sign(turn.T @ ahead) - [0, 0, half[2]]) + side * away * ahead
        for place, turn, side, away in ((there, R, 1, 0.0), (here, R_here, -1, 0.012))
    )
    wall = scenario.Obstacle(type="sphere", name="wall", radius=0.01, position=tuple(behind))
    for beyond, touches in ((-0.001, True), (0.0005, False)):
        centre = corner + (0.01 + beyond) * ahead
        post = scenario.Obstacle(type="sphere", name="post", radius=0.01, position=tuple(centre))
        parts = arm_geometry(arm, [], [wall, post])
        pair = parts.pairs.index((parts.names.index("tray"), parts.names.index("post")))
        before, at = parts.clearance(np.array([stretched, q[2]]))[:, pair]
        assert before > 0.03
        assert at == pytest.approx(beyond, abs=2e-4)  # the tray turns a little on its way
        found = sweep(parts, motion)
        assert found.obstacle.distance == pytest.approx(min(0.002, beyond), abs=2e-4)
        assert (found.touch is not None) == touches, found
        if touches:
            assert found.touch.time == pytest.approx(16.5 / 32, abs=0.2 / 32)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_the_least_clearance_is_never_above_a_dense_search(seed: int) -> None:
    """Random turns and posts: what a thousand samples find is found, and what is called clear is clear there."""
    rng = np.random.default_rng(seed)
    arm = load_arm(scenario.Arm(model="ur5"), scenario.Tray())
    ends = np.stack([REST, REST + rng.uniform(-1.0, 1.0, 6)])
    motion = JointMotion(np.array([0.0, 1.0]), ends, np.zeros_like(ends), np.zeros_like(ends))
    post = scenario.Obstacle(type="cylinder", radius=0.03, height=1.0, position=(*rng.uniform(0.2, 0.7, 2), 0.5))
    parts = arm_geometry(arm, [], [post])
    found = sweep(parts, motion)
    dense = parts.clearance(motion.sample(np.linspace(0, 1, 1001))[0]).min()
    if found.touch is None:
        assert dense > 0
        assert found.nearest is not None
        assert found.nearest.distance <= dense + 1.1e-3
        assert found.nearest.distance >= dense - 1e-5
    else:
        assert dense < 1e-3


@pytest.mark.parametrize("arm", ["panda", "ur5"])
def test_distances_that_are_asked_for_up_to_a_bound_are_exact_below_it_and_never_too_long(arm: str) -> None:
    """A path on which pairs come near and part again, more often than distances are taken."""
    parts = arm_geometry(load_arm(scenario.Arm(model=arm), TRAY))
    u, rng = np.linspace(0, 1, 45)[:, None], np.random.default_rng(5)
    limits = parts.arm.limits
    ends = np.clip(rng.uniform(-1.5, 1.5, (2, parts.arm.n)), limits.q_min, limits.q_max)
    q = ends[0] + u * (ends[1] - ends[0]) + 0.2 * np.sin(25 * u)
    exact, bounded = parts.clearance(q), parts.clearance(q, 0.06)
    near = exact < 0.06
    assert near.any()
    assert not near.all()
    assert np.abs(bounded - exact)[near].max() < 2e-6  # Coal's own tolerance is 1e-6
    assert (bounded - exact).max() < 2e-6
    assert bounded[~near].min() > 0.06 - 2e-6
    # A bound for each pair; and, of the pairs that come near, on a path beside that one.
    bounds = np.linspace(0.01, 0.1, len(parts.pairs))
    each = parts.apart().clearance(q, bounds)
    assert np.abs(each - exact)[exact < bounds].max() < 2e-6
    assert (each - exact).max() < 2e-6
    watched, beside = parts.near(q, 0.06), q + rng.uniform(-0.02, 0.02, q.shape)
    pairs = [parts.pairs.index(pair) for pair in watched.pairs]
    assert pairs == np.flatnonzero(near.any(axis=0)).tolist()
    exact, bounded = parts.apart().clearance(beside)[:, pairs], watched.clearance(beside, 0.06)
    assert np.abs(bounded - exact)[exact < 0.06].max() < 2e-6
    assert (bounded - exact).max() < 2e-6


def test_travel_bounds_what_joints_do_and_is_near_it() -> None:
    rng = np.random.default_rng(0)
    t = np.sort(np.concatenate([[0.0, 1.0], rng.uniform(0, 1, 6)]))
    motion = JointMotion(t, *(rng.normal(size=(3, 8, 2)) * np.array([1.0, 5.0, 50.0])[:, None, None]))
    at = np.linspace(0, 1, 13)
    dense = np.linspace(0, 1, 120001)
    gone = np.vstack([np.zeros(2), np.cumsum(np.abs(np.diff(motion.sample(dense)[0], axis=0)), axis=0)])
    true = np.diff(gone[np.searchsorted(dense, at)], axis=0)
    bound = np.diff(motion.travel(at), axis=0)
    assert (bound >= true - 1e-3).all()
    monotone = turn(np.zeros(6), 2, 1.5)
    assert monotone.travel(np.array([1.0]))[0] == pytest.approx([0, 0, 1.5, 0, 0, 0], abs=1e-12)


OVERHEAD = {"type": "sphere", "name": "lamp", "radius": 0.05, "position": (0.5, 0.0, 1.2)}


def test_the_curve_of_clearance_is_of_the_plan(tmp_path: Path) -> None:
    cube = scenario.load("panda-cube").with_changes(obstacles=[OVERHEAD], surroundings__floor="none")
    plan = make_plan(cube)
    plan.save(tmp_path)
    run = read_run(tmp_path)
    arm = load_arm(cube.arm, cube.tray)  # type: ignore[arg-type]
    whole, lamp = charts.clearance_charts(run, arm)
    assert lamp["title"] == "Clearance from lamp"
    assert plan.arm_status is not None
    for chart, key in ((whole, "clearance"), (lamp, "obstacle_clearance")):
        least = plan.arm_status.details[key]["distance"]
        assert min(chart["series"][0]["y"]) == pytest.approx(1e3 * least, abs=2.0)
        assert min(chart["series"][0]["y"]) > 0
    assert plan.arm_status.details["obstacle_clearance"]["second"] == "lamp"


@pytest.mark.parametrize(
    ("shape", "lengths", "volume"),
    [
        ({"type": "box", "size": (0.2, 0.3, 0.4)}, (0.2, 0.3, 0.4), 0.024),
        ({"type": "sphere", "radius": 0.1}, (0.2, 0.2, 0.2), 4 / 3 * np.pi * 1e-3),
        ({"type": "capsule", "radius": 0.1, "length": 0.5}, (0.2, 0.2, 0.7), np.pi * 1e-2 * 0.5 + 4 / 3 * np.pi * 1e-3),
        ({"type": "cylinder", "radius": 0.1, "height": 0.5}, (0.2, 0.2, 0.5), np.pi * 1e-2 * 0.5),
    ],
)
def test_obstacles_are_drawn_as_large_as_they_are(shape: dict, lengths: tuple, volume: float) -> None:
    """Turned by 90 degrees about x: what was along z is along -y. Round ones lose a little to their facets."""
    obstacle = scenario.Obstacle(name="it", position=(1, 2, 3), rpy_deg=(90, 0, 0), **shape)
    (mesh,) = obstacle_meshes([obstacle])
    assert mesh.vertices.max(axis=0) + mesh.vertices.min(axis=0) == pytest.approx([2, 4, 6], abs=1e-9)
    x, y, z = lengths
    assert np.ptp(mesh.vertices, axis=0) == pytest.approx([x, z, y], rel=0.02)
    a, b, c = (mesh.vertices[mesh.triangles[:, k]] - [1, 2, 3] for k in range(3))
    inside = float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum()) / 6
    assert 0.96 * volume < inside < 1.001 * volume  # positive: triangles are counter-clockwise from outside


def test_a_mesh_counts_as_the_hulls_of_its_pieces(tmp_path: Path) -> None:
    """Two boards 0.3 m apart: between them it is free, in each it is not, in the engine and for the planner."""
    import trimesh

    board = trimesh.creation.box((0.4, 0.4, 0.02))
    upper = board.copy()
    upper.apply_translation((0, 0, 0.3))
    trimesh.util.concatenate([board, upper]).export(tmp_path / "shelf.stl")
    shelf = scenario.Obstacle(
        type="mesh", name="shelf", file=str(tmp_path / "shelf.stl"), scale=2.0, position=(1.0, 0, 0.5)
    )
    pieces = obstacle_shapes(shelf)
    assert len(pieces) == 2
    lows, highs = zip(*((s.min(axis=0), s.max(axis=0)) for s in (surface(*p)[0] for p in pieces)), strict=True)
    assert np.sort(np.array(lows)[:, 2]) == pytest.approx([0.48, 1.08])
    assert np.sort(np.array(highs)[:, 2]) == pytest.approx([0.52, 1.12])
    cube = scenario.load("panda-cube")
    model = build(
        cube.with_changes(obstacles=[shelf.model_dump(exclude_none=True)]),
        true_world(cube, {}),
        load_arm(cube.arm, cube.tray),
    ).model
    geoms = [model.geom(i) for i in range(model.ngeom) if model.geom(i).name.startswith("salver:obstacle:0")]
    assert len(geoms) == 2
    assert np.sort([g.pos[2] for g in geoms]) == pytest.approx([0.5, 1.1], abs=1e-6)


TETRAHEDRON = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"


@pytest.mark.parametrize(
    ("content", "words_"),
    [
        (None, "cannot be read"),
        (b"hello", "holds no triangles"),
        (b"solid x\nendsolid x\n", "holds no triangles"),
        (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "has 3 corners"),
        (b"v 0 0 0\nv nan 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\n", "not finite"),
        # A tetrahedron and a triangle more: without that the obstacle would be less than it is.
        (TETRAHEDRON + b"v inf 0 0\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\nf 2 3 5\n", "not finite"),
    ],
)
def test_bad_meshes_of_obstacles(tmp_path: Path, content: bytes | None, words_: str) -> None:
    path = tmp_path / ("it.obj" if content and content.startswith(b"v") else "it.stl")
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ScenarioError) as refused:
        obstacle_shapes(scenario.Obstacle(type="mesh", name="it", file=str(path), position=(0, 0, 0)))
    message = str(refused.value)
    assert message.startswith("The obstacle it: its file ")
    assert words_ in message, message
    assert "\n" not in message


def test_a_box_with_a_normal_for_each_face_is_one_piece(tmp_path: Path) -> None:
    """As modellers write it: every corner three times, once for each face, with its normal."""
    import trimesh

    box = trimesh.creation.box((0.2, 0.2, 0.2))
    lines = [f"v {x} {y} {z}" for x, y, z in box.vertices] + [f"vn {x} {y} {z}" for x, y, z in box.face_normals]
    lines += [f"f {a + 1}//{k + 1} {b + 1}//{k + 1} {c + 1}//{k + 1}" for k, (a, b, c) in enumerate(box.faces)]
    (tmp_path / "box.obj").write_text("\n".join(lines))
    open_box = "\n".join(lines[:-2])  # one side open: still one piece, and its hull is closed
    (tmp_path / "open.obj").write_text(open_box)
    for name in ("box.obj", "open.obj"):
        pieces = obstacle_shapes(scenario.Obstacle(type="mesh", file=str(tmp_path / name), position=(0, 0, 0)))
        assert len(pieces) == 1, name
        assert np.ptp(surface(*pieces[0])[0], axis=0) == pytest.approx([0.2, 0.2, 0.2])


# ---- ends that cannot be ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("end", ["start", "goal"])
@pytest.mark.parametrize(("height", "part"), [(-0.02, "tray"), (0.0, "cube")])
def test_an_obstacle_inside_the_tray_or_its_load_at_an_end(end: str, height: float, part: str) -> None:
    """A ball of 10 mm about the cube's centre, or 20 mm below it, in the tray: told by both planners, at once."""
    cube = scenario.load("panda-cube").with_changes(motion__goal_yaw="fixed", arm__start_posture=None)
    x, y, z = getattr(cube.motion, end).position
    ball = {"type": "sphere", "name": "ball", "radius": 0.01, "position": (x, y, z + height)}
    if part == "tray":
        ball["position"] = (x + 0.08, y, z + height)  # beside the cube
    blocked = cube.with_changes(obstacles=[ball])
    told = f"At the {end} the {part} is inside the obstacle ball; move one of them."
    plan = make_plan(blocked)
    assert plan.arm_status is not None
    assert not plan.ok
    assert plan.arm_status.sentence == told
    with pytest.raises(UnreachableError, match=re.escape(told)):
        make_plan(blocked, "fastest")


def test_a_goal_that_is_blocked_whichever_way_the_tray_points_is_told_at_once() -> None:
    """A ball within the cube, about whose centre the tray turns; one beside the cube is left by turning away."""
    cube = scenario.load("panda-cube").with_changes(motion__goal_yaw="free")
    x, y, z = cube.motion.goal.position
    ball = {"type": "sphere", "name": "ball", "radius": 0.01, "position": (x, y, z)}
    told = (
        "At the goal the cube is inside the obstacle ball whichever way it points (at 36 headings); move one of them."
    )
    with pytest.raises(UnreachableError, match=re.escape(told)):
        make_plan(cube.with_changes(obstacles=[ball]), "fastest")
    first = cube.payload.first
    corner = 0.5 * np.hypot(*cube.tray.size) - 0.01  # from the tray's middle: within at the heading that was given only
    place = np.array((x, y, z)) - first.p_EB + (corner / np.sqrt(2), corner / np.sqrt(2), -0.01)
    problem = transport_problem(cube.with_changes(obstacles=[{**ball, "radius": 0.002, "position": tuple(place)}]))
    assert problem.keep_out is not None
    assert isinstance(problem.goal, AtPose)
    assert problem.keep_out.parts.in_the_way(*problem.goal.target.tray_pose) == ("tray", "ball")
    assert why_blocked(problem) is None


def test_a_load_that_does_not_stay_even_at_rest_is_told_at_once() -> None:
    """A bottle of 30 mm radius whose centre of mass is known to 40 mm; to 20 mm it stays, as it does on a polygon of
    eight points, 27 mm from its middle at least."""
    bottle = scenario.load("panda-tall-bottle").with_changes(motion__duration=None)
    for off, falls in ((0.04, True), (0.02, False)):
        problem = transport_problem(bottle.with_changes(objects__0__uncertainty={"com": [0.0, off, 0.0]}))
        assert (why_blocked(problem) is not None) == falls
        if falls:
            told = "At the start bottle cannot stay even at rest: in the worst case contact lacks "
            assert fastest(problem).status.sentence.startswith(told)


def test_an_end_that_no_posture_reaches_without_a_collision_is_told_where_no_pair_of_postures_was_found() -> None:
    """A ball under the tray at the goal, where the arm's last link must be; start and goal alone are within reach."""
    cube = scenario.load("panda-cube").with_changes(motion__goal_yaw="fixed", arm__start_posture=None)
    x, y, z = cube.motion.goal.position
    ball = {"type": "sphere", "name": "ball", "radius": 0.07, "position": (x, y, z - 0.13)}
    why = why_unreached(transport_problem(cube.with_changes(obstacles=[ball])))
    told = r"No posture was found at the goal in which nothing touches: panda_\w+ and ball touch in the best"
    assert re.match(told, why.sentence)


def beside_the_goal(cube: scenario.Scenario, gap: float) -> scenario.Scenario:
    """The cube with a ball of 3 cm beside the tray at the goal, at a distance in m."""
    p_SE, R_SE = transport_problem(cube).goal.target.tray_pose  # type: ignore[union-attr]
    centre = np.array([0.5 * cube.tray.size[0] + 0.03 + gap, 0.0, -0.5 * cube.tray.thickness])
    ball = {"type": "sphere", "name": "ball", "radius": 0.03, "position": tuple(p_SE + R_SE @ centre)}
    return cube.with_changes(obstacles=[ball])


@pytest.mark.parametrize("gap", [1e-3, 3e-3, 5.2e-3, 0.03])  # m; plans ask for 5 mm
def test_a_way_around_begins_and_ends_however_narrow_it_is_there(gap: float) -> None:
    cube = scenario.load("panda-cube").with_changes(motion__goal_yaw="fixed", arm__start_posture=None)
    problem = transport_problem(beside_the_goal(cube, gap))
    pair = ends(problem, np.random.default_rng(0), few=1)[0]
    space = FreeSpace.between(problem, np.stack([pair.start, pair.goal]), 10)
    assert space.nearest(pair.start) is not None
    assert space.nearest(pair.goal) is not None


def test_an_end_that_is_nearer_to_an_obstacle_than_the_arm_strays_there_is_refused_before_the_search() -> None:
    """A ball beside the tray at the goal, at 0.4 times and at 4 times the tracking error of the arm at rest there."""
    cube = scenario.load("panda-cube").with_changes(motion__goal_yaw="fixed", arm__start_posture=None)
    free = transport_problem(cube)
    stray = _stray_at_rest(free, ends(free, np.random.default_rng(0), few=1)[0].goal)
    for share, blocked in ((0.4, True), (4.0, False)):
        problem = transport_problem(beside_the_goal(cube, share * stray))
        why = why_touching(problem, ends(problem, np.random.default_rng(0), few=1))
        assert (why is not None) == blocked
        if why is not None:
            told = r"No posture was found at the goal in which nothing touches: tray and ball are [\d.]+ mm apart in "
            told += r"the best, where the arm strays by [\d.]+ mm; 0.05 m higher one was found\."
            assert re.fullmatch(told, why.sentence)


def test_an_end_that_is_free_in_one_of_the_postures_is_not_said_to_be_blocked() -> None:
    """Also where another pair of postures overlaps less, but at that end."""
    problem = transport_problem(scenario.load("panda-cube").with_changes(arm__start_posture=None))
    rng = np.random.default_rng(0)
    postures = sorted((guess(problem, rng, k) for k in range(1, 200)), key=lambda q: room(problem, q))
    deep, free = postures[0], postures[-1]
    slight = max((q for q in postures if room(problem, q) < 0.0), key=lambda q: room(problem, q))
    assert room(problem, deep) < room(problem, slight) < 0.0 < room(problem, free)
    both = Ends(slight, slight, 1.0, False)
    for pair, where in ((Ends(free, deep, 1.0, False), "goal"), (Ends(deep, free, 1.0, False), "start")):
        why = why_touching(problem, [pair, both])
        assert why is not None
        assert why.sentence.startswith(f"No posture was found at the {where} in which nothing touches")


@pytest.mark.slow
def test_what_touches_in_every_posture_at_an_end_is_told() -> None:
    """A ball under the tray at the goal, where the arm's last link must be."""
    cube = scenario.load("panda-cube").with_changes(motion__goal_yaw="fixed", arm__start_posture=None)
    x, y, z = cube.motion.goal.position
    ball = {"type": "sphere", "name": "ball", "radius": 0.07, "position": (x, y, z - 0.13)}
    found = fastest(transport_problem(cube.with_changes(obstacles=[ball])), FastestOptions(spans=8, pairs=1))
    assert not found.status.ok
    told = r"No posture was found at the goal in which nothing touches: panda_\w+ and ball touch in the best; 0.2 m .+"
    assert re.fullmatch(told, found.status.sentence)


def test_what_keeps_the_arm_from_the_nearest_posture_at_the_goal_is_told_with_a_motion_that_was_not_found() -> None:
    """A ball where the forearm would be at the goal and one in the way; no time is left to turn over around it."""
    bottle = scenario.load("ur5-bottle").with_changes(motion__duration=None, surroundings__floor=-1.0)
    free = transport_problem(bottle)
    pair = ends(free, np.random.default_rng(0), few=1)[0]
    assert why_roundabout(free, pair) == ""
    free.arm.tray_pose(pair.goal)
    forearm = 0.5 * (free.arm.data.oMi[3].translation + free.arm.data.oMi[4].translation)
    ball = {"type": "sphere", "name": "ball", "radius": 0.05, "position": tuple(forearm)}
    blocked = bottle.with_changes(obstacles=[ball], arm__start_posture=tuple(pair.start))
    turned_over = ends(transport_problem(blocked), np.random.default_rng(0))
    for k, other in enumerate(turned_over):
        halfway = free.arm.tray_pose(0.5 * (other.start + other.goal))[0]
        ball = {"type": "sphere", "name": f"ball{k}", "radius": 0.05, "position": tuple(halfway)}
        blocked = blocked.with_changes(obstacles=[*blocked.obstacles, ball])
    found = fastest(transport_problem(blocked), watch=Watch(time_limit=0.0))
    assert not found.status.ok
    assert found.status.sentence.endswith(
        " The motions that were tried end in another posture, since forearm_link and ball touch in the goal posture "
        "that is nearest to the start's."
    )


def test_a_tray_beside_an_obstacle_is_not_inside_it() -> None:
    """By hand: a wall a millimetre beyond the tray's edge at the start, and one a millimetre within."""
    cube = scenario.load("panda-cube")
    arm = load_arm(cube.arm, cube.tray)  # type: ignore[arg-type]
    x, y, z = cube.motion.start.position
    for gap, found in ((1e-3, None), (-1e-3, ("tray", "wall"))):
        place = (x, y - 0.5 * cube.tray.size[1] - gap - 0.05, z - 0.02)
        wall = scenario.Obstacle(type="box", name="wall", size=(0.5, 0.1, 0.5), position=place)
        parts = arm_geometry(arm, cube.payload.bodies, [wall])
        body = cube.payload.first
        assert parts.in_the_way(np.array((x, y, z)) - body.p_EB, np.eye(3)) == found
