"""Rates, paired counts and McNemar's test against brute force over binomial sums."""

import itertools

import numpy as np
import pytest
from scipy.stats import binom, binomtest

from manicm_ms.errors import ConfigError
from manicm_ms.evaluation.intervals import PairedCounts
from manicm_ms.evaluation.statistics import compare_paired, mcnemar_exact, mean_of_highest, paired_counts, success_rate


def test_no_episodes_say_nothing():
    assert mcnemar_exact(PairedCounts(0, 0, 0, 0)) == 1.0
    with pytest.raises(ConfigError, match="at least one episode"):
        success_rate([])
    with pytest.raises(ConfigError, match="at least one seed"):
        compare_paired([], [])


def test_impossible_counts_are_refused():
    with pytest.raises(ConfigError, match="one length"):
        paired_counts([True], [True, False])


def test_mcnemar_equals_the_binomial_sum_for_every_small_table():
    for b, c in itertools.product(range(9), repeat=2):
        p = mcnemar_exact(PairedCounts(3, b, c, 2))
        tail = sum(binom.pmf(k, b + c, 0.5) for k in range(min(b, c) + 1))
        assert p == pytest.approx(min(1.0, 2 * tail))
        if b + c:
            assert p == pytest.approx(binomtest(b, b + c).pvalue)


def test_comparison_counts_pairs_by_seed():
    teacher = [True, True, True, False, False, True]
    student = [True, False, True, True, False, True]
    result = compare_paired(teacher, student)
    assert result.counts == (3, 1, 1, 1)
    assert result.difference == 0.0
    assert result.mcnemar_p == 1.0
    assert success_rate(teacher)[:3] == (4, 6, pytest.approx(4 / 6))


def test_mean_of_highest_selects_before_it_averages():
    rates = [0.1, 0.9, 0.5, 0.7, 0.3, 0.8, 0.6]
    assert mean_of_highest(rates, 5) == pytest.approx((0.9 + 0.8 + 0.7 + 0.6 + 0.5) / 5)
    with pytest.raises(ConfigError, match="at least 5, got 2"):
        mean_of_highest([0.1, 0.2])


def test_mean_of_highest_is_biased_upward_and_the_rate_is_not():
    # The reason why it never stands alone: 40 evaluations of 20 episodes of a policy of true rate 0.5.
    rng = np.random.default_rng(0)
    rates = rng.binomial(20, 0.5, size=(2000, 40)) / 20
    assert np.mean([mean_of_highest(r, 5) for r in rates.tolist()]) > 0.6
    assert rates.mean() == pytest.approx(0.5, abs=0.005)
