"""Via poses: poses that are passed without a stop, at a free time.

Rows are the error at the motion's closest approach to the pose. There the error along the motion is zero, and the rest,
across the motion, does not change to first order with the time of passing: that time need not be a variable.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from salver.geometry import Array, Indices
from salver.models.arm.arm import ArmModel
from salver.planning.postures import PoseTarget
from salver.planning.trajopt.constraints.constraints import REACH_BEYOND_TRAY, Block, Constraint
from salver.planning.trajopt.evaluation import MotionEvaluation

WEIGHTS = np.array([1.0] * 3 + [REACH_BEYOND_TRAY] * 3)


@dataclass(frozen=True, eq=False)
class Closest:
    """The closest approach of a motion, cubic between two nodes, to a pose.

    node: the first of the two. error (r,): weighted, m. across (r, r): projection that removes the part along the
    motion. by_q (r, n): derivative of the error. by: derivatives of q there by (q, dq) at the first and second node.
    """

    node: int
    error: Array
    across: Array
    by_q: Array
    by: tuple[tuple[float, float], tuple[float, float]]

    @classmethod
    def of(cls, arm: ArmModel, target: PoseTarget, t: Array, q: Array, dq: Array) -> Closest:
        """The closest approach of a motion with instants t (N,), s, and states q, dq (N, n) at the nodes."""
        sizes = [float(np.linalg.norm(_weighted(arm, target, x)[0])) for x in q]
        best = int(np.argmin(sizes))
        found: list[tuple[float, Closest]] = []
        for node in (best - 1, best):
            if not 0 <= node < len(t) - 1:
                continue
            step = float(t[node + 1] - t[node])
            ends = np.stack([q[node], dq[node], q[node + 1], dq[node + 1]])
            looks = np.linspace(0.0, 1.0, 9)
            u = float(min(looks, key=lambda x: np.linalg.norm(_weighted(arm, target, _blend(x, step)[0] @ ends)[0])))
            for _ in range(3):  # Newton steps from within an eighth of a step, with quadratic convergence
                value, slope = _blend(u, step)
                error, jacobian = _weighted(arm, target, value @ ends)
                along = jacobian @ (slope @ ends)
                u = float(np.clip(u - along @ error / max(float(along @ along), 1e-12), 0.0, 1.0))
            value, slope = _blend(u, step)
            error, jacobian = _weighted(arm, target, value @ ends)
            along = jacobian @ (slope @ ends)
            square = float(along @ along)
            across = np.eye(len(error)) - (np.outer(along, along) / square if square > 1e-12 else 0.0)
            by = ((float(value[0]), float(value[1])), (float(value[2]), float(value[3])))
            found.append((float(np.linalg.norm(error)), cls(node, error, across, jacobian, by)))
        return min(found, key=lambda each: each[0])[1]


def _weighted(arm: ArmModel, target: PoseTarget, q: Array) -> tuple[Array, Array]:
    """Weighted pose error at a posture, m, and its derivative by q."""
    error, jacobian = target.residual(arm, q)
    weights = WEIGHTS[: len(error)]
    return weights * error, -weights[:, None] * jacobian


def _blend(u: float, step: float) -> tuple[Array, Array]:
    """Weights (4,) of the cubic through two states: of its value, by q and dq of the first and of the second; and of
    its slope by u."""
    value = [1 - 3 * u**2 + 2 * u**3, step * (u - 2 * u**2 + u**3), 3 * u**2 - 2 * u**3, step * (u**3 - u**2)]
    slope = [6 * u**2 - 6 * u, step * (1 - 4 * u + 3 * u**2), 6 * u - 6 * u**2, step * (3 * u**2 - 2 * u)]
    return np.array(value), np.array(slope)


@dataclass(frozen=True, eq=False)
class PassPose(Constraint):
    """The motion passes a pose, to within `salver.planning.verification.NEAR_ENOUGH`. name: of the rows.

    allowed: m, tolerance of each of six rows; together they pass the plan's check. scale: m, of the rows.
    """

    arm: ArmModel
    target: PoseTarget
    name: str
    allowed: float = 4e-4
    scale: float = 1e-2

    def blocks(self, motion: MotionEvaluation) -> Iterator[Block]:
        n, nodes = motion.n, motion.nodes
        t = motion.s[nodes] * motion.duration
        at = Closest.of(self.arm, self.target, t, *motion.at_nodes[:2])
        left, by_q = at.across @ at.error, at.across @ at.by_q
        signed = np.vstack([by_q, -by_q]) / self.scale
        values = (np.concatenate([left, -left]) - self.allowed) / self.scale

        def by_state(which: int, row: Indices) -> Array:
            out = np.zeros((len(row), 4 * n))
            for order in range(2):
                out[:, order * n : (order + 1) * n] = at.by[which][order] * signed[row]
            return out

        rates = sum(at.by[k][1] * motion.at_nodes[1, at.node + k] for k in range(2))
        yield Block(
            self.name,
            values[None],
            lambda node, row: by_state(0, row),
            nodes[at.node : at.node + 2],
            scales=False,
            following=lambda node, row: by_state(1, row),
            by_duration=(signed @ rates)[None],
            always=True,
            slows=0.0,
            in_words=lambda excess: f"{1e3 * self.scale * excess:.3g} mm",
        )
