"""Live motions driven in simulated time, and what was executed judged as one motion."""

from __future__ import annotations

import numpy as np

from salver.planning.fastest import evaluate
from salver.trajectory import JointMotion

PERIOD = 1e-3
PATIENCE = 60.0  # s: on a busy machine no clock is to decide a test


def drive(live, seconds, wishes=(), every=20, begins=0.0):
    """Run a live motion at 1 kHz from the clock's time `begins` on, planning every so many periods (None: never).

    wishes: (time, call) in order. q, dq, ddq (T, n).
    """
    rows, left = [], list(wishes)
    for k in range(round(seconds / PERIOD)):
        while left and left[0][0] <= k * PERIOD + 1e-9:
            left.pop(0)[1](live)
        q, dq, ddq, _ = live.command(begins + k * PERIOD)
        rows.append(np.stack([q, dq, ddq]))
        if every and k % every == 0:
            live.plan(PATIENCE)
    return tuple(np.swapaxes(np.array(rows), 0, 1))


def in_turn(*runs):
    """The states of runs that follow one another."""
    return tuple(np.concatenate(parts) for parts in zip(*runs, strict=True))


def executed(states):
    """What was commanded at 1 kHz, as one motion."""
    return JointMotion(np.arange(len(states[0])) * PERIOD, *states)


def rows_of(problem, motion):
    """The largest value of each row along a motion judged from its own beginning at rest, without any margin.

    Its jerk is the difference of two accelerations that were told: that of a quintic through two samples with a knot
    between them would be no one's.
    """
    t, constraints = motion.t, [constraint.near(motion.q[::5]) for constraint in problem.constraints]

    def largest(jerk):
        z = np.stack([*motion.sample(t), jerk])
        at = problem.at(t / motion.duration, z, motion.duration, imposed=False)
        return {block.name: float(block.values.max()) for block in evaluate(constraints, at, margins=False)}

    told = np.diff(motion.ddq, axis=0, append=motion.ddq[-1:]) / PERIOD
    return largest(motion.jerk(t)) | {"jerk": largest(told)["jerk"]}


def jolts(states):
    """How far posture and velocity are from what the velocity and acceleration before them say, at 1 kHz."""
    q, dq, ddq = states
    return tuple(
        float(np.abs(np.diff(x, axis=0) - 0.5 * PERIOD * (rate[1:] + rate[:-1])).max())
        for x, rate in ((q, dq), (dq, ddq))
    )
