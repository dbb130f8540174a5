"""A plan of several legs in the physics engine, leg by leg, what remains on the tray where the leg before has left it.

The true parameters are the same on all legs. What was carried on, and has slid, begins the next leg where it stood at
the end of the last, along the tray; how far it has turned or rocked is not carried over. Each leg begins when the arm
has come to rest under its new load (`physics.settle_before`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from salver.errors import ScenarioError
from salver.models.parameters import Parameter, all_parameters
from salver.planning.round import Round
from salver.scenario import Scenario
from salver.simulation.outcome import WORST_FIRST
from salver.simulation.physics import Experiment
from salver.simulation.record import SimulationRecord
from salver.simulation.run import Options

_ORDER = (*WORST_FIRST, "limit", "holds")
ENDS_IT = ("lost", "lifts", "tips")  # what remains on the tray is then not where a next leg could begin


@dataclass(frozen=True)
class RoundRecord:
    """Records of the legs that were run, in order: fewer than there are when the load was lost on one.

    parameters: the values that were not nominal. summary: outcome (the worst of all legs), leg (which one that was, 1
    for the first), duration, and the summary of each.
    """

    legs: tuple[SimulationRecord, ...]
    parameters: Mapping[str, float]
    summary: Mapping[str, Any]

    @property
    def outcome(self) -> str:
        return str(self.summary["outcome"])

    def save(self, directory: str | Path) -> Path:
        """Write DIRECTORY/simulation/leg1.npz and .json and so on; returns the path of the last."""
        return [leg.save(directory, f"leg{k}") for k, leg in enumerate(self.legs, 1)][-1]


@dataclass(frozen=True, eq=False)
class RoundExperiment:
    """A plan of several legs, to be run any number of times (`salver.simulation.physics.Experiment`)."""

    plan: Round
    options: Options = field(default_factory=Options)

    @cached_property
    def _experiments(self) -> list[Experiment]:
        return [Experiment(leg, self.options) for leg in self.plan.legs]

    def run(self, parameters: Mapping[str, float] | None = None, seed: int = 0) -> RoundRecord:
        """One run of all legs. Raises ScenarioError for parameters that cannot be."""
        true = _known(self.plan.scenario, parameters or {})
        moved: dict[Parameter, float] = {}  # by which what remains stands elsewhere
        records: list[SimulationRecord] = []
        for k, experiment in enumerate(self._experiments):
            scenario = experiment.plan.scenario
            names = {p: p.name for p in all_parameters([item.name for item in scenario.objects])}
            moved = {p: by for p, by in moved.items() if p in names}  # what is put on later stands where it should
            values = {p: true.get(p, 0.0) + moved.get(p, 0.0) for p in (*true, *moved)}
            record = experiment.run({names[p]: value for p, value in values.items() if p in names}, seed + k)
            records.append(record)
            if record.outcome in ENDS_IT:
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
        return RoundRecord(tuple(records), dict(parameters or {}), summary)


def simulate_round(plan: Round, *, parameters: Mapping[str, float] | None = None, seed: int = 0) -> RoundRecord:
    """Run a plan of several legs in the physics engine, leg by leg; see `salver.simulation.physics.simulate`.

    parameters: true values by name, where not nominal, of any object: "glass1.mass". Raises as that does.
    """
    return RoundExperiment(plan).run(parameters, seed)


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
