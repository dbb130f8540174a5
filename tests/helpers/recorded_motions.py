"""Motions of a tray and of an arm, and files of them as an audit reads."""

from pathlib import Path

import numpy as np

from salver.motion_files import JointSamples, MotionSeries
from salver.trajectory import min_jerk_line

START, GOAL = np.array([0.5, -0.25, 0.4]), np.array([0.5, 0.25, 0.4])

JOINTS = tuple(f"panda_joint{i}" for i in range(1, 8))

Q0 = np.array([0.082565, 1.039634, -0.777333, -1.678140, -2.197384, 0.842888, 1.123073])

AT_B, NO_TURN = np.zeros(3), np.eye(3)


def line(duration, rate=1000.0):
    t = np.arange(round(duration * rate) + 1) / rate
    return min_jerk_line(duration, START, GOAL, np.eye(3), np.eye(3)).sample(t)


def series_of(samples):
    """Samples as a motion to be written."""
    ns = np.round(samples.t * 1e9).astype(np.int64)
    if isinstance(samples, JointSamples):
        return MotionSeries(ns, samples.names, samples.q, samples.dq, samples.ddq)
    return MotionSeries(ns, p_SE=samples.p, quat_SE_wxyz=samples.quat_wxyz)


def write_csv(path: Path, header: str, *columns) -> Path:
    np.savetxt(path, np.column_stack(columns), delimiter=",", header=header, comments="", fmt="%.12g")
    return path


def tray_csv(path: Path, duration=1.5, noise=0.0, rate=1000.0) -> Path:
    s = line(duration, rate)
    p = s.p_SB + noise * np.random.default_rng(0).standard_normal(s.p_SB.shape)
    return write_csv(path, "t,x,y,z,qw,qx,qy,qz", s.t, p, s.quat_SB_wxyz)


def joint_motion(duration=2.0, rate=1000.0):
    t = np.arange(round(duration * rate) + 1) / rate
    u = t / duration
    s = 10 * u**3 - 15 * u**4 + 6 * u**5
    return t, Q0 + np.outer(s, [0.5, 0.1, -0.1, 0.1, 0.1, 0.0, 0.2])


HEADER = "t,x,y,z,qw,qx,qy,qz"
