"""BFGS with the line search of More and Thuente: to the last bit the points that SciPy's goes through.

SciPy's is a tenth of a second to import, a tenth of a short command, and its line search has changed between versions:
with this one the same plan leaves an arm in the same postures. J. Nocedal and S. Wright, "Numerical Optimization",
2006, algorithm 6.1; J. More and D. Thuente, "Line search algorithms with guaranteed sufficient decrease", ACM TOMS
20(3), 1994.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from math import isfinite

import numpy as np

from salver.geometry import Array

Slope = Callable[[Array], tuple[float, Array]]  # x (k,) to a value and its gradient (k,)

_FALL, _FLATTER = 1e-4, 0.9  # Wolfe's conditions: share of the fall that a slope promises; of the slope that is left
_EXTRAPOLATION = 1.1, 4.0  # how far beyond the last step the next one lies while no minimum is bracketed
_SHRINKING = 0.66  # of a bracket in two steps, or it is halved
_NARROW = 1e-14  # of a bracket, relative
_LEAST, _MOST, _TRIALS = 1e-100, 1e100, 99  # of a step; steps tried along a line


def descend(at: Slope, x: Array, steps: int, flat: float) -> Array:
    """Walk downhill from x (k,), so many steps at most, until no entry of the gradient exceeds `flat`: where it ends.

    at: the function and its gradient, which are not asked for twice in a row at one x.
    """
    at = _remembering(at)
    value, slope = at(x)
    before = value + float(np.linalg.norm(slope)) / 2  # what the first step may bring: a length of one
    unit = np.eye(len(x))
    inverse = unit
    for _ in range(steps):
        if not np.abs(slope).max() > flat:
            break
        way = -np.dot(inverse, slope)
        found = _along(at, x, way, value, slope, before)
        if found is None:
            break
        share, before, value, slope_there = found[0], value, found[1], found[2]
        step, turned = share * way, slope_there - slope
        x, slope = x + step, slope_there
        along = np.dot(turned, step)
        weight = 1000.0 if along == 0.0 else 1.0 / along
        left = unit - step[:, None] * turned[None, :] * weight
        right = unit - turned[:, None] * step[None, :] * weight
        inverse = np.dot(left, np.dot(inverse, right)) + weight * step[:, None] * step[None, :]
    return x


def _remembering(at: Slope) -> Slope:
    """The same, which knows what it said last."""
    last: list[tuple[Array, tuple[float, Array]]] = []

    def known(x: Array) -> tuple[float, Array]:
        if not last or not np.array_equal(last[0][0], x):
            last[:] = [(x.copy(), at(x))]
        return last[0][1]

    return known


def _along(
    at: Slope, x: Array, way: Array, value: float, slope: Array, before: float
) -> tuple[float, float, Array] | None:
    """A step along a line that meets Wolfe's conditions, as a share of it, with value and gradient there; or None."""
    falls = np.dot(slope, way)
    first = min(1.0, 1.01 * 2 * (value - before) / falls) if falls != 0 else 1.0
    search = _Search(value, falls)
    share = search.begin(1.0 if first < 0 else first)
    for _ in range(_TRIALS):
        if share is None or not isfinite(share):
            break
        there, gradient = at(x + share * way)
        trial, share = share, search.next(share, there, np.dot(gradient, way))
        if search.done:
            return trial, there, gradient
    return _thorough(at, x, way, value, slope, before)


def _thorough(
    at: Slope, x: Array, way: Array, value: float, slope: Array, before: float
) -> tuple[float, float, Array] | None:
    """As `_along`, by the search that SciPy asks where the other finds nothing."""
    from scipy.optimize import line_search

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = line_search(
            lambda y: at(y)[0], lambda y: at(y)[1], x, way, slope, value, before, c1=_FALL, c2=_FLATTER, amax=_MOST
        )
    if found[0] is None:
        return None
    gradient = at(x + found[0] * way)[1] if found[5] is None else found[5]
    return float(found[0]), float(found[3]), np.asarray(gradient)


@dataclass
class _Point:
    """A step, the value after it and the slope there along the line."""

    step: float
    value: float
    slope: float

    def tilted(self, slope: float) -> _Point:
        """Of the function less a line of this slope."""
        return _Point(self.step, self.value - self.step * slope, self.slope - slope)


class _Search:
    """More and Thuente's: the least point so far, the other end of what brackets a minimum, and the next step."""

    def __init__(self, value: float, slope: float) -> None:
        self.begins = _Point(0.0, value, slope)
        self.best = self.other = self.begins
        self.wanted = _FALL * slope
        self.bracketed, self.falling, self.done = False, True, False
        self.width, self.width_before = _MOST - _LEAST, (_MOST - _LEAST) / 0.5
        self.low, self.high = 0.0, 0.0

    def begin(self, step: float) -> float | None:
        """The first step, or None where the line does not fall."""
        self.high = step + _EXTRAPOLATION[1] * step
        return step if _LEAST <= step <= _MOST and self.begins.slope < 0 else None

    def next(self, step: float, value: float, slope: float) -> float | None:
        """The step to try after one; None when the search is over, and `done` when that one is what was looked for."""
        line = self.begins.value + step * self.wanted
        enough = value <= line
        if self.falling and enough and slope >= 0:
            self.falling = False
        self.done = bool(enough and abs(slope) <= _FLATTER * -self.begins.slope)
        stuck = self.bracketed and (step <= self.low or step >= self.high or self._narrow)
        at_most = step == _MOST and enough and slope <= self.wanted
        at_least = step == _LEAST and (not enough or slope >= self.wanted)
        if self.done or stuck or at_most or at_least:
            return None
        now, tilt = _Point(step, value, slope), 0.0
        if self.falling and value <= self.best.value and not enough:
            tilt = self.wanted  # a lower value, but not enough lower: the minimum of what it falls short by
        with np.errstate(invalid="ignore", over="ignore"):
            if tilt:
                ends = (self.best.tilted(tilt), self.other.tilted(tilt))
                best, other, step = self._narrowed(*ends, now.tilted(tilt))
                self.best, self.other = (_Point(p.step, p.value + p.step * tilt, p.slope + tilt) for p in (best, other))
            else:
                self.best, self.other, step = self._narrowed(self.best, self.other, now)
        if self.bracketed:
            apart = abs(self.other.step - self.best.step)
            if apart >= _SHRINKING * self.width_before:
                step = self.best.step + 0.5 * (self.other.step - self.best.step)
            self.width_before, self.width = self.width, apart
            self.low, self.high = sorted((self.best.step, self.other.step))
        else:
            self.low, self.high = (step + far * (step - self.best.step) for far in _EXTRAPOLATION)
        step = min(max(step, _LEAST), _MOST)
        if self.bracketed and (step <= self.low or step >= self.high or self._narrow):
            step = self.best.step
        return step

    @property
    def _narrow(self) -> bool:
        return self.high - self.low <= _NARROW * self.high

    def _narrowed(self, best: _Point, other: _Point, now: _Point) -> tuple[_Point, _Point, float]:
        """Both ends after a trial, and a step that a cubic or a line through slopes says is the lowest."""
        opposite = np.sign(now.slope) * np.sign(best.slope) < 0
        there, here = now.step, best.step
        if now.value > best.value:  # beyond a minimum
            cubic = here + _cubic(best, now, *_theta(best, now), there < here) * (there - here)
            chord = (best.value - now.value) / (there - here) + best.slope
            quadratic = here + ((best.slope / chord) / 2.0) * (there - here)
            nearer = abs(cubic - here) <= abs(quadratic - here)
            step = cubic if nearer else cubic + (quadratic - cubic) / 2.0
            self.bracketed = True
        elif opposite:
            cubic = there + _cubic(now, best, *_theta(best, now), there > here) * (here - there)
            secant = there + (now.slope / (now.slope - best.slope)) * (here - there)
            step = cubic if abs(cubic - there) > abs(secant - there) else secant
            self.bracketed = True
        elif abs(now.slope) < abs(best.slope):  # flatter: the cubic may have no minimum on this side
            step = self._flattening(best, other, now)
        elif self.bracketed:
            step = there + _cubic(now, other, *_theta(other, now), there > other.step) * (other.step - there)
        else:
            step = self.high if there > here else self.low
        if now.value > best.value:
            return best, now, step
        return now, best if opposite else other, step

    def _flattening(self, best: _Point, other: _Point, now: _Point) -> float:
        there, here = now.step, best.step
        theta, size = _theta(best, now)
        gamma = size * np.sqrt(max(0, (theta / size) ** 2 - (best.slope / size) * (now.slope / size)))
        if there > here:
            gamma = -gamma
        r = ((gamma - now.slope) + theta) / ((gamma + (best.slope - now.slope)) + gamma)
        if r < 0 and gamma != 0:
            cubic = there + r * (here - there)
        else:
            cubic = self.high if there > here else self.low
        secant = there + (now.slope / (now.slope - best.slope)) * (here - there)
        nearer = abs(cubic - there) < abs(secant - there)
        if self.bracketed:
            step, inside = cubic if nearer else secant, there + 0.66 * (other.step - there)
            return min(inside, step) if there > here else max(inside, step)
        further = cubic if abs(cubic - there) > abs(secant - there) else secant
        return min(max(further, self.low), self.high)


def _theta(end: _Point, now: _Point) -> tuple[float, float]:
    """More and Thuente's theta of the cubic through two points, and the size of what it is compared with."""
    theta = 3.0 * (end.value - now.value) / (now.step - end.step) + end.slope + now.slope
    return theta, max(abs(theta), abs(end.slope), abs(now.slope))


def _cubic(a: _Point, b: _Point, theta: float, size: float, turned: bool) -> float:
    """Share of the way from a to b at which the cubic through both values and slopes is least."""
    gamma = size * np.sqrt((theta / size) ** 2 - (a.slope / size) * (b.slope / size))
    if turned:
        gamma *= -1
    return float(((gamma - a.slope) + theta) / (((gamma - a.slope) + gamma) + b.slope))
