"""Jogging without protection: a servo that keeps the arm's limits and knows nothing of the load.

As in usual jogging, joints follow a velocity of the tray by the damped pseudo-inverse of the Jacobian, cut to the
joints' velocities and accelerations. The tray is kept level.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from salver.geometry import Array
from salver.models.arm.arm import ArmModel


@dataclass(frozen=True)
class Jogging:
    """Options of jogging without protection.

    response: time, s, to reach a velocity, if accelerations allow. damping: of the pseudo-inverse. levelling: gain that
    keeps the tray level, 1/s. approach, fastest: deceleration, m/s^2, before a goal, and speed, m/s, towards it. room:
    rad kept free before the end of a joint's range.
    """

    response: float = 0.02
    damping: float = 1e-2
    levelling: float = 10.0
    approach: float = 8.0
    fastest: float = 2.0
    room: float = 0.02


class Unprotected:
    """The jogged arm with state q, dq (n,); `step` advances it."""

    def __init__(self, arm: ArmModel, q: Array, dq: Array, jogging: Jogging | None = None) -> None:
        self._arm, self._jogging = arm, jogging or Jogging()
        self.q, self.dq, self.ddq = q.copy(), dq.copy(), np.zeros_like(q)

    def towards(self, p_SE: Array) -> Array:
        """The velocity (3,), m/s in S, of the tray's centre towards the goal p_SE (3,), m."""
        away = p_SE - self._arm.tray_pose(self.q)[0]
        distance = float(np.linalg.norm(away))
        if distance < 1e-6:
            return np.zeros(3)
        how = self._jogging
        speed = min(how.fastest, np.sqrt(2 * how.approach * distance), distance / (2 * how.response))
        return np.asarray(away * (speed / distance))

    def step(self, v_S: Array, omega_S: Array, dt: float) -> None:
        """Advance by dt, s, with the tray moving at v_S, m/s, and turning at omega_S, rad/s, as far as the arm can."""
        arm, how = self._arm, self._jogging
        _, R_SE = arm.tray_pose(self.q)
        jacobian = arm.body_jacobian(self.q)
        level_E = how.levelling * np.cross([0.0, 0.0, 1.0], R_SE[2])  # R_SE[2]: the vertical, in E
        twist_E = np.concatenate([R_SE.T @ v_S, R_SE.T @ omega_S + level_E])
        self.turn(jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + how.damping**2 * np.eye(6), twist_E), dt)

    def turn(self, dq: Array, dt: float) -> None:
        """Advance by dt, s, with the joints moving at dq (n,), rad/s, as far as they can."""
        limits, how = self._arm.limits, self._jogging
        dq = dq / max(1.0, float((np.abs(dq) / limits.velocity).max()))
        # So fast at most that it can still brake before a joint's end, which it begins to do `response` later.
        most = np.where(np.isfinite(limits.acceleration), limits.acceleration, 1e3)
        left = np.maximum([self.q - limits.q_min - how.room, limits.q_max - how.room - self.q], 0.0)
        down, up = most * (np.sqrt(how.response**2 + 2 * left / most) - how.response)
        dq = np.clip(dq, -down, up)
        self.ddq = np.clip((dq - self.dq) / how.response, -most, most)
        self.q = self.q + dt * self.dq + 0.5 * dt**2 * self.ddq
        self.dq = self.dq + dt * self.ddq
