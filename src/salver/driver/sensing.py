"""What is believed of the arm: each joint's reading is held against itself and against the model, and one that cannot
be believed is bridged.

A reading is a position and a speed. It is believed of a joint when it

- is possible: numbers, within the joint's range, no faster than it can turn;
- is news: what is repeated to the last bit says nothing, and the model's word is taken;
- follows from the last state: the speed by the torque that acted (the model), the position by the speed;
- and follows over the last `MEMORY`, where what is too little to be told in one period adds up: positions go at their
  speeds, and a joint whose torques must have set it moving does not stand.

Of a position and a speed that part the one is wrong that fits the model less, and is not believed again. A position
alone gives a speed too; where neither can be believed the joint is in the dark, and the model goes on with what it has
learnt to be wrong by. The longer that lasts, the farther from there may the next reading be: as far as the model may be
wrong, no farther, unless readings have followed from one another for long.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from salver.control.arm import ArmState
from salver.errors import SalverError
from salver.geometry import Array
from salver.models.arm import ArmModel, with_load

if TYPE_CHECKING:
    from salver.models.bodies import Body

Flags = NDArray[np.bool_]
LONGEST_GAP = 1.0  # s; a clock that says that more passed since the last sample is wrong
OUTSIDE = 0.2  # rad beyond the maker's range that a sensor may report
TOO_FAST = 2.0  # times the maker's speed limit: no joint turns like that
STRAY = 2.0  # times the way at the speed limit: a position farther off has jumped
JOLT = 0.1  # from one period to the next a speed cannot be off by more than this share of the limit
STRONGEST = 100.0  # and as much as at this acceleration, rad/s^2; nor can it from how far the joint really went
MOVING = 0.01  # rad/s by which a speed that is repeated may differ from the model's
MEMORY = 0.05  # s over which what single samples are off adds up
ASIDE = 0.005  # rad that positions may come off the way at their speeds within it
MISFIT = 0.5  # of the maker's acceleration that the model may be wrong by within it
REST = 0.4  # of that, what the model is wrong by after it has learnt
LEARNING = 0.1, 0.5  # s in which it learns, of a joint that moves and of one that stands
DRAWN = 0.05  # share of what a position is off that is taken to the speed, each period
CREEP = 0.02  # rad/s that a speed may be wrong by for good
STANDS = 0.2  # of what the model's speed changed: a joint that changed its own by less, and turns at less, stands
TRUST = 0.25  # of what is allowed else: a speed that was not believed before must be nearer
AGAIN = 20  # readings in a row that follow from one another are believed again,
AWAY = 0.3  # rad from the model at most
SOON = 0.002  # s, until the torque that an arm is left with has ended
UNKNOWN_SPEED = 10.0  # rad/s, where no maker's limit is known
UNKNOWN_ACCELERATION = 15.0  # rad/s^2, likewise


@dataclass(slots=True)
class Sensed:
    """state: measured, or bridged. elapsed: s since the last one. wrong: why it was bridged; empty when it was not.

    dark: whether neither position nor speed of some joint could be believed: where it is, only the model says.
    """

    state: ArmState
    elapsed: float
    wrong: str = ""
    dark: bool = False


class Senses:
    """Takes the samples of an arm, one a period. blind: periods since the last one that could be believed whole."""

    def __init__(self, arm: ArmModel, bodies: Sequence[Body], period: float, state: ArmState) -> None:
        """state: of the arm before the first sample. Raises SalverError when it is none."""
        self._arm, self._period = arm, period
        loaded, limits = with_load(arm, bodies), arm.limits
        self._model, self._data = loaded.pin_model, loaded.data
        self._speed = np.where(np.isfinite(limits.velocity), limits.velocity, UNKNOWN_SPEED)
        self._misfit = MISFIT * np.where(np.isfinite(limits.acceleration), limits.acceleration, UNKNOWN_ACCELERATION)
        self._fastest = TOO_FAST * self._speed
        self.blind, self._first = 0, True
        q, dq, wrong = self._numbers(state)
        if wrong := wrong or self._impossible(q, dq):
            raise SalverError(f"The arm's state cannot be believed: {wrong}.")
        self._believed = self._heard = ArmState(q, dq)
        self._jolt, self._most = self._jolts(period), MEMORY * self._misfit
        # The last position that was news, the way gone at the speeds since, and the time, s.
        self._seen = q, np.zeros(arm.n), np.zeros(arm.n)
        # (n,) each, fading within MEMORY: what positions came off the way at their speeds, speeds off the model, and
        # speeds changed; how wrong what is believed may be; the acceleration that the model has learnt to add.
        self._aside, self._off, self._turned, self._unsure_q, self._unsure_dq, self._bias = np.zeros((6, arm.n))
        self._told = np.zeros(arm.n, dtype=int)  # readings in a row that follow from one another
        self._odd_q, self._odd_dq = np.zeros((2, arm.n), dtype=bool)  # positions, speeds that parted from the others
        self._good_dq = np.ones(arm.n, dtype=bool)  # the last speed was believed
        self._dark = np.zeros(arm.n, dtype=bool)  # nothing was believed but the model
        self._plain = True  # everything was believed

    def take(self, answer: Any, torque: Array) -> Sensed:
        """A robot's (state, elapsed), as it came. torque: (n,) that acted since the last one."""
        state, elapsed, late = self._clock(answer)
        q, dq, odd = self._numbers(state)
        if not late and (late := self._hasty(q, dq, elapsed)):
            elapsed = self._period
        self._first = False
        if odd := odd or self._impossible(q, dq):
            q, dq = self._possible(q, dq)
        strange = self._weigh(q, dq, self._ahead(torque, elapsed), max(elapsed, self._period))
        wrong = late or odd or strange
        self.blind = self.blind + 1 if wrong else 0
        return Sensed(self._believed, elapsed, wrong, bool(self._dark.any()))

    def rests(self, state: ArmState, torque: Array, speed: float) -> bool:
        """Whether no joint turns faster, rad/s, nor does within `SOON` under this torque (n,)."""
        ddq = pin.aba(self._model, self._data, state.q, state.dq, torque) + self._bias
        return bool((np.abs(state.dq) + SOON * np.abs(ddq) <= speed).all())

    # What a sample says by itself ------------------------------------------------------------------------------------

    def _clock(self, answer: Any) -> tuple[Any, float, str]:
        try:
            state, elapsed = answer
            elapsed = float(elapsed)
        except (TypeError, ValueError):
            return None, self._period, "it says nothing"
        least = 0.0 if self._first else 0.5 * self._period
        if not least <= elapsed <= LONGEST_GAP:
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

    def _impossible(self, q: Array, dq: Array) -> str:
        limits = self._arm.limits
        outside = np.maximum(limits.q_min - q, q - limits.q_max)
        j = int(np.argmax(outside))
        if outside[j] > OUTSIDE:
            return f"{self._arm.joint_names[j]} is said to be at {q[j]:.4g} rad, far outside its range"
        j = int(np.argmax(np.abs(dq) / self._speed))
        if abs(dq[j]) > TOO_FAST * self._speed[j]:
            return f"{self._arm.joint_names[j]} is said to turn at {dq[j]:.4g} rad/s, which it cannot"
        return ""

    def _possible(self, q: Array, dq: Array) -> tuple[Array, Array]:
        """Of the readings (n,) what can be; NaN for the rest."""
        limits = self._arm.limits
        inside = (q >= limits.q_min - OUTSIDE) & (q <= limits.q_max + OUTSIDE)
        slow = np.abs(dq) <= self._fastest
        return np.where(inside, q, np.nan), np.where(slow, dq, np.nan)

    def _hasty(self, q: Array, dq: Array, elapsed: float) -> str:
        """A clock that runs ahead: the joints went as far as they go in one period, and it says that more passed."""
        if elapsed < 1.5 * self._period:
            return ""
        speed = 0.5 * (dq + self._believed.dq)
        gone, spare = q - self._believed.q, np.abs(speed) * (elapsed - self._period)
        telling = spare > ASIDE
        near = np.abs(gone - speed * self._period) < 0.25 * np.abs(gone - speed * elapsed)
        if not (telling.any() and near[telling].all()):
            return ""
        return f"its clock says that {elapsed:g} s passed, and its joints went as far as in {self._period:g} s"

    # What it says against what is known ------------------------------------------------------------------------------

    def _ahead(self, torque: Array, elapsed: float) -> ArmState:
        """Where the model takes the arm from what was believed."""
        q, dq = self._believed.q, self._believed.dq
        for _ in range(max(1, round(elapsed / self._period))):
            dq = dq + self._period * (pin.aba(self._model, self._data, q, dq, torque) + self._bias)
            dq = np.minimum(np.maximum(dq, -self._fastest), self._fastest)
            q = q + self._period * dq
        return ArmState(q, dq)

    def _jolts(self, time: float) -> Array:
        return np.asarray(JOLT * self._speed + STRONGEST * time)

    def _weigh(self, q: Array, dq: Array, model: ArmState, time: float) -> str:
        """Believe of q, dq (n,) what can be, of the model the rest. Why not all; empty when all was believed."""
        heard, self._heard = self._heard, ArmState(q, dq)
        new_q, new_dq = q != heard.q, dq != heard.dq
        fade, jolt = math.exp(-time / MEMORY), self._jolt if time == self._period else self._jolts(time)
        self._hold_to_itself(q, dq, heard, new_q, fade, jolt, time)
        off = dq - model.dq
        total = np.where(self._dark, off, fade * self._off + off)
        gone = q - model.q - 0.5 * time * off
        slow = np.maximum(np.abs(dq), np.abs(self._turned)) < STANDS * np.abs(total)
        plain = (
            new_q
            & new_dq
            & (np.abs(off) <= jolt)
            & (np.abs(gone) <= time * jolt)
            & (np.abs(self._aside) <= ASIDE)
            & ~(slow & (np.abs(total) > self._most))
        )
        if self._plain and plain.all():
            self._off = np.minimum(np.maximum(total, -self._most), self._most)
            self._learn(off, slow)
            self._believed = self._heard
            return ""
        return self._doubt(q, dq, model, time, fade, jolt, new_q, new_dq, total, slow)

    def _learn(self, off: Array, slow: Flags) -> None:
        bias = self._bias + off / np.where(slow, LEARNING[1], LEARNING[0])
        self._bias = np.minimum(np.maximum(bias, -self._misfit), self._misfit)

    def _hold_to_itself(
        self, q: Array, dq: Array, heard: ArmState, new_q: Flags, fade: float, jolt: Array, time: float
    ) -> None:
        """Whether positions (n,) go at their speeds, now and over the last `MEMORY`."""
        at, way, since = self._seen
        turned = dq - heard.dq
        way, since = way + 0.5 * time * (dq + heard.dq), since + time
        aside = np.where(new_q, q - at - way, 0.0)
        steady = (np.abs(aside) <= jolt * since) & (np.abs(turned) <= jolt)
        self._seen = np.where(new_q, q, at), np.where(new_q, 0.0, way), np.where(new_q, 0.0, since)
        self._aside = fade * self._aside + np.where(steady, aside, 0.0)
        self._turned = fade * self._turned + np.where(steady, turned, 0.0)
        self._told = np.where(steady & (np.abs(self._aside) <= TRUST * ASIDE), self._told + new_q, 0)

    def _doubt(
        self, q: Array, dq: Array, model: ArmState, time: float, fade: float, jolt: Array, new_q: Flags, new_dq: Flags,
        total: Array, slow: Flags,
    ) -> str:  # fmt: skip
        """`_weigh`, where something is not as it should be, or was not lately."""
        off = dq - model.dq
        stands = slow & (np.abs(total) > self._most)
        # Where positions and speeds part, the one that fits the model less is wrong, from now on.
        parted = (np.abs(self._aside) > ASIDE) & ~self._odd_q & ~self._odd_dq
        fits_less = np.abs(total + self._aside / MEMORY) > np.abs(total)
        self._odd_q, self._odd_dq = self._odd_q | (parted & fits_less), self._odd_dq | (parted & ~fits_less)

        # What follows from the state before, by the model, or for long from itself.
        again = (self._told > AGAIN) & (np.abs(q - model.q) <= AWAY)
        follows = np.abs(off) <= np.where(self._good_dq, jolt, TRUST * jolt) + self._unsure_dq
        good_dq = new_dq & ~stands & ~self._odd_dq & (again | follows)
        v = np.where(good_dq, dq, model.dq)
        gone = q - model.q - 0.5 * time * (v - model.dq)
        near = np.abs(gone) <= jolt * time + self._unsure_q
        good_q = new_q & ~stands & ~self._odd_q & (again | near)
        good_dq &= good_q | ~new_q | self._odd_q  # a position that jumped takes its speed with it

        # The speed of a position alone is drawn to where it goes; what was wrong for long is taken back.
        learnt = np.where(good_dq, off, np.where(good_q, DRAWN * gone / time, 0.0))
        wrong_before = (stands | (parted & ~fits_less)) & self._good_dq
        learnt = np.where(wrong_before, -fade * self._off, learnt)
        v = np.where(good_dq, dq, model.dq + learnt)
        believed = ArmState(np.where(good_q, q, model.q + 0.5 * time * (v - model.dq)), v)
        stays = (~new_q & (np.abs(believed.q - q) > MOVING * MEMORY)) | (~new_dq & (np.abs(model.dq - dq) > MOVING))
        bad = (new_q & ~good_q) | (new_dq & ~good_dq)

        self._dark = (stays | bad) & ~good_q & ~good_dq
        self._off = np.where(good_dq, np.minimum(np.maximum(total, -self._most), self._most), fade * self._off)
        self._good_dq = good_dq | (~new_dq & self._good_dq)
        self._bias = np.where(parted, 0.0, self._bias)  # what was learnt from one that lied is forgotten
        self._learn(np.where(parted, 0.0, np.minimum(np.maximum(learnt, -jolt), jolt)), slow)
        self._unsure_q = np.where(good_q, 0.0, self._unsure_q + time * np.where(good_dq, CREEP, self._unsure_dq))
        self._unsure_dq = np.where(good_dq, 0.0, self._unsure_dq + np.where(good_q, 0.0, time * REST * self._misfit))
        self._plain = bool((good_q & good_dq).all())
        self._believed = believed
        return self._why(q, dq, believed, stays, bad)

    def _why(self, q: Array, dq: Array, believed: ArmState, stays: Flags, bad: Flags) -> str:
        """What is wrong with a reading, of the first joint that it is wrong of; empty where nothing is."""
        if stays.any():
            who = "it" if stays.all() else self._arm.joint_names[int(np.argmax(stays))]
            return f"{who} reports the same state again though it moves"
        if not bad.any():
            return ""
        j = int(np.argmax(bad))
        name, off_q, off_dq = self._arm.joint_names[j], abs(q[j] - believed.q[j]), abs(dq[j] - believed.dq[j])
        if not off_q <= STRAY * self._speed[j] * self._period:
            return f"{name} is said to have jumped by {off_q:.2g} rad"
        if not off_dq <= JOLT * self._speed[j]:
            return f"the speed of {name} is said to have jumped by {off_dq:.2g} rad/s"
        return f"{name} is said to turn at {dq[j]:.3g} rad/s and goes elsewhere"
