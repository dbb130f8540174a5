"""A liquid on a tray that is already moving: waves that go on, and stops that know them."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

import salver as sv
from live_runs import ROUNDS
from salver.driver.preflight import check_plan
from salver.models.arm.arm import load_arm
from salver.planning.fastest import plan_fastest
from salver.planning.stop_library import StopLibrary
from salver.planning.stops import STORED, along, past_of, plan_stops, stop_from, stop_problem, stopped, stopping
from salver.planning.trajopt.ends import Anywhere, AtPosture
from salver.planning.trajopt.evaluation import MotionEvaluation
from salver.planning.trajopt.problem import TransportProblem, transport_problem
from salver.planning.verdict.verify import verify
from salver.sensitivity.arm.compliance import LoadResponses
from salver.simulation.physics import simulate
from salver.trajectory import JointMotion
from shaken_loads import BOX
from transport_problems import ROUGH, cup_and_jar

BESIDE = {"objects__0__uncertainty__position": [0.008, 0.005]}
NOW, END = 0.3, 0.8  # s: when a motion is left, and its end


def swinging(problem: TransportProblem) -> JointMotion:
    """All joints aside by up to .4 rad, the tray turning about every axis under the waves."""
    t = np.linspace(0.0, END, 801)
    s, away = t[:, None] / END, np.array([0.4, 0.1, 0.0, 0.1, -0.05, 0.12, 0.3])
    blend = (s**3 * (10 - 15 * s + 6 * s**2), 30 * s**2 * (1 - s) ** 2, 60 * s * (1 - s) * (1 - 2 * s))
    q, dq, ddq = (x * away / END**k for k, x in enumerate(blend))
    return JointMotion(t, problem.start_posture + q, dq, ddq)


def seen(problem: TransportProblem, motion: JointMotion, t: np.ndarray, since: float = 0.0) -> MotionEvaluation:
    """A motion at instants t, as one that begins at `since`."""
    q, dq, ddq = motion.sample(t)
    takes = END - since
    at = problem.at((t - since) / takes, np.stack([q, dq, ddq, motion.jerk(t)]), takes, imposed=False)
    return at.knowing(loads=LoadResponses.of(problem.cases, t - since, at.terms.w, at.response, problem.past, ROUNDS))


def left(problem: TransportProblem, motion: JointMotion, now: float = NOW) -> TransportProblem:
    """The problem of going on from an instant of a motion."""
    t, felt, strayed = along(problem, motion, "joint")
    state, past = AtPosture(*(x[0] for x in motion.sample(now))), replace(past_of(problem, t, felt, strayed), now=now)
    tracking = None if strayed is None else problem.tracking.begun(strayed.state_at(t, now))
    return replace(problem, start=state, goal=Anywhere(), tracking=tracking, past=past)


@pytest.mark.parametrize("shape", [{}, BOX, BESIDE], ids=["cylinder", "box", "place"])
def test_waves_of_a_motion_that_goes_on_are_those_of_both_together(shape):
    """A motion that is left and gone on with is one motion: at each of its later instants the waves are as high, push
    as hard, and leave as much, as planned and with what the arm makes of them and of an unknown load: but for what two
    rounds of waves and arm are off before it is left."""
    problem = transport_problem(sv.load_scenario("panda-coffee").with_changes(**shape))
    motion, after = swinging(problem), np.linspace(NOW, END, 101)
    whole = seen(problem, motion, np.concatenate([np.linspace(0, NOW, 61)[:-1], after]))
    later = seen(left(problem, motion), motion, after, since=NOW)
    (name, parts), *_ = later.loads.items()
    for found, known in zip(parts, whole.loads[name], strict=True):
        for what in ("crest", "free_height", "lightness", "wrench"):
            of_both = getattr(known, what)[:, 60:]
            np.testing.assert_allclose(getattr(found, what), of_both, atol=2e-3 * np.abs(of_both).max(), err_msg=what)
        np.testing.assert_allclose(found.left(), known.left(), rtol=1e-3)
        np.testing.assert_allclose(found.free_left, known.free_left, rtol=1e-3)
    np.testing.assert_allclose(later.joint_radius(0), whole.joint_radius(0)[60:], atol=2e-4 * 0.3)
    # It matters: as if level when it is left, the waves are others by a third.
    afresh = seen(replace(left(problem, motion), past=None), motion, after, since=NOW).loads[name][0]
    assert np.abs(afresh.crest - parts[0].crest).max() > 0.3 * parts[0].crest.max()


@pytest.mark.slow
def test_a_slow_plan_with_coffee_is_stopped_long_before_its_end_and_nothing_spills():
    """In the engine too, at the fullest and with the least damping, when the tray is at its fastest."""
    case = sv.load_scenario("panda-coffee").with_changes(motion__duration=1.6, motion__speeds="full")
    bare = sv.plan(case, method="baseline")
    assert bare.joint is not None
    plan = replace(bare, stops=plan_stops(stop_problem(bare), bare.joint, every=0.4, space=bare.space))
    assert plan.stops is not None
    assert plan.stops.longest < 1.0
    now = 0.8
    done = stopped(plan, now)
    assert done.duration - now < 0.5
    assert done.margins.verdict(worst=True).ok
    arm = load_arm(case.arm, case.tray)
    assert [
        check.sentence for check in check_plan(plan, arm, case.payload.bodies) if check.name == "stops" and not check.ok
    ] == []
    full = {"fill": 0.065, "damping": 0.002, "mass": 0.275, "friction": 0.36}
    assert simulate(plan, parameters=full, stop_at=now).outcome == "holds"


@pytest.mark.slow
def test_a_stop_keeps_the_coffee_of_a_cup_beside_its_place():
    """In the engine with the cup at every corner of its range, on a tray that is turning by 90 degrees; a stop for the
    exact place is refused."""
    now = 0.6
    turned = {"motion__goal_yaw": "fixed", "motion__goal__rpy_deg": [0.0, 0.0, 90.0], "motion__speeds": "full"}
    exact = sv.load_scenario("panda-coffee").with_changes(**turned)
    plan = plan_fastest(exact.with_changes(objects__0__uncertainty__position=[0.01, 0.01]), options=ROUGH)
    begun, other = (
        left(stop_problem(replace(plan, scenario=case)), plan.joint, now) for case in (plan.scenario, exact)
    )
    found, wrong = (stop_from(problem, problem.start) for problem in (begun, other))
    states = (begun.start.q, *begun.start.rates)
    assert verify(begun, found.motion, states, stopping(found.motion.duration)).ok
    assert not verify(begun, wrong.motion, states, stopping(wrong.motion.duration)).ok
    motion, stray = found.motion, np.stack([found.stray] * 2)
    each = (x[None] for x in (motion.q, motion.dq, motion.ddq))
    one = StopLibrary(np.array([now]), np.array([motion.duration]), STORED, *each, stray, plan.duration)
    full = {"fill": 0.065, "damping": 0.002, "mass": 0.275, "friction": 0.36}
    for x, y in product((-0.01, 0.01), repeat=2):
        run = simulate(replace(plan, stops=one), parameters=full | {"position_x": x, "position_y": y}, stop_at=now)
        assert run.outcome == "holds"


@pytest.mark.slow
def test_a_cup_stays_where_the_tray_leans_after_a_stop():
    """At rest on an incline friction must be its tangent, whatever the liquid did when the tray stopped: a stop that
    ended on 16 degrees, with .27 sure, slid 4 mm."""
    plan = plan_fastest(cup_and_jar().with_changes(motion__speeds="full"), options=ROUGH)
    problem = stop_problem(plan)
    found = plan_stops(problem, plan.joint, every=0.11)
    assert len(found.t) > 0
    leans = np.array([problem.arm.tray_pose(q[-1])[1][2, 2] for q in found.q])
    np.testing.assert_array_less(np.sqrt(1 - leans**2) / leans, 0.27)
    run = simulate(replace(plan, stops=found), parameters={"cup.friction": 0.27}, stop_at=0.11)
    assert run.outcome == "holds"
    assert run.slip[:, 0].max() < 1e-4
