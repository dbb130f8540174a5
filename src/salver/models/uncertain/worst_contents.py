"""The worst unknown contents of bodies for `salver.models.uncertain.worst_case`: exact for the rows that may be the
largest or near violation, an upper bound for the others."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from salver.geometry import Array, Indices
from salver.models.uncertain.contents import Filling

SURE = -0.02  # rows that may be above this are always computed exactly, so that the sign of every row is right
_SETTLED = 1e-6  # of the weight; bounds that differ by less are equal


@dataclass(frozen=True)
class ContentsCase:
    """One candidate of the worst case: values (T, n) of rows without fillings, coefficients (T, n, 9) of fillings."""

    value: Array
    coefficients: list[Array]


@dataclass(frozen=True)
class Unsolved:
    """m rows whose worst fillings must still be computed, each at an instant and in one case.

    at: (2, m) instants and rows. known: (m,) values without fillings. most: for each filling, (m,) upper bounds of its
    contribution. coefficients: for each filling, (m, 9). target: (m,) values below which results need not be exact.
    """

    at: Indices
    known: Array
    most: list[Array]
    coefficients: list[Array]
    target: Array

    @classmethod
    def joined(cls, parts: list[Unsolved]) -> Unsolved:
        at = np.concatenate([part.at for part in parts], axis=1)
        known, target = (np.concatenate([getattr(part, name) for part in parts]) for name in ("known", "target"))
        most, coefficients = (
            [np.concatenate(each) for each in zip(*(getattr(part, name) for part in parts), strict=True)]
            for name in ("most", "coefficients")
        )
        return cls(at, known, most, coefficients, target)

    @cached_property
    def highest(self) -> Array:
        """Upper bounds (m,) of the values with the worst fillings."""
        return self.known + sum(self.most)

    def only(self, some: Indices, target: Array) -> Unsolved:
        """Some of the rows, with other targets."""
        most, coefficients = [x[some] for x in self.most], [x[some] for x in self.coefficients]
        return Unsolved(self.at[:, some], self.known[some], most, coefficients, target)

    def worst(self, fillings: tuple[Filling, ...]) -> Array:
        """Values (m,) with the worst fillings, computed one by one, with the others at their upper bounds."""
        rest = list(self.most)
        for j, filling in enumerate(fillings):
            others = self.known + sum(rest) - rest[j]
            rest[j] = filling.largest(self.coefficients[j], self.target - others)[0]
        return np.minimum(self.highest, self.known + sum(rest))


def bounded(fillings: tuple[Filling, ...], cases: list[ContentsCase], start: int) -> tuple[Array, list[Unsolved]]:
    """Upper bounds (T, n) of the worst case with the worst fillings, and the rows that must be computed exactly.

    These may be the largest row of an instant, or above `SURE`; their values are -inf. start: index of the first
    instant.
    """
    limits = [[f.limits(of) for f, of in zip(fillings, case.coefficients, strict=True)] for case in cases]
    low, high = (
        np.array([c.value + sum(limit[side] for limit in each) for c, each in zip(cases, limits, strict=True)])
        for side in (0, 1)
    )
    matters = np.minimum(low.max(axis=(0, 2)), SURE)[None, :, None]
    needed, unsolved = (high > matters) & (high - low > _SETTLED), []
    for case, each, at in zip(cases, limits, needed, strict=True):
        instant, row = np.nonzero(at)
        if len(row):
            most, coefficients = [limit[1][at] for limit in each], [of[at] for of in case.coefficients]
            target = matters[0, instant, 0]
            unsolved.append(Unsolved(np.stack([start + instant, row]), case.value[at], most, coefficients, target))
    high[needed] = -np.inf
    return np.asarray(high.max(axis=0)), unsolved


def fill(fillings: tuple[Filling, ...], unsolved: list[Unsolved], values: Array) -> None:
    """Raise values (T, n), in place, to the exact worst cases of unsolved rows.

    The searches run for all rows together, because a search for a single row is inefficient: first for the row of each
    instant that may be the largest, then for rows that may exceed it.
    """
    every = Unsolved.joined(unsolved)
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
