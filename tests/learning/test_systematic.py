"""What a sensor is beside its noise: within the bounds the ranges hold the truth, however many logs there are; beyond
them it is seen, or the ranges hold the truth still."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from salver.cli import app
from salver.errors import FileFormatError, ScenarioError
from salver.geometry import Array
from salver.learning import SensorBounds, identify
from salver.learning.load.systematic import Felt, wrist_errors
from salver.models.physical import random_inertia
from salver.models.uncertain.parameters import INERTIAL, inertial_vector
from salver.planning.plan import Plan
from sensed_arm import Sensors
from wrong_sensors import Defects, WrongArm

WIDE = {"mass": "50%", "com": [0.015, 0.015, 0.015], "contents": "any"}
FAST = Sensors(rate=1000.0)


@pytest.fixture(scope="module")
def plan(bottle_plan: Plan) -> Plan:
    return replace(bottle_plan, scenario=bottle_plan.scenario.with_changes(objects__0__uncertainty=WIDE))


def drawn(plan: Plan, seed: int) -> Array:
    """(10,) a load within the ranges."""
    body, rng = plan.scenario.payload.first, np.random.default_rng([31, seed])
    values = inertial_vector(body.inertial)
    values[0] *= 1 + 0.4 * rng.uniform(-1, 1)
    values[1:4] = 0.008 * rng.uniform(-1, 1, 3)
    values[4:] = values[0] * random_inertia(body, values[1:4], rng)
    return values


def misses(plan: Plan, defects: Defects, bounds: SensorBounds, seed: int, wrist: bool) -> list[str]:
    """Parameters whose range does not hold the truth."""
    values = drawn(plan, seed)
    arm = WrongArm(plan, seed, FAST, wrist=wrist, joints=not wrist, defects=replace(defects, seed=seed))
    found = identify(plan, [arm.log(values)], arm.log(None), bounds).ranges
    return [name for name, x in zip(INERTIAL, values, strict=True) if not found[name].low <= x <= found[name].high]


WITHIN = [
    (True, Defects(force_bias=0.3, moment_bias=0.015), SensorBounds(force_bias=0.3, moment_bias=0.015)),
    (True, Defects(scale=0.05), SensorBounds(scale=0.05)),
    (True, Defects(cross_talk=0.04), SensorBounds(cross_talk=0.04)),
    (True, Defects(cable=0.3), SensorBounds(cable=0.3)),
    (True, Defects(position=0.005), SensorBounds(position=0.005)),
    (True, Defects(tilt=0.05), SensorBounds(tilt=0.05)),
    (True, Defects(delay=0.02), SensorBounds(delay=0.02)),
    (False, Defects(torque_bias=0.3), SensorBounds(torque_bias=0.4)),
    (False, Defects(scale=0.05), SensorBounds(torque_scale=0.05)),
    (False, Defects(links=0.02), SensorBounds(links=0.02)),
    (False, Defects(bandwidth=5.0), SensorBounds(delay=0.035, filter_time=0.035)),
]


@pytest.mark.parametrize(
    ("wrist", "defects", "bounds"),
    [*WITHIN[::3], *(pytest.param(*x, marks=pytest.mark.slow) for x in (*WITHIN[1::3], *WITHIN[2::3]))],
)
def test_within_its_bound_no_defect_moves_the_truth_out_of_the_ranges(
    plan: Plan, wrist: bool, defects: Defects, bounds: SensorBounds
) -> None:
    assert misses(plan, defects, bounds, 1, wrist) == []


def test_a_systematic_error_does_not_average_out_over_logs(plan: Plan) -> None:
    """Three logs of one sensor, which may be wrong by 5 % and 4 mm: no range is narrower than that."""
    bounds, values = SensorBounds(scale=0.05, position=0.004), drawn(plan, 2)
    arm = WrongArm(plan, 2, FAST, joints=False, defects=Defects(scale=0.05, position=0.004))
    found = identify(plan, [arm.log(values, f"log {k}") for k in range(3)], arm.log(None), bounds)
    assert found.ranges["mass"].half > 0.05 * values[0]
    assert min(found.ranges[name].half for name in ("com_x", "com_y")) > 0.004
    assert found.shares["scale"] > 0.9 * 0.05 * values[0]
    assert found.shares["noise"] < found.shares["scale"]


@pytest.mark.parametrize(
    ("wrist", "defects", "said"),
    [
        (True, Defects(force_bias=0.3), "force_bias of f_. looks"),
        (True, Defects(delay=0.02), "delay of wrist looks [12][.]. times as large as its bound of 0.01"),
        (True, Defects(cable=1.0), "cable of .* looks"),
        (False, Defects(torque_bias=0.5), "torque_bias of joint . looks"),
        (False, Defects(delay=0.03), "delay of joint torques looks"),
        (False, Defects(delay=0.1), "delay of joint torques looks (9[.]|10[.]|11[.])"),
        (False, Defects(bandwidth=1.6), "delay of joint torques looks"),  # a filter of 0.1 s is late too
    ],
)
def test_beyond_its_bound_a_defect_that_shows_is_named(plan: Plan, wrist: bool, defects: Defects, said: str) -> None:
    with pytest.raises(FileFormatError, match=said):
        misses(plan, defects, SensorBounds(), 3, wrist)


def test_each_effect_is_what_a_sensor_with_that_error_reads_more() -> None:
    """Of a wrench that changes: against matrices, a moved and turned sensor, and the same wrench later."""
    bounds, t = SensorBounds(), np.linspace(0.0, 1.0, 201)
    waves = np.array([np.sin((k + 1) * t) + k for k in range(6)])
    q = np.column_stack([t, t**2])
    errors = {e.name: e.effect for e in wrist_errors(bounds, Felt(t, q, waves.T, np.zeros((2, 201, 6))))}
    force, moment = waves[:3].T, waves[3:].T
    assert errors["scale of f_y"] == pytest.approx(bounds.scale * waves.T * np.eye(6)[1])
    talk = bounds.cross_talk * bounds.lever * np.outer(waves[2], np.eye(6)[3])
    assert errors["cross_talk of f_z in t_x"] == pytest.approx(talk)
    moved = moment - np.cross([0.0, 0.0, bounds.position], force)
    assert errors["position of z"] == pytest.approx(np.hstack([0 * force, moved - moment]))
    c, s = np.cos(1e-5), np.sin(1e-5)
    turn = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])  # of the sensor, about x
    turned = (np.hstack([force @ turn, moment @ turn]) - waves.T) / 1e-5
    assert errors["tilt of x"] == pytest.approx(bounds.tilt * turned, abs=1e-6)
    later = np.array([np.sin((k + 1) * (t - 1e-5)) + k for k in range(6)]).T
    assert errors["delay of wrist"][5:-5] == pytest.approx(
        bounds.delay * (later - waves.T)[5:-5] / 1e-5, abs=3e-3 * bounds.delay
    )
    assert np.abs(errors["cable of f_x, 1"]).max() == pytest.approx(bounds.cable)


@pytest.mark.parametrize("field", [f.name for f in fields(SensorBounds)])
def test_a_bound_that_is_none_is_refused(field: str) -> None:
    for value in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ScenarioError, match=f"{field} = .* must be a finite number above 0"):
            SensorBounds(**{field: value})


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("scale", "must be a name, an equals sign and a number"),
        ("scale=a", "must be a name, an equals sign and a number"),
        ("size=1", "is not a bound of"),
    ],
)
def test_the_command_says_which_bounds_there_are(tmp_path: Path, bottle_plan: Plan, given: str, said: str) -> None:
    bottle_plan.save(tmp_path / "run")
    log = tmp_path / "log.csv"
    asked = ["identify", str(log), "--directory", str(tmp_path / "run"), "--empty", str(log), "--bound", given]
    done = CliRunner().invoke(app, asked)
    assert done.exit_code == 2
    assert said in " ".join(done.output.split())
