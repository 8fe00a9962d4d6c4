"""Bets against loops, enumeration of all outcomes, simulation at the boundary, and another package's martingale."""

import itertools
import math

import numpy as np
import pytest
from fieldtrial.stats.confseq import paired_anytime_test
from scipy.stats import binom

from manicm_ms.errors import ConfigError
from manicm_ms.evaluation.anytime import (
    decide,
    difference_evidence,
    log_not_worse,
    log_worse,
    require_margin,
)

MARGIN = 0.05


def capital_by_loops(differences, margin, largest, sign):
    """The definition, one stake and one pair after another."""
    total = 0.0
    for k in range(1, 21):
        capital = 1.0
        for d in differences:
            capital *= 1 + sign * k / 21 * largest * (d + margin)
        total += capital
    return total / 20


def test_capitals_are_their_definition_after_every_pair():
    differences = np.random.default_rng(0).integers(-1, 2, 30).astype(float)
    up, down = log_not_worse(differences, 0.1), log_worse(differences, 0.1)
    for t in range(1, 31):
        assert math.exp(up[t - 1]) == pytest.approx(capital_by_loops(differences[:t], 0.1, 1 / 0.9, 1))
        assert math.exp(down[t - 1]) == pytest.approx(capital_by_loops(differences[:t], 0.1, 1 / 1.1, -1))
    rows = np.stack([differences, -differences])
    np.testing.assert_allclose(log_not_worse(rows, 0.1)[0], up)


@pytest.mark.parametrize(("rates", "margin"), [((0.1, 0.15), 0.05), ((0.0, 0.3), 0.3), ((0.45, 0.55), 0.1)])
def test_at_the_boundary_the_expected_capital_is_one_over_all_outcomes(rates, margin):
    b, c = rates  # the mean difference is exactly -margin
    shares = {1.0: b, -1.0: c, 0.0: 1 - b - c}
    up = down = 0.0
    for outcome in itertools.product(shares, repeat=6):
        probability = math.prod(shares[d] for d in outcome)
        up += probability * math.exp(log_not_worse(outcome, margin)[-1])
        down += probability * math.exp(log_worse(outcome, margin)[-1])
    assert (up, down) == (pytest.approx(1), pytest.approx(1))


def test_the_evidence_of_a_difference_has_the_known_values_and_an_expectation_of_one():
    assert difference_evidence(0, 7) == pytest.approx(26.8, abs=0.05)
    assert difference_evidence(6, 0) == pytest.approx(14.4, abs=0.05)
    assert difference_evidence(0, 0) == 1
    for m in range(12):
        assert sum(binom.pmf(b, m, 0.5) * difference_evidence(b, m - b) for b in range(m + 1)) == pytest.approx(1)


def test_policies_that_always_agree_need_90_pairs_at_5_percent_and_107_at_half_of_it():
    agreeing = np.zeros(200)
    reached = [int(np.argmax(log_not_worse(agreeing, MARGIN) >= -math.log(alpha))) + 1 for alpha in (0.05, 0.025)]
    assert reached == [90, 107]
    assert not decide(agreeing[:106], MARGIN).shows_not_worse
    assert decide(agreeing[:107], MARGIN).shows_not_worse
    assert not (log_worse(agreeing, MARGIN) > 0).any()


def test_few_pairs_at_the_boundary_are_ever_taken_for_either_claim():
    rng, draws = np.random.default_rng(5), 400
    u = rng.random((draws, 600))
    differences = (u < 0.05).astype(float) - (u > 0.90)  # 5 % one way, 10 % the other: just the margin
    bar = math.log(40)
    for log_capital in (log_not_worse, log_worse):
        false = (log_capital(differences, MARGIN) >= bar).any(axis=1).sum()
        assert binom.sf(false - 1, draws, 0.025) > 0.01, false


def test_a_policy_that_is_much_worse_is_told_so_and_the_first_claim_stands():
    worse = np.tile([-1.0, 0.0, 0.0], 40)
    found = decide(worse, MARGIN)
    assert found.shows_worse
    assert not found.shows_not_worse
    assert found.worse >= 40 > found.not_worse
    turned = np.concatenate([np.zeros(107), -np.ones(60)])
    assert decide(turned, MARGIN)[2:] == (True, False), "the claim made at pair 107"
    assert decide([], MARGIN) == (1.0, 1.0, False, False)


@pytest.mark.parametrize("rate", [0.0, 0.02, 0.05])
def test_another_packages_bets_come_to_the_same_claim(rate):
    u = np.random.default_rng(2).random(1500)
    agreeing = (u < rate).astype(float) - (u > 1 - rate)
    for shift, claim in ((0, "greater"), (-0.25, "less")):
        values = agreeing if shift == 0 else np.where(np.random.default_rng(3).random(1500) < -shift, -1.0, agreeing)
        theirs = paired_anytime_test(values, 0.025, claim, null=-MARGIN, breaks=50)
        ours = log_not_worse(values, MARGIN) if shift == 0 else log_worse(values, MARGIN)
        at = int(np.argmax(ours >= math.log(40))) + 1
        assert theirs.rejected_at is not None
        assert 0.4 < at / theirs.rejected_at < 2.5, "the stakes differ, the number of pairs not by much"


@pytest.mark.parametrize("margin", [0.0, 1.0, -0.05, 5.0, float("nan")])
def test_a_margin_out_of_range_is_refused(margin):
    with pytest.raises(ConfigError, match="--margin is in points and must lie between 0 and 100"):
        require_margin(margin)
    with pytest.raises(ConfigError, match="--margin"):
        log_not_worse([0.0], margin)
