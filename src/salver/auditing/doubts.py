"""Doubts: aspects of a motion that a recording leaves open and that could matter to the load."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from salver.auditing.motion import AuditedMotion, Doubt
from salver.auditing.options import DEFAULT
from salver.auditing.slip import Slip, hidden, left_over, slide
from salver.errors import Status
from salver.geometry import Array, Mask, lean

CANNOT_TELL = "cannot_tell"


@dataclass(frozen=True)
class Borne:
    """A motion with the acceleration reserve of the load, nominal or in the worst case.

    reserve (T,): m/s^2, additional acceleration in any direction at which the load still holds. rest, begun: the
    reserves at rest on a level tray, and in the first posture. pushed: m/s^2, unknown acceleration by the reaction of
    liquids and pendulums. kinetic: kinetic friction as a share of the static one.
    """

    motion: AuditedMotion
    reserve: Array
    rest: float
    pushed: float = 0.0
    begun: float = np.inf
    kinetic: float = 1.0

    @property
    def error(self) -> Array:
        """Bound (T,) of the error of the acceleration, m/s^2, including the reaction of liquids and pendulums."""
        return np.broadcast_to(self.motion.acceleration_error + self.motion.missed + self.pushed, self.reserve.shape)

    def hidden(self) -> tuple[Slip, float]:
        """Bound of the slip that noise and resolution could hide, and the frequency, Hz, up to which they hide none."""
        return hidden(self.motion, self.reserve, self.rest)

    @property
    def unsure(self) -> Mask:
        """Whether (T,) the motion exceeds the reserve by less than its uncertainty."""
        return (self.reserve < 0) & (self.reserve + self.error > 0)

    def edge(self) -> Doubt:
        """The doubt that the motion exceeds the reserve by less than its uncertainty."""
        k = int(np.argmin(self.reserve))
        known = (
            "there are no samples"
            if np.isinf(self.error[k])
            else f"it passes what is borne by {-self.reserve[k]:.2g} m/s^2, and is known to {self.error[k]:.2g} m/s^2"
        )
        return "edge", f"at {self.motion.samples.t[k]:.3f} s the motion may or may not be too much: {known}"

    def errors(self) -> list[Doubt]:
        """Errors of the samples that could explain a violation: their defects, a first posture in which nothing
        would stay, and violations that are shorter than a vibration of the highest frequency."""
        if self.motion.recording is None:
            return []
        t, highest = self.motion.samples.t, max(self.motion.options.highest, DEFAULT.highest)
        over = np.flatnonzero(np.diff(np.pad((self.reserve + self.error < 0).astype(int), 1)))
        lasting = False
        for first, last in over.reshape(-1, 2):
            most = -float(self.reserve[first:last].min())
            least = np.arccos(max(self.rest, 0.0) / (max(self.rest, 0.0) + most)) / (np.pi * highest)
            step = (t[min(last, len(t) - 1)] - t[max(first - 1, 0)]) / (last - first + 1)
            lasting |= bool((last - first) * step > 0.5 * least)
        if self.begun < 0:
            leans = np.rad2deg(lean(self.motion.samples.R_SB[:1]))[0]
            clause = (
                f"the tray leans by {leans:.0f} deg at its first sample, where nothing would stay at rest: the order "
                "of the columns, the convention of the rotations, the axes or the arm's base are others"
            )
            return [*self.motion.suspect, ("leaning", clause)]
        if lasting or not len(over):
            return list(self.motion.suspect)
        clause = f"at {t[over[0]]:.3f} s the motion is too much for a shorter time than any shake up to {highest:g} Hz"
        return [*self.motion.suspect, ("brief", f"{clause}: an error of the samples")]

    def unseen(self) -> list[Doubt]:
        """Doubts about motion that a recording does not show and that could slide a load."""
        recording, options, t = self.motion.recording, self.motion.options, self.motion.samples.t
        if recording is None:
            return []
        # If the recording contains a start to such a speed, or a stop from it, the motion before or after can be like
        # that; the verdict mentions it (`left_out`), and it is not a doubt.
        doubts = self._ends(recording.slowest)
        slip, harmless = self.hidden()
        if slip.distance > options.hidden:  # it grows with noise^2 / rate
            better, noise = options.hidden / slip.distance, 1e3 * recording.sensor.displacement
            known = f", or the knowledge that nothing on the arm is faster than {np.floor(10 * harmless) / 10:g} Hz"
            clause = (
                f"noise of {noise:.2g} mm could hide a shake of {_shake(slip)}, which would slide the load by up to "
                f"{1e3 * slip.distance:.2g} mm; noise below {noise * better**0.5:.2g} mm, "
                f"{recording.rate / better:.2g} samples a second{f'{known} (--highest)' if harmless else ''} would tell"
            )
            doubts.append(("noise", clause))
        short = self.reserve - self.motion.missed
        if slide(t, short) > options.noticed and slide(t, self.reserve) <= options.noticed:
            k = int(np.argmin(short))
            clause = (
                f"at {t[k]:.3f} s the motion is so fast that {recording.rate:.3g} samples a second show its "
                f"acceleration only to {np.broadcast_to(self.motion.missed, t.shape)[k]:.2g} m/s^2: twice as many "
                "would tell"
            )
            doubts.append(("unresolved", clause))
        fast = left_over(self.motion, self.reserve, self.rest)
        if fast.distance > options.noticed:
            clause = (
                f"the recording holds {_shake(fast)}, too fast for {recording.rate:.3g} samples a second to show its "
                f"acceleration: {6 * fast.frequency:.0f} a second would"
            )
            doubts.append(("unresolved", clause))
        if self.kinetic < 1 and max(slip.distance, fast.distance, slide(t, short)) > 0:
            clause = (
                "a shake that the samples do not show could start a slide, and under physics.kinetic_friction = "
                f"{self.kinetic:g} it may not stop: less noise would tell, or the knowledge that nothing is faster "
                "(--highest)"
            )
            doubts.append(("kinetic", clause))
        return doubts

    def left_out(self) -> str:
        """Assumptions and omissions of the verdict "holds", in words; the verdict begins with them."""
        seen, highest = self.motion.recording, self.motion.options.highest
        if seen is None:
            return ""
        first = [f"Not judged: {clause}. " for _, clause in self._ends()]
        if highest < DEFAULT.highest:
            first.append(f"Taken for granted: nothing shakes the tray faster than {highest:g} Hz. ")
        if seen.rate < 2.2 * highest:
            first.append(
                f"Taken for granted: nothing shakes the tray in step with the samples, at {0.5 * seen.rate:.3g} Hz; "
                f"{2.2 * highest:.0f} a second would show it. "
            )
        return "".join(first)

    def _ends(self, slowest: tuple[float, float] = (np.inf, np.inf)) -> list[Doubt]:
        """The doubt about a recording that begins or ends at a speed, if a load would slide at a jump to that speed.

        slowest: m/s, speeds at the first and last sample below which there is no doubt.
        """
        assert self.motion.recording is not None
        words = ("begins", "came before"), ("ends", "comes after")
        fast = [
            (f"{word} at {v:.2g} m/s", missing)
            for (word, missing), v, least in zip(words, self.motion.recording.ends, slowest, strict=True)
            if min(v, least) ** 2 / (2 * self.rest) > self.motion.options.hidden
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
