"""What the plan minimises, eq (13): the integral of the squared norm of Pi, and how its rows and columns count."""

from __future__ import annotations

import numpy as np

from salver.control.object import Gains
from salver.geometry import Array, Indices
from salver.models.bodies import Body
from salver.models.parameters import UncertainSet
from salver.scenario import Scenario
from salver.sensitivity.dual import Dual
from salver.sensitivity.filter import fastest_rate
from salver.sensitivity.tray import TrayLoop, TraySensitivity

_STEP = 0.35  # of the fastest rate times h: the integral of the cost is then right to some 1e-4


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


def refinement(loop: TrayLoop, step: float) -> int:
    """Into how many parts a step of s is to be divided, for the integral of the cost."""
    fastest = max(fastest_rate(*pair) for pair in zip(loop.gains.kp, loop.gains.kd, strict=True))
    return max(1, int(np.ceil(fastest * step / _STEP)))


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


def cost_residual(
    sensitivity: TraySensitivity,
    rows: tuple[float, float, float, float],
    columns: Array,
    time_weights: Array,
    size: int,
) -> tuple[Array, Array]:
    """Weighted Pi as residuals (n_r,), whose squares add up to the integral (13), with their Jacobian (n_r, size).

    rows, columns, time_weights: see `row_scale`, `column_scale`, `integration_weights`.
    """
    weights = np.sqrt(time_weights)[:, None, None]
    residual, jacobian = [np.zeros(0)], [np.zeros((0, size))]
    blocks = (sensitivity.dp, sensitivity.dtheta, sensitivity.dv, sensitivity.domega)
    moving = (sensitivity.loop.pushing, sensitivity.loop.turning) * 2  # the others' rows are zero
    for scale, block, which in zip(rows, blocks, moving, strict=True):
        if scale > 0 and len(which):
            value, tangent = _times_columns(block, which, columns, size)
            residual.append((scale * weights * value).ravel())
            jacobian.append((scale * weights[..., None] * tangent).reshape(value.size, size))
    return np.concatenate(residual), np.concatenate(jacobian)


def _times_columns(block: Dual, which: Indices, columns: Array, n_z: int) -> tuple[Array, Array]:
    """(T, n_p, 3) and its tangent with the parameter axis multiplied by a matrix: of these parameters, others being
    zero, and without the columns that are then zero."""
    some = columns[which]
    weights = some[:, some.any(axis=0)].T
    value = weights @ block.value[:, which]
    if block.tangent is None:
        return value, np.zeros((*value.shape, n_z))
    tangent = block.tangent[:, which].reshape(len(value), len(which), 3 * n_z)
    return value, (weights @ tangent).reshape(*value.shape, n_z)
