"""Live motions: at every moment one is committed that ends at rest with the load in place, whatever happens."""

import re
import time
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, example, given, settings
from hypothesis import strategies as st

import salver as sv
from live_runs import drive, executed, in_turn, jolts, rows_of
from salver.errors import ScenarioError
from salver.live import Live, Worker
from salver.live.motion import between, joined, resting
from salver.live.replan import Replanner, straight
from salver.live.verify import instants, verified
from salver.live.wishes import pose_goal
from salver.models.arm_limits import POSITION
from salver.planning.fastest import fastest, joint_plan, transport_problem
from salver.planning.fastest.constraints import Clearance, Contact, evaluate
from salver.planning.fastest.ends import AtPose, AtPosture
from salver.planning.fastest.exchange import optimise
from salver.planning.fastest.obstacles import AT_NODES, KeepOut
from salver.planning.fastest.sqp import minimise
from salver.planning.postures import PoseTarget
from salver.trajectory import JointMotion

LEAD = 0.1  # s: in simulated time planning takes none, and hand-overs are where they would be


@pytest.fixture(scope="module")
def cube():
    return sv.load_scenario("panda-cube")


@pytest.fixture(scope="module")
def problem(cube):
    return transport_problem(cube)


@pytest.fixture(scope="module")
def bottle():
    return sv.load_scenario("panda-tall-bottle")


def place(x, y, z):
    return lambda live: live.goto((x, y, z))


def beside_a_wall(problem, room):
    """The arm where the cube starts, with a wall beside the tray, room m away."""
    place = problem.arm.tray_pose(problem.start.q)[0] + [0.0, 0.1 + 0.01 + room, 0.0]  # half the tray and half the wall
    wall = {"name": "wall", "type": "box", "size": [0.1, 0.02, 0.1], "position": place.tolist()}
    return Live(problem.scenario.with_changes(arm__start_posture=None, obstacles=[wall]), problem.start.q)


def check(live, states):
    """What must be true of anything that was executed, and then left alone until it rests."""
    worst = rows_of(live.problem, states)
    assert max(worst.values()) <= 0.0, worst
    position, velocity = jolts(states)
    assert position < 1e-5  # rad: no jump; a jerk of 7500 rad/s^3, the most of this arm, makes 6e-7 in a period
    assert velocity < 5e-3  # rad/s: no jump of acceleration by more than that jerk in a period
    assert not np.any(states[1][-1])
    assert not np.any(states[2][-1])


@pytest.mark.slow
def test_a_goal_is_reached_and_changed_while_moving(cube):
    live = Live(cube, lead=LEAD)
    wishes = [(0.0, place(0.45, 0.1, 0.45)), (0.35, place(0.5, -0.3, 0.4)), (0.6, place(0.5, 0.0, 0.5))]
    states = drive(live, 2.5, wishes)
    check(live, states)
    first = live.problem.items[0]
    p, _ = live.problem.arm.object_pose(states[0][-1], first.p_EB, first.R_EB)
    assert np.abs(p - (0.5, 0.0, 0.5)).max() < 1e-6
    assert live.state.refused == ""
    assert live.state.doing == "resting"


@pytest.mark.slow
def test_the_bottle_stays_in_the_engine_at_the_corners_of_its_ranges(bottle):
    """Goals that change while it moves, and a stop; executed by the controller, with another bottle than it thinks."""
    live = Live(bottle, lead=LEAD)
    wishes = [(0.0, place(0.45, 0.1, 0.5)), (0.4, place(0.5, -0.35, 0.55)), (0.9, place(0.45, 0.1, 0.45))]
    states = drive(live, 2.6, [*wishes, (1.3, Live.stop)])
    check(live, states)
    motion = executed(states)
    plan = sv.plan(bottle)
    run = joint_plan(plan.scenario, live.problem, motion, plan.status, {})
    uncertain = run.uncertain
    for signs in (1, -1):
        values = uncertain.nominal + signs * uncertain.half_range * np.array(
            [-signs if name == "friction" else 1 for name in uncertain.names]
        )
        record = sv.simulate(run, parameters=dict(zip(map(str, uncertain.names), values.tolist(), strict=True)))
        assert record.outcome == "holds"


garbage = st.sampled_from(
    [
        lambda live: live.goto((np.nan, 0.0, 0.5)),
        lambda live: live.goto("there"),
        lambda live: live.goto((9.0, 0.0, 0.5)),
        lambda live: live.goto(q=np.full(7, 9.0)),
        lambda live: live.goto(),
        lambda live: live.command(np.nan),
        lambda live: live.command("now"),
        lambda live: live.plan(budget=np.nan),
        lambda live: live.measured(np.full(7, np.inf)),
    ]
)
goals = st.tuples(st.floats(0.35, 0.6), st.floats(-0.4, 0.2), st.floats(0.3, 0.6)).map(lambda p: place(*p))
wish = st.one_of(goals, st.just(Live.stop), garbage)


@pytest.mark.slow
@settings(
    max_examples=6,
    deadline=None,
    derandomize=True,
    suppress_health_check=list(HealthCheck),
    phases=[Phase.explicit, Phase.generate],  # what was wished is short, to make it shorter takes minutes
)
@example([(0.0, Live.stop), (0.0, place(0.5, 0.0, 0.5)), (0.0, place(0.35, 0.0, 0.3)), (0.0078, Live.stop)], 1)
@example([(0.0, place(0.375, 0.0, 0.305)), (0.006, Live.stop), (0.2, Live.stop)], 2)
@given(st.lists(st.tuples(st.floats(0.0, 1.2), wish), min_size=2, max_size=6), st.integers(5, 90))
def test_whatever_is_wished_no_row_is_broken_and_it_ends_at_rest(cube, wishes, every):
    live = Live(cube, lead=LEAD)
    states = drive(live, 1.3, sorted(wishes, key=lambda pair: pair[0]), every)
    silence = drive(live, 1.7, every=None, begins=1.3)
    check(live, in_turn(states, silence))


def test_a_planner_that_fails_or_dies_leaves_what_is_committed(cube, monkeypatch):
    live = Live(cube, lead=LEAD)
    states = drive(live, 0.4, [(0.0, place(0.45, 0.1, 0.45))])
    assert live.state.doing == "following"
    goal = live.committed

    def broken(*_, **__):
        raise ArithmeticError("lost")

    monkeypatch.setattr(type(live._planner._replanner), "to", broken)
    live.goto((0.5, -0.3, 0.4))
    assert "The planner failed (ArithmeticError: lost)" in live.plan(60.0).refused
    more = drive(live, 1.5, every=None, begins=0.4)
    assert live.committed is goal
    check(live, in_turn(states, more))


@pytest.mark.slow
def test_a_motion_that_comes_too_late_is_not_taken(cube, monkeypatch):
    """The loop goes on while one is sought, beyond where it would begin: the old one goes on, a later one comes."""
    live = Live(cube, lead=0.02)
    states = drive(live, 0.4, [(0.0, place(0.45, 0.1, 0.45))])
    goal, seek, between_times = live.committed, live._planner._replanner.to, []

    def slowly(self, *args):
        found = seek(*args)
        between_times.append(drive(live, 0.05, every=None, begins=0.4))
        return found

    with monkeypatch.context() as patched:
        patched.setattr(type(live._planner._replanner), "to", slowly)
        live.goto((0.5, -0.3, 0.4))
        live.plan(60.0)
    assert len(between_times) == 1
    late = drive(live, 0.01, every=None, begins=0.45)
    assert live.committed is goal
    more = drive(live, 2.2, begins=0.46)
    assert live.committed is not goal
    check(live, in_turn(states, between_times[0], late, more))


@pytest.fixture(scope="module")
def moving(cube):
    """On the way to a goal; only to be looked at."""
    live = Live(cube, lead=LEAD)
    drive(live, 0.4, [(0.0, place(0.45, 0.1, 0.45))])
    return live


class TestVerdict:
    """What is proposed by anyone is only believed after it was looked at."""

    def test_a_jolt_is_refused(self, moving):
        base, now = moving.committed, moving.committed.begins + 0.2
        goes_on = between(base.motion, 0.2, base.motion.duration)
        assert verified(moving.problem, goes_on, now, base).committed is not None
        for name, by in (("q", 1e-4), ("dq", 1e-3), ("ddq", 1e-2)):
            states = {key: getattr(goes_on, key).copy() for key in ("q", "dq", "ddq")}
            states[name][0, 2] += by
            found = verified(moving.problem, JointMotion(goes_on.t, **states), now, base)
            assert found.committed is None
            assert found.sentence == "it does not begin where the arm is then"

    def test_what_does_not_end_at_rest_is_refused(self, moving):
        base, now = moving.committed, moving.committed.begins + 0.1
        cut = between(base.motion, 0.1, 0.6 * base.motion.duration)
        found = verified(moving.problem, cut, now, base)
        assert found.committed is None
        assert found.sentence == "it does not end at rest"

    def test_what_goes_too_fast_or_is_no_number_is_refused(self, moving):
        base = moving.committed
        quick = JointMotion(
            0.8 * base.motion.t, base.motion.q, base.motion.dq / 0.8, base.motion.ddq / 0.64
        )  # a time-optimal motion in 80 % of its time
        found = verified(moving.problem, quick, 0.0, None)
        assert found.committed is None
        assert "exceeded" in found.sentence
        lost = replace(quick, q=np.where(np.arange(len(quick.q))[:, None] == 3, np.nan, quick.q))
        assert "not numbers" in verified(moving.problem, lost, 0.0, None).sentence

    @pytest.mark.slow
    def test_it_knows_what_a_wrong_load_has_brought_the_arm_into(self, bottle):
        """The deviation that goes on from motion to motion is that of all of them as one."""
        live = Live(bottle, lead=LEAD)
        states = drive(live, 1.4, [(0.0, place(0.45, 0.1, 0.5)), (0.35, place(0.5, -0.3, 0.55))])
        motion = executed(states)
        t = motion.t
        z = np.stack([*motion.sample(t), motion.jerk(t)])
        response = live.problem.at(t / motion.duration, z, motion.duration).response
        now = live.committed.begins + 0.2
        whole = response.state_at(t, now)
        carried = live.committed.deviation_at(now, live.problem)
        scale = np.abs(np.stack([response.joints.q, response.joints.dq])).max(axis=(1, 2))[:, None, :]
        assert (np.abs(whole - carried)[..., :-1] / scale).max() < 0.01  # nodes every 2 ms, against every 1 ms

    def test_contact_keeps_a_margin_also_where_the_scenario_asks_for_none(self, cube, moving):
        """0.1 % of what holds: jerk jumps between the instants that are looked at. Of a load that slides on the way."""
        motion = moving.committed.motion
        at = verified(moving.problem, motion, 3.0, None).committed.margins.t
        assert at[[0, -1]] == pytest.approx([3.0, 3.0 + motion.duration])
        problem = Live(cube.with_changes(contact__margin=0.0, objects__0__friction=0.2)).problem
        s, nodes = instants(motion)
        z = np.stack([*motion.sample(s * motion.duration), motion.jerk(s * motion.duration)])
        blocks = evaluate(problem.constraints, problem.at(s, z, motion.duration, nodes, imposed=False))
        (contact,) = (block for block in blocks if isinstance(block.of, Contact))
        more = 1e-3 - contact.margins[1]  # the rows hold a margin already
        assert more > 5e-4
        found = verified(problem, motion, 3.0, None)
        assert found.sentence.startswith("contact of cube would be exceeded")
        # What a wrong load does to the arm is known every 5 ms to the verdict, here at every node.
        assert found.excess == pytest.approx(contact.values.max() + more, abs=1e-5)

    def test_distances_of_ones_own_are_looked_at_beside_those_that_are_kept_anyway(self, moving):
        """A metre more than the arm's parts have."""
        problem, motion = moving.problem, moving.committed.motion
        wide = KeepOut(problem.keep_out.parts, problem.keep_out.required + 1.0)
        found = verified(replace(problem, extra=(Clearance(wide),)), motion, 3.0, None)
        assert found.what.startswith("clearance of ")
        assert 8.0 < found.excess < 10.0  # in units of 0.1 m, less what there is beyond what is asked for
        assert verified(replace(problem, extra=(Clearance(problem.keep_out),)), motion, 3.0, None).committed is not None

    def test_the_executed_is_the_same_in_pieces(self, moving):
        motion = moving.committed.motion
        parts = joined(between(motion, 0.0, 0.123), between(motion, 0.123, motion.duration))
        t = np.linspace(0, motion.duration, 200)
        for mine, other in zip(parts.sample(t), motion.sample(t), strict=True):
            assert np.abs(mine - other).max() < 1e-9

    @pytest.mark.slow
    def test_what_a_search_calls_safe_is_looked_at_all_the_same(self, cube, monkeypatch):
        """A search that answers with twice the speed, and says that it is safe."""

        def careless(problem, curve_of, start, *args, **kwargs):
            found = optimise(problem, curve_of, start, *args, **kwargs)
            return replace(found, duration=0.5 * found.duration)

        def careless_at_nodes(*args):
            found = minimise(*args)
            point = found.iterate.point
            return replace(found, iterate=replace(found.iterate, point=replace(point, duration=0.5 * point.duration)))

        def also_careless(problem, options):
            found = fastest(problem, options)
            return replace(found, duration=0.5 * found.duration)

        monkeypatch.setattr("salver.live.replan.optimise", careless)
        monkeypatch.setattr("salver.live.replan.minimise", careless_at_nodes)
        monkeypatch.setattr("salver.live.replan.fastest", also_careless)
        live = Live(cube, lead=LEAD)
        states = drive(live, 0.2, [(0.0, place(0.45, 0.1, 0.45))])
        assert not np.any(states[1])
        assert "is refused" in live.state.refused


class TestCommand:
    def test_it_never_raises_and_keeps_what_was_told(self, cube):
        live = Live(cube, lead=LEAD)
        drive(live, 0.5, [(0.0, place(0.45, 0.1, 0.45))])
        before = live.command(0.5)[0].copy()
        for nonsense in (np.nan, np.inf, None, "now", -1e9, 1e9, [], object()):
            assert np.array_equal(live.command(nonsense)[0], before)
        assert live.state.clock

    @pytest.mark.slow
    def test_when_the_clock_jumps_the_motion_goes_on_where_it_was(self, cube):
        live, other = Live(cube, lead=LEAD), Live(cube, lead=LEAD)
        wishes = [(0.0, place(0.45, 0.1, 0.45))]
        drive(live, 0.4, wishes)
        drive(other, 0.4, wishes)
        live.command(100.0)
        for k in range(1, 200):
            ahead, whole = live.command(100.0 + 1e-3 * k)[0].copy(), other.command(0.399 + 1e-3 * k)[0]
            assert np.abs(ahead - whole).max() < 1e-9

    def test_torque_is_that_of_the_nominal_load(self, cube):
        from salver.models.arm import with_load

        live = Live(cube, lead=LEAD)
        drive(live, 0.45, [(0.0, place(0.45, 0.1, 0.45))])
        q, dq, ddq, tau = live.command(0.45)
        loaded = with_load(live.problem.arm, live.problem.items)
        assert np.abs(dq).max() > 0.1
        assert np.abs(tau - loaded.inverse_dynamics(q, dq, ddq)).max() < 1e-9

    def test_it_makes_nothing_new(self, cube):
        """In a thousand periods the memory that is held does not grow, and no call holds more than a few views."""
        live = Live(cube, lead=LEAD)
        drive(live, 0.4, [(0.0, place(0.45, 0.1, 0.45))])
        times = (0.4 + 1e-3 * np.arange(1000)).tolist()
        first, later = [id(x) for x in live.command(times[0])], times[2:]
        tracemalloc.start()
        try:
            live.command(times[1])
            begun, _ = tracemalloc.get_traced_memory()
            tracemalloc.reset_peak()
            for t in later:
                live.command(t)
            held, peak = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
        assert [id(x) for x in live.command(1.4)] == first
        assert held - begun < 500  # bytes: some numbers
        assert peak - begun < 1500  # and Pinocchio's views of three arrays


class TestWishes:
    def test_what_cannot_be_is_refused_in_a_sentence(self, cube):
        live = Live(cube, lead=LEAD)
        for wish, sentence in (
            (lambda: live.goto((np.nan, 0, 0.5)), "the position has values that are not finite"),
            (lambda: live.goto((450.0, 0, 500.0)), "the position is 500 m away in S; it must be at most 100 m"),
            (lambda: live.goto([1.0, 2.0]), r"the position has shape \(2,\); it must be \(3,\)"),
            (lambda: live.goto(q=np.full(7, 9.0)), "panda_joint1 would be at 9; it must be within"),
            (lambda: live.goto(q=np.zeros(6)), r"the posture has shape \(6,\)"),
            (lambda: live.goto((0.5, 0, 0.5), q=np.zeros(7)), "a goal is a pose or a posture q, one of them"),
            (lambda: live.goto(((0.5, 0, 0.5), np.ones((3, 3)))), "the rotation is none"),
            (lambda: live.goto(((0.5, 0, 0.5), np.diag([1.0, -1, -1]))), "leans the tray by 180 deg"),
        ):
            status = wish()
            assert not status.ok
            assert re.search(sentence, status.sentence)
        assert live.idle
        live.goto((3.0, 0.0, 0.5))
        assert "no posture of the arm within its limits reaches it" in live.plan(60.0).refused
        assert live.idle

    def test_an_obstacle_at_the_goal_is_named(self, cube):
        post = {"type": "box", "name": "post", "position": [0.45, 0.1, 0.45], "size": [0.05, 0.05, 0.4]}
        live = Live(cube.with_changes(obstacles=[post]), lead=LEAD)
        live.goto(((0.45, 0.1, 0.45), np.eye(3)))
        assert re.search("would be inside post.$", live.plan(60.0).refused)
        live.goto((0.45, 0.1, 0.45))
        assert "would be inside post, whichever way it faces." in live.plan(60.0).refused

    def test_from_where_it_rests_near_to_something_it_goes_on(self, cube):
        """A post is half a millimetre further away than it must: more than the arm strays, less than planners keep."""
        post = {"type": "box", "name": "post", "position": [0.6934, -0.37, 0.5], "size": [0.1, 0.4, 1.0]}
        live = Live(cube.with_changes(obstacles=[post]), lead=LEAD)
        q, keep_out = live.problem.start.q[None], live.problem.keep_out
        assert 4e-4 < keep_out.near(q).distances(q).min() < 6e-4 < AT_NODES
        live.command(0.0)
        live.goto((0.45, 0.1, 0.45))
        assert live.plan(60.0).refused == ""

    def test_queued_goals_are_reached_one_after_the_other(self, cube):
        live = Live(cube, lead=LEAD)
        first = live.problem.items[0]
        live.goto((0.5, -0.25, 0.42))
        live.goto((0.48, -0.3, 0.45), queued=True)
        states = drive(live, 2.0)
        check(live, states)
        along = np.array([live.problem.arm.object_pose(q, first.p_EB, first.R_EB)[0] for q in states[0][::10]])
        for goal in ((0.5, -0.25, 0.42), (0.48, -0.3, 0.45)):
            assert np.abs(along - goal).max(axis=1).min() < 1e-4
        assert np.abs(along[-1] - (0.48, -0.3, 0.45)).max() < 1e-6

    def test_an_arm_that_is_elsewhere_is_stopped(self, cube):
        live = Live(cube, lead=LEAD)
        drive(live, 0.4, [(0.0, place(0.45, 0.1, 0.45))])
        told = live.command(0.4)[0].copy()
        assert live.measured(told + 0.01).ok
        assert (
            "panda_joint1 is 0.100 rad from where it was told to be"
            in live.measured(told + np.eye(7)[0] * 0.1).sentence
        )
        assert live.plan(60.0).doing == "stopping"

    def test_a_load_that_is_not_safe_at_rest_is_not_begun_with(self, cube, problem):
        with pytest.raises(ScenarioError, match="the load is not safe at rest at q"):
            Live(cube, q=np.array([0.0, 0.5, 0.0, -1.5, 0.0, 2.6, 0.0]))  # the tray leans
        with pytest.raises(ScenarioError, match=r"clearance of tray from wall would be (3|3\.\d) mm too small"):
            beside_a_wall(problem, -0.003)
        parts = beside_a_wall(problem, 0.003).problem.keep_out  # nearer than the 5 mm that are kept elsewhere
        pair = [(parts.parts.names[i], parts.parts.names[j]) for i, j in parts.parts.pairs].index(("tray", "wall"))
        assert parts.required[pair] == pytest.approx(0.0015, abs=1e-6)

    @pytest.mark.slow
    def test_it_leaves_a_wall_that_it_is_beside(self, problem):
        live = beside_a_wall(problem, 0.003)
        states = drive(live, 2.0, [(0.0, place(0.5, -0.1, 0.5))])
        assert not live.state.refused
        assert live.problem.arm.tray_pose(states[0][-1])[0][1] > -0.11
        check(live, states)

    def test_a_posture_that_is_clear_is_found_where_the_first_one_is_not(self, cube):
        """Near the base the posture that is nearest to the middle of the joints' ranges has the tray in the forearm."""
        position = (0.26, 0.29, 0.34)
        live = Live(cube.with_changes(arm__start_posture=None, motion__start__position=position))
        problem, q = live.problem, live.committed.motion.q[:1]
        middle = problem.start.nearest(problem.arm, problem.limits, problem.limits.range(POSITION)[0])
        assert problem.keep_out.distances(middle[None]).min() < 0
        assert problem.keep_out.distances(q).min() > 0
        np.testing.assert_allclose(problem.start.residual(problem.arm, q[0])[0], 0.0, atol=1e-6)


@pytest.mark.slow
def test_where_nothing_is_uncertain_too_rows_are_kept_with_commands_that_are_held(cube):
    """Held commands are short of what they should be even where the load is known."""
    known = cube.with_changes(
        objects=[{**item.model_dump(exclude_none=True), "uncertainty": {}} for item in cube.objects]
    )
    live = Live(known, lead=LEAD)
    assert not live.problem.payload.uncertain.names
    states = drive(live, 0.3, [(0.0, place(0.45, 0.1, 0.45)), (0.2, lambda live: live.twist([0.3, 0.2, 0.0]))])
    states = in_turn(states, drive(live, 1.5, begins=0.3))
    assert np.abs(states[0][-1] - states[0][0]).max() > 0.05
    worst = rows_of(live.problem, states)
    assert max(worst.values()) <= 0.0, worst


@pytest.mark.slow
def test_a_goal_is_found_from_every_state_of_a_way_elsewhere(cube):
    """And the motion there takes hardly longer than one that a thorough search finds."""
    live = Live(cube, lead=LEAD)
    drive(live, 0.3, [(0.0, place(0.5, -0.3, 0.5))])
    base, replanner, rng = live.committed, Replanner.of(live.problem), np.random.default_rng(22)
    longer = []
    for begins in base.nodes[:: len(base.nodes) // 6]:
        end = pose_goal(live.problem, rng.uniform([0.4, -0.4, 0.35], [0.55, 0.15, 0.6])).end
        found, status = replanner.to(end, base, begins, 60.0)
        assert found is not None, status.sentence
        at = replace(replanner.sought, start=AtPosture(*base.state(begins)), goal=end)
        at = replace(at, tracking=at.tracking.begun(base.deviation_at(begins, live.problem)))
        longer.append(found.motion.duration / fastest(at).duration)
    assert max(longer) < 1.15, longer


@pytest.mark.slow
def test_a_worker_plans_while_the_loop_runs(cube):
    live = Live(cube)
    live.goto((0.5, -0.25, 0.45))
    with Worker(live) as worker:
        begun = time.perf_counter()
        while live.committed.at_rest and time.perf_counter() < begun + 20:
            live.command(time.perf_counter())
            time.sleep(1e-3)
        assert worker.alive
    assert not live.committed.at_rest
    assert not worker.alive


def test_resting_is_a_motion_too(cube):
    live = Live(cube)
    motion = resting(live.problem.start.q)
    assert verified(live.problem, motion, 3.0, live.committed).committed is not None


def test_the_first_guess_of_a_way_ends_in_the_posture_that_is_nearest(cube):
    """A redundant arm reaches a pose in many ways: to where the tray is already it takes none at all."""
    problem = Live(cube).problem
    begun = replace(problem, start=AtPosture(problem.start.q))
    p, R = problem.arm.tray_pose(problem.start.q)
    guess = straight(replace(begun, goal=AtPose(PoseTarget(p, R))))
    assert np.abs(guess.coefficients - problem.start.q).max() < 1e-3
