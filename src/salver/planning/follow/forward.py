"""Forward kinematics of a joint motion: pose, velocity and acceleration of the tray."""

from __future__ import annotations

from salver.control.object import apply
from salver.geometry import GRAVITY_S
from salver.models.arm.arm import ArmModel
from salver.sensitivity.arm.terms import motion_terms
from salver.trajectory import JointMotion, MotionSamples


def tray_motion(arm: ArmModel, motion: JointMotion) -> MotionSamples:
    """Motion of the tray's frame E at the samples of a joint motion; `of_frame` gives that of a frame fixed to it."""
    terms = motion_terms(arm.pin_model, arm.tray_id, motion.q, motion.dq, motion.ddq)
    v_S, a_S = (apply(terms.R_SE, x) for x in (terms.twist[:, :3], terms.w[:, :3]))
    return MotionSamples(motion.t, terms.p_SE, v_S, a_S + GRAVITY_S, terms.R_SE, terms.twist[:, 3:], terms.w[:, 3:6])
