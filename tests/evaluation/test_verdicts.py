"""Pairs and verdicts: what is left out, what counts once, which conclusion stands; two other packages agree."""

import itertools

import numpy as np
import pytest
import robostats
from fieldtrial.stats.multiplicity import adjust_pvalues
from fieldtrial.stats.paired import mcnemar_exact as their_mcnemar
from fieldtrial.stats.paired import tango_interval
from robostats.kmodel import adjust

from manicm_ms.evaluation.pairs import Pair, compare_states, differences, pair_up, without_repeats
from manicm_ms.evaluation.rollout import POLICY_FAULT, EpisodeResult
from manicm_ms.evaluation.statistics import compare_paired, holm
from manicm_ms.evaluation.verdicts import BETTER, NOT_WORSE, UNDERPOWERED, WORSE, judge, sentence


def pairs(both, only_first, only_second, neither):
    kinds = [(True, True)] * both + [(True, False)] * only_first + [(False, True)] * only_second
    return [Pair(i, *kind) for i, kind in enumerate([*kinds, *[(False, False)] * neither])]


def episode(seed, success, crashed=None, state=None):
    return EpisodeResult(seed, success, 5, 2, 0.0, crashed, start_state=state)


def theirs(both, only_first, only_second, neither):
    """robostats' table; its `a` is our second policy."""
    return robostats.PairedResult(
        policy_id_a="second", policy_id_b="first", n_both_success=both, n_a_success_b_failure=only_second,
        n_b_success_a_failure=only_first, n_both_failure=neither,
        scenario_ids=tuple(map(str, range(both + only_first + only_second + neither))),
        dropped_from_a=0, dropped_from_b=0, protocol_fingerprints_a=(), protocol_fingerprints_b=(),
        replicates=None, scenario_spec_a=None, scenario_spec_b=None, provenance_a=None, provenance_b=None,
    )  # fmt: skip


@pytest.mark.parametrize("cells", [(5, 0, 0, 5), (80, 3, 9, 8), (10, 12, 1, 2), (0, 1, 0, 9), (40, 0, 11, 0)])
def test_numbers_without_repeats_are_those_of_two_other_packages_and_our_own(cells):
    found = compare_states(pairs(*cells))
    both, only_first, only_second, _ = cells
    assert (found.n, found.both, found.only_first, found.only_second) == (sum(cells), both, only_first, only_second)
    own = compare_paired([p.first for p in pairs(*cells)], [p.second for p in pairs(*cells)])
    assert found.p == own.mcnemar_p
    assert found.ci95 == own.difference_ci95
    assert found.ci95 == pytest.approx(tango_interval(only_second, only_first, sum(cells)), abs=1e-6)
    assert found.p == pytest.approx(their_mcnemar(only_second, only_first).pvalue)
    table = theirs(*cells)
    interval = robostats.paired_difference(table)
    assert found.ci95 == pytest.approx((interval.lower, interval.upper), abs=1e-6)
    assert found.p == pytest.approx(robostats.mcnemar(table).p_value)


def test_holms_correction_is_that_of_two_other_packages():
    for p_values in ([0.04], [0.01, 0.04, 0.03], [1.0, 1.0], list(np.random.default_rng(0).random(9) ** 3)):
        corrected = holm(p_values)
        assert corrected == pytest.approx(adjust_pvalues(p_values).adjusted)
        assert corrected == pytest.approx(adjust(list(p_values), "holm"))
    assert holm([]) == []


def test_a_crash_takes_its_pair_out_on_both_sides_and_a_policys_own_fault_does_not():
    fault = f"{POLICY_FAULT} 3 is not finite"
    first = [
        episode(1, True),
        episode(2, False, "solver diverged"),
        episode(3, True),
        episode(4, True),
        episode(5, True),
    ]
    second = [episode(1, True), episode(2, True), episode(3, False, fault), episode(4, False, "the env died: x"),
              episode(5, True)]  # fmt: skip
    found = pair_up(first, second)
    assert found.pairs == [Pair(1, True, True), Pair(3, True, False), Pair(5, True, True)]
    assert (found.crashed_first, found.crashed_second, found.left_out) == (1, 1, 2)


def test_repeats_on_one_start_state_count_as_one():
    first = [episode(i, won, state=state) for i, (won, state) in enumerate([(True, "a"), (True, "a"), (False, "b")])]
    second = [episode(i, won, state=state) for i, (won, state) in enumerate([(False, "a"), (True, "a"), (False, "b")])]
    found = pair_up(first, second).pairs
    counted = compare_states(found)
    assert (counted.n, counted.both, counted.only_first, counted.only_second, counted.neither) == (2, 0.5, 0.5, 0, 1)
    assert counted.difference == -0.25
    assert counted.repeats == 1
    assert differences(without_repeats(found)).tolist() == [-1.0, 0.0]
    # A hundred repeats of one state tell no more of other states than one does.
    many = compare_states([Pair("a", True, False)] * 100)
    assert (many.n, many.p) == (1, 1.0)
    assert many.ci95 == compare_states([Pair("a", True, False)]).ci95


def test_the_first_conclusion_that_holds_stands():
    def verdict(*cells, margin=0.05):
        found = compare_states(pairs(*cells))
        return judge(found, found.p, margin)

    assert verdict(80, 2, 18, 0)[:2] == (BETTER, True)
    assert verdict(60, 30, 2, 8)[:2] == (WORSE, False)
    assert verdict(1950, 40, 10, 0)[:2] == (WORSE, True), "surely worse, and surely by less than 5 points"
    assert verdict(95, 0, 0, 5)[:2] == (NOT_WORSE, True)
    assert verdict(9, 1, 0, 0)[:2] == (UNDERPOWERED, False)
    for b, c in itertools.product(range(0, 40, 3), repeat=2):  # better implies not worse, by any margin
        found = compare_states(pairs(60, c, b, 10))
        assert found.p > 0.05 or found.difference < 0 or found.ci95.low > 0
    empty = compare_states([])
    assert judge(empty, 1.0, 0.05) == (UNDERPOWERED, False, None)
    found = compare_states(pairs(80, 2, 12, 0))
    assert judge(found, found.p, 0.05).word == BETTER
    assert judge(found, 10 * found.p, 0.05).word == NOT_WORSE, "corrected for ten"


def test_a_test_and_an_interval_that_disagree_are_told_so():
    """Five pairs for A alone and none for B: McNemar's p is 1/16, and Tango's interval leaves 0 out."""
    found = compare_states(pairs(45, 5, 0, 0))
    assert found.ci95.high < 0
    said = sentence("A", "B", found, judge(found, found.p, 0.05), 0.05)
    assert said.startswith("50 start states hint at a difference between B and A: -10.0 points")
    assert said.endswith("which McNemar's exact test does not confirm. Play more episodes.")


def test_sentences_are_plain_and_say_how_many_episodes_would_do():
    def told(*cells):
        found = compare_states(pairs(*cells))
        return sentence("A", "B", found, judge(found, found.p, 0.05), 0.05)

    assert told(80, 2, 18, 0).startswith(
        "B is better than A by McNemar's exact test: +16.0 points (Tango's score interval, 95 %: +8.2 to +25.1)"
    )
    assert told(1950, 40, 10, 0).startswith(
        "B is worse than A by McNemar's exact test, though by less than 5 points: -1.5 points"
    )
    assert told(95, 0, 0, 5).startswith("B is not worse than A by more than 5 points: +0.0 points")
    assert told(10, 0, 0, 0) == (
        "10 start states cannot tell B from A: +0.0 points (Tango's score interval, 95 %: -27.8 to +27.8). If both are "
        "equally good and differ on as many start states as here (0 %), about 73 episodes of each would show that B is "
        "not worse by more than 5 points, with a chance of 80 %."
    )
    assert "Equally good policies would have shown it by now" in told(366, 19, 8, 7)
    assert told(0, 0, 0, 0) == "Nothing can be said about B and A: no start state was played by both without a crash."
