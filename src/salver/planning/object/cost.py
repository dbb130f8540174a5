"""What the plan minimises, eq (13): the integral of the squared norm of Pi, and how its rows and columns count."""

from __future__ import annotations

import numpy as np

from salver.control.object import Gains
from salver.geometry import Array
from salver.models.bodies import Body
from salver.models.parameters import UncertainSet
from salver.scenario import Scenario
from salver.sensitivity.tray import TrayLoop


def tray_loop(scenario: Scenario) -> TrayLoop:
    """The closed loop of the scenario's first object, with all its uncertain parameters."""
    first, uncertain = scenario.payload.first, scenario.payload.uncertain
    gains = Gains(scenario.control.kp, scenario.control.kd)
    return TrayLoop(first.inertial, gains, first.phi_jacobian(uncertain.parameters))


def row_scale(weighting: str, body: Body, gains: Gains) -> tuple[float, float, float, float]:
    """Weights of the blocks (dp, dtheta, dv, domega) of the state sensitivity in the cost.

    paper: the plain norm of the whole state, metres beside radians. pose: the plain norm of its pose rows.
    scaled: every row as a displacement of the contact points, in m: rotations by the radius of the base,
    rates by the natural frequency of their error dynamics, so that |e|^2 + |e'|^2 / kp is the energy of the
    error over its stiffness; columns by their half-range. It depends neither on units nor on which parameters
    are listed, and rates count as much as the displacements that they turn into.
    """
    if weighting == "paper":
        return 1.0, 1.0, 1.0, 1.0
    if weighting == "pose":
        return 1.0, 1.0, 0.0, 0.0
    radius = float(np.linalg.norm(body.base_polygon_B, axis=1).max())
    (kp, kp_R) = gains.kp
    return 1.0, radius, kp**-0.5, radius * kp_R**-0.5


def column_scale(weighting: str, uncertain: UncertainSet) -> Array:
    """(n_p, n_p) that multiplies Pi from the right: half-ranges when scaled, nothing in the paper's norms."""
    return uncertain.factor if weighting == "scaled" else np.eye(uncertain.size)


def integration_weights(instants: int, duration: float) -> Array:
    """(T,) fourth-order end-corrected trapezoidal weights of a uniform grid, s (Gregory)."""
    weights = np.full(instants, duration / (instants - 1))
    correction = np.array([9 / 24, 28 / 24, 23 / 24])
    weights[:3] *= correction
    weights[-3:] *= correction[::-1]
    return weights


def sensitivity_cost(scenario: Scenario, t: Array, state_sensitivity: Array) -> float:
    """Integral (13) of the weighted squared norm of Pi (T, 12, n_p) over uniform instants t (T,)."""
    weighting = scenario.objective.weighting
    blocks = row_scale(weighting, scenario.payload.first, tray_loop(scenario).gains)
    columns = column_scale(weighting, scenario.payload.uncertain)
    weighted = np.repeat(blocks, 3)[:, None] * (state_sensitivity @ columns)
    return float(np.einsum("t,tij->", integration_weights(len(t), float(t[-1])), weighted**2))
