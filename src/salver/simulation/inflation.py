"""By how much first-order tubes fall short of many sampled bodies, and tubes wide enough for them, checked.

Tubes (eqs 10 to 12) are first order; a large error of the centre of mass or of inertia leaves them by terms of
second order. Half of the samples say by how much the tubes must grow, as a share of their own largest radius;
the other half, which had no part in it, say whether that is enough.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from salver import sampling
from salver.control.object import Gains
from salver.geometry import Array
from salver.planning.object.evaluation import Evaluation
from salver.scenario import Scenario
from salver.simulation.closed_loop import Coverage, coverage, rollout
from salver.trajectory import Reference

RESERVE = 1.2  # on what the first half of the samples needed


@dataclass(frozen=True)
class Inflation:
    """Tubes of the cone coefficients of a scenario's first object, made wide enough for sampled bodies.

    share: by which every tube grows everywhere, as a share of its own largest radius; 0 where first order was
    enough. One for all tubes, because a corner of the set that one tube needs may be among the checking half.
    radius: (T, n_lambda) what the tubes are then, N. first_order: how the fitting samples lie in
    the original tubes. checked: how the other samples lie in the inflated ones.
    """

    share: float
    radius: Array
    first_order: Coverage
    checked: Coverage

    def __str__(self) -> str:
        widest = f"by {100 * self.share:.2g} % of their largest radius"
        return f"First-order tubes: {self.first_order}. Wider {widest}: {self.checked}."


def inflate(scenario: Scenario, reference: Reference, evaluation: Evaluation, n: int = 200, seed: int = 0) -> Inflation:
    """Tubes for n sampled bodies (extreme points of the set first) under the nonlinear closed loop (18), (19).

    evaluation: of the same reference. Raises SalverError when no combination of the parameters is possible.
    """
    payload = scenario.payload
    body = payload.first
    drawn = sampling.draw(payload.uncertain, n, seed, "corners", payload.bodies)
    order = np.random.default_rng(seed).permutation(n)  # extreme points and inner ones in both halves
    phi = payload.phi(body, drawn[order])
    gains = Gains(scenario.control.kp, scenario.control.kd)
    made = rollout(reference, body.inertial, body.contacts.grasp_map, gains, phi, evaluation.t)
    nominal, radius = evaluation.cone_coefficients, evaluation.cone_radius
    names = [f"coefficient {i + 1}" for i in range(nominal.shape[1])]
    half = n // 2
    fitted = coverage(evaluation.t, made.cone_coefficients[:half], nominal, radius, names)
    share = RESERVE * float(np.where(fitted.outside, fitted.relative, 0.0).max(initial=0.0))
    wider = radius + share * radius.max(axis=0)
    checked = coverage(evaluation.t, made.cone_coefficients[half:], nominal, wider, names)
    return Inflation(share, wider, fitted, checked)
