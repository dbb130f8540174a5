"""What a recording does not say, where it could matter to a load."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from salver.auditing.motion import HIGHEST, Recording, TrayMotion
from salver.auditing.slip import HIDDEN, NOTICED, Slip, hidden, left_over, slide
from salver.errors import Status
from salver.geometry import Array, Mask

CANNOT_TELL = "cannot_tell"
CLEAR = 2.2  # samples a period, below which a shake may have been seen at its zeros only, for a tenth of a second

Doubt = tuple[str, str]  # a code, and a clause that says what would tell


@dataclass(frozen=True)
class Borne:
    """A motion, and what the load would bear beyond it: reserve (T,) m/s^2 in any direction, and rest, the same at rest
    on a level tray; nominal, or in the worst case of the uncertain parameters."""

    motion: TrayMotion
    reserve: Array
    rest: float

    @property
    def error(self) -> Array:
        """(T,) m/s^2 by which the motion's acceleration may be wrong."""
        return np.broadcast_to(self.motion.acceleration_error + self.motion.missed, self.reserve.shape)

    def hidden(self) -> tuple[Slip, float]:
        """How far noise and resolution could hide a slide, and up to which frequency (Hz) they hide none."""
        assert self.motion.recording is not None
        return hidden(self.motion.samples.t, self.reserve, self.rest, self.motion.recording)

    @property
    def unsure(self) -> Mask:
        """(T,) whether the motion is too much there, but by less than it is known."""
        return (self.reserve < 0) & (self.reserve + self.error > 0)

    def edge(self) -> Doubt:
        """Where the motion passes what is borne by less than its acceleration is uncertain."""
        k = int(np.argmin(self.reserve))
        known = (
            "there are no samples"
            if np.isinf(self.error[k])
            else f"it passes what is borne by {-self.reserve[k]:.2g} m/s^2, and is known to {self.error[k]:.2g} m/s^2"
        )
        return "edge", f"at {self.motion.samples.t[k]:.3f} s the motion may or may not be too much: {known}"

    def unseen(self) -> list[Doubt]:
        """What a recording does not show, where it could slide a load."""
        recording, t = self.motion.recording, self.motion.samples.t
        if recording is None:
            return []
        # Where it comes from rest to such a speed within the recording, or from such a speed to rest, it can have done
        # so before or after: that is said (`left_out`), and no doubt.
        doubts = self._ends([_jerked(v, self.rest) > HIDDEN for v in recording.slowest])
        by_noise, harmless = self.hidden()
        if by_noise.distance > HIDDEN:
            doubts.append(("noise", _noise_clause(by_noise, harmless, recording)))
        short = self.reserve - self.motion.missed
        if slide(t, short) > NOTICED and slide(t, self.reserve) <= NOTICED:
            k = int(np.argmin(short))
            doubts.append(
                (
                    "unresolved",
                    f"at {t[k]:.3f} s the motion is so fast that {recording.rate:.3g} samples a second show its "
                    f"acceleration only to {np.broadcast_to(self.motion.missed, t.shape)[k]:.2g} m/s^2: twice as many "
                    "would tell",
                )
            )
        fast = left_over(t, self.reserve, self.rest, recording.unseen)
        if fast.distance > NOTICED:
            doubts.append(
                (
                    "unresolved",
                    f"the recording holds {_shake(fast)}, too fast for {recording.rate:.3g} samples a second to show "
                    f"its acceleration: {6 * fast.frequency:.0f} a second would",
                )
            )
        mirrored = left_over(t, self.reserve, self.rest, recording.mirrored, recording.rate)
        if mirrored.distance > NOTICED:
            doubts.append(
                (
                    "mirrored",
                    f"what looks like {recording.rate - mirrored.frequency:.2g} Hz may be {_shake(mirrored)}: at "
                    f"{recording.rate:.3g} samples a second the two look alike, at {2.5 * recording.highest:.0f} they "
                    "would not",
                )
            )
        return doubts

    def left_out(self) -> str:
        """What a verdict that everything holds leaves out or takes for granted; it stands before it."""
        seen = self.motion.recording
        if seen is None:
            return ""
        first = [f"Not judged: {clause}. " for _, clause in self._ends()]
        if seen.highest < HIGHEST:
            first.append(f"Taken for granted: nothing shakes the tray faster than {seen.highest:g} Hz. ")
        if seen.rate < CLEAR * seen.highest:
            first.append(
                f"Taken for granted: nothing shakes the tray in step with the samples, at {0.5 * seen.rate:.3g} Hz; "
                f"{CLEAR * seen.highest:.0f} a second would show it. "
            )
        return "".join(first)

    def _ends(self, which: Sequence[bool] = (True, True)) -> list[Doubt]:
        """Of a recording that begins or ends at speed, that it does not show how the tray comes to it."""
        assert self.motion.recording is not None
        words = ("begins", "came before"), ("ends", "comes after")
        fast = [
            (f"{word} at {v:.2g} m/s", missing)
            for (word, missing), v, asked in zip(words, self.motion.recording.ends, which, strict=True)
            if asked and _jerked(v, self.rest) > HIDDEN
        ]
        if not fast:
            return []
        speeds, missing = (" and ".join(parts) for parts in zip(*fast, strict=True))
        return [("speed", f"the recording {speeds}, and what {missing} is not in it")]


def cannot_tell(doubts: list[Doubt], worst: bool) -> Status:
    case = " in the worst case of the uncertain parameters" if worst else ""
    reasons = "; ".join(dict.fromkeys(clause for _, clause in doubts))
    codes = list(dict.fromkeys(code for code, _ in doubts))
    return Status(
        CANNOT_TELL, f"It cannot be told whether everything holds{case}: {reasons}.", False, {"reasons": codes}
    )


def _shake(slip: Slip) -> str:
    return f"{1e3 * slip.amplitude:.2g} mm at {slip.frequency:.2g} Hz around {slip.time:.3f} s"


def _jerked(speed: float, rest: float) -> float:
    """How far a load slides whose tray comes to a speed (m/s) at once, m. rest: reserve at rest, m/s^2."""
    return speed**2 / (2 * rest)


def _noise_clause(slip: Slip, harmless: float, seen: Recording) -> str:
    """What noise could hide, and what would show it: the slide grows with noise^2 / rate."""
    better = HIDDEN / slip.distance
    noise = 1e3 * seen.sensor.displacement
    known = f", or the knowledge that nothing on the arm is faster than {np.floor(10 * harmless) / 10:g} Hz (--highest)"
    return (
        f"noise of {noise:.2g} mm could hide a shake of {_shake(slip)}, which would slide the load by up to "
        f"{1e3 * slip.distance:.2g} mm; noise below {noise * better**0.5:.2g} mm, {seen.rate / better:.2g} samples a "
        f"second{known if harmless else ''} would tell"
    )
