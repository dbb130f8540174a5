"""Whether the load stays during a stop on the path: a robot's own protective stop, or a soft stop that scales time.

During a stop of duration T the speed factor falls from 1 to 0 at the rate -1/T, and the arm continues on its path, as
far as it would go in T/2 at full speed. The motion regressor of the tray is then w(s, s') of
`salver.contact_margins.time_scaling`. Only stops that end before the motion itself are checked.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from salver.contact_margins.model import MarginModel
from salver.contact_margins.time_scaling import TimeScaled
from salver.contact_margins.whole import Margins
from salver.geometry import Array, interpolated
from salver.trajectory import MotionSamples


@dataclass(frozen=True)
class BrakingOptions:
    """The stops that are checked.

    Attributes:
        instants: number of instants at which a stop begins, evenly over the motion. With twice the number the check
            takes twice the time.
        durations: number of durations from `shortest` to the motion's own, evenly in their logarithm.
        shortest: s, shortest stop. Protective stops of collaborative arms take a tenth to a half of a second.
        steps: instants along each stop at which contact is checked.
    """

    instants: int = 40
    durations: int = 14
    shortest: float = 0.05
    steps: int = 24


@dataclass(frozen=True)
class Braking:
    """Margins of the load during stops on the path.

    durations (M,): s. margin (K, M): least contact margin during a stop from each of K instants, evenly over the
    motion, as a share of the weight; NaN if the motion itself ends sooner.
    """

    durations: Array
    margin: Array

    @property
    def kept(self) -> Array:
        """Share (M,) of instants from which a stop of each duration keeps the load, if it ends before the motion."""
        return np.sum(self.margin >= 0, axis=0) / np.sum(np.isfinite(self.margin), axis=0)


def braking(model: MarginModel, tray: MotionSamples, worst: bool, options: BrakingOptions | None = None) -> Braking:
    """Check stops on the path of a motion of the tray frame E at full speed, for a rigid load.

    tray: (T,) instants of E. worst: over the whole uncertain set, else at nominal parameters. The tray is assumed to
    follow its path exactly; liquids and pendulums are not considered.
    """
    options = options or BrakingOptions()
    scaled, duration = TimeScaled(model, tray, worst), float(tray.t[-1] - tray.t[0])
    begins = np.linspace(0.0, duration, options.instants, endpoint=False)
    durations = np.geomspace(min(options.shortest, 0.5 * duration), 1.9 * duration, options.durations)
    share = np.linspace(0.0, 1.0, options.steps)  # shares of the duration of a stop
    k, m = np.nonzero(begins[:, None] + 0.5 * durations <= duration)
    places = tray.t[0] + begins[k, None] + durations[m, None] * (share - 0.5 * share**2)
    factor = np.broadcast_to(1.0 - share, places.shape).ravel()[:, None]
    static, moving, twist = (
        interpolated(tray.t, x, places.ravel()) for x in (scaled.static, scaled.moving, scaled.twist)
    )
    w = static + factor**2 * moving - np.repeat(1.0 / durations[m], len(share))[:, None] * twist
    margins = Margins(model, np.arange(len(w), dtype=float), w)
    found = np.full((options.instants, options.durations), np.nan)
    found[k, m] = (margins.exact_worst if worst else margins.exact).reshape(places.shape).min(axis=1)
    return Braking(durations, found)
