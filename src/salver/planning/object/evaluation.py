"""What a reference means for the carried objects: wrench, coefficients, sensitivities and margins over time.

Computed from the reference itself, not from the matrices of the planning problem, and at any instants: the
check of a plan does not share the planner's linear algebra.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from salver.display import Outlined
from salver.geometry import Array, Mask
from salver.linear_filter import QuadratureGrid
from salver.models.uncertain.parameters import UncertainSet
from salver.planning.object.conditions import apart, conditions_along
from salver.planning.object.cost import tray_loop
from salver.scenario import Scenario
from salver.sensitivity.dual import joined
from salver.sensitivity.tray import BodyMotion, TrayLoop, TraySensitivity
from salver.sensitivity.tubes import radius
from salver.trajectory import MotionSamples, Reference


@dataclass(frozen=True, repr=False)
class Evaluation(Outlined):
    """A motion at T uniform instants and what it asks of the contact, time axis first.

    samples: the motion of B. wrench_B (T, 6): nominal. cone_coefficients (T, n_lambda): Lambda of eq (19).
    slack (T, n_c): the scenario's own contact conditions minus their tubes, in the condition's unit, before the
    margin; slack_owner names the object or interface of each column. closed_loop: what the loop makes of wrong
    parameters, worked out when it is first read. distribution (n_lambda, 6): of the wrench on the coefficients.
    """

    samples: MotionSamples
    wrench_B: Array
    cone_coefficients: Array
    slack: Array
    slack_owner: tuple[str, ...]
    closed_loop: ObjectLoop
    distribution: Array
    uncertain: UncertainSet

    @property
    def state_sensitivity(self) -> Array:
        """(T, 12, n_p)."""
        return self.closed_loop.sensitivity.state

    @cached_property
    def input_sensitivity(self) -> Array:
        """(T, n_lambda, n_p)."""
        return np.asarray(self.distribution @ self.closed_loop.sensitivity.wrench)

    @cached_property
    def cone_radius(self) -> Array:
        """(T, n_lambda) tube of the coefficients (eq 11)."""
        return radius(self.input_sensitivity, self.uncertain)

    @property
    def t(self) -> Array:
        return self.samples.t

    @property
    def _others(self) -> Mask:
        """(n_c,) which columns are no contact, but a brim or the limit on tilt."""
        return np.array([apart(owner) for owner in self.slack_owner])

    @property
    def contacts(self) -> Array:
        """(T, ...) `slack` of the contact conditions alone."""
        return self.slack[:, ~self._others]

    def worst(self, since: float = 0.0) -> tuple[float, float, str]:
        """Least slack, its time, and the object it belongs to: of the contacts, unless only something else fails.
        since: s, of contacts alone from then on."""
        others, slack = self._others, self.slack
        if since > 0.0:
            slack = np.where(others | (self.t < since)[:, None], np.inf, slack)
        if slack[:, ~others].min() < 0 or slack[:, others].min(initial=np.inf) >= 0:
            slack = np.where(others, np.inf, slack)  # in a unit of its own
        k, i = np.unravel_index(int(np.argmin(slack)), slack.shape)
        return float(slack[k, i]), float(self.t[k]), self.slack_owner[i]


@dataclass(frozen=True, eq=False)
class ObjectLoop:
    """The object's loop along a reference, at a grid's instants; motion: the reference there."""

    loop: TrayLoop
    grid: QuadratureGrid
    motion: BodyMotion
    reference: Reference

    @cached_property
    def sensitivity(self) -> TraySensitivity:
        between = BodyMotion.of(self.reference.sample(self.grid.times))
        return self.loop.sensitivity(self.grid, self.motion, between)


def evaluate(scenario: Scenario, reference: Reference, instants: int, rest: float = 0.0) -> Evaluation:
    """Evaluate a reference at uniform instants from its start to its end; rest: s, and at rest after it."""
    loop, payload = tray_loop(scenario), scenario.payload
    grid = loop.grid(np.linspace(0, reference.duration + rest, instants))
    samples = reference.sample(grid.t)
    motion = BodyMotion.of(samples)
    closed_loop = ObjectLoop(loop, grid, motion, reference)
    wrench_B = joined(*motion.wrench(loop.body.phi[:, None]))[:, 0]
    first = payload.first
    distribution: Array = np.linalg.pinv(first.contacts.grasp_map).astype(float)
    rows = conditions_along(scenario, grid.t, motion, lambda: closed_loop.sensitivity)
    return Evaluation(
        samples,
        wrench_B,
        wrench_B @ distribution.T,
        np.concatenate([part.slack() for part in rows], axis=1),
        tuple(owner for part in rows for owner in part.owner),
        closed_loop,
        distribution,
        payload.uncertain,
    )
