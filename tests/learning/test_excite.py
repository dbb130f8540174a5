"""Excitation trajectories: the objective's slope, what it promises against what logs give, and that it is safe."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import salver as sv
from salver.cli import app
from salver.errors import ScenarioError
from salver.learning import identify
from salver.learning.load.excite import Information, plan_excite
from salver.learning.load.noise import SensorNoise
from salver.learning.load.sensors import simulated_log
from salver.planning.fastest import AtPosture, Point, transport_problem
from salver.planning.plan import Plan
from salver.planning.trajopt.curves import FreeCurve, Grid
from salver.planning.trajopt.spline import RestSpline
from salver.sampling import draw
from salver.scenario import load
from salver.simulation.physics import Experiment
from sensed_arm import SensedArm, Sensors, nominal_load

WIDE = {"mass": "50%", "com": [0.015, 0.015, 0.015], "friction": "10%"}


@pytest.fixture(scope="module")
def plan() -> Plan:
    return plan_excite(load("panda-tall-bottle").with_changes(objects__0__uncertainty=WIDE, motion__speeds="full"), 1.5)


def test_slope_of_what_is_told_agrees_with_differences() -> None:
    problem = transport_problem(load("panda-tall-bottle").with_changes(objects__0__uncertainty=WIDE))
    assert problem.start_posture is not None
    here, rng = AtPosture(problem.start_posture), np.random.default_rng(1)
    problem, spline = replace(problem, start=here, goal=here), RestSpline(5, 8)
    objective, curve = Information.of(problem), FreeCurve(problem, Grid.of(spline, spline.nodes(3)))
    q = here.q + 0.05 * rng.standard_normal((spline.size, problem.n))
    along = rng.standard_normal(q.shape)

    def value(step: float) -> float:
        return objective.value(curve, Point(q + step * along, 1.5))

    # Of the covariance of all ten, the block of mass and first moment.
    covariance = np.linalg.inv(objective._seen(curve, Point(q, 1.5))[0])[:4, :4]
    assert value(0.0) == pytest.approx(0.5 * np.linalg.slogdet(covariance)[1], rel=1e-9)
    slope = objective.model(curve, Point(q, 1.5)).slope @ along.ravel()
    assert (value(1e-4) - value(-1e-4)) / 2e-4 == pytest.approx(slope, rel=1e-4)


def test_ranges_half_as_wide_are_four_times_the_information() -> None:
    known = []
    for share in (50, 25):
        ranges = {"mass": f"{share}%", "com": [0.0] * 3, "friction": "10%"}
        problem = transport_problem(load("panda-tall-bottle").with_changes(objects__0__uncertainty=ranges))
        known.append(Information.of(problem).known[0, 0])
    assert known[1] == pytest.approx(4 * known[0])


def test_a_simulated_log_has_the_load_and_the_noise_that_are_assumed() -> None:
    plan = sv.plan("panda-cube", method="baseline")
    body, sensors = plan.scenario.payload.first.inertial, SensorNoise()
    for load_ in (body, replace(body, mass=1.3 * body.mass)):
        there, empty = (simulated_log(plan, x, 5).wrench_F[0] for x in (load_, None))
        assert (there - empty)[2] == pytest.approx(9.81 * load_.mass, rel=1e-4)  # at rest, upright
    runs = np.array([simulated_log(plan, None, seed).wrench_F for seed in range(40)])
    noise, later = runs - runs.mean(axis=0), 20
    for k, channel in ((0, sensors.force), (3, sensors.moment)):
        each = noise[:, :, k : k + 3] * np.sqrt(40 / 39)
        assert each.var() == pytest.approx(channel.white**2 + channel.coloured**2, rel=0.1)
        together = (each[:, later:] * each[:, :-later]).mean()
        assert together == pytest.approx(channel.coloured**2 * np.exp(-1e-3 * later / sensors.colour), rel=0.1)


@pytest.mark.slow
def test_it_is_safe_tells_more_than_the_transport_and_as_much_as_promised(plan: Plan) -> None:
    assert plan.ok
    assert plan.joint is not None
    assert plan.joint.q[0] == pytest.approx(plan.joint.q[-1], abs=1e-9)
    promised = float(plan.status.sentence.split("+-")[1].split(" g")[0])
    carried = sv.plan(
        plan.scenario.with_changes(motion__goal=load("panda-tall-bottle").motion.goal.model_dump()), "fastest"
    )
    found = []
    for each in (plan, carried):
        arm = SensedArm(each, 3, Sensors(rate=1000.0), joints=False)
        found.append(identify(each, [arm.log(nominal_load(each))], arm.log(None)))
    half = [1e3 * seen.ranges["mass"].half for seen in found]
    assert half[0] < half[1]
    assert half[0] == pytest.approx(promised, rel=0.2)


@pytest.mark.slow
def test_the_load_stays_at_corners_of_its_ranges(plan: Plan) -> None:
    uncertain, experiment = plan.scenario.payload.uncertain, Experiment(plan)
    for k, row in enumerate(draw(uncertain, 6, 0, "corners", plan.scenario.payload.bodies)):
        assert experiment.run(dict(zip(uncertain.names, map(float, row), strict=True)), k).outcome == "holds"


@pytest.mark.parametrize("duration", [0.0, float("nan"), 100.0])
def test_absurd_durations_are_refused(duration: float) -> None:
    with pytest.raises(ScenarioError, match=r"must be 0\.3 to 30\.$"):
        plan_excite(load("panda-tall-bottle"), duration)


def test_command_refuses_what_it_cannot_do(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["excite", "upright-cups", "-o", str(tmp_path / "out")])
    assert done.exit_code == 2
    assert not (tmp_path / "out").exists()
