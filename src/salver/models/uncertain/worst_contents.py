"""The worst unknown contents of bodies for `salver.models.uncertain.worst_case`: exact for the rows that may be the
largest or near violation, an upper bound for the others."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from salver.geometry import Array, Indices
from salver.models.uncertain.contents import Filling

SURE = -0.02  # rows that may be above this are always computed exactly, so that the sign of every row is right


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

    def worst(self, fillings: tuple[Filling, ...]) -> Array:
        """Values (m,) with the worst fillings, computed one by one, with the others at their upper bounds."""
        rest, highest = list(self.most), self.known + sum(self.most)
        for j, filling in enumerate(fillings):
            others = self.known + sum(rest) - rest[j]
            rest[j] = filling.largest(self.coefficients[j], self.target - others)[0]
        return np.minimum(highest, self.known + sum(rest))


def bounded(
    fillings: tuple[Filling, ...], cases: list[ContentsCase], start: int, equal: float = 1e-6
) -> tuple[Array, list[Unsolved]]:
    """Upper bounds (T, n) of the worst case with the worst fillings, and the rows that must be computed exactly.

    These may be the largest row of an instant, or above `SURE`; their values are -inf. start: index of the first
    instant. equal: share of the weight by which bounds of one value may differ.
    """
    limits = [[f.limits(of) for f, of in zip(fillings, case.coefficients, strict=True)] for case in cases]
    low, high = (
        np.array([c.value + sum(limit[side] for limit in each) for c, each in zip(cases, limits, strict=True)])
        for side in (0, 1)
    )
    matters = np.minimum(low.max(axis=(0, 2)), SURE)[None, :, None]
    needed, unsolved = (high > matters) & (high - low > equal), []
    for case, each, at in zip(cases, limits, needed, strict=True):
        instant, row = np.nonzero(at)
        if len(row):
            most, coefficients = [limit[1][at] for limit in each], [of[at] for of in case.coefficients]
            target = matters[0, instant, 0]
            unsolved.append(Unsolved(np.stack([start + instant, row]), case.value[at], most, coefficients, target))
    high[needed] = -np.inf
    return np.asarray(high.max(axis=0)), unsolved
