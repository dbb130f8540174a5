"""The cost of a plan, eq (13): the integral of the squared norm of Pi, and the weights of its rows and columns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from salver.control.object import Gains
from salver.geometry import Array, Indices
from salver.models.bodies import Body
from salver.scenario import Scenario
from salver.sensitivity.dual import Dual
from salver.sensitivity.tray import TrayLoop, TraySensitivity


def tray_loop(scenario: Scenario) -> TrayLoop:
    """The closed loop of the scenario's first object, with all its uncertain parameters."""
    first, uncertain = scenario.payload.first, scenario.payload.uncertain
    gains = Gains(scenario.control.kp, scenario.control.kd)
    return TrayLoop(first.inertial, gains, first.phi_jacobian(uncertain.parameters))


@dataclass(frozen=True, eq=False)
class CostWeights:
    """Weights of the rows and columns of Pi in the cost, and of the instants in its integral.

    rows: (4, 3), of the blocks (dp, dtheta, dv, domega) by axis. columns: (n_p, n_p), multiplies Pi from the right.
    times: (T,) s.
    The weightings that a scenario can choose are:

    paper: the plain norm of the whole state, metres beside radians. pose: the plain norm of its pose rows.
    scaled: every row as a displacement of the contact points, in m: rotations by the radius of the base,
    rates by the natural frequency of their error dynamics, so that |e|^2 + |e'|^2 / kp is the energy of the
    error over its stiffness; columns by their half-range. It depends neither on units nor on which parameters
    are listed, and rates count as much as the displacements that they turn into.

    A scenario's own weights are rows in SI units, with columns by their half-range.
    """

    rows: Array
    columns: Array
    times: Array

    @classmethod
    def of(cls, scenario: Scenario, t: Array) -> CostWeights:
        """The weights of a scenario, at uniform instants t (T,), s, from 0 on."""
        times, uncertain = integration_weights(len(t), float(t[-1])), scenario.payload.uncertain
        rows: Sequence[float]
        if scenario.objective.weighting in ("paper", "pose"):
            rates = 1.0 if scenario.objective.weighting == "paper" else 0.0
            rows, columns = (1.0, 1.0, rates, rates), np.eye(uncertain.size)
        else:
            radius, (kp, kp_R) = base_radius(scenario.payload.first), scenario.control.kp
            own, columns = scenario.objective.weighting, uncertain.factor
            rows = (1.0, radius, kp**-0.5, radius * kp_R**-0.5) if isinstance(own, str) else own
        return cls(np.broadcast_to(np.reshape(rows, (4, -1)), (4, 3)), columns, times)


def base_radius(body: Body) -> float:
    """Distance, m, from B to the furthest corner of the surface that a body stands on."""
    return float(np.linalg.norm(body.base_polygon_B, axis=1).max())


def integration_weights(instants: int, duration: float) -> Array:
    """Weights (T,), s, of the trapezoidal rule with fourth-order end correction (Gregory) on a uniform grid."""
    weights = np.full(instants, duration / (instants - 1))
    correction = np.array([9 / 24, 28 / 24, 23 / 24])
    weights[:3] *= correction
    weights[-3:] *= correction[::-1]
    return weights


def sensitivity_cost(scenario: Scenario, t: Array, sensitivity: TraySensitivity) -> float:
    """The integral (13) of the weighted squared norm of Pi over uniform instants t (T,), s, from 0 on."""
    return float(np.sum(np.square(cost_residual(sensitivity, CostWeights.of(scenario, t))[0])))


def cost_residual(sensitivity: TraySensitivity, weights: CostWeights, size: int = 0) -> tuple[Array, Array]:
    """Weighted Pi as residuals (n_r,), whose squares add up to the integral (13), with their Jacobian (n_r, size)."""
    instants = np.sqrt(weights.times)[:, None, None]
    residual, jacobian = [np.zeros(0)], [np.zeros((0, size))]
    blocks = (sensitivity.dp, sensitivity.dtheta, sensitivity.dv, sensitivity.domega)
    moving = (sensitivity.loop.pushing, sensitivity.loop.turning) * 2  # the other rows are zero
    for scale, block, which in zip(weights.rows, blocks, moving, strict=True):
        if scale.any() and len(which):
            value, tangent = _times_columns(block, which, weights.columns, size)
            residual.append((scale * instants * value).ravel())
            jacobian.append((scale[:, None] * instants[..., None] * tangent).reshape(value.size, size))
    return np.concatenate(residual), np.concatenate(jacobian)


def _times_columns(block: Dual, which: Indices, columns: Array, n_z: int) -> tuple[Array, Array]:
    """A block (T, n_p, 3) and its tangent, multiplied by a matrix along the parameter axis. Only the parameters `which`
    are nonzero; columns that are zero then are left out."""
    some = columns[which]
    weights = some[:, some.any(axis=0)].T
    value = weights @ block.value[:, which]
    if block.tangent is None:
        return value, np.zeros((*value.shape, n_z))
    tangent = block.tangent[:, which].reshape(len(value), len(which), 3 * n_z)
    return value, (weights @ tangent).reshape(*value.shape, n_z)
