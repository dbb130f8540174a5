"""Learning a load over several trips: carry it safely, identify it, narrow the ranges, plan again.

Each trip's plan is safe for all loads within the ranges of its scenario, and the ranges contain the true load, so that
the load should stay on every trip. If a plan is slower than the one before, that one is used again, because it was safe
for wider ranges.

A first trip is gentle and does not show the height of the centre of mass. Therefore an excitation trajectory, as safe
as any trip, follows (`salver.learning.load.excite`), by which joint torques locate the centre of mass too. Trips do not
show friction, because no plan needs more than its scenario assumes.

The true load is known to the physics engine only, in which it is carried and judged. The readings of the arm's sensors
(`salver.learning.load.sensors`) are simulated along the motion of the engine's arm with the load fixed to the tray, and
with the empty tray, to exclude effects of the engine's loose contacts on the arm.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from salver.errors import SalverError, ScenarioError, UnreachableError
from salver.geometry import Array
from salver.learning.load.excite import plan_excite
from salver.learning.load.identify import Identified, LoggedRun, identify_runs
from salver.learning.load.sensors import Defects, Done, SensedArm, Sensors
from salver.learning.load.systematic import SensorBounds
from salver.learning.logs import one_load
from salver.models.uncertain.parameters import INERTIAL, inertial_vector
from salver.planning.fastest import EFFORTS, FastestOptions, plan_fastest
from salver.planning.plan import Plan
from salver.sampling import draw
from salver.scenario import Scenario
from salver.simulation.physics import Experiment, simulate
from salver.simulation.record import SimulationRecord

Sensor = Literal["wrist", "torques"]


@dataclass(frozen=True)
class LearningOptions:
    """Options of learning a load while it is carried.

    Attributes:
        rate: samples per second of the simulated sensors.
        effort: effort of the search for each plan.
        excitation: duration of the excitation trajectory, s; with twice the value ranges are narrower and a trip takes
            longer.
        timestep: s, largest step of the engine; with longer ones a tall load rocks on its soft contacts.
    """

    rate: float = 1000.0
    effort: FastestOptions = EFFORTS["thorough"]
    excitation: float = 4.0
    timestep: float = 2e-4


LEARNING = LearningOptions()


@dataclass(frozen=True)
class Excitation:
    """An excitation trajectory from the start of a trip and back. outcome: of the engine."""

    plan: Plan
    outcome: str


@dataclass(frozen=True)
class Trip:
    """One trip with the load.

    plan: its scenario has the ranges that it was planned for. outcome: of the engine. kept: whether the plan is that of
    the trip before. learnt: the load identified from all logs so far; None if they contradict the ranges or the load
    was lost; `told` says which. known: the scenario with all ranges after the trip. excitation: made after the
    trip, before the next.
    """

    number: int
    plan: Plan
    outcome: str
    kept: bool
    learnt: Identified | None
    known: Scenario
    excitation: Excitation | None = None
    told: str = ""

    @property
    def lost(self) -> bool:
        """Whether the load was lost on the trip or the excitation trajectory."""
        return self.outcome != "holds" or (self.excitation is not None and self.excitation.outcome != "holds")

    @property
    def margin(self) -> float:
        """Least margin in the worst case of the ranges, as a share of the weight."""
        return float(self.plan.margins.exact_worst.min())


def true_load(scenario: Scenario, seed: int) -> Array:
    """A random load (11,) from the scenario's set: values of `INERTIAL` in the shape's frame G, then friction."""
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
    scenario: Scenario,
    count: int,
    seed: int = 0,
    sensor: Sensor = "wrist",
    first: Plan | None = None,
) -> Iterator[Trip]:
    """Trips with one hidden true load, which the seed determines; they end early when the load is lost.

    Args:
        count: number of trips.
        first: plan of the first trip, of this scenario; default: it is planned.

    Raises:
        ScenarioError: no arm, several objects, or no safe motion.
    """
    one_load(scenario, "learning")
    hidden, plan = _Hidden(scenario, true_load(scenario, seed), seed, sensor), None
    for number in range(1, count + 1):
        made = first if first is not None and number == 1 else plan_fastest(hidden.known, options=LEARNING.effort)
        better = made.ok and (plan is None or made.duration < plan.duration)
        if plan is None and not made.ok:
            raise ScenarioError(f"{scenario.name}: no safe motion for its ranges to begin with. {made.status.sentence}")
        plan = made if better or plan is None else plan
        outcome = hidden.carried(plan).outcome
        if outcome != "holds":
            told = "The load did not stay: nothing is learnt from this trip."
            yield Trip(number, plan, outcome, not better, None, hidden.known, told=told)
            return
        told, learnt, excitation = "", None, None
        try:
            learnt = hidden.identify(plan, f"trip {number}")
            if number == 1 and count > 1:
                excitation = hidden.excite()
        except SalverError as error:
            told = str(error)
        if learnt is not None:
            learnt = hidden.learnt  # with its messages
        trip = Trip(number, plan, outcome, not better, learnt, hidden.known, excitation, told)
        yield trip
        if trip.lost:
            return


@dataclass
class _Hidden:
    """A hidden load, with the present knowledge about it. base: the first scenario, in whose frame B all runs are
    expressed."""

    base: Scenario
    true: Array
    seed: int
    sensor: Sensor
    runs: list[LoggedRun] = field(default_factory=list)
    learnt: Identified | None = None

    def __post_init__(self) -> None:
        self.known = self.base

    def named(self, plan: Plan) -> dict[str, float]:
        values = dict(zip(INERTIAL, _in_frame(plan.scenario, self.true), strict=True))
        return values | {"friction": float(self.true[10])}

    def carried(self, plan: Plan) -> SimulationRecord:
        """Record of a run of a plan with the true load."""
        physics = plan.scenario.physics
        step = min(physics.timestep, physics.command_period / np.ceil(physics.command_period / LEARNING.timestep))
        stiff = replace(plan, scenario=plan.scenario.with_changes(physics__timestep=float(step)))
        return simulate(stiff, parameters=self.named(plan), seed=self.seed)

    def identify(self, plan: Plan, name: str) -> Identified:
        """Narrow the ranges by logs of a plan and all earlier logs. Raises SalverError when these contradict them."""
        arm = SensedArm(
            replace(plan, scenario=self.base),
            1000 * self.seed + len(self.runs) + 1,
            Sensors(rate=LEARNING.rate),
            wrist=self.sensor == "wrist",
            joints=self.sensor == "torques",
            defects=Defects.usual(SensorBounds(), self.seed),
        )
        load, named = np.array(_in_frame(self.base, self.true)), self.named(plan)
        run = LoggedRun(
            plan,
            arm.log(load, name, _done(plan, named, self.seed)),
            arm.log(None, f"{name}, empty", _done(*_empty(plan, named), self.seed)),
        )
        found = identify_runs(self.base, [*self.runs, run], self.known)
        self.runs.append(run)
        self.learnt, self.known = found, found.learnt_scenario()
        return found

    def excite(self) -> Excitation | None:
        """Plan and run an excitation trajectory; None if none is found."""
        try:
            plan = plan_excite(self.known, LEARNING.excitation)
        except UnreachableError:
            return None
        outcome = self.carried(plan).outcome
        if outcome == "holds":
            self.identify(plan, "excitation trajectory")
        return Excitation(plan, outcome)


def _empty(plan: Plan, named: dict[str, float]) -> tuple[Plan, dict[str, float]]:
    """The plan with a nearly empty tray (a millionth of the load), which the controller knows."""
    mass, robot = plan.scenario.payload.first.inertial.mass, plan.scenario.physics.robot
    knowing = robot.model_dump() | {"payload_error": -mass}
    nothing = {name: (1e-6 if name == "mass" or name.startswith("inertia") else 1.0) * x for name, x in named.items()}
    return replace(plan, scenario=plan.scenario.with_changes(physics__robot=knowing)), nothing


def _done(plan: Plan, named: dict[str, float], seed: int) -> Done:
    """Executed motion of the engine's arm, sampled at `LEARNING.rate`."""
    trace = Experiment(plan).strapped(named, seed)
    ddq = np.gradient(trace.dq, trace.t, axis=0)
    every = max(1, round(1 / (LEARNING.rate * (trace.t[1] - trace.t[0]))))
    kept = slice(None, None, every)
    return trace.t[kept], trace.q[kept], trace.dq[kept], ddq[kept]


def _in_frame(scenario: Scenario, true: Array) -> list[float]:
    """Values of `INERTIAL` of a true load in the frame B of a scenario."""
    values = true[:10].copy()
    values[1:4] -= scenario.payload.first.com_G
    return [float(x) for x in values]
