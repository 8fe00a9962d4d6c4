"""Intervals of a success rate and of a paired difference that keep their level near 0 and 1, where rates are found."""

from __future__ import annotations

import math
from typing import NamedTuple

from scipy.optimize import brentq
from scipy.stats import norm
from statsmodels.stats.proportion import proportion_confint

from manicm_ms.errors import ConfigError

CONFIDENCE = 0.95
"""Confidence level of every interval in a report."""
RATE_METHOD = "Clopper-Pearson"
DIFFERENCE_METHOD = "Tango's score interval"


class Interval(NamedTuple):
    """A closed interval of probabilities or of their differences."""

    low: float
    high: float


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

    @property
    def difference(self) -> float:
        """Success rate of the second minus that of the first."""
        return (self.only_second - self.only_first) / self.n


def rate_interval(successes: float, n: int, confidence: float = CONFIDENCE) -> Interval:
    """Return the exact interval of a probability, given `successes` among `n` trials.

    The limits are the probabilities at which so many successes or more, or so few or fewer, have probability
    (1 - confidence) / 2. Its coverage is never below `confidence`, where Wilson's interval falls to 91 % (50 trials of
    probability 0.99). With n = 0 nothing is known and the interval is [0, 1]. A mean count over repetitions on the same
    trials may be a fraction.

    Source: C. J. Clopper and E. S. Pearson, "The use of confidence or fiducial limits illustrated in the case of the
    binomial", Biometrika 26 (1934) 404-413.
    """
    if not 0 <= successes <= n:
        raise ConfigError(f"successes={successes} must lie between 0 and n={n}")
    if n == 0:
        return Interval(0.0, 1.0)
    low, high = proportion_confint(successes, n, alpha=1.0 - confidence, method="beta")
    return Interval(0.0 if successes == 0 else float(low), 1.0 if successes == n else float(high))


def paired_difference_interval(counts: PairedCounts, confidence: float = CONFIDENCE) -> Interval:
    """Return Tango's score interval of (second rate - first rate) on the same seeds.

    It holds the differences delta at which the score statistic of the paired table stays within z standard errors::

        (b - c - n delta) / sqrt(n (2 q + delta (1 - delta))),    b = only_second, c = only_first,

    where q is the most likely probability of "only the first" under that delta, the larger root of::

        2 n q^2 - (b + c - (2 n - b + c) delta) q - c delta (1 - delta) = 0.

    With no discordant pair the limits are -z^2 / (n + z^2) and z^2 / (n + z^2).

    Source: T. Tango, "Equivalence test and confidence interval for the difference in proportions for the
    paired-sample design", Statistics in Medicine 17 (1998) 891-908.
    """
    return score_interval(counts.only_second, counts.only_first, counts.n, confidence)


def score_interval(b: float, c: float, n: int, confidence: float = CONFIDENCE) -> Interval:
    """Return `paired_difference_interval` of n pairs, b of them for the second policy alone and c for the first.

    Mean counts over repetitions on the same n pairs may be fractions.
    """
    if n == 0:
        return Interval(-1.0, 1.0)
    z = float(norm.ppf(0.5 + confidence / 2))
    return Interval(_lower_limit(b, c, n, z), -_lower_limit(c, b, n, z))


def _lower_limit(b: float, c: float, n: int, z: float) -> float:
    """Return the least difference that b pairs for it, c against it and n in all do not exclude."""
    if c == n:
        return -1.0

    def excess(delta: float) -> float:
        return b - c - n * delta - z * math.sqrt(n * _variance(b, c, n, delta))

    # Not up to the estimate itself, where the variance may be 0 and so the excess: a second root.
    return float(brentq(excess, -1.0, (b - c) / n - 1e-9, xtol=1e-12))


def _variance(b: float, c: float, n: int, delta: float) -> float:
    """Return the variance of one pair's difference, by the most likely table whose true difference is `delta`."""
    linear = b + c - (2 * n - b + c) * delta
    q = (linear + math.sqrt(max(linear**2 + 8 * n * c * delta * (1 - delta), 0.0))) / (4 * n)
    return max(2 * q + delta * (1 - delta), 0.0)  # rounding may leave -1e-18 at delta = -1
