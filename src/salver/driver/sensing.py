"""Plausibility of an arm's readings. A reading that cannot be true stops the arm (`salver.driver.execution`).

A reading is a position and a speed. The reading of a joint is plausible if

- it is possible: finite, near the joint's range, not faster than any joint turns;
- its speed does not jump, except to the commanded one;
- its position agrees with its speeds: the step from the last reading lies between the old and the new speed, each times
  the period. The rest of the step is summed, fades over `window`, and may not exceed `drift`;
- it is new: a reading that is repeated bit by bit is stale where the joint is commanded to move otherwise.

So readings of an arm that is pushed or held are plausible. While the arm stops, a joint whose reading was not plausible
is assumed to be where it is commanded to be, until a reading shows it there or `confirmations` readings in a row are
plausible.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from salver.control.arm import ArmState
from salver.errors import SalverError
from salver.geometry import Array, Mask
from salver.models.arm.arm import ArmModel


@dataclass(frozen=True)
class Plausible:
    """Thresholds of plausible readings. rad stands for m at prismatic joints.

    outside: rad beyond the maker's range. speed_share: of the maker's speed limit. speed_change: share of that limit by
    which a speed may change in one period.
    drift, window: rad, s; how far positions may leave the integral of their speeds, and how soon that fades. The
    reading of a joint that is this near to its command counts again at once.
    confirmations: plausible readings in a row after which a joint's readings count again; enough for `drift` to show a
    false speed.
    moving: rad/s beside the commanded speed from which on an identical reading is stale; more for a coarse sensor.
    gap: largest time between two readings, s.
    bridged: periods in a row without a plausible reading in which a stop still surely keeps the load.
    """

    outside: float = 0.2
    speed_share: float = 20.0
    speed_change: float = 0.5
    drift: float = 0.005
    window: float = 0.05
    confirmations: int = 8
    moving: float = 0.01
    gap: float = 1.0
    bridged: int = 10


@dataclass(slots=True)
class Sensed:
    """A checked reading. state: as read. believed: (n,) whether each joint's reading counts. elapsed: s since the last
    reading. wrong: what was not plausible, in words; empty if nothing."""

    state: ArmState
    believed: Mask
    elapsed: float
    wrong: str = ""

    def take_for(self, commanded: ArmState) -> None:
        """Replace the state of joints whose reading does not count by the commanded one."""
        if not self.believed.all():
            q, dq = np.where(self.believed, (self.state.q, self.state.dq), (commanded.q, commanded.dq))
            self.state = ArmState(q, dq)


class Senses:
    """Takes the samples of an arm, one a period.

    blind: periods since the last sample that was plausible in every joint.
    """

    def __init__(self, arm: ArmModel, period: float, state: ArmState, plausible: Plausible = Plausible()) -> None:
        """state: of the arm before the first sample. Raises SalverError when it is not possible."""
        self._arm, self._period, self._plausible = arm, period, plausible
        self.blind, self._first = 0, True
        q, dq, wrong = self._numbers(state)
        if wrong := wrong or self._impossible(q, dq)[1]:
            raise SalverError(f"The arm's state cannot be believed: {wrong}.")
        self._read = ArmState(q, dq)
        self._drift = np.zeros(arm.n)  # rad by which positions left the integral of their speeds, fading
        self._followed = np.full(arm.n, plausible.confirmations)  # plausible readings in a row

    @property
    def sees(self) -> bool:
        """Whether the arm's state is known: readings were missing for a few periods at most."""
        return self.blind <= self._plausible.bridged

    def take(self, answer: Any, commanded: ArmState) -> Sensed:
        """A robot's (state, elapsed), as it came. commanded: state in which the arm should have been a period ago."""
        state, elapsed, late = self._clock(answer)
        self._first = False
        q, dq, odd = self._numbers(state)
        possible, impossible = self._impossible(q, dq)
        q, dq = np.where(possible, q, np.nan), np.where(possible, dq, np.nan)
        steady, drift = self._follows(q, dq, elapsed)
        if elapsed > 1.5 * self._period and not (steady & self._bounded(drift)).all():
            steady_in_one, drift_in_one = self._follows(q, dq, self._period)
            if (steady_in_one & self._bounded(drift_in_one)).all():
                late = f"its clock says that {elapsed:g} s passed, and its joints went as far as in {self._period:g} s"
                elapsed, steady, drift = self._period, steady_in_one, drift_in_one
        identical = (q == self._read.q) & (dq == self._read.dq)
        stale = identical & (np.abs(commanded.dq - dq) > self._plausible.moving)
        change = self._plausible.speed_change * self._arm.limits.velocity
        there = np.abs(q - commanded.q - elapsed * commanded.dq) <= self._plausible.drift
        there &= np.abs(dq - commanded.dq) <= change
        plausible = possible & (steady | there) & self._bounded(drift) & ~stale
        strange = "" if plausible.all() else self._why(q, dq, int(np.argmin(plausible)), identical, drift)
        self._followed = np.where(plausible, self._followed + 1, 0)
        believed = plausible & (there | (self._followed >= self._plausible.confirmations))
        self._read, self._drift = ArmState(q, dq), drift
        wrong = late or odd or impossible or strange
        wrong = wrong or ("" if believed.all() else "it is not believed again yet")
        self.blind = self.blind + 1 if wrong else 0
        return Sensed(self._read, believed, elapsed, wrong)

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
        """Whether each joint's reading (n,) is possible, and a sentence on a finite one that is impossible."""
        arm, plausible = self._arm, self._plausible
        outside = np.maximum(arm.limits.q_min - q, q - arm.limits.q_max)
        inside = outside <= plausible.outside
        slow = np.abs(dq) <= plausible.speed_share * arm.limits.velocity
        for j in np.flatnonzero(~inside & np.isfinite(q)).tolist():
            place = f"{arm.joint_names[j]} is said to be at {q[j]:.4g} {arm.unit(j)}, far outside its range"
            return inside & slow, place
        for j in np.flatnonzero(~slow & np.isfinite(dq)).tolist():
            return (
                inside & slow,
                f"{arm.joint_names[j]} is said to move at {dq[j]:.4g} {arm.unit(j)}/s, which it cannot",
            )
        return inside & slow, ""

    def _follows(self, q: Array, dq: Array, elapsed: float) -> tuple[Mask, Array]:
        """Whether each joint's speed (n,) can follow from the speed of the reading before, `elapsed` s earlier; and the
        drift (n,), rad, of its positions from the integral of the speeds."""
        plausible, before, time = self._plausible, self._read, max(elapsed, self._period)
        most = plausible.speed_change * self._arm.limits.velocity * time / self._period
        went = q - before.q
        slowest, fastest = np.minimum(dq, before.dq) * time, np.maximum(dq, before.dq) * time
        drift = math.exp(-time / plausible.window) * self._drift + went - np.clip(went, slowest, fastest)
        # What is not possible, NaN, tells nothing of the reading after it.
        return ~(np.abs(dq - before.dq) > most), np.where(np.isfinite(drift), drift, 0.0)

    def _bounded(self, drift: Array) -> Mask:
        return np.asarray(np.abs(drift) <= self._plausible.drift)

    def _why(self, q: Array, dq: Array, j: int, identical: Mask, drift: Array) -> str:
        name, unit = self._arm.joint_names[j], self._arm.unit(j)
        if identical[j]:
            return f"{'it' if identical.all() else name} reports the same state again though it moves"
        if not self._bounded(drift)[j]:
            off = f"{abs(drift[j]):.3g} {unit} off what its speeds make of it"
            return f"{name} is said to be at {q[j]:.5g} {unit}, {off}"
        return f"{name} is said to move at {dq[j]:.3g} {unit}/s, after {self._read.dq[j]:.3g} {unit}/s"
