"""Runs of a plan of several legs in the physics engine, leg by leg.

The true parameters are the same on all legs. An object that stays on the tray begins a leg at the position to which it
slid on the leg before; its rotation is reset. Each leg begins when the arm has come to rest under its new load
(`physics.settle_before`).
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
from salver.simulation.outcome import WORST_FIRST
from salver.simulation.physics import Experiment
from salver.simulation.record import SimulationRecord
from salver.simulation.run import Options
from salver.simulation.scene.loads import by_parameter, outside

_ORDER = (*WORST_FIRST, "limit", "holds")
OF_A_STOP = ("stop_at", "stop_takes", "finishes")  # keys of the summary of a run with a stop
ENDS_IT = ("lost", "lifts", "tips")  # outcomes after which no further leg can be run


@dataclass(frozen=True)
class RoundRecord:
    """Records of the legs that were run, in order; the legs after the loss of the load are missing.

    parameters: the values that were not nominal. summary: the worst outcome of all legs, the number of that leg (from
    1), the duration, the summary of each leg, and for a run with a stop the keys of `OF_A_STOP`.
    """

    legs: tuple[SimulationRecord, ...]
    parameters: Mapping[str, float]
    summary: Mapping[str, Any]

    @property
    def outcome(self) -> str:
        return str(self.summary["outcome"])

    def save(self, directory: str | Path, kind: str = "") -> Path:
        """Write DIRECTORY/simulation/leg1.npz and .json and so on; returns the path of the last.

        kind: added to the names of a run that is not at full speed; a run with a stop is leg1-stop.
        """
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
        """Run all legs once.

        stop_at: s, motion time from the start of the first leg, when a stop is requested, which ends the run.
        Raises ScenarioError for impossible parameters or an impossible stop.
        """
        true = by_parameter(self.plan.scenario, parameters or {})
        if stop_at is not None and stop_at > self.plan.duration:
            raise ScenarioError(
                f"The stop is requested at {stop_at:g} s; it must be after 0 and not after {self.plan.duration:.4g} s, "
                "the end of the last leg."
            )
        last, now = (None, 0.0) if stop_at is None else self._of_leg(stop_at)
        moved: dict[Parameter, float] = {}  # displacement, m, of the objects that stay on the tray
        records: list[SimulationRecord] = []
        for k, experiment in enumerate(self._experiments):
            scenario = experiment.plan.scenario
            names = {p: p.name for p in all_parameters([item.name for item in scenario.objects])}
            moved = {p: by for p, by in moved.items() if p in names}  # others are put on at their nominal place
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
        """Index of the leg at motion time `stop_at`, s, and the time on that leg, s."""
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

    parameters: true values by name, such as {"glass1.mass": 0.3}; the others are nominal. stop_at, errors: as in
    `RoundExperiment.run`.
    """
    record = RoundExperiment(plan).run(parameters, seed, stop_at)
    beyond = outside(plan.scenario.uncertain, parameters or {})
    return replace(record, legs=tuple(leg.what_if(beyond) for leg in record.legs))
