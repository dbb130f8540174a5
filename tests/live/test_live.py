"""Live motions: at every moment one is committed that ends at rest with the load in place, whatever happens."""

import gc
import importlib.util
import os
import sys
import time
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, example, given, settings
from hypothesis import strategies as st

import salver as sv
from live_runs import LEAD, check, drive, executed, halted, in_turn, place, rows_of
from salver.live import Live, Worker
from salver.live.replanning.replan import Replanner
from salver.live.replanning.wishes import pose_goal
from salver.planning.fastest import fastest, joint_plan
from salver.planning.trajopt.ends import AtPosture


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
wish = st.one_of(goals, st.just(halted), st.just(Live.stop), garbage)


@pytest.mark.slow
@settings(
    max_examples=4,
    deadline=None,
    derandomize=True,
    suppress_health_check=list(HealthCheck),
    phases=[Phase.explicit, Phase.generate],  # what was wished is short, to make it shorter takes minutes
)
@example([(0.0, halted), (0.0, place(0.5, 0.0, 0.5)), (0.0, place(0.35, 0.0, 0.3)), (0.0078, Live.stop)], 1)
@example([(0.0, place(0.375, 0.0, 0.305)), (0.006, halted), (0.2, Live.stop)], 2)
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
    assert live.state.requests[-1].why == "the planner failed (ArithmeticError)"
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


def test_it_never_raises_and_keeps_what_was_told(cube):
    live = Live(cube, lead=LEAD)
    drive(live, 0.5, [(0.0, place(0.45, 0.1, 0.45))])
    before = live.command(0.5)[0].copy()
    for nonsense in (np.nan, np.inf, None, "now", -1e9, 1e9, [], object()):
        assert np.array_equal(live.command(nonsense)[0], before)
    assert live.state.clock


@pytest.mark.slow
def test_when_the_clock_jumps_the_motion_goes_on_where_it_was(cube):
    live, other = Live(cube, lead=LEAD), Live(cube, lead=LEAD)
    wishes = [(0.0, place(0.45, 0.1, 0.45))]
    drive(live, 0.4, wishes)
    drive(other, 0.4, wishes)
    live.command(100.0)
    for k in range(1, 200):
        ahead, whole = live.command(100.0 + 1e-3 * k)[0].copy(), other.command(0.399 + 1e-3 * k)[0]
        assert np.abs(ahead - whole).max() < 1e-9


def test_torque_is_that_of_the_nominal_load(cube):
    from salver.models.arm.arm import with_load

    live = Live(cube, lead=LEAD)
    drive(live, 0.45, [(0.0, place(0.45, 0.1, 0.45))])
    q, dq, ddq, tau = live.command(0.45)
    loaded = with_load(live.problem.arm, live.problem.items)
    assert np.abs(dq).max() > 0.1
    assert np.abs(tau - loaded.inverse_dynamics(q, dq, ddq)).max() < 1e-9


def test_it_makes_nothing_new(cube):
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


def test_while_the_loop_has_not_taken_what_was_planned_there_is_nothing_to_plan(cube):
    """Or else whoever plans would ask without end, and the loop's interpreter with it."""
    live = Live(cube, lead=LEAD)
    live.command(0.0)
    live.goto((0.45, 0.1, 0.45))
    assert not live.idle
    live.plan(60.0)
    assert live.committed.at_rest
    assert live.idle


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "sched_setscheduler"), reason="this system has no real-time priorities")
def test_the_process_that_plans_has_no_real_time_priority(cube):
    """The loop's thread has, and so has the one that exchanges with it."""
    live, worker = Live(cube), None
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    except PermissionError:
        pytest.skip("no real-time priority is allowed here")
    try:
        worker = Worker(live).start()
        assert os.sched_getscheduler(worker._thread.native_id) == os.SCHED_FIFO
        assert os.sched_getscheduler(worker._process._running.pid) == os.SCHED_OTHER
    finally:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        if worker is not None:
            worker.close()


@pytest.mark.slow
@pytest.mark.parametrize("given", [{}, {"process": False}], ids=["by default a process", "a thread"])
def test_a_worker_plans_while_the_loop_runs(cube, given):
    live = Live(cube)
    live.goto((0.5, -0.25, 0.45))
    with Worker(live, **given) as worker:
        assert (worker._process is not None) == (not given)
        begun = time.perf_counter()
        while live.committed.at_rest and time.perf_counter() < begun + 20:
            live.command(time.perf_counter())
            time.sleep(1e-3)
        assert worker.alive
    assert not live.committed.at_rest
    assert not worker.alive


@pytest.mark.parametrize("before", [False, True], ids=["nobody froze it", "it was frozen before"])
def test_while_a_worker_runs_no_collection_goes_through_what_existed_before(cube, before):
    """Such a collection delayed the announcement of an obstacle by up to 40 ms. Who froze it before keeps it so."""
    live = Live(cube)
    frozen = gc.get_freeze_count()
    gc.unfreeze()
    try:
        if before:
            gc.freeze()
        with Worker(live, process=False):
            assert gc.get_freeze_count() > 10_000
        assert (gc.get_freeze_count() > 10_000) == before
    finally:
        if frozen:
            gc.freeze()


def test_what_python_froze_at_its_start_is_nobodys_freeze(cube, monkeypatch):
    """Python 3.12 begins with frozen objects; a worker's module comes later, and what it froze is let go."""
    live, frozen = Live(cube), gc.get_freeze_count()
    gc.freeze()
    try:
        spec = importlib.util.spec_from_file_location("late_worker", sys.modules[Worker.__module__].__file__)
        late = importlib.util.module_from_spec(spec)
        monkeypatch.setitem(sys.modules, "late_worker", late)
        spec.loader.exec_module(late)
        with late.Worker(live, process=False):
            assert gc.get_freeze_count() > 10_000
        assert not gc.get_freeze_count()
    finally:
        gc.freeze() if frozen else gc.unfreeze()
