"""Careful first, then fast: carry for what is known, identify, narrow the ranges, plan again.

Each trip's plan is safe for all loads within the ranges of its scenario, and those are made to cover the true one, so
the load is meant to stay on every trip. A plan that is slower than the one before is not taken: that one was safe for
wider ranges.

A first trip is short and gentle, and so hides the height of the centre of mass. So between it and the second the arm
makes an excitation trajectory, safe as any trip (`salver.learning.load.excite`); joint torques, too, locate the centre
of mass by it. And no carry shows more friction than its plan assumes. So the tray tilts, shortly and each time a little
steeper (`salver.learning.friction.tilts`), until the load moves by more than a mark on the tray hides, or could tip: by
two centimetres at most, whatever its friction is. Then it is put back.

Here the load is carried in the physics engine, which alone knows the true one, and judged there. What the arm's
sensors say (`salver.learning.load.sensors`) is made along what the engine's arm does with the load strapped to the
tray, and with the empty tray: what loose contacts of the engine do to an arm is no property of a load.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from salver.errors import SalverError, ScenarioError, UnreachableError
from salver.geometry import Array
from salver.learning.friction.friction import USUAL, Friction, friction
from salver.learning.friction.tilts import short_tilt
from salver.learning.load.excite import plan_excite
from salver.learning.load.identify import Identified, LoggedRun, identify_runs
from salver.learning.load.sensors import Defects, Done, SensedArm, Sensors
from salver.learning.load.systematic import SensorBounds
from salver.models.arm.arm import load_arm
from salver.models.uncertain.parameters import INERTIAL, inertial_vector
from salver.motion_files.samples import joint_samples
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
        rate: samples of the simulated sensors a second.
        effort: of each plan: a second of search is nothing beside a trip.
        excitation: s, of the excitation trajectory; doubled, ranges get narrower and a trip is lost.
        tilts: short tilts at most.
        worth: of friction; a tilt that promises less is not made.
        timestep: s, of the engine's steps at most: with longer ones a tall load rocks on its soft contacts.
    """

    rate: float = 1000.0
    effort: FastestOptions = EFFORTS["thorough"]
    excitation: float = 4.0
    tilts: int = 12
    worth: float = 0.003
    timestep: float = 2e-4


LEARNING = LearningOptions()


@dataclass(frozen=True)
class Tilt:
    """A short tilt. moved: m by which the load was seen to have. outcome: of the engine, where a load that moved
    "slides". found: what it shows of friction, or None for a load that was lost.
    """

    plan: Plan
    moved: float
    outcome: str
    found: Friction | None


@dataclass(frozen=True)
class Excitation:
    """An excitation trajectory, from where a trip begins and back. outcome: of the engine."""

    plan: Plan
    outcome: str


@dataclass(frozen=True)
class Trip:
    """plan: what was carried out; its scenario has the ranges it was planned for. outcome: of the engine, "holds" or
    what became of the load. kept: whether the plan is that of the trip before. learnt: from the logs so far; None if
    they contradict the ranges or the load was lost, as told says. known: with all ranges after it. excitation, tilts:
    made then, before the next; excitation is None where there was none to make.
    """

    number: int
    plan: Plan
    outcome: str
    kept: bool
    learnt: Identified | None
    known: Scenario
    excitation: Excitation | None = None
    tilts: tuple[Tilt, ...] = ()
    told: str = ""

    @property
    def lost(self) -> bool:
        """Whether the load was lost, on the trip or on what was made then."""
        then = self.excitation is not None and self.excitation.outcome != "holds"
        return self.outcome != "holds" or then or any(tilt.found is None for tilt in self.tilts)

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
    scenario: Scenario,
    count: int,
    seed: int = 0,
    sensor: Sensor = "wrist",
    first: Plan | None = None,
    *,
    tilts: bool = True,
    level: float = USUAL.levelled,
) -> Iterator[Trip]:
    """Trips with one hidden true load that is drawn with the seed; they end early when the load is lost.

    first: the plan to begin with, of this scenario; unless given it is made. tilts: whether friction is looked for
    after the first trip, with a robot whose base is level to so many deg.

    Raises ScenarioError for a scenario without an arm or with several objects, or for which no safe motion is found.
    """
    if scenario.arm is None or len(scenario.objects) > 1:
        raise ScenarioError(f"{scenario.name}: learning needs an arm, and one object on its tray.")
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
        told, learnt, excitation, made_tilts = "", None, None, list[Tilt]()
        try:
            learnt = hidden.identify(plan, f"trip {number}")
            if number == 1 and count > 1:
                excitation = hidden.excite()
                if tilts and (excitation is None or excitation.outcome == "holds"):
                    made_tilts += hidden.climb(level)
        except SalverError as error:
            told = str(error)
        if learnt is not None:
            learnt = hidden.learnt  # with what was told then
        trip = Trip(number, plan, outcome, not better, learnt, hidden.known, excitation, tuple(made_tilts), told)
        yield trip
        if trip.lost:
            return


@dataclass
class _Hidden:
    """A load that only the engine knows, and what is known of it. base: the scenario to begin with, in whose frame B
    all runs are understood; known: with the ranges of now."""

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
        """Outcome of the load on the tray."""
        physics = plan.scenario.physics
        step = min(physics.timestep, physics.command_period / np.ceil(physics.command_period / LEARNING.timestep))
        stiff = replace(plan, scenario=plan.scenario.with_changes(physics__timestep=float(step)))
        return simulate(stiff, parameters=self.named(plan), seed=self.seed)

    def identify(self, plan: Plan, name: str) -> Identified:
        """Narrow the ranges by logs of a plan, and all before. Raises SalverError when these contradict each other."""
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
        self.learnt, self.known = found, _with_friction(found.learnt_scenario(), self.known)
        return found

    def excite(self) -> Excitation | None:
        """Make an excitation trajectory; None when there is none."""
        try:
            plan = plan_excite(self.known, LEARNING.excitation)
        except UnreachableError:
            return None
        outcome = self.carried(plan).outcome
        if outcome == "holds":
            self.identify(plan, "excitation trajectory")
        return Excitation(plan, outcome)

    def climb(self, level: float) -> Iterator[Tilt]:
        """Tilt, each time as steep as what is known allows, until the load moves, or could tip."""
        for number in range(1, LEARNING.tilts + 1):
            plan = short_tilt(self.known, level=level)
            promised, before = friction(plan, level=level).low, self.known.payload
            if (promised or 0.0) < before.least_friction(before.first) + LEARNING.worth:
                return
            record = self.carried(plan)
            moved = float(record.slip.max())
            if record.outcome not in ("holds", "slides"):  # meant never to be
                yield Tilt(plan, moved, record.outcome, None)
                return
            assert plan.scenario.arm is not None
            names = load_arm(plan.scenario.arm, plan.scenario.tray).joint_names
            done = joint_samples(record.t, tuple(names), record.q, None, None, f"tilt {number}")
            found = friction(plan, done, moved=moved, level=level)
            self.known = _with_friction(self.known, found.learnt_scenario(self.known))
            yield Tilt(plan, moved, record.outcome, found)
            if moved > USUAL.unnoticed:
                return


def _with_friction(scenario: Scenario, other: Scenario) -> Scenario:
    """The scenario with the friction of another of the same load."""
    item = other.objects[0]
    half = None if item.uncertainty is None else item.uncertainty.friction
    return scenario.with_changes(objects__0__friction=item.friction, objects__0__uncertainty__friction=half)


def _empty(plan: Plan, named: dict[str, float]) -> tuple[Plan, dict[str, float]]:
    """The plan with nothing on the tray, but a millionth of the load, and a controller that knows it."""
    mass, robot = plan.scenario.payload.first.inertial.mass, plan.scenario.physics.robot
    knowing = robot.model_dump() | {"payload_error": -mass}
    nothing = {name: (1e-6 if name == "mass" or name.startswith("inertia") else 1.0) * x for name, x in named.items()}
    return replace(plan, scenario=plan.scenario.with_changes(physics__robot=knowing)), nothing


def _done(plan: Plan, named: dict[str, float], seed: int) -> Done:
    """Motion of the engine's arm, `LEARNING.rate` times a second."""
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
