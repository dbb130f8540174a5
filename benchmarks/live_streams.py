"""Streams of twists that a hand or a policy may send, and what a filter makes of them that knows of no load."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import salver as sv
from live_runs import PERIOD
from salver.live import Live
from salver.planning.fastest import TransportProblem, evaluate
from salver.trajectory import JointMotion

SECONDS = 1.5  # of a stream
SPARED = 0.2  # of what contact keeps at rest, that a gentle stream leaves, followed as it is told


def gentle(rng: np.random.Generator, seconds: float = SECONDS):
    rate, phase = rng.uniform(0.5, 3.0, 3), rng.uniform(0, 6, 3)
    return lambda t: np.array([0.12, 0.15, 0.05]) * (np.sin(rate * t + phase) - (1 - min(t, 0.4) / 0.4) * np.sin(phase))


def hostile(rng: np.random.Generator, seconds: float = SECONDS):
    """Another velocity every 0.13 s."""
    speeds = rng.uniform(-1.3, 1.3, (max(40, int(seconds / 0.13) + 1), 3)) * [1, 1, 0.4]
    return lambda t: speeds[int(t / 0.13)]


def noise(rng: np.random.Generator, seconds: float = SECONDS):
    """Of up to 5 Hz."""
    rate, phase = 2 * np.pi * rng.uniform(0.5, 5.0, (6, 3)), rng.uniform(0, 6, (6, 3))
    return lambda t: np.array([0.4, 0.4, 0.15]) * np.sin(rate * t + phase).sum(axis=0)


def gaps(rng: np.random.Generator, seconds: float = SECONDS):
    """Velocities, and times at which nothing is said."""
    speeds, silent = hostile(rng, seconds), rng.random(max(40, int(seconds / 0.09) + 1)) < 0.4
    return lambda t: None if silent[int(t / 0.09)] else speeds(t)


STREAMS = {"gentle twists": gentle, "hostile twists": hostile, "noise up to 5 Hz": noise, "twists with gaps": gaps}


def spared(problem: TransportProblem, q: np.ndarray, told, seconds: float) -> float:
    """The largest row of a stream that is followed as it is told, with the tray level; of contact, with a share of what
    it is at rest left over."""
    arm, step = problem.arm, 5e-3
    level, rows = arm.tray_pose(q)[1], []
    for t in np.arange(0.0, seconds, step):
        R = arm.tray_pose(q)[1]
        turned = 0.5 * sum(np.cross(R[:, i], level[:, i]) for i in range(3))
        dq = np.linalg.pinv(arm.body_jacobian(q)) @ np.concatenate([R.T @ told(t), R.T @ (5.0 * turned)])
        rows.append((q, dq))
        q = q + step * dq
    q_all, dq_all = map(np.array, zip(*rows, strict=True))
    ddq = np.gradient(dq_all, step, axis=0)
    z = np.stack([q_all, dq_all, ddq, np.gradient(ddq, step, axis=0)])
    s = np.linspace(0.0, 1.0, len(rows))
    constraints = [constraint.near(q_all[::5]) for constraint in problem.constraints]
    still = np.zeros_like(z[:, :5])
    still[0] = q_all[0]
    at_rest, moving = (
        evaluate(constraints, replace(problem.at(at, states, step * (len(s) - 1), imposed=False), moving=False))
        for at, states in ((s[:5], still), (s, z))
    )
    left = [SPARED * float(a.values.max()) if a.name.startswith("contact") else 0.0 for a in at_rest]
    along = ((b, x) for b, x in zip(moving, left, strict=True) if len(b.values) > 20)  # and not after it
    return max(float(b.values[20:].max()) - x for b, x in along)


def within(x: np.ndarray, limit: np.ndarray) -> np.ndarray:
    return x * min(1.0, float(np.min(limit / np.maximum(np.abs(x), 1e-12))))


def clipped(problem: TransportProblem, q: np.ndarray, told, seconds: float) -> JointMotion:
    """What a filter makes of a stream that keeps the tray's orientation and the joints' own limits of position, speed,
    acceleration and jerk, and knows of no load: velocities by the Jacobian's pseudo-inverse, at 1 kHz; what is beyond a
    limit is made shorter, all joints alike."""
    arm, limits = problem.arm, problem.limits
    dq, ddq = np.zeros_like(q), np.zeros_like(q)
    level, rows = arm.tray_pose(q)[1], [(q, dq, ddq)]
    for k in range(round((seconds + 0.8) / PERIOD)):
        t = k * PERIOD
        v = told(round(t, 2)) if t < seconds - 0.011 else None
        R = arm.tray_pose(q)[1]
        turned = 0.5 * sum(np.cross(R[:, i], level[:, i]) for i in range(3))  # rad, to where it should be, in S
        wanted = np.concatenate([R.T @ (np.zeros(3) if v is None else v), R.T @ (5.0 * turned)])
        asked = np.linalg.pinv(arm.body_jacobian(q), rcond=1e-2) @ wanted
        room = np.sqrt(np.maximum(limits.acceleration * np.stack([limits.q_max - q, q - limits.q_min]), 0.0))
        asked = within(asked, np.minimum(limits.velocity, np.where(asked > 0, *room)))
        ddq = ddq + within(within((asked - dq) / 0.02, limits.acceleration) - ddq, limits.jerk * PERIOD)
        q, dq = q + PERIOD * dq + 0.5 * PERIOD**2 * ddq, dq + PERIOD * ddq
        rows.append((q, dq, ddq))
    q_all, dq_all, ddq_all = map(np.array, zip(*rows, strict=True))
    dq_all[-1] = ddq_all[-1] = 0.0
    return JointMotion(PERIOD * np.arange(len(q_all)), q_all, dq_all, ddq_all)


def stream(scenario: sv.Scenario, kind: str, rng: np.random.Generator, seconds: float):
    """One of a kind; a gentle one can be followed as it is told, with some of the contact to spare."""
    if not kind.startswith("gentle"):
        return STREAMS[kind](rng, seconds)
    live = Live(scenario)
    while True:
        told = gentle(rng, seconds)
        if spared(live.problem, live.committed.motion.q[0], told, seconds) <= 0.0:
            return told
