"""Simulation in the frame of a moving tray: its motion acts on the objects as inertial forces.

Without an arm the tray follows the reference exactly. Moving a body by forces in a physics engine is never exact, and
MuJoCo's contacts ignore the velocity of a body whose pose is set; both are avoided by simulating in frame E, where the
tray is at rest. E has the acceleration a_E (of its origin, in E), angular velocity omega and angular acceleration
alpha. On a body of mass m and inertia I about its centre of mass c, with velocity v and angular velocity w in E, act
besides the contact forces (Landau and Lifshitz, Mechanics, section 39, and likewise for Euler's equation):

    f   = m (g_E - a_E - alpha x c - omega x (omega x c) - 2 omega x v)
    tau = - I (alpha + omega x w) - (omega + w) x I (omega + w) + w x I w
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from salver.geometry import GRAVITY_S, Array, hat
from salver.trajectory import MotionSamples


@dataclass(frozen=True)
class TrayMotion:
    """Motion of frame E at N instants, in E.

    specific (N, 3): g_E - a_E. omega, alpha (N, 3). turn (N, 3, 3): hat(omega). pull (N, 3, 3): hat(alpha) +
    hat(omega)^2. turns: whether omega or alpha is ever nonzero.
    """

    specific: Array
    omega: Array
    alpha: Array
    turn: Array
    pull: Array
    turns: bool

    def felt_at(self, k: int, p: Array, v: Array) -> Array:
        """Inertial and gravitational acceleration (3,) at instant k of a point at p (3,) with velocity v (3,) in E."""
        return self.specific[k] - self.pull[k] @ p - 2 * (self.turn[k] @ v)

    @classmethod
    def of(cls, motion: MotionSamples) -> TrayMotion:
        specific = np.einsum("tji,tj->ti", motion.R_SB, GRAVITY_S - motion.a_S)
        turn = hat(motion.omega_B)
        pull = hat(motion.alpha_B) + turn @ turn
        turns = bool(np.any(motion.omega_B) or np.any(motion.alpha_B))
        return cls(specific, motion.omega_B, motion.alpha_B, turn, pull, turns)


def apply(
    motion: TrayMotion, k: int, model: Any, data: Any, object_ids: Array, qvel_ids: Array, point_ids: Iterable[int] = ()
) -> None:
    """Set the inertial forces of instant k on the objects, and on bodies that are point masses.

    Poses and velocities in `data` must be current.
    """
    wrench = data.xfrc_applied
    for i in point_ids:
        root = data.subtree_com[model.body_rootid[i]]
        v = data.cvel[i, 3:] + np.cross(data.cvel[i, :3], data.xipos[i] - root)
        wrench[i, :3] = model.body_mass[i] * motion.felt_at(k, data.xipos[i], v)
    if not motion.turns:
        for i in object_ids:
            wrench[i, :3] = model.body_mass[i] * motion.specific[k]
        return
    specific, omega, alpha = motion.specific[k], motion.omega[k], motion.alpha[k]
    turn, pull = motion.turn[k], motion.pull[k]
    for i, j in zip(object_ids, qvel_ids, strict=True):
        c = data.xipos[i]
        w = data.xmat[i].reshape(3, 3) @ data.qvel[j + 3 : j + 6]
        v = data.qvel[j : j + 3] + _cross(w, c - data.xpos[i])
        axes = data.ximat[i].reshape(3, 3)
        inertia = (axes * model.body_inertia[i]) @ axes.T
        wrench[i, :3] = model.body_mass[i] * (specific - pull @ c - 2 * (turn @ v))
        # (omega + w) x I (omega + w) - w x I w, without the terms that cancel
        spin = turn @ (inertia @ (omega + w)) - _cross(inertia @ omega, w)
        wrench[i, 3:] = -(inertia @ (alpha + turn @ w)) - spin


def _cross(a: Array, b: Array) -> tuple[float, float, float]:
    """Cross product of two vectors (3,); ten times faster than np.cross, which matters at every engine step."""
    (x, y, z), (u, v, w) = a.tolist(), b.tolist()
    return y * w - z * v, z * u - x * w, x * v - y * u
