"""The object's controller, eq (19), term by term from a state in S."""

import numpy as np
import numpy.typing as npt

from newton_euler import wrench
from salver.control.object import Errors, Gains, apply, command
from salver.geometry import Array, log
from salver.trajectory import MotionSamples


def errors(reference: MotionSamples, p_SB: Array, R_SB: Array, v_S: Array, omega_B: Array) -> Errors:
    """Tracking errors of a state p_SB (..., 3), R_SB (..., 3, 3), v_S (..., 3), omega_B (..., 3).

    Leading axes broadcast: one sample of the reference (1, 3) can be compared with many states (n, 3).
    """
    transport = np.swapaxes(R_SB, -1, -2) @ reference.R_SB
    return Errors(
        reference.p_SB - p_SB,
        log(transport),
        reference.v_S - v_S,
        apply(transport, reference.omega_B) - omega_B,
        transport,
    )


def wrench_command(
    gains: Gains,
    phi_nominal: npt.ArrayLike,
    reference: MotionSamples,
    p_SB: Array,
    R_SB: Array,
    v_S: Array,
    omega_B: Array,
) -> Array:
    """Commanded wrench (..., 6) at B, eq (19), computed with the nominal inertial parameters phi_nominal (10,)."""
    a_cmd_S, alpha_cmd_B = command(gains, reference, errors(reference, p_SB, R_SB, v_S, omega_B))
    return wrench(phi_nominal, R_SB, a_cmd_S, omega_B, alpha_cmd_B)


def distribute(grasp_map: Array, wrench_B: Array) -> Array:
    """Cone coefficients Lambda (..., n_lambda) of least norm for a wrench (..., 6): eq (19)."""
    return wrench_B @ np.linalg.pinv(grasp_map).T
