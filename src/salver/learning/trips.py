"""Careful first, then fast: carry for what is known, identify, narrow the ranges, plan again.

Each trip's plan is safe for all loads within the ranges of its scenario, and those are made to cover the true one, so
the load is meant to stay on every trip. A plan that is slower than the one before is not taken: that one was safe for
wider ranges.

Here the load is carried in the physics engine, which alone knows the true one, and judged there. What the arm's
sensors say (`salver.learning.sensors`) is made along what the engine's arm does with the load strapped to the tray, and
with the empty tray: what loose contacts of the engine do to an arm is no property of a load.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from salver.errors import SalverError, ScenarioError
from salver.geometry import Array
from salver.learning.identify import Identified, identify
from salver.learning.sensors import Done, SensedArm
from salver.models.parameters import INERTIAL, inertial_vector
from salver.planning.fastest import plan_fastest
from salver.planning.plan import Plan
from salver.sampling import draw
from salver.scenario import Scenario
from salver.simulation.physics import Experiment, simulate

SENSORS = ("wrist", "torques")
RATE = 1000.0  # samples of the sensors a second
Sensor = Literal["wrist", "torques"]


@dataclass(frozen=True)
class Trip:
    """plan: what was carried out; its scenario has the ranges it was planned for. outcome: of the engine, "holds" or
    what became of the load. kept: whether the plan is that of the trip before. learnt: from the trip's logs; None if
    they contradict the ranges or the load was lost, as told says.
    """

    number: int
    plan: Plan
    outcome: str
    kept: bool
    learnt: Identified | None
    told: str = ""

    @property
    def margin(self) -> float:
        """Least margin in the worst case of the ranges, of the weight."""
        return float(self.plan.margins.exact_worst.min())


def true_load(scenario: Scenario, seed: int) -> Array:
    """(11,) a load drawn from the scenario's set: values of `INERTIAL` in the shape's frame G, then friction."""
    payload, body = scenario.payload, scenario.payload.first
    values = np.append(inertial_vector(body.inertial), body.friction)
    drawn = draw(payload.uncertain, 1, seed, bodies=payload.bodies)[0]
    for p, value in zip(payload.uncertain.parameters, drawn, strict=True):
        if p.entry is not None:
            values[p.entry] = value
        elif p.kind == "friction":
            values[10] = value
    if not any(p.kind == "inertia" for p in payload.uncertain.parameters):
        values[4:10] *= values[0] / body.inertial.mass
    values[1:4] += body.com_G
    return values


def trips(
    scenario: Scenario, count: int, seed: int = 0, sensor: Sensor = "wrist", first: Plan | None = None
) -> Iterator[Trip]:
    """So many trips with one hidden true load, drawn with the seed; ends early when the load is lost. first: the plan
    to begin with, of this scenario; unless given it is made.

    Raises ScenarioError for a scenario without an arm or with several objects, or for which no safe motion is found.
    """
    if scenario.arm is None or len(scenario.objects) > 1:
        raise ScenarioError(f"{scenario.name}: learning needs an arm, and one object on its tray.")
    true, known, plan = true_load(scenario, seed), scenario, None
    for number in range(1, count + 1):
        made = first if first is not None and number == 1 else plan_fastest(known)
        better = made.ok and (plan is None or made.duration < plan.duration)
        if plan is None and not made.ok:
            raise ScenarioError(f"{scenario.name}: no safe motion for its ranges to begin with. {made.status.sentence}")
        plan = made if better or plan is None else plan
        named = dict(zip(INERTIAL, _in_frame(plan.scenario, true), strict=True)) | {"friction": float(true[10])}
        outcome = simulate(plan, parameters=named, seed=seed).outcome
        if outcome != "holds":
            yield Trip(
                number, plan, outcome, not better, None, "The load did not stay: nothing is learnt from this trip."
            )
            return
        seen = replace(plan, scenario=known)  # the same motion, in the frame and with the ranges that are the latest
        arm = SensedArm(seen, 1000 * seed + number, wrist=sensor == "wrist", joints=sensor == "torques")
        load = np.array(_in_frame(known, true))
        try:
            logs = (
                arm.log(load, f"trip {number}", _done(plan, named, seed)),
                arm.log(None, f"trip {number}, empty", _done(*_empty(plan, named), seed)),
            )
            learnt = identify(seen, [logs[0]], logs[1])
        except SalverError as error:
            yield Trip(number, plan, outcome, not better, None, str(error))
            continue
        known = learnt.learnt_scenario()
        yield Trip(number, plan, outcome, not better, learnt)


def _empty(plan: Plan, named: dict[str, float]) -> tuple[Plan, dict[str, float]]:
    """The plan with nothing on the tray, but a millionth of the load, and a controller that knows it."""
    mass, robot = plan.scenario.payload.first.inertial.mass, plan.scenario.physics.robot
    knowing = robot.model_dump() | {"payload_error": -mass}
    nothing = {name: (1e-6 if name == "mass" or name.startswith("inertia") else 1.0) * x for name, x in named.items()}
    return replace(plan, scenario=plan.scenario.with_changes(physics__robot=knowing)), nothing


def _done(plan: Plan, named: dict[str, float], seed: int) -> Done:
    """What the engine's arm does, `RATE` times a second."""
    trace = Experiment(plan).strapped(named, seed)
    ddq = np.gradient(trace.dq, trace.t, axis=0)
    every = max(1, round(1 / (RATE * (trace.t[1] - trace.t[0]))))
    kept = slice(int(np.argmax(trace.t > -1e-9)), None, every)
    return trace.t[kept], trace.q[kept], trace.dq[kept], ddq[kept]


def _in_frame(scenario: Scenario, true: Array) -> list[float]:
    """Values of `INERTIAL` of a true load in the frame B of a scenario."""
    values = true[:10].copy()
    values[1:4] -= scenario.payload.first.com_G
    return [float(x) for x in values]
