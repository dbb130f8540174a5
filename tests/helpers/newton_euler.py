"""Eq (1), as Newton and Euler have it: the wrench that a moving body needs."""

import numpy as np

from salver.geometry import GRAVITY_S, Array
from salver.models.rigid_body import inertia_matrix


def wrench(phi: Array, R_SB: Array, a_S: Array, omega_B: Array, alpha_B: Array) -> Array:
    """Wrench (..., 6) at B of a body with inertial parameters phi (10,); a_S (..., 3) of the origin of B."""
    mass, moment, inertia = phi[0], phi[1:4], inertia_matrix(phi[4:])
    f = np.einsum("...ji,...j->...i", R_SB, a_S - GRAVITY_S)
    force = mass * f + np.cross(alpha_B, moment) + np.cross(omega_B, np.cross(omega_B, moment))
    torque = np.cross(moment, f) + alpha_B @ inertia + np.cross(omega_B, omega_B @ inertia)
    return np.concatenate([force, torque], axis=-1)
