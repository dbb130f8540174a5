"""Forward kinematics of a joint motion: pose, velocity and acceleration of the tray."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from salver.models.arm.arm import ArmModel
from salver.trajectory import JointMotion, MotionSamples


def tray_motion(arm: ArmModel, motion: JointMotion) -> MotionSamples:
    """Motion of the tray's frame E at the samples of a joint motion; `of_frame` gives that of a frame fixed to it."""
    count, local = len(motion.t), pin.ReferenceFrame.LOCAL
    p, v, a, omega, alpha = (np.empty((count, 3)) for _ in range(5))
    R = np.empty((count, 3, 3))
    model, data, tray = arm.pin_model, arm.pin_model.createData(), arm.tray_id
    for k, state in enumerate(zip(motion.q, motion.dq, motion.ddq, strict=True)):
        pin.forwardKinematics(model, data, *state)
        placement = pin.updateFramePlacement(model, data, tray)
        twist = pin.getFrameVelocity(model, data, tray, local)
        rate = pin.getFrameClassicalAcceleration(model, data, tray, local)
        p[k], R[k] = placement.translation, placement.rotation
        v[k], a[k] = placement.rotation @ twist.linear, placement.rotation @ rate.linear
        omega[k], alpha[k] = twist.angular, rate.angular
    return MotionSamples(motion.t, p, v, a, R, omega, alpha)
