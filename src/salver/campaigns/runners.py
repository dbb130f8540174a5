"""Single runs of a campaign, from plan and true parameters to a flat record of scalars."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from salver.campaigns.definition import Definition, samples, seed_of_run
from salver.errors import SalverError
from salver.geometry import Array

if TYPE_CHECKING:
    from salver.planning.plan import Plan
    from salver.planning.round import MultiLegPlan
    from salver.simulation.physics import Experiment
    from salver.simulation.round import RoundExperiment, RoundRecord

Scalars = dict[str, float | str | bool | None]

# Entries of a summary that depend on the machine or the plan; the table leaves them out.
NOT_OF_THE_RUN = ("wall_time", "provenance", "thresholds", "method", "with_arm", "duration", "tube")


@dataclass(frozen=True)
class Context:
    """The input of a worker, which reads plans and samples from the run directory once."""

    directory: Path
    definition: Definition

    @cached_property
    def _samples(self) -> tuple[tuple[str, ...], Array]:
        return samples(self.directory, self.definition)

    @cached_property
    def _plans(self) -> dict[str, Plan | MultiLegPlan]:
        from salver.planning.round import load

        return {stem: load(self.directory, stem) for stem in self.definition.plans}

    @cached_property
    def _experiments(self) -> dict[str, Experiment | RoundExperiment]:
        from salver.planning.plan import Plan
        from salver.simulation.physics import Experiment
        from salver.simulation.round import RoundExperiment

        return {
            s: Experiment(plan) if isinstance(plan, Plan) else RoundExperiment(plan) for s, plan in self._plans.items()
        }

    def parameters(self, run: int) -> dict[str, float]:
        names, values = self._samples
        return dict(zip(names, map(float, values[run]), strict=True))

    def execute(self, stem: str, run: int) -> dict[str, Any]:
        """Record of a run of a plan; one that fails has the outcome "error" and a sentence."""
        begin, parameters = time.perf_counter(), self.parameters(run)
        seed, stop_at = self.definition.seed, self.definition.stop_at(run, self._plans[stem].duration)
        result = _physics(self._experiments[stem], parameters, seed_of_run(seed, run), stop_at)
        return {
            "stem": stem,
            "run": run,
            "seconds": round(time.perf_counter() - begin, 4),
            "parameters": parameters,
            "outcome": result.pop("outcome"),
            "scalars": result,
        }


def _physics(
    experiment: Experiment | RoundExperiment, parameters: dict[str, float], seed: int, stop_at: float | None
) -> Scalars:
    """Scalars of a run in the physics engine. stop_at: s, time of the stop request, or None."""
    from salver.simulation.closed_loop import tube_scalars
    from salver.simulation.round import RoundExperiment

    try:
        if isinstance(experiment, RoundExperiment):
            return round_scalars(experiment.run(parameters, seed, stop_at))
        one = experiment if stop_at is None else replace(experiment, stop_at=stop_at)
        record = one.run(parameters, seed)
    except SalverError as error:
        return {"outcome": "error", "sentence": str(error)}
    scalars = run_scalars(record.summary)
    return scalars | (tube_scalars(experiment.plan, record.t, record.cone_coefficients) if stop_at is None else {})


def run_scalars(summary: Mapping[str, Any]) -> Scalars:
    """The scalars of a run's summary. With several objects their entries have the prefix `object.`, and each peak_
    without a prefix is the largest over all objects."""
    scalars: Scalars = {}
    for key, value in summary.items():
        if isinstance(value, Mapping) and key not in NOT_OF_THE_RUN:
            scalars |= {f"{key}.{name}": x for name, x in value.items() if _is_scalar(x)}
        elif key not in NOT_OF_THE_RUN and _is_scalar(value):
            scalars[key] = value
    objects = summary.get("objects", ())
    for item in objects:
        prefix = f"{item['name']}." if len(objects) > 1 else ""
        own = {key: value for key, value in item.items() if key != "name" and _is_scalar(value)}
        scalars |= {prefix + key: value for key, value in own.items() if prefix or key != "outcome"}
    if len(objects) > 1:
        for key in dict.fromkeys(key for item in objects for key in item if key.startswith("peak_")):
            scalars[key] = max(float(item[key]) for item in objects if key in item)  # liquids have more keys
    return scalars


def round_scalars(record: RoundRecord) -> Scalars:
    """The scalars of a run of several legs: the worst values of all legs, the leg with the outcome, the stop, and
    outcome and slip on each leg."""
    from salver.simulation.round import OF_A_STOP

    legs = [run_scalars(leg.summary) for leg in record.legs]
    scalars: Scalars = {"outcome": record.outcome, "leg": int(record.summary["leg"])}
    scalars |= {key: record.summary[key] for key in OF_A_STOP if key in record.summary}
    for key in dict.fromkeys(key for leg in legs for key in leg if "peak" in key and "." not in key):
        values = [leg[key] for leg in legs if isinstance(leg.get(key), float)]
        if values:
            scalars[key] = max(values)  # type: ignore[type-var]
    for k, leg in enumerate(legs, 1):
        scalars |= {f"leg{k}.{key}": leg[key] for key in ("outcome", "peak_slip")}
    return scalars


def _is_scalar(value: object) -> bool:
    return value is None or isinstance(value, float | int | str | bool)
