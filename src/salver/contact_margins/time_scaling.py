"""Speed factors at which a motion keeps its load.

A motion run at speed factor s, which changes at the rate s' (1/s), has velocities s v and accelerations s^2 a + s' v.
So the motion regressor of the tray is

    w(s, s') = w_static + s^2 (w(1) - w_static) + s' (twist, 0),

with w_static at rest in the same posture, and twist = (R^T v, omega) at full speed. A contact margin is concave in w,
and so in (s^2, s'), also in the worst case. So a load that holds at rest in every posture and at full speed holds at
every factor between, and the factors at which it holds are one interval. Liquids and pendulums have their own time
scale: with them, factors are checked on a grid, which is refined where the margin is small.

The tray is assumed to follow its motion exactly at every speed.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import groupby, pairwise
from typing import Any

import numpy as np

from salver.contact_margins.model import MarginModel
from salver.contact_margins.root_finding import zero_between
from salver.contact_margins.values import TOLERANCE
from salver.contact_margins.whole import Margins
from salver.dynamics.payload_response import PayloadResponse
from salver.errors import Status
from salver.geometry import Array, Indices
from salver.models.tray_motion import motion_vector
from salver.trajectory import MotionSamples

TRIED = np.append(0.0, 1.04 ** np.arange(-59.0, 1.0))  # factors that are checked with a liquid or pendulum
_HAPPENS = {"unsettled": "still sloshes"}

Intervals = tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class SpeedSearch:
    """Options of the search for speed factors.

    Attributes:
        slowest: least factor; the time of a load at rest is that at this factor.
        fastest: largest factor.
        finest: resolution of the limits of the factor with a liquid or pendulum.
        few: step through `TRIED` for a quick look.
        ripple: share of the limits by which the remaining margin varies at low factors without a resonance.
    """

    slowest: float = 0.01
    fastest: float = 5.0
    finest: float = 1e-3
    few: int = 4
    ripple: float = 0.02


SEARCH = SpeedSearch()


@dataclass(frozen=True)
class SafeSpeeds:
    """The constant speed factors at which a motion keeps its load.

    intervals: safe intervals of factors from 0 to 1, in order. fastest: largest safe factor, possibly above 1; None if
    there is none. fails_at, failure: a factor just below the uppermost interval (or above it, if that begins at 0), and
    the status there; None if all factors from 0 to 1 are safe. tried: number of factors that were checked; 0 if the
    intervals are exact. lacking: for each unsafe range the checked factor with the largest violation. unchecked:
    limitations at other speeds, in words.
    """

    intervals: Intervals
    fastest: float | None
    worst: bool
    fails_at: float | None = None
    failure: Status | None = None
    tried: int = 0
    lacking: tuple[float, ...] = ()
    unchecked: str = ""

    @property
    def every(self) -> bool:
        """Whether the load is kept at every speed from 0 to full speed."""
        return self.intervals == ((0.0, 1.0),)

    @property
    def pace(self) -> Status:
        """The shortest time in which the path holds: details["factor"] times the duration, None if there is none."""
        if self.fastest is None:
            return Status("tilted", self.sentence, False, {"factor": None})
        tried = ", and at no less that was tried" if self.tried else ""
        sentence = f"It just holds at {1 / self.fastest:.3f} times the duration{tried}."
        return Status("found", sentence, True, {"factor": 1 / self.fastest})

    @property
    def sentence(self) -> str:
        blind = f"Not checked at other speeds: {self.unchecked}. " if self.unchecked else ""
        return blind + self.verdict

    @property
    def verdict(self) -> str:
        """The verdict without the list of what was not checked."""
        tried = f" ({self.tried} speeds were tried)" if self.tried else ""
        if self.every:
            return f"Holds at every speed from 0 to 100 %{tried}."
        case, failure = " in the worst case" if self.worst else "", self.failure
        assert failure is not None
        assert self.fails_at is not None
        what = f"{failure.details['interface']} {_HAPPENS.get(failure.code, failure.code)}{case}"
        speed = f"at {100 * self.fails_at:.3g} %" if self.fails_at else "standing still"
        return f"{self._ranges()}: {speed} {what}, in the posture of {failure.details['posture_time']:.3f} s{tried}."

    def _ranges(self) -> str:
        parts = [(max(0.0, np.ceil(100 * low - 1e-6)), np.floor(100 * high + 1e-6)) for low, high in self.intervals]
        if not parts:
            return "Holds at no speed from 0 to 100 %"
        if len(parts) == 1 and parts[0][1] == 100:
            return "Only at full speed" if parts[0][0] == 100 else f"Only at {parts[0][0]:g} to 100 % of full speed"
        told = " and ".join(f"{low:g} to {high:g} %" if high > low else f"{low:g} %" for low, high in parts)
        return f"Holds at {told} of full speed"

    def summary(self) -> dict[str, Any]:
        """The result as a JSON object."""
        return {
            "every": self.every,
            "unchecked": self.unchecked,
            "sentence": self.sentence,
            "intervals": [list(each) for each in self.intervals],
            "fails_at": self.fails_at,
            "code": None if self.failure is None else self.failure.code,
            "posture_time": None if self.failure is None else self.failure.details["posture_time"],
            "tried": self.tried,
        }


def safe_speeds(model: MarginModel, tray: MotionSamples, worst: bool) -> SafeSpeeds:
    """The speed factors at which a motion of the tray frame E keeps the load.

    tray: (T,) instants of E at full speed. worst: over the whole uncertain set, else at nominal parameters.
    """
    scaled = TimeScaled(model, tray, worst)
    tried, lacking = 0, tuple[float, ...]()
    if model.payload.dynamic:
        intervals, fastest, tried, lacking = _tried(scaled)
    else:
        intervals, fastest = _exact(scaled)
    fails_at, failure = scaled.failure(intervals)
    return SafeSpeeds(intervals, fastest, worst, fails_at, failure, tried, lacking)


@dataclass(frozen=True, eq=False)
class TimeScaled:
    """A motion of the tray at other speeds. tray: (T,) instants of E at full speed."""

    model: MarginModel
    tray: MotionSamples
    worst: bool

    @cached_property
    def static(self) -> Array:
        """Motion regressor (T, 12) of the tray at rest in each posture."""
        zero = np.zeros_like(self.tray.v_S)
        return motion_vector(self.tray.R_SB, zero, zero, zero)

    @cached_property
    def moving(self) -> Array:
        """Motion regressor (T, 12) at full speed minus `static`."""
        s = self.tray
        return motion_vector(s.R_SB, s.a_S, s.omega_B, s.alpha_B) - self.static

    @cached_property
    def twist(self) -> Array:
        """Twist of the tray in E at full speed, padded with zeros (T, 12)."""
        s = self.tray
        return np.hstack([np.einsum("tji,tj->ti", s.R_SB, s.v_S), s.omega_B, np.zeros((len(s.t), 6))])

    def w(self, squared: float, rate: float = 0.0, at: Indices | slice = slice(None)) -> Array:
        """Motion regressor (T, 12) at the square of a factor and a rate of the factor, 1/s."""
        return np.asarray(self.static[at] + squared * self.moving[at] + rate * self.twist[at])

    def margin(self, squared: float, rate: float = 0.0, at: Indices | slice = slice(None)) -> Array:
        """Least margin (T,) of all contacts, as a share of the weight."""
        margins = Margins(self.model, self.tray.t[at], self.w(squared, rate, at))
        return (margins.exact_worst if self.worst else margins.exact) + TOLERANCE

    def margins(self, factor: float) -> Margins:
        """All margins at a constant factor, over the stretched time; at factor 0 over that of the slowest one."""
        w, t = self.w(factor**2), (self.tray.t - self.tray.t[0]) / (factor or SEARCH.slowest)
        return Margins(self.model, t, w, None if self._loads is None else self._loads.elsewhere(t, w))

    @cached_property
    def _loads(self) -> PayloadResponse | None:
        """At full speed."""
        return PayloadResponse.along(self.model.payload, self.tray.t, self.w(1.0))

    def slack(self, factor: float) -> float:
        """Least of all contact margins and slacks of liquids and pendulums, as shares."""
        margins = self.margins(factor)
        inside = min((float(each.slack.min()) for each in margins.load_verdicts(self.worst)), default=np.inf)
        if inside < 0:
            return inside
        return min(inside, float((margins.exact_worst if self.worst else margins.exact).min()) + TOLERANCE)

    def failure(self, intervals: Intervals) -> tuple[float | None, Status | None]:
        """An unsafe factor beside the uppermost interval, and the status there."""
        if intervals == ((0.0, 1.0),):
            return None, None
        low, high = intervals[-1] if intervals else (0.0, 0.0)
        if not intervals:  # then it does not hold standing still either
            beside = [0.0]
        elif low > 0:
            below = intervals[-2][1] if len(intervals) > 1 else 0.0
            beside = [(np.ceil(100 * low - 1e-6) - 1) / 100, 0.5 * (low + below), below]
        else:
            beside = [(np.floor(100 * high + 1e-6) + 1) / 100, 0.5 * (1 + high), 1.0]
        for factor in map(float, beside):
            status = self.margins(factor).verdict(self.worst)
            if not status.ok:
                break
        else:  # the verdict has finer pyramids
            factor, status = float(beside[0]), replace(status, code="slides", ok=False)
        posture = float(status.details["time"]) * (factor or SEARCH.slowest)
        return factor, replace(status, details={**status.details, "posture_time": posture})


def _exact(scaled: TimeScaled) -> tuple[Intervals, float | None]:
    """The interval of factors of a load without inner dynamics, and the largest of them."""
    still, full = (scaled.margin(squared).min() >= 0 for squared in (0.0, 1.0))
    inside = 1.0 if full else 0.0 if still else _between(scaled)
    if inside is None:
        return (), None
    low, high = _edge(scaled, inside, 0.0), _edge(scaled, inside, 1.0 if inside < 1 else SEARCH.fastest**2)
    if high < SEARCH.slowest**2:
        return (), None
    return ((float(np.sqrt(low)), float(np.sqrt(min(high, 1.0)))),) if low <= 1 else (), float(np.sqrt(high))


def _between(scaled: TimeScaled) -> float | None:
    """The square of a factor at which all holds, of a motion that holds neither standing still nor at full speed: where
    the least margin is largest."""
    from scipy.optimize import minimize_scalar

    found = minimize_scalar(
        lambda squared: -scaled.margin(squared).min(),
        bounds=(0.0, SEARCH.fastest**2),
        method="bounded",
        options={"xatol": 1e-9},
    )
    return float(found.x) if found.fun <= 0 else None


def _edge(scaled: TimeScaled, inside: float, outside: float) -> float:
    """The last safe squared factor on the way from a safe one (`inside`) to another (`outside`), to a millionth of it.

    By concavity only the instants that fail at the end can fail on the way.
    """
    failing = np.flatnonzero(scaled.margin(outside) < 0)
    if not len(failing):
        return outside

    def left(squared: float) -> float:
        return float(scaled.margin(squared, at=failing).min())

    if left(inside) <= 0:  # margins of fewer instants are rounded differently, and a zero needs both signs
        return inside
    if left(outside) >= 0:
        return outside
    return inside + (1 - 1e-6) * (zero_between(left, inside, outside, 1e-9) - inside)


def _tried(scaled: TimeScaled) -> tuple[Intervals, float | None, int, tuple[float, ...]]:
    """For a load with a liquid or pendulum: safe intervals of factors up to 1, the largest safe factor, the number of
    checked factors, and the worst factor of each unsafe range."""
    known = {float(s): scaled.slack(float(s)) for s in TRIED}
    while True:
        factors = sorted(known)
        between = []
        for a, b in pairwise(factors):
            edge = (known[a] < 0) != (known[b] < 0)
            # Between two safe factors another may be unsafe, if their slacks differ by more than what remains.
            near = 0 <= min(known[a], known[b]) < abs(known[a] - known[b])
            if b - a > (SEARCH.finest if edge else 8 * SEARCH.finest) and (edge or near):
                between.append(0.5 * (a + b))
        if not between:
            break
        known |= {s: scaled.slack(s) for s in between}
    runs = [(kept, list(run)) for kept, run in groupby(factors, key=lambda s: known[s] >= 0)]
    holds = tuple((run[0], run[-1]) for kept, run in runs if kept)
    lacking = tuple(min(run, key=known.__getitem__) for kept, run in runs if not kept)
    fastest = holds[-1][1] if holds else None
    return holds, _above(scaled) if fastest == 1.0 else fastest, len(known), lacking


def lacking_of_few(model: MarginModel, tray: MotionSamples) -> tuple[float, ...]:
    """Factors up to 1 at which a load with inner dynamics is not kept, in the worst case: the worst factor, and every
    resonance, where the margin is smaller than beside it and than at rest. Few factors are tried, and all of `TRIED`
    beside those that fail; an empty result is no proof (see `safe_speeds`).
    """
    scaled, known, few = TimeScaled(model, tray, worst=True), dict[int, float](), SEARCH.few

    def look(numbers: Iterable[int]) -> None:
        known.update({k: scaled.slack(float(TRIED[k])) for k in numbers})

    look(range(0, len(TRIED), few))
    failing = [k for k in known if known[k] < 0]
    look({j for k in failing for j in range(max(k - few, 0), min(k + few, len(TRIED)))} - known.keys())
    most = min(0.0, known[0] - SEARCH.ripple)
    found = {k for k in known if known[k] < min(most, *(known.get(j, np.inf) for j in (k - 1, k + 1)))}
    found |= {k for k in known if known[k] == min(known.values()) < 0}
    return tuple(float(TRIED[k]) for k in sorted(found))


def _above(scaled: TimeScaled) -> float:
    """The largest factor above 1 up to which all checked ones are safe, for a load with a liquid or pendulum."""
    low, high = 1.0, 1.04
    while high < SEARCH.fastest and scaled.slack(high) >= 0:
        low, high = high, 1.04 * high
    while high - low > SEARCH.finest and high < SEARCH.fastest:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if scaled.slack(middle) >= 0 else (low, middle)
    return low
