"""How many pairs a planned comparison needs, computed from the very tests that it will be judged by."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import logsumexp
from scipy.stats import binom, norm

from manicm_ms.evaluation.anytime import ALPHA, EACH_ALPHA, STAKES, require_margin, stakes
from manicm_ms.evaluation.intervals import CONFIDENCE

POWER = 0.8
"""Chance with which a number of pairs "would do"."""
MOST_PAIRS = 1_000_000
"""Numbers of pairs of a planned comparison are not told beyond it."""
MOST_PLAYED = 20_000
"""Nor those of a comparison that stops by itself beyond this one: they are simulated."""
LOOK = 10
"""Pairs played between two looks at a comparison that stops by itself."""
EQUAL, OBSERVED = "equally good", "as observed"
"""What is supposed of two policies: equal rates and the observed share of discordant pairs, or the observed shares."""


def shows_not_worse(b: ArrayLike, c: ArrayLike, n: int, margin: float) -> NDArray[np.bool_]:
    """Return whether the lower end of Tango's interval lies above -margin, for many tables of n pairs at once.

    Args:
        b: pairs in which the second policy alone succeeded.
        c: pairs in which the first alone did.
        n: all pairs.
        margin: difference of success rates.
    """
    b, c = np.asarray(b, dtype=float), np.asarray(c, dtype=float)
    linear = b + c + (2 * n - b + c) * margin
    q = (linear + np.sqrt(np.maximum(linear**2 - 8 * n * c * margin * (1 + margin), 0))) / (4 * n)
    spread = np.sqrt(n * np.maximum(2 * q - margin * (1 + margin), 0))
    return np.asarray(b - c + n * margin > norm.ppf(0.5 + CONFIDENCE / 2) * spread)


def chance_of_not_worse(n: int, b_rate: float, c_rate: float, margin: float) -> float:
    """Return the probability that n pairs show "not worse by more than `margin`", where pairs fall in these shares."""

    def least(m: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the least b among m discordant pairs that shows it; m + 1 where none does."""
        low, high = np.full_like(m, -1), m + 1
        while (high - low > 1).any():
            middle = (low + high) // 2
            shown = shows_not_worse(middle, m - middle, n, margin)
            low, high = np.where(shown, low, middle), np.where(shown, middle, high)
        return high

    return _over_discordant(n, b_rate, c_rate, lambda m, share: binom.sf(least(m) - 1, m, share))


def chance_of_worse(n: int, b_rate: float, c_rate: float, alpha: float = ALPHA) -> float:
    """Return the probability that McNemar's exact test of n pairs shows the second policy to be worse.

    Arguments as in `chance_of_not_worse`.
    """

    def most(m: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the largest b among m discordant pairs that shows it; -1 where none does."""
        found = binom.ppf(alpha / 2, m, 0.5)
        return np.where(binom.cdf(found, m, 0.5) > alpha / 2, found - 1, found)

    return _over_discordant(n, b_rate, c_rate, lambda m, share: binom.cdf(most(m), m, share))


def _over_discordant(
    n: int, b_rate: float, c_rate: float, chance: Callable[[NDArray[np.int64], float], NDArray[np.float64]]
) -> float:
    """Return the mean of `chance(m, share)` over the number m of discordant pairs, `share` of which are of kind b."""
    rate = b_rate + c_rate
    if rate == 0:
        return float(chance(np.zeros(1, dtype=np.int64), 0.5)[0])
    low, high = binom.ppf([1e-9, 1 - 1e-9], n, rate).astype(np.int64)
    m = np.arange(low, high + 1)
    return float(np.sum(binom.pmf(m, n, rate) * chance(m, b_rate / rate)))


class NeededPairs(NamedTuple):
    """How many pairs would do.

    Attributes:
        pairs: their number; None where it is beyond `MOST_PAIRS`.
        claim: what they would show, "not worse" or "worse".
        supposing: `EQUAL` or `OBSERVED`.
    """

    pairs: int | None
    claim: str
    supposing: str


def needed_pairs(b: float, c: float, n: int, margin: float) -> NeededPairs:
    """Return how many pairs would have decided a comparison that n pairs left open, with a chance of `POWER`.

    The first answer supposes two equally good policies that disagree as often as these did, and asks for "not worse".
    Where n pairs should then have been enough, the policies are hardly equal: the second answer supposes the shares
    that were observed, and asks for what they would show.

    Args:
        b: pairs in which the second policy alone succeeded.
        c: pairs in which the first alone did.
        n: all pairs, at least one.
        margin: difference of success rates.
    """
    require_margin(margin)
    each = (b + c) / n / 2
    equal = least_pairs(lambda m: chance_of_not_worse(m, each, each, margin))
    if equal is None or equal > n:
        return NeededPairs(equal, "not worse", EQUAL)
    b_rate, c_rate = b / n, c / n
    if b_rate - c_rate > -margin:
        return NeededPairs(least_pairs(lambda m: chance_of_not_worse(m, b_rate, c_rate, margin)), "not worse", OBSERVED)
    return NeededPairs(least_pairs(lambda m: chance_of_worse(m, b_rate, c_rate)), "worse", OBSERVED)


def least_pairs(chance: Callable[[int], float]) -> int | None:
    """Return the least number of pairs with a chance of `POWER`, but for the steps of counts that are whole."""
    high = 1
    while chance(high) < POWER:
        if high >= MOST_PAIRS:
            return None
        high = min(2 * high, MOST_PAIRS)
    low = high // 2
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if chance(middle) >= POWER else (middle, high)
    return high


def pairs_until_not_worse(
    discordant: float, margin: float, alpha: float = EACH_ALPHA, paths: int = 200, seed: int = 0
) -> int | None:
    """Return how many pairs the anytime-valid bet on "not worse" needs at most, with a chance of `POWER`.

    Simulated, for two equally good policies that are looked at after every ten pairs.

    Args:
        discordant: share of pairs in which exactly one of them succeeds.
        margin: difference of success rates.
        alpha: level of the claim.
        paths: simulated comparisons.
        seed: of the simulation.

    Returns None where it is more than `MOST_PLAYED`.
    """
    require_margin(margin)
    gains = np.log1p(stakes(1 / (1 - margin))[:, None] * np.array([1 + margin, margin - 1, margin]))  # (STAKES, 3)
    shares, looks, rng = [discordant / 2, discordant / 2, 1 - discordant], 25, np.random.default_rng(seed)
    while looks * LOOK <= MOST_PLAYED:
        counts = rng.multinomial(LOOK, shares, size=(paths, looks)).cumsum(axis=1)  # (paths, looks, 3)
        reached = logsumexp(counts @ gains.T, axis=2) - np.log(STAKES) >= -np.log(alpha)
        stopped = np.sort(np.where(reached.any(axis=1), reached.argmax(axis=1) + 1, looks + 1))
        needed = int(stopped[int(np.ceil(POWER * paths)) - 1])
        if needed <= looks:
            return LOOK * needed
        looks *= 4
    return None
