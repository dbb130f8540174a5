"""The fastest safe motion: durations against bars, conditions kept everywhere, ends, objectives, mistakes."""

from __future__ import annotations

import re
import time
from dataclasses import replace

import numpy as np
import pytest

from salver.contact_margins import margins
from salver.errors import ScenarioError
from salver.geometry import Array
from salver.models.tray_motion import Speed
from salver.planning.fastest import FastestMotion, FastestOptions, fastest, nearby, object_motion, plan_fastest
from salver.planning.fastest.planned import each_kind, joint_plan, judged, slow_enough, tightened
from salver.planning.make import make_plan
from salver.planning.plan import Plan
from salver.planning.postures import REACHED, PoseTarget, posture_at
from salver.planning.trajopt.constraints.constraints import FINEST, ContactConstraint, evaluate, worst_of
from salver.planning.trajopt.curves import FreeCurve, Grid, united
from salver.planning.trajopt.ends import Anywhere, AtPosture
from salver.planning.trajopt.exchange import programme_of
from salver.planning.trajopt.objectives import LeastMargin, Point
from salver.planning.trajopt.problem import TransportProblem, transport_problem
from salver.planning.trajopt.spline import RestSpline, SplineMotion
from salver.planning.trajopt.sqp import SqpOptions, minimise
from salver.scenario import load
from salver.trajectory import smooth_step
from transport_problems import Distance, bottle, cube, line

UNCERTAIN = {"mass": "20%", "com": [0.003, 0.002, 0.004], "inertia": "10%", "friction": "10%"}


# The optimum ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("friction", "level", "bar"), [(0.4, True, 0.745), (0.4, False, 0.667), (0.2, True, 0.975), (0.2, False, 0.775)]
)
def test_paper_endpoints_are_as_fast_as_the_bar_and_safe(friction, level, bar):
    """The bar is that of full speed only."""
    orientation = "fixed" if level else "free"
    scenario = cube(friction, objects__0__uncertainty={}, motion__orientation=orientation, motion__speeds="full")
    plan = plan_fastest(scenario)
    assert plan.duration <= bar
    assert plan.ok, (plan.status, plan.verification.sentence, plan.arm_status)
    assert plan.verification.slack < 0.03  # contact binds: it is not the arm alone that limits
    tilt = np.arccos(np.clip(plan.evaluation.samples.R_SB[:, 2, 2], -1, 1)).max()
    assert tilt < 2e-3 if level else np.deg2rad(5) < tilt < np.deg2rad(45)


@pytest.mark.slow
def test_fastest_plan_does_not_depend_on_a_duration_that_the_scenario_gives():
    """Its duration would otherwise say that the tray stays level: `Motion.may_turn`."""
    timed, untimed = (make_plan(load("panda-cube").with_changes(motion__duration=T), "fastest") for T in (2.5, None))
    assert timed.duration == untimed.duration
    assert np.degrees(np.arccos(timed.evaluation.samples.R_SB[:, 2, 2].min())) > 5


def test_bounded_tilt_lies_between_level_and_free():
    scenario = cube(0.2, objects__0__uncertainty={}, motion__orientation="free", motion__max_tilt_deg=8.0)
    plan = plan_fastest(scenario)
    tilt = np.rad2deg(np.arccos(np.clip(plan.evaluation.samples.R_SB[:, 2, 2], -1, 1)).max())
    assert plan.ok
    assert 6.0 < tilt <= 8.0
    assert 0.79 < plan.duration < 1.0


@pytest.mark.parametrize("margin", [0.0, 0.05])
def test_contact_keeps_the_margin_that_the_scenario_asks_for(margin):
    """And no more: it is what binds. As a share of the weight, at 601 points of another grid."""
    scenario = cube(0.2, objects__0__uncertainty={}, motion__orientation="fixed", contact__margin=margin)
    found = fastest(transport_problem(scenario), FastestOptions(spans=8))
    assert found.status.ok, found.status
    s = np.linspace(0, 1, 601)
    z = np.stack(found.sample(s * found.duration))
    contacts = [ContactConstraint(rows) for rows in found.problem.contacts]
    left = -worst_of(evaluate(contacts, found.problem.at(s, z, found.duration), margins=False))[0]
    assert margin - 1e-4 < left < margin + 5e-3


@pytest.mark.slow
def test_robust_plan_takes_longer_and_the_nominal_one_breaks_its_conditions():
    scenario = bottle(mass="40%", com=[0.005, 0.005, 0.005], friction="10%").with_changes(motion__speeds="full")
    robust, nominal = (transport_problem(scenario, robust=robust) for robust in (True, False))
    slow, fast = fastest(robust), fastest(nominal)
    assert slow.status.ok
    assert margins(scenario, slow.reference().samples, edges=4).exact_worst.min() > 0  # by another module's worst case
    assert fast.status.ok
    assert 1.03 * fast.duration < slow.duration < 1.4 * fast.duration
    s = np.linspace(0, 1, 301)
    z = np.stack(fast.sample(s * fast.duration))
    value, name = worst_of(evaluate(robust.constraints, robust.at(s, z, fast.duration), margins=False))
    assert value > 0.05
    assert name == "contact of bottle"


@pytest.mark.slow
def test_start_posture_is_chosen_when_none_is_given():
    scenario = cube(objects__0__uncertainty={}, arm__start_posture=None, motion__orientation="free")
    found = fastest(transport_problem(scenario), FastestOptions(spans=8))
    assert found.status.ok
    assert found.duration < 0.67
    motion = object_motion(found.problem, np.zeros(1), found.coefficients[:1], np.zeros((1, 7)), np.zeros((1, 7)))
    assert np.abs(motion.p_SB[0] - scenario.motion.start.position).max() < 1e-8


@pytest.mark.slow
def test_obstacle_on_the_way_is_avoided():
    pillar = {"type": "capsule", "position": [0.60, -0.12, 0.35], "radius": 0.03, "length": 0.5}
    scenario = cube(objects__0__uncertainty={}, motion__orientation="free", obstacles=[pillar])
    found = fastest(transport_problem(scenario))
    assert found.status.ok, found.status
    free = fastest(transport_problem(cube(objects__0__uncertainty={}, motion__orientation="free")))
    assert found.duration > free.duration
    s = np.linspace(0, 1, 201)
    apart, through = (
        min(tray_to_pillar(found.problem, q) for q in motion.sample(s * motion.duration)[0]) for motion in (found, free)
    )
    assert through < -0.02
    assert 0.0049 < apart < 0.008  # 5 mm are kept, and it is worth going as near


def tray_to_pillar(problem: TransportProblem, q: Array) -> float:
    """Distance of the tray's box from the pillar's axis less its radius, by looking at points of the axis, m."""
    p, R = problem.arm.tray_pose(q)
    size = np.array([*problem.scenario.tray.size, problem.scenario.tray.thickness])
    axis = np.array([0.60, -0.12, 0.35]) + np.linspace(-0.25, 0.25, 2001)[:, None] * np.array([0, 0, 1.0])
    local = (axis - p) @ R + np.array([0, 0, 0.5 * size[2]])
    beyond = np.abs(local) - 0.5 * size
    outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
    return float((outside + np.minimum(beyond.max(axis=1), 0.0)).min()) - 0.03


@pytest.mark.parametrize("level", [True, False])
@pytest.mark.slow
def test_random_start_postures_converge(level):
    """All of these; `benchmarks/fastest_solve.py` counts a hundred."""
    template = transport_problem(cube(objects__0__uncertainty={}), robust=False, level=level)
    rng, limits, tried = np.random.default_rng(7), template.limits, 0
    assert template.keep_out is not None
    while tried < 3:
        guess = limits.q_min + rng.uniform(0.1, 0.9, 7) * (limits.q_max - limits.q_min)
        radius, angle = rng.uniform(0.35, 0.65), rng.uniform(-1.2, 1.2)
        place = np.array([radius * np.cos(angle), radius * np.sin(angle), rng.uniform(0.2, 0.6)])
        body = template.items[0]
        target = PoseTarget(place, np.eye(3), body.p_EB, body.R_EB, yaw_free=True)
        q, left = posture_at(template.arm, target, guess, limits=limits)
        if left > REACHED or template.keep_out.parts.clearance(q[None]).min() < 0.02:
            continue
        tried += 1
        found = fastest(replace(template, start=AtPosture(q)))
        assert found.status.ok, found.status
        assert max(found.worst.values()) <= 0


# Ends that move, and ends anywhere ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def on_the_way() -> FastestMotion:
    """The tall bottle's plan for nominal values."""
    return fastest(transport_problem(load("panda-tall-bottle"), robust=False))


def at(plan: FastestMotion, t: float) -> AtPosture:
    q, dq, ddq, _ = (x[0] for x in plan.sample(np.array([t])))
    return AtPosture(q, dq, ddq)


@pytest.mark.slow
@pytest.mark.parametrize("t", [0.1, 0.4, 0.6])
def test_a_stop_from_the_middle_of_a_motion_keeps_every_condition(on_the_way, t):
    """It begins in the plan's state, ends at rest, and is checked at 601 points, torque rate by its own differences."""
    state = at(on_the_way, t)
    problem = replace(on_the_way.problem, start=state, goal=Anywhere())
    found = fastest(problem)
    assert found.status.ok, found.status
    assert found.duration < on_the_way.duration
    s = np.linspace(0, 1, 601)
    z = np.stack(found.sample(s * found.duration))
    assert np.abs(z[0, 0] - state.q).max() < 1e-12
    assert np.abs(z[1, 0] - state.dq).max() < 1e-9
    assert np.abs(z[2, 0] - state.ddq).max() < 1e-6
    assert np.abs(z[1:3, -1]).max() < 1e-6
    value, name = worst_of(evaluate(problem.constraints, problem.at(s, z, found.duration), margins=False))
    assert value < 2e-3, name  # of the size of the quantity; 5e-5 at the points of the plan's own check
    steps = np.diff(s * found.duration)[:, None]
    assert np.abs(np.diff(z[0], axis=0) / steps - 0.5 * (z[1, 1:] + z[1, :-1])).max() < 1e-3


@pytest.mark.slow
def test_what_is_left_of_a_fastest_motion_is_fastest(on_the_way):
    """Bellman: planned anew from the middle, a motion to the same goal takes as long as the rest of the first one."""
    t = 0.35
    rest = fastest(replace(on_the_way.problem, start=at(on_the_way, t)))
    assert rest.status.ok, rest.status
    assert rest.duration == pytest.approx(on_the_way.duration - t, rel=0.03)


# What is made small --------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_margin_at_a_longer_duration_is_kept_between_the_nodes_and_beats_slowing_down():
    """On 400 points of another grid; the same path, only slower, is what anybody would do instead."""
    problem = transport_problem(cube(0.2, objects__0__uncertainty={}, motion__orientation="fixed"))
    quickest = fastest(problem)
    s, before = np.linspace(0, 1, 400), 0.0
    for factor in (1.05, 1.2, 1.5):
        duration = factor * quickest.duration
        careful = nearby(quickest, LeastMargin(), duration)
        assert careful.status.ok, careful.status
        assert careful.duration == duration

        def least(z: Array, duration: float = duration) -> float:
            rows = evaluate(
                [ContactConstraint(rows) for rows in problem.contacts], problem.at(s, z, duration), margins=False
            )
            return -worst_of(rows)[0]

        slowed = np.stack(quickest.sample(s * quickest.duration)) / factor ** np.arange(4.0)[:, None, None]
        margin = least(np.stack(careful.sample(s * duration)))
        assert margin > least(slowed) + 1e-3
        assert margin > before
        before = margin


def test_distance_to_a_motion_is_least_at_that_motion_and_its_model_is_exact():
    problem = transport_problem(cube(), robust=False)
    spline, duration = RestSpline(5, 8), 1.5
    curve = FreeCurve(problem, Grid.of(spline, spline.nodes(2)))
    rng, here = np.random.default_rng(5), line(problem, spline)
    other = here + 0.05 * rng.normal(size=here.shape)
    wanted = curve.motion(other, duration)
    objective = Distance(wanted, (1.0, 0.1, 0.01, 0.0))
    assert objective.value(curve, Point(other, duration)) == pytest.approx(0.0, abs=1e-20)
    step = np.append(rng.normal(size=here.size), 0.0)
    start, value = Point(here, duration), objective.value(curve, Point(here, duration))
    moved = Point(here + step[:-1].reshape(here.shape), duration)
    assert objective.expected(curve, start, value, step) == pytest.approx(objective.value(curve, moved), rel=1e-10)


@pytest.mark.parametrize("share", [1.0, 0.05])
def test_a_motion_that_keeps_every_condition_is_found_again(share):
    """From 0.24 rad away in the mean, and from 0.012: what is near is not taken for found."""
    problem, begun = transport_problem(cube(objects__0__friction=1.0), robust=False), time.perf_counter()
    quickest = fastest(problem)
    longer = SplineMotion(quickest.spline, quickest.coefficients, 2 * quickest.duration)
    nodes = quickest.spline.nodes(FastestOptions().nodes_per_span)
    blend = smooth_step(np.linspace(0, 1, len(longer.coefficients)))[:, None]
    wanted = longer.coefficients + share * np.random.default_rng(2).uniform(-1, 1, 7) * blend * (1 - blend)
    grid = programme_of(problem, FreeCurve, longer, nodes).curve.grid
    there = Distance(FreeCurve(problem, grid).motion(wanted, longer.duration))
    programme = programme_of(problem, FreeCurve, longer, nodes, there)
    assert programme.at(Point(wanted, longer.duration)).violation < 2e-5  # of the arm's own clearance, at the start
    begin = programme.begin(longer.coefficients, longer.duration)
    found = minimise(programme, begin, SqpOptions())
    assert found.status.ok
    assert quickest.binding  # something hinders a shorter time
    assert 0 < quickest.wall_time + found.wall_time < time.perf_counter() - begun
    assert np.sqrt(2 * begin.cost) == pytest.approx(0.2435 * share, rel=0.01)
    # 1 mrad: rows are solved to 1e-5 of their scale, and that violation has a price of 1 to 20 rad^2.
    assert np.sqrt(2 * found.iterate.cost) < 1.5e-3


# What a user can get wrong -------------------------------------------------------------------------------------


@pytest.mark.slow
def test_with_no_margin_the_plan_and_its_own_check_agree():
    """What the check on another grid finds between the points of the search's own is less than what is kept there."""
    task = {"objects__0__friction": 0.33753377991514605, "motion__goal__position": (0.52008546, 0.19969177, 0.58228742)}
    cube = load("panda-cube").with_changes(**task, objects__0__uncertainty={}, arm__start_posture=None)
    plan = plan_fastest(cube.with_changes(contact__margin=0.0, contact__condition="exact", motion__orientation="free"))
    assert plan.status.ok
    assert plan.verification.ok
    assert plan.verification.slack > 0.5 * FINEST


def test_scenario_without_arm_is_refused():
    scenario = cube()
    with pytest.raises(ScenarioError, match=r"needs an arm"):
        transport_problem(scenario.model_copy(update={"arm": None}))


def test_start_posture_of_another_pose_is_refused():
    with pytest.raises(ScenarioError, match=r"start_posture puts cube 392 mm"):
        transport_problem(cube(arm__start_posture=[0.0, 0.3, 0.0, -1.8, 0.0, 2.1, 0.8]))


@pytest.mark.slow
def test_unreachable_goal_has_a_status():
    begun = time.perf_counter()
    found = fastest(transport_problem(cube(motion__goal__position=[1.8, 0.0, 0.4])))
    assert 0 < found.wall_time <= time.perf_counter() - begun
    assert not found.status.ok
    assert found.status.code == "unreachable"


def test_what_oversteps_a_limit_by_a_hair_between_the_optimisers_instants_is_made_slower_by_that():
    """The verdict looks at more instants. Run in .9995 of its time a motion is some .1 % too quick, and an acceleration
    grows as the square of the pace: .001 of its time mends it, .0001 does not. In .97 it is 6 %: then the optimiser is
    at fault, and nothing is covered up."""
    scenario = cube()
    problem = transport_problem(scenario.with_changes(motion__duration=None))
    found = fastest(problem, FastestOptions(spans=8))

    def planned(motion: FastestMotion) -> Plan:
        return judged(joint_plan(scenario, problem, motion.joint_motion(), motion.status, {}), problem)

    def hastened(share: float) -> tuple[FastestMotion, Plan]:
        motion = replace(found, duration=share * found.duration)
        return motion, planned(motion)

    hasty = hastened(0.9995)
    assert not hasty[1].ok
    slower, plan = slow_enough(*hasty, planned, robust=True)
    assert plan.ok
    assert slower.duration == plan.duration == pytest.approx(0.9995 * 1.001 * found.duration)
    assert f"{slower.duration:.4f} s" in plan.status.sentence
    much = hastened(0.97)
    assert slow_enough(*much, planned, robust=True) == much

    tight = tightened(hasty[0])
    assert tight is not None
    excess = float(re.search(r"acceleration of \S+ would be exceeded by (\S+) %", hasty[1].status.sentence)[1]) / 100
    assert tight.limits.acceleration == pytest.approx((1 - 2 * excess) * problem.limits.acceleration, rel=1e-5)
    assert np.array_equal(tight.limits.velocity, problem.limits.velocity)
    again = fastest(tight, FastestOptions(spans=8), near=hasty[0])
    assert planned(again).ok, "within less of the limit it keeps the whole of it between the nodes too"
    assert again.duration < 1.002 * found.duration
    assert tightened(much[0]) is None


def test_a_plan_whose_motion_fails_the_verdict_is_unsafe():
    """Found for the cube; with two thirds of its friction the motion would lose it."""
    scenario = cube(motion__duration=None)
    problem = transport_problem(scenario)
    found = fastest(problem, FastestOptions(spans=8))
    plan = joint_plan(scenario, problem, found.joint_motion(), found.status, {})
    slipping = transport_problem(cube(motion__duration=None, objects__0__friction=0.33))
    told = judged(plan, slipping).status
    assert not told.ok
    assert "contact of cube" in told.sentence
    assert judged(replace(plan, status=told), slipping).status is told


@pytest.mark.slow
def test_time_limit_is_kept():
    """The search ends early; how early depends on the machine."""
    problem = transport_problem(cube())
    limited, free = (fastest(problem, FastestOptions(time_limit=limit)) for limit in (1e-3, 60.0))
    assert free.status.ok
    assert 0 < limited.iterations < free.iterations


def test_start_posture_inside_an_obstacle_has_a_status():
    block = {"type": "box", "name": "block", "position": [0.54, -0.37, 0.3], "size": [0.2, 0.2, 0.2]}
    found = fastest(transport_problem(cube(obstacles=[block])))
    assert found.status.code == "collision"
    assert "block" in found.status.sentence


def test_goal_that_tilts_a_level_tray_is_refused():
    goal = {"position": [0.444272, 0.100574, 0.4], "rpy_deg": [5.0, 0.0, 0.0]}
    with pytest.raises(ScenarioError, match=r"motion.goal tilts the tray by 5 deg"):
        transport_problem(cube(motion__goal=goal, motion__orientation="fixed"))


def test_nodes_that_differ_by_rounding_are_one():
    """A grid of nodes sought on again has them all, a bit beside itself; two of them would be no time apart."""
    nodes = np.sort(np.append(np.random.default_rng(0).uniform(size=200), [0.0, 1.0]))
    again = np.interp(np.arange(len(nodes)) * 6 / 6, np.arange(len(nodes)), nodes * (1 + 2e-16))
    more = np.append(again, 0.5 * (nodes[1:] + nodes[:-1]))
    assert len(np.union1d(nodes, more)) > 403
    found = united(nodes, more)
    assert len(found) == 403
    assert np.diff(found).min() > 1e-9


def test_a_constraint_that_hinders_at_several_speeds_is_named_once() -> None:
    speeds = (Speed(), Speed(0.822), Speed(0.0, 0.25), Speed(1.0, -0.25), Speed(1e-3))
    names = ("acceleration", *(f"contact of cup on tray{speed.words}" for speed in speeds))
    assert each_kind(names) == ["acceleration", "contact of cup on tray (at other speeds too)"]
    assert each_kind(names[:2]) == ["acceleration", "contact of cup on tray"]
