"""Duration against robustness: the fastest plan for growing uncertainty."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from salver.contact_margins import margins
from salver.errors import ScenarioError, Status, UnreachableError
from salver.planning.fastest.found import FastestMotion, FastestOptions
from salver.planning.fastest.planned import found_and_planned
from salver.planning.trajopt.problem import transport_problem
from salver.scenario import Scenario

SCALES = (0.0, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0)
FRICTION_SHARE = 0.1  # half-range of friction when a scenario names nothing uncertain


@dataclass(frozen=True)
class TradeoffPoint:
    """A point of the trade-off between duration and robustness.

    scale: factor of all half-ranges; 0 is nominal, 1 the scenario's own set. duration: of the fastest motion that is
    safe for that set, s. friction_needed: least friction coefficient with which the motion is safe at otherwise nominal
    parameters; the largest over all objects and interfaces. margin: least exact margin at nominal parameters, as a
    share of the weight. status: of the plan.
    """

    scale: float
    duration: float
    friction_needed: float
    margin: float
    status: Status

    def record(self) -> dict[str, Any]:
        return asdict(self)


def scaled(scenario: Scenario, factor: float) -> Scenario:
    """The scenario with all half-ranges multiplied by a factor. Raises ScenarioError when no such objects can exist.

    contents = "any" stays as it is, unless the factor is 0.
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
    shake = scenario.uncertainty.shake
    if shake is not None:
        changes["uncertainty__shake__amplitude"] = factor * shake.amplitude
        changes["uncertainty__shake__tilt_deg"] = factor * shake.tilt_deg
    if factor == 0.0:
        changes["uncertainty__correlation"] = {}
    return scenario.with_changes(**changes)


def _times(value: Any, factor: float) -> Any:
    if isinstance(value, dict):
        return {key: _times(entry, factor) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_times(entry, factor) for entry in value]
    return factor * value


@dataclass(frozen=True)
class TradeoffTask:
    """The task of a trade-off curve.

    scenario: without a duration, and with ranges. own: the scale of the given scenario's own set. tray: in words,
    whether the tray may tilt. assumed: in words, the ranges that were assumed; "" if the scenario gives some.
    left_open: duration of the given scenario, s, which is ignored; None without one.
    """

    scenario: Scenario
    own: float
    tray: str
    assumed: str
    left_open: float | None

    @classmethod
    def of(cls, scenario: Scenario) -> TradeoffTask:
        """The task of `salver plan --fastest` for a scenario, with ranges assumed if it has none."""
        left_open, asked = scenario.motion.duration, scenario.with_changes(motion__duration=None)
        tray = "may tilt" if asked.motion.may_turn else "stays level"
        named = (
            asked.uncertainty.tilt_deg
            or asked.uncertainty.shake
            or any(item.uncertainty.model_dump(exclude_none=True, exclude_defaults=True) for item in asked.objects)
        )
        if named:
            return cls(asked, 1.0, tray, "", left_open)
        changes = {
            f"objects__{i}__uncertainty": {"friction": FRICTION_SHARE * item.friction}
            for i, item in enumerate(asked.objects)
        }
        assumed = f"friction, by {100 * FRICTION_SHARE:g} %"
        return cls(asked.with_changes(**changes), 0.0, tray, assumed, left_open)

    @property
    def sentence(self) -> str:
        """The task in words, and how it differs from the scenario."""
        then = "so" if self.scenario.motion.orientation is None else "and"
        left = "" if self.left_open is None else f"The duration of {self.left_open:g} s is left open, {then} "
        found = f"{left}the tray {self.tray}, as with salver plan --fastest."
        if self.assumed:
            found += f" Nothing is uncertain in the scenario: {self.assumed}, is taken to be."
        return found[0].upper() + found[1:]


def tradeoff(
    scenario: Scenario, scales: Sequence[float] = SCALES, options: FastestOptions | None = None
) -> Iterator[TradeoffPoint]:
    """Points of the curve, smallest scale first; each search begins from the point before.

    At the scenario's own ranges the point is the result of `plan_fastest` with the duration left open. The curve ends
    early where no motion is safe or no such object can exist. Raises ScenarioError when the scenario has no arm.
    """
    asked = TradeoffTask.of(scenario)
    before: FastestMotion | None = None
    for scale in sorted(scales):
        try:
            larger = scaled(asked.scenario, scale)
        except ScenarioError as error:
            yield TradeoffPoint(scale, np.nan, np.nan, np.nan, Status("impossible", str(error), False))
            return
        problem, near = transport_problem(larger), None if scale == asked.own else before
        try:
            found, plan = found_and_planned(problem, options=options, near=near)
        except UnreachableError as error:
            yield TradeoffPoint(scale, np.nan, np.nan, np.nan, Status("unreachable", str(error), False))
            return
        if not plan.status.ok:
            yield TradeoffPoint(scale, np.nan, np.nan, np.nan, plan.status)
            return
        seen = margins(scaled(asked.scenario, 0.0), found.reference().samples)
        needed = max(float(np.max(m.friction_needed)) for m in seen.interfaces)
        yield TradeoffPoint(scale, plan.duration, needed, float(seen.exact.min()), plan.status)
        before = found
