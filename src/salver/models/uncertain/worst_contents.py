"""The worst contents of rows over an uncertain set (`salver.models.uncertain.worst_case`): those that matter are
sought, all side by side, and of the others a bound is enough."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from salver.geometry import Array, Indices
from salver.models.uncertain.contents import Filling

SURE = -0.02  # rows beyond this are always worked out, so that the sign of every row is right
_SETTLED = 1e-6  # of the weight: a bound that is within this of a value is the value


@dataclass(frozen=True)
class ContentsCase:
    """Values (T, n) of rows but for their fillings, and those fillings' coefficients (T, n, 9), in one case."""

    value: Array
    coefficients: list[Array]


@dataclass(frozen=True)
class Open:
    """Of m rows at instants at which it can matter, each in one case, what is not known: the worst fillings.

    at (2, m): instants and rows. known: (m,) without fillings; most: (m,) what each of these adds at most, by
    coefficients: (m, 9). target: (m,) below which no value needs to be improved.
    """

    at: Indices
    known: Array
    most: list[Array]
    coefficients: list[Array]
    target: Array

    @classmethod
    def joined(cls, parts: list[Open]) -> Open:
        at = np.concatenate([part.at for part in parts], axis=1)
        known, target = (np.concatenate([getattr(part, name) for part in parts]) for name in ("known", "target"))
        most, coefficients = (
            [np.concatenate(each) for each in zip(*(getattr(part, name) for part in parts), strict=True)]
            for name in ("most", "coefficients")
        )
        return cls(at, known, most, coefficients, target)

    @cached_property
    def highest(self) -> Array:
        """(m,) that is not exceeded."""
        return self.known + sum(self.most)

    def only(self, some: Indices, target: Array) -> Open:
        """Some of the rows, with other targets."""
        most, coefficients = [x[some] for x in self.most], [x[some] for x in self.coefficients]
        return Open(self.at[:, some], self.known[some], most, coefficients, target)

    def worst(self, fillings: tuple[Filling, ...]) -> Array:
        """(m,) with the worst fillings. One after the other: while one is computed, the others are at their most."""
        rest = list(self.most)
        for j, filling in enumerate(fillings):
            others = self.known + sum(rest) - rest[j]
            rest[j] = filling.largest(self.coefficients[j], self.target - others)[0]
        return np.minimum(self.highest, self.known + sum(rest))


def bounded(fillings: tuple[Filling, ...], cases: list[ContentsCase], start: int) -> tuple[Array, list[Open]]:
    """(T, n) a bound on the worst of the cases with the worst fillings, but for what is open: the largest row of an
    instant, and rows near or beyond their edge. Instants are counted from `start`."""
    limits = [[f.limits(of) for f, of in zip(fillings, case.coefficients, strict=True)] for case in cases]
    low, high = (
        np.array([c.value + sum(limit[side] for limit in each) for c, each in zip(cases, limits, strict=True)])
        for side in (0, 1)
    )
    matters = np.minimum(low.max(axis=(0, 2)), SURE)[None, :, None]
    needed, open_ = (high > matters) & (high - low > _SETTLED), []
    for case, each, at in zip(cases, limits, needed, strict=True):
        instant, row = np.nonzero(at)
        if len(row):
            most, coefficients = [limit[1][at] for limit in each], [of[at] for of in case.coefficients]
            target = matters[0, instant, 0]
            open_.append(Open(np.stack([start + instant, row]), case.value[at], most, coefficients, target))
    high[needed] = -np.inf
    return np.asarray(high.max(axis=0)), open_


def fill(fillings: tuple[Filling, ...], open_: list[Open], values: Array) -> None:
    """Values (T, n) are made those of what is open, where these are larger: all of it side by side, for a search asks
    little of a single row. First of each instant the row that may be largest: others need not be sought that are not
    as large."""
    every = Open.joined(open_)
    last = np.lexsort((every.highest, every.at[0]))
    last = last[np.append(np.diff(every.at[0][last]) > 0, True)]
    first = every.only(last, every.target[last])
    found, known = first.worst(fillings), np.full(len(values), -np.inf)
    known[first.at[0]] = np.minimum(found, SURE)
    target, worst = np.maximum(every.target, known[every.at[0]]), every.highest.copy()
    worst[last] = found
    left = every.highest > target
    left[last] = False
    others = np.flatnonzero(left)
    worst[others] = every.only(others, target[others]).worst(fillings)
    np.maximum.at(values, tuple(every.at), worst)
