"""Statistics of campaigns: confidence intervals of rates, paired comparison of two plans, quantiles."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True)
class Rate:
    """count of total, with an interval that contains the true rate with at least `level` probability."""

    count: int
    total: int
    low: float
    high: float
    level: float = 0.95

    @property
    def value(self) -> float:
        return self.count / self.total if self.total else float("nan")

    def as_dict(self) -> dict[str, float]:
        return {"count": self.count, "of": self.total, "rate": self.value, "low": self.low, "high": self.high}


def clopper_pearson(count: int, total: int, level: float = 0.95) -> Rate:
    """Exact interval of a rate from `count` successes in `total` runs (Clopper and Pearson 1934).

    It never covers less than `level`; with nothing observed it is all of [0, 1].
    """
    from scipy.special import betaincinv  # scipy.stats takes half a second to import

    if not 0 <= count <= total:
        raise ValueError(f"count {count} is not between 0 and total {total}")
    if not 0 < level < 1:
        raise ValueError(f"level {level} is not between 0 and 1")
    tail = 0.5 * (1 - level)
    low = float(betaincinv(count, total - count + 1, tail)) if count > 0 else 0.0
    high = float(betaincinv(count + 1, total - count, 1 - tail)) if count < total else 1.0
    return Rate(count, total, low, high, level)


@dataclass(frozen=True)
class Paired:
    """Comparison of two plans on the same samples: runs in which both, one, or neither succeeded; McNemar's exact p.

    p_value: probability that discordant runs are split at least this unevenly if neither plan is better.
    """

    both: int
    only_first: int
    only_second: int
    neither: int
    p_value: float

    def as_dict(self) -> dict[str, float]:
        return dict(self.__dict__)


def mcnemar(first: npt.ArrayLike, second: npt.ArrayLike) -> Paired:
    """Exact (binomial, two-sided) McNemar test of paired outcomes (McNemar 1947): booleans of equal length."""
    from scipy.special import bdtr

    a, b = np.asarray(first, dtype=bool), np.asarray(second, dtype=bool)
    if a.shape != b.shape:
        raise ValueError(f"paired outcomes have the lengths {a.size} and {b.size}; they must be equal")
    only_first, only_second = int(np.sum(a & ~b)), int(np.sum(~a & b))
    discordant = only_first + only_second
    p = min(1.0, 2 * float(bdtr(min(only_first, only_second), discordant, 0.5))) if discordant else 1.0
    return Paired(int(np.sum(a & b)), only_first, only_second, int(np.sum(~a & ~b)), p)


QUANTILES = {"min": 0.0, "q05": 0.05, "median": 0.5, "q95": 0.95, "max": 1.0}


def quantiles(values: npt.ArrayLike, at: Mapping[str, float] = QUANTILES) -> dict[str, float]:
    """Named quantiles (linear between order statistics) of the finite values; NaN if there are none."""
    x = np.asarray(values, dtype=float)
    x = x[np.isfinite(x)]
    if x.size == 0:
        return dict.fromkeys(at, float("nan"))
    return {name: float(q) for name, q in zip(at, np.quantile(x, list(at.values())), strict=True)}
