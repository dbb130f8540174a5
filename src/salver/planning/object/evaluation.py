"""Evaluation of a reference: wrench, cone coefficients, sensitivities and contact slacks over time.

It uses the reference itself, not the matrices of the planning problem, so the check of a plan is independent of the
planner's linear algebra.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np

from salver.display import Outlined
from salver.geometry import Array, Mask
from salver.models.uncertain.parameters import UncertainSet
from salver.planning.object.conditions import apart, cases_of, constraints_of, slack_along, tray_evaluation
from salver.planning.object.cost import tray_loop
from salver.scenario import Scenario
from salver.sensitivity.dual import joined
from salver.sensitivity.tray import BodyMotion, TraySensitivity
from salver.sensitivity.tubes import radius
from salver.trajectory import MotionSamples, Reference


@dataclass(frozen=True, repr=False)
class Evaluation(Outlined):
    """A reference at T uniform instants with its contact quantities, time axis first.

    samples: the motion of B. wrench_B: (T, 6) nominal wrench. cone_coefficients: (T, n_lambda) Lambda of eq (19).
    slack: (T, n_c) contact conditions of the scenario minus their tubes, in the condition's unit, before the margin.
    slack_owner: (n_c,) object or interface of each column. sensitivity: returns that of the closed loop, computed when
    it is first called. distribution: (n_lambda, 6) map from the wrench to the coefficients. uncertain: the set.
    """

    samples: MotionSamples
    wrench_B: Array
    cone_coefficients: Array
    slack: Array
    slack_owner: tuple[str, ...]
    sensitivity: Callable[[], TraySensitivity]
    distribution: Array
    uncertain: UncertainSet

    @property
    def state_sensitivity(self) -> Array:
        """(T, 12, n_p)."""
        return self.sensitivity().state

    @cached_property
    def input_sensitivity(self) -> Array:
        """(T, n_lambda, n_p)."""
        return np.asarray(self.distribution @ self.sensitivity().wrench)

    @cached_property
    def cone_radius(self) -> Array:
        """(T, n_lambda) tube radius of the coefficients (eq 11)."""
        return radius(self.input_sensitivity, self.uncertain)

    @property
    def t(self) -> Array:
        return self.samples.t

    @property
    def _others(self) -> Mask:
        """(n_c,) which columns are no contact conditions, but a limit of load dynamics or of tilt."""
        return np.array([apart(owner) for owner in self.slack_owner])

    @property
    def contacts(self) -> Array:
        """(T, ...) `slack` of the contact conditions only."""
        return self.slack[:, ~self._others]

    def worst(self, since: float = 0.0) -> tuple[float, float, str]:
        """Least slack, its time (s) and its owner: of the contact conditions, unless only another condition fails.

        since: s; from then on only contact conditions count.
        """
        others, slack = self._others, self.slack
        if since > 0.0:
            slack = np.where(others | (self.t < since)[:, None], np.inf, slack)
        if slack[:, ~others].min() < 0 or slack[:, others].min(initial=np.inf) >= 0:
            slack = np.where(others, np.inf, slack)  # has another unit
        k, i = np.unravel_index(int(np.argmin(slack)), slack.shape)
        return float(slack[k, i]), float(self.t[k]), self.slack_owner[i]


def evaluate(scenario: Scenario, reference: Reference, instants: int, rest: float = 0.0) -> Evaluation:
    """Evaluate a reference at uniform instants from its start to its end, and for `rest` seconds at rest after it."""
    loop, payload = tray_loop(scenario), scenario.payload
    t = np.linspace(0, reference.duration + rest, instants)
    samples, sensitivity = reference.sample(t), cache(lambda: loop.along(reference, t))
    motion = BodyMotion.of(samples)
    wrench_B = joined(*motion.wrench(loop.body.phi[:, None]))[:, 0]
    first = payload.first
    distribution: Array = np.linalg.pinv(first.contacts.grasp_map).astype(float)
    tray = tray_evaluation(payload, t, motion, cases_of(payload), lambda _: sensitivity())
    return Evaluation(
        samples,
        wrench_B,
        wrench_B @ distribution.T,
        *slack_along(constraints_of(scenario), tray),
        sensitivity,
        distribution,
        payload.uncertain,
    )
