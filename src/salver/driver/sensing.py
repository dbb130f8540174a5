"""Which readings of an arm are plausible. The arm's model stands in for a joint whose reading is not.

A reading is a position and a speed. The reading of a joint is plausible if it

- is possible: finite, near the joint's range, not faster than any joint turns;
- is new: an identical reading tells nothing, and is stale once the model says that the joint moves;
- follows from the model under the torque that acted, or from the reading before it: the position changes by the mean of
  both speeds, whatever the model says, so that an arm that is pushed, held or struck is believed;
- and does so over the last `window` as well, where small steps would add up.

A joint that was not plausible is believed again if it follows from the model, or after `confirmations` readings in a
row that follow from one another near it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from salver.control.arm import ArmState
from salver.errors import SalverError
from salver.geometry import Array, Mask
from salver.models.arm import ArmModel, with_load

if TYPE_CHECKING:
    from salver.models.bodies import Body


@dataclass(frozen=True)
class Plausible:
    """How far a plausible reading may be from what is expected. rad stands for m at prismatic joints.

    outside: rad beyond the maker's range. speed_share: of the maker's speed limit. gap: s between two readings.
    speed_change, acceleration: a speed may differ from the model's by this share of the speed limit, and by this
    acceleration (rad/s^2) times the time between two readings.
    window, drift: s, rad; positions may leave the integral of their speeds by `drift` within a `window`.
    moving: rad/s by the model from which on an identical reading is stale.
    confirmations, away: readings in a row, and rad from the model at most, after which a joint is believed again.
    settling: s within which the torque that an arm is left with has ended.
    speed_unknown: rad/s, the speed limit of a joint whose maker states none.
    """

    outside: float = 0.2
    speed_share: float = 20.0
    gap: float = 1.0
    speed_change: float = 0.1
    acceleration: float = 100.0
    window: float = 0.05
    drift: float = 0.005
    moving: float = 0.01
    confirmations: int = 20
    away: float = 0.3
    settling: float = 0.002
    speed_unknown: float = 10.0


@dataclass(slots=True)
class Sensed:
    """state: measured, or from the model. elapsed: s since the last one. wrong: what was not plausible, or empty."""

    state: ArmState
    elapsed: float
    wrong: str = ""


class Senses:
    """Takes the samples of an arm, one a period.

    blind: periods since the last sample that was plausible in every joint.
    """

    def __init__(
        self,
        arm: ArmModel,
        bodies: Sequence[Body],
        period: float,
        state: ArmState,
        plausible: Plausible = Plausible(),
    ) -> None:
        """state: of the arm before the first sample. Raises SalverError when it is not possible."""
        self._arm, self._period, self._plausible = arm, period, plausible
        self._loaded, limits = with_load(arm, bodies), arm.limits
        self._speed = np.where(np.isfinite(limits.velocity), limits.velocity, plausible.speed_unknown)
        self.blind, self._first = 0, True
        q, dq, wrong = self._numbers(state)
        if wrong := wrong or self._impossible(q, dq)[1]:
            raise SalverError(f"The arm's state cannot be believed: {wrong}.")
        self._believed = self._read = ArmState(q, dq)
        self._drift = np.zeros(arm.n)  # rad by which positions left the integral of their speeds, fading
        self._consistent = np.full(arm.n, plausible.confirmations)  # readings in a row that follow from one another
        self._sure = np.ones(arm.n, dtype=bool)  # whether the last reading was believed

    def take(self, answer: Any, torque: Array) -> Sensed:
        """A robot's (state, elapsed), as it came. torque: (n,) N m that acted since the last one."""
        state, elapsed, late = self._clock(answer)
        q, dq, odd = self._numbers(state)
        possible, impossible = self._impossible(q, dq)
        q, dq = np.where(possible, q, np.nan), np.where(possible, dq, np.nan)
        if not late and (late := self._hasty(q, dq, elapsed)):
            elapsed = self._period
        self._first = False
        model = self._ahead(torque, elapsed)
        good, strange = self._judged(q, dq, model, max(elapsed, self._period))
        self._believed = ArmState(np.where(good, q, model.q), np.where(good, dq, model.dq))
        wrong = late or odd or impossible or strange
        self.blind = self.blind + 1 if wrong else 0
        return Sensed(self._believed, elapsed, wrong)

    def rests(self, state: ArmState, torque: Array, speed: float) -> bool:
        """Whether no joint turns faster, rad/s, nor does within `settling` under this torque (n,)."""
        change = self._plausible.settling * self._acceleration(state.q, state.dq, torque)
        return bool((np.abs(state.dq) + np.abs(change) <= speed).all())

    def _clock(self, answer: Any) -> tuple[Any, float, str]:
        try:
            state, elapsed = answer
            elapsed = float(elapsed)
        except (TypeError, ValueError):
            return None, self._period, "it says nothing"
        least = 0.0 if self._first else 0.5 * self._period
        if not least <= elapsed <= self._plausible.gap:
            return state, self._period, f"its clock says that {elapsed:g} s passed"
        return state, elapsed, ""

    def _hasty(self, q: Array, dq: Array, elapsed: float) -> str:
        """One sentence of a clock that runs ahead: the joints went as far as in one period, and it says more passed."""
        way = 0.5 * (dq + self._believed.dq)
        telling = np.abs(way) * (elapsed - self._period) > self._plausible.drift
        gone = q - self._believed.q
        refuted = 4 * np.abs(gone - way * self._period) < np.abs(gone - way * elapsed)
        if not (telling.any() and refuted[telling].all()):
            return ""
        return f"its clock says that {elapsed:g} s passed, and its joints went as far as in {self._period:g} s"

    def _numbers(self, state: Any) -> tuple[Array, Array, str]:
        try:
            q, dq = np.array(state.q, dtype=float), np.array(state.dq, dtype=float)
        except (TypeError, ValueError, AttributeError):
            q = dq = np.empty(0)
        if q.shape != (self._arm.n,) or dq.shape != (self._arm.n,):
            nothing = np.full(self._arm.n, np.nan)
            return nothing, nothing, "it reports no state of its joints"
        for name, values in (("position", q), ("speed", dq)):
            bad = np.flatnonzero(~np.isfinite(values))
            if len(bad):
                return q, dq, f"the {name} of {self._arm.joint_names[bad[0]]} is {values[bad[0]]}"
        return q, dq, ""

    def _impossible(self, q: Array, dq: Array) -> tuple[Mask, str]:
        """Whether each joint's reading (n,) is possible; one sentence of one that is finite and is not."""
        arm, plausible = self._arm, self._plausible
        outside = np.maximum(arm.limits.q_min - q, q - arm.limits.q_max)
        inside, slow = outside <= plausible.outside, np.abs(dq) <= plausible.speed_share * self._speed
        for j in np.flatnonzero(~inside & np.isfinite(q)).tolist():
            return (
                inside & slow,
                f"{arm.joint_names[j]} is said to be at {q[j]:.4g} {arm.unit(j)}, far outside its range",
            )
        for j in np.flatnonzero(~slow & np.isfinite(dq)).tolist():
            return (
                inside & slow,
                f"{arm.joint_names[j]} is said to move at {dq[j]:.4g} {arm.unit(j)}/s, which it cannot",
            )
        return inside & slow, ""

    def _ahead(self, torque: Array, elapsed: float) -> ArmState:
        """Where the model takes the arm from what was believed."""
        q, dq, most = self._believed.q, self._believed.dq, self._plausible.speed_share * self._speed
        for _ in range(max(1, round(elapsed / self._period))):
            dq = np.clip(dq + self._period * self._acceleration(q, dq, torque), -most, most)
            q = q + self._period * dq
        return ArmState(q, dq)

    def _acceleration(self, q: Array, dq: Array, torque: Array) -> Array:
        return np.asarray(pin.aba(self._loaded.pin_model, self._loaded.data, q, dq, torque))

    def _judged(self, q: Array, dq: Array, model: ArmState, time: float) -> tuple[Mask, str]:
        """Whether the reading (n,) of each joint is plausible, and one sentence of the first that is not. NaN stands
        for what is not possible."""
        plausible, before = self._plausible, self._read
        self._read = ArmState(q, dq)
        step = plausible.speed_change * self._speed + plausible.acceleration * time

        by_model = (np.abs(dq - model.dq) <= step) & (np.abs(q - model.q) <= step * time)
        # Speeds that change within a period leave the position off their mean by up to half the change times the time;
        # a false speed beside a true position by just half. A quarter tells them apart, for changes at mid-period.
        miss = q - before.q - 0.5 * time * (dq + before.dq)
        by_itself = np.abs(miss) <= 0.25 * time * (step + np.abs(dq - before.dq))
        self._consistent = np.where(by_itself, self._consistent + 1, 0)
        self._drift = np.where(np.isfinite(miss), math.exp(-time / plausible.window) * self._drift + miss, 0.0)
        drifts = np.abs(self._drift) > plausible.drift
        confirmed = (self._consistent >= plausible.confirmations) & (np.abs(q - model.q) <= plausible.away)
        follows = (by_model | (by_itself & self._sure) | confirmed) & ~drifts

        # An identical reading tells nothing. The model goes on from the state before it, and shows whether it is stale.
        identical = (q == before.q) & (dq == before.dq)
        stale = identical & (np.abs(model.dq - dq) > plausible.moving)
        good = np.asarray(follows & ~identical)
        self._sure = good | (identical & ~stale)
        bad = ~self._sure
        return good, self._why(q, dq, model, int(np.argmax(bad)), identical) if bad.any() else ""

    def _why(self, q: Array, dq: Array, model: ArmState, j: int, identical: Mask) -> str:
        name, unit = self._arm.joint_names[j], self._arm.unit(j)
        if identical[j]:
            return f"{'it' if identical.all() else name} reports the same state again though it moves"
        return (
            f"{name} is said to be at {q[j]:.5g} {unit} and to move at {dq[j]:.3g} {unit}/s, where "
            f"{model.q[j]:.5g} {unit} and {model.dq[j]:.3g} {unit}/s are expected"
        )
