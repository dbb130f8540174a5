"""Logs of joints that lag behind their plan."""

from __future__ import annotations

import numpy as np
from scipy.signal import StateSpace, lsim

from salver.geometry import Array
from salver.models.arm.arm import load_arm
from salver.motion_files import JointSamples
from salver.motion_files.samples import joint_samples
from salver.planning.plan import Plan

UNEQUAL = [14.4, 9.6, 12.0, 13.2, 10.8, 14.4, 9.6]  # Hz: 12 and a fifth more or less


def lagging(plan: Plan, hertz: list[float], damping: float, late: float = 0.0) -> tuple[Array, Array, Array, Array]:
    """t, q, dq, ddq of joints that are second-order lags of the plan, by SciPy; 0.2 s of rest first."""
    assert plan.joint is not None
    t = np.arange(-0.2, plan.duration + 0.6, 1e-3)
    told = plan.joint.sample(t - late)[0]
    states = []
    for f, column in zip(hertz, told.T, strict=True):
        rate = 2 * np.pi * f
        lag = StateSpace([[0, 1], [-(rate**2), -2 * damping * rate]], [[0], [rate**2]], np.eye(2), np.zeros((2, 1)))
        _, x, _ = lsim(lag, column - column[0], t - t[0])
        bend = rate**2 * (column - column[0] - x[:, 0]) - 2 * damping * rate * x[:, 1]
        states.append((x[:, 0] + column[0], x[:, 1], bend))
    q, dq, ddq = (np.stack(x, axis=1) for x in zip(*states, strict=True))
    return t, q, dq, ddq


def logged(plan: Plan, t: Array, q: Array, noise: float = 0.0, seed: int = 0, every: int = 1) -> JointSamples:
    assert plan.scenario.arm is not None
    names = tuple(load_arm(plan.scenario.arm, plan.scenario.tray).joint_names)
    q = q + noise * np.random.default_rng(seed).standard_normal(q.shape)
    return joint_samples(t[::every] + 7.0, names, q[::every], None, None, "a log")
