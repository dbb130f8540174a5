"""Load-safe stops: from anywhere along a plan to rest, with the load in its place for the whole uncertain set."""

from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

import salver as sv
from salver.cli import app
from salver.control.arm import ArmState
from salver.driver.stops import CoolStop
from salver.errors import ScenarioError
from salver.models.arm import with_load
from salver.planning.fastest import transport_problem
from salver.planning.fastest.constraints import evaluate, worst_of
from salver.planning.stop_library import StopLibrary
from salver.planning.stops import plan_stops, stopped, with_stops


@pytest.fixture(scope="module")
def bottle():
    """The fastest plan of the tall bottle, with a stop every 60 ms where one was found."""
    plan = sv.plan("panda-tall-bottle")
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


def test_whenever_it_is_asked_for_the_arm_rests_no_later_than_with_the_plan(bottle):
    for now in np.linspace(0, bottle.duration, 301):
        assert bottle.stops.rests_at(now) <= bottle.duration
        motion = bottle.stops.stopped(bottle.joint, now)
        assert motion.duration == pytest.approx(bottle.stops.rests_at(now))
        until = np.linspace(0, now, 7)
        assert np.allclose(motion.sample(until)[0], bottle.joint.sample(until)[0], atol=1e-9)  # not before it is asked
    waits = [bottle.stops.rests_at(now) - now for now in np.linspace(0, bottle.duration, 2001)]
    assert max(waits) <= bottle.stops.longest + 1e-9
    assert bottle.stops.longest < 0.7 * bottle.duration


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
    """The same corners: with the planned stop it holds in the engine, with the cool stop's motion it falls."""
    loaded = with_load(transport_problem(bottle.scenario).arm, transport_problem(bottle.scenario).items)
    uncertain, fallen = bottle.uncertain, 0
    for now, signs in ((0.25, 1), (0.45, -1), (0.6, 1)):
        values = uncertain.nominal + signs * uncertain.half_range * np.array(
            [-signs if n == "friction" else 1 for n in uncertain.names]
        )
        parameters = dict(zip(map(str, uncertain.names), values.tolist(), strict=True))
        assert sv.simulate(stopped(bottle, now), parameters=parameters).outcome == "holds"
        fallen += sv.simulate(_cooled(bottle, loaded, now), parameters=parameters).outcome != "holds"
    assert fallen >= 2


def _cooled(plan, loaded, now):
    """The plan up to an instant and then the driver's cool stop, which knows nothing of the load."""
    q, dq, _ = (x[0] for x in plan.joint.sample(now))
    stop = CoolStop(loaded, ArmState(q, dq))
    s = np.linspace(0, stop.braking, 61)
    states = (np.array(x) for x in zip(*(stop.reference(x) for x in s), strict=True))
    library = StopLibrary(
        np.array([now]), np.array([stop.braking]), s / stop.braking, *(x[None] for x in states), np.inf
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


def test_what_has_no_stops_says_so_in_a_sentence(bottle):
    with pytest.raises(ScenarioError, match="has no stops"):
        stopped(replace(bottle, stops=None), 0.1)
    with pytest.raises(ScenarioError, match="asked for at 9 s; the plan lasts"):
        stopped(bottle, 9.0)
    with pytest.raises(ScenarioError, match="safe fastest plans"):
        with_stops(sv.plan("panda-cube"))
