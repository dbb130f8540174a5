"""What a reference means for the carried objects: wrench, coefficients, sensitivities and margins over time.

Computed from the reference itself, not from the matrices of the planning problem, and at any instants: the
check of a plan does not share the planner's linear algebra.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from salver.display import Outlined
from salver.geometry import Array, invert
from salver.models.tray_motion import frame_map
from salver.planning.object.conditions import apart, conditions_for, motion_vector
from salver.planning.object.cost import tray_loop
from salver.scenario import Scenario
from salver.sensitivity.dual import joined
from salver.sensitivity.sloshing import Liquids
from salver.sensitivity.tray import BodyMotion
from salver.sensitivity.tubes import radius
from salver.trajectory import MotionSamples, Reference


@dataclass(frozen=True, repr=False)
class Evaluation(Outlined):
    """A motion at T uniform instants and what it asks of the contact, time axis first.

    samples: the motion of B. wrench_B (T, 6): nominal. cone_coefficients (T, n_lambda): Lambda of eq (19), and
    cone_radius its tube (eq 11). state_sensitivity (T, 12, n_p), input_sensitivity (T, n_lambda, n_p).
    slack (T, n_c): the scenario's own contact conditions minus their tubes, in the condition's unit, before the
    margin; slack_owner names the object or interface of each column.
    """

    samples: MotionSamples
    wrench_B: Array
    cone_coefficients: Array
    cone_radius: Array
    state_sensitivity: Array
    input_sensitivity: Array
    slack: Array
    slack_owner: tuple[str, ...]

    @property
    def t(self) -> Array:
        return self.samples.t

    def worst(self) -> tuple[float, float, str]:
        """Least slack, its time, and the object it belongs to: of the contacts, unless only something else fails."""
        others = np.array([apart(owner) for owner in self.slack_owner])
        slack = self.slack
        if slack[:, ~others].min() < 0 or slack[:, others].min(initial=np.inf) >= 0:
            slack = np.where(others, np.inf, slack)  # in a unit of its own
        k, i = np.unravel_index(int(np.argmin(slack)), slack.shape)
        return float(slack[k, i]), float(self.t[k]), self.slack_owner[i]


def evaluate(scenario: Scenario, reference: Reference, instants: int) -> Evaluation:
    """Evaluate a reference at uniform instants from its start to its end."""
    loop, uncertain = tray_loop(scenario), scenario.payload.uncertain
    grid = loop.grid(np.linspace(0, reference.duration, instants))
    samples = reference.sample(grid.t)
    motion = BodyMotion.of(samples)
    sensitivity = loop.sensitivity(grid, motion, BodyMotion.of(reference.sample(grid.times)))
    wrench_B = joined(*motion.wrench(loop.body.phi[:, None]))[:, 0]
    distribution = np.linalg.pinv(scenario.payload.first.contacts.grasp_map)
    theta = distribution @ sensitivity.wrench
    first = scenario.payload.first
    w_E = motion_vector(motion, 0)[0] @ frame_map(*invert(first.p_EB, first.R_EB)).T
    liquids = Liquids.along(scenario.payload, grid.t, w_E)
    rows = [condition(motion, sensitivity, 0, liquids) for condition in conditions_for(scenario)]
    return Evaluation(
        samples,
        wrench_B,
        wrench_B @ distribution.T,
        radius(theta, uncertain),
        sensitivity.state,
        theta,
        np.concatenate([part.least() for part in rows], axis=1),
        tuple(owner for part in rows for owner in part.owner),
    )
