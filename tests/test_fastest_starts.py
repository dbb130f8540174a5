"""Where the search for the fastest motion begins, and what may end it."""

from __future__ import annotations

import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest
from scipy.optimize import linprog

from salver import scenario
from salver.errors import Status
from salver.models.known_arms import KNOWN_ARMS, robot_file
from salver.planning.fastest import FastestOptions, fastest, plan_fastest, search, transport_problem
from salver.planning.fastest.around import LEAN, STEP, way_around
from salver.planning.fastest.bound import least_by_friction, least_duration, least_time
from salver.planning.fastest.constraints import Clearance, evaluate
from salver.planning.fastest.curves import FreeCurve
from salver.planning.fastest.ends import AtPose
from salver.planning.fastest.exchange import rough
from salver.planning.fastest.found import FastestMotion
from salver.planning.fastest.obstacles import AT_NODES, KeepOut
from salver.planning.fastest.problem import TransportProblem
from salver.planning.fastest.search import few_pieces, refitted
from salver.planning.fastest.sides import DEEPEST, past
from salver.planning.fastest.spline import SplineMotion
from salver.planning.fastest.starts import (
    ATTEMPTS,
    BATCHES,
    Start,
    _sought,
    bendable,
    bent,
    between,
    ends,
    open_to,
    straight,
    touches,
    tray_line,
    unlike,
)
from salver.planning.fastest.watch import Watch

POST = {"type": "capsule", "position": [0.55, -0.02, 0.35], "radius": 0.03, "length": 0.7}


@pytest.fixture(scope="module")
def behind_a_post() -> TransportProblem:
    case = scenario.load("panda-cube").with_changes(
        objects__0__uncertainty={}, motion__orientation="free", obstacles=[POST]
    )
    return transport_problem(case)


@pytest.fixture(scope="module")
def past_the_post(behind_a_post: TransportProblem) -> FastestMotion:
    """With few pieces there are ten centimetres from node to node, and the post is six thick."""
    return fastest(behind_a_post, FastestOptions(spans=8))


def test_a_way_around_touches_nothing_stays_level_and_is_the_same_for_the_same_seed(behind_a_post):
    problem = behind_a_post
    pair = ends(problem, np.random.default_rng(0))[0]
    assert touches(problem, straight(pair)) > 0.01
    ways = [way_around(problem, [pair.start], [pair.goal], np.random.default_rng(seed), 20_000) for seed in (3, 3, 4)]
    way = ways[0]
    assert way is not None
    assert ways[1] is not None
    assert ways[2] is not None
    assert np.array_equal(way, ways[1])
    assert len(way) != len(ways[2]) or not np.allclose(way, ways[2])
    assert np.array_equal(way[0], pair.start)
    assert np.array_equal(way[-1], pair.goal)
    assert np.linalg.norm(np.diff(way, axis=0), axis=1).max() <= 3 * STEP
    assert problem.keep_out.parts.first_touch(way) is None
    lean = max(np.arccos(min(1.0, problem.arm.tray_pose(q)[1][2, 2])) for q in way)
    assert lean <= 2 * LEAN + 1e-6
    assert np.all(way >= problem.limits.q_min)
    assert np.all(way <= problem.limits.q_max)


def test_no_way_is_found_without_looking_and_none_out_of_an_end_that_touches(behind_a_post):
    problem = behind_a_post
    pair = ends(problem, np.random.default_rng(0))[0]
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


def test_a_path_that_tips_the_load_off_is_not_open_and_nor_is_one_through_a_post(behind_a_post):
    problem = behind_a_post
    pair = ends(problem, np.random.default_rng(0))[0]
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


def test_ways_over_a_post_and_before_it_cannot_be_bent_into_one_another(behind_a_post):
    """It is 0.7 m tall."""
    problem = behind_a_post
    pair = ends(problem, np.random.default_rng(0))[0]
    found = [way_around(problem, [pair.start], [pair.goal], np.random.default_rng(seed), 20_000) for seed in (0, 2, 5)]
    ways = [Start("way", way) for way in found if way is not None]

    def over(way: Start) -> bool:
        p = np.array([problem.arm.tray_pose(q)[0] for q in way.path(np.linspace(0, 1, 60))])
        return bool(p[np.abs(p[:, 1] + 0.02).argmin(), 2] > 0.7)

    assert sorted(over(way) for way in ways) == [False, False, True]
    for way in ways:
        for other in ways:
            assert bendable(problem, way, other) == (over(way) == over(other))


def test_paths_pass_a_post_over_it_and_on_the_near_side(behind_a_post):
    """From end to end, hardly touching; it is 0.4 m tall, and a way over it twice as long as one before it."""
    post = {**POST, "position": [0.55, -0.02, 0.2], "length": 0.4}
    problem = transport_problem(behind_a_post.scenario.with_changes(obstacles=[post]))
    pair = ends(problem, np.random.default_rng(0))[0]
    least = {}
    for start in past(problem, pair):
        assert np.array_equal(start.postures[0], pair.start)
        assert np.array_equal(start.postures[-1], pair.goal)
        assert touches(problem, start) <= DEEPEST < touches(problem, straight(pair))
        p = np.array([problem.arm.tray_pose(q)[0] for q in start.path(np.linspace(0, 1, 60))])
        there = p[np.abs(p[:, 1] + 0.02).argmin()]
        side = "over" if there[2] > 0.55 else "before" if there[0] < 0.5 else "through"
        least[side] = min(start.least(problem), least.get(side, np.inf))
    assert sorted(least) == ["before", "over"]
    assert least["before"] < least["over"]
    assert past(replace(problem, keep_out=None), pair) == []


def test_postures_in_which_the_arm_stands_otherwise_come_first(behind_a_post):
    """A base turned once round is another posture and stands the same."""
    first = ends(behind_a_post, np.random.default_rng(0), few=1)[0]
    turn = 2 * np.pi * np.eye(7)[0]
    same = replace(first, start=first.start + turn, goal=first.goal + turn, cost=first.cost + 0.1)
    other = replace(first, goal=first.goal + 0.5)
    assert unlike(behind_a_post, [first, same, other]) == [first, other, same]
    assert unlike(behind_a_post, [first]) == [first]


def test_a_start_that_cannot_be_the_best_is_given_up_early_and_one_that_can_is_not(behind_a_post):
    problem = behind_a_post
    few, watch = few_pieces(FastestOptions()), Watch()
    begin = past(problem, ends(problem, np.random.default_rng(0))[0])[0].motion(problem, few)
    whole = rough(problem, FreeCurve, begin, 2, watch)
    assert whole.iterate.violation < 1e-3
    better, worse = (rough(problem, FreeCurve, begin, 2, watch, beat=x * whole.iterate.duration) for x in (0.7, 1.5))
    assert better.iterations < whole.iterations
    assert better.iterate.duration > 0.7 * whole.iterate.duration
    assert worse.iterations == whole.iterations
    assert worse.iterate.duration == whole.iterate.duration


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
            "objects": [{"shape": {"type": "box", "size": [0.097, 0.097, 0.063]}, "mass": 0.3, "friction": 0.29}],
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


def test_an_end_that_is_too_near_keeps_what_it_can(behind_a_post):
    problem = behind_a_post
    pair = ends(problem, np.random.default_rng(0))[0]
    there = problem.keep_out.parts.clearance(np.stack([pair.start, pair.goal])).min(axis=0)
    wanted = replace(problem.keep_out, required=there + 1e-3)  # nowhere kept
    kept = between(replace(problem, keep_out=wanted), pair).keep_out
    assert np.all(kept.required + AT_NODES <= 0.5 * there + 1e-12)
    assert np.all(
        kept.distances(np.stack([pair.start, pair.goal])) >= AT_NODES
    )  # what the nodes of a programme ask for
    assert np.array_equal(
        between(problem, pair).keep_out.required[there > 0.01], problem.keep_out.required[there > 0.01]
    )


def test_where_an_end_is_very_near_nothing_may_touch_all_the_same(behind_a_post):
    """A quarter of a millimetre is left at an end: a programme asks for half of it, the check for no touch."""
    problem = behind_a_post
    pair = ends(problem, np.random.default_rng(0))[0]
    parts = problem.keep_out.parts
    kept = KeepOut(parts, np.full(len(parts.pairs), 0.5 * 2.5e-4 - AT_NODES))
    inside = straight(pair).path(np.linspace(0, 1, 40))
    true = parts.clearance(inside)
    assert true.min() < 0.0 < true[0].min()
    s, z = np.linspace(0, 1, 40), np.stack([inside, *np.zeros((3, *inside.shape))])
    for imposed, asked in ((True, 0.5 * 2.5e-4), (False, 0.0)):
        motion = replace(problem, tracking=None).at(s, z, 1.0, imposed=imposed)
        (block,) = evaluate((Clearance(kept),), motion)
        near = true < 1e-3
        assert near.any()
        assert block.values[near] == pytest.approx(-10 * (true - asked)[near], abs=1e-9)


@pytest.mark.parametrize(
    ("distance", "velocity", "acceleration", "jerk", "time"),
    [
        (4.0, 1.0, 1.0, np.inf, 5.0),  # a trapezium of velocity
        (1.0, 9.0, 1.0, np.inf, 2.0),  # a triangle: 2 sqrt(d / a)
        (1.0, np.inf, np.inf, 32.0, 1.0),  # jerk alone: (32 d / j)^(1/3)
        (3.0, 1.0, 2.0, 4.0, 4.0),  # all of them: 1 s up, 1 s down, 2 s at full speed
        (6.0, np.inf, 2.0, 4.0, 4.0),  # 1/2 s of jerk, 1 s at full acceleration, 1/2 s of jerk, and the same down
        (3.0, 2.0, np.inf, np.inf, 1.5),
        (3.0, np.inf, np.inf, np.inf, 0.0),
        (0.0, 1.0, 1.0, 1.0, 0.0),
    ],
)
def test_least_time_of_a_joint(distance, velocity, acceleration, jerk, time):
    assert least_time(distance, velocity, acceleration, jerk) == pytest.approx(time)


def test_no_force_within_a_cone_carries_a_mass_farther():
    """As a linear programme: pushes (x, z) at 41 instants of 1 s, within a cone about the vertical of slope 1/2, of a
    point mass that begins and ends at rest; how far can it come? The bound's distance, and hardly less."""
    count, slope, g = 41, 0.5, 9.81
    t = np.linspace(0.0, 1.0, count)
    x, z = np.eye(2 * count)[:count], np.eye(2 * count)[count:]  # impulses by mass, m/s
    far = (1 - t) @ x
    at_rest = np.stack([x.sum(axis=0), z.sum(axis=0)])  # both stop, z against gravity
    found = linprog(
        -far,
        A_ub=np.vstack([x - slope * z, -x - slope * z]),
        b_ub=np.zeros(2 * count),
        A_eq=at_rest,
        b_eq=[0.0, g],
        bounds=(None, None),
    )
    assert -found.fun == pytest.approx(slope * g / 2)
    problem = transport_problem(scenario.load("panda-cube").with_changes(objects__0__uncertainty={}))
    pair = ends(problem, np.random.default_rng(0))[0]
    body = problem.items[0]
    p_0, p_1 = (problem.arm.object_pose(q, body.p_EB, body.R_EB)[0] for q in (pair.start, pair.goal))
    distance = np.linalg.norm((p_1 - p_0)[:2])
    time = least_by_friction(problem.arm, problem.payload, 0.0, pair.start, pair.goal)
    assert body.friction * g * time**2 / 2 == pytest.approx(distance)
    leaning = least_by_friction(problem.arm, problem.payload, 0.2, pair.start, pair.goal)
    assert np.tan(np.arctan(body.friction) + 0.2) * g * leaning**2 / 2 == pytest.approx(distance)
    assert least_by_friction(problem.arm, problem.payload, np.inf, pair.start, pair.goal) == 0.0


def test_a_slippery_load_has_its_bound_by_friction():
    case = scenario.load("panda-cube").with_changes(motion__duration=None, motion__orientation="fixed")
    case = case.with_changes(objects__0__friction=0.15, objects__0__uncertainty={"friction": "20%"})
    plan = plan_fastest(case, options=FastestOptions(spans=8))
    assert plan.ok
    assert "friction alone takes" in plan.status.sentence
    distance = np.hypot(*(np.array(case.motion.goal.position) - case.motion.start.position)[:2])
    slope = np.tan(np.arctan(0.12) + np.sqrt(2) * 1e-3)  # level, to a milliradian about each axis
    assert plan.solver["bound"] == pytest.approx(np.sqrt(2 * distance / (slope * 9.81)), rel=1e-6)
    assert plan.solver["bound"] < plan.duration


def test_no_motion_is_faster_than_its_joints_alone(behind_a_post, past_the_post):
    found = past_the_post
    bound = least_duration(behind_a_post.limits, found.coefficients[0], found.coefficients[-1])
    assert 0.2 * found.duration < bound < found.duration


def test_the_tray_goes_straight_along_its_line():
    problem = transport_problem(scenario.load("panda-cube"))
    pair = ends(problem, np.random.default_rng(0))[0]
    line = tray_line(problem, pair)
    assert line is not None
    p = np.array([problem.arm.tray_pose(q)[0] for q in line.postures])
    along = (p[-1] - p[0]) / np.linalg.norm(p[-1] - p[0])
    assert np.abs(np.cross(p - p[0], along)).max() < 1e-9


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
def test_a_search_that_is_interrupted_says_so_and_keeps_what_it_has(behind_a_post):
    shares = []

    def tell(share: float, best: float | None) -> None:
        shares.append(share)
        if best is not None:
            watch.interrupt()

    watch = Watch(tell=tell)
    found = fastest(behind_a_post, FastestOptions(spans=8, starts=5), watch=watch)
    assert found.status.ok
    assert found.status.code == "interrupted"
    assert "ended by an interruption" in found.status.sentence
    assert shares == sorted(shares)
    assert 0 < shares[-1] < 1


@pytest.mark.slow
def test_a_thin_post_does_not_fit_between_the_nodes_of_a_rough_motion(behind_a_post, past_the_post):
    found = past_the_post
    assert found.status.ok
    assert found.duration < 0.95  # 0.83 s with many pieces
    q = found.sample(np.linspace(0, found.duration, 800))[0]
    assert behind_a_post.keep_out.parts.first_touch(q) is None


def test_a_bend_leaves_the_ends_where_they_are_and_is_widest_half_way(behind_a_post):
    pair = ends(behind_a_post, np.random.default_rng(0))[0]
    start = bent(pair, np.random.default_rng(1)).postures
    u = np.linspace(0, 1, len(start))[:, None]
    beside = start - (pair.start + u * (pair.goal - pair.start))
    assert np.abs(beside[[0, -1]]).max() < 1e-12
    assert np.array_equal(np.abs(beside).argmax(axis=0), np.full(7, len(start) // 2))
    assert 0.02 < np.abs(beside).max() < 2.0  # rad


def test_an_end_is_turned_by_a_quarter_where_the_last_joint_has_room_for_it(monkeypatch):
    """Both ways in the middle of its range, one way near an end of it; none where that alone takes longer than what was
    found. The start stays."""
    problem, options = transport_problem(scenario.load("panda-cube")), FastestOptions()
    one = search._Search(problem, options, Watch(), [], np.random.default_rng(0))
    monkeypatch.setattr(search._Search, "_rough_from", lambda self, problem, start, damping, beat: start)
    few, low, high = few_pieces(options), problem.limits.q_min[-1], problem.limits.q_max[-1]

    def turned(end, duration=3.0):
        coefficients = np.zeros((few.size, 7))
        coefficients[-1, -1] = end
        found = SimpleNamespace(iterate=SimpleNamespace(coefficients=coefficients, duration=duration, violation=0.0))
        motions = list(one._turned(problem, found))
        assert all(motion.duration == duration for motion in motions)
        assert all(np.array_equal(motion.coefficients[:, :-1], coefficients[:, :-1]) for motion in motions)
        assert all(motion.coefficients[0, -1] == 0.0 for motion in motions)
        return [motion.coefficients[-1, -1] - end for motion in motions]

    for end in (0.1, low + 1.6, high - 1.6):
        assert turned(end) == pytest.approx([0.5 * np.pi, -0.5 * np.pi])
    assert turned(high - 1.5) == pytest.approx([-0.5 * np.pi])
    assert turned(low + 1.5) == pytest.approx([0.5 * np.pi])
    assert turned(0.0, duration=0.3) == []  # 1.57 rad at 2.6 rad/s


def test_every_step_of_every_part_of_a_search_is_counted(monkeypatch):
    """Of the first optima with few pieces, of those a quarter turn away, and of what is made of them."""
    counted = []

    def counting(part):
        def run(*arguments, **options):
            found = part(*arguments, **options)
            counted.append(found)
            return found

        return run

    for part in ("rough", "_optimum"):
        monkeypatch.setattr(search, part, counting(getattr(search, part)))
    case = scenario.load("panda-cube").with_changes(objects__0__uncertainty={}, motion__goal_yaw="free")
    begun = time.perf_counter()
    found = fastest(transport_problem(case), FastestOptions(spans=8, pairs=1))
    took = time.perf_counter() - begun
    assert found.status.ok
    assert len(counted) > 2
    assert min(part.iterations for part in counted) > 0
    assert found.iterations == sum(part.iterations for part in counted)
    assert min(part.wall_time for part in counted) > 0
    assert sum(part.wall_time for part in counted) <= found.wall_time <= took
    again = replace(found, wall_time=2.0, iterations=5).after(replace(found, wall_time=1.5, iterations=3))
    assert (again.wall_time, again.iterations) == (3.5, 8)


@pytest.mark.parametrize("place", [[0.444272, 0.100574, 0.4], [3.0, 0.0, 0.4]], ids=["reached", "unreachable"])
def test_the_time_that_a_search_took_is_told(place):
    problem = transport_problem(scenario.load("panda-cube").with_changes(motion__goal__position=place))
    begun = time.perf_counter()
    found = fastest(problem, FastestOptions(spans=8, pairs=1))
    took = time.perf_counter() - begun
    assert found.status.ok == (place[0] < 1)
    assert 0 < found.wall_time <= took


def a_refined(monkeypatch, rows, *ends):
    """Of a rough optimum of 1 s with these rows: what of ends (what binds, s, steps) in turn is kept, and the steps."""
    options, ok = FastestOptions(), Status("optimal", "It is.", True)
    few = few_pieces(options)
    size = refitted(SplineMotion(few, np.zeros((few.size, 7)), 1.0), options.spans).coefficients.shape
    results = [
        SimpleNamespace(status=ok, binding=binding, iterations=steps, duration=seconds, coefficients=np.zeros(size))
        for binding, seconds, steps in ends
    ]
    found = iter(results)
    monkeypatch.setattr(search, "_optimum", lambda *_, **__: next(found))
    grid = SimpleNamespace(s=np.linspace(0, 1, 21), nodes=np.arange(0, 21, 5))
    begun = SimpleNamespace(
        coefficients=np.zeros((few.size, 7)),
        duration=1.0,
        curve=SimpleNamespace(grid=grid),
        blocks=[SimpleNamespace(name=name) for name in rows],
    )
    one = search._Search(transport_problem(scenario.load("panda-cube")), options, Watch(), [], np.random.default_rng(0))
    kept = one._refined(one.problem, begun)
    return results.index(kept), one.iterations


def test_a_search_that_nothing_stopped_goes_on_from_there_and_counts_all_its_steps(monkeypatch):
    """The first refinement ends where nothing binds; the second is faster and bound, and that is the end."""
    ends = ((), 1.0, 5), (("torque",), 0.9, 3), ((), 0.8, 7)
    assert a_refined(monkeypatch, ["torque", "acceleration"], *ends) == (1, 5 + 3)


def test_a_refined_motion_may_be_longer_where_the_rough_one_knew_less(monkeypatch):
    """With more pieces the shortest motion is no longer; with more conditions it may be, and the rough one's time then
    says nothing."""
    ends = (("torque", "waves in cup"), 1.1, 5), (("torque", "waves in cup"), 1.05, 3), (("torque",), 0.8, 7)
    assert a_refined(monkeypatch, ["torque"], *ends) == (0, 5)
    assert a_refined(monkeypatch, ["torque", "waves in cup"], *ends) == (2, 5 + 3 + 7)


def test_of_rough_optima_that_know_less_the_others_too_become_longer():
    """One takes 1 s and becomes 1.03 s long: if the same binds, one of 1.07 s may still take 0.96 of that; if something
    binds that none of them knows, not even one of 1.01 s is worth it."""
    rough = SimpleNamespace(duration=1.0, blocks=[SimpleNamespace(name="torque")])
    refining = [search._refining(rough, SimpleNamespace(duration=1.03, binding=x)) for x in (["torque"], ["waves"])]
    assert refining == [search.REFINING, 1.03]
    shorter = SimpleNamespace(duration=0.8, binding=["waves"])
    assert search._refining(rough, shorter) == search.REFINING


@pytest.mark.slow
def test_a_coffee_is_refined_once(monkeypatch):
    """Its rough motions know of no waves: 0.709 s; with them none takes less than 0.72 s."""
    spent = []
    optimum = search._optimum
    monkeypatch.setattr(search, "_optimum", lambda *a, **k: spent.append(optimum(*a, **k)) or spent[-1])
    found = fastest(transport_problem(scenario.load("panda-coffee")))
    assert found.status.ok
    assert 0.72 < found.duration < 0.73
    assert len(spent) == 1


@pytest.mark.slow
def test_another_start_takes_the_place_of_one_that_becomes_longer_when_it_is_refined():
    """In the goal posture that promises most, something is within a millimetre of something else, about as near
    as the arm may stray; to the other posture the way is free, and takes 1.199 s."""
    case = scenario.parse(
        {
            "name": "two-ends",
            "motion": {
                "start": {"position": [0.49670281, 0.61522311, 0.5464039]},
                "goal": {"position": [0.48675431, -0.31498546, 0.54518059]},
                "goal_yaw": "fixed",
            },
            "objects": [
                {
                    "shape": {"type": "box", "size": [0.09449807, 0.09449807, 0.09091334]},
                    "mass": 0.16143063,
                    "friction": 0.44288296,
                    "support_inset": 0.002,
                    "uncertainty": {"mass": "10%", "friction": "10%"},
                }
            ],
            "contact": {"condition": "exact"},
            "tray": {"size": [0.18, 0.18], "mass": 0.2, "height": 0.05},
            "arm": {"model": "ur10"},
            "obstacles": [
                {"type": "box", "position": [0.42032934, -0.08351663, 0.37796455], "size": [0.18, 0.18, 0.12]}
            ],
        },
        "two-ends",
    )
    found = fastest(transport_problem(case))
    assert found.status.ok
    assert found.duration < 1.21


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
    _sought(problem, np.random.default_rng(0), 0)
    apart = [np.abs(one - other).max() for k, one in enumerate(goals) for other in goals[:k]]
    assert len(starts) == ATTEMPTS // BATCHES
    assert 2 <= len(goals) < len(starts)
    assert min(apart) > 1e-6
