"""Effect of a stop on the path on the load: a robot's own protective stop, or a soft stop that scales time.

A stop that begins at t and takes T s lets the speed factor fall from 1 to 0 at the rate -1/T, so the arm goes on along
its path for half of T. The tray's motion regressor meanwhile is w(s, s') of `salver.contact_margins.time_scaling`, in
the postures that are passed. A motion is only asked for stops that bring it to rest before its own end.
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
        instants: at which a stop begins, evenly over the motion. Doubled, twice the time.
        durations: number of durations between `shortest` and the motion's own, evenly in their logarithm.
        shortest: s, of a stop. Protective stops of collaborative arms take a tenth to a half of a second.
        steps: instants along each stop at which contact is checked.
    """

    instants: int = 40
    durations: int = 14
    shortest: float = 0.05
    steps: int = 24


@dataclass(frozen=True)
class Braking:
    """The stops on the path that keep the load.

    t (K,): s at which a stop begins. durations (M,): s that it takes. margin (K, M): the least contact margin along it,
    as a share of the weight; NaN where the motion itself ends sooner.
    """

    t: Array
    durations: Array
    margin: Array

    @property
    def shortest(self) -> Array:
        """(K,) s, of the stops that keep the load; NaN where none does that ends before the motion."""
        kept = np.where(self.margin >= 0, self.durations, np.inf).min(axis=1)
        return np.where(np.isfinite(kept), kept, np.nan)

    @property
    def kept(self) -> Array:
        """(M,) share of the instants at which a stop keeps the load, of those from which it ends before the motion."""
        return np.sum(self.margin >= 0, axis=0) / np.sum(np.isfinite(self.margin), axis=0)


def braking(model: MarginModel, tray: MotionSamples, worst: bool, options: BrakingOptions | None = None) -> Braking:
    """Stops on the path of a motion of the tray frame E at full speed, of everything rigid on it.

    tray: (T,) instants of E. worst: over the whole uncertain set, else at nominal parameters. The tray is taken to
    follow its path exactly; what moves inside loads is left out.
    """
    options = options or BrakingOptions()
    scaled, duration = TimeScaled(model, tray, worst), float(tray.t[-1] - tray.t[0])
    begins = np.linspace(0.0, duration, options.instants, endpoint=False)
    durations = np.geomspace(min(options.shortest, 0.5 * duration), 1.9 * duration, options.durations)
    share = np.linspace(0.0, 1.0, options.steps)  # of the time of a stop
    ends = begins[:, None] + 0.5 * durations  # on the motion's own clock
    k, m = np.nonzero(ends <= duration)
    places = tray.t[0] + begins[k, None] + durations[m, None] * (share - 0.5 * share**2)
    factor, rate = np.broadcast_to(1.0 - share, places.shape).ravel(), np.repeat(-1.0 / durations[m], len(share))
    at = places.ravel()
    static, moving, twist = (interpolated(tray.t, x, at) for x in (scaled.static, scaled.moving, scaled.twist))
    w = static + factor[:, None] ** 2 * moving + rate[:, None] * twist
    margins = Margins(model, np.arange(len(w), dtype=float), w)
    least = (margins.exact_worst if worst else margins.exact).reshape(places.shape).min(axis=1)
    found = np.full((options.instants, options.durations), np.nan)
    found[k, m] = least
    return Braking(tray.t[0] + begins, durations, found)
