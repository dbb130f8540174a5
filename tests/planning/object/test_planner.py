"""Eqs (13) to (17): the planning problem's derivatives, its global optimum, and what it says when there is none."""

import numpy as np
import pytest
from scipy.optimize import minimize

import odd_loads
from salver.errors import ScenarioError
from salver.planning import qp
from salver.planning.make import plan_baseline, plan_object
from salver.planning.object.cost import CostWeights, integration_weights
from salver.planning.object.problem import ObjectProgramme, Problem
from salver.planning.object.solvers import _dual_value, solve, solve_convex
from salver.planning.qp import Optimum, Quadratic
from salver.planning.trajopt.objectives import Point
from salver.scenario import load

PAPER = load("panda-cube")
GOAL = [0.444272, 0.100574, 0.4]
CORRELATED = {"set": "ellipsoid", "correlation": {"mass,com_x": 0.5, "com_x,com_z": -0.6, "com_y,inertia_yy": 0.4}}
TEN = {"mass": "10%", "com": [0.002] * 3, "inertia": [3.4e-5, 5e-6, 3.4e-5, 5e-6, 5e-6, 3.4e-5]}


def changed(**changes):
    return PAPER.with_changes(**changes)


def turning(**changes):
    return changed(motion__orientation="free", motion__goal={"position": GOAL, "rpy_deg": [10, 0, 90]}, **changes)


@pytest.mark.parametrize(
    "scenario",
    [
        PAPER,
        turning(objects__0__uncertainty=TEN),
        turning(motion__max_tilt_deg=20, motion__goal_yaw="free"),
        turning(objects__0__uncertainty=TEN, contact__condition="exact"),
        turning(objects__0__uncertainty=TEN, contact__condition="exact", uncertainty=CORRELATED),
        turning(objects__0__uncertainty=TEN, uncertainty=CORRELATED),
        odd_loads.pair("ellipsoid", contact__condition="paper", motion__duration=1.0, motion__orientation="free"),
        odd_loads.stack("ellipsoid", contact__condition="exact", motion__duration=1.0, motion__orientation="free"),
    ],
    ids=["paper", "ten parameters, turning", "tilt", "exact", "exact ellipsoid", "ellipsoid", "pair", "stack"],
)
def test_derivatives_are_those_of_the_values(scenario):
    problem = Problem(scenario, 21)
    rng = np.random.default_rng(0)
    z, d, h = 0.05 * rng.normal(size=problem.size), rng.normal(size=problem.size), 1e-6
    here, ahead, behind = (problem.at(z + s * h * d) for s in (0, 1, -1))
    numeric = (ahead.residual - behind.residual) / (2 * h)
    assert here.residual_jacobian @ d == pytest.approx(numeric, abs=1e-7 * np.abs(numeric).max())
    assert here.goal_jacobian @ d == pytest.approx((ahead.goal - behind.goal) / (2 * h), abs=1e-8)
    programme = ObjectProgramme.of(problem)
    path, *sides = (programme.at(Point((z + s * h * d)[:, None], problem.duration)) for s in (0, 1, -1))
    for now, up, down in zip(path.blocks, *(side.blocks for side in sides), strict=True):
        rows = programme.linearised(path, [np.full(block.values.shape, block is now) for block in path.blocks])
        assert rows.bound == pytest.approx(-now.values.ravel(), abs=1e-12)
        change = (up.values - down.values).ravel() / (2 * h)
        # Where a term changes sign in between, its absolute value has no derivative: both sides have theirs.
        jump = np.abs(up.values - 2 * now.values + down.values).ravel() / h
        assert np.mean(jump < 1e-4 * np.abs(change).max()) > 0.9
        assert np.all(np.abs(rows.matrix[:, :-1] @ d - change) < 0.51 * jump + 1e-6 * np.abs(change).max())


RANGES = {"mass": "15%", "friction": "10%"}
EXACT = {"contact__condition": "exact", "objects__0__uncertainty": RANGES | {"com": [0.001, 0.002, 0.0]}}
PLACE = {"objects__0__uncertainty": RANGES | {"position": [0.004, 0.004]}}
BOTH = [
    changes | {"uncertainty": {"set": kind, "tilt_deg": [0.5, 0.5]}}
    for changes in (EXACT, PLACE)
    for kind in ("box", "ellipsoid")
]


def other_solver(problem, solution, elastic):
    """Of SLSQP, which knows nothing of tangent cuts, from near a solution: the least cost, or with `elastic` the least
    violation of all rows."""
    model = problem.at(np.zeros(problem.size))
    # In coordinates in which the cost is round, or SLSQP's steps are hopeless.
    shape = np.linalg.qr(model.residual_jacobian)[1]
    change, unit = np.linalg.inv(shape), solution.cost

    def cost(y):
        if elastic:
            return y[-1], np.eye(len(y))[-1]
        r = model.residual + model.residual_jacobian @ (change @ y[:-1])
        return r @ r / unit, np.append(2 * (model.residual_jacobian @ change).T @ r / unit, 0.0)

    def left(y):
        slack = problem.at(change @ y[:-1]).slack[0].ravel()
        return slack - problem.scenario.contact.margin + elastic * y[-1]

    start = shape @ solution.z + 0.1 * np.sqrt(unit) * np.random.default_rng(0).normal(size=problem.size)
    rows, options = {"type": "ineq", "fun": left}, {"maxiter": 300}
    found = minimize(cost, np.append(start, 5.0), jac=True, method="SLSQP", constraints=rows, options=options)
    assert found.success
    # SLSQP may leave constraints by its own tolerance, and is then a little cheaper.
    assert left(found.x).min() > -1e-6
    assert left(np.append(shape @ solution.z, solution.violation)).min() >= -1e-9
    return found.x[-1] if elastic else found.fun * unit


@pytest.mark.parametrize(
    "changes",
    [
        {"objective__weighting": "scaled", "motion__duration": 2.5},
        {"objective__weighting": "paper", "motion__duration": 1.0},
        {"objective__weighting": "pose", "motion__duration": 1.0},
        {"objective__weighting": [*range(12)], "motion__duration": 1.0},
        pytest.param(BOTH[0] | {"motion__duration": 1.1}, marks=pytest.mark.slow),
        *(changes | {"motion__duration": 1.1} for changes in BOTH[1:]),
    ],
)
def test_convex_solution_is_the_global_optimum(changes):
    problem = Problem(changed(**changes), 31)
    solution = solve_convex(problem)
    assert solution.status.code == "optimal"
    assert solution.gap < 1e-9
    assert solution.lower_bound == pytest.approx(solution.cost, rel=1e-9)
    assert solution.violation < 1e-9
    assert solution.cost == pytest.approx(other_solver(problem, solution, False), rel=1e-5)


@pytest.mark.parametrize("changes", [{"motion__duration": 0.7}, *(x | {"motion__duration": 0.5} for x in BOTH)])
def test_where_nothing_is_feasible_the_violation_is_the_least_that_another_solver_finds(changes):
    problem = Problem(changed(**changes), 31)
    solution = solve_convex(problem)
    assert solution.status.code == "infeasible"
    assert solution.violation == pytest.approx(other_solver(problem, solution, True), rel=1e-5)


def test_value_of_the_dual_bounds_every_choice_and_is_met_at_the_bounds_of_the_step():
    """Of min 1/2 |x - a|^2 over a box, a beyond both kinds of its faces: by hand."""
    a, free = np.array([2.0, -3.0, 0.2]), np.zeros((0, 3))
    programme = Quadratic(np.eye(3), -a, free, np.zeros(0), free, np.zeros(0), np.full(3, -1.0), np.full(3, 1.0))
    found = qp.solve(programme, 1e-10)
    assert found.x == pytest.approx([1.0, -1.0, 0.2], abs=1e-7)
    least = 0.5 * (1.0 + 4.0) - 0.5 * a @ a
    assert _dual_value(programme, found) == pytest.approx(least, abs=1e-6)
    held = np.array([[0.0, 0.0, 2.0]])  # the third at 0.5
    both = Quadratic(np.eye(3), -a, free, np.zeros(0), held, np.ones(1), np.full(3, -1.0), np.full(3, 1.0))
    assert _dual_value(both, qp.solve(both, 1e-10)) == pytest.approx(least + 0.5 * 0.3**2, abs=1e-6)
    hasty = Optimum(found.x, found.rows, found.equal, 0.5 * found.low, 0.9 * found.high)
    assert _dual_value(programme, hasty) < least - 1e-3  # still a bound where the multipliers are not the right ones


def test_ellipsoid_is_less_cautious_than_the_box_around_it():
    """In a time that is too short for either, the least that is missing is less."""
    both = {}
    for kind in ("box", "ellipsoid"):
        place = {"com": [0.003] * 3}
        scenario = changed(
            objects__0__uncertainty=place, uncertainty={"set": kind}, contact__condition="exact", motion__duration=0.5
        )
        both[kind] = solve(Problem(scenario, 31)).violation
    assert 0.1 < both["ellipsoid"] < 0.995 * both["box"]


def test_more_freedom_never_costs_more():
    costs = [solve(Problem(changed(motion__degree=degree), 61)).cost for degree in (5, 6, 7, 9, 12, 16)]
    assert np.all(np.diff(costs) <= 1e-12 * costs[0])


def test_infeasible_says_which_constraint_when_and_by_how_much():
    problem = Problem(changed(motion__duration=0.7), 41)
    solution = solve(problem)
    assert not solution.status.ok
    details = solution.status.details
    assert details["proven"]
    assert f"t = {details['time']:.3f} s" in solution.status.sentence
    worst = 0.001 - problem.at(solution.z).slack[0].min()
    assert worst == pytest.approx(details["violation"], rel=1e-6)


@pytest.mark.parametrize("name", ["panda-cube-yaw", "panda-cube-tilted-goal", "panda-cube-10-parameters"])
def test_free_orientation_and_uncertain_centre_of_mass_end_in_verified_plans(name):
    plan = plan_object(load(name))
    assert plan.status.ok
    assert plan.verification.ok
    assert plan.verification.boundary_error < 1e-9
    assert plan.cost <= plan_baseline(load(name)).cost
    assert plan.solver["programmes"] >= 1


@pytest.mark.slow
def test_sequential_answer_is_a_local_optimum():
    scenario = turning(motion__duration=1.0, objects__0__uncertainty={"mass": "10%", "inertia": "10%"})
    problem = Problem(scenario, 41)
    solution = solve(problem)
    assert solution.status.ok
    model = problem.at(solution.z)
    rng = np.random.default_rng(0)
    feasible_and_better = 0
    for _ in range(200):
        d = 3e-4 * rng.normal(size=problem.size)
        d -= np.linalg.pinv(model.goal_jacobian) @ (model.goal_jacobian @ d)
        trial = problem.at(solution.z + d)
        kept = trial.slack[0].min() >= scenario.contact.margin
        feasible_and_better += kept and trial.cost < solution.cost * (1 - 1e-4)
    assert feasible_and_better == 0


def test_a_step_that_removes_a_violation_is_not_the_last():
    """The second step met all rows, at a price; the search ended there, and another one from there saved a fifth."""
    free = {"motion__orientation": "free", "contact__condition": "exact", "motion__duration": 0.72}
    problem = Problem(load("prisma-cube").with_changes(**free), 61)
    found = solve(problem)
    assert solve(problem, found.z).cost > (1 - 1e-3) * found.cost


def test_without_freedom_the_one_reference_is_judged():
    """At degree 5 the boundary conditions leave nothing free; with an uncertain centre of mass the problem is not
    convex."""
    for duration, safe in ((2.5, True), (0.8, False)):
        scenario = load("panda-cube-10-parameters").with_changes(motion__degree=5, motion__duration=duration)
        plan = plan_object(scenario)
        assert (plan.status.ok, plan.verification.ok) == (safe, safe)
        assert plan.cost == pytest.approx(plan_baseline(scenario).cost, rel=1e-9)


def test_weightings_differ_as_documented():
    def weights(weighting):
        return CostWeights.of(changed(objective__weighting=weighting), np.linspace(0, 1, 11))

    def rows(weighting):
        return weights(weighting).rows.tolist()

    assert rows("paper") == np.repeat([1, 1, 1, 1], 3).reshape(4, 3).tolist()
    assert rows("pose") == np.repeat([1, 1, 0, 0], 3).reshape(4, 3).tolist()
    radius = 0.02 * np.sqrt(3)
    assert weights("scaled").rows == pytest.approx(np.outer([1, radius, 500**-0.5, radius * 300**-0.5], np.ones(3)))
    assert rows([2, 0.5, 0, 3]) == np.repeat([2, 0.5, 0, 3], 3).reshape(4, 3).tolist()
    assert rows([*range(12)]) == np.arange(12.0).reshape(4, 3).tolist()
    assert weights([2, 0.5, 0, 3]).columns == pytest.approx(weights("scaled").columns)
    assert weights("paper").columns == pytest.approx(np.eye(PAPER.payload.uncertain.size))
    assert weights("scaled").columns == pytest.approx(np.diag(PAPER.payload.uncertain.half_range))


def test_own_weights_of_one_axis_lessen_the_deviation_along_it():
    """The paper's cube in 1 s: plans whose cost counts the deviation along the way alone, or in height alone."""

    def problem(axis):
        weights = [*np.eye(3)[axis], *np.zeros(9)]
        return Problem(changed(motion__duration=1.0, objective__weighting=weights), 21)

    y, z = problem(1), problem(2)
    along, height = solve(y).z, solve(z).z
    assert y.at(along).cost < 0.97 * y.at(height).cost
    assert z.at(height).cost < 0.97 * z.at(along).cost


@pytest.mark.parametrize(
    ("given", "said"), [([1, 1, 1], "it has 3 weights"), ([0, 0, 0, 0], "at least one of them positive")]
)
def test_own_weights_are_four_or_twelve_not_all_zero(given, said):
    with pytest.raises(ScenarioError, match=said):
        changed(objective__weighting=given)


@pytest.mark.parametrize("nodes", [2, 5, 6, 7, 21, 50])
def test_errors_are_integrated_at_steps_that_are_short_for_the_fastest_of_them(nodes):
    """0.35 of 1 / sqrt(500) s, the modulus of both poles of s^2 + 25 s + 500; with one part less they are longer."""
    t = Problem(PAPER, nodes).t
    every = (len(t) - 1) // (nodes - 1)
    longest, span = 0.35 / np.sqrt(500.0), PAPER.motion.duration / (nodes - 1)
    assert t[every] == pytest.approx(span)  # the nodes are among them
    assert span / every <= longest < span / (every - 1)


def test_integration_weights_are_exact_for_cubics():
    for n in (7, 12, 61):
        t = np.linspace(0, 2, n)
        assert integration_weights(n, 2.0) @ (t**3 - 2 * t + 1) == pytest.approx(4 - 4 + 2)


def test_paper_condition_knows_only_objects_on_the_tray():
    lower = PAPER.model_dump(mode="json", exclude_none=True)["objects"][0]
    scenario = changed(objects=[lower, {**lower, "name": "upper", "on": "cube"}])
    with pytest.raises(ScenarioError, match="upper stands on cube"):
        Problem(scenario, 11).constraints  # noqa: B018
    assert Problem(scenario.with_changes(contact__condition="exact"), 11).constraints


@pytest.mark.parametrize("degree", [6, 9, 14])
def test_where_nothing_acts_on_the_closed_loop_the_motion_of_least_jerk_is_planned(degree):
    scenario = changed(objects__0__uncertainty={"friction": "10%"}, contact__condition="exact", motion__degree=degree)
    plan, line = plan_object(scenario), plan_baseline(scenario)
    assert plan.cost == 0
    # Equal but for the quadrature of the cost on the grid.
    assert plan.evaluation.samples.p_SB == pytest.approx(line.evaluation.samples.p_SB, abs=1e-6)


@pytest.mark.slow
def test_tilt_stays_below_its_limit_and_less_freedom_costs_more():
    free = changed(motion__orientation="free", motion__duration=0.8)
    plans = [plan_object(free.with_changes(motion__max_tilt_deg=limit)) for limit in (None, 15, 5)]
    tilt = [np.rad2deg(np.arccos(plan.evaluation.samples.R_SB[:, 2, 2].min())) for plan in plans]
    assert all(plan.ok for plan in plans)
    assert tilt[0] > 15  # so the next limit binds
    assert 14 < tilt[1] <= 15
    assert 4 < tilt[2] <= 5
    assert plans[0].cost < plans[1].cost < plans[2].cost


@pytest.mark.slow
def test_a_tray_that_tilts_is_quicker_than_a_level_one():
    """At full speed: standing still no load stays on a tray that leans so far."""
    plan = plan_object(changed(motion__orientation="free", motion__duration=0.6, motion__speeds="full"))
    assert plan.ok
    assert not plan_object(changed(motion__duration=0.6)).ok


def test_free_yaw_meets_the_vertical_only():
    tilted = {"position": GOAL, "rpy_deg": [8, 0, 70]}
    fixed = changed(motion__orientation="free", motion__goal=tilted, motion__duration=0.8, contact__condition="exact")
    plan = plan_object(fixed.with_changes(motion__goal_yaw="free"))
    assert plan.ok
    assert plan.cost <= plan_object(fixed).cost * (1 + 1e-4)
    assert plan.evaluation.samples.R_SB[-1, :, 2] == pytest.approx(fixed.motion.goal.rotation[:, 2], abs=1e-9)


@pytest.mark.parametrize(
    "changes",
    [
        pytest.param({"objects__0__friction": 1e-6}, marks=pytest.mark.slow),
        {"objects__0__friction": 1e-6, "contact__condition": "exact"},
        {"motion__duration": 0.01},
        {"contact__condition": "exact", "uncertainty__tilt_deg": [30.0, 0.0]},  # slides at rest, whatever the motion
    ],
    ids=["ice", "ice, exact", "a hundredth of a second", "slope"],
)
def test_what_no_motion_can_keep_gets_a_sentence_about_contact(changes):
    plan = plan_object(changed(**changes))
    assert plan.status.code == "infeasible"
    assert "misses the condition on cube" in plan.status.sentence
    assert plan.verification.sentence.startswith("The contact condition is missed by")


def test_a_margin_that_nothing_reaches_is_named():
    plan = plan_object(changed(objects__0__mass=1e-3, objects__0__inertia=[1e-6, 1e-6, 1e-6]))
    assert plan.status.code == "infeasible"
    assert "of the 0.001 N of contact.margin over its tube" in plan.status.sentence


@pytest.mark.slow
@pytest.mark.parametrize("name", ["panda-cube-tilted-goal", "panda-tall-bottle", "slippery-cube"])
def test_a_high_degree_finds_no_less_than_a_low_one(name):
    """Polynomials of degree 9 are of degree 30 too. One of degree 30 bends far between 61 nodes; the margin that was
    added for that, and kept when the nodes were brought closer, left nothing. Where no duration is given it is 2 s.
    """
    case = load(name)
    case = case.with_changes(arm=None, motion__duration=case.motion.duration or 2.0, motion__orientation="fixed")
    low, high = (plan_object(case.with_changes(motion__degree=degree)) for degree in (9, 30))
    assert low.ok
    assert high.ok, high.status
    assert high.verification.ok
    assert high.cost <= low.cost * (1 + 1e-6)
