"""The motion of the tray frame."""

from __future__ import annotations

from typing import TYPE_CHECKING

from salver.geometry import Array, invert
from salver.models.tray_motion import frame_map, motion_vector
from salver.scenario import Scenario

if TYPE_CHECKING:
    from salver.trajectory import MotionSamples


def tray_motion(scenario: Scenario, samples: MotionSamples) -> Array:
    """Motion regressor w (T, 12) of the tray frame E if frame B of the first object moves as `samples`."""
    first = scenario.payload.first
    w_B = motion_vector(samples.R_SB, samples.a_S, samples.omega_B, samples.alpha_B)
    return w_B @ frame_map(*invert(first.p_EB, first.R_EB)).T
