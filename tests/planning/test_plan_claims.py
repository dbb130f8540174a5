"""What plans say of themselves, checked by what they do: bounds, optimality, convexity, seeds, ends, files."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import simpson

import odd_loads
import sampled_sets
from salver.contact_margins import margins
from salver.errors import Status
from salver.files import to_json
from salver.geometry import Array, exp, invert
from salver.models.arm.arm import load_arm
from salver.models.contact_rows import contact_rows
from salver.planning.fastest import FastestOptions, fastest, transport_problem
from salver.planning.make import make_plan, plan_baseline, plan_object, plan_pair
from salver.planning.object.cost import cost_residual
from salver.planning.object.evaluation import evaluate
from salver.planning.object.problem import Problem
from salver.planning.object.solvers import SEARCH, solve, solve_sequential
from salver.planning.plan import Plan, load_plan
from salver.planning.postures import PoseTarget, candidate_postures
from salver.scenario import Scenario, load
from salver.simulation.physics import simulate
from salver.trajectory import PolynomialReference, boundary_solution, min_jerk_line

PAPER = load("panda-cube").with_changes(arm=None, motion__goal_yaw="fixed")
START, GOAL = np.array(PAPER.motion.start.position), np.array(PAPER.motion.goal.position)
LEVEL = np.eye(3)


def planned(reference: PolynomialReference, made: Scenario = PAPER) -> Plan:
    return Plan(made, "robust", reference, Status("made", "Made by hand.", True))


def test_a_start_whose_heading_is_free_is_no_detour() -> None:
    """A heading that is hard to reach costs a second; free, it costs nothing, and the load stays in the engine."""
    start = {"position": [0.54237, -0.370574, 0.4], "rpy_deg": [0, 0, 170]}
    case = load("panda-cube").with_changes(
        arm__start_posture=None, motion__duration=None, motion__goal_yaw="fixed", motion__start=start
    )
    fixed = make_plan(case, "fastest")
    free, line = plan_pair(case.with_changes(motion__start_yaw="free"), "fastest")
    assert fixed.ok
    assert free.ok
    assert free.duration < 0.65 < 1.2 < fixed.duration
    begins = free.reference.sample(np.zeros(1))
    assert_allclose(begins.p_SB[0], start["position"], atol=1e-9)
    assert_allclose(begins.R_SB[0, :, 2], [0, 0, 1], atol=1e-9)
    assert begins.R_SB[0, 0, 0] > 0.9  # it points the other way
    assert line.joint is not None
    assert free.joint is not None
    assert_allclose(line.joint.q[0], free.joint.q[0], atol=1e-9)  # a line from the other heading could not begin there
    tilted = case.with_changes(motion__start_yaw="free", motion__start={**start, "rpy_deg": [0, 10, 170]})
    assert replace(free, scenario=tilted).verification.boundary_error > 0.1
    assert simulate(free).summary["outcome"] == "holds"


def test_only_the_first_leg_may_begin_with_any_heading() -> None:
    legs = load("waiters-round").with_changes(motion__start_yaw="free").each_leg
    assert [leg.motion.start_yaw for leg in legs] == ["free"] + [None] * (len(legs) - 1)


# The ends ------------------------------------------------------------------------------------------------------

TIME = 2.5


def line(p_miss: tuple[Array, Array], turn: Array) -> PolynomialReference:
    return min_jerk_line(TIME, START + p_miss[0], GOAL + p_miss[1], LEVEL, exp(turn))


def pushed(order: int, end: int, size: float) -> PolynomialReference:
    """The line whose velocity (1) or acceleration (2) at one end is `size` along y."""
    values = np.stack([START, np.zeros(3), np.zeros(3), GOAL, np.zeros(3), np.zeros(3)])
    values[3 * end + order, 1] = size * (TIME / 2) ** order
    return PolynomialReference(TIME, LEVEL, boundary_solution(5, values).particular)


def spun(order: int, end: int, size: float) -> PolynomialReference:
    """The line that turns, at one end, with an angular velocity (0) or acceleration (1) of `size` about z."""
    values = np.zeros((4, 3))
    values[2 * end + order, 2] = size * (TIME / 2) ** order
    straight = line((np.zeros(3), np.zeros(3)), np.zeros(3))
    return PolynomialReference(TIME, LEVEL, straight.position, boundary_solution(7, values, (0, 1)).particular)


MISSES = {
    "start": lambda e: line((np.array([0, e, 0]), np.zeros(3)), np.zeros(3)),
    "goal": lambda e: line((np.zeros(3), np.array([0, 0, -e])), np.zeros(3)),
    "turn": lambda e: line((np.zeros(3), np.zeros(3)), np.array([0, 0, e])),
    "velocity at the start": lambda e: pushed(1, 0, e),
    "velocity at the goal": lambda e: pushed(1, 1, -e),
    "acceleration at the start": lambda e: pushed(2, 0, -e),
    "acceleration at the goal": lambda e: pushed(2, 1, e),
    "spin at the start": lambda e: spun(0, 0, e),
    "spin at the goal": lambda e: spun(0, 1, -e),
    "angular acceleration at the start": lambda e: spun(1, 0, e),
    "angular acceleration at the goal": lambda e: spun(1, 1, e),
}


@pytest.mark.parametrize("what", MISSES)
def test_a_plan_that_misses_its_ends_by_a_millionth_is_not_verified(what: str) -> None:
    missed = planned(MISSES[what](1e-6))
    assert missed.verification.violation == 0
    # An angular velocity also turns the object a little.
    assert 0.99e-6 < missed.verification.boundary_error < 2e-6
    assert not missed.verification.ok
    assert not missed.ok
    assert "misses its start or goal by 1" in missed.verification.sentence
    exact = planned(MISSES[what](1e-11))
    assert exact.verification.ok
    assert exact.ok


def test_a_plan_that_reaches_its_ends_and_loses_the_load_on_the_way_is_not_verified() -> None:
    """A line in 0.6 s needs a friction of 0.82, and 0.4 is sure."""
    lost = planned(min_jerk_line(0.6, START, GOAL, LEVEL, LEVEL), PAPER.with_changes(motion__duration=0.6))
    assert lost.verification.boundary_error < 1e-9
    assert lost.verification.violation > 0
    assert not lost.verification.ok
    assert not lost.ok


def test_a_free_yaw_is_free_and_a_tilt_is_not() -> None:
    made = PAPER.with_changes(motion__goal_yaw="free")
    still = (np.zeros(3), np.zeros(3))
    assert planned(line(still, np.array([0, 0, 0.7])), made).verification.ok
    assert not planned(line(still, np.array([0, 0, 0.7]))).verification.ok
    for axis in range(2):
        missed = planned(line(still, 1e-6 * np.eye(3)[axis]), made)
        assert missed.verification.boundary_error == pytest.approx(1e-6, rel=1e-3)
        assert not missed.verification.ok


# Bounds, optima ------------------------------------------------------------------------------------------------

COM = {"mass": "10%", "com": [0.002, 0.001, 0.002]}


def cost_at(problem: Problem, z: Array) -> float:
    return problem.at(z).cost


@pytest.mark.slow
@pytest.mark.parametrize("duration", [2.5, 1.3])
def test_lower_bound_of_a_plan_is_the_least_cost_of_any_motion(duration: float) -> None:
    """Where the constraints bend, only the cost alone bounds it: no motion at all costs less, and one costs that."""
    problem = Problem(PAPER.with_changes(objects__0__uncertainty=COM, motion__duration=duration), 31)
    found = solve(problem)
    assert found.status.ok
    assert found.lower_bound is not None
    assert found.lower_bound <= found.cost * (1 + 1e-9)
    assert found.cost == pytest.approx(cost_at(problem, found.z), rel=1e-9)
    rng = np.random.default_rng(0)
    around = [
        cost_at(problem, found.z + scale * rng.normal(size=problem.size))
        for scale in (1e-3, 1e-2, 1)
        for _ in range(20)
    ]
    assert min(around) >= found.lower_bound * (1 - 1e-9)
    # Attained: the cost is a sum of squares of affine functions, whose least value is the normal equations'.
    zero = problem.at(np.zeros(problem.size))
    r, J = zero.residual, zero.residual_jacobian
    least = cost_at(problem, np.linalg.solve(J.T @ J, -J.T @ r))
    assert found.lower_bound == pytest.approx(least, rel=1e-6)
    assert cost_at(problem, np.zeros(problem.size)) > 1.01 * found.lower_bound


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"contact__condition": "exact"},
        {"objects__0__uncertainty": COM},
        {"objects__0__uncertainty": COM, "contact__condition": "exact"},
        {"objects__0__uncertainty": {"inertia": "10%", "friction": "10%"}},
        {"objects__0__uncertainty": {"position": [0.002, 0.001]}, "uncertainty__tilt_deg": [1.0, 0.5]},
        {"motion__orientation": "free"},
        {"motion__orientation": "free", "contact__condition": "exact"},
        {"motion__goal": {"position": GOAL.tolist(), "rpy_deg": [0, 0, 40]}},
    ],
    ids=str,
)
def test_what_is_called_convex_is_affine(changes: dict) -> None:
    """One convex programme is the answer exactly where cost residuals are affine in z, and slacks concave."""
    problem = Problem(PAPER.with_changes(**changes), 15)
    rng, affine, concave = np.random.default_rng(1), True, True
    for _ in range(3):
        z = 0.3 * rng.normal(size=problem.size)
        each = [evaluate(problem.scenario, problem.reference(k * z), len(problem.t)) for k in (0, 0.4, 1)]
        first, between, last = (cost_residual(one.sensitivity(), problem.weights)[0] for one in each)
        affine &= np.allclose(between, 0.6 * first + 0.4 * last, rtol=1e-9, atol=1e-12)
        concave &= bool(np.all(each[1].slack >= 0.6 * each[0].slack + 0.4 * each[2].slack - 1e-9))
    assert problem.is_affine == (affine and concave)


def test_a_step_that_makes_it_worse_is_not_taken() -> None:
    """A tilt that is bounded tightly: the more steps, the less is violated, from the first one on."""
    changes = {"motion__orientation": "free", "motion__duration": 0.7, "motion__max_tilt_deg": 5.0}
    problem = Problem(PAPER.with_changes(**changes), 15)
    left = [solve_sequential(problem, None, replace(SEARCH, iterations=steps)).violation for steps in (0, 1, 2, 4, 6)]
    assert left[0] > 0.05
    assert np.all(np.diff(left) <= 1e-9)
    assert left[-1] < 0.8 * left[0]


# Seeds and starts ------------------------------------------------------------------------------------------------


def test_seeds_choose_other_postures() -> None:
    arm = load_arm(load("panda-cube").arm, PAPER.tray)
    first, again, other = (candidate_postures(arm, PoseTarget(START - [0, 0, 0.02], LEVEL), seed) for seed in (1, 1, 2))
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    # Beyond the first, from the middle of the ranges, the guesses are others.
    assert not any(np.allclose(first[1], q, atol=1e-6) for q in other[:2])


@pytest.mark.slow
def test_a_fastest_motion_is_another_with_another_seed_and_the_same_with_the_same() -> None:
    """With both postures free to choose."""
    case = load("panda-cube").with_changes(arm__start_posture=None, objects__0__uncertainty={})
    problem = transport_problem(case, robust=False)
    briefly = FastestOptions(spans=4, pairs=1, iterations=0.1)
    one, again, other = (fastest(problem, replace(briefly, seed=seed)) for seed in (0, 0, 3))
    assert np.array_equal(one.coefficients, again.coefficients)
    assert not np.array_equal(one.coefficients, other.coefficients)


# The paper's condition for several objects ------------------------------------------------------------------------


def tumbling(made: Scenario) -> PolynomialReference:
    rng = np.random.default_rng(5)
    start = np.array(made.motion.start.position)
    straight = min_jerk_line(1.0, start, start + np.array([0.2, 0.3, 0.05]), LEVEL, LEVEL)
    return PolynomialReference(1.0, LEVEL, straight.position, 0.4 * rng.normal(size=(5, 3)))


def pyramid_coefficients(made: Scenario, name: str) -> Array:
    """pinv(G F-hat) (n, 6) of the sure contact of an object with its least friction, written out point by point."""
    body = next(each for each in made.payload.bodies if each.name == name)
    mu, k = made.payload.least_friction(body), made.contact.edges
    columns = []
    for p in odd_loads.sure_points_B(made, name):
        for j in range(k):
            f = np.array([mu * np.cos(2 * np.pi * j / k), mu * np.sin(2 * np.pi * j / k), 1.0]) / np.sqrt(1 + mu**2)
            columns.append(np.concatenate([f, np.cross(p, f)]))
    return np.linalg.pinv(np.array(columns).T)


@pytest.mark.parametrize("kind", ["box", "ellipsoid"])
def test_papers_condition_of_each_object_counts_its_own_load_and_place(kind: str) -> None:
    """Two yawed boxes: Lambda less the tube of a body that follows its tray, by differences of the true wrench.

    Of the first object only what its own loop does not know: place and tilt.
    """
    made = odd_loads.pair(kind, contact__condition="paper", motion__orientation="free", motion__duration=1.0)
    first_only = {"position": [0.003, 0.005], "friction": 0.05}
    made = made.with_changes(
        objects__0__uncertainty=first_only,
        uncertainty__correlation={"tilt_x,beside.com_y": 0.4, "tilt_y,lower.position_x": -0.5}
        if kind == "ellipsoid"
        else {},
    )
    found = evaluate(made, tumbling(made), 15)
    first = made.payload.first
    tray = found.samples.of_frame(*invert(first.p_EB, first.R_EB))
    w, uncertain = odd_loads.felt(tray), made.payload.uncertain
    for k, item in enumerate(made.objects):
        coefficients = pyramid_coefficients(made, item.name)
        nominal = odd_loads.interface_wrenches(made, {}, w)[k] @ coefficients.T
        slopes = []
        for name, half in zip(uncertain.names, uncertain.half_range, strict=True):
            h = 1e-3 * half
            up, down = (odd_loads.interface_wrenches(made, {name: s * h}, w)[k] for s in (1, -1))
            slopes.append((up - down) @ coefficients.T / (2 * h))
        slope = np.stack(slopes, axis=-1)
        tube = np.einsum("...p,...p->...", slope, sampled_sets.steepest(slope, uncertain))
        mine = found.slack[:, [owner == item.name for owner in found.slack_owner]]
        assert mine.shape[1] == nominal.shape[1]
        assert_allclose(mine.min(axis=1), (nominal - tube).min(axis=1), atol=2e-6)


@pytest.mark.parametrize("kind", ["box", "ellipsoid"])
def test_tube_and_cost_of_a_correlated_set(kind: str) -> None:
    """The tube of Lambda is as wide as the farthest point of the set makes it; the cost is that of any square root."""
    made = odd_loads.single(kind, contact__condition="paper", motion__orientation="free", motion__duration=1.0)
    made = made.with_changes(
        objects__0__uncertainty__position=None, uncertainty__tilt_deg=None, uncertainty__correlation={}
    )
    pairs = {"mass,com_x": 0.5, "com_x,com_z": -0.6, "com_y,inertia_yy": 0.4} if kind == "ellipsoid" else {}
    made = made.with_changes(uncertainty__correlation=pairs)
    plan = planned(tumbling(made), made)
    uncertain, theta = plan.uncertain, plan.input_sensitivity[::60]
    farthest = sampled_sets.steepest(theta, uncertain)
    assert_allclose(plan.cone_radius[::60], np.einsum("...p,...p->...", theta, farthest), rtol=1e-9, atol=1e-12)
    radius = np.linalg.norm(odd_loads.sure_points_B(made, "box"), axis=1).max()
    (kp, kp_R) = made.control.kp
    scale = np.repeat([1.0, radius, kp**-0.5, radius * kp_R**-0.5], 3)[:, None]
    square = np.square(scale * (plan.state_sensitivity @ sampled_sets.directions(uncertain))).sum(axis=(1, 2))
    assert plan.cost == pytest.approx(simpson(square, x=plan.t), rel=1e-6)
    # And the planner's own: its residuals, on its own grid.
    problem = Problem(made, 61)
    at_start = planned(problem.reference(np.zeros(problem.size)), made)
    assert cost_at(problem, np.zeros(problem.size)) == pytest.approx(at_start.cost, rel=1e-4)


@pytest.mark.parametrize(
    ("load_of", "kind"), [(odd_loads.stack, "ellipsoid"), (odd_loads.pair, "box"), (odd_loads.pair, "ellipsoid")]
)
def test_exact_condition_of_a_plan_is_the_worst_case_of_the_rows(load_of: object, kind: str) -> None:
    """At full speed, and standing still and at full speed while the speed changes by 0.3 1/s either way."""
    made = load_of(kind, contact__condition="exact", motion__orientation="free", motion__duration=1.0)
    full, first = made.with_changes(motion__speeds="full"), made.payload.first
    found = evaluate(full, tumbling(made), 9)
    w = odd_loads.felt(found.samples.of_frame(*invert(first.p_EB, first.R_EB)))
    claimed = np.max([rows.worst(w).max(axis=1) for rows in contact_rows(made.payload)], axis=0)
    assert_allclose(found.slack.min(axis=1), -claimed, atol=1e-9)
    whole = margins(made, found.samples, edges=made.contact.edges)
    for m in whole.interfaces:
        mine = found.slack[:, [owner == m.name for owner in found.slack_owner]]
        assert_allclose(mine.min(axis=1), m.exact_worst, atol=1e-9)
    corners = []
    for moving in (1.0, 0.0):
        for rate in (0.3, -0.3):
            of_B = found.samples
            changed = replace(
                of_B,
                a_S=moving * of_B.a_S + rate * of_B.v_S,
                omega_B=moving * of_B.omega_B,
                alpha_B=moving * of_B.alpha_B + rate * of_B.omega_B,
            )
            # Turned as B, so that v of E is v_B - omega x p_EB, whatever else the tray does.
            w = odd_loads.felt(changed.of_frame(*invert(first.p_EB, first.R_EB)))
            if not moving:  # centripetal accelerations, which `of_frame` adds, are none where nothing turns
                assert not changed.omega_B.any()
            corners.append(np.max([rows.worst(w).max(axis=1) for rows in contact_rows(made.payload)], axis=0))
    slack = evaluate(made.with_changes(motion__speed_rate=0.3), tumbling(made), 9).slack
    assert_allclose(slack.min(axis=1), -np.max(corners, axis=0), atol=1e-9)


# Files -----------------------------------------------------------------------------------------------------------


def free() -> Plan:
    return plan_object(PAPER.with_changes(motion__orientation="free", motion__duration=0.8))


def several() -> Plan:
    made = odd_loads.pair("ellipsoid", arm=None, contact__condition="exact", motion__duration=3.0, motion__nodes=11)
    return plan_baseline(made)


def with_the_fastest_arm() -> Plan:
    return make_plan(load("panda-cube").with_changes(motion__goal_yaw="free"), "fastest")


@pytest.mark.slow
@pytest.mark.parametrize("make", [free, several, with_the_fastest_arm], ids=lambda make: make.__name__)
def test_a_plan_comes_back_from_its_files_as_it_was(make: object, tmp_path: object) -> None:
    """Number by number, and again from the files of what came back."""
    plan = make()
    again = load_plan(plan.save(tmp_path / "first"))
    twice = load_plan(again.save(tmp_path / "second"))
    t = np.linspace(0.0, plan.duration, 23)
    for other in (again, twice):
        assert json.loads(to_json(other.summary())) == json.loads(to_json(plan.summary()))
        assert other.status == plan.status
        assert other.verification == plan.verification
        arrays = other.arrays()
        assert list(arrays) == list(plan.arrays())
        for key, array in plan.arrays().items():
            assert np.array_equal(array, arrays[key]), key
        for name, value in vars(plan.reference.sample(t)).items():
            assert np.array_equal(value, getattr(other.reference.sample(t), name)), name
    assert replace(again, scenario=plan.scenario).duration == plan.duration
