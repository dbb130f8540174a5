"""Ways to rest: what the loop falls back on when it must not go on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Protocol

import numpy as np
import pinocchio as pin

from salver.control.arm import ArmState
from salver.geometry import Array
from salver.models.arm import ArmModel, with_load

if TYPE_CHECKING:
    from salver.models.bodies import Body

STOP_GAINS = (200.0, 28.0)  # 1/s^2, 1/s of the cool stop, in every joint
STOP_SHARE = 0.8  # of the maker's acceleration: what is on the tray may go, the arm must not go far
LEAST_STOP_TIME = 0.15  # s
HOLD_AFTER_STOP = 0.25  # s


class Stop(Protocol):
    """From a moving state to rest. What it returns still passes the loop's gate (`salver.driver.gate`)."""

    @property
    def keeps_load(self) -> bool:
        """Whether what lies loose on the tray surely stays there."""
        ...

    @property
    def duration(self) -> float:
        """s from its beginning until the arm rests and torque control may end."""
        ...

    def step(self, state: ArmState, s: float) -> Array:
        """Torque (n,), N m, for a state a time s after it began."""
        ...


StopFrom = Callable[[ArmState, float], Stop]
"""The stop from a state that can be believed, at time t of the motion, s."""


def cool_stops(arm: ArmModel, bodies: Sequence[Body]) -> StopFrom:
    """Cool stops of an arm with its load, whatever the state."""
    loaded = with_load(arm, bodies)
    return lambda state, t: CoolStop(loaded, state)


class CoolStop:
    """Brings the arm to rest from any state, smoothly and within a share of its acceleration, and holds it there.

    The velocity of every joint goes to zero along a quintic step, so neither acceleration nor torque jumps. It asks
    nothing of the contact: what lies on the tray may slide or fall.
    """

    keeps_load = False

    def __init__(self, loaded: ArmModel, state: ArmState) -> None:
        """loaded: the arm with what it carries (`salver.models.arm.with_load`)."""
        self._model, self._data = loaded.pin_model, loaded.data
        self._q, self._dq = state.q.copy(), state.dq.copy()
        needed = 1.875 * np.abs(self._dq) / (STOP_SHARE * loaded.limits.acceleration)  # the step's steepest slope
        self.braking = max(LEAST_STOP_TIME, float(np.max(np.where(np.isfinite(needed), needed, 0.0))))

    @property
    def duration(self) -> float:
        return self.braking + HOLD_AFTER_STOP

    def reference(self, s: float) -> tuple[Array, Array, Array]:
        """(q, dq, ddq) a time s after the stop began."""
        x = min(max(s / self.braking, 0.0), 1.0)
        left = 1 - x**3 * (10 - 15 * x + 6 * x**2)
        slope = -30 * x**2 * (1 - x) ** 2 / self.braking
        area = self.braking * (x - x**4 * (2.5 - 3 * x + x**2))
        return self._q + area * self._dq, left * self._dq, slope * self._dq

    def step(self, state: ArmState, s: float) -> Array:
        q, dq, ddq = self.reference(s)
        kp, kd = STOP_GAINS
        wanted = ddq + kp * (q - state.q) + kd * (dq - state.dq)
        return np.asarray(pin.rnea(self._model, self._data, state.q, state.dq, wanted)).copy()
