"""How near a liquid comes to its brim along a motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from salver.dynamics.load_limits import LIGHTEST, LoadVerdict
from salver.errors import Status
from salver.geometry import Array
from salver.models.load_dynamics import LEAST_WEIGHT

# Groups of its limits, in words.
HIGH = "what they may reach"
STEEP = "the steepness to which they are known"


@dataclass(frozen=True, eq=False)
class Spill(LoadVerdict):
    """How near one liquid comes to its brim, at its worst case.

    size: (T,) m of the crest, the highest of all cases. left: (T,) m of room over it, least of all cases; infinite
    under a lid. after: the same for good after the motion. steep: (T,) free wave over the largest for which the model
    is valid, at the end of all that are left. light: (T,) share of its weight that does not press, over the largest for
    which it is. settled: m that waves are lower than wanted, some time after the motion; infinite if nothing is wanted.
    """

    left: Array
    after: float
    steep: Array
    light: Array
    settled: float

    @property
    def room(self) -> float:
        """m that are left under the brim, during the motion and after it."""
        return min(float(self.left.min()), self.after)

    def status(self, case: str = "") -> Status:
        """Whether one liquid stays in its container, in one sentence. case: words for the parameters."""
        k = int(np.argmin(self.left))
        when = {"interface": self.name, "time": float(self.t[k]), "left": float(self.left[k])}
        end = float(self.t[-1])
        if np.isfinite(self.left[k]) and self.left[k] < 0:
            first = float(self.t[np.argmax(self.left < 0)])
            sentence = f"The liquid in {self.name} {case}comes {_mm(-self.left[k])} too high at {self.t[k]:.3f} s"
            return Status("spills", f"{sentence}, the first time at {first:.3f} s.", False, when | {"time": first})
        if self.steep.max() > 1:
            sentence = (
                f"The waves in {self.name} {case}become {self.steep.max():.2f} times as steep as what the model "
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
            sentence = f"The liquid in {self.name} {case}comes {_mm(-self.after)} too high after the motion."
            return Status("spills", sentence, False, when | {"time": end})
        if self.settled < 0:
            sentence = (
                f"The waves in {self.name} {case}are {_mm(-self.settled)} higher after the motion than is wanted."
            )
            return Status("unsettled", sentence, False, when | {"time": end})
        if not np.isfinite(self.left[k]):
            return Status("holds", f"The liquid in {self.name} is kept in by its lid.", True, when)
        sentence = f"The liquid in {self.name} stays {_mm(min(self.left[k], self.after))} below what it may reach."
        return Status("holds", sentence, True, when)


def _mm(metres: float) -> str:
    return f"{1e3 * metres:.1f} mm"
