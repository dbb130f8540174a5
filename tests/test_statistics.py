"""Intervals, paired tests and quantiles against published or hand-computed values."""

import math

import numpy as np
import pytest
from scipy import stats

from salver.statistics import clopper_pearson, mcnemar, quantiles


def test_nothing_observed_in_n_runs_gives_the_closed_form_bound():
    # With no event in n runs, the 95 % upper limit solves (1 - p)^n = 0.025.
    rate = clopper_pearson(0, 100)
    assert rate.low == 0.0
    assert rate.high == pytest.approx(1 - 0.025 ** (1 / 100), rel=1e-12)
    assert clopper_pearson(100, 100).low == pytest.approx(0.025 ** (1 / 100), rel=1e-12)


def test_four_of_twenty_as_in_textbooks():
    rate = clopper_pearson(4, 20)
    assert (round(rate.low, 4), round(rate.high, 4)) == (0.0573, 0.4366)
    assert rate.value == 0.2


@pytest.mark.parametrize(("count", "total"), [(3, 17), (16, 17), (50, 135)])
def test_the_bounds_are_where_the_binomial_tails_have_their_probability(count, total):
    rate = clopper_pearson(count, total)
    tail = 0.025
    assert stats.binom.sf(count - 1, total, rate.low) == pytest.approx(tail, rel=1e-9)
    assert stats.binom.cdf(count, total, rate.high) == pytest.approx(tail, rel=1e-9)


def test_coverage_is_never_below_the_level():
    n, p = 20, 0.13
    covered = sum(
        stats.binom.pmf(k, n, p) for k in range(n + 1) if clopper_pearson(k, n).low <= p <= clopper_pearson(k, n).high
    )
    assert covered >= 0.95


def test_no_runs_say_nothing_and_wrong_counts_are_refused():
    rate = clopper_pearson(0, 0)
    assert (rate.low, rate.high) == (0.0, 1.0)
    assert math.isnan(rate.value)
    with pytest.raises(ValueError, match="not between 0 and total"):
        clopper_pearson(5, 4)


def test_mcnemar_counts_only_the_discordant_pairs():
    # 8 runs where only the first holds, 1 where only the second does: p = 2 (C(9,0) + C(9,1)) / 2^9.
    first = [True] * 8 + [False] + [True] * 50 + [False] * 3
    second = [False] * 8 + [True] + [True] * 50 + [False] * 3
    result = mcnemar(first, second)
    assert [result[key] for key in ("both", "only_first", "only_second", "neither")] == [50, 8, 1, 3]
    assert result["p_value"] == pytest.approx(2 * 10 / 512)


def test_mcnemar_of_equal_outcomes_is_no_evidence():
    assert mcnemar([True, False], [True, False])["p_value"] == 1.0
    assert mcnemar([True, False], [False, True])["p_value"] == 1.0
    with pytest.raises(ValueError, match="must be equal"):
        mcnemar([True], [True, False])


def test_quantiles_skip_what_is_not_a_number():
    result = quantiles([3.0, np.nan, 1.0, 2.0, np.inf])
    assert (result["min"], result["median"], result["max"]) == (1.0, 2.0, 3.0)
    assert math.isnan(quantiles([])["median"])
