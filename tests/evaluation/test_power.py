"""How many pairs would do, against enumeration of all tables, another package's power, and simulation."""

import itertools

import numpy as np
import pytest
from fieldtrial.stats.power import mcnemar_power
from scipy.stats import multinomial

from manicm_ms.evaluation.anytime import log_not_worse
from manicm_ms.evaluation.intervals import PairedCounts, score_interval
from manicm_ms.evaluation.power import (
    EQUAL,
    OBSERVED,
    chance_of_not_worse,
    chance_of_worse,
    needed_pairs,
    pairs_until_not_worse,
    shows_not_worse,
)
from manicm_ms.evaluation.statistics import mcnemar_exact


def tables(n):
    return [(b, c) for b, c in itertools.product(range(n + 1), repeat=2) if b + c <= n]


@pytest.mark.parametrize("margin", [0.05, 0.3])
def test_the_claim_is_that_of_tangos_interval_for_every_table(margin):
    for n in (4, 17):
        for b, c in tables(n):
            assert bool(shows_not_worse(b, c, n, margin)) == (score_interval(b, c, n).low > -margin)


def test_chances_are_the_sums_over_all_tables():
    n, b_rate, c_rate, margin = 16, 0.2, 0.1, 0.25
    law = multinomial(n, [b_rate, c_rate, 1 - b_rate - c_rate])
    shown = worse = 0.0
    for b, c in tables(n):
        probability = law.pmf([b, c, n - b - c])
        shown += probability * (score_interval(b, c, n).low > -margin)
        worse += probability * (c > b and mcnemar_exact(PairedCounts(0, c, b, 0)) <= 0.05)
    assert chance_of_not_worse(n, b_rate, c_rate, margin) == pytest.approx(shown, abs=1e-7)
    assert chance_of_worse(n, b_rate, c_rate) == pytest.approx(worse, abs=1e-7)


def test_the_power_of_mcnemars_test_is_another_packages():
    ours = chance_of_worse(60, 0.05, 0.25) + chance_of_worse(60, 0.25, 0.05)  # both ways, as theirs is
    assert ours == pytest.approx(mcnemar_power(0.25, 0.05, 60).power, abs=1e-6)


def test_needed_pairs_are_enough_and_far_fewer_are_not():
    assert needed_pairs(0, 0, 10, 0.05) == (73, "not worse", EQUAL)  # z^2 / (n + z^2) < 0.05
    found = needed_pairs(3, 3, 60, 0.05)
    assert (found.claim, found.supposing) == ("not worse", EQUAL)
    assert (
        chance_of_not_worse(found.pairs, 0.05, 0.05, 0.05)
        >= 0.8
        > chance_of_not_worse(int(0.9 * found.pairs), 0.05, 0.05, 0.05)
    )
    more = needed_pairs(10, 48, 1000, 0.05)  # equal ones would have shown it: 6 % differ
    assert (more.claim, more.supposing) == ("not worse", OBSERVED)
    assert more.pairs > 1000
    worse = needed_pairs(5, 60, 1000, 0.05)
    assert (worse.claim, worse.supposing) == ("worse", OBSERVED)
    assert chance_of_worse(worse.pairs, 0.005, 0.06) >= 0.8


def test_needed_pairs_beyond_all_measure_are_not_told():
    assert needed_pairs(450, 500, 1000, 0.000_1).pairs is None


def test_pairs_until_decided_are_those_of_other_draws():
    needed = pairs_until_not_worse(0.1, 0.05)
    assert needed == pairs_until_not_worse(0.1, 0.05)
    u = np.random.default_rng(11).random((300, needed))
    reached = log_not_worse((u < 0.05).astype(float) - (u > 0.95), 0.05) >= np.log(40)
    assert reached.any(axis=1).mean() == pytest.approx(0.8, abs=0.07)
    assert pairs_until_not_worse(0.0, 0.05) == 110
    assert pairs_until_not_worse(0.5, 0.001, paths=20) is None
