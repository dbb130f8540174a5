"""How much slower or faster the same path could be run so that everything just holds.

Run s times slower, accelerations and products of velocities fall by s^2 and gravity stays:
w = w_rest + (w_1 - w_rest) / s^2. The margin is concave in 1/s^2, so what holds at one pace holds at all slower ones
that gravity allows. Waves keep time of their own, so that with a liquid slower is not always calmer, and paces are
tried one by one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from salver.contact_margins import MarginModel, Margins
from salver.contact_margins.whole import spill_status
from salver.errors import Status
from salver.geometry import Array, Indices
from salver.models.tray_motion import motion_vector
from salver.sensitivity.spills import Liquids

PACES = 1.03 ** np.arange(60)  # at which a motion with a liquid is looked at: up to 5.7 times slower
SLOWEST = 100.0  # times the duration: a path that needs more is called impossible
FASTEST = 0.2
BEYOND = 1.001  # times what no margin lasts to: worst cases of contents are known to a thousandth of their curvature


@dataclass(frozen=True)
class Pace:
    """Uniform time scaling of the same path, at which it just holds.

    factor: of the duration; above 1 it must be run slower, below 1 it could be run faster. None when no pace
    would do, because gravity alone fails somewhere on the path: status says where.
    """

    factor: float | None
    status: Status


def pace(margins: Margins, R_SB: Array, worst: bool) -> Pace:
    """Of a motion with these margins, at whose instants the tray is turned by R_SB (T, 3, 3)."""
    w, rest = margins.w, _resting(R_SB)
    here = margins.exact_worst if worst else margins.exact
    least = _margin(margins.model, rest, worst)
    if least.min() < 0:
        when = float(margins.t[int(np.argmin(least))])
        case = " in the worst case" if worst else ""
        sentence = f"The tray is tilted too far at {when:.3f} s: even at rest there nothing would hold{case}."
        return Pace(None, Status("tilted", sentence, False, {"time": when}))
    slowest, fastest = 1 / SLOWEST**2, 1 / FASTEST**2  # of 1/s^2

    def margin(share: float, at: Indices) -> Array:
        return _margin(margins.model, rest[at] + share * (w[at] - rest[at]), worst)

    # What holds at rest and at a pace holds at every slower one, as margins are concave.
    if here.min() < 0:
        low, high, failing = slowest, 1.0, np.flatnonzero(here < 0)
        begin, end = margin(slowest, failing), here[failing]
        if begin.min() < 0:
            return Pace(None, Status("tilted", f"Even {SLOWEST:g} times slower the path would not hold.", False))
    else:
        # Nor does anything hold beyond where the line through rest and here ends: far beyond, all would be sought.
        everywhere = np.arange(len(w))
        ends = np.divide(least, least - here, out=np.full(len(w), np.inf), where=least > here)
        low, high = 1.0, min(fastest, BEYOND * float(ends.min()))
        beyond = margin(high, everywhere)
        if beyond.min() >= 0 and high < fastest:
            high, beyond = fastest, margin(fastest, everywhere)
        failing = np.flatnonzero(beyond < 0)
        begin, end = here[failing], beyond[failing]
    share = _least_root(lambda share, some: margin(share, failing[some]), low, high, begin, end)
    factor = float(1 / np.sqrt(share))
    return Pace(factor, Status("found", f"It just holds at {factor:.3f} times the duration.", True, {"factor": factor}))


def pace_of_liquids(model: MarginModel, t: Array, w: Array, R_SB: Array, worst: bool) -> Pace:
    """The least slowing, from the motion's own pace on, at which nothing spills or slides; of w (T, ...) at t (T,)."""
    rest = _resting(R_SB)
    for factor in PACES:
        felt = rest + (w - rest) / factor**2
        slower = factor * (t - t[0])
        liquids = Liquids.along(model.payload, slower, felt)
        if liquids is not None and not all(spill_status(spill).ok for spill in liquids.spills(worst)):
            continue  # contact takes longer to look at
        if Margins(model, slower, felt, None, liquids).verdict(worst).ok:
            sentence = f"It holds at {factor:.3f} times the duration, and at no less that was tried."
            return Pace(float(factor), Status("found", sentence, True, {"factor": float(factor)}))
    sentence = f"Up to {PACES[-1]:.3g} times slower the path would not hold."
    return Pace(None, Status("tilted", sentence, False))


def _resting(R_SB: Array) -> Array:
    zero = np.zeros((len(R_SB), 3))
    return motion_vector(R_SB, zero, zero, zero)


def _margin(model: MarginModel, w: Array, worst: bool) -> Array:
    margins = Margins(model, np.arange(float(len(w))), w)
    return margins.exact_worst if worst else margins.exact


def _least_root(f: Callable[[float, Indices], Array], low: float, high: float, begin: Array, end: Array) -> float:
    """Where the first of n concave functions turns negative between low, at which they are begin (n,), none negative,
    and high, at which they are end (n,), all negative: to 1e-6, on the side where none has; high where there is none.

    f: of a place, those that are asked for. A function lies above its chord: one whose chord ends beyond a root that is
    known is not asked again, and few are near the least.
    """
    from scipy.optimize import brentq

    if not len(begin):
        return high
    some, root = np.arange(len(begin)), high
    while len(some):
        ending = low + (root - low) * begin / (begin - end)
        k = int(np.argmin(ending))
        known = {low: float(begin[k]), root: float(end[k])}

        def first(x: float, one: Indices = some[[k]], known: dict[float, float] = known) -> float:
            return known[x] if x in known else float(f(x, one)[0])

        near = ending < root
        near[k] = False
        root = float(brentq(first, low, root, rtol=1e-7))
        some, begin = some[near], begin[near]
        end = f(root, some) if len(some) else begin
        some, begin, end = some[end < 0], begin[end < 0], end[end < 0]
    return max(low, root * (1 - 1e-6))
