"""What the fastest motion is made of: spline, rows and their derivatives, and what a wrong load does to the arm."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin
import pytest
from scipy.interpolate import BSpline

from salver.geometry import Array
from salver.models.arm.arm import with_load
from salver.models.tray_motion import Speed, corners
from salver.models.uncertain.parameters import Parameter, inertial_vector
from salver.models.uncertain.worst_case import Drift, WorstCase
from salver.planning.fastest import object_motion
from salver.planning.object.evaluation import evaluate
from salver.planning.trajopt.constraints.constraints import ContactConstraint, TiltConstraint
from salver.planning.trajopt.constraints.load_limits import LoadConstraint
from salver.planning.trajopt.curves import FreeCurve, Grid
from salver.planning.trajopt.ends import AtPosture
from salver.planning.trajopt.objectives import Duration, Point
from salver.planning.trajopt.problem import TransportProblem, transport_problem
from salver.planning.trajopt.programme import Programme, Subproblem
from salver.planning.trajopt.spline import RestSpline, b_splines
from salver.planning.trajopt.sqp import SqpOptions, minimise
from salver.scenario import Scenario, load
from salver.sensitivity.arm.terms import motion_terms
from salver.trajectory import SampledReference, smooth_step
from shaken_loads import BOX, BOX_IN
from transport_problems import bottle, cube, line

UNCERTAIN = {"mass": "20%", "com": [0.003, 0.002, 0.004], "inertia": "10%", "friction": "10%"}


# The spline ----------------------------------------------------------------------------------------------------


def test_spline_rests_at_both_ends_whatever_its_coefficients():
    spline = RestSpline(5, 9)
    coefficients = np.random.default_rng(0).normal(size=(spline.size, 3))
    q, dq, ddq, _ = spline.matrices(np.array([0.0, 1.0])) @ coefficients
    assert np.abs(q - coefficients[[0, -1]]).max() < 1e-12
    assert np.abs(dq).max() < 1e-9
    assert np.abs(ddq).max() < 1e-7


@pytest.mark.parametrize(("degree", "spans"), [(4, 1), (5, 20), (7, 3)])
def test_b_splines_are_those_of_another_library(degree, spans):
    spline = RestSpline(degree, spans)
    s, n = np.union1d(np.linspace(0, 1, 101), spline.breaks()), spans + degree
    other = BSpline(spline.knots(), np.eye(n), degree)
    for k, rows in enumerate(b_splines(spline.knots(), degree, s, 4)):
        assert rows == pytest.approx(other.derivative(k)(s) if k else other(s), abs=1e-13 * (degree * 30 * spans) ** k)


def test_spline_derivatives_are_derivatives():
    spline, h = RestSpline(5, 7), 1e-5
    coefficients = np.random.default_rng(1).normal(size=(spline.size, 2))
    s = np.linspace(0.05, 0.95, 40)
    ahead, here, behind = (spline.matrices(s + step) @ coefficients for step in (h, 0.0, -h))
    for k in range(3):
        assert np.allclose((ahead[k] - behind[k]) / (2 * h), here[k + 1], rtol=1e-5, atol=1e-3 * 10**k)


def test_spline_reproduces_a_min_jerk_line():
    spline = RestSpline(5, 14)
    s = np.linspace(0, 1, 201)
    coefficients = spline.fit(s, smooth_step(s)[:, None])
    assert np.abs(spline.matrices(s)[0] @ coefficients - smooth_step(s)[:, None]).max() < 1e-10


# Terms and rows ------------------------------------------------------------------------------------------------


def test_motion_terms_match_differences_and_pinocchio():
    problem = transport_problem(cube())
    rng = np.random.default_rng(2)
    z = rng.normal(size=(4, 21))
    z[:, :7] = 0.5 * (problem.limits.q_min + problem.limits.q_max) + 0.3 * z[:, :7]

    def terms(z: Array):
        return motion_terms(problem.model, problem.arm.tray_id, z[:, :7], z[:, 7:14], z[:, 14:])

    here, h = terms(z), 1e-6
    for k in range(21):
        step = np.zeros(21)
        step[k] = h
        ahead, behind = terms(z + step), terms(z - step)
        assert np.allclose((ahead.w - behind.w) / (2 * h), here.w_z[:, :, k], atol=2e-7, rtol=1e-6)
        assert np.allclose((ahead.torque - behind.torque) / (2 * h), here.torque_z[:, :, k], atol=2e-6, rtol=1e-6)
    loaded = with_load(problem.arm, problem.items)
    change = rng.normal(size=(4, 21, 2))
    shift, rate, felt = here.changed(change)
    assert np.allclose(shift, here.jacobian @ change[:, :7], atol=1e-9)
    assert np.allclose(rate, here.twist_q @ change[:, :7] + here.jacobian @ change[:, 7:14], atol=1e-9)
    assert np.allclose(felt, here.w_z @ change, atol=1e-9)
    for i in range(4):
        assert np.allclose(here.torque[i], loaded.inverse_dynamics(z[i, :7], z[i, 7:14], z[i, 14:]), atol=1e-10)
        assert np.allclose(here.mass_matrix[i], loaded.mass_matrix(z[i, :7]), atol=1e-10)


def test_object_motion_is_the_derivative_of_its_own_positions():
    problem = transport_problem(cube())
    spline, duration = RestSpline(5, 8), 1.3
    coefficients = line(problem, spline)
    t = np.linspace(0, duration, 2001)
    z = Grid.of(spline, t / duration).motion(coefficients, duration)
    motion = object_motion(problem, t, z[0], z[1], z[2])
    assert np.allclose(np.gradient(motion.p_SB, t, axis=0)[2:-2], motion.v_S[2:-2], atol=1e-5)
    assert np.allclose(np.gradient(motion.v_S, t, axis=0)[2:-2], motion.a_S[2:-2], atol=1e-4)
    assert np.allclose(np.gradient(motion.omega_B, t, axis=0)[2:-2], motion.alpha_B[2:-2], atol=1e-4)


@pytest.mark.parametrize("strays", [False, True])
@pytest.mark.parametrize("kind", ["box", "ellipsoid"])
def test_derivative_of_the_worst_case(kind, strays):
    correlation = {"mass,com_x": 0.5, "com_x,com_z": -0.6, "com_y,inertia_yy": 0.4} if kind == "ellipsoid" else {}
    scenario = bottle(**UNCERTAIN).with_changes(uncertainty={"set": kind, "correlation": correlation})
    rows, rng = transport_problem(scenario).contacts[0], np.random.default_rng(3)
    count = 12
    w = rng.normal(size=(count, 12)) + np.array([0, 0, 9.81, *[0] * 9])
    drift = None
    if strays:
        terms = tuple((p,) for p in scenario.payload.uncertain.parameters if p.entry is not None)
        terms = (*terms, (*terms[0], *terms[1]), (Parameter("other", "mass"),))
        swing = 0.05 * rng.normal(size=(count, 12))
        drift = Drift(terms, 0.1 * rng.normal(size=(count, 12, len(terms))), swing)
    node, row = (index.ravel() for index in np.indices((count, len(rows.nominal))))
    slope, h = WorstCase.of(rows, w, drift).attained(node, row), 1e-6
    for k in range(12):
        step = h * np.eye(12)[k]
        difference = (rows.worst(w + step, drift) - rows.worst(w - step, drift))[node, row] / (2 * h)
        assert np.abs(difference - slope[:, k]).max() < 1e-6  # w is some 10, so rounding is 1e-15 over h


def test_contact_rows_know_that_a_held_command_is_late_by_the_jerk():
    """At the start nothing has a history yet: the derivative by the jerk there is exact."""
    problem = transport_problem(bottle(**UNCERTAIN))
    spline = RestSpline(5, 6)
    grid = Grid.of(spline, spline.nodes(3))
    coefficients = line(problem, spline) + 0.02 * np.random.default_rng(4).normal(size=(spline.size, problem.n))
    z, contact = (
        grid.motion(coefficients, 0.9),
        next(c for c in problem.constraints if isinstance(c, ContactConstraint)),
    )

    def rows(jerk):
        moved = z.copy()
        moved[3, 0] = jerk
        return next(iter(contact.blocks(problem.at(grid.s, moved, 0.9))))

    jerk, h, seen = z[3, 0], 1e-3, 0
    for joint in range(problem.n):
        step = h * np.eye(problem.n)[joint]
        difference = (rows(jerk + step).values - rows(jerk - step).values)[0] / (2 * h)
        every = np.arange(len(difference))
        slope = rows(jerk).gradient(np.zeros(len(every), dtype=int), every)[:, 3 * problem.n + joint]
        assert np.abs(difference - slope).max() < 1e-11  # rounding of the rows, over h
        seen = max(seen, np.abs(slope).max())
    assert seen > 1e-6


def changes(programme, path, masks, direction, tau):
    """Of linearised rows, multiplied by T^2 / T_0^2 where they scale, along a direction of the coefficients and tau of
    T^2: their names, what they are by differences, and what is predicted."""
    rows, point, h = programme.linearised(path, masks), path.point, 1e-6

    def moved(sign: float) -> Array:
        factor = 1 + sign * h * tau
        there = Point(point.coefficients + sign * h * direction, point.duration * float(np.sqrt(factor)))
        blocks = programme.at(there).blocks
        return np.concatenate(
            [blocks[k].values[node, f] * (factor if blocks[k].scales else 1.0) for k, node, f in rows.where]
        )

    names = np.concatenate([np.full(len(node), path.blocks[k].name) for k, node, _ in rows.where])
    return names, (moved(1.0) - moved(-1.0)) / (2 * h), rows.matrix @ np.append(direction.ravel(), tau)


def test_linearised_rows_match_differences_in_coefficients_and_squared_duration():
    problem = transport_problem(cube(motion__orientation="fixed", motion__speed_rate=0.5), robust=False)
    spline = RestSpline(5, 6)
    programme = Programme(FreeCurve(problem, Grid.of(spline, spline.nodes(3))), problem.constraints, Duration())
    rng = np.random.default_rng(4)
    coefficients = line(problem, spline) + 0.02 * rng.normal(size=(spline.size, problem.n))
    path = programme.at(Point(coefficients, 0.9))
    near, direction = [block.near(10.0) for block in path.blocks], rng.normal(size=coefficients.shape)
    names, difference, predicted = changes(programme, path, near, direction, 0.3)
    assert {"velocity", "torque", "torque rate", "tilt", "clearance"} <= set(names)
    at = ("", " standing still")
    assert {f"contact of cube{where} while the speed changes" for where in at} <= set(names)
    error = np.abs(difference - predicted) / (1 + np.abs(predicted))
    # Where the nearest points of two hulls jump, a distance has only one-sided derivatives.
    assert error[names != "clearance"].max() < 1e-5
    assert np.quantile(error[names == "clearance"], 0.9) < 1e-2


def test_a_step_that_leads_far_astray_is_not_taken_and_nothing_is_said_of_it(monkeypatch):
    """Waves of a motion that is 1e60 times as wide are higher than numbers are, and so are their forces, of which one
    less the other is none."""
    problem = transport_problem(load("panda-coffee"), robust=False)
    wet = [each for each in problem.constraints if isinstance(each, ContactConstraint | LoadConstraint)]
    spline = RestSpline(5, 6)
    programme = Programme(FreeCurve(problem, Grid.of(spline, spline.nodes(12))), wet, Duration())
    path = programme.at(Point(line(problem, spline), 1.2))
    wide = np.r_[0, np.linspace(0.5e60, 1e60, spline.size - 2), 0].repeat(problem.n)  # both ends stay
    astray, moved = np.append(wide, 0.0), []
    monkeypatch.setattr(Subproblem, "solve", lambda self, rows: (astray, 0.0, np.zeros(len(rows.bound))))
    monkeypatch.setattr(Programme, "moved", lambda *args, of=Programme.moved: moved.append(of(*args)) or moved[-1])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = minimise(programme, path, SqpOptions(iterations=2))
    assert moved
    assert all(each.violation == np.inf for each in moved)
    assert found.iterate is path


@pytest.mark.parametrize(
    ("factor", "where", "beside"),
    [(1.0, "", False), (0.6, " at 60 % of full speed", False), (1.0, "", True)],
    ids=["one cup", "slower", "a cup and a turned box beside their places"],
)
def test_rows_of_waves_know_all_that_was_felt_before(factor, where, beside):
    """The whole motion in between changes, and its duration. What is interpolated between the nodes has an error of
    fourth order: on twice as many nodes a sixteenth."""
    scenario = load("panda-coffee")
    if beside:
        cup = scenario.objects[0].model_dump(mode="json", exclude_none=True)
        box = {**cup, "name": "box", "shape": BOX["objects__0__shape"], "liquid": BOX_IN, "at": [0.09, -0.1]}
        scenario = scenario.with_changes(objects=[cup, box | {"yaw_deg": 35.0}], tray__size=[0.4, 0.4])
    problem = replace(transport_problem(scenario, robust=False), speeds=(Speed(factor),))
    if beside:
        asides = ((0.02, -0.03), (-0.03, 0.01))
        cases = [tuple(replace(case, aside=aside) for case in each for aside in asides) for each in problem.cases]
        problem = replace(problem, cases=tuple(cases))
    wet = [each for each in problem.constraints if isinstance(each, ContactConstraint | LoadConstraint)]
    spline, rng = RestSpline(5, 6), np.random.default_rng(4)
    inner = np.r_[0, np.ones(spline.size - 2), 0][:, None]  # at both ends the tray rests level where it was told
    bent, direction = inner * rng.normal(size=(2, spline.size, problem.n))
    errors = []
    for density in (12, 24):
        programme = Programme(FreeCurve(problem, Grid.of(spline, spline.nodes(density))), wet, Duration())
        path = programme.at(Point(line(problem, spline) + 0.02 * bent, 1.2 * factor))  # at the factor it takes 1.2 s
        exact = [block.values > -block.remembers for block in path.blocks]
        names, difference, predicted = changes(programme, path, exact, direction, 0.3)
        what = ("contact of", "effective gravity in", "steepness in", "steepness left in", "waves in", "waves left in")
        each = [f"{name} {item.name}" for item in scenario.objects for name in what]
        assert set(names) == {f"{name}{where}" for name in each}
        relative = np.abs(difference - predicted) / np.abs(predicted).max()
        errors.append([relative[names == f"{name}{where}"].max() for name in each])
    light = np.array(["gravity" in name for name in each])
    coarse, fine = np.array(errors)[:, ~light]
    assert np.max(coarse) < 1e-3
    cups = np.array(["cup" in name for name in each])[~light]  # the walls of a box turn its waves, to a thousandth
    assert np.all(np.divide(coarse, fine)[cups] > 10)
    assert np.max(np.array(errors)[:, light]) < 1e-9  # it remembers nothing


def test_contact_of_an_arm_that_follows_exactly_is_what_the_check_of_a_plan_looks_at():
    """Independent of the rows' own way: the object's motion from its poses, and the conditions of an object's plan."""
    scenario = cube(motion__orientation="free")
    problem = transport_problem(scenario)
    spline, duration = RestSpline(5, 6), 0.8
    coefficients = line(problem, spline)
    s = np.linspace(0, 1, 61)
    z = FreeCurve(problem, Grid.of(spline, s)).motion(coefficients, duration)
    motion = problem.at(s, z, duration, imposed=False)
    (rows,) = problem.contacts
    assert len(problem.speeds) == 4
    exactly, allowing = (
        [next(iter(ContactConstraint(rows, speed=speed, exactly=x).blocks(motion))) for speed in problem.speeds]
        for x in (True, False)
    )
    reference = SampledReference(object_motion(problem, s * duration, *z[:3]))
    slack = evaluate(scenario.with_changes(contact__condition="exact"), reference, len(s)).slack
    assert np.hstack([block.values for block in exactly]) == pytest.approx(-slack, abs=1e-9)
    differ = [np.abs(one.values - other.values).max() for one, other in zip(exactly, allowing, strict=True)]
    assert min(differ[:2]) > 1e-3
    assert min(differ[2:]) > 1e-5  # the arm sags under a wrong load, by little
    assert not exactly[0].gradient(np.array([20]), np.array([3]))[:, 3 * problem.n :].any()  # jerk is for held commands


def tilting(problem, seed=3, spans=6, points=121, duration=1.2):
    """A motion of the arm on which the tray turns about every axis, within the limits of its jerk."""
    spline, rng = RestSpline(5, spans), np.random.default_rng(seed)
    inner = np.r_[0, np.ones(spline.size - 2), 0][:, None]
    coefficients = line(problem, spline) + 0.08 * inner * rng.normal(size=(spline.size, problem.n))
    s = np.linspace(0, 1, points)
    z = FreeCurve(problem, Grid.of(spline, s)).motion(coefficients, duration)
    return problem.at(s, z, duration, imposed=False)


def test_an_arm_that_stands_still_sags_as_one_that_moves_very_slowly_strays():
    motion = tilting(transport_problem(bottle(**UNCERTAIN)))
    slow = motion.at_factor(1e-3).response.felt()[1]
    assert slow is not None
    assert motion.sag.terms == slow.terms
    assert np.abs(motion.sag.dw).max() > 1e-3
    assert motion.sag.dw[1:] == pytest.approx(slow.dw[1:], abs=1e-5)  # where it begins, it has not quite settled


@pytest.mark.parametrize("seed", range(4))
def test_contact_at_any_factor_and_rate_is_no_nearer_to_its_edge_than_at_the_corners(seed):
    """Of an arm that follows exactly. What a wrong load makes of one has a time scale of its own."""
    problem = transport_problem(bottle(**UNCERTAIN))
    (rows,), motion, rng = problem.contacts, tilting(problem, seed=seed), np.random.default_rng(seed)

    def values(speed):
        return next(iter(ContactConstraint(rows, speed=speed, exactly=True).blocks(motion))).values

    full, full_back, still, still_back = (values(speed) for speed in corners("any", 0.25))
    for factor, rate in rng.uniform([0.02, -0.25], [1.0, 0.25], (6, 2)):
        at_corners = (1 - factor**2) * np.maximum(still, still_back) + factor**2 * np.maximum(full, full_back)
        assert (values(Speed(factor, rate)) <= at_corners + 1e-9).all()


def test_commands_are_held_for_a_period_also_where_nothing_is_uncertain():
    """What that costs grows as the period does; only a nominal plan leaves it out."""
    costs = []
    for period in (1e-3, 2e-3):
        problem = transport_problem(bottle().with_changes(physics__command_period=period))
        assert not problem.uncertain.size
        spline, duration, s = RestSpline(5, 6), 0.8, np.linspace(0, 1, 61)
        z = FreeCurve(problem, Grid.of(spline, s)).motion(line(problem, spline), duration)
        motion = problem.at(s, z, duration, imposed=False)
        exactly, allowing = (
            next(iter(ContactConstraint(problem.contacts[0], exactly=x).blocks(motion))).values for x in (True, False)
        )
        costs.append(np.abs(allowing - exactly).max())
    assert costs[0] > 1e-4
    assert costs[1] == pytest.approx(2 * costs[0], rel=0.1)
    assert transport_problem(bottle(), robust=False).tracking is None


def test_putting_the_goal_right_does_not_jolt_the_arm():
    """The correction of a goal missed by 2 mrad is itself a smooth move of that size."""
    problem = transport_problem(cube(), robust=False)
    spline, duration = RestSpline(5, 14), 1.0
    curve = FreeCurve(problem, Grid.of(spline, spline.nodes(4)))
    missed = line(problem, spline)
    missed += np.linspace(0, 1, spline.size)[:, None] * np.array([0.0, 2e-3, 0, 0, 0, 0, 0])
    right = curve.repaired(missed)
    assert right is not None
    moved = curve.motion(right, duration) - curve.motion(missed, duration)
    size = np.abs(moved[0]).max()
    assert 5e-4 < size < 5e-3
    assert np.abs(moved[2]).max() < 20 * size / duration**2  # min-jerk takes 5.8; the last control point alone 1759


def test_an_end_is_reached_with_a_joint_at_its_stop():
    problem = transport_problem(cube(), robust=False)
    assert problem.start_posture is not None
    free = problem.goal.nearest(problem.arm, problem.limits, problem.start_posture)
    assert free is not None
    for joint, shift in ((0, -0.05), (1, -0.05), (2, 0.05)):
        q_min, q_max = problem.limits.q_min.copy(), problem.limits.q_max.copy()
        side = q_max if shift < 0 else q_min
        side[joint] = free[joint] + shift
        tight = replace(problem.limits, q_min=q_min, q_max=q_max)
        q = problem.goal.nearest(problem.arm, tight, problem.start_posture)
        assert q is not None, joint
        assert np.all((q > q_min) & (q < q_max))
        assert np.abs(problem.goal.residual(problem.arm, q)[0]).max() < 1e-10


def test_rows_beyond_a_kink_are_exact_where_they_were_taken():
    box = {"name": "post", "type": "box", "position": [0.55, -0.13, 0.3], "size": [0.1, 0.1, 0.6]}
    problem = transport_problem(cube(obstacles=[box]), robust=False)
    spline = RestSpline(5, 8)
    programme = Programme(FreeCurve(problem, Grid.of(spline, spline.nodes(3))), problem.constraints, Duration())
    first = line(problem, spline)
    path, trial = (programme.at(Point(c, 1.0)) for c in (first, first + 0.02 * np.sin(np.arange(7))))
    kinked = programme.beyond_kinks(path, trial)
    (clearance,) = (block for block in trial.blocks if block.kinked)
    moved = np.append((trial.coefficients - path.coefficients).ravel(), 0.0)
    assert len(kinked.bound) > 3
    assert np.allclose(kinked.matrix @ moved - kinked.bound, clearance.values[clearance.values > 0], atol=1e-12)


# The closed loop -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class WrongLoad:
    """A bottle on a line of 1 s: the first-order response, and rollouts with bottles that are another."""

    scenario: Scenario
    problem: TransportProblem
    spline: RestSpline
    coefficients: Array
    duration: float = 1.0
    steps: int = 400

    @classmethod
    def of(cls, **uncertainty: object) -> WrongLoad:
        scenario = bottle(**uncertainty)
        problem, spline = transport_problem(scenario, level=False), RestSpline(5, 8)
        return cls(scenario, problem, spline, line(problem, spline))

    def motion(self, s: Array) -> Array:
        return Grid.of(self.spline, s).motion(self.coefficients, self.duration)

    def response(self, name: str) -> Array:
        """Joint errors (steps + 1, 7) for one half-range of a term."""
        tracking, s = self.problem.tracking, np.linspace(0, 1, self.steps + 1)
        assert tracking is not None
        z = self.motion(s)
        terms = motion_terms(self.problem.model, self.problem.arm.tray_id, z[0], z[1], z[2])
        found = replace(tracking, settle=0.0).along(s * self.duration, terms, z[1:])
        column = ["*".join(p.name for p in factors) for factors in tracking.load.terms].index(name)
        return -found.joints.q[:, :, column] * tracking.load.half_range[column]

    def rollout(self, **signs: float) -> Array:
        """The same of the true arm: nominal computed torque on Pinocchio's forward dynamics, by Runge-Kutta."""
        problem, tracking, uncertain = self.problem, self.problem.tracking, self.scenario.payload.uncertain
        assert tracking is not None
        half = dict(zip(uncertain.names, uncertain.half_range, strict=True))
        body = self.scenario.payload.first
        values = inertial_vector(body.inertial)
        for name, sign in signs.items():
            values[("mass", "com_x", "com_y", "com_z").index(name)] += sign * half[name]
        true = replace(body, inertial=replace(body.inertial, mass=values[0], com_B=values[1:4]))
        model = with_load(problem.arm, [true]).pin_model
        data, nominal = model.createData(), problem.model.createData()

        def slope(time: float, x: Array) -> Array:
            q, dq, ddq = self.motion(np.array([time / self.duration]))[:3, 0]
            command = ddq + tracking.kp * (q - x[:7]) + tracking.kd * (dq - x[7:])
            torque = pin.rnea(problem.model, nominal, x[:7], x[7:], command)
            return np.concatenate([x[7:], pin.aba(model, data, x[:7], x[7:], torque)])

        wanted, h = self.motion(np.linspace(0, 1, self.steps + 1))[0], self.duration / self.steps
        x, path = np.concatenate([wanted[0], np.zeros(7)]), []
        for i in range(self.steps):
            path.append(wanted[i] - x[:7])
            time = i * h
            k1 = slope(time, x)
            k2 = slope(time + 0.5 * h, x + 0.5 * h * k1)
            k3 = slope(time + 0.5 * h, x + 0.5 * h * k2)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + slope(min(time + h, self.duration), x + h * k3))
        return np.array([*path, wanted[-1] - x[:7]])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mass", "com_x", "com_z"])
def test_tracking_matches_a_rollout_of_the_arm_with_a_wrong_load(name):
    case = WrongLoad.of(mass="4%", com=[0.001, 0.001, 0.001])
    difference = 0.5 * (case.rollout(**{name: 1.0}) - case.rollout(**{name: -1.0}))
    assert np.abs(difference).max() > 1e-6
    assert np.abs(difference - case.response(name)).max() < 2e-3 * np.abs(difference).max()


@pytest.mark.slow
def test_tracking_knows_that_mass_multiplies_its_distance():
    """What a heavier bottle and a higher centre of mass do together, beyond what each does alone.

    Four fifths are in the load itself; the rest is what the heavier load makes of the error that its centre of mass
    causes.
    """
    case = WrongLoad.of(mass="40%", com=[0.005, 0.005, 0.005])
    corners = {(m, c): case.rollout(mass=m, com_z=c) for m in (1.0, -1.0) for c in (1.0, -1.0)}
    together = 0.25 * sum(m * c * error for (m, c), error in corners.items())
    predicted = case.response("mass*com_z")
    assert np.abs(together - predicted).max() < 0.03 * np.abs(together).max()


def test_tracking_starts_sagged_after_long_rest():
    """After a long rest the error is static: kp e = M^-1 J^T dF."""
    scenario = bottle(mass="10%")
    problem = transport_problem(scenario, level=False)
    tracking = problem.tracking
    assert tracking is not None
    spline = RestSpline(5, 8)
    z = Grid.of(spline, np.linspace(0, 1, 51)).motion(line(problem, spline), 1.0)
    terms = motion_terms(problem.model, problem.arm.tray_id, z[0], z[1], z[2])
    found = replace(tracking, settle=50.0).along(np.linspace(0, 1, 51), terms, z[1:]).joints
    extra = 9.81  # of a kilogram
    point_jacobian = terms.R_SE[0] @ terms.jacobian[0, :3]  # the load is above E, and E is level: the lever is vertical
    expected = np.linalg.solve(terms.mass_matrix[0], extra * point_jacobian[2]) / tracking.kp
    assert np.allclose(-found.q[0, :, 0], expected, rtol=1e-4, atol=1e-9)
    assert np.abs(found.dq[0]).max() < 1e-9


# The curve ------------------------------------------------------------------------------------------------------


def test_when_its_ends_are_put_right_a_motion_follows_each_the_less_the_further_away():
    line_problem = transport_problem(cube(0.2))
    spline = RestSpline(5, 9)
    start, goal = np.linspace(0.1, 0.7, 7), np.linspace(-0.5, 0.4, 7)
    problem = replace(line_problem, start=AtPosture(start), goal=AtPosture(goal))
    curve = FreeCurve(problem, Grid.of(spline, np.linspace(0, 1, 9)))
    shares = np.linspace(0, 1, spline.size)[:, None]
    asked = start + shares * (goal - start)
    off_start, off_goal = np.full(7, 0.02), np.full(7, -0.05)
    assert np.allclose(curve.repaired(asked + off_start) - asked, 0.0, atol=1e-15)  # both by the same: all by that
    moved = curve.repaired(asked + (1 - shares) * off_start + shares * off_goal) - (
        asked + (1 - shares) * off_start + shares * off_goal
    )
    assert np.allclose(moved[[0, -1]], np.stack([-off_start, -off_goal]), atol=1e-15)
    assert np.all(np.diff(moved, axis=0) > 0)  # from -0.02 to 0.05, without a jolt in between


def test_tilt_counts_in_shares_of_what_is_allowed():
    """A level tray has the whole of 1 - cos(largest) left; one that leans by 90 degrees has gone far beyond."""
    problem = transport_problem(cube(0.2))
    s = np.linspace(0, 1, 5)
    motion = problem.at(s, np.stack([np.tile(problem.start_posture, (5, 1)), *[np.zeros((5, 7))] * 3]), 1.0)
    for largest in np.deg2rad([8.0, 45.0]):
        (block,) = TiltConstraint(largest).blocks(motion)
        assert np.allclose(block.values, -1.0, atol=1e-6)
