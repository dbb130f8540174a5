"""What is carried once a motion is over: on a tray that leans a liquid pushes more when it has swung back than when the
tray stopped."""

from __future__ import annotations

import numpy as np

from salver.geometry import Array
from salver.planning.fastest.brim import Brim
from salver.planning.fastest.constraints import Contact, evaluate
from salver.planning.fastest.problem import TransportProblem

WATCHED = 40  # instants of a wave


def stays(problem: TransportProblem, t: Array, z: Array) -> bool:
    """Whether what is carried stays, and what is in it, to the edge of their rows: along a motion z (4, P, n) at t (P,)
    s, from 0 on, and at rest at its end for a wave of the slowest liquid. With one instant: at rest there, with the
    waves that there are."""
    liquids = [body.liquid for body in problem.payload.liquids if body.liquid is not None]
    slowest = min(float(liquid.modes(liquid.fill).omega.min()) for liquid in liquids)
    rest = np.zeros((4, WATCHED, problem.n))
    rest[0] = z[0, -1]
    t = np.concatenate([t, t[-1] + np.arange(1, WATCHED + 1) * (2 * np.pi / slowest / WATCHED)])
    motion = problem.at(t / t[-1], np.concatenate([z, rest], axis=1), float(t[-1]), imposed=False)
    carried = [constraint for constraint in problem.constraints if isinstance(constraint, Contact | Brim)]
    blocks = evaluate(carried, motion, margins=False)
    return all(block.values.max() <= 0 for block in blocks if len(block.points) > 1)  # but for what is left for good
