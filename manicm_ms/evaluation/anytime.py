"""Paired comparisons that may be looked at after every pair and stopped whenever one likes (anytime-valid).

Each is a bet against a hypothesis. While the hypothesis is true no way of betting on the next pair is expected to gain,
so that the capital, 1 at the start, reaches 1 / alpha with probability alpha at most, whenever one looks (J. Ville,
1939). Capitals of several stakes are averaged, which is such a bet again.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import betaln, logsumexp

from manicm_ms.errors import ConfigError
from manicm_ms.evaluation.intervals import CONFIDENCE

ALPHA = round(1 - CONFIDENCE, 9)
EACH_ALPHA = ALPHA / 2
"""Of each of two bets that run side by side; Tango's interval leaves the same beyond each of its ends."""
STAKES = 20
"""Stakes that are averaged: k / (STAKES + 1) of the largest possible one, k = 1 .. STAKES."""


def require_margin(margin: float) -> None:
    """Raise ConfigError unless the margin, a difference of success rates, lies strictly between 0 and 1."""
    if not 0 < margin < 1:
        points = f"{100 * margin:g}"
        raise ConfigError(f"--margin is in points and must lie between 0 and 100, both excluded, got {points}")


def log_not_worse(differences: ArrayLike, margin: float) -> NDArray[np.float64]:
    """Return the logarithm of the capital of the bet that the second policy is not worse by more than `margin`.

    After pairs 1 .. t, with D = second minus first::

        mean over lambda of prod (1 + lambda (D + margin)),   lambda = k / (21 (1 - margin)),  k = 1 .. 20

    It is a bet against "the mean of D is -margin or less".

    Args:
        differences: (..., T) in [-1, 1], of paired outcomes in the order in which they were played.
        margin: difference of success rates, in (0, 1).

    Returns (..., T), the logarithm after each pair.
    """
    require_margin(margin)
    return _log_capital(np.asarray(differences, dtype=float) + margin, 1 / (1 - margin))


def log_worse(differences: ArrayLike, margin: float) -> NDArray[np.float64]:
    """Return the logarithm of the capital of the mirrored bet: the second policy is worse by more than `margin`.

    It is a bet against "the mean of D is -margin or more"; arguments and result as in `log_not_worse`.
    """
    require_margin(margin)
    return _log_capital(-(np.asarray(differences, dtype=float) + margin), 1 / (1 + margin))


def _log_capital(gains: NDArray[np.float64], largest_stake: float) -> NDArray[np.float64]:
    """Return the logarithm of the mean capital over the stakes, (..., T), of gains (..., T) per unit of stake."""
    logs = [np.cumsum(np.log1p(stake * gains), axis=-1) for stake in stakes(largest_stake)]
    return np.asarray(logsumexp(logs, axis=0)) - math.log(STAKES)


def stakes(largest: float) -> NDArray[np.float64]:
    """Return the stakes (STAKES,) whose capitals are averaged; at `largest` a pair could lose everything."""
    return largest * np.arange(1, STAKES + 1) / (STAKES + 1)


def difference_evidence(b: int, c: int) -> float:
    """Return E, the evidence that two policies differ: b pairs for the one alone, c for the other.

    E = 2^(b + c) B(b + 1/2, c + 1/2) / B(1/2, 1/2): the capital of bets on which way the next discordant pair falls,
    averaged over Jeffreys' prior. Under equal success rates it reaches 1 / alpha with probability alpha at most.
    """
    return math.exp((b + c) * math.log(2) + betaln(b + 0.5, c + 0.5) - betaln(0.5, 0.5))


class AnytimeDecision(NamedTuple):
    """What two bets say after some pairs; a capital is the largest that was reached so far.

    Attributes:
        not_worse: capital of "not worse by more than the margin".
        worse: capital of "worse by more than the margin".
        shows_not_worse: whether that claim may be made.
        shows_worse: whether that one may be.
    """

    not_worse: float
    worse: float
    shows_not_worse: bool
    shows_worse: bool


def decide(differences: ArrayLike, margin: float, alpha: float = EACH_ALPHA) -> AnytimeDecision:
    """Return what may be claimed after these pairs, at level `alpha` for each of both claims.

    Where both capitals have reached 1 / alpha, the claim that did so first stands.
    """
    values = np.asarray(differences, dtype=float)
    if values.size == 0:
        return AnytimeDecision(1.0, 1.0, False, False)
    bar = -math.log(alpha)
    paths = log_not_worse(values, margin), log_worse(values, margin)
    first = [int(np.argmax(path >= bar)) if (path >= bar).any() else values.size for path in paths]
    highest = [float(np.exp(min(path.max(), 700.0))) for path in paths]
    sooner = first[0] < first[1], first[1] < first[0]
    return AnytimeDecision(highest[0], highest[1], *sooner)
