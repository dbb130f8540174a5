"""Live motions driven in simulated time, and what was executed judged as one motion."""

from __future__ import annotations

from dataclasses import replace
from itertools import chain
from typing import NamedTuple

import numpy as np

from salver.live.replanning.steer import TICK
from salver.planning.fastest import evaluate
from salver.planning.trajopt.constraints.constraints import ContactConstraint
from salver.sensitivity.arm.compliance import LoadResponses
from salver.sensitivity.arm.tracking import JointLoop
from salver.trajectory import JointMotion

PERIOD = 1e-3
EVERY = round(TICK / PERIOD)  # periods between ticks
LEAD = 0.1  # s: in simulated time planning takes none, and hand-overs are where they would be
PATIENCE = 60.0  # s: on a busy machine no clock is to decide a test
JUST = 1e-6  # s before a knot
APART = 1e-4  # s: between nearer instants a quintic's jerk is lost in rounding
ROUNDS = 8  # in which waves and the arm that gives way to them are known, for two seconds; longer, as many more


class Linear(JointLoop):
    """A loop for which what is missing is linear between the nodes."""

    def along(self, t, terms, rates, order=1, shares=None):
        return super().along(t, terms, rates, order, shares)


class Told(NamedTuple):
    """What a loop was told: q, dq, ddq and torques (T, n) at live times t; and of the knots between, where jerk jumps,
    (t, q, dq, ddq)."""

    q: np.ndarray
    dq: np.ndarray
    ddq: np.ndarray
    tau: np.ndarray
    t: np.ndarray
    knots: list


class Loop:
    """A robot's loop, which notes what it is told by a live motion."""

    def __init__(self, live):
        self.live, self._command = live, live.command
        self.rows, self.t, self.knots = [], [], []

    def command(self, t):
        before = self.live.now
        out = self._command(t)
        (path, since), now = self.live.path, self.live.now
        self.rows.append(np.stack(out))
        self.t.append(now)
        for knot in since + path.t:
            if before < knot < now:
                self.knots.append((knot, *(x[0] for x in path.sample(knot - since))))
        return out

    @property
    def told(self):
        return Told(*np.swapaxes(np.array(self.rows), 0, 1), np.array(self.t), self.knots)


def drive(live, seconds, wishes=(), every=20, begins=0.0):
    """Run a live motion at 1 kHz from the clock's time `begins` on, planning every so many periods (None: never).

    wishes: (time, call) in order. What was told.
    """
    loop, left = Loop(live), list(wishes)
    for k in range(round(seconds / PERIOD)):
        while left and left[0][0] <= k * PERIOD + 1e-9:
            left.pop(0)[1](live)
        loop.command(begins + k * PERIOD)
        if every and k % every == 0:
            live.plan(PATIENCE)
    return loop.told


def in_turn(*runs):
    """What was told in runs that follow one another."""
    *arrays, knots = zip(*runs, strict=True)
    return Told(*map(np.concatenate, arrays), [*chain(*knots)])


def executed(told):
    """What was told, as one motion: quintic between periods and knots."""
    t, knots = told.t, np.array([at for at, *_ in told.knots])
    far = np.abs(t[:, None] - knots).min(axis=1, initial=np.inf) > APART
    rows = [*zip(t[far], *(x[far] for x in told[:3]), strict=True), *told.knots]
    t, *states = map(np.array, zip(*sorted(rows, key=lambda row: row[0]), strict=True))
    return JointMotion(t - t[0], *states)


def rows_of(problem, told):
    """The largest value of each row along what was told, judged as one motion from its own beginning at rest, without
    any margin; torques by the differences that were told.

    Just before each knot too, where the jerk jumps, and with it what a late command is short of: what a cubic through
    such a jump makes of nodes that are as near as these is wrong by more than what is judged.
    """
    motion = executed(told)
    knots = np.array([knot[0] for knot in told.knots]) - told.t[0]
    t = np.unique(np.concatenate([motion.t, knots[knots > JUST] - JUST]))
    rows = _rows(replace(problem, cases=()), motion, t, motion.jerk(t))
    if problem.cases:  # their filter is a cubic's: it takes what is half way where the jerk jumps
        t = motion.t
        jerk = 0.5 * (motion.jerk(t) + motion.jerk(np.maximum(t - JUST, 0.0)))
        wet = _rows(replace(problem, cases=problem.every_case), motion, t, jerk)
        rows = {name: max(value, rows.get(name, value)) for name, value in wet.items()}
    rate = np.abs(np.diff(told.tau, axis=0) / np.diff(told.t)[:, None])
    return rows | {"torque rate": float((rate / problem.limits.torque_rate).max()) - 1.0}


def _rows(problem, motion, t, jerk):
    """The largest value of each row along a motion, at instants t."""
    if problem.tracking is not None:
        problem = replace(problem, tracking=Linear(**vars(problem.tracking)))
    at = problem.at(t / motion.duration, np.stack([*motion.sample(t), jerk]), motion.duration, imposed=False)
    rounds = int(ROUNDS * max(1.0, 0.5 * motion.duration))
    at = at.knowing(loads=LoadResponses.of(problem.cases, t, at.terms.w, at.response, rounds=rounds))
    constraints = [constraint.near(motion.q[::5]) for constraint in problem.constraints]
    if problem.payload.dynamic and not problem.cases:
        constraints = [constraint for constraint in constraints if not isinstance(constraint, ContactConstraint)]
    return {block.name: float(block.values.max()) for block in evaluate(constraints, at, margins=False)}


def jolts(told):
    """How far posture and velocity are from what the velocity and acceleration before them say, at 1 kHz."""
    q, dq, ddq = told[:3]
    return tuple(
        float(np.abs(np.diff(x, axis=0) - 0.5 * PERIOD * (rate[1:] + rate[:-1])).max())
        for x, rate in ((q, dq), (dq, ddq))
    )


def place(x, y, z):
    """The wish for an object to be there."""
    return lambda live: live.goto((x, y, z))


def halted(live):
    """To rest, and on from there when something else is requested."""
    live.stop()
    return live.resume()


def check(live, states):
    """What must be true of anything that was executed, and then left alone until it rests."""
    worst = rows_of(live.problem, states)
    assert max(worst.values()) <= 0.0, worst
    position, velocity = jolts(states)
    assert position < 1e-5  # rad: no jump; a jerk of 7500 rad/s^3, the most of this arm, makes 6e-7 in a period
    assert velocity < 5e-3  # rad/s: no jump of acceleration by more than that jerk in a period
    assert not np.any(states[1][-1])
    assert not np.any(states[2][-1])


def said(stream, seconds):
    """A stream of twists, 100 a second."""
    return [(t, lambda live, t=t: live.twist(stream(t))) for t in np.arange(0.0, seconds, 0.01)]
