"""Constraints by load dynamics, for example that a liquid stays below its brim."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from salver.dynamics.load_limits import LoadLimit
from salver.dynamics.load_rows import of_parts
from salver.dynamics.motion_gradients import Unknowns
from salver.geometry import Array, Indices
from salver.models.bodies import Body
from salver.models.tray_motion import FULL_SPEED, Speed
from salver.planning.trajopt.constraints.constraints import FINEST, Block, Constraint, ContactConstraint, History
from salver.planning.trajopt.evaluation import MotionEvaluation


@dataclass(frozen=True, eq=False)
class LoadConstraint(Constraint):
    """Limits of a body's inner dynamics (`LoadResponse.limits`), during the motion and after it, in all cases; rows are
    in units of the room up to the limit. speed: factor above 0. spare: share of the room that is kept free below full
    speed, for speed factors between the constrained ones."""

    body: Body
    speed: Speed = FULL_SPEED
    spare: float = 2e-3

    def blocks(self, motion: MotionEvaluation) -> Iterator[Block]:
        parts = motion.at_factor(self.speed.factor).loads[self.body.name]
        for each in zip(*(part.limits() for part in parts), strict=True):
            yield self._block(motion, each)

    def _block(self, motion: MotionEvaluation, each: Sequence[LoadLimit]) -> Block:
        """Rows of one kind of limit, for all cases one after the other."""
        name, counts = each[0].name, [len(part.most) for part in each]
        most = np.concatenate([part.most for part in each]) * (1.0 if self.speed.factor == 1.0 else 1.0 - self.spare)

        def history(i: Indices, f: Indices, unknowns: Unknowns) -> Array:
            found = np.zeros((len(i), unknowns.felt.shape[2]))
            for k, case, mine in of_parts(counts, f):
                found[mine] = each[k].by(case, i[mine], unknowns)
            return found / most[f, None]

        block = Block(
            f"{name} in {self.body.name}{self.speed.words}",
            (np.concatenate([part.values for part in each]) / most[:, None] - 1).T,
            lambda i, f: np.zeros((len(i), 4 * motion.n)),
            motion.nodes,
            margins=(5e-3, FINEST),  # the modes' excitation is interpolated between nodes
            history=history,
            kinked=True,
            most=2 if len(motion.loads) < 2 else 1,  # rows of similar cases are similar
            reach=0.1,
            factor=self.speed.factor,
        )
        if len(block.values) > 1:
            return block
        # The whole motion contributes to the residual swing.
        return block.having(points=motion.nodes[-1:], margins=(0.03, FINEST), most=None, reach=np.inf)


@dataclass(frozen=True, eq=False)
class AtRest(Constraint):
    """A constraint in the rest after a motion, while load dynamics and the arm settle: its rows with a value at each
    instant. They depend on the final states and posture of the motion."""

    of: ContactConstraint | LoadConstraint

    def blocks(self, motion: MotionEvaluation) -> Iterator[Block]:
        whole = motion.at_factor(self.of.speed.factor)
        for block in replace(self.of, speed=FULL_SPEED).blocks(whole.rest):
            if len(block.values) > 1:
                yield block.having(
                    name=f"{block.name}{self.of.speed.words} after the motion",
                    points=np.full(len(block.values), motion.nodes[-1]),
                    gradient=partial(_of_posture, block),
                    history=block.history and partial(_of_states, block.history, whole),
                    inherits=False,
                    factor=self.of.speed.factor,
                )


def _of_posture(block: Block, i: Indices, f: Indices) -> Array:
    """Derivatives (r, 4 n) of rows at rest by z of the last node: only the posture counts."""
    rows = block.gradient(i, f)
    rows[:, rows.shape[1] // 4 :] = 0.0
    return rows


def _of_states(history: History, motion: MotionEvaluation, i: Indices, f: Indices, unknowns: Unknowns) -> Array:
    """Derivatives of rows at rest by unknowns of the motion before it."""
    pairs = [(motion.rest.loads[name][0].planned, parts[0].planned) for name, parts in motion.loads.items()]
    return history(i, f, unknowns.after(pairs))
