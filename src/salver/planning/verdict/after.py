"""The load after the end of a motion: on a tray that leans a liquid pushes more when it has swung back than when
the tray stopped."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from salver.geometry import Array
from salver.planning.trajopt.constraints.constraints import ContactConstraint, evaluate
from salver.planning.trajopt.constraints.load_limits import LoadConstraint
from salver.planning.trajopt.evaluation import MotionEvaluation
from salver.planning.trajopt.problem import TransportProblem

HOLD_STEP = 1e-2  # s between nodes of an arm at rest


def stays(problem: TransportProblem, t: Array, z: Array) -> bool:
    """Whether what is carried stays, and what is in it, to the edge of their rows: along a motion z (4, P, n) at t (P,)
    s, from 0 on, and at rest at its end for a period of the slowest load. With one instant: at rest there, with the
    modal states that there are."""
    carried = [
        constraint for constraint in problem.constraints if isinstance(constraint, ContactConstraint | LoadConstraint)
    ]
    blocks = evaluate(carried, _rested(problem, t, z), margins=False)
    return all(block.values.max() <= 0 for block in blocks if len(block.points) > 1)  # but for what is left for good


def standing_still(problem: TransportProblem, q: Array, seconds: float) -> MotionEvaluation:
    """The arm at rest in a posture (n,) for so long, s, from the deviation and the modal states with which the problem
    begins."""
    z = np.zeros((4, max(5, int(np.ceil(seconds / HOLD_STEP)) + 1), problem.n))
    z[0] = q
    return problem.at(np.linspace(0.0, 1.0, z.shape[1]), z, seconds)


def calmer(problem: TransportProblem, t: Array, z: Array) -> TransportProblem:
    """The problem with so much less of a swing left after it that contact lasts at the end of a motion z (4, P, n) at
    t (P,), s, which loses it there: what a swing adds to the rows grows with it. As given, if none is to blame."""
    still = np.zeros_like(z)
    still[0] = z[0, -1]
    moved, stood = _rested(problem, t, z), _rested(problem, t, still)
    most, without = (_contact(problem, motion)[len(t) :].max() for motion in (moved, stood))
    if not without < 0.0 < most:
        return problem
    limits = [limit for each in moved.loads.values() for part in each for limit in part.limits() if limit.residual]
    left = max((float((limit.values / limit.most[:, None]).max()) for limit in limits), default=0.0)
    if left == 0.0:
        return problem
    return replace(problem, calm=0.9 * left * without / (without - most))  # rows are not quite linear in the swing


def _contact(problem: TransportProblem, motion: MotionEvaluation) -> Array:
    """(N,) largest row of all contacts at the nodes, with the margin that is asked for."""
    rows = [ContactConstraint(rows, problem.scenario.contact.margin) for rows in problem.contacts]
    return np.max([block.values.max(axis=1) for block in evaluate(rows, motion)], axis=0)


def _rested(problem: TransportProblem, t: Array, z: Array) -> MotionEvaluation:
    """A motion and a period of rest after it."""
    instants = 40  # of one period: the peak between two of them is missed by 0.3 %
    rest = np.zeros((4, instants, problem.n))
    rest[0] = z[0, -1]
    t = np.concatenate([t, t[-1] + np.arange(1, instants + 1) * (problem.payload.slowest_period / instants)])
    return problem.at(t / t[-1], np.concatenate([z, rest], axis=1), float(t[-1]), imposed=False)
