"""What is believed of the arm: each joint's reading is held against itself and against the model, and one that cannot
be believed is bridged.

A reading is a position and a speed. It is believed of a joint when it

- is possible: numbers, within the joint's range, no faster than any joint turns;
- is news: what is repeated to the last bit says nothing, and the model's word is taken;
- follows from the last one by itself, the position by the speeds, whatever the model says: who is pushed, held, or
  thrown back from a joint's stop reads the truth; or follows from the torque that acted, by the model;
- and follows over the last `MEMORY`, where what is too little to be told in one period adds up.

The model knows the ends of the ranges: a joint that goes out there is stopped, and that moves the others.

Of a position and a speed that part the one is wrong that fits the model less, and is not believed again. A position
alone gives a speed too; where neither can be believed the joint is in the dark, and the model goes on with what it has
learnt to be wrong by. The longer that lasts, the farther from there may the next reading be, when positions go at their
speeds again: as far as the model may be wrong, no farther, unless that was so for long.
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
TOO_FAST = 20.0  # times the maker's speed limit: no joint turns like that,
RUNAWAY = 4.0  # nor does the model let it without having been told
STRAY = 2.0  # times the way at the speed limit: a position farther off has jumped
JOLT = 0.1  # from one period to the next a speed cannot be off by more than this share of the limit
STRONGEST = 100.0  # and as much as at this acceleration, rad/s^2; nor can it from how far the joint really went
MOVING = 0.01  # rad/s by which a speed that is repeated may differ from the model's
MEMORY = 0.05  # s over which what single samples are off adds up
ASIDE = 0.005  # rad that positions may come off the way at their speeds within it
MISFIT = 0.5  # of the maker's acceleration that the model may be wrong by within it
REST = 0.4  # of that, what the model is wrong by after it has learnt
LEARNING = 0.1  # s in which it learns
DRAWN = 0.05  # share of what a position is off that is taken to the speed, each period
CREEP = 0.02  # rad/s that a speed may be wrong by for good
SHARE = 0.25  # of what a speed changed by that its position may be off: half of it, where only the speed is said to
TRUST = 0.25  # of what is allowed else: a speed that was not believed before must be nearer
AT_ONCE = 3  # speeds in a row that positions went at to the letter are believed,
AGAIN = 20  # readings in a row that follow from one another are believed again,
AWAY = 0.3  # rad from the model at most
AT_END = 0.01  # rad from the end of its range, where a joint may meet its stop
SOON = 0.002  # s, until the torque that an arm is left with has ended
UNKNOWN_SPEED = 10.0  # rad/s, where no maker's limit is known
UNKNOWN_ACCELERATION = 15.0  # rad/s^2, likewise


@dataclass(slots=True)
class Sensed:
    """state: measured, or bridged. elapsed: s since the last one. wrong: why it was bridged; empty when it was not."""

    state: ArmState
    elapsed: float
    wrong: str = ""


class Senses:
    """Takes the samples of an arm, one a period.

    blind: periods since the last one that could be believed whole. dark: periods in a row in which neither position nor
    speed of some joint could be believed: where it is, only the model says.
    """

    def __init__(self, arm: ArmModel, bodies: Sequence[Body], period: float, state: ArmState) -> None:
        """state: of the arm before the first sample. Raises SalverError when it is none."""
        self._arm, self._period = arm, period
        self._loaded, limits = with_load(arm, bodies), arm.limits
        self._model, self._data = self._loaded.pin_model, self._loaded.data
        self._speed = np.where(np.isfinite(limits.velocity), limits.velocity, UNKNOWN_SPEED)
        self._misfit = MISFIT * np.where(np.isfinite(limits.acceleration), limits.acceleration, UNKNOWN_ACCELERATION)
        self._fastest = RUNAWAY * self._speed
        self.blind, self.dark, self._first = 0, 0, True
        q, dq, wrong = self._numbers(state)
        if wrong := wrong or self._impossible(q, dq):
            raise SalverError(f"The arm's state cannot be believed: {wrong}.")
        self._believed = self._heard = ArmState(q, dq)
        self._jolt, self._most = self._jolts(period), MEMORY * self._misfit
        # The last position that was news, the way gone at the speeds since, and the time, s.
        self._seen = q, np.zeros(arm.n), np.zeros(arm.n)
        # (n,) each, fading within MEMORY: what positions came off the way at their speeds, and speeds off the model;
        # how wrong what is believed may be; the acceleration that the model has learnt to add.
        self._aside, self._off, self._unsure_q, self._unsure_dq, self._bias = np.zeros((5, arm.n))
        # Readings in a row of which positions went at their speeds: for long, to the letter, and nearly.
        self._told, self._itself, self._steady = np.zeros((3, arm.n), dtype=int)
        self._odd_q, self._odd_dq = np.zeros((2, arm.n), dtype=bool)  # positions, speeds that parted from the others
        self._good_dq = np.ones(arm.n, dtype=bool)  # the last speed was believed,
        self._sure = np.ones(arm.n, dtype=bool)  # and the last position too
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
        strange = self._weigh(q, dq, self._ahead(torque, elapsed, dq), max(elapsed, self._period))
        wrong = late or odd or strange
        self.blind = self.blind + 1 if wrong else 0
        self.dark = self.dark + 1 if self._dark.any() else 0
        return Sensed(self._believed, elapsed, wrong)

    def rests(self, state: ArmState, torque: Array, speed: float) -> bool:
        """Whether no joint turns faster, rad/s, nor does within `SOON` under this torque (n,)."""
        free = state.dq + SOON * self._acceleration(state.q, state.dq, torque)
        changes = self._within_range(state.q, free) - state.dq
        return bool((np.abs(state.dq) + np.abs(changes) <= speed).all())

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
            return f"{self._arm.joint_names[j]} is said to be at {q[j]:.4g} {self._arm.unit(j)}, far outside its range"
        j = int(np.argmax(np.abs(dq) / self._speed))
        if abs(dq[j]) > TOO_FAST * self._speed[j]:
            return f"{self._arm.joint_names[j]} is said to move at {dq[j]:.4g} {self._arm.unit(j)}/s, which it cannot"
        return ""

    def _possible(self, q: Array, dq: Array) -> tuple[Array, Array]:
        """Of the readings (n,) what can be; NaN for the rest."""
        limits = self._arm.limits
        inside = (q >= limits.q_min - OUTSIDE) & (q <= limits.q_max + OUTSIDE)
        slow = np.abs(dq) <= TOO_FAST * self._speed
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

    def _ahead(self, torque: Array, elapsed: float, told: Array) -> ArmState:
        """Where the model takes the arm from what was believed. told (n,): the speeds that are reported then."""
        q, dq = self._believed.q, self._believed.dq
        most = np.maximum(self._fastest, np.abs(dq))
        for left in range(max(1, round(elapsed / self._period)) - 1, -1, -1):
            dq = dq + self._period * self._acceleration(q, dq, torque)
            dq = self._within_range(q, np.minimum(np.maximum(dq, -most), most), None if left else told)
            q = q + self._period * dq
        return ArmState(q, dq)

    def _acceleration(self, q: Array, dq: Array, torque: Array) -> Array:
        return np.asarray(pin.aba(self._model, self._data, q, dq, torque) + self._bias)

    def _within_range(self, q: Array, free: Array, told: Array | None = None) -> Array:
        """Speeds (n,) of an arm that would turn at `free` if its joints turned without end.

        A joint that goes out at the end of its range is stopped there by an impulse inwards, which moves the others
        too. How strong it is nobody knows: the joint may be let out further, rest, or bounce. What is told of its speed
        tells it, and without it the joint rests.
        """
        limits = self._arm.limits
        above, below = q > limits.q_max - AT_END, q < limits.q_min + AT_END
        ends = above | below
        if not ends.any():
            return free
        rests = np.where(above, np.minimum(free, 0.0), np.maximum(free, 0.0))  # of a joint at an end
        v = rests if told is None else np.where(np.isfinite(told), told, rests)
        after = np.where(above, np.minimum(free, v), np.where(below, np.maximum(free, v), free))
        if not len(j := np.flatnonzero(after != free)):
            return free
        gives = np.linalg.inv(self._loaded.mass_matrix(q))[:, j]
        return np.asarray(free + gives @ np.linalg.solve(gives[j], (after - free)[j]))

    def _jolts(self, time: float) -> Array:
        return np.asarray(JOLT * self._speed + STRONGEST * time)

    def _weigh(self, q: Array, dq: Array, model: ArmState, time: float) -> str:
        """Believe of q, dq (n,) what can be, of the model the rest. Why not all; empty when all was believed."""
        heard, self._heard = self._heard, ArmState(q, dq)
        new_q, new_dq = q != heard.q, dq != heard.dq
        fade, jolt = math.exp(-time / MEMORY), self._jolt if time == self._period else self._jolts(time)
        itself = self._hold_to_itself(q, dq, heard, new_q, fade, jolt, time)
        off = dq - model.dq
        total = np.where(self._dark, off, fade * self._off + off)
        gone = q - model.q - 0.5 * time * off
        plain = (
            new_q
            & new_dq
            & (itself | ((np.abs(off) <= jolt) & (np.abs(gone) <= time * jolt)))
            & (np.abs(self._aside) <= ASIDE)
        )
        if self._plain and plain.all():
            self._off = np.minimum(np.maximum(total, -self._most), self._most)
            self._learn(off)
            self._believed = self._heard
            return ""
        return self._doubt(q, dq, model, time, fade, jolt, new_q, new_dq, total, itself)

    def _learn(self, off: Array) -> None:
        bias = self._bias + off / LEARNING
        self._bias = np.minimum(np.maximum(bias, -self._misfit), self._misfit)

    def _hold_to_itself(
        self, q: Array, dq: Array, heard: ArmState, new_q: Flags, fade: float, jolt: Array, time: float
    ) -> Flags:
        """Whether positions (n,) go at their speeds: over the last `MEMORY`, in `_aside`; now, what is returned."""
        at, way, since = self._seen
        turned = dq - heard.dq
        way, since = way + 0.5 * time * (dq + heard.dq), since + time
        aside = np.where(new_q, q - at - way, 0.0)
        itself = new_q & (np.abs(aside) <= (TRUST * jolt + SHARE * np.abs(turned)) * since)
        steady = itself | (np.abs(aside) <= jolt * since) & (np.abs(turned) <= jolt)
        self._itself = np.where(itself, self._itself + 1, 0)
        self._steady = np.where(steady & new_q, self._steady + 1, 0)
        self._seen = np.where(new_q, q, at), np.where(new_q, 0.0, way), np.where(new_q, 0.0, since)
        self._aside = fade * self._aside + np.where(steady, aside, 0.0)
        self._told = np.where(steady & (np.abs(self._aside) <= TRUST * ASIDE), self._told + new_q, 0)
        return itself

    def _doubt(
        self, q: Array, dq: Array, model: ArmState, time: float, fade: float, jolt: Array, new_q: Flags, new_dq: Flags,
        total: Array, itself: Flags,
    ) -> str:  # fmt: skip
        """`_weigh`, where something is not as it should be, or was not lately."""
        off = dq - model.dq
        # Where positions and speeds part, the one that fits the model less is wrong, from now on.
        parted = (np.abs(self._aside) > ASIDE) & ~self._odd_q & ~self._odd_dq
        fits_less = np.abs(total + self._aside / MEMORY) > np.abs(total)
        self._odd_q, self._odd_dq = self._odd_q | (parted & fits_less), self._odd_dq | (parted & ~fits_less)

        # What follows from the state before, by itself or by the model, or for a while from itself.
        again, at_once, itself = self._told > AGAIN, self._itself >= AT_ONCE, itself & self._sure
        follows = itself | (np.abs(off) <= np.where(self._good_dq, jolt, TRUST * jolt) + self._unsure_dq)
        good_dq = new_dq & ~self._odd_dq & (at_once | again | follows)
        v = np.where(good_dq, dq, model.dq)
        gone = q - model.q - 0.5 * time * (v - model.dq)
        way = time * np.where(np.isfinite(off), off, 0.0)  # at the speed that is told, and not by the model
        beside = q - model.q - np.minimum(np.maximum(q - model.q, np.minimum(way, 0.0)), np.maximum(way, 0.0))
        reach = jolt * time + np.where(self._steady > 1, self._unsure_q, 0.0)  # not of who passes by by chance
        near = itself | (np.minimum(np.abs(gone), np.abs(beside)) <= reach)
        good_q = new_q & ~self._odd_q & (near | (again & (np.abs(q - model.q) <= AWAY)))
        good_dq &= good_q | ~new_q | self._odd_q | np.isnan(q)  # a position that jumps takes its speed with it

        # The speed of a position alone is drawn to where it goes; what was wrong for long is taken back.
        learnt = np.where(good_dq, off, np.where(good_q, DRAWN * gone / time, 0.0))
        wrong_before = parted & ~fits_less & self._good_dq
        learnt = np.where(wrong_before, -fade * self._off, learnt)
        v = np.where(good_dq, dq, model.dq + learnt)
        believed = ArmState(np.where(good_q, q, model.q + 0.5 * time * (v - model.dq)), v)
        stays = (~new_q & (np.abs(believed.q - q) > MOVING * MEMORY)) | (~new_dq & (np.abs(model.dq - dq) > MOVING))
        bad = (new_q & ~good_q) | (new_dq & ~good_dq)

        self._dark = (stays | bad) & ~good_q & ~good_dq
        self._off = np.where(good_dq, np.minimum(np.maximum(total, -self._most), self._most), fade * self._off)
        self._good_dq, self._sure = good_dq | (~new_dq & self._good_dq), good_q & good_dq
        self._bias = np.where(parted, 0.0, self._bias)  # what was learnt from one that lied is forgotten
        self._learn(np.where(parted, 0.0, np.minimum(np.maximum(learnt, -jolt), jolt)))
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
            return f"{name} is said to have jumped by {off_q:.2g} {self._arm.unit(j)}"
        if not off_dq <= JOLT * self._speed[j]:
            return f"the speed of {name} is said to have jumped by {off_dq:.2g} {self._arm.unit(j)}/s"
        return f"{name} is said to move at {dq[j]:.3g} {self._arm.unit(j)}/s and goes elsewhere"
