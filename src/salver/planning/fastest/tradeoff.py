"""Duration against robustness: the fastest plan for ever larger uncertainty."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from salver.contact_margins import margins
from salver.errors import ScenarioError, Status
from salver.planning.fastest import FastestMotion, FastestOptions, fastest
from salver.planning.fastest.problem import transport_problem
from salver.scenario import Scenario

SCALES = (0.0, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0)
FRICTION_SHARE = 0.1  # half-range of friction when a scenario names nothing uncertain


@dataclass(frozen=True)
class TradeoffPoint:
    """scale: of all half-ranges; 0 is nominal, 1 the scenario's own set. duration: of the fastest motion that is safe
    for that set, s. friction_needed: least nominal friction coefficient with which the motion holds, all else
    nominal, by object or interface the largest. margin: least exact margin at nominal parameters, share of the weight.
    """

    scale: float
    duration: float
    friction_needed: float
    margin: float
    status: Status

    def record(self) -> dict[str, Any]:
        return asdict(self)


def scaled(scenario: Scenario, factor: float) -> Scenario:
    """The scenario with all half-ranges multiplied. Raises ScenarioError when no such objects can exist.

    Contents that may be any stay so, unless the factor is 0.
    """
    changes: dict[str, Any] = {}
    for i, item in enumerate(scenario.objects):
        ranges = item.uncertainty.model_dump(mode="json", exclude_none=True, exclude_defaults=True)
        contents = {"contents": ranges.pop("contents")} if "contents" in ranges else {}
        scaled_ranges = {key: _times(value, factor) for key, value in ranges.items()}
        changes[f"objects__{i}__uncertainty"] = scaled_ranges | (contents if factor else {})
    tilt = scenario.uncertainty.tilt_deg
    if tilt is not None:
        changes["uncertainty__tilt_deg"] = _times(list(tilt), factor)
    if factor == 0.0:
        changes["uncertainty__correlation"] = {}
    return scenario.with_changes(**changes)


def _times(value: Any, factor: float) -> Any:
    if isinstance(value, dict):
        return {key: _times(entry, factor) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_times(entry, factor) for entry in value]
    return factor * value


def with_something_uncertain(scenario: Scenario) -> Scenario:
    """The scenario itself, or with friction uncertain by `FRICTION_SHARE` when it names nothing uncertain."""
    if (
        any(item.uncertainty.model_dump(exclude_none=True, exclude_defaults=True) for item in scenario.objects)
        or scenario.uncertainty.tilt_deg
    ):
        return scenario
    changes = {
        f"objects__{i}__uncertainty": {"friction": FRICTION_SHARE * item.friction}
        for i, item in enumerate(scenario.objects)
    }
    return scenario.with_changes(**changes)


def tradeoff(
    scenario: Scenario, scales: Sequence[float] = SCALES, options: FastestOptions | None = None
) -> Iterator[TradeoffPoint]:
    """Points of the curve, smallest scale first, each from the one before. Ends early where no motion is safe, or no
    such object can exist.

    Raises ScenarioError when the scenario has no arm.
    """
    scenario = with_something_uncertain(scenario)
    before: FastestMotion | None = None
    for scale in sorted(scales):
        try:
            larger = scaled(scenario, scale)
        except ScenarioError as error:
            yield TradeoffPoint(scale, np.nan, np.nan, np.nan, Status("impossible", str(error), False))
            return
        problem = transport_problem(larger)
        found = fastest(problem, options, None if before is None or not before.status.ok else before)
        if not found.status.ok:
            yield TradeoffPoint(scale, np.nan, np.nan, np.nan, found.status)
            return
        seen = margins(scaled(scenario, 0.0), found.reference().samples)
        needed = max(float(np.max(m.friction_needed)) for m in seen.interfaces)
        yield TradeoffPoint(scale, found.duration, needed, float(seen.exact.min()), found.status)
        before = found
