"""Collisions and joint ranges of an arm along a joint motion from a file."""

from __future__ import annotations

import numpy as np

from salver.auditing.commanded import commanded_motion
from salver.errors import Status
from salver.models.arm.arm import ArmModel
from salver.models.arm.arm_geometry import UnknownShapeError, arm_geometry
from salver.motion_files.samples import JointSamples, reordered
from salver.planning.follow.clearance import sweep
from salver.planning.follow.limits import COLLISION, LIMIT_EXCEEDED, WITHIN_LIMITS, unchecked
from salver.scenario import Scenario
from salver.trajectory import JointMotion
from salver.wording import listed

NOT_CHECKED = Status("not_checked", "Not checked: whether an arm can follow the motion, and what it would touch.", True)


def arm_status(samples: JointSamples, arm: ArmModel, scenario: Scenario, step: float = 5e-3) -> Status:
    """Whether joints stay in their ranges at all samples, and nothing collides, at postures `step`, s, apart and
    between them. The sentence of a good status begins with what was not checked."""
    samples = reordered(samples, arm.joint_names)
    t, q = commanded_motion(samples)[:2] if samples.commanded else (samples.t, samples.q)
    beyond = np.maximum(arm.limits.q_min - q, q - arm.limits.q_max)
    k, j = np.unravel_index(int(np.argmax(beyond)), beyond.shape)
    if beyond[k, j] > 0:
        name, unit = arm.joint_names[j], arm.unit(int(j))
        far = f"{name} is at {q[k, j]:.4g} {unit} at {t[k]:.2f} s, {beyond[k, j]:.2g} {unit} out of its range"
        return Status(LIMIT_EXCEEDED, f"{far}.", False)
    try:
        parts = arm_geometry(arm, scenario.payload.bodies, scenario.around)
    except UnknownShapeError as error:
        return Status(NOT_CHECKED.code, f"{NOT_CHECKED.sentence} {error}", True)
    keep = np.unique(np.clip(np.searchsorted(t, np.arange(t[0], t[-1], step)), 0, len(t) - 1))
    keep = np.union1d(keep, [0, len(t) - 1])
    t, q = t[keep], q[keep]
    dq = np.gradient(q, t, axis=0)
    swept = sweep(parts, JointMotion(t, q, dq, np.gradient(dq, t, axis=0)))
    rolling = arm.base is not None and arm.base.kind == "differential"
    slides = ["whether the base moves across its heading"] if rolling else []
    blind = listed(["how fast the joints move, and their torques", *slides, *unchecked(arm, parts)])
    if swept.touch is not None:
        first, second, when = swept.touch.first, swept.touch.second, swept.touch.time
        return Status(COLLISION, f"{first} and {second} touch at {when:.2f} s.", False)
    near = swept.obstacle or swept.nearest
    passes = ""
    if near is not None:
        distance, when = 1e3 * near.distance, near.time
        passes = f"; {near.first} passes {near.second} at {distance:.0f} mm at {when:.2f} s"
    sentence = f"Not checked: {blind}. The joints keep to their ranges and nothing touches{passes}."
    return Status(WITHIN_LIMITS, sentence, True)
