"""A plan of several legs in the physics engine, leg by leg, what remains on the tray where the leg before has left it.

The true parameters are the same on all legs. What was carried on, and has slid, begins the next leg where it stood at
the end of the last, along the tray; how far it has turned or rocked is not carried over. Each leg begins when the arm
has come to rest under its new load (`physics.settle_before`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from salver.errors import ScenarioError
from salver.models.uncertain.parameters import Parameter, all_parameters
from salver.planning.round import MultiLegPlan
from salver.scenario import Scenario
from salver.simulation.outcome import WORST_FIRST
from salver.simulation.physics import Experiment
from salver.simulation.record import SimulationRecord
from salver.simulation.run import Options
from salver.simulation.scene.loads import outside

_ORDER = (*WORST_FIRST, "limit", "holds")
OF_A_STOP = ("stop_at", "stop_takes", "finishes")  # of a summary
ENDS_IT = ("lost", "lifts", "tips")  # what remains on the tray is then not where a next leg could begin


@dataclass(frozen=True)
class RoundRecord:
    """Records of the legs that were run, in order: fewer than there are when the load was lost on one.

    parameters: the values that were not nominal. summary: outcome (the worst of all legs), leg (which one that was, 1
    for the first), duration, and the summary of each; of a run that was stopped also what that of the last leg says of
    the stop.
    """

    legs: tuple[SimulationRecord, ...]
    parameters: Mapping[str, float]
    summary: Mapping[str, Any]

    @property
    def outcome(self) -> str:
        return str(self.summary["outcome"])

    def save(self, directory: str | Path, kind: str = "") -> Path:
        """Write DIRECTORY/simulation/leg1.npz and .json and so on, of a stopped run leg1-stop; returns the path of the
        last. kind: added to the names of what is no run of the plan at full speed."""
        kind = "-stop" if "stop_at" in self.summary else kind
        return [leg.save(directory, f"leg{k}", kind) for k, leg in enumerate(self.legs, 1)][-1]


@dataclass(frozen=True, eq=False)
class RoundExperiment:
    """A plan of several legs, to be run any number of times (`salver.simulation.physics.Experiment`)."""

    plan: MultiLegPlan
    options: Options = field(default_factory=Options)

    @cached_property
    def _experiments(self) -> list[Experiment]:
        return [Experiment(leg, self.options) for leg in self.plan.legs]

    def run(
        self, parameters: Mapping[str, float] | None = None, seed: int = 0, stop_at: float | None = None
    ) -> RoundRecord:
        """One run of all legs. stop_at: s of all motions together, one after the other, at which a stop is asked for;
        it ends the run. Raises ScenarioError for parameters that cannot be, and for a stop that cannot."""
        true = _known(self.plan.scenario, parameters or {})
        if stop_at is not None and stop_at > self.plan.duration:
            raise ScenarioError(
                f"The stop is asked for at {stop_at:g} s; it must be after 0 and not after {self.plan.duration:.4g} s, "
                "the end of all legs."
            )
        last, now = (None, 0.0) if stop_at is None else self._of_leg(stop_at)
        moved: dict[Parameter, float] = {}  # by which what remains stands elsewhere
        records: list[SimulationRecord] = []
        for k, experiment in enumerate(self._experiments):
            scenario = experiment.plan.scenario
            names = {p: p.name for p in all_parameters([item.name for item in scenario.objects])}
            moved = {p: by for p, by in moved.items() if p in names}  # what is put on later stands where it should
            values = {p: true.get(p, 0.0) + moved.get(p, 0.0) for p in (*true, *moved)}
            if k == last:
                experiment = replace(experiment, stop_at=now)
            record = experiment.run({names[p]: value for p, value in values.items() if p in names}, seed + k)
            records.append(record)
            if record.outcome in ENDS_IT or k == last:
                break
            slid = record.slip_E[-1] - record.creep_E[-1]
            for name, shift in zip(record.object_names, slid, strict=True):
                for axis, by in zip("xy", shift, strict=False):
                    p = Parameter(name, "position", axis)
                    moved[p] = moved.get(p, 0.0) + float(by)
        worst = min(range(len(records)), key=lambda k: _ORDER.index(records[k].outcome))
        summary = {
            "outcome": records[worst].outcome,
            "leg": worst + 1,
            "duration": self.plan.duration,
            "legs": [record.summary for record in records],
        }
        summary |= {name: records[-1].summary[name] for name in OF_A_STOP if name in records[-1].summary}
        if "stop_at" in summary:
            summary["stop_at"] = stop_at
        return RoundRecord(tuple(records), dict(parameters or {}), summary)

    def _of_leg(self, stop_at: float) -> tuple[int, float]:
        """Leg, counted from 0, of an instant of all motions together, and s of that leg's own time."""
        *before, _ = self.plan.legs
        for k, leg in enumerate(before):
            if stop_at <= leg.duration:
                return k, stop_at
            stop_at -= leg.duration
        return len(before), stop_at


def simulate_round(
    plan: MultiLegPlan, *, parameters: Mapping[str, float] | None = None, seed: int = 0, stop_at: float | None = None
) -> RoundRecord:
    """Run a plan of several legs in the physics engine, leg by leg; see `salver.simulation.physics.simulate`.

    parameters: true values by name, where not nominal, of any object: "glass1.mass". stop_at: see
    `RoundExperiment.run`. Raises as that does.
    """
    record = RoundExperiment(plan).run(parameters, seed, stop_at)
    beyond = outside(plan.scenario.uncertain, parameters or {})
    return replace(record, legs=tuple(leg.what_if(beyond) for leg in record.legs))


def _known(scenario: Scenario, parameters: Mapping[str, float]) -> dict[Parameter, float]:
    """Values by parameter. Raises ScenarioError for an unknown name."""
    known = {p.name: p for p in all_parameters([item.name for item in scenario.objects])}
    for name in parameters:
        if name not in known:
            raise ScenarioError(
                f'There is no parameter "{name}" in {scenario.name}; those of an object have its name in front, as in '
                f"{scenario.objects[0].name}.mass."
            )
    return {known[name]: float(value) for name, value in parameters.items()}
