"""Intervals and tests against published worked examples and brute force over binomial sums."""

import itertools

import numpy as np
import pytest
from scipy.stats import binom, binomtest, norm

from manicm_ms.errors import ConfigError
from manicm_ms.evaluation.statistics import (
    PairedCounts,
    compare_paired,
    mcnemar_exact,
    mean_of_highest,
    mean_rate_interval,
    paired_counts,
    paired_difference_interval,
    success_rate,
    wilson_interval,
)


@pytest.mark.parametrize(("k", "n"), [(0, 1), (1, 1), (0, 20), (20, 20), (81, 263), (15, 148), (97, 100), (1, 29)])
def test_wilson_solves_its_defining_quadratic(k, n):
    # Wilson's limits are the p at which |k/n - p| equals z standard errors under p itself.
    z = norm.ppf(0.975)
    low, high = wilson_interval(k, n)
    for p in (low, high):
        assert abs(k / n - p) == pytest.approx(z * np.sqrt(p * (1 - p) / n), abs=1e-12)
    assert low <= k / n <= high


@pytest.mark.parametrize(
    ("k", "n", "low", "high"),
    # R. G. Newcombe, Statistics in Medicine 17 (1998) 857-872, table I, method 3.
    [(81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0.0, 0.1611), (1, 29, 0.0061, 0.1718)],
)
def test_wilson_reproduces_the_published_table(k, n, low, high):
    assert wilson_interval(k, n) == pytest.approx((low, high), abs=5e-5)


@pytest.mark.parametrize("p", [0.1, 0.5, 0.9])
def test_wilson_covers_near_its_nominal_level(p):
    # Coverage of the score interval over its binomial sum: close to 95 % on either side.
    n = 100
    covered = sum(binom.pmf(k, n, p) for k in range(n + 1) if wilson_interval(k, n)[0] <= p <= wilson_interval(k, n)[1])
    assert 0.93 < covered < 0.975


def test_no_episodes_say_nothing():
    assert wilson_interval(0, 0) == (0.0, 1.0)
    assert paired_difference_interval(PairedCounts(0, 0, 0, 0)) == (-1.0, 1.0)
    assert mcnemar_exact(PairedCounts(0, 0, 0, 0)) == 1.0
    with pytest.raises(ConfigError, match="at least one episode"):
        success_rate([])
    with pytest.raises(ConfigError, match="at least one seed"):
        compare_paired([], [])


def test_impossible_counts_are_refused():
    with pytest.raises(ConfigError, match="successes=5"):
        wilson_interval(5, 4)
    with pytest.raises(ConfigError, match="one length"):
        paired_counts([True], [True, False])


def test_mcnemar_equals_the_binomial_sum_for_every_small_table():
    for b, c in itertools.product(range(9), repeat=2):
        p = mcnemar_exact(PairedCounts(3, b, c, 2))
        tail = sum(binom.pmf(k, b + c, 0.5) for k in range(min(b, c) + 1))
        assert p == pytest.approx(min(1.0, 2 * tail))
        if b + c:
            assert p == pytest.approx(binomtest(b, b + c).pvalue)


@pytest.mark.parametrize(
    ("table", "difference", "low", "high"),
    [
        # Fagerland, Lydersen, Laake: Statistical Analysis of Contingency Tables (2017), chapter 8, and
        # their R package contingencytables: Cavo et al. (2012) and Bentur et al. (2009), first - second.
        ((59, 6, 16, 80), -0.0621, -0.1186, -0.0046),
        ((1, 1, 7, 12), -0.2857, -0.5070, -0.0260),
        # Newcombe (1998) 2635-2650, table of examples, method 10.
        ((36, 12, 2, 0), 0.2000, 0.0569, 0.3404),
    ],
)
def test_paired_interval_reproduces_published_examples(table, difference, low, high):
    counts = PairedCounts(*table)
    mirrored = paired_difference_interval(counts)  # ours is second - first
    assert (-mirrored.high, -mirrored.low) == pytest.approx((low, high), abs=5.1e-4)
    assert (counts.only_first - counts.only_second) / counts.n == pytest.approx(difference, abs=5e-5)


def test_paired_interval_mirrors_when_the_policies_swap():
    for table in [(5, 3, 1, 2), (40, 0, 7, 3), (0, 9, 4, 0), (10, 0, 0, 0), (0, 0, 0, 6)]:
        a, b, c, d = table
        here, there = (
            paired_difference_interval(PairedCounts(a, b, c, d)),
            paired_difference_interval(PairedCounts(a, c, b, d)),
        )
        assert here == pytest.approx((-there.high, -there.low))
        assert -1.0 <= here.low <= (c - b) / sum(table) <= here.high <= 1.0


def test_paired_interval_covers_near_its_nominal_level():
    # All tables of 20 pairs, weighted by their multinomial probability.
    n, q = 20, np.array([0.55, 0.2, 0.1, 0.15])
    truth, covered = q[2] - q[1], 0.0
    log_factorial = np.cumsum(np.concatenate([[0.0], np.log(np.arange(1, n + 1))]))
    for a in range(n + 1):
        for b in range(n + 1 - a):
            for c in range(n + 1 - a - b):
                table = np.array([a, b, c, n - a - b - c])
                low, high = paired_difference_interval(PairedCounts(*table.tolist()))
                if low <= truth <= high:
                    covered += np.exp(log_factorial[n] - log_factorial[table].sum() + (table * np.log(q)).sum())
    assert 0.93 < covered < 0.99


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


def test_the_interval_of_a_mean_of_rates_is_wilsons_for_one_and_holds_its_level_for_many():
    assert mean_rate_interval([(7, 10)]) == pytest.approx(wilson_interval(7, 10))
    with pytest.raises(ConfigError):
        mean_rate_interval([])
    rng = np.random.default_rng(0)
    true, n = np.array([0.99, 0.9, 0.3, 0.05]), np.array([50, 20, 50, 20])
    draws = rng.binomial(n, true, size=(4000, 4))
    inside = [
        low <= true.mean() <= high for low, high in (mean_rate_interval(list(zip(d, n, strict=True))) for d in draws)
    ]
    assert 0.94 < np.mean(inside) < 0.985  # a little wide near 0 and 1, as Wilson's own intervals are


def test_the_interval_of_a_mean_of_rates_narrows_with_more_tasks_of_the_same_kind():
    one, four = mean_rate_interval([(25, 50)]), mean_rate_interval([(25, 50)] * 4)
    assert four[1] - four[0] == pytest.approx((one[1] - one[0]) / 2)
