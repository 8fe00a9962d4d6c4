"""Success rates and paired comparisons with their uncertainty: what a number of episodes can and cannot say."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from statsmodels.stats.contingency_tables import mcnemar
from statsmodels.stats.multitest import multipletests

from manicm_ms.errors import ConfigError
from manicm_ms.evaluation.intervals import Interval, PairedCounts, paired_difference_interval, rate_interval


class SuccessRate(NamedTuple):
    """Successes among `n` episodes: `rate` with its Clopper-Pearson interval `ci95`."""

    successes: int
    n: int
    rate: float
    ci95: Interval


class PairedComparison(NamedTuple):
    """Two policies on the same seeds.

    Attributes:
        counts: the 2 x 2 table.
        difference: success rate of the second minus that of the first.
        difference_ci95: Tango's score interval of it.
        mcnemar_p: two-sided p of McNemar's exact test.
    """

    counts: PairedCounts
    difference: float
    difference_ci95: Interval
    mcnemar_p: float


def success_rate(successes: Sequence[bool] | np.ndarray) -> SuccessRate:
    """Return the rate of true entries with its 95 % interval; raise ConfigError where there are none."""
    outcomes = np.asarray(successes, dtype=bool)
    if outcomes.size == 0:
        raise ConfigError("a success rate needs at least one episode")
    k, n = int(outcomes.sum()), int(outcomes.size)
    return SuccessRate(k, n, k / n, rate_interval(k, n))


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


def compare_paired(first: Sequence[bool] | np.ndarray, second: Sequence[bool] | np.ndarray) -> PairedComparison:
    """Compare two policies on the same seeds; entry i of both belongs to the same seed."""
    counts = paired_counts(first, second)
    if counts.n == 0:
        raise ConfigError("a paired comparison needs at least one seed")
    return PairedComparison(counts, counts.difference, paired_difference_interval(counts), mcnemar_exact(counts))


def holm(p_values: Sequence[float]) -> list[float]:
    """Return p values corrected for being printed together, in their order; nothing for nothing.

    Source: S. Holm, "A simple sequentially rejective multiple test procedure", Scandinavian Journal of Statistics 6
    (1979) 65-70.
    """
    if len(p_values) == 0:
        return []
    return [float(p) for p in multipletests(list(p_values), method="holm")[1]]


def mean_of_highest(rates: Sequence[float], count: int = 5) -> float:
    """Return the paper's score: the mean of the `count` highest evaluations during a training.

    ManiCM and DP3 report it with count = 5 over evaluations of 20 episodes each. Selecting the highest
    biases it upward (about 10 points at 20 episodes), so it stands beside a rate on held-out seeds and
    never replaces it.
    """
    if count < 1 or len(rates) < count:
        raise ConfigError(
            f"the mean of the {count} highest evaluations needs at least {max(count, 1)}, got {len(rates)}"
        )
    return float(np.mean(np.sort(np.asarray(rates, dtype=float))[-count:]))
