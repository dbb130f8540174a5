"""Where the search for the fastest motion begins, and what may end it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from salver import scenario
from salver.geometry import Array
from salver.models.arm.known_arms import KNOWN_ARMS, robot_file
from salver.planning.fastest import FastestOptions, fastest, transport_problem
from salver.planning.follow.clearance import EXACT, RESOLUTION
from salver.planning.seeds.around import FreeSpace, way_around
from salver.planning.seeds.starts import (
    EndOptions,
    Ends,
    Start,
    _sought,
    between,
    ends,
    open_to,
    straight,
    touches,
)
from salver.planning.trajopt.bound import least_duration
from salver.planning.trajopt.constraints.constraints import Clearance, evaluate
from salver.planning.trajopt.constraints.obstacles import CLEARANCE, KeepOut
from salver.planning.trajopt.ends import AtPose, AtPosture
from salver.planning.trajopt.problem import TransportProblem

POST = {"type": "capsule", "position": [0.55, -0.02, 0.35], "radius": 0.03, "length": 0.7}


@pytest.fixture(scope="module")
def pair(behind_a_post: TransportProblem) -> Ends:
    """The most promising postures at its ends."""
    return ends(behind_a_post, np.random.default_rng(0))[0]


@pytest.fixture(scope="module")
def ways(behind_a_post: TransportProblem, pair: Ends) -> list[Array | None]:
    """Three ways around the post."""
    return [way_around(behind_a_post, [pair.start], [pair.goal], np.random.default_rng(k), 20_000) for k in (0, 2, 5)]


def test_a_leaning_posture_is_put_upright_in_one_step_to_second_order_and_by_the_least(behind_a_post):
    """Leaning by up to some tenths of a radian; other joints turn the tray too, and are left as they are."""
    arm, rng = behind_a_post.arm, np.random.default_rng(12)
    for _ in range(5):
        q = behind_a_post.start_posture + 0.06 * rng.normal(size=7)
        turned = arm.tray_pose(q)[1]
        lean = np.arccos(turned[2, 2])
        found = FreeSpace(behind_a_post, None, lean**2, 1, corrections=2).nearest(q)  # a step, and a look
        assert found is not None
        axis = np.array([-turned[2, 1], turned[2, 0], 0.0])  # about which the tray's normal leans, in E
        least = np.linalg.pinv(arm.body_jacobian(q)[3:5]) @ axis[:2]
        assert np.linalg.norm(found - q) < 1.01 * np.linalg.norm(least) + lean**2


def test_a_way_around_touches_nothing_stays_level_and_is_the_same_for_the_same_seed(behind_a_post, pair, ways):
    problem, (way, other, _) = behind_a_post, ways
    assert touches(problem, straight(pair)) > 0.01
    again = way_around(problem, [pair.start], [pair.goal], np.random.default_rng(0), 20_000)
    assert way is not None
    assert other is not None
    assert np.array_equal(way, again)
    assert len(way) != len(other) or not np.allclose(way, other)
    assert np.array_equal(way[0], pair.start)
    assert np.array_equal(way[-1], pair.goal)
    assert np.linalg.norm(np.diff(way, axis=0), axis=1).max() <= 3 * FreeSpace.step
    assert problem.keep_out.parts.first_touch(way) is None
    lean = max(np.arccos(min(1.0, problem.arm.tray_pose(q)[1][2, 2])) for q in way)
    assert lean <= 2 * FreeSpace.level + 1e-6
    assert np.all(way >= problem.limits.q_min)
    assert np.all(way <= problem.limits.q_max)


def test_no_way_is_found_without_looking_and_none_out_of_an_end_that_touches(behind_a_post, pair):
    problem = behind_a_post
    rng = np.random.default_rng(0)
    assert way_around(problem, [pair.start], [pair.goal], rng, 5) is None
    inside = pair.start + np.linspace(0, 1, 200)[:, None] * (pair.goal - pair.start)
    touch = problem.keep_out.parts.first_touch(inside)
    assert touch is not None
    blocked = inside[touch.index]
    assert way_around(problem, [pair.start], [blocked], rng, 20_000) is None
    assert way_around(problem, [blocked], [pair.goal], rng, 20_000) is None
    way = way_around(problem, [blocked, pair.start], [pair.goal], rng, 20_000)
    assert way is not None
    assert np.array_equal(way[0], pair.start)


def test_ends_that_touch_something_are_slid_free_where_the_arm_can():
    """A post where the elbow is in most postures at the start; all that are begun from are clear, and at the poses."""
    case = scenario.load("panda-cube").with_changes(arm__start_posture=None, motion__duration=None, obstacles=[POST])
    problem = transport_problem(case)
    pairs = ends(problem, np.random.default_rng(1))
    assert pairs
    assert all(pair.free for pair in pairs)
    for pair in pairs:
        assert problem.keep_out.parts.first_touch(np.stack([pair.start, pair.goal])) is None
        for end, q in ((problem.start, pair.start), (problem.goal, pair.goal)):
            assert np.abs(end.residual(problem.arm, q)[0]).max() < 1e-9


@pytest.mark.slow
def test_in_no_two_pairs_of_ends_the_arm_stands_and_moves_alike():
    """An arm with a spherical shoulder and wrist: each posture has three twins with the same elbow. The elbow and the
    wrist, or the time that the joints need, tell the pairs apart."""
    case = scenario.load("panda-cube").with_changes(
        arm__model="gen3", arm__start_posture=None, arm__gains=None, motion__duration=None, objects__0__uncertainty={}
    )
    problem = transport_problem(case)
    pairs = ends(problem, np.random.default_rng(0))
    model, data = problem.arm.pin_model, problem.arm.data

    def joints(q: np.ndarray) -> np.ndarray:
        pin.forwardKinematics(model, data, q)
        return np.array([placement.translation for placement in data.oMi.tolist()])

    assert len(pairs) > 1
    for k, one in enumerate(pairs):
        for other in pairs[:k]:
            apart = max(
                np.abs(joints(a) - joints(b)).max() for a, b in ((one.start, other.start), (one.goal, other.goal))
            )
            assert apart > 0.02 or abs(one.cost - other.cost) > 0.02 * one.cost


def test_a_path_that_tips_the_load_off_is_not_open_and_nor_is_one_through_a_post(behind_a_post, pair):
    problem = behind_a_post
    assert not open_to(problem, straight(pair))
    bare = replace(problem, keep_out=None)
    assert open_to(bare, straight(pair))
    friction = problem.items[0].friction
    for share, is_open in ((0.9, True), (1.1, False)):
        middle = pair.start.copy()
        middle[5] += share * np.arctan(friction)  # the wrist, about an axis that lies level
        lean = np.arccos(problem.arm.tray_pose(middle)[1][2, 2])
        assert lean == pytest.approx(share * np.arctan(friction), abs=0.01)
        assert open_to(bare, Start("nod", np.stack([pair.start, middle, pair.start]))) == is_open


@pytest.mark.slow
def test_where_one_pair_of_postures_has_no_way_another_has():
    """Three balls between start and goal of a tall turn (task 21 of the survey): no way was found between any of the
    most promising postures, and one is found at once from any to any."""
    case = scenario.parse(
        {
            "name": "balls",
            "motion": {
                "start": {"position": [0.2177, 0.3087, 0.4188]},
                "goal": {"position": [0.2139, -0.5032, 0.2907]},
                "goal_yaw": "free",
            },
            "objects": [
                {
                    "shape": {"type": "box", "size": [0.097, 0.097, 0.063]},
                    "mass": 0.3,
                    "friction": 0.29,
                    "uncertainty": "none",
                }
            ],
            "contact": {"condition": "exact"},
            "tray": {"size": [0.18, 0.18], "mass": 0.2, "height": 0.05},
            "obstacles": [
                {"type": "sphere", "radius": 0.04, "position": [0.207, 0.0097, 0.3324]},
                {"type": "sphere", "radius": 0.04, "position": [0.2825, -0.2335, 0.2989]},
                {"type": "sphere", "radius": 0.04, "position": [0.2156, -0.0276, 0.455]},
            ],
            "arm": {"model": "panda"},
        },
        "balls",
    )
    problem = transport_problem(case)
    found = fastest(problem)
    assert found.status.ok
    assert found.duration < 2.3
    q = found.sample(np.linspace(0, found.duration, 800))[0]
    assert problem.keep_out.parts.first_touch(q) is None


def test_an_end_that_is_too_near_keeps_what_it_can(behind_a_post, pair):
    problem = behind_a_post
    there = problem.keep_out.parts.clearance(np.stack([pair.start, pair.goal])).min(axis=0)
    wanted = replace(problem.keep_out, required=there + 1e-3)  # nowhere kept
    kept = between(replace(problem, keep_out=wanted), pair).keep_out
    assert np.all(kept.required + CLEARANCE.at_nodes <= 0.5 * there + 1e-12)
    assert np.all(
        kept.distances(np.stack([pair.start, pair.goal])) >= CLEARANCE.at_nodes
    )  # what the nodes of a programme ask for
    assert np.array_equal(
        between(problem, pair).keep_out.required[there > 0.01], problem.keep_out.required[there > 0.01]
    )


@pytest.mark.slow
def test_nodes_ask_of_an_end_no_more_than_the_tracking_error_leaves_there() -> None:
    """Forearm and tray are 6.7 mm apart at the goal, of which the uncertain load takes 1.2: 1 mm for the motion between
    nodes beside 5 mm was more than is left. All other rows then were violated as much, and a detour of 2.6 s won."""
    ways = ([0.471, -0.3, 0.344], [0.471, 0.3, 0.344])
    case = {
        "name": "near-at-the-goal",
        "arm": {"model": "ur5e"},
        "motion": {"start": {"position": ways[0]}, "goal": {"position": ways[1]}},
        "objects": [{"shape": {"type": "cylinder", "radius": 0.035, "height": 0.12}, "mass": 0.3, "friction": 0.35}],
    }
    problem = transport_problem(scenario.parse(case, "a test"))
    pair = ends(problem, np.random.default_rng(0), few=4)[0]
    problem = between(problem, pair)
    for q in (pair.start, pair.goal):
        z = np.zeros((4, 5, 6))
        z[0] = q
        (clearance,) = evaluate([Clearance(problem.keep_out)], problem.at(np.linspace(0, 1, 5), z, 1.0))
        assert clearance.values.max() < 1e-9
    assert fastest(problem).duration < 1.05


def test_where_an_end_is_very_near_nothing_may_touch_all_the_same(behind_a_post, pair):
    """A quarter of a millimetre is left at an end: a programme asks for half of it, the check for so much that a look
    at the whole motion, 0.1 mm exact in the way of two parts and 0.01 mm in distances, finds no touch."""
    problem = behind_a_post
    parts = problem.keep_out.parts
    kept = KeepOut(parts, np.full(len(parts.pairs), 0.5 * 2.5e-4 - CLEARANCE.at_nodes))
    inside = straight(pair).path(np.linspace(0, 1, 40))
    true = parts.clearance(inside)
    assert true.min() < 0.0 < true[0].min()
    s, z = np.linspace(0, 1, 40), np.stack([inside, *np.zeros((3, *inside.shape))])
    for imposed, asked in ((True, 0.5 * 2.5e-4), (False, 0.5 * RESOLUTION + 2 * EXACT)):
        motion = replace(problem, tracking=None).at(s, z, 1.0, imposed=imposed)
        (block,) = evaluate((Clearance(kept),), motion)
        near = true < 1e-3
        assert near.any()
        assert block.values[near] == pytest.approx(-10 * (true - asked)[near], abs=1e-9)


def cube_from(q: list[float], orientation: str) -> TransportProblem:
    """The paper's cube, friction .4 and nothing uncertain, carried from a posture to the paper's goal."""
    case = scenario.load("panda-cube").with_changes(
        objects__0__friction=0.4,
        objects__0__uncertainty={},
        motion__duration=None,
        motion__goal_yaw="free",
        motion__orientation=orientation,
    )
    return replace(transport_problem(case, robust=False), start=AtPosture(np.array(q)))


AMID = [1.70239342, -0.32298972, -0.55980024, -2.74469279, 2.8739436, 0.69100383, 0.1707132]


def test_from_a_posture_whose_nearest_goal_touches_another_goal_is_nearer():
    """The nearest goal touches, and slid free takes 1.33 s at least; the motion that was found from it was half as long
    again as a level one, which may tilt too."""
    problem = cube_from(AMID, "free")
    nearest = problem.goal.nearest(problem.arm, problem.limits, problem.start.q)
    assert problem.keep_out.parts.first_touch(nearest[None]) is not None
    few = ends(problem, np.random.default_rng(0), few=2)
    least = [least_duration(problem.limits, pair.start, pair.goal) for pair in few]
    assert all(pair.free for pair in few)
    assert min(least) < 1.1 < 1.3 < max(least)
    assert [pair.cost for pair in few] == sorted(pair.cost for pair in few)


@pytest.mark.slow
def test_a_motion_that_may_tilt_takes_no_longer_than_a_level_one():
    level, tilting = (fastest(cube_from(AMID, orientation)) for orientation in ("fixed", "free"))
    assert level.status.ok
    assert tilting.status.ok
    assert tilting.duration < 1.001 * level.duration < 0.86


@pytest.mark.slow
def test_a_short_arm_starts_where_its_own_parts_leave_room():
    """The tutorial's bottle on a UR5, whose tray is within 6 mm of its forearm in one of its few postures: something
    hinders a shorter time, and it is no slower than the straight line in 0.9 s, which is known to be safe."""
    case = scenario.parse(
        {
            "name": "bottle",
            "motion": {"start": {"position": [0.45, -0.25, 0.45]}, "goal": {"position": [0.45, 0.25, 0.45]}},
            "objects": [
                {
                    "name": "bottle",
                    "shape": {"type": "cylinder", "radius": 0.033, "height": 0.20},
                    "mass": 0.55,
                    "com": [0.0, 0.0, -0.02],
                    "friction": 0.35,
                    "support_inset": 0.003,
                    "uncertainty": {"mass": "10%", "com": [0.003, 0.003, 0.01], "friction": "10%"},
                }
            ],
            "contact": {"condition": "exact"},
            "tray": {"size": [0.25, 0.25], "height": 0.05, "mass": 0.4},
            "arm": {
                "model": str(robot_file(KNOWN_ARMS["ur5"])),
                "flange": "tool0",
            },
        },
        "bottle",
    )
    for orientation in ("fixed", "free"):
        found = fastest(transport_problem(case.with_changes(motion__orientation=orientation)))
        assert found.status.ok
        assert found.binding
        assert found.duration < 0.9


@pytest.mark.slow
def test_a_thin_post_does_not_fit_between_the_nodes_of_a_rough_motion(behind_a_post):
    """With few pieces there are ten centimetres from node to node, and the post is six thick."""
    found = fastest(behind_a_post, FastestOptions(spans=8))
    assert found.status.ok
    assert found.duration < 0.95  # 0.83 s with many pieces
    q = found.sample(np.linspace(0, found.duration, 800))[0]
    assert behind_a_post.keep_out.parts.first_touch(q) is None


def test_a_start_posture_is_followed_once(monkeypatch):
    """An arm of six joints has few postures at a pose: goals are sought from each of them once, however many guesses
    lead there."""
    problem = transport_problem(scenario.load("ur5-bottle"))
    goals, starts = [], []
    nearest = AtPose.nearest

    def noted(end, arm, limits, q, *more):
        (goals if end is problem.goal else starts).append(q)
        return nearest(end, arm, limits, q, *more)

    monkeypatch.setattr(AtPose, "nearest", noted)
    _sought(problem, np.random.default_rng(0), 0, options := EndOptions())
    apart = [np.abs(one - other).max() for k, one in enumerate(goals) for other in goals[:k]]
    assert len(starts) == options.attempts // options.batches
    assert 2 <= len(goals) < len(starts)
    assert min(apart) > 1e-6


@pytest.mark.parametrize("seed", range(3))
def test_no_joint_begins_a_whole_turn_away(seed: int) -> None:
    """Joints of a UR5e turn by 360 degrees either way: a posture at 305 degrees is one at -55."""
    problem = transport_problem(scenario.load("ur5-bottle").with_changes(arm__model="ur5e"))
    for pair in ends(problem, np.random.default_rng(seed)):
        assert np.abs(0.5 * (pair.start + pair.goal)).max() <= np.pi
        assert problem.arm.tray_pose(pair.start)[0] == pytest.approx(problem.start.target.tray_pose[0], abs=1e-6)
