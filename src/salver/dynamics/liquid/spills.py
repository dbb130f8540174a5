"""The verdict on a liquid along a motion: distance from the brim, and validity of the model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from salver.dynamics.load_limits import LIGHTEST, LoadVerdict
from salver.errors import Status
from salver.geometry import Array
from salver.models.load_dynamics import LEAST_WEIGHT
from salver.wording import millimetres

# Groups of its limits, in words.
HIGH = "what they may reach"
STEEP = "the steepness to which they are known"


@dataclass(frozen=True, eq=False)
class Spill(LoadVerdict):
    """Verdict on one liquid in the worst case.

    size: (T,) highest crest, m. left: (T,) least distance from crest to brim, m; infinite under a lid. after: that
    distance after the motion, m. steep: (T,) free wave relative to the largest for which the model is valid; the last
    value includes residual waves. light: (T,) reduction of apparent weight, relative to the largest valid one. settled:
    distance of residual waves below the requested height, m; infinite without a request.
    """

    left: Array
    after: float
    steep: Array
    light: Array
    settled: float

    @property
    def room(self) -> float:
        """Least distance under the brim, during the motion and after it, m."""
        return min(float(self.left.min()), self.after)

    def status(self, case: str = "") -> Status:
        """Whether one liquid stays in its container, in one sentence. case: words for the parameters."""
        k = int(np.argmin(self.left))
        when = {"interface": self.name, "time": float(self.t[k]), "left": float(self.left[k])}
        end, own = float(self.t[-1]), f"{self.name} {case}"
        if np.isfinite(self.left[k]) and self.left[k] < 0:
            first = float(self.t[np.argmax(self.left < 0)])
            sentence = f"The liquid in {own}comes {millimetres(-self.left[k])} too high at {self.t[k]:.3f} s"
            return Status("spills", f"{sentence}, the first time at {first:.3f} s.", False, when | {"time": first})
        if self.steep.max() > 1:
            sentence = (
                f"The waves in {own}become {self.steep.max():.2f} times as steep as what the model "
                "is valid for: they may break."
            )
            return Status("spills", sentence, False, when | {"time": float(self.t[np.argmax(self.steep > 1)])})
        if self.light.max() > 1:
            k = int(self.light.argmax())
            pressing = 100 * max(0.0, 1 - LIGHTEST * float(self.light[k]))
            sentence = (
                f"Of its weight only {pressing:.0f} % hold down the liquid in {self.name} at {self.t[k]:.3f} s: below "
                f"{100 * LEAST_WEIGHT:.0f} % nothing is known of its waves."
            )
            return Status("spills", sentence, False, when | {"time": float(self.t[k])})
        if self.after < 0:
            sentence = f"The liquid in {own}comes {millimetres(-self.after)} too high after the motion."
            return Status("spills", sentence, False, when | {"time": end})
        if self.settled < 0:
            sentence = f"The waves in {own}are {millimetres(-self.settled)} higher after the motion than is wanted."
            return Status("unsettled", sentence, False, when | {"time": end})
        if not np.isfinite(self.left[k]):
            return Status("holds", f"The liquid in {self.name} is kept in by its lid.", True, when)
        sentence = (
            f"The liquid in {self.name} stays {millimetres(min(self.left[k], self.after))} below what it may reach."
        )
        return Status("holds", sentence, True, when)
