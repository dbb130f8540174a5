"""The motion of the tray frame, and how the closed loop changes it when parameters differ."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from salver.geometry import Array, invert
from salver.models.rigid_body import inertia_entries, regressor
from salver.models.tray_motion import frame_map, motion_vector
from salver.scenario import Scenario

if TYPE_CHECKING:
    from salver.trajectory import MotionSamples


def tray_motion(scenario: Scenario, samples: MotionSamples) -> Array:
    """w (T, 12) of the tray frame E when the first object's B moves as `samples`."""
    first = scenario.payload.first
    w_B = motion_vector(samples.R_SB, samples.a_S, samples.omega_B, samples.alpha_B)
    return w_B @ frame_map(*invert(first.p_EB, first.R_EB)).T


def tracking_motion(scenario: Scenario, samples: MotionSamples, state: Array, wrench: Array) -> Array:
    """First-order change (T, 12, n_p) of the tray motion w when the closed loop meets other parameters.

    state: Pi (T, 12, n_p); wrench: d wrench_B / dp (T, 6, n_p) of the first object, both of the closed loop at
    the uncertain parameters of the scenario (Plan.state_sensitivity; grasp_map @ Plan.input_sensitivity).
    What of the wrench's change is not due to the parameters themselves is due to the motion's.
    """
    first, uncertain = scenario.payload.first, scenario.payload.uncertain
    y = regressor(samples.R_SB, samples.a_S, samples.omega_B, samples.alpha_B)
    moved = wrench - y @ first.phi_jacobian(uncertain.parameters)
    omega, domega = samples.omega_B, np.swapaxes(state[:, 9:], 1, 2)
    inertia = first.inertial.inertia_com
    gyroscopic = np.cross(domega, (omega @ inertia)[:, None]) + np.cross(omega[:, None], domega @ inertia)
    dalpha = (np.swapaxes(moved[:, 3:], 1, 2) - gyroscopic) @ np.linalg.inv(inertia)
    products = omega[:, None, :, None] * domega[:, :, None, :]
    products = inertia_entries(products + np.swapaxes(products, 2, 3))
    dforce = np.swapaxes(moved[:, :3], 1, 2) / first.inertial.mass
    dw_B = np.concatenate([dforce, dalpha, products], axis=2)
    return np.swapaxes(dw_B @ frame_map(*invert(first.p_EB, first.R_EB)).T, 1, 2)
