"""How far a joint trajectory is missed because the load is not what the controller thinks, to first order.

With computed torque for the nominal load the joints' errors e = q* - q obey, to first order in the parameters,

    e'' + kd e' + kp e = M(q)^-1 J_E(q)^T dF(t),        dF = (d load / dp) w(t),

M the mass matrix of the arm with its nominal load, J_E the tray's body Jacobian and dF the wrench that the unknown
part of the load needs along the motion: the same linear filter as the paper's object has, with another forcing.
Everything here is a smooth function of the trajectory, for planners that bound its effect on the contact.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from salver.geometry import Array
from salver.sensitivity.arm.filter import NodeFilter
from salver.sensitivity.arm.load import LoadChange


@dataclass(frozen=True)
class JointDeviation:
    """d/dp of the joints' motion at T instants: q, dq, ddq (T, n, n_c), in rad, rad/s, rad/s^2 per unit of p.

    missing: (T, n, n_c) acceleration that the controller asks for and does not get, ddq_cmd - ddq.
    """

    q: Array
    dq: Array
    ddq: Array
    missing: Array

    @property
    def state(self) -> Array:
        """(T, 3 n, n_c): q, dq, ddq one below the other."""
        return np.concatenate([self.q, self.dq, self.ddq], axis=1)


def missing_acceleration(w: Array, jacobian_E: Array, mass_matrix: Array, load: LoadChange) -> Array:
    """M^-1 J_E^T dF (T, n, n_c), of w (T, 12) at E, J_E (T, 6, n) and M (T, n, n) with the nominal load."""
    wrench = np.tensordot(w, load.load_p, axes=(1, 2))  # (T, n_c, 6)
    return np.asarray(np.linalg.solve(mass_matrix, np.swapaxes(wrench @ jacobian_E, 1, 2)))


def tracking_error(missing: Array, response: NodeFilter, settled: Array | float = 1.0) -> JointDeviation:
    """Deviation of the joints under joint-space computed torque, for a `missing` acceleration (T, n, n_c).

    response: `node_filter(t, kp, kd, settle)` of the nodes' times and the joints' gains; settled: as in its `respond`.
    """
    e, rate, acceleration = response.respond(missing, settled)
    return JointDeviation(-e, -rate, -acceleration, missing)


def tracking_wrench_motion(
    w: Array, w_z: Array, jacobian_E: Array, mass_matrix: Array, load: LoadChange, response: NodeFilter
) -> Array:
    """dw (T, 12, n_c): how what the tray feels at E changes per unit of each term of the load, through tracking.

    w: (T, 12) what the tray feels, at E; w_z: (T, 12, 3 n) its derivative by (q, dq, ddq). jacobian_E: (T, 6, n).
    mass_matrix: (T, n, n), nominal load included. A contact row c (at E) then changes by c . dw, on top of what the
    parameter changes in c itself. Multiply by `load.half_range` for the change over the whole range. Of second order,
    only the load's own products are in it, not what the load makes of its tracking error.
    """
    missing = missing_acceleration(w, jacobian_E, mass_matrix, load)
    return np.asarray(w_z @ tracking_error(missing, response).state)
