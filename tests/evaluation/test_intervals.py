"""Intervals against their definitions, published examples and enumeration of all outcomes."""

import itertools
import math

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.stats import binom, norm

from manicm_ms.errors import ConfigError
from manicm_ms.evaluation.intervals import PairedCounts, paired_difference_interval, rate_interval

Z = norm.ppf(0.975)


@pytest.mark.parametrize(("k", "n"), [(0, 1), (1, 1), (0, 20), (20, 20), (81, 263), (15, 148), (97, 100), (1, 29)])
def test_the_limits_of_a_rate_leave_a_fortieth_beyond_the_count(k, n):
    low, high = rate_interval(k, n)
    assert low == 0 if k == 0 else binom.sf(k - 1, n, low) == pytest.approx(0.025)
    assert high == 1 if k == n else binom.cdf(k, n, high) == pytest.approx(0.025)
    assert low <= k / n <= high


@pytest.mark.parametrize(
    ("k", "n", "low", "high"),
    # R. G. Newcombe, Statistics in Medicine 17 (1998) 857-872, table I, method 5.
    [(81, 263, 0.2527, 0.3676), (15, 148, 0.0578, 0.1617), (0, 20, 0.0, 0.1684), (1, 29, 0.0009, 0.1776)],
)
def test_the_interval_of_a_rate_reproduces_the_published_table(k, n, low, high):
    assert rate_interval(k, n) == pytest.approx((low, high), abs=5e-5)


@pytest.mark.parametrize("n", [50, 100, 200])
def test_the_interval_of_a_rate_keeps_its_level_where_rates_are_found(n):
    # By enumeration. Wilson's interval covers 91.1 % at n = 50, p = 0.99.
    intervals = np.array([rate_interval(k, n) for k in range(n + 1)])
    for p in np.linspace(0.9, 0.999, 100):
        inside = (intervals[:, 0] <= p) & (p <= intervals[:, 1])
        assert binom.pmf(np.arange(n + 1), n, p)[inside].sum() >= 0.95


def test_no_episodes_say_nothing_and_impossible_counts_are_refused():
    assert rate_interval(0, 0) == (0.0, 1.0)
    assert paired_difference_interval(PairedCounts(0, 0, 0, 0)) == (-1.0, 1.0)
    with pytest.raises(ConfigError, match="successes=5"):
        rate_interval(5, 4)


@pytest.mark.parametrize(
    ("table", "low", "high"),
    [
        # Fagerland, Lydersen, Laake: Statistical Analysis of Contingency Tables (2017), chapter 8, and their R
        # package contingencytables: Cavo et al. (2012) and Bentur et al. (2009), first - second.
        ((59, 6, 16, 80), -0.1240, -0.0054),
        ((1, 1, 7, 12), -0.5172, -0.0260),
    ],
)
def test_the_paired_interval_reproduces_published_examples(table, low, high):
    ours = paired_difference_interval(PairedCounts(*table))  # second - first
    assert (-ours.high, -ours.low) == pytest.approx((low, high), abs=5e-5)


def score(counts, delta):
    """Tango's statistic, its nuisance probability found by maximising the likelihood instead of by its formula."""
    b, c, n = counts.only_second, counts.only_first, counts.n

    def loss(q):
        shares = [(b, q + delta), (c, q), (n - b - c, 1 - 2 * q - delta)]
        return -sum(k * math.log(max(p, 1e-300)) for k, p in shares if k)

    q = minimize_scalar(loss, bounds=(max(0, -delta), (1 - delta) / 2), method="bounded", options={"xatol": 1e-13}).x
    return (b - c - n * delta) / math.sqrt(n * (2 * q + delta * (1 - delta)))


@pytest.mark.parametrize("table", [(59, 6, 16, 80), (5, 3, 1, 2), (734, 20, 19, 127), (0, 9, 4, 0), (3, 1, 6, 0)])
def test_at_the_limits_of_a_paired_difference_the_score_is_z(table):
    counts = PairedCounts(*table)
    low, high = paired_difference_interval(counts)
    assert score(counts, low) == pytest.approx(Z, abs=1e-5)
    assert score(counts, high) == pytest.approx(-Z, abs=1e-5)


@pytest.mark.parametrize("n", [1, 20, 200])
def test_without_a_discordant_pair_the_limits_are_known_in_closed_form(n):
    edge = Z**2 / (n + Z**2)
    assert paired_difference_interval(PairedCounts(n, 0, 0, 0)) == pytest.approx((-edge, edge))
    assert paired_difference_interval(PairedCounts(0, 0, n, 0)) == pytest.approx(((n - Z**2) / (n + Z**2), 1.0))
    assert paired_difference_interval(PairedCounts(0, n, 0, 0)).low == -1.0


def test_the_paired_interval_mirrors_when_the_policies_swap():
    for a, b, c, d in [(5, 3, 1, 2), (40, 0, 7, 3), (0, 9, 4, 0), (10, 0, 0, 0), (0, 0, 0, 6), (0, 0, 3, 1)]:
        here = paired_difference_interval(PairedCounts(a, b, c, d))
        there = paired_difference_interval(PairedCounts(a, c, b, d))
        assert here == pytest.approx((-there.high, -there.low))
        assert -1.0 <= here.low <= (c - b) / (a + b + c + d) <= here.high <= 1.0


@pytest.mark.parametrize("q", [(0.15, 0.15), (0.02, 0.02), (0.02, 0.10), (0.0, 0.03)])
def test_the_paired_interval_covers_near_its_nominal_level(q):
    # All numbers of discordant pairs among 50, weighted by their multinomial probability.
    n, (first, second) = 50, q
    covered = 0.0
    for b, c in itertools.product(range(n + 1), repeat=2):
        weight = binom.pmf(c, n, second) * binom.pmf(b, n - c, first / (1 - second)) if b + c <= n else 0.0
        if weight > 1e-9:
            low, high = paired_difference_interval(PairedCounts(n - b - c, b, c, 0))
            covered += weight * (low <= second - first <= high)
    assert covered > 0.93
