"""Load-safe stops: from anywhere along a plan to rest, with the load in its place for the whole uncertain set."""

import json
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

import salver as sv
from salver.campaigns import run_campaign
from salver.campaigns.summary import read_table, summarise
from salver.cli import app
from salver.control.arm import ArmState
from salver.driver.preflight import _stops
from salver.driver.stops import ControlledStop
from salver.errors import FileFormatError, ScenarioError, Status
from salver.models.arm.arm import load_arm, with_load
from salver.planning.fastest import AtPosture, transport_problem
from salver.planning.stop_library import StopLibrary
from salver.planning.stops import (
    plan_stops,
    stop_from,
    stop_problem,
    stopped,
    with_stops,
)
from salver.planning.trajopt.constraints.constraints import evaluate, worst_of

PAPER = sv.load_scenario("panda-cube")


@pytest.fixture(scope="module")
def bottle(bottle_plan):
    """The fastest plan of the tall bottle, with a stop every 60 ms where one was found."""
    plan = bottle_plan
    return replace(plan, stops=plan_stops(transport_problem(plan.scenario), plan.joint, every=0.06))


@pytest.mark.slow
def test_a_stop_begins_in_the_plans_state_and_ends_at_rest(bottle):
    stops = bottle.stops
    assert len(stops.t) >= 8
    q, dq, ddq = bottle.joint.sample(stops.t)
    assert np.abs(stops.q[:, 0] - q).max() < 1e-9
    assert np.abs(stops.dq[:, 0] - dq).max() < 1e-8
    assert np.abs(stops.ddq[:, 0] - ddq).max() < 1e-6
    assert max(np.abs(stops.dq[:, -1]).max(), np.abs(stops.ddq[:, -1]).max()) < 1e-6


@pytest.mark.slow
def test_whenever_it_is_asked_for_the_arm_rests_no_later_than_with_the_plan(bottle):
    for now in np.linspace(1e-3, bottle.duration, 301):
        rests = bottle.stops.course(now).rests
        assert now <= rests <= bottle.duration
        motion = bottle.stops.stopped(bottle.joint, now)
        assert motion.duration == pytest.approx(rests)
        until = np.linspace(0, now, 7)
        assert np.allclose(motion.sample(until)[0], bottle.joint.sample(until)[0], atol=1e-9)  # not before it is asked
    waits = [bottle.stops.course(now).rests - now for now in np.linspace(0, bottle.duration, 2001)]
    assert max(waits) <= bottle.stops.longest + 1e-9
    assert bottle.stops.longest < 0.7 * bottle.duration


@pytest.mark.slow
def test_before_it_begins_nothing_moves_and_near_its_end_it_is_finished(bottle):
    stops = bottle.stops
    for now in (-0.1, 0.0):
        assert stops.course(now).rests == now
        assert stops.course(now).stop is None
    assert stops.course(stops.t[-1] + 1e-6).rests == bottle.duration
    assert stops.t[-1] < stops.finishing < bottle.duration
    for now in (stops.finishing - 1e-3, stops.finishing + 1e-6):
        assert (stops.course(now).stop is None) == (now > stops.finishing)
    assert f"from {stops.finishing:.2f} s on only by finishing" in stops.sentence
    none = replace(stops, t=stops.t[:0], duration=stops.duration[:0])
    assert none.sentence.endswith(f"it can only be finished, within {bottle.duration:.2f} s.")
    assert none.longest == pytest.approx(bottle.duration)


@pytest.mark.slow
def test_what_is_moved_keeps_every_condition_from_the_first_instant_to_rest(bottle):
    """Judged as one motion from the plan's own start, as arm and load go through it: nothing is carried over."""
    problem = transport_problem(bottle.scenario)
    for now in bottle.stops.t[::3]:
        motion = bottle.stops.stopped(bottle.joint, float(now))
        s = np.linspace(0, 1, 601)
        z = np.stack([*motion.sample(s * motion.duration), motion.jerk(s * motion.duration)])
        value, name = worst_of(evaluate(problem.constraints, problem.at(s, z, motion.duration), margins=False))
        assert value < 2e-3, (
            f"{name} at a stop from {now:.2f} s"
        )  # jerk and torque rate jump inside a step of this grid


@pytest.mark.slow
def test_the_bottle_stays_at_the_worst_corners_where_braking_without_a_plan_drops_it(bottle):
    """The same corners: with the planned stop it holds in the engine, with the controlled stop's motion it falls."""
    loaded = with_load(transport_problem(bottle.scenario).arm, transport_problem(bottle.scenario).items)
    uncertain, fallen = bottle.uncertain, 0
    for now, signs in ((0.25, 1), (0.45, -1), (0.6, 1)):
        values = uncertain.nominal + signs * uncertain.half_range * np.array(
            [-signs if n == "friction" else 1 for n in uncertain.names]
        )
        parameters = dict(zip(map(str, uncertain.names), values.tolist(), strict=True))
        assert sv.simulate(bottle, parameters=parameters, stop_at=now).outcome == "holds"
        fallen += sv.simulate(_cooled(bottle, loaded, now), parameters=parameters).outcome != "holds"
    assert fallen >= 2


def _cooled(plan, loaded, now):
    """The plan up to an instant and then the driver's controlled stop, which knows nothing of the load."""
    q, dq, _ = (x[0] for x in plan.joint.sample(now))
    stop = ControlledStop(loaded, ArmState(q, dq))
    s = np.linspace(0, stop.braking, 61)
    states = (np.array(x) for x in zip(*(stop.reference(x) for x in s), strict=True))
    library = StopLibrary(
        np.array([now]),
        np.array([stop.braking]),
        s / stop.braking,
        *(x[None] for x in states),
        np.zeros((2, 7)),
        np.inf,
    )
    return stopped(replace(plan, stops=library), now)


@pytest.mark.slow
def test_stops_come_back_from_the_files_of_a_plan(bottle, tmp_path):
    bottle.save(tmp_path)
    again = sv.load_plan(tmp_path)
    for name, array in bottle.stops.arrays().items():
        assert np.array_equal(array, again.stops.arrays()[name])
    assert again.stops.longest == bottle.stops.longest
    done = CliRunner().invoke(app, ["simulate", str(tmp_path), "--stop-at", "0.3"])
    assert done.exit_code == 0, done.output
    assert "bottle holds" in done.output
    written = sorted(path.name for path in (tmp_path / "simulation").iterdir())
    assert written == ["plan-stop.json", "plan-stop.npz"]  # not what the page takes for a run of the plan


@pytest.mark.slow
def test_a_campaign_of_stops_goes_on_and_each_run_comes_again_alone(bottle, tmp_path):
    """Each run has its own instant, the same when it is made again; more runs keep the first three."""
    bottle.save(tmp_path)
    earlier = read_table(run_campaign(tmp_path, 3, method="corners", stops=True, jobs=1).folder / "runs.parquet")
    both = sv.campaign(tmp_path, 5, method="corners", stops=True, jobs=1)
    table = read_table(both.folder / "runs.parquet")
    assert both.folder.name == "stops"
    assert {name: values[:3] for name, values in table.items()} == earlier
    assert table["stop_at"] == [both.definition.stop_at(k, bottle.duration) for k in range(5)]
    assert len(set(table["stop_at"])) == 5
    for now, takes in zip(table["stop_at"], table["stop_takes"], strict=True):
        assert takes == pytest.approx(bottle.stops.course(now).rests - now)
    told = both.summary["plans"]["plan"]["stops"]
    assert (told["lost"]["count"], told["lost"]["of"], told["beyond_a_limit"]["count"]) == (0, 5, 0)
    alone = CliRunner().invoke(app, ["simulate", str(tmp_path), "--run", "4", "--folder", "stops", "--json"])
    assert json.loads(alone.stdout)["plan"]["stop_at"] == table["stop_at"][4]
    assert json.loads(alone.stdout)["plan"]["objects"][0]["peak_slip"] == table["peak_slip"][4]


def test_lost_and_beyond_a_limit_are_counted_from_what_became_of_the_load(tmp_path):
    became = (
        [("holds", 1e-5, False), ("slides", 4e-3, True), ("slides", 6e-3, False), ("tips", 0.0, False)],
        [("lifts", 0.0, False), ("lost", 0.3, False), ("limit", 1e-4, False), ("holds", 1e-4, True)],
    )
    names = ("outcome", "peak_slip", "finishes")
    same = {"stem": "plan", "stop_at": 0.1, "stop_takes": 0.2}
    runs = enumerate(run for half in became for run in half)
    rows = [{**same, "run": k, **dict(zip(names, run, strict=True))} for k, run in runs]
    told = summarise(rows, ["plan"], tmp_path)["plans"]["plan"]["stops"]
    assert (told["lost"]["count"], told["lost"]["of"], told["beyond_a_limit"]["count"], told["finished"]) == (
        4,
        8,
        1,
        2,
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda s: {"q": s.q + 1e-4}, "does not begin where the arm is then"),
        (lambda s: {"dq": np.where(np.arange(len(s.s))[:, None] < len(s.s) - 1, s.dq, 0.01)}, "does not end at rest"),
        (lambda s: {"duration": 0.7 * s.duration}, "is not safe"),
        (lambda s: {"t": s.t[::-1]}, "their times do not increase"),
        (lambda s: {"s": np.where(np.arange(len(s.s)) == 2, s.s[1], s.s)}, "their times do not increase"),
        (lambda s: {"ddq": np.where(s.ddq == s.ddq.max(), np.nan, s.ddq)}, "stop_ddq is not an array of numbers"),
        (lambda s: {"stray": s.stray[1:]}, "stop_stray is not an array of numbers"),
    ],
)
def test_nothing_moves_with_stops_that_are_not_what_they_should_be(bottle, change, words):
    case = bottle.scenario
    arm = load_arm(case.arm, case.tray)
    stops = bottle.stops
    few = replace(stops, **{x: getattr(stops, x)[::4] for x in ("t", "duration", "q", "dq", "ddq")})
    few = replace(few, stray=stops.stray[-len(few.t) - 1 :])
    assert _stops(replace(bottle, stops=few), arm).ok
    told = _stops(replace(bottle, stops=replace(few, **change(few))), arm)
    assert words in told.sentence
    assert not told.ok
    assert told.required


@pytest.mark.slow
def test_stops_are_judged_for_every_load_of_the_set(bottle):
    """The same stops, with friction that may be a third less than was planned for: the nominal bottle would stay."""
    arm = load_arm(bottle.scenario.arm, bottle.scenario.tray)
    wide = bottle.scenario.with_changes(objects__0__uncertainty__friction="40%")
    assert _stops(bottle, arm).ok
    told = _stops(replace(bottle, scenario=wide), arm)
    assert not told.ok
    assert "is not safe" in told.sentence


@pytest.mark.slow
def test_what_has_no_stops_says_so_in_a_sentence(bottle):
    with pytest.raises(ScenarioError, match="has no stops"):
        stopped(replace(bottle, stops=None), 0.1)
    with pytest.raises(ScenarioError, match="asked for at 9 s; it must be after 0"):
        stopped(bottle, 9.0)
    unsafe = replace(bottle, status=Status("infeasible", "No.", False))
    for plan in (sv.plan("panda-cube", arm=False), unsafe):
        with pytest.raises(ScenarioError, match="safe plans of an arm"):
            with_stops(plan)
    with pytest.raises(ScenarioError, match="has no arm"):
        sv.simulate(replace(bottle, scenario=bottle.scenario.with_changes(arm=None)), stop_at=0.1)
    arrays = bottle.stops.arrays()
    del arrays["stop_stray"]
    with pytest.raises(FileFormatError, match="lack the array stop_stray"):
        StopLibrary.of_arrays(arrays, 1.0)


@pytest.mark.slow
def test_a_plan_in_object_space_stops_in_the_joints_and_keeps_its_load():
    """Its controller closes the loop on the cube's pose; the stop's on the joints, from the deviation as it then is."""
    plan = sv.plan(sv.load_scenario("panda-cube", motion__duration=1.25))
    stops = plan_stops(stop_problem(plan), plan.joint, every=0.25, space=plan.space)
    plan = replace(plan, stops=stops)
    assert plan.space == "object"
    assert np.abs(stops.t[:, None] - [0.25, 0.5, 0.75, 1.0]).min(axis=0).max() < 1e-9  # and between, where one is late
    assert stops.duration.max() < 0.4
    for now, mass in ((0.3, 0.2816), (0.7, 0.2304)):
        run = sv.simulate(plan, parameters={"mass": mass}, stop_at=now)
        assert run.outcome == "holds"
        assert run.summary["arm"]["torque_rate_cut"] == 0  # nothing jumps where one controller follows the other
        assert run.t[-1] < stops.course(now).rests + 0.6
        off = np.abs(run.q - stops.stopped(plan.joint, now).sample(run.t)[0]).max(axis=0)
        # As far as was said; at nominal parameters too the engine's arm is up to 0.2 mrad from where it is expected.
        assert np.all(off <= stops.stray[stops.course(now).stop] + 2e-4)
        assert off.max() > 0.7 * stops.stray.max()  # and that is no idle bound: this is a corner


@pytest.mark.slow
def test_while_the_arm_leans_into_its_first_acceleration_it_is_soon_at_rest(bottle):
    """In at most 1.6 times what the joints take when nothing stands on the tray; instants lie closer there."""
    early = np.flatnonzero(bottle.stops.t < 0.1)
    assert np.abs(bottle.stops.t[:, None] - [0.06, 0.09]).min(axis=0).max() < 1e-9
    for k in early:
        q, dq, _ = bottle.joint.sample(bottle.stops.t[k])
        arm = with_load(load_arm(bottle.scenario.arm, bottle.scenario.tray), bottle.scenario.payload.bodies)
        assert bottle.stops.duration[k] < 1.6 * ControlledStop(arm, ArmState(q[0], dq[0])).braking


@pytest.mark.slow
def test_a_path_of_ones_own_made_faster_can_be_stopped_too(tmp_path):
    """By the command: the cube at the worst corner, stopped half way, stays."""
    sv.plan("panda-cube").save(tmp_path / "given")
    run = CliRunner().invoke(app, ["retime", str(tmp_path / "given"), "-o", str(tmp_path / "quick"), "--stops"])
    assert run.exit_code == 0, run.output
    quick = sv.load_plan(tmp_path / "quick")
    assert quick.stops is not None
    assert quick.stops.longest < 0.5 * quick.duration
    now = 0.5 * quick.duration
    rests = quick.stops.course(now).rests
    corner = dict(zip(quick.uncertain.names, quick.uncertain.nominal + quick.uncertain.half_range, strict=True))
    record = sv.simulate(quick, parameters={name: float(x) for name, x in corner.items()}, stop_at=now)
    assert record.summary["outcome"] == "holds"
    assert np.abs(record.dq[record.t > rests + 0.3]).max() < 0.02


@pytest.mark.slow
def test_a_motion_of_ones_own_can_be_stopped_from_any_state(bottle):
    """Without a guess, and not on any plan: the bottle's, a tenth slower. It begins in that state."""
    problem = transport_problem(bottle.scenario)
    q, dq, ddq = (x[0] for x in bottle.joint.sample(0.3))
    found = stop_from(problem, AtPosture(q, 0.9 * dq, 0.81 * ddq))
    begin = [x[0] for x in (found.motion.q, found.motion.dq, found.motion.ddq)]
    assert np.allclose(np.concatenate(begin), np.concatenate([q, 0.9 * dq, 0.81 * ddq]), atol=1e-9)
    assert np.abs(found.motion.dq[-1]).max() < 1e-9
    assert found.motion.duration < bottle.stops.course(0.3).rests - 0.3
    assert stop_from(problem, AtPosture(q, 3 * dq)) is None  # beyond the speed limit
    takes = found.motion.duration
    assert stop_from(problem, AtPosture(q, 0.9 * dq, 0.81 * ddq), beat=0.9 * takes) is None
    assert stop_from(problem, AtPosture(q, 0.9 * dq, 0.81 * ddq), beat=1.05 * takes).motion.duration == takes
