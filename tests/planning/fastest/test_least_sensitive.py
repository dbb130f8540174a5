"""The least sensitive motion in a given time: the paper's cost over motions of the joints, and what it keeps."""

from __future__ import annotations

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from salver import scenario
from salver.cli import app
from salver.errors import ScenarioError, UnreachableError
from salver.planning.fastest import FastestOptions, transport_problem
from salver.planning.fastest.optimum import DEGREE
from salver.planning.fastest.safest import optima, quickest_within
from salver.planning.fastest.sensitive import SensitivityCost, plan_least_sensitive
from salver.planning.make import make_plan
from salver.planning.object.cost import sensitivity_cost, tray_loop
from salver.planning.plan import Plan
from salver.planning.trajopt.curves import FreeCurve, Grid
from salver.planning.trajopt.found import object_motion
from salver.planning.trajopt.objectives import Point
from salver.planning.trajopt.spline import RestSpline
from salver.planning.trajopt.watch import Watch
from salver.trajectory import JointMotion, SampledReference
from transport_problems import ROUGH, straight_start

FEW = FastestOptions(spans=8)
BOTTLE = scenario.load("panda-tall-bottle").with_changes(motion__duration=1.2, motion__speeds="full")


def cost_of(plan: Plan) -> float:
    """Eq (13) of what the plan says its object does, by the loop's response to that reference."""
    t = np.linspace(0, plan.duration, 601)
    return sensitivity_cost(plan.scenario, t, tray_loop(plan.scenario).along(plan.reference, t))


@pytest.mark.parametrize("weighting", ["paper", "pose", "scaled", [*range(12)]])
def test_the_cost_of_a_joint_motion_is_that_of_what_the_object_does_and_its_slope_is_that_of_differences(weighting):
    """A motion that tilts, of a bottle with uncertain mass, centre of mass and inertia, seen from the object alone."""
    case = BOTTLE.with_changes(objective__weighting=weighting)
    problem, spline = transport_problem(case), RestSpline(DEGREE, 8)
    rng = np.random.default_rng(3)
    begun = straight_start(problem, spline).coefficients
    turned = rng.standard_normal(begun.shape)
    turned[[0, -1]] = 0.0
    q = begun + 0.05 * turned
    objective, curve = (
        SensitivityCost(problem, spline, 1.2, 1.0),
        FreeCurve(problem, Grid.of(spline, np.linspace(0, 1, 2))),
    )

    def cost(coefficients):
        return objective.value(curve, Point(coefficients, 1.2))

    t = 1.2 * np.unique(np.concatenate([np.linspace(0, 1, 401), spline.breaks()]))
    z = FreeCurve(problem, Grid.of(spline, t / 1.2)).motion(q, 1.2)
    joint = JointMotion(t, *z[:3])
    seen = SampledReference(object_motion(problem, joint.t, joint.q, joint.dq, joint.ddq))
    instants = objective.t
    own = sensitivity_cost(case, instants, tray_loop(case).along(seen, instants))
    assert cost(q) == pytest.approx(own, rel=1e-5)  # what interpolation of the samples leaves

    way = rng.standard_normal(q.shape)
    way[[0, -1]] = 0.0
    step = 1e-5
    slope = objective.model(curve, Point(q, 1.2)).slope @ way.ravel()
    assert slope == pytest.approx((cost(q + step * way) - cost(q - step * way)) / (2 * step), rel=1e-6)


@pytest.fixture(scope="module")
def free():
    """The bottle's, with a tray that may tilt."""
    return make_plan(BOTTLE, "least-sensitive", options=ROUGH)


@pytest.mark.slow
def test_it_reacts_less_than_the_papers_plan_which_the_arm_cannot_follow_and_than_the_safest(free):
    plan = free
    paper, safest = (make_plan(BOTTLE, method, options=ROUGH) for method in ("robust", "safest"))
    assert plan.ok, (plan.status, plan.arm_status)
    assert plan.verification.ok
    assert plan.method == "least-sensitive"
    assert plan.space == "joint"
    assert not paper.ok
    assert paper.status.ok
    assert cost_of(plan) == pytest.approx(plan.solver["cost"], rel=1e-3)
    assert cost_of(plan) < 0.98 * cost_of(paper)
    assert cost_of(plan) < 0.9 * cost_of(safest)


@pytest.mark.slow
def test_of_the_optima_that_were_found_the_least_sensitive_is_taken():
    """A level cube in 0.9 s: some of the places to begin from lead to dearer optima than others."""
    case = scenario.load("panda-cube").with_changes(motion__duration=0.9, motion__orientation="fixed")
    taken = plan_least_sensitive(case, options=FEW).solver
    watch = Watch(None)
    quickest, duration = quickest_within(case, "least sensitive", FEW, watch)
    objective = SensitivityCost(quickest.problem, quickest.spline, duration, taken["line"])
    curve = FreeCurve(quickest.problem, Grid.of(quickest.spline, np.linspace(0, 1, 2)))
    found = [m for m in optima(objective, quickest, duration, FEW, watch) if m.status.ok]
    costs = [objective.value(curve, Point(m.coefficients, duration)) for m in found]
    assert max(costs) > (1 + 1e-4) * min(costs)
    assert taken["cost"] / taken["line"] == pytest.approx(min(costs), rel=1e-6)


@pytest.mark.slow
def test_a_tray_that_keeps_its_orientation_does_so_and_is_the_more_sensitive_for_it(free):
    fixed = make_plan(BOTTLE.with_changes(motion__orientation="fixed"), "least-sensitive", options=ROUGH)
    assert fixed.ok
    assert np.abs(fixed.reference.sample(fixed.t).R_SB[:, 2, 2] - 1).max() < 1e-5
    assert cost_of(free) < cost_of(fixed)


@pytest.mark.slow
def test_what_cannot_be_asked_is_told():
    case = scenario.load("panda-cube")
    with pytest.raises(ScenarioError, match=r"no uncertain parameter acts on the closed loop of cube"):
        plan_least_sensitive(case.with_changes(objects__0__uncertainty={"friction": "10%"}), options=FEW)
    with pytest.raises(ScenarioError, match=r"motion\.duration is missing; the least sensitive plan needs one"):
        plan_least_sensitive(case.with_changes(motion__duration=None), options=FEW)
    with pytest.raises(UnreachableError, match=r"no safe motion in 0\.3 s was found"):
        plan_least_sensitive(case.with_changes(motion__duration=0.3), options=FEW)
    asked = CliRunner().invoke(app, ["plan", "panda-cube", "--safest", "--least-sensitive"])
    assert asked.exit_code == 2
    assert "give one of them" in asked.output
    rounds = CliRunner().invoke(app, ["plan", "waiters-round", "--least-sensitive"])
    assert rounds.exit_code == 2
    assert "--least-sensitive is not for a task of several legs" in rounds.output


def test_a_plan_that_the_arm_cannot_follow_says_what_can_be_asked_instead(tmp_path):
    done = CliRunner().invoke(app, ["plan", "panda-cube", "--duration", "1", "-o", str(tmp_path / "cube")])
    assert done.exit_code == 3, done.output
    assert "--least-sensitive plans the same within the arm's limits" in done.output


@pytest.mark.slow
def test_the_command_writes_a_plan_that_is_read_again(tmp_path):
    directory = tmp_path / "least"
    words = ["plan", "panda-cube", "--least-sensitive", "--duration", "1", "--effort", "quick"]
    words += ["-o", str(directory), "--json"]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)["plan"]
    assert told["method"] == "least-sensitive"
    again = CliRunner().invoke(app, ["simulate", str(directory)])
    assert again.exit_code == 0, again.output
