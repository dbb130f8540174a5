"""Statistics of campaigns: confidence intervals of rates, paired comparison of two plans, quantiles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True)
class Rate:
    """count of total, with an interval that contains the true rate with a probability of at least 95 %."""

    count: int
    total: int
    low: float
    high: float

    @property
    def value(self) -> float:
        return self.count / self.total if self.total else float("nan")

    def as_dict(self) -> dict[str, float]:
        return {"count": self.count, "of": self.total, "rate": self.value, "low": self.low, "high": self.high}


def clopper_pearson(count: int, total: int) -> Rate:
    """Exact 95 % interval of a rate from `count` successes in `total` runs (Clopper and Pearson 1934).

    With nothing observed it is all of [0, 1].
    """
    from scipy.special import betaincinv  # scipy.stats takes half a second to import

    if not 0 <= count <= total:
        raise ValueError(f"count {count} is not between 0 and total {total}")
    tail = 0.025
    low = float(betaincinv(count, total - count + 1, tail)) if count > 0 else 0.0
    high = float(betaincinv(count + 1, total - count, 1 - tail)) if count < total else 1.0
    return Rate(count, total, low, high)


def mcnemar(first: npt.ArrayLike, second: npt.ArrayLike) -> dict[str, float]:
    """Comparison of two plans on the same samples: numbers of runs in which both, one, or neither succeeded, and
    McNemar's exact p (binomial, two-sided; McNemar 1947).

    first, second: booleans of equal length. p_value: probability that discordant runs are split at least this unevenly
    if neither plan is better.
    """
    from scipy.special import bdtr

    a, b = np.asarray(first, dtype=bool), np.asarray(second, dtype=bool)
    if a.shape != b.shape:
        raise ValueError(f"paired outcomes have the lengths {a.size} and {b.size}; they must be equal")
    only_first, only_second = int(np.sum(a & ~b)), int(np.sum(~a & b))
    discordant = only_first + only_second
    p = min(1.0, 2 * float(bdtr(min(only_first, only_second), discordant, 0.5))) if discordant else 1.0
    return {
        "both": int(np.sum(a & b)),
        "only_first": only_first,
        "only_second": only_second,
        "neither": int(np.sum(~a & ~b)),
        "p_value": p,
    }


QUANTILES = {"min": 0.0, "q05": 0.05, "median": 0.5, "q95": 0.95, "max": 1.0}


def quantiles(values: npt.ArrayLike) -> dict[str, float]:
    """Named quantiles (linear between order statistics) of the finite values; NaN if there are none."""
    x = np.asarray(values, dtype=float)
    x = x[np.isfinite(x)]
    if x.size == 0:
        return dict.fromkeys(QUANTILES, float("nan"))
    return {name: float(q) for name, q in zip(QUANTILES, np.quantile(x, list(QUANTILES.values())), strict=True)}
