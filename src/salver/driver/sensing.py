"""What is believed of the arm: every sample is checked, and one that cannot be is bridged by the model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from salver.control.arm import ArmState
from salver.errors import SalverError
from salver.geometry import Array
from salver.models.arm import ArmModel, with_load

if TYPE_CHECKING:
    from salver.models.bodies import Body

LONGEST_GAP = 1.0  # s; a clock that says that more passed since the last sample is wrong
OUTSIDE = 0.2  # rad beyond the maker's range that a sensor may report
TOO_FAST = 2.0  # times the maker's speed limit: no joint turns like that
STRAY = 2.0  # times the way at the speed limit: farther from where the last sample leads a joint cannot be,
JOLT = 0.1  # and its speed cannot differ by more than this share of the limit
STRONGEST = 100.0  # and as much as at this acceleration, rad/s^2; nor can it from how far the joint really went
MOVING = 0.01  # rad/s; faster than this no two samples are the same
UNKNOWN_SPEED = 10.0  # rad/s, where no maker's limit is known


@dataclass(slots=True)
class Sensed:
    """state: measured, or bridged. elapsed: s since the last one. wrong: why it was bridged; empty when it was not."""

    state: ArmState
    elapsed: float
    wrong: str = ""


class Senses:
    """Takes the samples of an arm, one a period. blind: periods since the last one that could be believed."""

    def __init__(self, arm: ArmModel, bodies: Sequence[Body], period: float, state: ArmState) -> None:
        """state: of the arm before the first sample. Raises SalverError when it is none."""
        self._arm, self._period = arm, period
        loaded = with_load(arm, bodies)
        self._model, self._data = loaded.pin_model, loaded.data
        self._speed = np.where(np.isfinite(arm.limits.velocity), arm.limits.velocity, UNKNOWN_SPEED)
        self._believed, self.blind, self._first = state, 0, True
        q, dq, wrong = self._numbers(state)
        if wrong or (wrong := self._impossible(q, dq)):
            raise SalverError(f"The arm's state cannot be believed: {wrong}.")
        self._believed = self._heard = ArmState(q, dq)
        self._unheard = 0.0  # s since the last sample with numbers in it

    def take(self, answer: Any, torque: Array) -> Sensed:
        """A robot's (state, elapsed), as it came. torque: (n,) that acted since the last one."""
        elapsed, wrong = self._clock(answer)
        q = dq = self._believed.q
        if not wrong:
            q, dq, wrong = self._numbers(answer[0])
        self._unheard += max(elapsed, self._period)
        if not wrong:
            wrong = self._impossible(q, dq) or self._stuck(q, dq) or self._astray(q, dq, elapsed)
            self._heard, self._unheard = ArmState(q, dq), 0.0
        self._first = False
        if wrong:
            self.blind += 1
            self._believed = self._bridged(torque, elapsed)
        else:
            self.blind = 0
            self._believed = ArmState(q, dq)
        return Sensed(self._believed, elapsed, wrong)

    def _clock(self, answer: Any) -> tuple[float, str]:
        try:
            _, elapsed = answer
            elapsed = float(elapsed)
        except (TypeError, ValueError):
            return self._period, "it says nothing"
        least = 0.0 if self._first else 0.5 * self._period
        if not least <= elapsed <= LONGEST_GAP:
            return self._period, f"its clock says that {elapsed:g} s passed"
        return elapsed, ""

    def _numbers(self, state: Any) -> tuple[Array, Array, str]:
        try:
            q, dq = np.array(state.q, dtype=float), np.array(state.dq, dtype=float)
        except (TypeError, ValueError, AttributeError):
            q = dq = np.empty(0)
        if q.shape != (self._arm.n,) or dq.shape != (self._arm.n,):
            return q, dq, "it reports no state of its joints"
        for name, values in (("position", q), ("speed", dq)):
            bad = np.flatnonzero(~np.isfinite(values))
            if len(bad):
                return q, dq, f"the {name} of {self._arm.joint_names[bad[0]]} is {values[bad[0]]}"
        return q, dq, ""

    def _impossible(self, q: Array, dq: Array) -> str:
        limits = self._arm.limits
        outside = np.maximum(limits.q_min - q, q - limits.q_max)
        j = int(np.argmax(outside))
        if not outside[j] <= OUTSIDE:
            return f"{self._arm.joint_names[j]} is said to be at {q[j]:.4g} rad, far outside its range"
        j = int(np.argmax(np.abs(dq) / self._speed))
        if not abs(dq[j]) <= TOO_FAST * self._speed[j]:
            return f"{self._arm.joint_names[j]} is said to turn at {dq[j]:.4g} rad/s, which it cannot"
        return ""

    def _stuck(self, q: Array, dq: Array) -> str:
        same = np.array_equal(q, self._heard.q) and np.array_equal(dq, self._heard.dq)
        return "it reports the same state again though it moves" if same and np.abs(dq).max() > MOVING else ""

    def _astray(self, q: Array, dq: Array, elapsed: float) -> str:
        """Against what is believed. The longer that is the model's word, the farther off it may be; two samples that
        agree with each other are then believed from farther away."""
        time = max(elapsed, self._period)
        wrong = self._jump(q, dq, self._believed, time, 1) or self._contradiction(q, dq, self._believed, time)
        if not wrong or not self.blind:
            return wrong
        again = self._jump(q, dq, self._believed, time, 1 + self.blind)
        return wrong if again or self._contradiction(q, dq, self._heard, self._unheard) else ""

    def _jump(self, q: Array, dq: Array, last: ArmState, time: float, times: int) -> str:
        allowed = times * STRAY * self._speed * time
        off = np.abs(q - last.q - time * last.dq)
        j = int(np.argmax(off / allowed))
        if not off[j] <= allowed[j]:
            return f"{self._arm.joint_names[j]} is said to have jumped by {off[j]:.2g} rad"
        allowed = times * (JOLT * self._speed + STRONGEST * time)
        off = np.abs(dq - last.dq)
        j = int(np.argmax(off / allowed))
        if not off[j] <= allowed[j]:
            return f"the speed of {self._arm.joint_names[j]} is said to have jumped by {off[j]:.2g} rad/s"
        return ""

    def _contradiction(self, q: Array, dq: Array, last: ArmState, time: float) -> str:
        """Speeds must be those at which the positions change."""
        allowed = JOLT * self._speed + STRONGEST * time
        off = np.abs((q - last.q) / time - 0.5 * (dq + last.dq))
        j = int(np.argmax(off / allowed))
        if not off[j] <= allowed[j]:
            return f"{self._arm.joint_names[j]} is said to turn at {dq[j]:.3g} rad/s and goes elsewhere"
        return ""

    def _bridged(self, torque: Array, elapsed: float) -> ArmState:
        """Where the model takes the arm from the last state that was believed."""
        q, dq = self._believed.q.copy(), self._believed.dq.copy()
        for _ in range(max(1, round(elapsed / self._period))):
            dq = dq + self._period * pin.aba(self._model, self._data, q, dq, torque)
            dq = np.clip(dq, -TOO_FAST * self._speed, TOO_FAST * self._speed)
            q = q + self._period * dq
        return ArmState(q, dq)
