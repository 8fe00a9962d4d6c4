"""Success rates and paired comparisons with their uncertainty: what a number of episodes can and cannot say."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from statsmodels.stats.contingency_tables import mcnemar
from statsmodels.stats.proportion import proportion_confint

from manicm_ms.errors import ConfigError

CONFIDENCE = 0.95
"""Confidence level of every interval in a report."""


class Interval(NamedTuple):
    """A closed interval of probabilities or of their differences."""

    low: float
    high: float


class SuccessRate(NamedTuple):
    """Successes among `n` episodes: `rate` with its Wilson interval `ci95`."""

    successes: int
    n: int
    rate: float
    ci95: Interval


class PairedCounts(NamedTuple):
    """How often two policies succeeded on the same seeds: both, one alone, neither."""

    both: int
    only_first: int
    only_second: int
    neither: int

    @property
    def n(self) -> int:
        """Number of pairs."""
        return sum(self)


class PairedComparison(NamedTuple):
    """Two policies on the same seeds.

    Attributes:
        counts: the 2 x 2 table.
        difference: success rate of the second minus that of the first.
        difference_ci95: its interval (Newcombe's method 10).
        mcnemar_p: two-sided p of McNemar's exact test.
    """

    counts: PairedCounts
    difference: float
    difference_ci95: Interval
    mcnemar_p: float


def wilson_interval(successes: int, n: int, confidence: float = CONFIDENCE) -> Interval:
    """Return Wilson's score interval of a probability, given `successes` among `n` trials.

    Unlike the normal approximation it stays inside [0, 1] and keeps its coverage near 0 and 1, where
    success rates are found. With n = 0 nothing is known and the interval is [0, 1].

    Source: E. B. Wilson, "Probable inference, the law of succession, and statistical inference",
    J. Am. Stat. Assoc. 22 (1927) 209-212.
    """
    if not 0 <= successes <= n:
        raise ConfigError(f"successes={successes} must lie between 0 and n={n}")
    if n == 0:
        return Interval(0.0, 1.0)
    low, high = proportion_confint(successes, n, alpha=1.0 - confidence, method="wilson")
    # The formula gives exactly 0 and 1 at the ends; rounding gives 1e-17.
    return Interval(0.0 if successes == 0 else float(low), 1.0 if successes == n else float(high))


def mean_rate_interval(counts: Sequence[tuple[int, int]], confidence: float = CONFIDENCE) -> Interval:
    """Return the interval of the mean of K independent rates, each counted once, given (successes, n) of each.

    With Wilson limits (l_k, u_k) of each rate p_k and their mean p, the limits are::

        p - sqrt(sum_k (p_k - l_k)^2) / K        p + sqrt(sum_k (u_k - p_k)^2) / K

    It tells what the number of episodes leaves open, not what another choice of the K tasks would. One rate alone gets
    its Wilson interval.

    Source: the "method of variance estimates recovery", G. Y. Zou and A. Donner, Statistics in Medicine 27 (2008)
    1693-1702; Newcombe's square-and-add is its case of a difference.
    """
    if not counts:
        raise ConfigError("a mean of rates needs at least one")
    limits = [wilson_interval(k, n, confidence) for k, n in counts]
    rates = [k / n for k, n in counts]
    mean = sum(rates) / len(rates)
    below = math.sqrt(sum((p - low) ** 2 for p, (low, _) in zip(rates, limits, strict=True))) / len(rates)
    above = math.sqrt(sum((high - p) ** 2 for p, (_, high) in zip(rates, limits, strict=True))) / len(rates)
    return Interval(mean - below, mean + above)


def success_rate(successes: Sequence[bool] | np.ndarray) -> SuccessRate:
    """Return the rate of true entries with its 95 % interval; raise ConfigError where there are none."""
    outcomes = np.asarray(successes, dtype=bool)
    if outcomes.size == 0:
        raise ConfigError("a success rate needs at least one episode")
    k, n = int(outcomes.sum()), int(outcomes.size)
    return SuccessRate(k, n, k / n, wilson_interval(k, n))


def paired_counts(first: Sequence[bool] | np.ndarray, second: Sequence[bool] | np.ndarray) -> PairedCounts:
    """Count the pairs of outcomes of two policies; entry i of both belongs to the same seed."""
    a, b = np.asarray(first, dtype=bool), np.asarray(second, dtype=bool)
    if a.shape != b.shape:
        raise ConfigError(f"paired outcomes must be of one length, got {a.size} and {b.size}")
    return PairedCounts(int((a & b).sum()), int((a & ~b).sum()), int((~a & b).sum()), int((~a & ~b).sum()))


def mcnemar_exact(counts: PairedCounts) -> float:
    """Return the two-sided p of McNemar's exact test that both policies succeed equally often.

    Only seeds on which exactly one succeeded carry information: under the hypothesis each of the
    m = only_first + only_second falls either way with probability 1/2, so p = min(1, 2 P(X <= min))
    with X ~ Binomial(m, 1/2). Without such seeds p = 1.

    Source: Q. McNemar, Psychometrika 12 (1947) 153-157, in its exact binomial form.
    """
    if counts.only_first + counts.only_second == 0:
        return 1.0
    table = [[counts.both, counts.only_first], [counts.only_second, counts.neither]]
    return float(mcnemar(table, exact=True).pvalue)


def paired_difference_interval(counts: PairedCounts, confidence: float = CONFIDENCE) -> Interval:
    """Return the interval of (second rate - first rate) on the same seeds.

    Newcombe's hybrid score interval ("method 10", also "square-and-add"): with Wilson limits (l, u)
    of both rates and the correlation phi of the outcomes, the limits of d = p2 - p1 are::

        d - sqrt((p2 - l2)^2 - 2 phi (p2 - l2)(u1 - p1) + (u1 - p1)^2)
        d + sqrt((u2 - p2)^2 - 2 phi (u2 - p2)(p1 - l1) + (p1 - l1)^2)

    where a positive phi is damped by a continuity correction of n / 2 in its numerator.

    Source: R. G. Newcombe, "Improved confidence intervals for the difference between binomial
    proportions based on paired data", Statistics in Medicine 17 (1998) 2635-2650.
    """
    n = counts.n
    if n == 0:
        return Interval(-1.0, 1.0)
    k1, k2 = counts.both + counts.only_first, counts.both + counts.only_second
    p1, p2 = k1 / n, k2 / n
    (l1, u1), (l2, u2) = wilson_interval(k1, n, confidence), wilson_interval(k2, n, confidence)
    phi = _damped_phi(counts)
    d = p2 - p1
    below = (p2 - l2) ** 2 - 2 * phi * (p2 - l2) * (u1 - p1) + (u1 - p1) ** 2
    above = (u2 - p2) ** 2 - 2 * phi * (u2 - p2) * (p1 - l1) + (p1 - l1) ** 2
    # |phi| <= 1 makes both sums of squares; rounding may leave -1e-18.
    return Interval(d - math.sqrt(max(below, 0.0)), d + math.sqrt(max(above, 0.0)))


def _damped_phi(counts: PairedCounts) -> float:
    """Return the correlation of the outcomes with Newcombe's continuity correction, 0 where undefined."""
    a, b, c, d = counts
    margins = (a + b) * (c + d) * (a + c) * (b + d)
    if margins == 0:
        return 0.0
    numerator = float(a * d - b * c)
    if numerator > 0:
        numerator = max(numerator - counts.n / 2, 0.0)
    return numerator / math.sqrt(margins)


def compare_paired(first: Sequence[bool] | np.ndarray, second: Sequence[bool] | np.ndarray) -> PairedComparison:
    """Compare two policies on the same seeds; entry i of both belongs to the same seed."""
    counts = paired_counts(first, second)
    if counts.n == 0:
        raise ConfigError("a paired comparison needs at least one seed")
    difference = (counts.only_second - counts.only_first) / counts.n
    return PairedComparison(counts, difference, paired_difference_interval(counts), mcnemar_exact(counts))


def mean_of_highest(rates: Sequence[float], count: int = 5) -> float:
    """Return the paper's score: the mean of the `count` highest evaluations during a training.

    ManiCM and DP3 report it with count = 5 over evaluations of 20 episodes each. Selecting the highest
    biases it upward (about 10 points at 20 episodes), so it stands beside a rate on fresh seeds and
    never replaces it.
    """
    if count < 1 or len(rates) < count:
        raise ConfigError(
            f"the mean of the {count} highest evaluations needs at least {max(count, 1)}, got {len(rates)}"
        )
    return float(np.mean(np.sort(np.asarray(rates, dtype=float))[-count:]))
